"""Poses of frames over a complete session, and the path of one frame in another.

``convert.frames.FrameTree`` has the current poses of a running gateway.  The classes here have all samples of a
session and look up many times at once, by the rule of all joins (``docs/reference/which-moment.md``): on one clock,
between two samples that are at most ``GAP_NS`` apart or equal.  Elsewhere a pose is unknown.  A frame of /tf_static,
and one whose samples are all equal, is there at all times.
"""

from __future__ import annotations

from array import array
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from igtl_gateway.addon import NS_PER_S, ConversionError
from igtl_gateway.addon.messages import Pose, frame_id
from igtl_gateway.addon.streams import (
    END_NS,
    GAP_NS,
    OneClock,
    StreamTimes,
    between_poses,
    matrices_of,
    one_clock,
    pick,
)
from igtl_gateway.addon.terminal import duration_text
from igtl_gateway.addons.review.pose_rows import PoseRows

Array = npt.NDArray[Any]

_ROW = 7  # x, y, z, qx, qy, qz, qw
_STILL_M = 1e-3  # a frame that moves by less is stationary
_LONGEST_CHAIN = 100
_LATCHED = "/tf_static"


@dataclass(frozen=True, slots=True)
class FramePath:
    """The path of a frame's origin in another frame.

    Attributes:
        stamps_ns: (n,) gateway times, UTC.
        positions: (n, 3) metres.
        joined: (n - 1,) whether the path from a position to the next one is known.
        notes: sentences for the user: the clock, and where the path is not known.
    """

    stamps_ns: Array
    positions: Array
    joined: Array
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Placed:
    """Points in another frame.

    Attributes:
        points: (n, 3) metres; NaN where ``known`` is false.
        known: (n,) whether the poses on the way are known at the moment of the point.
        notes: sentences for the user: the clock, and which pose is not known.
    """

    points: Array
    known: Array
    notes: tuple[str, ...] = ()


@dataclass(slots=True)
class _FrameSamples:
    """The poses of a frame in its parent, as flat arrays: a long session has millions of them."""

    parent: str
    child: str
    source: str
    stamps: array[int] = field(default_factory=lambda: array("q"))
    arrivals: array[int] = field(default_factory=lambda: array("q"))
    poses: array[float] = field(default_factory=lambda: array("d"))

    def samples(self) -> _Sorted:
        rows = np.array(self.poses).reshape(-1, _ROW)
        own = StreamTimes(
            f"{self.child!r} in {self.parent!r} ({self.source})", np.array(self.arrivals), np.array(self.stamps)
        )
        is_still = self.source == _LATCHED or bool((rows == rows[-1]).all())
        return _Sorted(own, matrices_of(rows[:, :3], rows[:, 3:]), is_still)


@dataclass(frozen=True, slots=True)
class _Sorted:
    """The samples of a frame in order of receipt: times, poses (n, 4, 4), and whether the last one is always valid."""

    times: StreamTimes
    matrices: Array
    is_still: bool


