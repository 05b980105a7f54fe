"""Poses of many messages at once: what ``poses_of`` yields of each, in arrays."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from igtl_gateway.addon import ConversionError
from igtl_gateway.addon.messages import frame_id
from igtl_gateway.addon.reading import Heads, Rows, gathered
from igtl_gateway.addon.ros import CdrRows, PoseStamped, TFMessage, TransformStamped

Array = npt.NDArray[Any]

#: Kinds of messages of one stream and size in a block, and their size: more are read one by one.
_MOST_FORMS, _MOST_BYTES = 16, 1 << 16
_TYPES: Mapping[str, Any] = {each.TYPE: each for each in (TransformStamped, TFMessage, PoseStamped)}


@dataclass(frozen=True, slots=True, eq=False)
class PoseRows:
    """Poses of one frame in another; each array has one element per pose.

    Attributes:
        parent, child: frame ids.
        source: topic.
        order: int64, places in the order of all poses of the messages.
        poses: float64 (n, 7).
        stamps: of the messages, UTC ns, int64; 0 = unset.
        arrivals: gateway time, UTC ns, int64.
    """

    parent: str
    child: str
    source: str
    order: Array
    poses: Array
    stamps: Array
    arrivals: Array

    def valid(self) -> PoseRows:
        """Those that are poses: finite, with a rotation, of two frames."""
        has_names = self.parent and self.child and self.parent != self.child
        good = np.isfinite(self.poses).all(axis=1) & self.poses[:, 3:].any(axis=1) & bool(has_names)
        return self if good.all() else self.where(np.flatnonzero(good))

    def where(self, rows: Array) -> PoseRows:
        """The poses of a mask or of indices."""
        arrays = self.order[rows], self.poses[rows], self.stamps[rows], self.arrivals[rows]
        return PoseRows(self.parent, self.child, self.source, *arrays)


def pose_rows(rows: Rows, heads: Heads) -> list[PoseRows] | None:
    """Return the valid poses of messages of `POSES`; None where they are to be read one by one."""
    if rows.times.dtype != np.int64:
        return None
    pairs = np.stack((rows.heads.astype(np.int64), rows.ends - rows.begins))
    found: list[PoseRows] = []
    for pair in np.unique(pairs, axis=1).T:
        places = np.flatnonzero((pairs == pair[:, np.newaxis]).all(axis=0))
        if pair[1] > _MOST_BYTES or (rows.which[places] != rows.which[places[0]]).any():
            return None
        data = np.frombuffer(rows.buffers[rows.which[places[0]]], np.uint8)
        head = heads.known[int(pair[0])]
        try:
            messages = gathered(data, rows.begins[places], int(pair[1]))
            for part, parent, named, poses, stamps, at in _poses(_TYPES[head.type], messages):
                some = places[part]
                child = frame_id(head.channel if named is None else named)
                order, arrivals = some * _MOST_BYTES + at, rows.times[some]
                found.append(PoseRows(frame_id(parent), child, head.channel, order, poses, stamps, arrivals).valid())
        except (ConversionError, ValueError):
            return None
    return [each for each in found if len(each.order)]


def _poses(kind: Any, messages: Array) -> Iterator[tuple[Array, str, str | None, Array, Array, int]]:
    """Yield the poses of messages (n, size): which of these, parent, child, poses, stamps, and place in the message."""
    left = np.arange(len(messages))
    for _ in range(_MOST_FORMS):
        if not len(left):
            return
        sample = messages[left[0]]
        fixed = np.zeros(len(sample), np.bool_)
        kind.read(CdrRows(sample[None], kind.TYPE, fixed))
        alike = (messages[left][:, fixed] == sample[fixed]).all(axis=1)
        some, left = left[alike], left[~alike]
        read = kind.read(CdrRows(np.ascontiguousarray(messages[some]), kind.TYPE))
        for at, one in enumerate(read.transforms if kind is TFMessage else (read,)):
            pose = (*one.translation, *one.rotation) if kind is TransformStamped else one.pose
            child = None if kind is PoseStamped else one.child_frame_id
            stamps = np.broadcast_to(np.asarray(one.header.stamp_ns, np.int64), len(some))
            yield some, one.header.frame_id, child, np.stack(list(pose), axis=1), stamps, at
    raise ValueError
