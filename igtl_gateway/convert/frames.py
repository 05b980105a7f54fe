"""The tree of ROS frames, built from /tf and /tf_static, and the requests of ``--tf-out``.

``FrameTree`` does the look-up of tf2 at time 0: the pose of a frame in another one, at the latest time for which all
dynamic edges between them have samples.  It reads no clock, only the stamps of the messages.  Its arithmetic is plain
+, −, ×, ÷ and √ on Python floats, so equal inputs give equal bits on every machine.  Rotations are interpolated
linearly and normalised: between samples 0.1 rad apart, the result differs from the great circle by less than 10⁻⁵ rad,
and needs no trigonometry.

Differences from tf2, each in a case in which tf2 has no result:

* Quaternions of any length above 0 are accepted and normalised; tf2 rejects a length that differs by 1 %.
* A second sample with the same stamp replaces the first one; tf2 ignores it.
* A sample without stamp (0) is valid at all times, like a static one; tf2 finds it at time 0 only.
* Stamps that jump back by more than the history (a bag is played again) clear the edge; tf2 ignores them.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections import Counter
from dataclasses import dataclass, field

import numpy as np

from igtl_gateway.base.errors import ConfigError, ConversionError
from igtl_gateway.base.quantities import counted
from igtl_gateway.convert.common_msgs import FrameTransform, TFMessage
from igtl_gateway.convert.poses import Quaternion, rotation_matrix, unit_quaternion
from igtl_gateway.convert.structs import Pose
from igtl_gateway.convert.units import LengthUnits
from igtl_gateway.wire.body import Body
from igtl_gateway.wire.tracking import QuaternionTrackingData, TrackingData

#: History of an edge before its newest sample, ns: as in tf2.
HISTORY_NS = 10_000_000_000
#: Maximum number of samples of one edge: 10 s at 200 Hz, 2 s at 1 kHz.
MAX_SAMPLES = 2_000
#: Maximum number of samples of all edges (150 MB); above it an edge keeps only its last two.
MAX_ALL_SAMPLES = 500_000
MAX_FRAMES = 10_000

#: Reasons for which a transform is rejected: keys of ``FrameTree.refused``.
NO_NAME, NO_POSE, CYCLE, TOO_MANY_FRAMES = "no_frame_name", "not_a_pose", "cycle", "too_many_frames"
TOO_DEEP = "too_deep"
#: Frames from a frame up to the root, at most, where another one is added: each would cost a walk along all of them.
MAX_DEPTH = 256

#: Child frames of the edges from the target, and from the base, up to their first common ancestor.
Chain = tuple[tuple[str, ...], tuple[str, ...]]
Vector = tuple[float, float, float]

_IDENTITY: Pose = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)


@dataclass(slots=True)
class _TfEdge:
    """The samples of a frame in its parent.

    Attributes:
        parent: frame id.
        static: whether there is one sample, which is valid at all times.
        stamps: UTC ns, ascending.
        poses: of the child in the parent, with unit quaternions; one for each stamp.
        version: number of the update that last changed this edge.
    """

    parent: str
    static: bool
    stamps: list[int] = field(default_factory=list)
    poses: list[Pose] = field(default_factory=list)
    version: int = 0


class FrameTree:
    """A tree of frames with the recent samples of each edge.

    Args:
        max_frames: maximum number of frames with a parent; the transforms of other frames are rejected.
        max_samples: maximum number of samples that one edge stores.

    Attributes:
        refused: number of rejected transforms by reason.
    """

    def __init__(self, max_frames: int = MAX_FRAMES, max_samples: int = MAX_SAMPLES) -> None:
        self.refused: Counter[str] = Counter()
        self._max_frames = max_frames
        self._max_samples = max_samples
        self._edges: dict[str, _TfEdge] = {}  # child → its edge
        self._chains: dict[tuple[str, str], Chain | None] = {}  # cache, cleared when the tree changes its shape
        self._samples = 0
        self._version = 0

    def names(self) -> set[str]:
        """Return the frames of the tree, those without a parent, too."""
        edges = dict(self._edges)  # another thread may add to it
        return {*edges, *(edge.parent for edge in edges.values())}

    def update(self, message: TFMessage, static: bool) -> None:
        """Add the transforms of a message of /tf or, if ``static``, of /tf_static.  Invalid ones are counted."""
        for transform in message.transforms:
            reason = self._add_sample(transform, static or transform.header.stamp_ns == 0)
            if reason:
                self.refused[reason] += 1

    def _add_sample(self, transform: FrameTransform, static: bool) -> str:
        """Add one sample; return "", or the reason for a rejection."""
        parent, child = frame_id(transform.header.frame_id), frame_id(transform.child_frame_id)
        if not parent or not child:
            return NO_NAME
        pose = _unit_pose(transform.pose)
        if pose is None:
            return NO_POSE
        edge = self._edges.get(child)
        if edge is None or edge.parent != parent:
            if edge is None and len(self._edges) >= self._max_frames:
                return TOO_MANY_FRAMES
            if obstacle := self._obstacle(parent, child):
                return obstacle
            self._chains.clear()
        if edge is None or edge.parent != parent or edge.static != static:
            self._samples -= len(edge.stamps) if edge else 0
            edge = self._edges[child] = _TfEdge(parent, static)
        self._version += 1
        edge.version = self._version
        self._insert(edge, transform.header.stamp_ns, pose)
        return ""

    def _insert(self, edge: _TfEdge, stamp_ns: int, pose: Pose) -> None:
        stamps, poses = edge.stamps, edge.poses
        if stamps and (edge.static or stamp_ns < stamps[-1] - HISTORY_NS):
            self._samples -= len(stamps)
            stamps.clear()
            poses.clear()
        at = len(stamps) if not stamps or stamp_ns > stamps[-1] else bisect_left(stamps, stamp_ns)
        if at < len(stamps) and stamps[at] == stamp_ns:
            poses[at] = pose
            return
        stamps.insert(at, stamp_ns)
        poses.insert(at, pose)
        self._samples += 1
        limit = self._max_samples if self._samples <= MAX_ALL_SAMPLES else 2
        surplus = max(len(stamps) - limit, bisect_left(stamps, stamps[-1] - HISTORY_NS), 0)
        if surplus:
            del stamps[:surplus], poses[:surplus]
            self._samples -= surplus

    def _obstacle(self, parent: str, child: str) -> str:
        """Return why ``child`` cannot be below ``parent``; "" if it can."""
        frame = parent
        for _ in range(MAX_DEPTH):
            if frame == child:
                return CYCLE
            edge = self._edges.get(frame)
            if edge is None:
                return ""
            frame = edge.parent
        return TOO_DEEP

    def knows(self, frame: str) -> bool:
        """Return whether a frame has a parent or a child."""
        return frame in self._edges or any(edge.parent == frame for edge in self._edges.values())

    def root_of(self, frame: str) -> str:
        """Return the frame without a parent above a frame, or itself; as ``names`` for any thread."""
        for _ in range(MAX_DEPTH + 1):
            edge = self._edges.get(frame)
            if edge is None:
                break
            frame = edge.parent
        return frame

    def chain(self, target: str, base: str) -> Chain | None:
        """Return the edges between two frames, by child frame; None if the frames are not connected."""
        key = (target, base)
        if key not in self._chains:
            self._chains[key] = self._find_chain(target, base)
        return self._chains[key]

    def _find_chain(self, target: str, base: str) -> Chain | None:
        up, down = self._path_to_root(target), self._path_to_root(base)
        steps_down = {frame: step for step, frame in enumerate(down)}
        for step, frame in enumerate(up):
            if frame in steps_down:
                return tuple(up[:step]), tuple(down[: steps_down[frame]])
        return None

    def _path_to_root(self, frame: str) -> list[str]:
        """Return the frame and all its ancestors up to the root."""
        way = [frame]
        while edge := self._edges.get(way[-1]):
            way.append(edge.parent)
        return way

    def version(self, target: str, base: str) -> int:
        """Return a number that changes whenever the result of ``latest`` might; 0 if the frames are not connected."""
        chain = self.chain(target, base)
        return max((self._edges[child].version for part in chain for child in part), default=0) if chain else 0

    def latest(self, target: str, base: str) -> tuple[int, Pose] | None:
        """Return stamp and pose of ``target`` in ``base``, at the latest time for which all dynamic edges have samples.

        The stamp is UTC ns, 0 if all edges are static; lengths are in metres.  None if the frames are not connected, or
        if the newest sample of one edge is older than all samples of another one.
        """
        chain = self.chain(target, base)
        if chain is None:
            return None
        edges = [self._edges[child] for part in chain for child in part]
        stamp_ns = min((edge.stamps[-1] for edge in edges if not edge.static), default=0)
        if any(stamp_ns < edge.stamps[0] for edge in edges if not edge.static):
            return None
        target_pose, base_pose = (self._climb(part, stamp_ns) for part in chain)
        return stamp_ns, compose(_inverse(base_pose), target_pose) if chain[1] else target_pose

    def at(self, target: str, base: str, stamp_ns: int, gap_ns: int) -> Pose | None:
        """Return the pose of ``target`` in ``base`` at a time; lengths are in metres.

        Each edge is interpolated between the two samples around the time, or held after its last one; an edge whose
        samples are all equal is valid at all times.  None if the frames are not connected, the time is before the first
        sample of an edge, or one of the samples is further away than ``gap_ns``.
        """
        chain = self.chain(target, base)
        if chain is None or not all(
            _is_known(self._edges[child], stamp_ns, gap_ns) for part in chain for child in part
        ):
            return None
        target_pose, base_pose = (self._climb(part, stamp_ns) for part in chain)
        return compose(_inverse(base_pose), target_pose) if chain[1] else target_pose

    def _climb(self, children: tuple[str, ...], stamp_ns: int) -> Pose:
        """Return the pose of the first child in the parent of the last one."""
        pose = _IDENTITY
        for step, child in enumerate(children):
            edge = self._edges[child]
            above = _pose_at(edge, stamp_ns)
            pose = compose(above, pose) if step else above
        return pose


def frame_id(name: str) -> str:
    """Return a frame id in the form that is compared: without the leading slash of tf, which has no meaning."""
    return name.lstrip("/")


def _unit_pose(pose: Pose) -> Pose | None:
    """Return the pose with its quaternion normalised; None for NaN, infinity or a quaternion without length."""
    if not all(map(math.isfinite, pose)):
        return None
    try:
        return (*pose[:3], *unit_quaternion(pose[3:]))
    except ConversionError:
        return None


def _is_known(edge: _TfEdge, stamp_ns: int, gap_ns: int) -> bool:
    """Return whether an edge is known at a time: see ``FrameTree.at``."""
    stamps = edge.stamps
    after = bisect_left(stamps, stamp_ns)
    if edge.static or (after < len(stamps) and stamps[after] == stamp_ns):
        return True
    if 0 < after < len(stamps):
        return stamps[after] - stamps[after - 1] <= gap_ns or edge.poses[after] == edge.poses[after - 1]
    # a frame that is sent only once, or always the same, does not move
    return (after > 0 and stamp_ns - stamps[-1] <= gap_ns) or all(pose == edge.poses[0] for pose in edge.poses)


def _pose_at(edge: _TfEdge, stamp_ns: int) -> Pose:
    """Return the pose at a time; before the first sample it is that one, after the last one that one."""
    after = bisect_left(edge.stamps, stamp_ns)
    if edge.static or after == 0 or after == len(edge.stamps):
        return edge.poses[-1 if after else 0]
    if edge.stamps[after] == stamp_ns:
        return edge.poses[after]
    start_ns, end_ns = edge.stamps[after - 1], edge.stamps[after]
    return _interpolate(edge.poses[after - 1], edge.poses[after], (stamp_ns - start_ns) / (end_ns - start_ns))


def _interpolate(a: Pose, b: Pose, share: float) -> Pose:
    """Return the pose at ``share`` (0 … 1) of the way from a to b."""
    # of b's two quaternions, use the one nearer to a: the shorter rotation, and the length is never 0
    side = 1.0 if a[3] * b[3] + a[4] * b[4] + a[5] * b[5] + a[6] * b[6] >= 0.0 else -1.0
    rest = 1.0 - share
    x, y, z = (rest * p + share * q for p, q in zip(a[:3], b[:3], strict=True))
    qx, qy, qz, qw = (rest * p + share * side * q for p, q in zip(a[3:], b[3:], strict=True))
    return (x, y, z, *unit_quaternion((qx, qy, qz, qw)))


def compose(a: Pose, b: Pose) -> Pose:
    """Return the product of two poses: the pose in a's parent of a frame that has the pose b in a."""
    ax, ay, az, aw = a[3:]
    bx, by, bz, bw = b[3:]
    x, y, z = _rotated(a[3:], b[:3])
    rotation = unit_quaternion(
        (
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
            aw * bw - ax * bx - ay * by - az * bz,
        )
    )
    return (a[0] + x, a[1] + y, a[2] + z, *rotation)


