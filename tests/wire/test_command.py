"""COMMAND and RTS_COMMAND: layout, the widest name, lengths that lie."""

from __future__ import annotations

import struct

import pytest

from igtl_gateway.base.buffers import join
from igtl_gateway.base.errors import MalformedBody, TruncatedMessage
from igtl_gateway.wire import Message, decode, encode
from igtl_gateway.wire.command import NAME_WIDTH, Command

GOLDEN = b"\0\0\0\5" + b"Go".ljust(128, b"\0") + b"\0\x6a" + b"\0\0\0\2" + b"\xc3\xa9"


def test_golden_bytes() -> None:
    command = Command.of(5, "Go", "é")
    assert join(command.pack()) == GOLDEN
    assert Command.unpack(memoryview(GOLDEN)) == command == Command(5, "Go", "é".encode(), 106)
    assert command.text == "é"
    assert Command.of(5, "Go", "e").encoding == 3


@pytest.mark.parametrize("kind", ["COMMAND", "RTS_COMMAND"])
def test_a_command_and_its_reply_look_alike(kind: str) -> None:
    message = Message(kind, "", Command.of(2**32 - 1, "Go", ""), header_version=2)
    assert decode(join(encode(message))) == message


def test_the_widest_name() -> None:
    command = Command(1, "n" * NAME_WIDTH, b"")
    assert Command.unpack(memoryview(join(command.pack()))) == command
    with pytest.raises(MalformedBody, match="at most 128"):
        Command(1, "é" * 64 + "n", b"").pack()


def test_what_stands_behind_a_nul_is_kept() -> None:
    data = GOLDEN[:4] + b"Go\0junk\xff".ljust(128, b"\0") + GOLDEN[132:]
    command = Command.unpack(memoryview(data))
    assert join(command.pack()) == data
    assert command.describe()["command_name"] == "Go"


def test_more_than_the_cpp_interface_holds() -> None:
    command = Command(1, "", bytes(65_536))
    assert Command.unpack(memoryview(join(command.pack()))) == command


def test_lengths_that_lie() -> None:
    for size in range(len(GOLDEN)):
        with pytest.raises(TruncatedMessage):
            Command.unpack(memoryview(GOLDEN[:size]))
    with pytest.raises(MalformedBody):
        Command.unpack(memoryview(GOLDEN + b"\0"))
    with pytest.raises(TruncatedMessage):
        Command.unpack(memoryview(GOLDEN[:134] + struct.pack(">I", 2**32 - 1) + GOLDEN[138:]))


@pytest.mark.parametrize("command", [Command(-1, "", b""), Command(2**32, "", b""), Command(0, "", b"", 65_536)])
def test_numbers_beyond_their_fields(command: Command) -> None:
    with pytest.raises(MalformedBody):
        encode(Message("COMMAND", "", command))
