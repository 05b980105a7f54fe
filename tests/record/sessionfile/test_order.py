"""Messages in order of time, whatever the order and the overlap of chunks, within the limits."""

from __future__ import annotations

import gc
import random
import threading
import tracemalloc
from dataclasses import replace
from io import BytesIO
from pathlib import Path

import pytest
from mcap.reader import make_reader

from igtl_gateway.base.errors import LimitExceeded
from igtl_gateway.base.untrusted import limits
from igtl_gateway.record.sessionfile import chunks, order
from igtl_gateway.record.sessionfile.index import read_index
from igtl_gateway.record.sessionfile.order import message_rows
from igtl_gateway.record.sessionfile.records import Malformed
from tests.record.sessionfile.test_index import DEFINITIONS, bag, messages
from tests.tables import table
from tools import mcap_build as build
from tools.mcap_build import Chunk


def times(data: bytes, from_ns: int = 0) -> list[tuple[int, int]]:
    """Time and sequence of each message."""
    stream = BytesIO(data)
    index = read_index(Path("a"), stream)
    return [(row[2], row[1]) for _, rows in message_rows(stream, index, "a", from_ns) for row in rows or ()]


def by_library(data: bytes, from_ns: int = 0) -> list[tuple[int, int]]:
    found = make_reader(BytesIO(data)).iter_messages(starting_at=from_ns)
    return [(message.log_time, message.sequence) for _, _, message in found]


@table("small", [0, 8 << 20])
@table("seed", range(8))
def test_the_order_is_that_of_the_library(monkeypatch: pytest.MonkeyPatch, small: int, seed: int) -> None:
    for module in (chunks, order):
        monkeypatch.setattr(module, "SMALL_BYTES", small)
    chance = random.Random(seed)
    parts = []
    for _ in range(6):
        stamps = [chance.randrange(0, 60 if seed % 2 else 1000) for _ in range(chance.randrange(1, 30))]
        parts.append(Chunk((*DEFINITIONS, *messages(*stamps)), chance.choice(("", "lz4", "zstd"))))
    data = bag(*parts).finish()
    assert times(data) == by_library(data)
    assert times(data, 30) == by_library(data, 30)


def test_chunks_in_turn_are_not_all_read_at_once() -> None:
    data = bag(*(Chunk((*DEFINITIONS, *messages(at, at))) for at in range(20))).finish()
    stream = BytesIO(data)
    index = read_index(Path("a"), stream)
    found = message_rows(stream, index, "a", is_wanted=lambda chunk: chunk.start_ns == 19)
    assert [rows is None for _, rows in found] == [True] * 19 + [False]


def test_messages_that_nobody_takes_are_given_up_without_a_wait(monkeypatch: pytest.MonkeyPatch) -> None:
    """The garbage collection did it in a thread that just started, under a lock which the wait needs, too."""
    data = bag(*(Chunk((*DEFINITIONS, *messages(at, at))) for at in range(20))).finish()
    stream = BytesIO(data)
    found = message_rows(stream, read_index(Path("a"), stream), "a")
    next(found)
    waits: list[threading.Thread] = []
    monkeypatch.setattr(threading.Thread, "join", waits.append)
    del found
    gc.collect()
    assert waits == []


def test_chunks_that_overlap_are_held_within_the_limit() -> None:
    one = (build.MESSAGE, build.message(1, 1, 5, 5, bytes(3_000_000)))
    last = (build.MESSAGE, build.message(1, 1, 50, 50, b""))
    data = bag(*(Chunk((*DEFINITIONS, one, last), "zstd") for _ in range(10))).finish()
    assert len(times(data)) == 20
    with (
        limits.limits_in_force(replace(limits.current_limits(), free=20_000_000)),
        pytest.raises(LimitExceeded, match="overlap"),
    ):
        times(data)


def test_chunks_that_only_claim_to_overlap_are_not_held_together() -> None:
    one = (build.MESSAGE, build.message(1, 1, 5, 5, bytes(3_000_000)))
    chunk = Chunk((*DEFINITIONS, one), "zstd", start=10, end=20)
    data = bag(*(chunk for _ in range(20))).finish()
    tracemalloc.start()
    assert len(times(data)) == 20
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 15_000_000  # of 60 MB


@table("small", [0, 8 << 20])
@table("tail", [b"\5", b"\5" + bytes(8), build.record(build.MESSAGE, b"", 30), b"\x80" + b"\xff" * 8])
def test_records_that_do_not_fit_their_chunk(monkeypatch: pytest.MonkeyPatch, small: int, tail: bytes) -> None:
    for module in (chunks, order):
        monkeypatch.setattr(module, "SMALL_BYTES", small)
    chunk = Chunk((*DEFINITIONS, *messages(1)))
    plain = chunk.plain() + tail
    data = bag(replace(chunk, packed=plain, size=len(plain), crc=0)).finish()
    with pytest.raises(Malformed, match="expected a whole record"):
        times(data)


def test_a_file_has_no_more_messages_than_bytes() -> None:
    many = Chunk((*DEFINITIONS, *messages(1) * 30_000), "zstd")
    assert len(times(bag(many).finish())) == 30_000  # its message index alone has more bytes
    stripped = build.assemble([(build.HEADER, build.header()), many], message_index=False).finish()
    assert len(stripped) < 20_000
    with pytest.raises(LimitExceeded, match="messages: found 30000, expected at most 20000"):
        times(stripped)
