"""Chunks: what is compressed and what is not, where large messages lie, and what the library reads of it."""

from __future__ import annotations

import random
from io import BytesIO
from itertools import groupby

import pytest
from mcap.reader import make_reader
from mcap.records import ChunkIndex

from igtl_gateway.record.sessionfile.compression import Compression
from igtl_gateway.record.sessionfile.stream import McapStream

CHUNK_BYTES = 4096
LARGE = 1024
_CHANCE = random.Random(1)
NOISE, SAME = _CHANCE.randbytes(2 * LARGE), bytes(2 * LARGE)


def chunks(messages: list[tuple[int, bytes]], compression: Compression) -> list[ChunkIndex]:
    """Of a file of these messages (channel, data), which the library reads as they are."""
    file = BytesIO()
    stream = McapStream(file, chunk_bytes=CHUNK_BYTES, compression=compression)
    stream.start("", "")
    schema = stream.register_schema("S", "", b"")
    for number in range(1, 3):
        assert stream.register_channel(f"/{number}", "cdr", schema, {}) == number
    for number, (channel, data) in enumerate(messages):
        given = bytearray(data)
        stream.add_message(channel, 100 + number, b"", memoryview(given), 5, number)
        given[:] = bytes(len(given))  # the caller may do with it what he likes
    stream.finish()
    assert stream.size == len(file.getvalue())
    file.seek(0)
    read = [
        (channel.id, bytes(message.data), message.log_time - 100, message.sequence)
        for _, channel, message in make_reader(file, validate_crcs=True).iter_messages(log_time_order=False)
    ]
    assert read == [(*message, number, number) for number, message in enumerate(messages)]
    file.seek(0)
    summary = make_reader(file).get_summary()
    assert summary and summary.statistics
    assert summary.statistics.message_count == len(messages)
    return summary.chunk_indexes


def runs(found: list[ChunkIndex]) -> list[tuple[str, int]]:
    return [(name, len(list(each))) for name, each in groupby(chunk.compression for chunk in found)]


def test_lz4_rests_where_it_gains_nothing_and_tries_again() -> None:
    found = chunks([(1, NOISE)] * 40 + [(1, SAME)] * 40, "lz4")
    # one in 32 is tried: the first of those that get smaller is not seen at once
    assert runs(found) == [("", 67), ("lz4", 13)]


def test_a_stream_that_gains_now_and_then_is_always_tried() -> None:
    found = chunks([(1, NOISE), (1, NOISE), (1, NOISE), (1, SAME)] * 20, "lz4")
    assert runs(found) == [("", 3), ("lz4", 1)] * 20


def test_each_stream_rests_for_itself() -> None:
    found = chunks([(1, NOISE), (2, SAME)] * 20, "lz4")
    assert runs(found) == [("", 1), ("lz4", 1)] * 20


def test_a_large_message_ends_its_chunk_but_not_for_zstd() -> None:
    messages = [(2, b"small"), (1, NOISE), (1, NOISE)]
    assert [len(chunks(messages, compression)) for compression in ("none", "lz4", "zstd")] == [2, 2, 1]


@pytest.mark.parametrize("compression", ["none", "lz4", "zstd"])
def test_any_sizes(compression: Compression) -> None:
    chance = random.Random(2)
    sizes = (0, 1, 30, 300, LARGE - 1, LARGE, CHUNK_BYTES, 3 * CHUNK_BYTES)
    chunks([(chance.randint(1, 2), chance.randbytes(chance.choice(sizes))) for _ in range(300)], compression)
    assert chunks([], compression) == []