class FramePoses:
    """The poses of all frames of a session."""

    def __init__(self) -> None:
        self._edges: dict[str, _FrameSamples] = {}
        self._sorted: dict[str, _Sorted] = {}

    def add(self, parent: str, child: str, pose: Pose, stamp_ns: int, arrival_ns: int, source: str) -> None:
        """Add a sample; skip an invalid one (without a name, with a zero quaternion, not finite).

        Args:
            parent, child: frame ids.
            pose: of the child in the parent.
            stamp_ns: of the message, UTC; 0 = unset.
            arrival_ns: gateway time, UTC.
            source: topic.
        """
        parent, child = frame_id(parent), frame_id(child)
        if not parent or not child or parent == child or not np.isfinite(pose).all() or not any(pose[3:]):
            return
        edge = self._edges.get(child)
        if edge is None or edge.parent != parent:
            edge = self._edges[child] = _FrameSamples(parent, child, source)
        edge.stamps.append(max(stamp_ns, 0))
        edge.arrivals.append(arrival_ns)
        edge.poses.extend(pose)
        self._sorted.pop(child, None)

    def add_rows(self, found: Sequence[PoseRows]) -> None:
        """Add valid samples of many messages, as `add` does each of them in their order."""
        by_child: dict[str, list[PoseRows]] = {}
        for each in sorted(found, key=lambda each: int(each.order[0])):
            by_child.setdefault(each.child, []).append(each)
        for child, groups in by_child.items():
            which = np.repeat(np.arange(len(groups)), [len(each.order) for each in groups])
            order = np.argsort(np.concatenate([each.order for each in groups]), kind="stable")
            poses, stamps, arrivals = (
                np.concatenate([getattr(each, name) for each in groups])[order]
                for name in ("poses", "stamps", "arrivals")
            )
            which = which[order]
            names = [each.parent for each in groups]
            numbers = np.array([names.index(name) for name in names])[which]
            # another parent begins the frame again
            parts = np.split(np.arange(len(which)), np.flatnonzero(np.diff(numbers)) + 1)
            for part in parts:
                first = groups[int(which[part][0])]
                edge = self._edges.get(child)
                if edge is None or edge.parent != first.parent:
                    edge = self._edges[child] = _FrameSamples(first.parent, child, first.source)
                edge.stamps.frombytes(np.maximum(stamps[part], 0).tobytes())
                edge.arrivals.frombytes(arrivals[part].tobytes())
                edge.poses.frombytes(np.ascontiguousarray(poses[part]).tobytes())
            self._sorted.pop(child, None)

    def moving(self) -> dict[str, str]:
        """Return frame → first topic of the frames that move in their parent, in order of appearance."""
        found = {}
        for child, edge in self._edges.items():
            positions = np.array(edge.poses).reshape(-1, _ROW)[:, :3]
            if np.ptp(positions, axis=0).max() > _STILL_M:
                found[child] = edge.source
        return found

    def connected(self, one: str, other: str) -> bool:
        """Return whether a chain of transforms connects the two frames."""
        return self._path_to_root(frame_id(one))[-1] == self._path_to_root(frame_id(other))[-1]

    def above(self, frame: str) -> set[str]:
        """Return the frame and all of its ancestors."""
        return set(self._path_to_root(frame_id(frame)))

    def path(self, child: str, base: str) -> FramePath:
        """Return the origin of ``child`` in ``base`` at each of its samples where it is known.  Both are connected."""
        child, base = frame_id(child), frame_id(base)
        up, down = self._way(child, base)
        own = self._samples(child)
        clock, moving = self._clock([*up, *down], own.times)
        moments, rows = _ascending(clock.times(own.times, len(moving)))
        placed = self._placed(np.zeros((len(moments), 3)), (up, down), moments, (clock, moving))
        # on a straight line to the next sample, unless one of them is unknown, or they are too far apart and differ
        still = (own.matrices[rows[1:]] == own.matrices[rows[:-1]]).all(axis=(1, 2))
        gaps = ~still & (np.diff(moments) > GAP_NS)
        joined = ~gaps & placed.known[1:] & placed.known[:-1]
        notes = list(placed.notes)
        if gaps.any():
            longest_ns = float(np.diff(moments)[gaps].max())
            notes.append(
                f"{own.times.name}: unknown in {_count(int(gaps.sum()), 'gap')} above {GAP_NS / NS_PER_S:g} s, "
                f"the longest of {duration_text(longest_ns)}: what the tool did there is not counted"
            )
        # a sample without a position divides the path
        known = np.flatnonzero(placed.known)
        return FramePath(
            own.times.times[rows[known]],
            placed.points[known],
            joined[known[:-1]] & (np.diff(known) == 1) if len(known) else joined[:0],
            tuple(notes),
        )

    def transformed(self, points: Array, frame: str, base: str, stream: StreamTimes, row: int) -> Placed:
        """Return (n, 3) points of a frame in ``base``, at the moment of a message of another stream.

        Args:
            points: metres.
            frame, base: of the points, and of the result.
            stream: of the message with the points.
            row: which of its messages.

        Raises ConversionError if the frames are not connected.
        """
        way = self._way(frame_id(frame), frame_id(base))
        clock, moving = self._clock([*way[0], *way[1]], stream)
        moments = np.repeat(clock.times(stream, len(moving))[row : row + 1], len(points))
        return self._placed(points, way, moments, (clock, moving))

    def _way(self, frame: str, base: str) -> tuple[list[str], list[str]]:
        """Return the frames up from ``frame`` to the common ancestor, and from there down to ``base``."""
        up, down = self._path_to_root(frame), self._path_to_root(base)
        common = next((step for step in up if step in down), None)
        if common is None:
            raise ConversionError(f"found frames {frame!r} and {base!r} unconnected, expected a transform between them")
        return up[: up.index(common)], down[: down.index(common)][::-1]

    def _clock(self, way: Sequence[str], stream: StreamTimes) -> tuple[OneClock, list[str]]:
        """Return the clock of the frames that move, and of a stream behind them; and these frames."""
        moving = [
            child for child in way if not self._samples(child).is_still and self._samples(child).times is not stream
        ]
        return one_clock([*(self._samples(child).times for child in moving), stream]), moving

    def _placed(
        self,
        points: Array,
        way: tuple[Sequence[str], Sequence[str]],
        moments: Array,
        joined: tuple[OneClock, Sequence[str]],
    ) -> Placed:
        """Return points (n, 3) at moments (n,) of a clock after a way up and down."""
        clock, moving = joined
        known = np.ones(len(points), np.bool_)
        notes = list(clock.notes)
        for number, child in enumerate([*way[0], *way[1]]):
            place = moving.index(child) if child in moving else len(moving)
            matrices, good = self._at(child, clock, place, moments)
            if not good.all():
                notes.append(
                    f"{self._samples(child).times.name}: unknown at {int((~good).sum()):,} of "
                    f"{_count(len(moments), 'moment')}: before its first pose, after its last one, or in a gap above "
                    f"{GAP_NS / NS_PER_S:g} s"
                )
            known &= good
            turns, shifts = matrices[:, :3, :3], matrices[:, :3, 3]
            if number < len(way[0]):
                points = np.einsum("nij,nj->ni", turns, points) + shifts
            else:
                points = np.einsum("nji,nj->ni", turns, points - shifts)
        return Placed(np.where(known[:, None], points, np.nan), known, tuple(notes))

    def _samples(self, child: str) -> _Sorted:
        if child not in self._sorted:
            self._sorted[child] = self._edges[child].samples()
        return self._sorted[child]

    def _at(self, child: str, clock: OneClock, place: int, moments: Array) -> tuple[Array, Array]:
        """Return the poses (n, 4, 4) of a frame in its parent at moments (n,), and where they are known (n,).

        ``place`` is that of its stream among those of the clock.
        """
        samples = self._samples(child)
        if samples.is_still:
            return np.broadcast_to(samples.matrices[-1], (len(moments), 4, 4)), np.ones(len(moments), np.bool_)
        times, rows = _ascending(clock.times(samples.times, place))
        matrices = samples.matrices[rows]
        # equal poses have no gap between them
        changes = np.append(0, np.cumsum((matrices[1:] != matrices[:-1]).any(axis=(1, 2))))
        picks = pick(times, moments, "interpolate", end_ns=END_NS)
        before, after, share = picks.before, picks.after, picks.share
        near = (times[after] - times[before] <= GAP_NS) | (share == 0.0) | (changes[after] == changes[before])
        return between_poses(matrices[before], matrices[after], share), picks.good & near

    def _path_to_root(self, frame: str) -> list[str]:
        """Return the frame, its parent, and so on up to the root."""
        path = [frame]
        while (edge := self._edges.get(path[-1])) and len(path) < _LONGEST_CHAIN and edge.parent not in path:
            path.append(edge.parent)
        return path


def _ascending(times: Array) -> tuple[Array, Array]:
    """Return different times, ascending, and the index of each: of equal ones the last message is valid."""
    order = np.argsort(times, kind="stable")
    found = times[order]
    last = np.append(found[1:] != found[:-1], True)
    return found[last], order[last]


def _count(number: int, what: str) -> str:
    return f"{number:,} {what}{'s' * (number != 1)}"
