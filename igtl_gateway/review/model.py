"""What a review says: values, no arithmetic.

Positions are metres in the frame of the cloud, which is the camera's optical frame (x right, y down, z forward);
whatever a surgeon reads is millimetres.  Stamps are UTC ns.  ``None`` is what could not be found out.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum
from typing import Any

import numpy.typing as npt

Array = npt.NDArray[Any]
Point = tuple[float, float, float]


class Level(Enum):
    """How a stitch is judged; ordered by ``rank``."""

    OK = "ok"
    LOOK = "look"  #: a person should look at it: near a limit, or the figures cannot be trusted here
    WRONG = "wrong"  #: beside the tissue, beyond doubt

    @property
    def rank(self) -> int:
        """0 good … 2 bad."""
        return list(Level).index(self)


@dataclass(frozen=True, slots=True)
class Thresholds:
    """From where on a figure is a reason; ``docs/review.md`` says why these.

    Attributes:
        wrong_mm: a point so far off the tissue, and by more than ``sure`` standard errors, is wrong.
        look_mm: a point so far off is looked at.
        sure: standard errors that a distance must exceed to be wrong.
        noise_mm: depth noise from which on a place is looked at.
        reading_mm: deviation of the camera's reading at a point from the tissue around it, and of that from the
            tissue in a window twice as wide.
        density_mm2: points for each mm² below which a place is looked at.
        missing: share of pixels without depth above which a place is looked at.
        spacing: a distance to the next stitch that differs by more than this share from the plan's median.
        bite: a bite length that differs by more than this share from the plan's median.
        reach_mm: the tool was at a planned point if it came so near.
        window_mm: radius of the window that the tissue is fitted in.
        place_mm: radius of the place itself: noise, density and missing share are taken here.
        core_mm: radius that the camera's own reading is taken in.
    """

    wrong_mm: float = 1.0
    look_mm: float = 0.5
    sure: float = 3.0
    noise_mm: float = 0.4
    reading_mm: float = 0.7
    density_mm2: float = 2.0
    missing: float = 0.5
    spacing: float = 0.4
    bite: float = 0.4
    reach_mm: float = 5.0
    window_mm: float = 4.0
    place_mm: float = 2.5
    core_mm: float = 1.0


@dataclass(frozen=True, slots=True)
class CloudReview:
    """The clouds as one: the median depth of each pixel, and its noise.

    Attributes:
        topic: where the clouds came from.
        frame_id: their frame.
        clouds: number of clouds that were used.
        stamps_ns: gateway times of the first and the last of them.
        source_stamps_ns: the camera's own stamps of these two; 0 = unset.
        height, width: pixels; height 1 for a cloud that is not organised.
        positions: (points, 3) float32, metres: those pixels that have a depth.
        noise_mm: (points,) float32, depth noise as standard deviation; NaN where unknown.
        step_mm: step of the depth at the median depth; 0 where it is continuous.
        step_grows: exponent with which the step grows with depth: 0 for a grid of depths, 2 of disparities.
        temporal: whether the noise was seen between clouds (all of it), or only within one (a lower bound).
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
    """How near the tool's origin came to a planned point.

    Attributes:
        distance_mm: closest approach.
        stamp_ns: gateway time of it.
        position: of the tool then, metres, frame of the cloud.
        reached: whether the tool was meant for this point: near enough, and no other planned point was nearer.
    """

    distance_mm: float
    stamp_ns: int
    position: Point
    reached: bool


@dataclass(frozen=True, slots=True)
class EndReview:
    """An entry or exit point.

    Attributes:
        position: metres, frame of the cloud.
        distance_mm: from the fitted tissue, at a right angle to it: + above (the camera's side), − under it.
        error_mm: standard error of this distance: of the tissue, and of the reading where the point is one of the
            camera's readings (``lifted``).
        interval_mm: the true distance is within so much of ``distance_mm`` in 95 of 100 cases.
        lifted: whether the point is one of the camera's readings, with all of its noise.
        scatter_mm: how much the whole plan scatters about the tissue beyond that, at most as readings do here;
            None where the plan is too short to tell.
        noise_mm: depth noise here: ``temporal_mm`` where known, else ``spatial_mm``.
        temporal_mm: depth noise from cloud to cloud at the same pixel.
        spatial_mm: depth noise from pixel to pixel within a cloud: a lower bound.
        reading_mm: how far the camera's own reading here is from the tissue around: + towards the camera.
        wider_mm: how far the tissue as fitted in a window twice as wide is from this one, here: + towards the camera.
        density_mm2: points with a depth for each mm² of tissue, of one cloud.
        missing: share of the pixels without depth, of one cloud.
        spacing_mm: to the nearer of the neighbours' same ends.
        executed: of the tool; None where there is no tool in the file.
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
        number: from 1, its place in the plan.
        label: its name in the plan, else its number.
        entry, exit: its ends.
        bite_length_mm: straight from entry to exit.
        bite_depth_mm: how deep that straight line runs below the fitted tissue, at most.
        driven_depth_mm: how deep the tool ran below the fitted tissue between entry and exit, at most.
        level: the worst of the reasons.
        reasons: why it is not ok, the gravest first.
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


@dataclass(frozen=True, slots=True)
class PlanReview:
    """A version of the plan.

    Attributes:
        topic, type: of the message that brought it.
        frame_id: the message's frame; the stitches here are in the cloud's.
        stamp_ns: gateway time.
        source_ns: stamp in the message; 0 = unset.
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
        """The stitches that are wrong."""
        return tuple(stitch for stitch in self.stitches if stitch.level is Level.WRONG)


@dataclass(frozen=True, slots=True)
class Change:
    """A stitch that differs between the first and the last version.

    Attributes:
        number, label: of the last version; of the first one where the stitch was taken out.
        moved_mm: how far the entry and the exit point were moved; None where the stitch was added or taken out.
        before, after: its level in the first and in the last version; None where it is not there.
    """

    number: int
    label: str
    moved_mm: tuple[float, float] | None
    before: Level | None
    after: Level | None


@dataclass(frozen=True, slots=True)
class Review:
    """All that is said of a session.

    Attributes:
        cloud: the clouds.
        plans: every version, in order of time; at least one.
        changes: from the first to the last version.
        tool: frame of the tool whose path was compared; "" where there is none.
        thresholds: what was judged by.
        notes: what a reader should know of how this was made: streams left out, frames that nothing connects.
    """

    cloud: CloudReview
    plans: tuple[PlanReview, ...]
    changes: tuple[Change, ...] = ()
    tool: str = ""
    thresholds: Thresholds = field(default_factory=Thresholds)
    notes: tuple[str, ...] = ()

    @property
    def first(self) -> PlanReview:
        """The plan as it was drawn."""
        return self.plans[0]

    @property
    def last(self) -> PlanReview:
        """The plan as it was left."""
        return self.plans[-1]
