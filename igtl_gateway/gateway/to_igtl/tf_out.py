"""Frames of the tf tree for OpenIGTLink: the messages that an update of the tree causes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from igtl_gateway.base.errors import ConversionError
from igtl_gateway.base.qos import Qos
from igtl_gateway.base.stamp import NS_PER_S
from igtl_gateway.config.configuration import Config, TfOutRow
from igtl_gateway.convert.common_msgs import TFMessage
from igtl_gateway.convert.context import ToIgtlContext
from igtl_gateway.convert.frames import FrameTree, TfRequest
from igtl_gateway.convert.igtl_msgs import TrackedTool
from igtl_gateway.convert.igtl_msgs import TrackingData as RosTrackingData
from igtl_gateway.convert.rosmsg import Header, TransformStamped
from igtl_gateway.convert.structs import Pose
from igtl_gateway.convert.table import row_to_igtl
from igtl_gateway.convert.units import LengthUnits
from igtl_gateway.gateway.to_igtl.sender import OutboundMessage
from igtl_gateway.wire.tracking import TOOL_6D

#: topic → whether its transforms are static.
TF_TOPICS = {"/tf": False, "/tf_static": True}
#: /tf is a stream of changes: after a lost sample a chain of transforms is outdated.
TF_QOS = {"/tf": Qos(depth=1000), "/tf_static": Qos(depth=100, latched=True)}


#: Poses whose stamps differ by less are of one moment: 0.5 mm at 100 mm/s.
MOMENT_NS = 5_000_000

#: (row, frame, stamp of its pose) → whether the pose is too old to be sent.
IsStale = Callable[[TfOutRow, str, int], bool]


@dataclass(slots=True)
class _FramesSent:
    """A row of the configuration, its last messages, and the oldest stamp in them (0: static).

    ``arrived``: frame without a stamp → gateway time (0: on /tf_static) and pose of its last change.
    """

    row: TfOutRow
    request: TfRequest
    device: str
    versions: tuple[int, ...] = ()
    last: OutboundMessage | None = None
    oldest_ns: int = 0
    sent: dict[str, tuple[int, Pose]] = field(default_factory=dict)
    arrived: dict[str, tuple[int, Pose]] = field(default_factory=dict)


class TfOut:
    """The tf tree, and the frames of it that are sent to peers.

    Args:
        config: configuration with the rows ``tf_out``.
        devices: device name of at most 20 bytes for each row.

    Attributes:
        max_age_of: row → maximum age of its poses, s; 0: no limit.
    """

    def __init__(self, config: Config, devices: tuple[str, ...]) -> None:
        self.tree = FrameTree()
        self.max_age_of: Callable[[TfOutRow], float] = config.max_age_of
        self._config = config
        self._requests = [
            _FramesSent(row, row.request(), device) for row, device in zip(config.tf_out, devices, strict=True)
        ]

    def __bool__(self) -> bool:
        return bool(self._requests)

    def update(
        self, message: TFMessage, static: bool, now_ns: int, is_stale: IsStale
    ) -> tuple[list[tuple[OutboundMessage, LengthUnits]], list[str]]:
        """Apply a message of /tf or /tf_static; return the changed messages with their units, and the problems.

        Frames that are too old are left out.  A message has one stamp, so frames of several moments are several
        messages, each with the poses of its moment.
        """
        self.tree.update(message, static)
        changed: list[tuple[OutboundMessage, LengthUnits]] = []
        refused: list[str] = []
        for one in self._requests:
            try:
                outs = self._changed(one, static, now_ns, is_stale)
            except ConversionError as error:
                refused.append(str(error))
                continue
            changed += [(out, self._config.lengths(one.row)) for out in outs]
        return changed, refused

    def _changed(self, one: _FramesSent, static: bool, now_ns: int, is_stale: IsStale) -> list[OutboundMessage]:
        request = one.request
        versions = tuple(self.tree.version(frame, request.base) for frame in request.frames)
        if versions == one.versions:
            return []
        one.versions = versions
        found = [(frame, self.tree.latest(frame, request.base)) for frame in request.frames]
        known = [(frame, place) for frame, place in found if place is not None]
        if len(request.frames) > 1 and self._config.naming:
            known = [(frame, _timed(one, frame, place, 0 if static else now_ns)) for frame, place in known]
        if self.max_age_of(one.row):
            known = [(frame, place) for frame, place in known if not (place[0] and is_stale(one.row, frame, place[0]))]
        places = dict(known)
        if not places or places == one.sent:
            return []
        changed = [stamp_ns for frame, (stamp_ns, _) in known if one.sent.get(frame) != places[frame]]
        one.sent = places
        # recordings without rules of names are older than this one, too
        moments = moments_of(changed) if self._config.naming else [max(ns for ns, _ in places.values())]
        outs = []
        for stamp_ns in moments:
            least_ns = stamp_ns - MOMENT_NS if self._config.naming else 0
            poses = {frame: pose for frame, (ns, pose) in known if not ns or (least_ns < ns <= stamp_ns and stamp_ns)}
            if not poses:
                continue
            outs.append(self._outbound(one, poses, stamp_ns, now_ns))
            if one.last is None or stamp_ns >= one.last.ros_stamp_ns or not self._config.naming:
                one.oldest_ns = min((places[frame][0] for frame in poses if places[frame][0]), default=0)
                one.last = outs[-1]
        return outs

    def _outbound(self, one: _FramesSent, poses: dict[str, Pose], stamp_ns: int, now_ns: int) -> OutboundMessage:
        request = one.request
        header = Header(stamp_ns, request.base)
        message: RosTrackingData | TransformStamped
        if request.type in ("TDATA", "QTDATA"):
            message = RosTrackingData(header, tuple(TrackedTool(frame, TOOL_6D, pose) for frame, pose in poses.items()))
        else:
            ((frame, pose),) = poses.items()
            message = TransformStamped(header, frame, pose[:3], pose[3:])
        conversion = row_to_igtl(message.TYPE, request.type)
        assert conversion is not None
        outgoing = conversion.convert(message, ToIgtlContext(self._config.lengths(one.row)))
        return OutboundMessage(
            request.type,
            one.device,
            outgoing.content,
            self._config.pick_stamp(one.row, stamp_ns, now_ns),
            request.device,
            stamp_ns,
            request.base,
            "" if len(request.frames) > 1 else request.frames[0],
            is_static=not stamp_ns,
        )

    def latest(self, now_ns: int | None = None) -> list[OutboundMessage]:
        """Return the last messages for queries and late joiners, without those that are too old at ``now_ns``."""
        return [
            one.last
            for one in self._requests
            if one.last is not None
            and (
                now_ns is None
                or not (self.max_age_of(one.row) and one.oldest_ns)
                or now_ns - one.oldest_ns <= round(self.max_age_of(one.row) * NS_PER_S)
            )
        ]

    def static(self) -> list[OutboundMessage]:
        """Return the last messages of static frames, which are sent only once."""
        return [one.last for one in self._requests if one.last and not one.last.ros_stamp_ns]


def _timed(one: _FramesSent, frame: str, place: tuple[int, Pose], now_ns: int) -> tuple[int, Pose]:
    """A frame without a stamp that moves is of the moment of its receipt; ``now_ns``: 0 of a static update."""
    stamp_ns, pose = place
    if stamp_ns:
        return place
    arrived = one.arrived.get(frame)
    if arrived is None or arrived[1] != pose:
        one.arrived[frame] = arrived = now_ns, pose
    return arrived


def moments_of(stamps: Sequence[int]) -> list[int]:
    """The moments of stamps in their order: each is the last of those that are near; 0, of static frames, if alone."""
    found: list[int] = []
    first_ns = 0
    for stamp_ns in sorted(stamp_ns for stamp_ns in stamps if stamp_ns):
        if found and stamp_ns - first_ns < MOMENT_NS:
            found[-1] = stamp_ns
        else:
            found.append(stamp_ns)
            first_ns = stamp_ns
    return found or [0][: len(stamps)]
