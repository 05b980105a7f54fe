"""Whole messages on their way through ROS: unchanged, or refused."""

from __future__ import annotations

import pytest

from igtl_gateway.base.buffers import join
from igtl_gateway.base.errors import ConversionError, TruncatedMessage
from igtl_gateway.convert.igtl_msgs import RawMessage
from igtl_gateway.convert.raw import message_of, raw_message
from igtl_gateway.wire import Item, Message, Raw, encode

TICKS = 5 << 32 | 0x80000000


def message(version: int = 1, name: str = "Device") -> bytes:
    items = (Item("key", b"value"),) if version > 1 else ()
    return join(encode(Message("USMESSAGE", name, Raw(b"content"), TICKS, version, 0, items)))


@pytest.mark.parametrize("version", [1, 2])
def test_there_and_back(version: int) -> None:
    data = message(version)
    raw = raw_message(data, 11, 3)
    assert raw.data is data
    assert (raw.stamp_ns, raw.source_stamp_ns, raw.source_ticks) == (11, 5_500_000_000, TICKS)
    assert (raw.direction, raw.links.tolist()) == (RawMessage.DIRECTION_IN, [3])
    assert (raw.type, raw.device_name) == ("USMESSAGE", "Device")
    assert bytes(message_of(RawMessage.unpack(raw.pack()))) == data


def test_names_become_readable_text() -> None:
    assert raw_message(message(name="caf\udce9\x00rest"), 0, 0).device_name == "caf\ufffd"


def test_what_has_no_header_has_no_raw_message() -> None:
    with pytest.raises(TruncatedMessage):
        raw_message(message()[:57], 0, 0)


@pytest.mark.parametrize(
    "data",
    [
        b"",
        message()[:-1],
        message() + b"\x00",
        message() * 2,
        message()[:-1] + b"T",
        b"\x00\x03" + message()[2:],
        message(2)[:58] + b"\x00" * 12 + message(2)[70:],
    ],
)
def test_what_is_not_one_whole_message_is_refused(data: bytes) -> None:
    raw = raw_message(message(), 0, 0)
    with pytest.raises(ConversionError, match=r"igtl_msgs/msg/RawMessage: .*found .* expected"):
        message_of(RawMessage(0, 0, 0, 0, raw.links, raw.type, raw.device_name, data))