def _inverse(pose: Pose) -> Pose:
    qx, qy, qz, qw = pose[3:]
    inverse_rotation = (-qx, -qy, -qz, qw)
    x, y, z = _rotated(inverse_rotation, pose[:3])
    return (-x, -y, -z, *inverse_rotation)


def _rotated(q: Quaternion, v: Vector) -> Vector:
    """Return v + 2 u × (u × v + w v), with q = (u, w): v rotated by q."""
    (x, y, z, w), (a, b, c) = q, v
    d = y * c - z * b + w * a
    e = z * a - x * c + w * b
    f = x * b - y * a + w * c
    return a + 2.0 * (y * f - z * e), b + 2.0 * (z * d - x * f), c + 2.0 * (x * e - y * d)


# -- requests for poses ------------------------------------------------------------------------------------

#: Types in which frames can be sent, and whether one message can hold several frames.
_TYPES = {"TRANSFORM": False, "POSITION": False, "TDATA": True, "QTDATA": True}
_FORM = "FRAME[,FRAME...]:BASE[=DEVICE[:TYPE]], such as tool0:base_link or probe,needle:tracker=Tracker:TDATA"


@dataclass(frozen=True, slots=True)
class TfRequest:
    """ROS frames that are sent to OpenIGTLink: one ``--tf-out``.

    Attributes:
        frames: frame ids, without leading slash; more than one only for TDATA and QTDATA.
        base: frame id of the reference frame of their poses.
        device: device name of the messages, of any length.
        type: TRANSFORM, POSITION, TDATA or QTDATA.

    Raises ConfigError for anything else.
    """

    frames: tuple[str, ...]
    base: str
    device: str
    type: str

    def __post_init__(self) -> None:
        if self.type not in _TYPES:
            raise _refusal(f"type {self.type!r}", f"one of {', '.join(_TYPES)}")
        if not all((self.frames, *self.frames, self.base, self.device)):
            raise _refusal(repr(self.text()), _FORM)
        if len(self.frames) > 1 and not _TYPES[self.type]:
            raise _refusal(f"{counted(len(self.frames), 'frame')} as {self.type}", "TDATA or QTDATA for several frames")
        if len({*self.frames, self.base}) <= len(self.frames):
            raise _refusal(repr(self.text()), "different frames, none of them the base")

    @classmethod
    def parse(cls, text: str) -> TfRequest:
        """Return the request of an option value ``FRAME[,FRAME...]:BASE[=DEVICE[:TYPE]]``.

        The device defaults to ``FRAMEToBASE`` (``ToolsToBASE`` for several frames), the type to TRANSFORM (TDATA
        for several).
        """
        where, named, what = text.partition("=")
        listed, colon, base = where.partition(":")
        if not colon or ":" in base:
            raise _refusal(repr(text), _FORM)
        frames = tuple(frame_id(name.strip()) for name in listed.split(","))
        base = frame_id(base.strip())
        several = len(frames) > 1
        device, typed, type_name = (part.strip() for part in what.partition(":"))
        if (named and not device) or (typed and not type_name):
            raise _refusal(repr(text), _FORM)
        return cls(
            frames,
            base,
            device or f"{'Tools' if several else frames[0]}To{base}",
            type_name or ("TDATA" if several else "TRANSFORM"),
        )

    def text(self) -> str:
        """Return the option value that ``parse`` reads."""
        return f"{','.join(self.frames)}:{self.base}={self.device}:{self.type}"


