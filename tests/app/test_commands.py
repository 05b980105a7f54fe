"""The command service without ROS: calls become messages, replies are picked out of the log."""

from __future__ import annotations

import threading
from types import SimpleNamespace
from typing import Any

import pytest

from igtl_gateway.app.commands import CommandService, Publish
from igtl_gateway.convert.igtl_msgs import Command, CommandReply, MetadataItem
from igtl_gateway.convert.rosmsg import Header
from igtl_gateway.gateway.log.entry import Entry, Kind


def request(**fields: Any) -> SimpleNamespace:
    values = {"device_name": "Slicer", "name": "Go", "content": "<x/>", "metadata": [], "link": 0, "timeout": 0.0}
    return SimpleNamespace(**values | fields)


def reply_entry(reply: CommandReply) -> Entry:
    return Entry(1, 1, Kind.ROS_OUT, "/igtl/in/Slicer/command_reply", reply.TYPE, (reply.pack(),))


def replied(command: Command, **fields: Any) -> CommandReply:
    return CommandReply(Header(), command.device_name, command.id, command.name, **{"status": 1} | fields)


def started(publish: Publish, timeout_s: float) -> CommandService:
    """A service on a node whose messages are plain objects."""
    side: Any = SimpleNamespace(message_class=lambda _type: SimpleNamespace, serve=lambda *_: True)
    service = CommandService(side, publish, timeout_s, lambda note: pytest.fail(note.text))
    service.start()
    return service


def test_a_call_becomes_a_message_and_its_reply_the_response() -> None:
    said: list[tuple[str, Command]] = []

    def publish(topic: str, ros_type: str, cdr: bytes) -> None:
        assert ros_type == Command.TYPE
        said.append((topic, Command.unpack(cdr)))
        command = said[-1][1]
        service.on_entry(reply_entry(CommandReply(Header(), "x", 1, "", 1)))  # to another program
        item = MetadataItem("Status", 3, "SUCCESS")
        service.on_entry(reply_entry(replied(command, content="<ok/>", metadata=(item,), link=4)))
        service.on_entry(reply_entry(replied(command, content="too late")))

    service = started(publish, 5.0)
    item = SimpleNamespace(key="who", encoding=0, value="me")
    response = service.call(request(metadata=[item], timeout=2.5), SimpleNamespace())
    ((topic, command),) = said
    assert topic == "/igtl/out/Slicer/command"
    assert (command.name, command.content, command.timeout) == ("Go", "<x/>", 2.5)
    assert command.metadata == (MetadataItem("who", 0, "me"),)
    assert (response.status, response.content, response.link) == (1, "<ok/>", 4)
    assert [(one.key, one.value) for one in response.metadata] == [("Status", "SUCCESS")]


def test_each_call_has_an_id_of_its_own() -> None:
    ids: list[int] = []

    def publish(_topic: str, _type: str, cdr: bytes) -> None:
        command = Command.unpack(cdr)
        ids.append(command.id)
        service.on_entry(reply_entry(replied(command)))

    service = started(publish, 5.0)
    for _ in range(3):
        service.call(request(), SimpleNamespace())
    assert ids == [0x8000_0000, 0x8000_0001, 0x8000_0002]


def test_the_end_of_the_gateway_ends_a_call() -> None:
    asked = threading.Event()
    service = started(lambda *_: asked.set(), 60.0)
    response = SimpleNamespace()
    caller = threading.Thread(target=service.call, args=(request(), response))
    caller.start()
    assert asked.wait(10)
    service.stop()
    caller.join(10)
    assert not caller.is_alive()
    assert response.status == CommandReply.TIMEOUT and "stopped" in response.error_message
