"""What the gateway sends to a peer that it does not know yet, and the signs by which it recognises PLUS."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from igtl_gateway.base.buffers import join
from igtl_gateway.base.stamp import ns_to_ticks
from igtl_gateway.config.configuration import Config, PeerRow, ToIgtlRow
from igtl_gateway.convert import rosmsg
from igtl_gateway.convert.common_msgs import MultiArrayLayout
from igtl_gateway.convert.igtl_msgs import Command as RosCommand
from igtl_gateway.convert.igtl_msgs import CommandReply, LinkStatusList, TrackedTool, TrackingData
from igtl_gateway.convert.multi_arrays import MULTI_ARRAYS
from igtl_gateway.convert.plus_signs import MAX_SEARCHED
from igtl_gateway.convert.profiles import CPP_FACTORY
from igtl_gateway.convert.raw import raw_message
from igtl_gateway.convert.rosmsg import Header
from igtl_gateway.gateway import LINKS_TOPIC, Gateway, Session
from igtl_gateway.gateway.log.entry import Kind
from igtl_gateway.gateway.peers import Peers
from igtl_gateway.wire import Message, Raw, encode
from igtl_gateway.wire.capability import Capability
from igtl_gateway.wire.client_info import ClientInfo
from igtl_gateway.wire.image import Image
from igtl_gateway.wire.point import Points
from igtl_gateway.wire.query import EmptyQuery, StartTracking
from igtl_gateway.wire.registry import BODIES
from igtl_gateway.wire.text import Status, String
from igtl_gateway.wire.transform import Transform
from tests.peers.plus_like import FACTORY, PLACE, PlusReceiver, client_info, failed_reply, frame
from tests.script import T0_NS, Script
from tests.tables import table

LIVE = Config().watched()


def script(config: Config = LIVE, role: str = "client") -> Script:
    made = Script(config)
    made.up(1, peer="127.0.0.1:18944", role=role)
    return made


def profile_of(made: Script) -> str:
    (data,) = [one.data() for one in reversed(made.log) if one.channel == LINKS_TOPIC][:1]
    return LinkStatusList.unpack(data).links[0].profile


def sent_bytes(made: Script) -> list[bytes]:
    return [entry.data() for entry in made.log if entry.kind is Kind.IGTL_OUT]


def numbers() -> rosmsg.RosMessage:
    return MULTI_ARRAYS["f8"](MultiArrayLayout(), np.arange(3.0))


def command() -> RosCommand:
    return RosCommand(Header(), "Plus", 0, "StopRecording", 3, "<Command Name='StopRecording'/>")


def test_a_plus_server_that_nobody_named_keeps_its_command_channel() -> None:
    made, plus = script(), PlusReceiver()
    for number in range(5):
        for message in frame(number, "ProbeToTracker", "StylusToTracker"):
            made.igtl(message)
        made.ros("/igtl/out/joints", numbers())
    assert made.ros("/igtl/out/Plus/command", command()) == ["igtl COMMAND/Plus v1 to 1"]
    plus.receive(sent_bytes(made))
    assert not plus.lost and plus.read == ["COMMAND"]
    # the reply shows PLUS without doubt: from now on it is sent version 2, and answers in it
    assert "note peer_profile" in made.igtl(failed_reply(1, "No ChannelId specified."))
    assert profile_of(made) == "plus"
    assert made.tick(0.3) == ["igtl GET_STATUS/ v2 to 1"]


@table("igtl_type", sorted({*BODIES, "MYTYPE"}))
def test_no_type_reaches_an_unrecognised_peer_at_which_it_loses_the_stream(igtl_type: str) -> None:
    made = script()
    made.tick(0.3)  # until then it might be 3D Slicer
    data = join(encode(Message(igtl_type, "D", Raw(b""))))
    lines = made.ros("/igtl/out/any", replace(raw_message(data, T0_NS, 0), links=np.zeros(0, np.uint32)))
    assert lines == ([f"igtl {igtl_type}/D v1 to 1"] if igtl_type in CPP_FACTORY else ["note not_for_peer"])


def test_the_safe_types_are_those_of_the_factory() -> None:
    assert CPP_FACTORY | {"CLIENTINFO", "TRACKEDFRAME", "USMESSAGE"} == FACTORY


def test_what_is_held_back_is_counted_and_noted_once_with_the_way_to_send_it() -> None:
    made = script()
    assert made.ros("/igtl/out/joints", numbers()) == ["note not_for_peer"]
    (note,) = (note for note in made.notes if note.code == "not_for_peer")
    assert "--peer 127.0.0.1:18944=default" in note.text
    assert made.ros("/igtl/out/joints", numbers()) == []
    assert made.gateway.ledger.to_dict()["igtl_out"]["NDARRAY"]["dropped"] == {"not_for_unrecognised": 2}


@pytest.mark.parametrize(
    "shown",
    [
        Message("NDARRAY", "A", BODIES["NDARRAY"].unpack(memoryview(b"\3\1\0\1\7"))),
        Message("GET_NDARRAY", "", EmptyQuery()),
        Message("CAPABILITY", "", Capability(("STRING", "NDARRAY"))),
        Message("STATUS", "", Status(1), header_version=2),
    ],
    ids=["sends it", "asks for it", "lists it", "version 2"],
)
def test_a_peer_that_shows_that_it_knows_a_type_gets_it(shown: Message) -> None:
    made = script()
    made.igtl(shown)
    (line,) = made.ros("/igtl/out/joints", numbers())
    assert line.startswith("igtl NDARRAY/joints")


@pytest.mark.parametrize(
    "config",
    [Config(), Config(cautious=False), Config(cautious=True, peers=(PeerRow("127.0.0.1:*", "default"),))],
    ids=["an old recording", "switched off", "a named profile"],
)
def test_who_wants_all_types_gets_them(config: Config) -> None:
    assert script(config).ros("/igtl/out/joints", numbers()) == ["igtl NDARRAY/joints v1 to 1"]


@pytest.mark.parametrize("attributes, profile", [(('TDATAResolution="0"',), "plus"), ((), "plus-v1")])
def test_plus_as_a_client_is_recognised_from_its_first_message(attributes: tuple[str, ...], profile: str) -> None:
    made = script(role="server")
    lines = made.igtl(Message("CLIENTINFO", "", ClientInfo.of(client_info(*attributes))))
    assert "note peer_profile" in lines and profile_of(made) == profile
    pose = rosmsg.TransformStamped(Header(T0_NS, "base"), "Tool", (0.1, 0.2, 0.3), (0.0, 0.0, 0.0, 1.0))
    (line,) = made.ros("/igtl/out/ToolToRobot", pose)
    assert line == f"igtl TRANSFORM/ToolToRobot v{2 if profile == 'plus' else 1} to 1"


@pytest.mark.parametrize("attributes", [('TDATAResolution="0"',), ()], ids=["plus", "plus-v1"])
def test_plus_that_asks_for_tracking_data_before_the_robot_is_there_gets_it(attributes: tuple[str, ...]) -> None:
    made = script(role="server")
    made.igtl(Message("CLIENTINFO", "", ClientInfo.of(client_info(*attributes))))
    asked = join(encode(Message("STT_TDATA", "", StartTracking(0, "Robot"))))
    assert "note stream_started" in made.igtl(asked)
    assert "'Robot' is not known yet" in next(note.text for note in made.notes if note.code == "stream_started")
    pose = rosmsg.TransformStamped(Header(T0_NS, "Robot"), "Tool", (0.1, 0.2, 0.3), (0.0, 0.0, 0.0, 1.0))
    made.ros("/igtl/out/ToolToRobot", pose)
    (tracked,) = (one for one in made.sent() if one.type == "TDATA")
    assert tracked.content.elements["name"].tolist() == [b"ToolToRobot"]  # type: ignore[attr-defined]


def test_what_is_advised_for_a_client_names_the_server_that_it_connects_to() -> None:
    """Its own port is another one at its next connection."""
    made = Script(LIVE)
    made.up(1, peer="127.0.0.1:51790", local="127.0.0.1:18944", role="server")
    made.ros("/igtl/out/Numbers", numbers())
    (held,) = [note.text for note in made.notes if note.code == "not_for_peer"]
    for count in range(2):
        for one in frame(count, "ProbeToTracker", "StylusToTracker"):
            made.igtl(one)
    (shown,) = [note.text for note in made.notes if note.code == "peer_profile"]
    assert "--peer 127.0.0.1:18944=default" in held and "--peer 127.0.0.1:18944=plus" in shown


def test_frames_of_one_stamp_in_one_order_show_a_plus_of_version_1_and_that_it_has_no_validity() -> None:
    made = script()
    first = [made.igtl(one) for one in frame(0, "ProbeToTracker", "StylusToTracker")]
    assert not any("note peer_profile" in lines for lines in first)
    second = [made.igtl(one) for one in frame(1, "ProbeToTracker", "StylusToTracker")]
    assert "note peer_profile" in second[1]
    (note,) = [note for note in made.notes if note.code == "peer_profile"]
    assert "invalid poses" in note.text and "ClientHeaderVersion" in note.text and "=plus" in note.text
    assert profile_of(made) == "plus-v1"
    assert made.tick(1.0) == [], "what only looks like PLUS is sent no version 2"
    for one in frame(2, "ProbeToTracker", version=2):
        made.igtl(one)
    assert profile_of(made) == "plus"


def test_frames_of_one_pose_show_a_plus_only_where_the_gateway_is_the_client() -> None:
    for role, profile in (("client", "plus-v1"), ("server", "unrecognised")):
        made = script(role=role)
        for number in range(20):
            made.igtl(frame(number, "StylusToTracker")[0])
        assert profile_of(made) == profile


@pytest.mark.parametrize(
    "names, step",
    [(("Tool", "Probe"), 1 << 28), (("toolToBase", "probeToBase"), 1 << 28), (("AToB", "CToD"), 0)],
    ids=["names", "small letters", "stamps that stay"],
)
def test_other_servers_are_not_taken_for_plus(names: tuple[str, ...], step: int) -> None:
    made = script()
    for number in range(20):
        for one in frame(number, *names, ticks_per_frame=step):
            made.igtl(one)
    assert profile_of(made) == "unrecognised"


def test_messages_without_stamps_are_not_taken_for_plus() -> None:
    made = script()
    for _ in range(20):
        made.igtl(Message("TRANSFORM", "ProbeToTracker", Transform(PLACE)))
        made.igtl(Message("TRANSFORM", "StylusToTracker", Transform(PLACE)))
    assert profile_of(made) == "unrecognised"


def test_an_old_style_reply_shows_plus() -> None:
    made = script()
    text = String.of('<CommandReply Status="SUCCESS" Message="" />')
    assert "note peer_profile" in made.igtl(Message("STRING", "ACK_101", text))
    assert profile_of(made) == "plus-v1"


def test_live_and_verified_are_equal_while_a_peer_is_searched() -> None:
    """The fast path must not pass over the messages that recognise a peer."""
    made = script()
    names = ("ProbeToTracker",)
    for number in range(MAX_SEARCHED + 5):
        made.igtl(frame(number, *names)[0])
        if number == 3:
            for one in frame(number + 1000, "ProbeToTracker", "StylusToTracker"):
                made.igtl(one)
    again = Session(Gateway(LIVE, fast_path=False))
    outputs = [out for entry in made.log if entry.kind.is_input for out in again.recorded(entry)]
    assert outputs == [entry for entry in made.log if not entry.kind.is_input]


@pytest.mark.parametrize("device", ["Camera", "Image_Reference"])
def test_pictures_count_in_the_search_whether_they_are_compiled_or_not(device: str) -> None:
    made = script()
    for number in range(MAX_SEARCHED - 10):
        picture = Image((2, 2, 1), 3, bytes(12), 3)
        made.igtl(Message("IMAGE", device, picture, ns_to_ticks(T0_NS + number)))
    assert made.gateway.fast_path.to_ros
    for number in range(10):
        made.igtl(frame(number, "ProbeToTracker")[0])
    again_core = Gateway(LIVE, fast_path=False)
    again = Session(again_core)
    outputs = [out for entry in made.log if entry.kind.is_input for out in again.recorded(entry)]
    assert outputs == [entry for entry in made.log if not entry.kind.is_input]
    live, full = (core.fast_path._peers.get(1) for core in (made.gateway, again_core))
    assert live and full and live.frames == full.frames


def test_streams_that_are_not_searched_are_compiled_at_once() -> None:
    made = script()
    made.igtl(frame(0, "ProbeToTracker")[0])
    for number in range(2):
        made.igtl(Message("POINT", "Marks", Points.of(np.full((3, 3), number, ">f4")), ns_to_ticks(T0_NS)))
    assert [key[1][2:7] for key in made.gateway.fast_path.to_ros] == [b"POINT"]


def test_the_reason_of_a_failed_command_arrives() -> None:
    made = script(Config(cautious=True, profile="plus"))
    made.ros("/igtl/out/Plus/command", command())
    (asked,) = made.sent()
    made.igtl(failed_reply(asked.content.command_id, "No ChannelId specified."))  # type: ignore[attr-defined]
    reply = CommandReply.unpack(made.published("/igtl/in/Plus/command_reply"))
    assert (reply.status, reply.error_message) == (CommandReply.FAIL, "No ChannelId specified.")


def test_plus_gets_the_status_that_it_expects_with_a_pose() -> None:
    made = script(Config(cautious=True, profile="plus"))
    pose = rosmsg.TransformStamped(Header(T0_NS, "base"), "Tool", (0.1, 0.2, 0.3), (0.0, 0.0, 0.0, 1.0))
    made.ros("/igtl/out/ToolToRobot", pose)
    (sent,) = made.sent()
    assert {item.key: item.text for item in sent.metadata}["TransformStatus"] == "OK"
    tools = (TrackedTool("Probe", 2, (0.1, 0.2, 0.3, 0.0, 0.0, 0.0, 1.0)),)
    made.ros("/igtl/out/Tools", TrackingData(Header(T0_NS, "base"), tools))
    (sent,) = made.sent()
    assert {item.key: item.text for item in sent.metadata}["ProbeStatus"] == "OK"


def test_a_status_of_the_user_is_kept() -> None:
    row = ToIgtlRow(topic="/tool", device="ToolToRobot", metadata=(("TransformStatus", "OUT_OF_VIEW"),))
    made = script(Config(cautious=True, profile="plus", to_igtl=(row,)))
    made.ros("/tool", rosmsg.TransformStamped(Header(T0_NS, "base"), "Tool", (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)))
    (sent,) = made.sent()
    assert [item.text for item in sent.metadata if item.key == "TransformStatus"] == ["OUT_OF_VIEW"]


def test_a_pose_that_its_sender_marks_as_not_valid_is_not_on_tf() -> None:
    made = script()

    def poses(status: str, number: int) -> bool:
        made.igtl(frame(number, "StylusToTracker", version=2, status=status)[0])
        published = {entry.channel for entry in made.last if entry.kind is Kind.ROS_OUT}
        assert "/igtl/in/StylusToTracker/transform" in published
        return "/tf" in published

    assert [poses(status, number) for number, status in enumerate(("OK", "INVALID", "OUT_OF_VIEW", "OK"))] == [
        True,
        False,
        False,
        True,
    ]


def test_a_bridge_of_crtk_arms_sends_their_types() -> None:
    made = script(Config(profile="crtk:/PSM*").watched())
    made.tick(0.3)  # until then it might be 3D Slicer
    assert made.ros("/igtl/out/joints", numbers()) == ["igtl NDARRAY/joints v1 to 1"]


def test_a_server_has_the_profile_of_its_address_as_the_configuration_has_it() -> None:
    """A name of a host, and the address that it has."""
    config = Config(peers=(PeerRow("scanner.local:18944", "plus"),))
    for asked, profile in (("scanner.local:18944", "plus"), ("other:18944", "unrecognised"), ("", "unrecognised")):
        peers = Peers(replace(config, cautious=True))
        facts = {"peer": "10.0.0.7:18944", "role": "client"} | ({"asked": asked} if asked else {})
        assert peers.up(1, facts, 0).profile.name == profile
