"""The conversation without I/O: what is sent, expected and matched, with a clock that stands."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import pytest

from igtl_gateway.api.conversation import Conversation, Handler, PeerOptions, Wait, is_command
from igtl_gateway.base.buffers import Buffer, join
from igtl_gateway.base.errors import ConfigError, LinkClosed, Refused
from igtl_gateway.base.stamp import NS_PER_S
from igtl_gateway.gateway.log.note import Level, Note
from igtl_gateway.wire import Message, decode, encode
from igtl_gateway.wire.command import Command
from igtl_gateway.wire.query import EmptyQuery, QueryReply
from igtl_gateway.wire.text import Status, String

LINK = 7


class StandingClock:
    def utc_ns(self) -> int:
        return 1_700_000_000 * NS_PER_S

    def monotonic_ns(self) -> int:
        return 5 * NS_PER_S


class World:
    def __init__(self) -> None:
        self.sent: list[tuple[list[int], Message]] = []
        self.talk = Conversation("server", PeerOptions(), StandingClock(), self._out, ends=True)
        self.link(True)

    def _out(self, links: Sequence[int], buffers: Sequence[Buffer], _stream: str, _keep: bool) -> None:
        self.sent.append((list(links), decode(join(list(buffers)))))

    def link(self, up: bool) -> None:
        self.talk.link_changed(LINK, up, Note(Level.INFO, "link", "up" if up else "down"))

    def arrives(self, kind: str, device: str, content: Any) -> None:
        self.talk.received(LINK, join(encode(Message(kind, device, content, 0, 1))))


def result(wait: Wait[Any]) -> Any:
    """What a driver does with a wait that has its result."""
    found = wait.attempt()
    wait.leave()
    assert found is not None
    return wait.finish(found)


def test_the_answer_of_a_query_does_not_enter_the_queue() -> None:
    world = World()
    wait = world.talk.query("TRANSFORM", "Tool", 5, None)
    assert [(links, message.type) for links, message in world.sent] == [([LINK], "GET_TRANS")]
    assert wait.attempt() is None
    world.arrives("STRING", "Tool", String(b"of another type"))
    assert wait.attempt() is None
    world.arrives("STATUS", "Tool", Status(4, 0, "NotFound", "no such tool"))
    with pytest.raises(Refused, match="no such tool"):
        result(wait)
    assert world.talk.receive("", "", 0).attempt().text == "of another type"
    assert world.talk.receive("", "", 0).attempt() is None


def test_a_wait_that_was_left_takes_no_answer() -> None:
    world = World()
    world.talk.query("STATUS", "Tool", 5, None).leave()
    world.arrives("STATUS", "Tool", Status(1, 0, "", ""))
    assert result(world.talk.receive("STATUS", "", 0)).device == "Tool"


def test_a_stream_that_is_refused_and_one_without_acknowledgement() -> None:
    world = World()
    wait = world.talk.stream("STT", "TDATA", "", EmptyQuery(), 5, None)
    world.arrives("RTS_TDATA", "", QueryReply(1))
    with pytest.raises(Refused, match="STT_TDATA"):
        result(wait)
    assert result(world.talk.stream("STP", "TDATA", "", EmptyQuery(), 0, None)) is None


def test_replies_are_those_of_their_command() -> None:
    world = World()
    first, second = (world.talk.command(name, "", "", None, 5, None) for name in ("A", "B"))
    numbers = [message.content.command_id for _, message in world.sent if isinstance(message.content, Command)]
    world.arrives("RTS_COMMAND", "", Command.of(numbers[1], "B", "second"))
    assert first.attempt() is None
    assert result(second).text == "second"


def test_a_connection_that_ends_ends_the_waits() -> None:
    world = World()
    wait = world.talk.query("STATUS", "", 5, None)
    world.link(False)
    for each in (wait, world.talk.receive("", "", 5), world.talk.connected(1, 5, "a server")):
        with pytest.raises(LinkClosed):
            each.attempt()


def test_calls_of_handlers_and_their_end() -> None:
    world = World()
    world.talk.add_handler(Handler(is_command("Go"), lambda _: "done", world.talk.respond_to_command))
    world.arrives("COMMAND", "Robot", Command.of(3, "Go", ""))
    call = result(world.talk.next_call())
    world.talk.finish(call, "done", None)
    ((links, reply),) = world.sent
    assert isinstance(reply.content, Command)
    assert (links, reply.type, reply.content.command_id) == ([LINK], "RTS_COMMAND", 3)
    assert world.talk.next_call().attempt() is None
    assert world.talk.close()
    assert result(world.talk.next_call()) is None
    assert not world.talk.close()


def test_time_is_an_argument() -> None:
    world = World()
    assert world.talk.deadline_ns(None) is None
    assert world.talk.left_s(world.talk.deadline_ns(2.5)) == 2.5
    with pytest.raises(ConfigError, match="timeout_s: found -1, expected"):
        world.talk.deadline_ns(-1)
    world.arrives("STATUS", "Robot", Status(1, 0, "", ""))
    error = world.talk.no_reply(world.talk.receive("STRING", "", 2))
    expected = "server: found nothing within 2 s, expected a message STRING/*; received so far: STATUS/Robot (1)"
    assert str(error) == expected
