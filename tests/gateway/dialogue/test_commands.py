"""Commands in both directions, with ids, time-outs and replies."""

from __future__ import annotations

from dataclasses import replace

import pytest

from igtl_gateway.config.configuration import Config
from igtl_gateway.convert.commands import reply_result, with_failure_in_text
from igtl_gateway.convert.igtl_msgs import Command as RosCommand
from igtl_gateway.convert.igtl_msgs import CommandReply, MetadataItem
from igtl_gateway.convert.rosmsg import Header
from igtl_gateway.gateway.dialogue.commands import MAX_PENDING, PendingCommand, PendingCommands
from igtl_gateway.wire import Item, Message
from igtl_gateway.wire.command import Command
from igtl_gateway.wire.text import Status
from tests.script import Script

HELLO = Message("STATUS", "", Status(1), 0, 2, 0, (Item("a", b"b"),))


def asked(command_id: int = 7, name: str = "Start", device: str = "Robot") -> Message:
    return Message("COMMAND", device, Command.of(command_id, name, "<Command/>"))


def metadata(message: Message) -> dict[str, str]:
    return {item.key: item.text for item in message.metadata}


def test_a_command_of_a_peer_is_answered_by_ros() -> None:
    script = Script()
    script.up(1)
    script.up(2)
    script.igtl(HELLO, link=2)
    assert script.igtl(asked(), link=2) == ["ros /igtl/in/Robot/command"]
    command = RosCommand.unpack(script.published("/igtl/in/Robot/command"))
    assert (command.id, command.name, command.content, command.link) == (7, "Start", "<Command/>", 2)
    reply = CommandReply(Header(), "", 7, "", CommandReply.SUCCESS, content="done")
    assert script.ros("/igtl/out/Robot/command_reply", reply) == ["igtl RTS_COMMAND/Robot v2 to 2"]
    (message,) = script.sent()
    assert isinstance(message.content, Command)
    assert (message.content.command_id, message.content.name, message.content.text) == (7, "Start", "done")
    assert metadata(message)["Status"] == "SUCCESS"
    assert script.ros("/igtl/out/Robot/command_reply", reply) == ["note conversion"], "answered is answered"


def test_a_command_that_nobody_answers_fails_in_time() -> None:
    script = Script(Config(command_timeout_s=2.0))
    script.up(1)
    script.igtl(HELLO)
    script.igtl(asked())
    assert script.tick(1.9) == []
    assert script.tick(0.2) == ["igtl RTS_COMMAND/Robot v2 to 1", "note command_timeout"]
    told = metadata(script.sent()[0])
    assert told["Status"] == "FAIL" and "no reply in time" in told["ErrorMessage"]
    assert script.gateway.due_ns is None


def _refused(config: Config, *messages: Message) -> str:
    """The text of the reply to a peer of header version 1."""
    script = Script(config)
    script.up(1)
    for message in messages or [asked()]:
        script.igtl(message)
    script.tick(6.0)
    content = script.sent()[-1].content
    assert isinstance(content, Command) and not script.sent()[-1].metadata
    return content.text


@pytest.mark.parametrize(
    ("config", "reason"),
    [
        (Config(), "no reply in time from ROS"),
        (Config(deny_in=("COMMAND",)), "COMMAND is denied"),
    ],
)
def test_a_peer_without_metadata_finds_the_failure_in_the_text(config: Config, reason: str) -> None:
    text = _refused(config)
    assert text == f'<CommandReply Name="Start" Status="FAIL" Message="{reason}" />'
    assert reply_result(text, ()) == (CommandReply.FAIL, reason, "")
    assert _refused(replace(config, fitting=1)) == "", "recordings from before verify"


@pytest.mark.parametrize(
    ("error_message", "content", "reason"),
    [("no power", "", "no power"), ("", "late", "late"), ("no power", "<Sorry/>", "no power: <Sorry/>")],
)
def test_such_a_failure_keeps_what_the_node_has_answered(error_message: str, content: str, reason: str) -> None:
    reply = CommandReply(Header(), "Robot", 7, "Start", CommandReply.FAIL, error_message, content=content)
    assert reply_result(with_failure_in_text(reply).content, ()) == (CommandReply.FAIL, reason, "")


