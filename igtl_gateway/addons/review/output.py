"""The output of ``review``: JSON and CSV for programs, tables for people."""

from __future__ import annotations

import csv
import shutil
import textwrap
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from igtl_gateway.addon.terminal import cell, count_text, is_terminal, moment_text, print_line, width
from igtl_gateway.addon.writing import open_text, written
from igtl_gateway.addons.review import EndReview, Level, PlanReview, Review, StitchReview

_COLOURS = {Level.OK: "32", Level.LOOK: "33", Level.WRONG: "1;31"}
_MARKS = {Level.OK: " ", Level.LOOK: "?", Level.WRONG: "!"}
_NS_PER_S = 1e9
_NARROW = 30  #: letters that a line of reasons has at least
_STEP_SHARE = 0.5  # of the noise: smaller steps of depth are not worth a word


# -- for programs --------------------------------------------------------------------------------------------------


def review_facts(path: Path, review: Review) -> dict[str, Any]:
    cloud = review.cloud
    return {
        "file": str(path),
        "good": not review.last.wrong,
        "cloud": {
            "topic": cloud.topic,
            "frame_id": cloud.frame_id,
            "clouds": cloud.clouds,
            "height": cloud.height,
            "width": cloud.width,
            "points": len(cloud.positions),
            "noise": "temporal" if cloud.temporal else "spatial",
            "noise_mm": dict(zip(("p10", "median", "p90"), _noise(review), strict=True)),
            "step_mm": round(cloud.step_mm, 4),
            "step_grows": round(cloud.step_grows, 2),
        },
        "tool": review.tool,
        "thresholds": asdict(review.thresholds),
        "plans": [_json_value(asdict(plan)) for plan in review.plans],
        "changes": [_json_value(asdict(change)) for change in review.changes],
        "notes": review.notes,
    }


def _json_value(value: Any) -> Any:
    """Levels as words; micrometres are enough."""
    match value:
        case Level():
            return value.value
        case dict():
            return {key: _json_value(part) if key != "position" else part for key, part in value.items()}
        case list() | tuple():
            return [_json_value(part) for part in value]
        case float():
            return round(value, 4)
        case _:
            return value


def _noise(review: Review) -> tuple[float | None, ...]:
    """10 %, 50 % and 90 % of the points have less, mm."""
    known = np.sort(review.cloud.noise_mm[np.isfinite(review.cloud.noise_mm)])
    if not known.size:
        return None, None, None
    return tuple(round(float(known[int(share * (known.size - 1))]), 4) for share in (0.1, 0.5, 0.9))


_END_COLUMNS = (
    *("distance_mm", "error_mm", "noise_mm", "temporal_mm", "spatial_mm", "reading_mm", "wider_mm"),
    *("density_mm2", "missing", "spacing_mm", "interval_mm", "scatter_mm"),
)


def write_csv(path: Path, review: Review, overwrite: bool) -> None:
    with written(path, overwrite=overwrite) as place, open_text(place, newline="") as out:
        rows = list(_csv_rows(review))
        writer = csv.DictWriter(out, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)


def _csv_rows(review: Review) -> Iterable[dict[str, Any]]:
    for version, plan in enumerate(review.plans, 1):
        for stitch in plan.stitches:
            row: dict[str, Any] = {
                "version": version,
                "topic": plan.topic,
                "stamp_ns": plan.stamp_ns,
                "stitch": stitch.number,
                "label": stitch.label,
                "mark": stitch.mark,
                "level": stitch.level.value,
            }
            for name, end in (("entry", stitch.entry), ("exit", stitch.exit)):
                row |= {f"{name}_{axis}_m": f"{value:.6f}" for axis, value in zip("xyz", end.position, strict=True)}
                row |= {f"{name}_{column}": _number(getattr(end, column)) for column in _END_COLUMNS}
                row[f"{name}_lifted"] = int(end.lifted)
                row[f"{name}_tool_mm"] = _number(end.executed.distance_mm if end.executed else None)
                row[f"{name}_reached"] = int(end.executed.reached) if end.executed else ""
            row |= {
                column: _number(getattr(stitch, column))
                for column in ("bite_length_mm", "bite_depth_mm", "driven_depth_mm")
            }
            yield row | {"reasons": "; ".join(stitch.reasons)}


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.4f}"


# -- for people ----------------------------------------------------------------------------------------------------


def print_review(path: Path, review: Review, start_ns: int) -> None:
    colour = is_terminal()
    cloud, plans = review.cloud, review.plans
    stitches = count_text(len(review.last.stitches), "stitch", "stitches")
    print_line(f"{path}: {stitches}, {count_text(len(plans), 'version')} of the plan")
    size = (
        f"{cloud.width} × {cloud.height}" if cloud.height > 1 else f"{count_text(cloud.width, 'point')}, not organised"
    )
    print_line(f"  cloud  {cloud.topic}, {count_text(cloud.clouds, 'cloud')} of {size}, frame {cloud.frame_id}")
    low, middle, high = _noise(review)
    if middle is not None:
        how = "from cloud to cloud" if cloud.temporal else "from pixel to pixel, a lower bound"
        if cloud.step_mm > _STEP_SHARE * middle:
            growing = ", growing with depth" if cloud.step_grows > 1 else ""
            how += f"; depth comes in steps of {cloud.step_mm:.2f} mm{growing}"
        print_line(f"  noise  {middle:.2f} mm in depth ({low:.2f} … {high:.2f}), {how}")
    if review.tool:
        print_line(f"  tool   {review.tool}")
    for note in review.notes:
        print_line(f"  note   {note}")
    for version, plan in enumerate(plans, 1):
        when = moment_text(plan.stamp_ns - start_ns)
        print_line("", f"plan {version} of {len(plans)}: {plan.topic} at {when}, {_levels(plan)}")
        if plan is review.first or plan is review.last:
            _print_plan(plan, colour, with_tool=bool(review.tool) and plan is review.last)
    _print_changes(review, colour)
    wrong = [stitch.name for stitch in review.last.wrong]
    verdict = f"WRONG: {', '.join(wrong)}" if wrong else "no stitch of the last plan is wrong"
    print_line()
    print_line(verdict, colour=_COLOURS[Level.WRONG if wrong else Level.OK] if colour else "")


