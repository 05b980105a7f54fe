"""The results of a review: values without arithmetic; ``choices`` has what a user can choose.

Positions are in metres, in the frame of the cloud.  Lengths with ``_mm`` in their name are for the reader, in
millimetres.  Stamps are UTC ns.  ``None`` stands for a figure that could not be determined.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum
from typing import Any

import numpy.typing as npt

from igtl_gateway.addon.terminal import counted
from igtl_gateway.addons.review.choices import Thresholds

Array = npt.NDArray[Any]
Point = tuple[float, float, float]


class Level(Enum):
    """The level of a stitch; ordered by ``rank``."""

    OK = "ok"
    LOOK = "look"  #: a person should look at it: a figure is near a limit, or cannot be trusted
    WRONG = "wrong"  #: not on the tissue, with the given confidence

    @property
    def rank(self) -> int:
        """Severity, from 0 (ok) to 2 (wrong)."""
        return list(Level).index(self)


@dataclass(frozen=True, slots=True)
class CloudReview:
    """The combined clouds: the depth image and its noise.

    Attributes:
        topic: of the clouds.
        frame_id: of the clouds.
        clouds: number of clouds that were used.
        stamps_ns: gateway times of the first and the last of them, UTC.
        source_stamps_ns: the camera's stamps of these two clouds, UTC; 0 = unset.
        height, width: pixels; height 1 for an unorganised cloud.
        positions: (points, 3) float32, metres: the pixels with a depth.
        noise_mm: (points,) float32, depth noise as standard deviation; NaN if unknown.
        step_mm: step of the depth at the median depth; 0 if depth is continuous.
        step_grows: exponent with which the step grows with depth: 0 for steps of depth, 2 for steps of disparity.
        temporal: whether the noise was measured between clouds (the complete noise), or within one (a lower bound).
    """

    topic: str
    frame_id: str
    clouds: int
    stamps_ns: tuple[int, int]
    source_stamps_ns: tuple[int, int]
    height: int
    width: int
    positions: Array
    noise_mm: Array
    temporal: bool
    step_mm: float = 0.0
    step_grows: float = 0.0


@dataclass(frozen=True, slots=True)
class Executed:
    """The closest approach of the tool's origin to a planned point.

    Attributes:
        distance_mm: smallest distance.
        stamp_ns: gateway time of this distance, UTC.
        position: of the tool at this time, metres, frame of the cloud.
        reached: whether the tool was within ``Thresholds.reach_mm`` while no other planned point was nearer.
    """

    distance_mm: float
    stamp_ns: int
    position: Point
    reached: bool


@dataclass(frozen=True, slots=True)
class EndReview:
    """The figures of an entry or exit point.

    Attributes:
        position: metres, frame of the cloud.
        distance_mm: from the fitted tissue, perpendicular to it: positive above (the camera's side), negative below.
        error_mm: standard error of this distance: of the tissue, and of the point itself if it is ``lifted``.
        interval_mm: the true distance is within ``distance_mm`` ± this value in 95 of 100 cases.
        lifted: whether the point is one of the camera's readings and has their noise.
        scatter_mm: scatter of the complete plan about the tissue beyond the errors, at most the scatter of single
            readings at this point; None if the plan is too short.
        noise_mm: depth noise around the point: ``temporal_mm`` if known, otherwise ``spatial_mm``.
        temporal_mm: depth noise from cloud to cloud at the same pixel.
        spatial_mm: depth noise from pixel to pixel within a cloud: a lower bound.
        reading_mm: distance of the camera's own reading from the fitted tissue: positive = towards the camera.
        wider_mm: distance of the surface fitted in a window twice as wide: positive = towards the camera.
        density_mm2: points with a depth for each mm² of tissue, in one cloud.
        missing: share of the pixels without depth, in one cloud.
        spacing_mm: distance to the same end of the nearer neighbour in the plan.
        executed: closest approach of the tool; None without a tool, or in a version that was not executed.
    """

    position: Point
    distance_mm: float | None = None
    error_mm: float | None = None
    interval_mm: float | None = None
    lifted: bool = False
    scatter_mm: float | None = None
    noise_mm: float | None = None
    temporal_mm: float | None = None
    spatial_mm: float | None = None
    reading_mm: float | None = None
    wider_mm: float | None = None
    density_mm2: float | None = None
    missing: float | None = None
    spacing_mm: float | None = None
    executed: Executed | None = None


@dataclass(frozen=True, slots=True)
class StitchReview:
    """A stitch of one version of the plan.

    Attributes:
        number: position in the plan, from 1.
        label: name in the plan, or the number if it has none.
        entry, exit: the two ends.
        bite_length_mm: straight distance from entry to exit.
        bite_depth_mm: largest depth of this straight line below the fitted tissue; None without tissue.
        driven_depth_mm: largest depth of the tool below the fitted tissue between entry and exit; None if the tool
            did not reach both, or where its path between them is not known.
        level: the worst level of the reasons.
        reasons: why the level is not *ok*, the worst first.
        mark: label of the phase of the session in which the tool made the stitch; "" without one.
    """

    number: int
    label: str
    entry: EndReview
    exit: EndReview
    bite_length_mm: float
    bite_depth_mm: float | None
    driven_depth_mm: float | None
    level: Level
    reasons: tuple[str, ...]
    mark: str = ""

    @property
    def name(self) -> str:
        """The label, with that of the phase if it is another one."""
        return self.label if self.mark in ("", self.label) else f"{self.label} ({self.mark})"


@dataclass(frozen=True, slots=True)
class PlanReview:
    """A version of the plan.

    Attributes:
        topic, type: of the message with this version.
        frame_id: of the message; the stitches are in the frame of the cloud.
        stamp_ns: gateway time, UTC.
        source_ns: stamp in the message, UTC; 0 = unset.
        stitches: in the order of the plan.
    """

    topic: str
    type: str
    frame_id: str
    stamp_ns: int
    source_ns: int
    stitches: tuple[StitchReview, ...]

    @property
    def wrong(self) -> tuple[StitchReview, ...]:
        """The stitches with the level *wrong*."""
        return tuple(stitch for stitch in self.stitches if stitch.level is Level.WRONG)


@dataclass(frozen=True, slots=True)
class Change:
    """A stitch that differs between the first and the last version.

    Attributes:
        number, label: in the last version; in the first version if the stitch was removed.
        moved_mm: distances by which the entry and the exit point were moved; None if the stitch was added or removed.
        before, after: level in the first and in the last version; None if that version does not have the stitch.
    """

    number: int
    label: str
    moved_mm: tuple[float, float] | None
    before: Level | None
    after: Level | None


@dataclass(frozen=True, slots=True)
class Review:
    """The review of a session.

    Attributes:
        cloud: the combined clouds.
        plans: all versions, in order of time; at least one.
        changes: from the first to the last version.
        tool: frame of the tool whose path was compared; "" without a tool.
        thresholds: the limits that were applied.
        notes: what was left out or assumed: decimated clouds, frames that are not connected, uncertain axes.
    """

    cloud: CloudReview
    plans: tuple[PlanReview, ...]
    changes: tuple[Change, ...] = ()
    tool: str = ""
    thresholds: Thresholds = field(default_factory=Thresholds)
    notes: tuple[str, ...] = ()

    def __repr__(self) -> str:
        wrong = ", ".join(stitch.label for stitch in self.last.wrong) or "none"
        return (
            f"<Review: {counted(len(self.last.stitches), 'stitch', 'stitches')} of plan {len(self.plans)}, wrong: "
            f"{wrong}>"
        )

    @property
    def first(self) -> PlanReview:
        """The plan as first drawn."""
        return self.plans[0]

    @property
    def last(self) -> PlanReview:
        """The plan with all corrections."""
        return self.plans[-1]