@pytest.mark.parametrize(
    ("reply", "text"),
    [
        (CommandReply(Header(), "", 7, "", CommandReply.FAIL, 'no "x" <y>'), None),
        (CommandReply(Header(), "", 7, "", CommandReply.FAIL, content="joint 2 is blocked"), None),
        (CommandReply(Header(), "", 7, "", CommandReply.SUCCESS, content="done"), "done"),
        (CommandReply(Header(), "", 7, "", CommandReply.FAIL, "a", content="<CommandReply Status='FALSE'/>"), "<Com"),
    ],
)
def test_a_failure_of_a_node_reaches_a_peer_without_metadata(reply: CommandReply, text: str | None) -> None:
    script = Script()
    script.up(1)
    script.igtl(asked())
    script.ros("/igtl/out/Robot/command_reply", reply)
    content = script.sent()[0].content
    assert isinstance(content, Command)
    if text is None:
        assert reply_result(content.text, ()) == (CommandReply.FAIL, reply.error_message or reply.content, "")
    else:
        assert content.text.startswith(text)
        assert content.text == reply.content


@pytest.mark.parametrize("config", [Config(), Config(deny_in=("COMMAND",))])
def test_a_name_of_odd_bytes_costs_nobody_the_answer(config: Config) -> None:
    """Found by tools/fuzz_gateway.py: as text it is longer than a header field; that tick reported no timeout."""
    script = Script(config)
    script.up(1)
    script.up(2)
    odd = (b"\xff" * 12).decode("utf-8", "surrogateescape")
    told = [*script.igtl(asked(device=odd)), *script.igtl(asked(device=odd)), *script.igtl(asked(), link=2)]
    told += script.tick(60.0)
    assert "note internal_error" not in told
    replies = [line for line in told if line.startswith("igtl RTS_COMMAND/")]
    assert [line.rpartition(" ")[2] for line in replies] == ["1", "1", "2"]
    assert "igtl RTS_COMMAND/Robot v1 to 2" in replies


def test_the_same_id_twice_is_refused_while_the_first_waits() -> None:
    script = Script()
    script.up(1)
    script.igtl(asked())
    assert script.igtl(asked()) == ["igtl RTS_COMMAND/Robot v1 to 1", "note command_refused"], "and not given to ROS"


def test_ros_commands_a_peer_and_gets_its_reply() -> None:
    script = Script()
    script.up(1)
    order = RosCommand(Header(), "Slicer", 0, "LoadScene", 0, "<x/>", (MetadataItem("who", 0, "me"),))
    assert script.ros("/igtl/out/Slicer/command", order) == ["igtl COMMAND/Slicer v1 to 1"]
    content = script.sent()[0].content
    assert isinstance(content, Command) and content.command_id == 1
    script.ros("/igtl/out/Slicer/command", order)
    second = script.sent()[0].content
    assert isinstance(second, Command) and second.command_id == 2
    answer = Message("RTS_COMMAND", "Slicer", Command.of(1, "LoadScene", "ok"), 0, 2, 0, (Item.of("Status", "FAIL"),))
    assert script.igtl(answer) == ["ros /igtl/in/Slicer/command_reply"]
    reply = CommandReply.unpack(script.published("/igtl/in/Slicer/command_reply"))
    assert (reply.id, reply.status, reply.content, reply.link) == (1, CommandReply.FAIL, "ok", 1)
    assert script.tick(10.0) == ["ros /igtl/in/Slicer/command_reply", "note command_timeout"]
    late = CommandReply.unpack(script.published("/igtl/in/Slicer/command_reply"))
    assert (late.id, late.status) == (2, CommandReply.TIMEOUT)


