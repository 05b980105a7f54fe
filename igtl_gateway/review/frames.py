"""Poses of frames over the whole session, and a frame's path as seen from another one.

Unlike ``convert.frames.FrameTree``, which answers for the present of a running gateway, this knows all samples and
answers for many times at once.  Between samples poses are interpolated, before the first and after the last held.
"""

from __future__ import annotations

from array import array
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from igtl_gateway.convert.frames import frame_id
from igtl_gateway.convert.igtl_msgs import Pose
from igtl_gateway.errors import ConversionError

Array = npt.NDArray[Any]

_ROW = 7  # x, y, z, qx, qy, qz, qw
_STILL_M = 1e-3  # a frame that moves by less is held still
_LONGEST_CHAIN = 100


@dataclass(frozen=True, slots=True)
class FramePath:
    """The origin of a frame as seen from another one.

    Attributes:
        stamps_ns: (n,) gateway times.
        positions: (n, 3) metres.
    """

    stamps_ns: Array
    positions: Array


@dataclass(slots=True)
class _FrameSamples:
    """A frame in its parent: numbers in rows, as a long session has millions."""

    parent: str
    source: str
    stamps: array[int] = field(default_factory=lambda: array("q"))
    arrivals: array[int] = field(default_factory=lambda: array("q"))
    poses: array[float] = field(default_factory=lambda: array("d"))

    def samples(self) -> tuple[Array, Array, Array]:
        """Stamps (ascending), gateway times and poses with unit quaternions of continuous sign."""
        stamps, first = np.unique(np.array(self.stamps), return_index=True)
        poses = np.array(self.poses).reshape(-1, _ROW)[first]
        poses[:, 3:] /= np.sqrt((poses[:, 3:] ** 2).sum(axis=1))[:, None]
        turned = (poses[1:, 3:] * poses[:-1, 3:]).sum(axis=1) < 0
        poses[1:, 3:] *= np.where(np.cumsum(turned) % 2, -1.0, 1.0)[:, None]
        return stamps, np.array(self.arrivals)[first], poses


class FramePoses:
    """Every frame that a session tells of."""

    def __init__(self) -> None:
        self._edges: dict[str, _FrameSamples] = {}
        self._made: dict[str, tuple[Array, Array, Array]] = {}

    def add(self, parent: str, child: str, pose: Pose, stamp_ns: int, arrival_ns: int, source: str) -> None:
        """A sample; what is none (no name, no rotation, not finite) is passed over.

        Args:
            parent, child: frame ids.
            pose: of the child in the parent.
            stamp_ns: of the message; 0 = unset, then the gateway time stands for it.
            arrival_ns: gateway time.
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
        self._made.pop(child, None)

    def moving(self) -> dict[str, str]:
        """Frame → topic that told of it first, of the frames that move in their parent, in order of appearance."""
        found = {}
        for child, edge in self._edges.items():
            positions = np.array(edge.poses).reshape(-1, _ROW)[:, :3]
            if np.ptp(positions, axis=0).max() > _STILL_M:
                found[child] = edge.source
        return found

    def connected(self, one: str, other: str) -> bool:
        """Whether the pose of one frame in the other can be told."""
        return self._path_to_root(frame_id(one))[-1] == self._path_to_root(frame_id(other))[-1]

    def above(self, frame: str) -> set[str]:
        """The frame and those that it hangs on."""
        return set(self._path_to_root(frame_id(frame)))

    def path(self, child: str, base: str) -> FramePath:
        """The origin of ``child`` in ``base`` at each of its samples.  Both must be connected."""
        stamps, arrivals, _ = self._samples(frame_id(child))
        return FramePath(arrivals, self.moved(np.zeros((len(stamps), 3)), child, base, stamps))

    def moved(self, points: Array, frame: str, base: str, stamps: Array) -> Array:
        """(n, 3) points of a frame as seen from ``base``, each at its stamp.

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
        if child not in self._made:
            self._made[child] = self._edges[child].samples()
        return self._made[child]

    def _at(self, child: str, stamps: Array) -> Array:
        """(n, 7) poses of a frame in its parent."""
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
        way = [frame]
        while (edge := self._edges.get(way[-1])) and len(way) < _LONGEST_CHAIN and edge.parent not in way:
            way.append(edge.parent)
        return way


def _rotated(q: Array, v: Array) -> Array:
    """(n, 3) vectors turned by (n, 4) unit quaternions: v + 2 u × (u × v + w v), with q = (u, w)."""
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
