"""Views of a suture plan's review: the cloud by depth noise, the stitches by level, a table."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import rerun as rr

from igtl_gateway.addon.reading import Entry, Kind
from igtl_gateway.addon.terminal import counted
from igtl_gateway.addons.review import Level, PlanReview, Review, StitchReview
from igtl_gateway.addons.view import colours
from igtl_gateway.addons.view.contents import (
    REVIEW_CLOUD,
    REVIEW_DISTANCE,
    REVIEW_LEGENDS,
    REVIEW_STITCHES,
    REVIEW_TABLE,
    REVIEW_WRONG,
)
from igtl_gateway.addons.view.legend import scale_bar
from igtl_gateway.addons.view.pen import Pen

_COLOURS = {Level.OK: 0x66BB6AFF, Level.LOOK: 0xFFB300FF, Level.WRONG: 0xFF1744FF}
#: Lighter colours of the levels, for labels that are readable on a cloud.
_LETTERS = {Level.LOOK: 0xFFECB3FF, Level.WRONG: 0xFFCDD2FF}
_MARKS = {Level.OK: "ok", Level.LOOK: "look", Level.WRONG: "**wrong**"}
_NAMES = f"{REVIEW_STITCHES}/names"
_LINE_M = 0.0005
#: Red end of the noise scale, as a multiple of the limit for the level LOOK.
_RED = 2.0
#: Red end of the distance scale, in mm: a few bite lengths.
_FAR_MM = 20.0


def draw_review(review: Review, pen: Pen) -> dict[str, str]:
    """Draw the clouds once, and stitches and table for each version of the plan; return cloud → colour scale."""
    cloud = review.cloud
    red_mm = review.thresholds.noise_mm * _RED
    points = rr.Points3D(
        cloud.positions,
        colors=colours.scale_colours(cloud.noise_mm, 0.0, red_mm),
        radii=[rr.Radius.ui_points(2.0)],
    )
    pen.static(REVIEW_CLOUD, rr.CoordinateFrame(cloud.frame_id), points)
    for path in (REVIEW_STITCHES, REVIEW_DISTANCE, _NAMES, REVIEW_WRONG, f"{REVIEW_WRONG}/names"):
        pen.static(path, rr.CoordinateFrame(cloud.frame_id))
    scales = {
        REVIEW_CLOUD: ("Depth noise", 0.0, red_mm, "mm"),
        REVIEW_DISTANCE: ("Distance to plan", 0.0, _FAR_MM, "mm"),
    }
    _draw_legends(cloud.frame_id, review, scales, pen)
    for number, plan in enumerate(review.plans, 1):
        pen.at(Entry(0, plan.stamp_ns, Kind.NOTE, source_ns=plan.source_ns))
        pen.log(REVIEW_STITCHES, _stitches(plan))
        pen.log(REVIEW_DISTANCE, _by_distance(cloud.positions, plan))
        pen.log(_NAMES, _names(plan))
        pen.log(REVIEW_WRONG, _wrong(plan))
        pen.log(f"{REVIEW_WRONG}/names", _names(plan))
        pen.log(
            REVIEW_TABLE,
            rr.TextDocument(pen.displayable(_table(review, plan, number, red_mm)), media_type="text/markdown"),
        )
    return {cloud: f"{name} {low:g} … {high:g} {unit}" for cloud, (name, low, high, unit) in scales.items()}


def _draw_legends(frame: str, review: Review, scales: dict[str, tuple[str, float, float, str]], pen: Pen) -> None:
    """Draw a bar for each scale below the box of the stitches, where their view looks."""
    stitches = [end.position for stitch in review.last.stitches for end in (stitch.entry, stitch.exit)]
    if not stitches:
        return
    low, high = np.min(stitches, axis=0), np.max(stitches, axis=0)
    for cloud, scale in scales.items():
        for place, part in zip(("", "/numbers"), scale_bar(*scale, (low, high)), strict=True):
            pen.static(f"{REVIEW_LEGENDS[cloud]}{place}", rr.CoordinateFrame(frame), part)


def _by_distance(positions: npt.NDArray[np.float32], plan: PlanReview) -> rr.Points3D:
    """Colour the cloud by its distance from the nearest stitch."""
    nearest = np.full(len(positions), np.inf)
    for stitch in plan.stitches:
        begin, end = np.array(stitch.entry.position), np.array(stitch.exit.position)
        along = end - begin
        share = (positions - begin) @ along / (float(along @ along) or 1.0)
        off = positions - (begin + np.clip(share, 0.0, 1.0)[:, None] * along)
        np.minimum(nearest, np.sqrt((off**2).sum(axis=1)), out=nearest)
    colour = colours.scale_colours(nearest * 1000.0, 0.0, _FAR_MM)
    return rr.Points3D(positions, colors=colour, radii=[rr.Radius.ui_points(2.0)])


def _stitches(plan: PlanReview) -> rr.LineStrips3D:
    strips = np.array([(stitch.entry.position, stitch.exit.position) for stitch in plan.stitches], np.float32)
    return rr.LineStrips3D(
        strips.reshape(-1, 2, 3),
        colors=np.array([_COLOURS[stitch.level] for stitch in plan.stitches], np.uint32),
        radii=[_LINE_M],
        labels=[_label(stitch) for stitch in plan.stitches],
        show_labels=False,  # labels of all points would overlap: show one under the pointer
    )


def _wrong(plan: PlanReview) -> rr.LineStrips3D:
    """Mark the wrong stitches by thick red lines, for the view of the tissue."""
    strips = [(stitch.entry.position, stitch.exit.position) for stitch in plan.wrong]
    return rr.LineStrips3D(
        np.array(strips, np.float32).reshape(-1, 2, 3), colors=[_COLOURS[Level.WRONG]], radii=[2 * _LINE_M]
    )


def _names(plan: PlanReview) -> rr.Points3D:
    """Label the stitches that are not good, at the end that is further off the tissue."""
    named = [stitch for stitch in plan.stitches if stitch.level is not Level.OK]
    ends = [max((each.entry, each.exit), key=lambda end: abs(end.distance_mm or 0.0)) for each in named]
    return rr.Points3D(
        np.array([end.position for end in ends], np.float32).reshape(-1, 3),
        colors=np.array([_LETTERS[stitch.level] for stitch in named], np.uint32),
        radii=[2 * _LINE_M],
        labels=[_label(stitch) for stitch in named],
        show_labels=True,
    )


def _label(stitch: StitchReview) -> str:
    """Return the number of a stitch and, if it is not good, its distance from the tissue."""
    if stitch.level is Level.OK:
        return stitch.label
    distances = [end.distance_mm for end in (stitch.entry, stitch.exit) if end.distance_mm is not None]
    worst = max(distances, key=abs, default=None)
    return f"{stitch.label}: {stitch.level.value}" + (f" {worst:+.1f} mm" if worst is not None else "")


def _table(review: Review, plan: PlanReview, number: int, red_mm: float) -> str:
    """Return a table of the stitches, the worst first; reasons are above the table, where lines wrap."""
    lines = [
        f"**Plan {number} of {len(review.plans)}**, {plan.topic}: {len(plan.wrong)} of "
        f"{counted(len(plan.stitches), 'stitch', 'stitches')} "
        "are wrong.",
        "",
        *(
            f"- **{stitch.label}** {stitch.level.value}: {'; '.join(stitch.reasons)}"
            for stitch in sorted(plan.stitches, key=lambda each: -each.level.rank)
            if stitch.reasons
        ),
        "",
        "| stitch | judged | entry off tissue (mm) | exit off tissue (mm) | depth noise (mm) | spacing (mm) "
        "| bite length (mm) |",
        "|---|---|---|---|---|---|---|",
    ]
    for stitch in sorted(plan.stitches, key=lambda each: -each.level.rank):
        ends = (stitch.entry, stitch.exit)
        noise = max((end.noise_mm for end in ends if end.noise_mm is not None), default=None)
        spacing = min((end.spacing_mm for end in ends if end.spacing_mm is not None), default=None)
        cells = [
            stitch.label,
            _MARKS[stitch.level],
            *(_mm(end.distance_mm, sign=True) for end in ends),
            *(_mm(noise), _mm(spacing), _mm(stitch.bite_length_mm)),
        ]
        lines.append(f"| {' | '.join(cells)} |")
    lines += [
        "",
        f"Colours of the cloud: depth noise, blue 0 … red {red_mm:g} mm; distance from the nearest stitch, "
        f"blue 0 … red {_FAR_MM:g} mm. All lengths in mm.",
    ]
    return "\n".join([*lines, *(f"\n{note}" for note in review.notes)])


def _mm(value: float | None, *, sign: bool = False) -> str:
    if value is None:
        return "-"
    return f"{value:+.2f}" if sign else f"{value:.2f}"