def test_a_command_has_its_own_time() -> None:
    script = Script()
    script.up(1)
    script.ros("/igtl/out/S/command", RosCommand(Header(), "S", 9, "Wait", 0, "", timeout=60.0))
    assert script.tick(59.0) == []
    assert script.tick(1.5) == ["ros /igtl/in/S/command_reply", "note command_timeout"]


def test_without_a_peer_the_answer_comes_at_once() -> None:
    script = Script()
    assert script.ros("/igtl/out/S/command", RosCommand(Header(), "S", 5, "Go", 0, "")) == [
        "ros /igtl/in/S/command_reply"
    ]
    reply = CommandReply.unpack(script.published("/igtl/in/S/command_reply"))
    assert (reply.id, reply.status) == (5, CommandReply.NO_PEER)


def test_a_peer_that_must_not_be_asked_is_nobody_to_ask() -> None:
    script = Script(Config(profile="holoscan"))
    script.up(1)
    script.ros("/igtl/out/S/command", RosCommand(Header(), "S", 5, "Go", 0, ""))
    reply = CommandReply.unpack(script.published("/igtl/in/S/command_reply"))
    assert reply.status == CommandReply.NO_PEER and script.sent() == []


def test_a_peer_that_goes_leaves_no_one_waiting() -> None:
    script = Script()
    script.up(1)
    script.ros("/igtl/out/S/command", RosCommand(Header(), "S", 5, "Go", 0, ""))
    assert script.down(1) == ["ros /igtl/in/S/command_reply"]
    assert script.gateway.due_ns is None


def test_ids_are_reused_only_when_free_and_their_number_is_bounded() -> None:
    book = PendingCommands()
    for index in range(1, MAX_PENDING + 1):
        assert book.add(PendingCommand(1, index, "D", "N", index))
    assert not book.add(PendingCommand(1, MAX_PENDING + 1, "D", "N", 1))
    assert book.new_id() == MAX_PENDING + 1
    assert book.due_ns == 1
    assert [one.command_id for one in book.overdue(3)] == [1, 2, 3]
    taken = book.take(4)
    assert taken is not None and taken.command_id == 4 and book.take(4) is None
    assert len(book.on_link_down(1)) == MAX_PENDING - 4 and not len(book)


def test_a_reply_is_for_the_command_of_its_peer_or_the_first_with_its_id() -> None:
    book = PendingCommands()
    first, second, other = (PendingCommand(link, number, "D", "N", 9) for link, number in ((2, 7), (3, 7), (3, 8)))
    assert all(map(book.add, (first, second, other)))
    assert not book.add(PendingCommand(3, 7, "D", "N", 9)), "it waits already"
    assert book.take(7, 1) is None
    assert [book.take(7, 3), book.take(7, 3)] == [second, None]
    assert [book.take(7), book.take(7), book.take(8)] == [first, None, other], "without a link: of any"


TOO_MUCH = (MetadataItem("key", 0, "x" * 100_000),)


def test_a_command_that_cannot_be_sent_fails_at_once() -> None:
    script = Script()
    script.up(1)
    script.igtl(HELLO)
    command = RosCommand(Header(), "Robot", 9, "Start", 0, "", TOO_MUCH)
    assert script.ros("/igtl/out/Robot/command", command) == ["note conversion", "ros /igtl/in/Robot/command_reply"]
    reply = CommandReply.unpack(script.published("/igtl/in/Robot/command_reply"))
    assert (reply.id, reply.status) == (9, CommandReply.FAIL) and "metadata" in reply.error_message
    assert script.gateway.due_ns is None, "nothing is waited for"


def test_a_reply_that_cannot_be_sent_is_a_failure() -> None:
    script = Script()
    script.up(1)
    script.igtl(HELLO)
    script.igtl(asked())
    reply = CommandReply(Header(), "", 7, "", CommandReply.SUCCESS, metadata=TOO_MUCH)
    lines = script.ros("/igtl/out/Robot/command_reply", reply)
    assert lines == ["note conversion", "igtl RTS_COMMAND/Robot v2 to 1"]
    assert metadata(script.sent()[0])["Status"] == "FAIL"