def _refusal(found: str, expected: str) -> ConfigError:
    return ConfigError(f"--tf-out: found {found}, expected {expected}")


def in_frame(content: Body, pose: Pose, lengths: LengthUnits) -> Body:
    """Transform tracking data to another frame, in which its own frame has ``pose`` (metres)."""
    if isinstance(content, TrackingData):
        elements = content.elements.copy()
        columns = elements["matrix"].astype(np.float64).reshape(-1, 4, 3)
        turned = np.empty_like(columns)
        for row, (a, b, c) in enumerate(rotation_matrix(pose[3:])):  # plain sums give the same bits on every machine
            turned[:, :, row] = a * columns[:, :, 0] + b * columns[:, :, 1] + c * columns[:, :, 2]
            turned[:, 3, row] += lengths.to_igtl(pose[row])
        elements["matrix"] = turned.reshape(-1, 12)
        return TrackingData(elements)
    assert isinstance(content, QuaternionTrackingData)
    elements = content.elements.copy()
    x, y, z = (lengths.to_igtl(value) for value in pose[:3])
    for element in elements:
        moved = compose((x, y, z, *pose[3:]), (*element["position"].tolist(), *element["quaternion"].tolist()))
        element["position"], element["quaternion"] = moved[:3], moved[3:]
    return QuaternionTrackingData(elements)
