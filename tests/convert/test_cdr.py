"""CDR: alignment from behind the encapsulation header, zero padding, both byte orders, broken bytes."""

from __future__ import annotations

import struct
import sys
import threading
import time
import tracemalloc

import numpy as np
import pytest

from igtl_gateway.base.buffers import MANY_BYTES, Buffer, join, join_in_steps
from igtl_gateway.base.errors import ConversionError
from igtl_gateway.convert.cdr import CdrReader, CdrWriter
from igtl_gateway.convert.express import COMPILED
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.native.joining import join_parts

LITTLE, BIG = b"\x00\x01\x00\x00", b"\x00\x00\x00\x00"


def test_golden_bytes() -> None:
    out = CdrWriter()
    out.u8(7)
    out.string("ab")
    out.f64s(1.0)
    out.bool(True)
    out.i32(-1)
    out.sequence(np.array([1, 2], ">u2"), 2, 2)
    out.octets(b"xyz")
    assert out.finish() == (
        LITTLE
        + b"\x07\0\0\0" + b"\3\0\0\0ab\0"  # 1, padding, length with NUL
        + b"\0" * 5 + struct.pack("<d", 1.0)  # aligned to 8 behind the encapsulation
        + b"\1\0\0\0" + b"\xff" * 4
        + b"\2\0\0\0" + b"\1\0\2\0"
        + b"\3\0\0\0xyz"
    )  # fmt: skip


def test_many_bytes_are_the_same_in_any_way() -> None:
    parts: list[Buffer] = [b"\0" * 3, memoryview(bytes(range(256)) * (MANY_BYTES >> 8)), b"", bytearray(b"end")]
    assert (join_parts or join)(parts) == join_in_steps(parts) == b"".join(parts)
    entry = Entry(1, 1, Kind.ROS_OUT, payload=tuple(parts))
    assert entry.data() == b"".join(parts)


@pytest.mark.skipif(not COMPILED, reason="without the C part, bytes are joined in steps, by one thread at a time")
def test_other_threads_run_while_many_bytes_are_joined() -> None:
    """No thread is made to give the interpreter up here: only who does not need it gives others a turn."""
    out, turns, ends = CdrWriter(), [0], threading.Event()
    out.octets(bytes(16 * MANY_BYTES))

    def run() -> None:
        while not ends.is_set():
            turns[0] += 1
            time.sleep(0)

    other, interval = threading.Thread(target=run), sys.getswitchinterval()
    other.start()
    sys.setswitchinterval(1000)
    try:
        before = turns[0]
        out.finish()
        after = turns[0]
    finally:
        sys.setswitchinterval(interval)
        ends.set()
        other.join()
    assert after > before


def test_an_empty_sequence_needs_no_alignment() -> None:
    out = CdrWriter()
    out.sequence(np.empty((0, 3)), 8, 0)
    out.u8(1)
    assert out.finish() == LITTLE + b"\0\0\0\0\1"
    read = CdrReader(LITTLE + b"\0\0\0\0\1", "t")
    assert read.sequence("f8", 3, 8).shape == (0,)
    assert read.u8() == 1


@pytest.mark.parametrize("order", ["<", ">"])
def test_both_byte_orders(order: str) -> None:
    data = (LITTLE if order == "<" else BIG) + struct.pack(f"{order}i4xd", -5, 2.5)
    read = CdrReader(data, "t")
    assert (read.i32(), read.array("f8", 1, 8)[0]) == (-5, 2.5)


def test_arrays_and_octets_are_views() -> None:
    out = CdrWriter()
    out.sequence(np.arange(6.0), 8, 2)
    out.octets(b"abc")
    data = np.frombuffer(out.finish(), np.uint8)
    read = CdrReader(data.data, "t")
    assert np.shares_memory(read.sequence("f8", 3, 8), data)
    assert np.shares_memory(np.frombuffer(read.octets(), np.uint8), data)


@pytest.mark.parametrize("head", [b"", b"\0\1", b"\1\0\0\0", b"\0\2\0\0", b"\0\7\0\0", b"\xff" * 4])
def test_encapsulations_that_are_not_cdr(head: bytes) -> None:
    with pytest.raises(ConversionError, match="encapsulation"):
        CdrReader(head, "t")


def test_ends_too_early() -> None:
    for size in range(4):
        with pytest.raises(ConversionError, match="ends at byte"):
            CdrReader(LITTLE + bytes(size), "t").u32()


@pytest.mark.parametrize("count", [0x7FFFFFFF, 0x80000000, 0xFFFFFFFF])
def test_lying_lengths(count: int) -> None:
    data = LITTLE + struct.pack("<I", count) + bytes(60)
    tracemalloc.start()
    for call in (
        lambda: CdrReader(data, "t").octets(),
        lambda: CdrReader(data, "t").string(),
        lambda: CdrReader(data, "t").sequence("f8", 3, 8),
        lambda: CdrReader(data, "t").sequence("u1", 1, 1),
        lambda: CdrReader(data, "t").count(),
    ):
        with pytest.raises(ConversionError):
            call()
    assert tracemalloc.get_traced_memory()[1] < 100_000
    tracemalloc.stop()


@pytest.mark.parametrize("text", ["", "plain", "é€😀", "\udcff invalid UTF-8"])
def test_strings(text: str) -> None:
    out = CdrWriter()
    out.string(text)
    assert CdrReader(out.finish(), "t").string() == text


def test_a_string_without_its_nul() -> None:
    """Some writers leave it out; an announced length of 0 is an empty string."""
    assert CdrReader(LITTLE + b"\2\0\0\0ab", "t").string() == "ab"
    assert CdrReader(LITTLE + b"\0\0\0\0", "t").string() == ""
