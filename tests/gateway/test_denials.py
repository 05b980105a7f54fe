"""Read-only mode: what is denied comes in by no way and goes out by none."""

from __future__ import annotations

import pytest

from igtl_gateway.base.buffers import join
from igtl_gateway.base.errors import ConfigError
from igtl_gateway.config.configuration import Config
from igtl_gateway.convert import rosmsg
from igtl_gateway.convert.igtl_msgs import Command as RosCommand
from igtl_gateway.convert.igtl_msgs import CommandReply
from igtl_gateway.convert.raw import raw_message
from igtl_gateway.convert.rosmsg import Header
from igtl_gateway.gateway import denials
from igtl_gateway.gateway.denials import Denials
from igtl_gateway.gateway.log.note import Note
from igtl_gateway.replay.verify import verify
from igtl_gateway.wire import Message, Raw, encode
from igtl_gateway.wire.bind import Bind, BindChild
from igtl_gateway.wire.body import Body
from igtl_gateway.wire.command import Command
from igtl_gateway.wire.query import QUERIES, QueryReply
from igtl_gateway.wire.text import Status, String
from igtl_gateway.wire.transform import Transform
from tests.gateway.test_relay import Relay, codes
from tests.script import T0_NS, Script
from tests.tables import table

POSE = Transform((1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 10.0, 20.0, 30.0))
TOOL = rosmsg.TransformStamped(Header(T0_NS, "base"), "tool", (0.1, 0.2, 0.3), (0.0, 0.0, 0.0, 1.0))
ORDER = RosCommand(Header(), "Robot", 0, "Start", 3, "<Command/>")


def bind(*children: tuple[str, Body]) -> Message:
    made = tuple(BindChild(name, f"c{index}", join(body.pack())) for index, (name, body) in enumerate(children))
    return Message("BIND", "Both", Bind(made))


def query(name: str) -> Message:
    return Message(name, "Tool", QUERIES[name].unpack(memoryview(b"")))


@table(
    ("globs", "igtl_type", "denied"),
    [
        ("TRANSFORM", "TRANSFORM", True),
        ("transform", "TRANSFORM", True),
        ("TRANSFORM", "QTRANS", False),
        ("POSITION", "QTRANS", True),  # another name of the same
        ("QTRANS", "QTRANS", True),
        ("GET_TRANSFORM", "GET_TRANS", True),
        ("STT_*", "GET_TRANS", False),
        ("COMMAND", "RTS_COMMAND", False),
        ("*", "ANYTHING", True),
        ("", "COMMAND", False),
    ],
)
def test_globs_of_types(globs: str, igtl_type: str, denied: bool) -> None:
    denials = Denials(globs.split())
    assert [denials.type(igtl_type) for _ in range(2)] == [denied, denied]
    assert bool(denials) is bool(globs)


@pytest.mark.parametrize("glob", ["", "TRANSFORM/Tool", "A B", "A,B", "Ä"])
def test_what_can_be_no_type_is_refused(glob: str) -> None:
    with pytest.raises(ConfigError, match=r"gateway\.deny_in"):
        Config(deny_in=(glob,))


def test_a_viewer_moves_nothing_and_sees_all() -> None:
    script = Script(Config(deny_in=("*",)))
    script.up(1)
    assert script.igtl(Message("TRANSFORM", "Tool", POSE)) == ["note denied"]
    assert script.igtl(Message("TRANSFORM", "Tool", POSE)) == [], "noted once for each peer and type"
    script.up(2)
    assert script.igtl(Message("TRANSFORM", "Tool", POSE), link=2) == ["note denied"]
    assert script.ros("/igtl/out/Robot", TOOL) == ["igtl TRANSFORM/Robot v1 to 1,2"]
    fates = script.gateway.ledger.to_dict()["igtl_in"]["TRANSFORM/Tool"]
    assert fates == {"received": 3, "decoded": 3, "dropped": {"denied": 3}}
    assert not script.gateway.fast_path.to_ros, "no fast path for what is denied"
    assert verify(script.log, script.gateway.config).good
    assert not verify(script.log, Config()).good, "denials are part of what a recording verifies with"


def test_a_denied_command_fails_at_once() -> None:
    script = Script(Config(deny_in=("COMMAND",)))
    script.up(1)
    lines = script.igtl(Message("COMMAND", "Robot", Command.of(7, "Start", "<Command/>")))
    assert lines == ["note denied", "igtl RTS_COMMAND/Robot v1 to 1"]
    (reply,) = script.sent()
    assert isinstance(reply.content, Command) and reply.content.command_id == 7
    assert script.gateway.due_ns is None, "nothing waits for an answer of ROS"


@pytest.mark.parametrize(
    ("name", "answer"),
    [
        ("GET_TRANS", ("STATUS", Status(5, 0, "AccessDenied", "GET_TRANS is denied"))),
        ("STT_TDATA", ("RTS_TDATA", QueryReply(1))),
        ("STP_TDATA", ("RTS_TDATA", QueryReply(1))),
        ("RTS_TDATA", None),  # an answer to an answer would have no end
    ],
)
def test_a_denied_query_is_refused(name: str, answer: tuple[str, Body] | None) -> None:
    script = Script(Config(deny_in=("???_*",)))
    script.ros("/igtl/out/Tool", TOOL)
    script.up(1)
    lines = script.igtl(query(name))
    assert not any(line.startswith("ros") for line in lines)
    assert [(message.type, message.content) for message in script.sent()] == ([answer] if answer else [])
    assert "note denied" in lines


