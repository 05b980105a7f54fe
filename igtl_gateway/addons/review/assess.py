"""The review of a session: compares every version of the plan with the tissue and with the path of the tool."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from igtl_gateway.addons.review import executed, judge, points
from igtl_gateway.addons.review.choices import Thresholds
from igtl_gateway.addons.review.error import SURE_95
from igtl_gateway.addons.review.frames import FramePath
from igtl_gateway.addons.review.material import Material
from igtl_gateway.addons.review.messages import DrawnPlan
from igtl_gateway.addons.review.model import (
    Change,
    CloudReview,
    EndReview,
    Executed,
    PlanReview,
    Review,
    StitchReview,
)
from igtl_gateway.addons.review.points import Assessed
from igtl_gateway.addons.review.scene import DepthScene
from igtl_gateway.addons.review.surface import TissueSurface, fit

Array = npt.NDArray[Any]

MM = 1000.0
_FEW_CLOUDS = 3  # with fewer, the median does not remove an outlier of one cloud
_CHORD_STEPS = 33  # positions on the straight line from entry to exit
_LONGEST_BITE_M = 0.1  # a longer one is not a stitch
_BEYOND_BITE_M = 0.0015  # margin of tissue around a bite in the fit that its depth refers to
_MOVED_MM = 0.5  # median change of the depth from which a note reports motion
_WIDER = 2.0  # window of the wider fit, in windows
_MIN_FOR_MEDIAN = 3  # stitches from which lengths are compared with their median
_SAME_MM = 0.02  # distance below which a point has not moved between versions


def review_of(material: Material, thresholds: Thresholds | None = None) -> Review:
    """Return the review of the collected material.

    Raises GatewayError if the session has no cloud or no plan, ConfigError if it does not have the requested ones.
    """
    limits = thresholds or Thresholds()
    scene, topic = material.scene()
    versions = material.versions(scene)
    base = scene.clouds[-1].frame_id
    tool, path = _tool(material, base, versions[-1])
    notes = [*material.notes, *_caveats(scene)]
    if not tool:
        notes.append(f"no moving frame is known in {base!r}: the plan is not compared with the path of a tool")
    assessor = _Assessor(scene, limits)
    plans = [assessor.plan(version, path if version is versions[-1] else None) for version in versions]
    known = np.isfinite(scene.depth)
    points_of_rays = np.concatenate([scene.rays, np.ones((len(scene.rays), 1))], axis=1) * scene.depth[:, None]
    positions = scene.axes.from_optical(points_of_rays[known])
    middle = np.array(np.median(scene.depth[known]) if known.any() else np.nan)
    height, width, _ = scene.clouds[-1].points.shape
    first, last = scene.clouds[0], scene.clouds[-1]
    cloud = CloudReview(
        topic,
        base,
        len(scene.clouds),
        (first.stamp_ns, last.stamp_ns),
        (first.source_ns, last.source_ns),
        height,
        width,
        positions.astype(np.float32),
        (scene.noise[known] * MM).astype(np.float32),
        scene.temporal is not None,
        float(scene.steps.at(middle)) * MM,
        scene.steps.grow,
    )
    return Review(cloud, tuple(plans), tuple(_changes(plans[0], plans[-1])), tool, limits, tuple(notes))


def _caveats(scene: DepthScene) -> list[str]:
    """Return notes on what makes the figures less certain than their standard errors."""
    notes = [scene.note] if scene.note else []
    if len(scene.clouds) < _FEW_CLOUDS:
        notes.append(
            f"only {len(scene.clouds)} cloud{'s' * (len(scene.clouds) > 1)}: "
            "a single bad cloud cannot be distinguished from the tissue, and errors are lower bounds"
        )
    if len(scene.clouds) > 1:
        steps = scene.depths[-1] - scene.depths[0]
        steps = steps[np.isfinite(steps)]
        moved_mm = float(np.median(steps)) * MM if steps.size else 0.0
        if abs(moved_mm) > _MOVED_MM:
            notes.append(
                f"the scene moved by {moved_mm:+.1f} mm in depth from the first to the last cloud: "
                "distances refer to its median position"
            )
    return notes


def _tool(material: Material, base: str, plan: DrawnPlan) -> tuple[str, FramePath | None]:
    """Return the moving frame that comes closest to the plan, and its path in ``base``; "" and None without one."""
    best: tuple[float, str, FramePath] | None = None
    for frame in material.tools(base):
        path = material.frames.path(frame, base)
        if not len(path.positions):
            material.note(f"{frame}: its path in {base!r} is not known: not compared with the plan", *path.notes)
            continue
        off = [((path.positions - point) ** 2).sum(axis=1).min() for point in plan.ends()]
        nearness = float(np.sort(off)[: max(len(off) // 4, 1)].mean())
        if best is None or nearness < best[0]:
            best = nearness, frame, path
    if best is None:
        return "", None
    material.note(*best[2].notes)
    return best[1], best[2]


class _Assessor:
    """Assesses plans on one scene, with one fit for each point, even if several versions have it."""

    def __init__(self, scene: DepthScene, limits: Thresholds) -> None:
        self._scene = scene
        self._limits = limits
        self._ends: dict[bytes, Assessed] = {}
        self._bites: dict[bytes, TissueSurface | None] = {}

    def plan(self, drawn: DrawnPlan, path: FramePath | None) -> PlanReview:
        """Return the review of one version; ``path`` of the tool is given for the executed version only."""
        limits, count = self._limits, len(drawn.entry)
        passed: list[Executed | None] = [None] * (2 * count)
        if path is not None:
            passed = list(executed.approaches(path, drawn.ends(), limits.reach_mm))
        spacing = [_spacing(ends) for ends in (drawn.entry, drawn.exit)]
        median_spacing = [float(np.median(found)) if count >= _MIN_FOR_MEDIAN else 0.0 for found in spacing]
        lengths = np.sqrt(((drawn.exit - drawn.entry) ** 2).sum(axis=1)) * MM
        median_bite = float(np.median(lengths)) if count >= _MIN_FOR_MEDIAN else 0.0
        found_ends = points.with_own_errors(self._scene, [self._end(point) for point in drawn.ends()])
        stitches = []
        for i in range(count):
            ends = [
                replace(found_ends[number], spacing_mm=float(found[i]) if count > 1 else None, executed=approach)
                for number, found, approach in ((i, spacing[0], passed[i]), (count + i, spacing[1], passed[count + i]))
            ]
            reasons: list[judge.Reason] = []
            for name, end, median_mm in zip(("entry", "exit"), ends, median_spacing, strict=True):
                reasons += judge.of_end(name, end, limits)
                if end.spacing_mm is not None:
                    reasons += judge.of_length(f"{name}: spacing", end.spacing_mm, median_mm, limits.spacing)
            length_mm = float(lengths[i])
            reasons += judge.of_length("bite", length_mm, median_bite, limits.bite)
            level, texts = judge.worst_level(reasons)
            surface = self._bite(drawn.entry[i], drawn.exit[i])
            driven = None
            if path is not None and surface and (entered := ends[0].executed) and (left := ends[1].executed):
                optical = replace(path, positions=self._scene.axes.to_optical(path.positions))
                driven = executed.driven_depth_mm(optical, entered, left, surface)
            stitches.append(
                StitchReview(
                    number=i + 1,
                    label=drawn.labels[i] if drawn.labels else str(i + 1),
                    entry=ends[0],
                    exit=ends[1],
                    bite_length_mm=length_mm,
                    bite_depth_mm=self._chord_depth_mm(drawn.entry[i], drawn.exit[i], surface) if surface else None,
                    driven_depth_mm=driven,
                    level=level,
                    reasons=texts,
                )
            )
        return PlanReview(drawn.topic, drawn.type, drawn.frame_id, drawn.stamp_ns, drawn.source_ns, tuple(stitches))

    def _end(self, point: Array) -> Assessed:
        key = point.tobytes()
        if key not in self._ends:
            self._ends[key] = self._assessed(point)
        return self._ends[key]

    def _assessed(self, position: Array) -> Assessed:
        scene, limits = self._scene, self._limits
        x, y, z = (float(value) for value in position)
        end = EndReview((x, y, z))
        point = scene.axes.to_optical(position)
        z = float(point[2])
        if not z > 0:
            return end, None
        ray = point[:2] / z
        place = scene.around(ray, limits.place_mm / MM / z)
        if not len(place):
            return end, None
        temporal, spatial = (_median_mm(found, place) for found in (scene.temporal, scene.spatial))
        known = np.isfinite(scene.depths[:, place])
        end = replace(
            end,
            noise_mm=spatial if temporal is None else temporal,
            temporal_mm=temporal,
            spatial_mm=spatial,
            missing=None if scene.spatial is None else float(1 - known.mean()),
        )
        surface = fit(scene, point, limits.window_mm / MM)
        if surface is None:
            return end, None
        distance_mm = MM * float(surface.distance(point[None])[0])
        # wrong readings that fill the window are fitted as tissue; a wider window has more correct readings
        wider = fit(scene, point, _WIDER * limits.window_mm / MM)
        wider_mm = distance_mm - MM * float(wider.distance(point[None])[0]) if wider else None
        slant = float(surface.slant(ray[None])[0])
        core = scene.around(ray, limits.core_mm / MM / z)
        core = core[np.isfinite(scene.depth[core])]
        reading = None
        if len(core):
            readings = np.concatenate([scene.rays[core], np.ones((len(core), 1))], axis=1) * scene.depth[core, None]
            reading = float(np.median(surface.distance(readings))) * MM
        # the disc has its radius at the depth of the point; its area on the tissue grows with depth and slope
        scale = float(surface.depth(ray[None])[0]) / z
        area_mm2 = np.pi * limits.place_mm**2 * scale**2 * slant
        error_mm = surface.error / slant * MM
        end = replace(
            end,
            distance_mm=distance_mm,
            error_mm=error_mm,
            interval_mm=SURE_95 * error_mm,
            reading_mm=reading,
            wider_mm=wider_mm,
            density_mm2=float(known.sum(axis=1).mean() / area_mm2),
        )
        return end, surface.reading / slant * MM

    def _chord_depth_mm(self, entry: Array, leave: Array, surface: TissueSurface) -> float:
        shares = np.linspace(0, 1, _CHORD_STEPS)[:, None]
        return -MM * float(surface.distance(self._scene.axes.to_optical(entry + shares * (leave - entry))).min())

    def _bite(self, entry: Array, leave: Array) -> TissueSurface | None:
        """Return the tissue around a complete stitch, or None; the robust fit bridges an open wound."""
        key = entry.tobytes() + leave.tobytes()
        if key not in self._bites:
            half = float(np.sqrt(((leave - entry) ** 2).sum())) / 2
            entry, leave = self._scene.axes.to_optical(entry), self._scene.axes.to_optical(leave)
            window = max(self._limits.window_mm / MM, half + _BEYOND_BITE_M)
            sane = min(entry[2], leave[2]) > 0 and half < _LONGEST_BITE_M / 2
            self._bites[key] = fit(self._scene, (entry + leave) / 2, window) if sane else None
        return self._bites[key]


def _spacing(points: Array) -> Array:
    """Return (n,) distances from each point to the nearer of its neighbours in the plan, mm."""
    steps = np.sqrt((np.diff(points, axis=0) ** 2).sum(axis=1)) * MM
    beside = np.full((2, len(points)), np.inf)
    beside[0, 1:] = beside[1, :-1] = steps
    nearer: Array = beside.min(axis=0)
    return nearer


def _median_mm(noise: Array | None, place: Array) -> float | None:
    """Return the median of the known noise at these pixels, mm; None if none is known."""
    if noise is None:
        return None
    found = noise[place]
    found = found[np.isfinite(found)]
    return float(np.median(found)) * MM if found.size else None


def _changes(first: PlanReview, last: PlanReview) -> list[Change]:
    """Return the changed stitches, matched by index if both versions have equally many, otherwise by proximity."""
    pairs: list[tuple[StitchReview | None, StitchReview | None]]
    if len(first.stitches) == len(last.stitches):
        pairs = list(zip(first.stitches, last.stitches, strict=True))
    else:
        pairs = _nearest(first, last)
    changes = []
    for before, after in pairs:
        if before and after:
            moved = tuple(
                MM * float(np.sqrt(((np.array(a.position) - np.array(b.position)) ** 2).sum()))
                for a, b in ((before.entry, after.entry), (before.exit, after.exit))
            )
            if max(moved) > _SAME_MM:
                changes.append(Change(after.number, after.label, (moved[0], moved[1]), before.level, after.level))
        elif one := after or before:
            changes.append(
                Change(one.number, one.label, None, before.level if before else None, after.level if after else None)
            )
    return changes


def _nearest(first: PlanReview, last: PlanReview) -> list[tuple[StitchReview | None, StitchReview | None]]:
    """Return pairs of stitches whose centres are mutually nearest; a stitch without a match is paired with None."""
    before, after = (
        np.array([np.add(stitch.entry.position, stitch.exit.position) / 2 for stitch in plan.stitches])
        for plan in (first, last)
    )
    square = ((before[:, None] - after[None]) ** 2).sum(axis=-1)
    pairs: list[tuple[StitchReview | None, StitchReview | None]] = []
    matched = set()
    for number, stitch in enumerate(last.stitches):
        nearest = int(np.argmin(square[:, number]))
        if int(np.argmin(square[nearest])) == number:
            matched.add(nearest)
            pairs.append((first.stitches[nearest], stitch))
        else:
            pairs.append((None, stitch))
    pairs += [(stitch, None) for number, stitch in enumerate(first.stitches) if number not in matched]
    return pairs