def _levels(plan: PlanReview) -> str:
    found = Counter(stitch.level for stitch in plan.stitches)
    return ", ".join(f"{found[level]} {level.value}" for level in Level if found[level])


_TITLES = (
    ("stitch", ""),
    ("above tissue, mm", "entry"),
    ("", "exit"),
    ("noise", "mm"),
    ("spacing", "mm"),
    ("bite, mm", "length"),
    ("", "depth"),
    ("points", "/mm²"),
    ("no", "depth"),
)
_TOOL_TITLES = (("stitch", ""), ("tool, mm", "entry"), ("", "exit"), ("", "depth"))


def _print_plan(plan: PlanReview, colour: bool, with_tool: bool) -> None:
    _print_table(plan, colour, _TITLES, [_row(stitch) for stitch in plan.stitches], with_reasons=True)
    if with_tool:
        _print_table(plan, colour, _TOOL_TITLES, [_tool_row(stitch) for stitch in plan.stitches], with_reasons=False)


def _print_table(
    plan: PlanReview,
    colour: bool,
    titles: Sequence[tuple[str, str]],
    rows: Sequence[tuple[str, ...]],
    *,
    with_reasons: bool,
) -> None:
    """Print a row for each stitch, in 80 columns; what is of both ends is the worse one of them."""
    table = [*(tuple(title[line] for title in titles) for line in (0, 1)), *rows]
    # a title in the first line may lie over the columns to its right
    alone = [bool(following) for following, _ in (*titles[1:], ("end", ""))]
    widths = [max(len(row[column]) for row in table[0 if alone[column] else 1 :]) for column in range(len(titles))]
    widths[0] = width(row[0] for row in table)
    over = ""
    for column, (title, wide) in enumerate(zip(table[0], widths, strict=True)):
        at = sum(widths[:column]) + 2 * column
        over = over.ljust(at) + (title if not column else "")
        if column and title:
            over += title if len(title) > wide else title.rjust(wide)
    print_line(f"    {over}".rstrip())
    room = shutil.get_terminal_size().columns - widths[0] - 6 if is_terminal() else 0
    for number, row in enumerate(table[1:]):
        cells = [cell(row[0], widths[0]), *(text.rjust(wide) for text, wide in zip(row[1:], widths[1:], strict=True))]
        line = "  ".join(cells).rstrip()
        if number == 0:
            print_line(f"    {line}")
            continue
        stitch = plan.stitches[number - 1]
        painted = colour and stitch.level is not Level.OK
        print_line(f"  {_MARKS[stitch.level]} {line}", colour=_COLOURS[stitch.level] if painted else "")
        for reason in stitch.reasons if with_reasons else ():
            for part in _wrapped(reason, room):
                print_line(f"    {' ' * widths[0]}  {part}")


def _wrapped(text: str, room: int) -> list[str]:
    """``text`` in lines of ``room`` letters; 0: in one."""
    return textwrap.wrap(text, max(room, _NARROW)) if room else [text]


def _row(stitch: StitchReview) -> tuple[str, ...]:
    ends = (stitch.entry, stitch.exit)
    noise = [end.noise_mm for end in ends if end.noise_mm is not None]
    spacing = [end.spacing_mm for end in ends if end.spacing_mm is not None]
    density = [end.density_mm2 for end in ends if end.density_mm2 is not None]
    missing = [end.missing for end in ends if end.missing is not None]
    return (
        stitch.name,
        *(_off(end) for end in ends),
        _mm(max(noise, default=None)),
        _mm(min(spacing, default=None), 1),
        _mm(stitch.bite_length_mm, 1),
        _mm(stitch.bite_depth_mm, 1),
        f"{min(density):.1f}" if density else "–",
        f"{max(missing):.0%}" if missing else "–",
    )


def _tool_row(stitch: StitchReview) -> tuple[str, ...]:
    ends = (stitch.entry, stitch.exit)
    tool = (_mm(end.executed.distance_mm) if end.executed and end.executed.reached else "–" for end in ends)
    return (stitch.name, *tool, _mm(stitch.driven_depth_mm, 1))


def _off(end: EndReview) -> str:
    if end.distance_mm is None or end.error_mm is None:
        return "–"
    return f"{end.distance_mm:+.2f}±{end.error_mm:.2f}"


def _mm(value: float | None, digits: int = 2) -> str:
    return "–" if value is None else f"{value:.{digits}f}"


def _print_changes(review: Review, colour: bool) -> None:
    if len(review.plans) == 1:
        return
    print_line("", "from the first plan to the last")
    if not review.changes:
        print_line("  nothing changed")
    for change in review.changes:
        before, after = (level.value if level else "" for level in (change.before, change.after))
        if change.moved_mm:
            entry, leave = change.moved_mm
            text = f"entry moved by {entry:.2f} mm, exit by {leave:.2f} mm: {before} → {after}"
        else:
            text = f"added: {after}" if change.after else f"taken out: was {before}"
        print_line(f"  {change.label}  {text}", colour=_COLOURS[change.after or Level.OK] if colour else "")