def test_what_is_in_a_bind_is_denied_with_it() -> None:
    script = Script(Config(deny_in=("TRANSFORM",)))
    script.up(1)
    assert script.igtl(bind(("STRING", String.of("hello")), ("TRANSFORM", POSE))) == ["note denied"]
    deep = bind(("BIND", bind(("TRANSFORM", POSE)).content))
    assert script.igtl(deep) == []
    assert any(line.startswith("ros") for line in script.igtl(bind(("STRING", String.of("hello")))))


def test_nothing_denied_goes_out() -> None:
    script = Script(Config(deny_out=("TRANSFORM", "COMMAND", "GET_STATUS", "BIND"), profile="plus"))
    script.ros("/igtl/out/Tool", TOOL)
    script.up(1)
    assert script.ros("/igtl/out/Tool", TOOL) == ["note denied"]
    assert script.ros("/igtl/out/Tool", TOOL) == []
    for message in (Message("TRANSFORM", "Tool", POSE), bind(("TRANSFORM", POSE))):
        assert script.ros("/igtl/out/raw", raw_message(join(encode(message)), T0_NS, 0)) == ["note denied"]
    assert script.gateway.ledger.to_dict()["ros_in"]["/igtl/out/Tool"]["dropped"] == {"denied": 2, "no_peer": 1}
    assert script.tick(60.0) == [], "a denied ping is not due again and again"
    assert not script.gateway.fast_path.to_igtl


def test_who_asks_for_what_is_denied_is_told() -> None:
    script = Script(Config(deny_out=("TRANSFORM",)))
    script.ros("/igtl/out/Tool", TOOL)
    script.up(1)
    script.igtl(query("GET_TRANS"))
    (answer,) = script.sent()
    assert answer.content == Status(5, 0, "AccessDenied", "GET_TRANS is denied")
    script.igtl(query("GET_POSITION"))
    (position,) = script.sent()
    assert position.type == "POSITION", "the same pose as another type is another matter"


def test_ros_is_told_of_a_denied_command() -> None:
    script = Script(Config(deny_out=("COMMAND",)))
    script.up(1)
    assert script.ros("/igtl/out/Robot/command", ORDER) == ["note denied", "ros /igtl/in/Robot/command_reply"]
    reply = CommandReply.unpack(script.published("/igtl/in/Robot/command_reply"))
    assert (reply.status, reply.error_message) == (CommandReply.FAIL, "COMMAND is denied")


def test_a_relay_denies_from_the_client_or_to_it() -> None:
    relay = Relay(Config(relay=True, deny_in=("COMMAND",), deny_out=("STRING",)))
    relay.pair(1, 2)
    command, text = (
        join(encode(Message(name, "A", body)))
        for name, body in (("COMMAND", Command.of(1, "Start", "")), ("STRING", String.of("hello")))
    )
    assert codes(relay.igtl(command, 1)) == ["denied"] and relay.igtl(command, 1) == []
    assert [entry.links for entry in relay.igtl(command, 2)] == [(1,)]
    assert codes(relay.igtl(text, 2)) == ["denied"]
    assert [entry.links for entry in relay.igtl(text, 1)] == [(2,)]
    blind = bytearray(join(encode(Message("BIND", "B", Raw(b"\xff\xff")))))
    (told,) = relay.igtl(bytes(blind), 1)
    assert "cannot be decoded" in Note.unpack(told.data()).text


def test_a_relay_denies_a_bind_for_its_child() -> None:
    relay = Relay(Config(relay=True, deny_in=("COMMAND",)))
    relay.pair(1, 2)
    (note,) = relay.igtl(join(encode(bind(("STRING", String.of("hello")), ("COMMAND", Command.of(1, "Go", ""))))), 1)
    assert "BIND that contains COMMAND is denied" in Note.unpack(note.data()).text
    assert [entry.links for entry in relay.igtl(join(encode(bind(("STRING", String.of("hello"))))), 1)] == [(2,)]


def test_a_child_that_cannot_be_decoded_contains_nothing_that_is_denied() -> None:
    inner = Message("BIND", "Both", Bind((BindChild("BIND", "inner", b"\xff\xff"),)))
    assert Denials(["COMMAND"]).message(inner) == ""
    assert Denials(["BIND"]).message(inner) == "BIND"
    assert Denials([]).message(inner) == ""


def test_names_that_a_peer_invents_do_not_fill_the_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(denials, "_MAX_KNOWN", 2)
    some = Denials(["X*"])
    assert [some.type(name) for name in ("X1", "A", "X2", "B", "X2", "B")] == [True, False, True, False, True, False]
    assert len(some._known) == 2


def test_a_denied_message_of_an_unknown_link_is_dropped_with_a_note() -> None:
    script = Script(Config(deny_in=("TRANSFORM",)))
    assert script.igtl(Message("TRANSFORM", "Tool", POSE), link=9) == ["note denied"]
    assert script.gateway.ledger.to_dict()["igtl_in"]["TRANSFORM/Tool"]["dropped"] == {"denied": 1}
