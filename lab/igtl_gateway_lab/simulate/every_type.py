"""Everything that crosses the gateway, once: every row of the conversion table, every query, every kind of peer.

The messages are in ``every_igtl`` and ``every_ros``; this module has their senders and their order.  The session is
a list of steps at equal distances of time, so that paces and deadlines are met by counting.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from igtl_gateway.base.buffers import join
from igtl_gateway.base.stamp import NS_PER_MS, NS_PER_S, ns_to_ticks
from igtl_gateway.config.configuration import Config, PeerRow, TfOutRow, ToIgtlRow, ToRosRow
from igtl_gateway.convert import igtl_msgs, rosmsg
from igtl_gateway.convert.igtl_msgs import CommandReply, MetadataItem, Query
from igtl_gateway.convert.names import short_device_name
from igtl_gateway.convert.rosmsg import Header, RosMessage
from igtl_gateway.gateway.log.entry import Kind
from igtl_gateway.wire import Item, Message, Raw, encode
from igtl_gateway.wire.body import Body
from igtl_gateway.wire.query import QUERIES, EmptyQuery, StartTracking
from igtl_gateway.wire.text import Status, String
from igtl_gateway.wire.transform import Transform
from igtl_gateway_lab.simulate import every_igtl, every_ros
from igtl_gateway_lab.simulate.every_ros import tf_frames, tool_pose, topic, tracking_step
from igtl_gateway_lab.simulate.scenario import (
    ScenarioInput,
    link_down_input,
    link_up_input,
    note_input,
    peer_input,
    ros_input,
    stamped,
    tick_input,
)

START_NS = 1_767_225_600 * NS_PER_S
_STEP_NS = 20 * NS_PER_MS

#: Links: programs on old and new libraries, those with a profile, who comes to track, who comes late, who deviates.
OLD, NEW, SLICER, PLUS, BRAINLAB, HOLOSCAN, TRACKER, LATE, DEVIATING, JAVA = range(1, 11)
_CHOSEN = {OLD: "legacy-v1", BRAINLAB: "brainlab", HOLOSCAN: "holoscan", DEVIATING: "openigtlink-rust"}


def _address(link: int) -> str:
    return f"127.0.0.1:{52000 + link}"


CONFIG = Config(
    command_timeout_s=1.0,
    to_igtl=(
        *every_ros.rows(),
        ToIgtlRow(topic="/igtl/out/Surface/early_mesh", device="Surface"),
        ToIgtlRow(topic="/told/*", device="Pose", stamp="now", metadata=(("site", "Zürich"),)),
        ToIgtlRow(topic="/millimetres/*", device="Pose", ros_unit="mm"),
    ),
    to_ros=(
        ToRosRow(device="Sliced*", kinds=("+slices",)),
        *(ToRosRow(device=f"As_{kind}", kinds=(kind,)) for _, kind, _ in every_igtl.robot_messages()),
        ToRosRow(device="Metres", igtl_unit="m", topic="/metres/{kind}", frame_id="room", child_frame_id="probe"),
    ),
    tf_out=(
        TfOutRow(frames=("Tool",), base="Base"),
        TfOutRow(frames=("Marker",), base="Tool", device="MarkerInTool", type="POSITION"),
        TfOutRow(frames=("Tool", "Marker", "Camera"), base="Base", device="Scene"),
        TfOutRow(frames=("Camera",), base="Base", device="CameraPlace"),
    ),
    peers=tuple(PeerRow(_address(link), profile) for link, profile in _CHOSEN.items()),
)


@dataclass(frozen=True, slots=True)
class _Up:
    link: int


@dataclass(frozen=True, slots=True)
class _Down:
    link: int


@dataclass(frozen=True, slots=True)
class _Sent:
    """A peer sends a message; ``data`` replaces the encoded body."""

    link: int
    type: str
    device: str
    content: Body
    metadata: tuple[Item, ...] = ()
    version: int = 1
    stamped: bool = True
    data: bytes = b""


@dataclass(frozen=True, slots=True)
class _Published:
    topic: str
    message: RosMessage


@dataclass(frozen=True, slots=True)
class _Tick:
    """A tick for the gateway after the given number of seconds without other inputs."""

    after_s: float


_Step = _Up | _Down | _Sent | _Published | _Tick


def inputs() -> Iterator[ScenarioInput]:
    """The whole session, in order of time."""
    time_ns = START_NS
    yield note_input(
        time_ns, "synthetic", "synthetic session: no robot, no patient, no camera; see simulate every-type"
    )
    for step in _steps():
        time_ns += _STEP_NS
        match step:
            case _Up(link):
                yield link_up_input(time_ns, link, _address(link))
            case _Down(link):
                yield link_down_input(time_ns, link, _address(link))
            case _Tick(after_s):
                time_ns += round(after_s * NS_PER_S)
                yield tick_input(time_ns)
            case _Published(name, message):
                yield ros_input(time_ns, name, stamped(message, time_ns - 3 * NS_PER_MS), time_ns - 2 * NS_PER_MS)
            case _Sent():
                yield _heard(step, time_ns)


def _heard(sent: _Sent, time_ns: int) -> ScenarioInput:
    if sent.data:
        return ScenarioInput(time_ns, Kind.IGTL_IN, sent.data, link=sent.link)
    ticks = ns_to_ticks(time_ns - 5 * NS_PER_MS) if sent.stamped else 0
    return peer_input(
        time_ns, sent.link, Message(sent.type, sent.device, sent.content, ticks, sent.version, 0, sent.metadata)
    )


def _steps() -> Iterator[_Step]:
    yield from _without_peers()
    yield from _greetings()
    yield from _unanswered()
    yield from _frames()
    yield from _tracked()
    yield from _contents()
    yield from _metadata()
    yield from _refused()
    yield from (_Published(topic(device), message) for device, _, message in every_ros.messages())
    yield from _settings()
    yield from _queries()
    yield from _streams()
    yield from _commands()
    yield from _raw()
    yield from _robots()
    yield from _deviating()
    yield from _ends()


def _without_peers() -> Iterator[_Step]:
    """A command without a receiver, and a plan for late joiners."""
    yield _Published("/igtl/out/Robot/command", igtl_msgs.Command(Header(), "Robot", 5, "Start", 0, ""))
    yield _Published("/igtl/out/Surface/early_mesh", rosmsg.Mesh(np.array([[0, 1, 2]], np.uint32), np.eye(3) / 64))


def _greetings() -> Iterator[_Step]:
    """Everyone comes; some show what they are."""
    yield from map(_Up, (OLD, NEW, SLICER, PLUS, BRAINLAB, HOLOSCAN))
    yield _Sent(NEW, "STATUS", "New", Status(1), (Item.of("greeting", "hello"),), 2)
    # the first message of 3D Slicer
    yield _Sent(SLICER, "STATUS", "", Status(1), (Item.of("dummy", "dummy"),), 2, stamped=False)
    valid = (Item.of("TransformValid", "true"), Item.of("TransformStatus", "OK"))
    yield _Sent(PLUS, "TRANSFORM", "StylusToRef", Transform((*every_igtl.TILTED, 1.0, 2.0, 3.0)), valid, 2)


def _unanswered() -> Iterator[_Step]:
    """Queries without data: each peer gets a reply that it can read."""
    for link, version in ((OLD, 1), (NEW, 2), (SLICER, 2), (BRAINLAB, 1)):
        yield _Sent(link, "GET_TRAJ", "", EmptyQuery(), version=version)
        yield _Sent(link, "GET_TRANS", "", EmptyQuery(), version=version)
    yield _Sent(NEW, "STT_TDATA", "", StartTracking(0, "NoSuchFrame"), version=2)
    yield _Sent(NEW, "GET_MYTYPE", "", Raw(b""), version=2)


def _frames() -> Iterator[_Step]:
    """A tree of frames from three sides: /tf_static, /tf, and a peer that sees a marker."""
    yield _Published("/tf_static", tf_frames(("Base", "Camera", (0.5, 0.0, 1.0, 0.6, 0.0, 0.0, 0.8))))
    arm, tool = ("Base", "Arm", (0.0, 0.0, 0.25, *every_igtl.TURNED)), ("Arm", "Tool", (0.0, 0.125, 0.0, *_UPRIGHT))
    yield _Published("/tf", tf_frames(arm, tool))
    yield _Sent(OLD, "TRANSFORM", "MarkerToCamera", Transform((*every_igtl.QUARTER, 10.0, 20.0, 30.0)))
    # of the two edges one is newer than the other: what goes out is between two samples
    yield _Published("/tf", tf_frames(("Base", "Arm", (0.0, 0.0, 0.5, *_UPRIGHT))))
    yield _Published("/tf", tf_frames(("Arm", "Tool", (0.25, 0.125, 0.0, *_UPRIGHT))))
    yield _Published("/tf", tf_frames(("Base", "Arm", (0.0, 0.0, 0.75, *every_igtl.TURNED))))


_UPRIGHT = (0.0, 0.0, 0.0, 1.0)


def _tracked() -> Iterator[_Step]:
    """Tracking data put together from single poses, for who asks for them, until it does no more."""
    yield _Up(TRACKER)
    yield _Published(topic("Pose"), tool_pose(0))
    yield _Published(topic("Pose/as_position"), tool_pose(0))
    yield _Sent(TRACKER, "GET_QTDATA", "", EmptyQuery())
    yield _Sent(TRACKER, "STT_QTDATA", "", StartTracking(50, ""))
    for step in range(6):
        yield _Published(topic("Pose/as_position"), tool_pose(step))
    yield _Sent(TRACKER, "STP_QTDATA", "", EmptyQuery())
    yield _Published(topic("Pose/as_position"), tool_pose(6))


def _contents() -> Iterator[_Step]:
    """Every type from a peer, in turn with header version 1 and 2."""
    for index, (igtl_type, device, content) in enumerate(every_igtl.contents()):
        link = (OLD, NEW)[index % 2]
        # one of them unstamped, as everything from 3D Slicer is
        yield _Sent(link, igtl_type, device, content, version=link, stamped=igtl_type != "QTRANS")


def _metadata() -> Iterator[_Step]:
    """Metadata with a standard message, with an igtl_msgs message, and with one without conversion."""
    device = short_device_name(every_igtl.METADATA[0].text)
    for igtl_type, content in (("TRANSFORM", Transform((*every_igtl.TILTED, 4.0, 5.0, 6.0))), ("MYTYPE", Raw(b"x"))):
        yield _Sent(NEW, igtl_type, device, content, every_igtl.METADATA, 2)
    yield _Sent(NEW, "GET_STATUS", device, EmptyQuery(), every_igtl.METADATA, 2)
    yield _Sent(SLICER, "STRING", "Node", String.of("pushed"), (Item.of("MRMLNodeName", "Node"),), 2, stamped=False)


def _refused() -> Iterator[_Step]:
    """Messages that fail on their way and cost only themselves."""
    good = join(encode(Message("STRING", "Greeting", String.of("intact"), ns_to_ticks(START_NS))))
    yield _Sent(OLD, "", "", Raw(b""), data=good[:-1] + b"?")
    for content in (b"\x00\x03\xff\xff", b"\x00"):
        yield _Sent(OLD, "STRING", "Greeting", Raw(content))
    yield _Published(topic("Surface/mesh"), rosmsg.Mesh(np.array([[0, 1, 2]], np.uint32), np.full((3, 3), np.nan)))
    yield _Published("/igtl/out/Query/query", Query(Header(), 9, "TDATA"))


def _settings() -> Iterator[_Step]:
    """What rows of the configuration change."""
    told = rosmsg.TransformStamped(Header(0, "Base"), "Told", (1.0, 2.0, 3.0), every_igtl.TURNED)
    yield _Published("/told/pose", told)
    yield _Published("/millimetres/pose", told)
    yield _Sent(OLD, "TRANSFORM", "Metres", Transform((*every_igtl.TILTED, 1.0, 2.0, 3.0)))


def _queries() -> Iterator[_Step]:
    """Every query from a peer and, to that peer, from ROS; then some by and for those that take few."""
    for name in QUERIES:
        yield _Sent(NEW, name, "", every_igtl.query(name), version=2)
    for query in every_ros.queries(TRACKER):
        yield _Published("/igtl/out/Query/query", query)
    for name in ("GET_STATUS", "GET_CAPABIL", "GET_TRANS", "GET_TDATA", "GET_POINT", "GET_IMGMETA"):
        for link, version in ((OLD, 1), (SLICER, 2), (PLUS, 2), (HOLOSCAN, 2)):
            yield _Sent(link, name, "", EmptyQuery(), version=version)
    yield _Sent(OLD, "GET_TRANS", "ToolToBase", EmptyQuery())
    yield _Published("/igtl/out/Query/query", Query(Header(0, "Base"), Query.GET, "STATUS"))


def _streams() -> Iterator[_Step]:
    """Tracking data at the pace and in the frame that a peer asked for, and none behind its STP_."""
    yield _Sent(TRACKER, "STT_TDATA", "Tools", StartTracking(50, "Base"))
    for step in range(8):
        yield _Published(topic("Tools"), tracking_step(step))
    yield _Sent(TRACKER, "STT_TDATA", "Tools", StartTracking(0, "Tool"))
    yield _Published(topic("Tools"), tracking_step(8))
    yield _Sent(TRACKER, "STP_TDATA", "Tools", EmptyQuery())
    yield _Published(topic("Tools"), tracking_step(9))
    yield _Sent(TRACKER, "STT_TDATA", "Scene", StartTracking(0, "Camera"))
    arm, tool = ("Base", "Arm", (0.0, 0.0, 1.0, *_UPRIGHT)), ("Arm", "Tool", (0.5, 0.0, 0.0, *_UPRIGHT))
    yield _Published("/tf", tf_frames(arm, tool))


def _commands() -> Iterator[_Step]:
    """Commands both ways: answered, refused, too late, and lost with their peer."""
    yield _Sent(NEW, "COMMAND", "Robot", every_igtl.command_content(7, "Start"), (Item.of("who", "surgeon"),), 2)
    yield _Sent(NEW, "COMMAND", "Robot", every_igtl.command_content(7, "Again"), version=2)
    yield _Sent(OLD, "COMMAND", "Robot", every_igtl.command_content(7, "Start"))
    yield _Published("/igtl/out/Robot/command_reply", _reply(7, CommandReply.SUCCESS, NEW, content="done"))
    yield _Published("/igtl/out/Robot/command_reply", _reply(7, CommandReply.FAIL, OLD, "arm is not homed"))
    yield _Published("/igtl/out/Robot/command_reply", _reply(7, CommandReply.SUCCESS, OLD, content="again"))
    order = igtl_msgs.Command(Header(), "Slicer", 0, "LoadScene", 106, "<Größe/>", (MetadataItem("who", 0, "robot"),))
    yield _Published("/igtl/out/Slicer/command", replace(order, link=SLICER))
    yield _Sent(
        SLICER, "RTS_COMMAND", "Slicer", every_igtl.command_content(1, "LoadScene"), (Item.of("Status", "FAIL"),), 2
    )
    yield _Published("/igtl/out/Slicer/command", replace(order, id=12, timeout=0.5))
    for link, version in ((OLD, 1), (NEW, 2), (SLICER, 2), (PLUS, 2)):
        yield _Sent(link, "RTS_COMMAND", "Slicer", every_igtl.command_content(12, "LoadScene"), version=version)
    yield _Sent(NEW, "COMMAND", "Robot", every_igtl.command_content(8, "Forgotten"), version=2)
    yield from map(_Tick, (0.1, 0.5, 0.5))
    yield _Published("/igtl/out/Slicer/command", replace(order, link=BRAINLAB, timeout=60.0))
    yield _Down(BRAINLAB)


def _reply(command_id: int, status: int, link: int, error: str = "", *, content: str = "") -> CommandReply:
    return CommandReply(Header(), "", command_id, "", status, error, content=content, link=link)


def _raw() -> Iterator[_Step]:
    """Raw messages from ROS: to all, to one, with a header that not every peer can read, and an invalid one."""
    old = join(encode(Message("MYTYPE", "FromRos", Raw(b"\x01\x02\x03"), ns_to_ticks(START_NS))))
    new = join(encode(Message("TRANSFORM", "FromRos", Transform((*every_igtl.QUARTER, 1.0, 2.0, 3.0)), 0, 2, 9)))
    for data, links in ((old, ()), (old, (NEW,)), (new, ()), (old[:-1], ())):
        yield _Published("/igtl/out/Raw/raw", _raw_message(data, links))


def _raw_message(data: bytes, links: Iterable[int]) -> igtl_msgs.RawMessage:
    return igtl_msgs.RawMessage(0, 0, 0, 1, np.array(list(links), np.uint32), "", "", data)


def _robots() -> Iterator[_Step]:
    """The messages of an arm with CRTK names, each way."""
    yield from (_Published(topic(device), message) for device, _, message in every_ros.robot_messages())
    for igtl_type, kind, content in every_igtl.robot_messages():
        yield _Sent(NEW, igtl_type, f"As_{kind}", content, version=2)


def _deviating() -> Iterator[_Step]:
    """What is read although it deviates: other layouts than those of the header version, milliseconds as fractions."""
    pose = Transform((*every_igtl.TILTED, 7.0, 8.0, 9.0))
    yield from map(_Up, (DEVIATING, JAVA))
    bare = join(encode(Message("TRANSFORM", "Bare", pose, ns_to_ticks(START_NS))))
    version_3 = join(encode(Message("TRANSFORM", "Next", pose, ns_to_ticks(START_NS), 2, 0, every_igtl.METADATA)))
    for data, version in ((bare, 2), (version_3, 3)):
        yield _Sent(DEVIATING, "", "", Raw(b""), data=version.to_bytes(2, "big") + data[2:])
    yield _Sent(JAVA, "STT_TDATA", "", StartTracking(50, is_long=True))
    java = join(encode(Message("TRANSFORM", "Java", pose, START_NS // NS_PER_S << 32 | 250)))
    yield _Sent(JAVA, "", "", Raw(b""), data=java)


def _ends() -> Iterator[_Step]:
    """A silent peer is pinged; a late joiner gets the latched messages; all peers disconnect."""
    yield _Tick(0.3)
    yield _Sent(PLUS, "STATUS", "", Status(1), version=2)
    yield _Up(LATE)
    yield from map(_Down, (OLD, NEW, SLICER, PLUS, HOLOSCAN, TRACKER, LATE, DEVIATING, JAVA))
