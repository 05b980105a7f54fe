"""The walk that counts the objects of a message goes where the decoder goes."""

from __future__ import annotations

import struct

import pytest

from igtl_gateway.base.errors import LimitExceeded
from igtl_gateway.base.untrusted import limits
from igtl_gateway.base.untrusted.definitions import parse_definition
from igtl_gateway.base.untrusted.elements import ElementCounter

RULE = "=" * 80 + "\n"
TEXT = f"uint8 a\nfloat64 b\nstring s\nuint16[] n\np/E[2] two\np/E[] e\n{RULE}MSG: p/E\nint8 x\nstring t\n"
TYPES = parse_definition(TEXT, "p/msg/A")


def message(count: int, *, ros1: bool) -> bytes:
    """Padded as CDR is, or not at all; ``1 + 1 + 2 * 2 + 2 * count`` objects."""

    def pad(data: bytes, size: int) -> bytes:
        return data if ros1 else data + bytes(-len(data) % size)

    data = pad(b"\1", 8) + struct.pack("<d", 1) + struct.pack("<I", 3) + b"ab\0"
    data = pad(data, 4) + struct.pack("<I", 1) + b"\1\1"
    for _ in range(2):
        data = pad(data + b"\1", 4) + struct.pack("<I", 1) + b"\0"
    data = pad(data, 4) + struct.pack("<I", count)
    for _ in range(count):
        data = pad(data + b"\1", 4) + struct.pack("<I", 1) + b"\0"
    return data if ros1 else b"\0\1\0\0" + data


@pytest.mark.parametrize("ros1", [True, False])
def test_every_text_and_every_message_counts(ros1: bool) -> None:
    data, objects = message(20, ros1=ros1), 6 + 2 * 20
    one = ElementCounter(TYPES, "p/msg/A", ros1=ros1)
    with limits.limits_in_force(limits.FileLimits(count=objects)):
        one.check(data)
    with (
        limits.limits_in_force(limits.FileLimits(count=objects - 1)),
        pytest.raises(LimitExceeded, match="a message of p/msg/A"),
    ):
        one.check(data)


def test_what_is_not_of_the_type_is_left_to_the_decoder() -> None:
    with limits.limits_in_force(limits.FileLimits(count=1)):
        ElementCounter(parse_definition("string[] x\n", "p/msg/A"), "p/msg/A").check(b"\0\1\0\0\1")
        ElementCounter(parse_definition("uint8[] x\n", "p/msg/A"), "p/msg/A").check(bytes(1000))


def test_messages_of_ros_1_without_fields_have_no_bytes() -> None:
    """2^32 - 1 of them are 4 bytes: the count is all that there is."""
    types = parse_definition(f"uint8 a\np/E[] e\nstring s\n{RULE}MSG: p/E\n", "p/msg/A")
    one = ElementCounter(types, "p/msg/A", ros1=True)
    one.check(b"\1" + struct.pack("<II", 100, 2) + b"ab")
    for count in (200_000, (1 << 32) - 1):
        with pytest.raises(LimitExceeded, match="a message of p/msg/A"):
            one.check(b"\1" + struct.pack("<II", count, 0))
    # in ROS 2 each has a byte
    ElementCounter(types, "p/msg/A").check(b"\0\1\0\0\1\0\0\0" + struct.pack("<I", (1 << 32) - 1))
