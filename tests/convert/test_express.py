"""The compiled conversions of poses: what the full conversion gives, byte by byte, or None; in C and in Python.

Over random poses, and for the CRC: ``tests/native/test_twins.py``.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from typing import Any

import pytest

from igtl_gateway.base.buffers import join
from igtl_gateway.base.stamp import NS_PER_S, ns_to_ticks, ticks_to_ns
from igtl_gateway.convert import express, poses, rosmsg
from igtl_gateway.convert.common_msgs import PoseStamped
from igtl_gateway.convert.context import ToIgtlContext, ToRosContext
from igtl_gateway.convert.express import MATRIX, QUATERNION
from igtl_gateway.wire import HEADER_SIZE, Item, Message, decode, encode
from igtl_gateway.wire.header import crc64
from igtl_gateway.wire.message import EXTENDED_SIZE
from igtl_gateway.wire.transform import Position, Transform

Pair = tuple[Callable[..., Any], Callable[..., Any]]

T0_NS = 1_700_000_000 * NS_PER_S
RECEIVED_NS = T0_NS + 40_000_000
H = math.sqrt(0.5)
TURN = Transform((0.36, 0.48, -0.8, -0.8, 0.6, 0.0, 0.48, 0.64, 0.6, 1.0, 2.0, 3.0))
HALF_TURN = Transform((1.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0, 0.0, -1.0, -1.5, 0.0, 1e-40))
PLACE = Position((4.0, 5.0, 6.0), (0.0, 0.6, 0.0, -0.8))
#: Millimetres to metres and back, as numerator and denominator.
TO_ROS, TO_IGTL = (1.0, 1000.0), (1000.0, 1.0)


@pytest.fixture(
    params=[
        pytest.param(express.PLAIN, id="python"),
        pytest.param(
            (express.pose_to_ros, express.pose_to_igtl),
            id="c",
            marks=pytest.mark.skipif(not express.COMPILED, reason="installed without the C part"),
        ),
    ]
)
def functions(request: pytest.FixtureRequest) -> Pair:
    pair: Pair = request.param
    return pair


# To ROS


def wire(
    content: Transform | Position,
    source_ns: int = T0_NS,
    version: int = 1,
    items: tuple[Item, ...] = (),
    number: int = 0,
) -> bytes:
    name = "TRANSFORM" if isinstance(content, Transform) else "POSITION"
    ticks = ns_to_ticks(source_ns) if source_ns else 0
    return join(encode(Message(name, "Probe", content, ticks, version, number, items)))


def full(content: Transform | Position, stamp_ns: int) -> bytes:
    """By the full path: decoded from the wire, which rounds to float32, and converted."""
    to, received = ToRosContext("Probe", stamp_ns, "igtl", "Probe"), decode(wire(content)).content
    if isinstance(received, Transform):
        return poses.transform_to_ros(received, to).pack()
    assert isinstance(received, Position)
    return poses.position_to_ros(received, to).pack()


def filled(
    function: Callable[..., Any], data: object, sample: bytes, *, own: bool = True, check_crc: bool = True
) -> tuple[Any, ...] | None:
    """``data`` after ``sample``, on its way to one topic."""
    size = MATRIX if sample[2:11] == b"TRANSFORM" else QUATERNION
    at = HEADER_SIZE + (EXTENDED_SIZE if sample[1] == 2 else 0)
    template = full(TURN, T0_NS)
    made: tuple[Any, ...] | None = function(
        data, sample, at, size, check_crc, own, RECEIVED_NS, TO_ROS, ((template, 4),)
    )
    return made


@pytest.mark.parametrize("version", [1, 2])
@pytest.mark.parametrize("content", [TURN, HALF_TURN, PLACE])
def test_to_ros_it_is_the_full_conversion(functions: Pair, content: Transform | Position, version: int) -> None:
    sample = wire(TURN if isinstance(content, Transform) else PLACE, version=version, number=1)
    data = wire(content, T0_NS + 123_456_789, version, number=2)
    source_ns = ticks_to_ns(ns_to_ticks(T0_NS + 123_456_789))
    assert filled(functions[0], data, sample) == (source_ns, source_ns, full(content, source_ns))
    assert filled(functions[0], data, sample, own=False) == (source_ns, RECEIVED_NS, full(content, RECEIVED_NS))


def test_a_stamp_of_zero_is_unset(functions: Pair) -> None:
    made = filled(functions[0], wire(TURN, 0), wire(TURN))
    assert made == (0, RECEIVED_NS, full(TURN, RECEIVED_NS))


def with_crc(data: bytes) -> bytes:
    return data[:50] + struct.pack(">Q", crc64(data[HEADER_SIZE:])) + data[HEADER_SIZE:]


def changed(data: bytes, at: int) -> bytes:
    """One bit of one byte is another, and the CRC fits."""
    return with_crc(data[:at] + bytes([data[at] ^ 1]) + data[at + 1 :])


def scaled(factor: float) -> Transform:
    return Transform((*(factor * value for value in TURN.wire_matrix[:9]), 0.0, 0.0, 0.0))


@pytest.mark.parametrize(
    "data",
    [
        bytearray(wire(TURN)),
        wire(TURN) + b"\0",
        changed(wire(TURN), 14),
        changed(wire(TURN), 49),
        wire(TURN)[:50] + b"no CRC !" + wire(TURN)[HEADER_SIZE:],
        wire(Transform((*TURN.wire_matrix[:9], math.nan, 0.0, 0.0))),
        wire(Transform((*TURN.wire_matrix[:9], 0.0, -math.inf, 0.0))),
        wire(scaled(1.01)),
        wire(scaled(-1.0)),
    ],
    ids=["no bytes", "longer", "name", "size", "CRC", "nan", "inf", "scale", "reflection"],
)
def test_to_ros_what_the_full_path_must_judge_is_left_to_it(functions: Pair, data: object) -> None:
    assert filled(functions[0], data, wire(TURN)) is None


@pytest.mark.parametrize("quaternion", [(0.0,) * 4, (math.nan, 0.0, 0.0, 1.0)])
def test_a_position_without_a_rotation_is_left_to_it(functions: Pair, quaternion: tuple[float, ...]) -> None:
    data = wire(Position((1.0, 2.0, 3.0), quaternion))
    assert filled(functions[0], data, wire(PLACE)) is None


def test_other_metadata_and_another_extended_header_are_left_to_it(functions: Pair) -> None:
    sample = wire(TURN, version=2, items=(Item("key", b"one"),))
    assert filled(functions[0], sample, sample) is not None
    assert filled(functions[0], wire(TURN, version=2, items=(Item("key", b"two"),)), sample) is None
    assert filled(functions[0], changed(sample, HEADER_SIZE + 3), sample) is None


def test_a_wrong_crc_is_seen_only_where_it_is_looked_at(functions: Pair) -> None:
    data = wire(TURN)[:50] + bytes(8) + wire(TURN)[HEADER_SIZE:]
    assert filled(functions[0], data, wire(TURN)) is None
    made = filled(functions[0], data, wire(TURN), check_crc=False)
    assert made is not None and made[2:] == (full(TURN, T0_NS),)


# To OpenIGTLink

HEADER = rosmsg.Header(T0_NS, "base")
ROTATION = (0.0, 0.0, 0.6, 0.8)
TOOL = rosmsg.TransformStamped(HEADER, "tool", (0.1, 0.2, 0.3), ROTATION)
POSE = PoseStamped(HEADER, (0.1, 0.2, 0.3, *ROTATION))
SENT = Position((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))


def tool(position: tuple[float, float, float], rotation: tuple[float, ...] = ROTATION, stamp_ns: int = T0_NS) -> bytes:
    header = rosmsg.Header(stamp_ns, "base")
    return rosmsg.TransformStamped(header, "tool", position, rotation).pack()  # type: ignore[arg-type]


def sent(
    function: Callable[..., Any],
    cdr: object,
    *,
    size: int = MATRIX,
    items: tuple[Item, ...] | None = None,
    digits: int | None = None,
    own: bool = True,
    source_ns: int = 0,
) -> tuple[Any, ...] | None:
    """``cdr`` after ``TOOL``, on its way to peers of header version 1, or with metadata ``items`` of version 2."""
    content: Any = TURN if size == MATRIX else SENT
    template = wire(content, 1, 1 if items is None else 2, items or ())
    at = HEADER_SIZE + (0 if items is None else EXTENDED_SIZE)
    digits_at = digits if digits is not None else (template.index(b"1" * 19) if items else 0)
    first_end = 12 + 4 + len("base") + 1
    second = first_end + -first_end % 4
    names = (first_end, second, second + 4 + len("tool") + 1)
    made: tuple[Any, ...] | None = function(
        cdr, TOOL.pack(), names, size, own, source_ns, RECEIVED_NS, TO_IGTL, ((template, at, digits_at),)
    )
    return made


def by_the_full_path(cdr: bytes, size: int, stamp_ns: int, items: tuple[Item, ...] | None = None) -> bytes:
    convert = poses.transform_to_igtl if size == MATRIX else poses.position_to_igtl
    content: Any = convert(rosmsg.TransformStamped.unpack(cdr), ToIgtlContext()).content
    return wire(content, stamp_ns, 1 if items is None else 2, items or ())


@pytest.mark.parametrize("size", [MATRIX, QUATERNION])
def test_to_igtl_it_is_the_full_conversion(functions: Pair, size: int) -> None:
    cdr = tool((1.0, -2.0, 0.5), (H, 0.0, -H, 0.0), T0_NS + 7)
    assert sent(functions[1], cdr, size=size) == (T0_NS + 7, by_the_full_path(cdr, size, T0_NS + 7))


@pytest.mark.parametrize(
    ("header_ns", "source_ns", "own", "expected_ns"),
    [
        (T0_NS, 5, True, T0_NS),
        (0, T0_NS + 5, True, T0_NS + 5),
        (0, 0, True, RECEIVED_NS),
        (T0_NS, 5, False, RECEIVED_NS),
    ],
)
def test_whose_stamp_is_sent(functions: Pair, header_ns: int, source_ns: int, own: bool, expected_ns: int) -> None:
    cdr = tool((0.0, 0.0, 0.0), stamp_ns=header_ns)
    made = sent(functions[1], cdr, own=own, source_ns=source_ns)
    assert made == (expected_ns, by_the_full_path(cdr, MATRIX, expected_ns))


def test_the_digits_of_the_stamp_stand_in_the_metadata(functions: Pair) -> None:
    cdr = tool((1.0, 2.0, 3.0), stamp_ns=T0_NS + 9)
    made = sent(functions[1], cdr, items=(Item("ros_stamp", b"1" * 19),))
    assert made == (
        T0_NS + 9,
        by_the_full_path(cdr, MATRIX, T0_NS + 9, (Item("ros_stamp", b"%d" % (T0_NS + 9)),)),
    )


@pytest.mark.parametrize(("own", "source_ns"), [(True, T0_NS + 9), (True, 0), (False, T0_NS + 9)])
@pytest.mark.parametrize("size", [MATRIX, QUATERNION])
def test_without_a_stamp_of_ros_the_digits_may_be_those_of_the_message(
    functions: Pair, size: int, own: bool, source_ns: int
) -> None:
    cdr, one = tool((1.0, 2.0, 3.0), stamp_ns=0), (Item("ros.stamp", b"1" * 19),)
    at = wire(TURN if size == MATRIX else SENT, 1, 2, one).index(b"1" * 19)
    made = sent(functions[1], cdr, size=size, items=one, digits=-at, own=own, source_ns=source_ns)
    shown_ns = source_ns if own and source_ns else RECEIVED_NS
    assert made == (shown_ns, by_the_full_path(cdr, size, shown_ns, (Item("ros.stamp", b"%d" % shown_ns),)))
    assert sent(functions[1], cdr, size=size, items=one, digits=-at, source_ns=999) is None
    assert sent(functions[1], tool((1.0, 2.0, 3.0)), size=size, items=one, digits=-at) is None


@pytest.mark.parametrize(("header_ns", "digits"), [(999, None), (0, None), (T0_NS, -1)])
def test_metadata_of_another_size_are_left_to_the_full_path(
    functions: Pair, header_ns: int, digits: int | None
) -> None:
    """A stamp with fewer digits, or one where the template has none, or none where it has one."""
    cdr = tool((1.0, 2.0, 3.0), stamp_ns=header_ns)
    assert sent(functions[1], cdr, items=(Item("ros_stamp", b"1" * 19),), digits=digits) is None


def test_metadata_without_a_stamp_stay(functions: Pair) -> None:
    cdr, items = tool((1.0, 2.0, 3.0), stamp_ns=0), (Item("key", b"value"),)
    made = sent(functions[1], cdr, items=items, digits=-1)
    assert made == (RECEIVED_NS, by_the_full_path(cdr, MATRIX, RECEIVED_NS, items))


@pytest.mark.parametrize(
    "cdr",
    [
        memoryview(TOOL.pack()),
        TOOL.pack() + b"\0",
        b"\x00\x00" + TOOL.pack()[2:],
        TOOL.pack().replace(b"base", b"Base"),
        TOOL.pack().replace(b"tool", b"Tool"),
        tool((0.0, math.nan, 0.0)),
        tool((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, math.inf)),
        tool((0.0, 0.0, 3.5e35)),
        tool((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0)),
    ],
    ids=["no bytes", "longer", "byte order", "frame", "child", "nan", "inf", "beyond float32", "no rotation"],
)
def test_to_igtl_what_the_full_path_must_judge_is_left_to_it(functions: Pair, cdr: object) -> None:
    assert sent(functions[1], cdr) is None


def test_padding_between_the_names_is_not_compared(functions: Pair) -> None:
    """Senders leave it as it was in their memory."""
    cdr = bytearray(tool((1.0, 2.0, 3.0)))
    at = 12 + 4 + len("base") + 1
    assert not any(cdr[at : at + 3])
    cdr[at : at + 3] = b"\xaa\xbb\xcc"
    assert sent(functions[1], bytes(cdr)) == sent(functions[1], tool((1.0, 2.0, 3.0)))
