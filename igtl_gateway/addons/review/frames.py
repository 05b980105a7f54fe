"""Poses of frames over a complete session, and the path of one frame in another.

``convert.frames.FrameTree`` has the current poses of a running gateway.  The classes here have all samples of a
session and look up many times at once.  Poses are interpolated between samples, and constant before the first and
after the last sample.
"""

from __future__ import annotations

from array import array
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from igtl_gateway.addon import ConversionError, Pose
from igtl_gateway.convert.frames import frame_id

Array = npt.NDArray[Any]

_ROW = 7  # x, y, z, qx, qy, qz, qw
_STILL_M = 1e-3  # a frame that moves by less is stationary
_LONGEST_CHAIN = 100


@dataclass(frozen=True, slots=True)
class FramePath:
    """The path of a frame's origin in another frame.

    Attributes:
        stamps_ns: (n,) gateway times, UTC.
        positions: (n, 3) metres.
    """

    stamps_ns: Array
    positions: Array


@dataclass(slots=True)
class _FrameSamples:
    """The poses of a frame in its parent, as flat arrays: a long session has millions of them."""

    parent: str
    source: str
    stamps: array[int] = field(default_factory=lambda: array("q"))
    arrivals: array[int] = field(default_factory=lambda: array("q"))
    poses: array[float] = field(default_factory=lambda: array("d"))

    def samples(self) -> tuple[Array, Array, Array]:
        """Return stamps (ascending), gateway times and poses, whose unit quaternions have a continuous sign."""
        stamps, first = np.unique(np.array(self.stamps), return_index=True)
        poses = np.array(self.poses).reshape(-1, _ROW)[first]
        poses[:, 3:] /= np.sqrt((poses[:, 3:] ** 2).sum(axis=1))[:, None]
        turned = (poses[1:, 3:] * poses[:-1, 3:]).sum(axis=1) < 0
        poses[1:, 3:] *= np.where(np.cumsum(turned) % 2, -1.0, 1.0)[:, None]
        return stamps, np.array(self.arrivals)[first], poses


class FramePoses:
    """The poses of all frames of a session."""

    def __init__(self) -> None:
        self._edges: dict[str, _FrameSamples] = {}
        self._sorted: dict[str, tuple[Array, Array, Array]] = {}

    def add(self, parent: str, child: str, pose: Pose, stamp_ns: int, arrival_ns: int, source: str) -> None:
        """Add a sample; skip an invalid one (without a name, with a zero quaternion, not finite).

        Args:
            parent, child: frame ids.
            pose: of the child in the parent.
            stamp_ns: of the message, UTC; 0 = unset, in this case the gateway time is used.
            arrival_ns: gateway time, UTC.
            source: topic.
        """
        parent, child = frame_id(parent), frame_id(child)
        if not parent or not child or parent == child or not np.isfinite(pose).all() or not any(pose[3:]):
            return
        edge = self._edges.get(child)
        if edge is None or edge.parent != parent:
            edge = self._edges[child] = _FrameSamples(parent, source)
        edge.stamps.append(stamp_ns or arrival_ns)
        edge.arrivals.append(arrival_ns)
        edge.poses.extend(pose)
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
        """Return the origin of ``child`` in ``base`` at each of its samples.  Both must be connected."""
        stamps, arrivals, _ = self._samples(frame_id(child))
        return FramePath(arrivals, self.transformed(np.zeros((len(stamps), 3)), child, base, stamps))

    def transformed(self, points: Array, frame: str, base: str, stamps: Array) -> Array:
        """Return (n, 3) points of a frame in ``base``, each at its stamp (n,), UTC ns.

        Raises ConversionError if the frames are not connected.
        """
        frame, base = frame_id(frame), frame_id(base)
        if frame == base:
            return points
        up, down = self._path_to_root(frame), self._path_to_root(base)
        common = next((step for step in up if step in down), None)
        if common is None:
            raise ConversionError(f"found frames {frame!r} and {base!r} unconnected, expected a transform between them")
        for child in up[: up.index(common)]:
            pose = self._at(child, stamps)
            points = _rotated(pose[:, 3:], points) + pose[:, :3]
        for child in reversed(down[: down.index(common)]):
            pose = self._at(child, stamps)
            points = _rotated(pose[:, 3:] * np.array([-1.0, -1.0, -1.0, 1.0]), points - pose[:, :3])
        return points

    def _samples(self, child: str) -> tuple[Array, Array, Array]:
        if child not in self._sorted:
            self._sorted[child] = self._edges[child].samples()
        return self._sorted[child]

    def _at(self, child: str, stamps: Array) -> Array:
        """Return the (n, 7) poses of a frame in its parent at (n,) stamps."""
        known, _, poses = self._samples(child)
        after = np.clip(np.searchsorted(known, stamps), 1, max(len(known) - 1, 1))
        before = after - 1
        after = np.minimum(after, len(known) - 1)
        span = np.maximum(known[after] - known[before], 1)
        share = np.clip((stamps - known[before]) / span, 0.0, 1.0)[:, None]
        pose: Array = (1 - share) * poses[before] + share * poses[after]
        pose[:, 3:] /= np.sqrt((pose[:, 3:] ** 2).sum(axis=1))[:, None]
        return pose

    def _path_to_root(self, frame: str) -> list[str]:
        """Return the frame, its parent, and so on up to the root."""
        path = [frame]
        while (edge := self._edges.get(path[-1])) and len(path) < _LONGEST_CHAIN and edge.parent not in path:
            path.append(edge.parent)
        return path


def _rotated(q: Array, v: Array) -> Array:
    """Return (n, 3) vectors rotated by (n, 4) unit quaternions: v + 2 u × (u × v + w v), with q = (u, w)."""
    u, w = q[:, :3], q[:, 3:]
    inner = _cross(u, v) + w * v
    return v + 2.0 * _cross(u, inner)


def _cross(a: Array, b: Array) -> Array:
    return np.stack(
        [
            a[:, 1] * b[:, 2] - a[:, 2] * b[:, 1],
            a[:, 2] * b[:, 0] - a[:, 0] * b[:, 2],
            a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0],
        ],
        axis=1,
    )
