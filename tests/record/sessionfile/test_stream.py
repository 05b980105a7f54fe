"""Chunks: what is compressed and what is not, where large messages lie, and what the library reads of it."""

from __future__ import annotations

import random
from io import BytesIO
from itertools import groupby

import pytest
from mcap.reader import make_reader
from mcap.records import ChunkIndex

from igtl_gateway.base.stamp import NS_PER_S
from igtl_gateway.record.sessionfile.compression import Compression
from igtl_gateway.record.sessionfile.stream import McapStream
from tests.tables import table

CHUNK_BYTES = 4096
LARGE = 1024
_CHANCE = random.Random(1)
NOISE, SAME = _CHANCE.randbytes(2 * LARGE), bytes(2 * LARGE)


def chunks(
    messages: list[tuple[int, bytes]],
    compression: Compression,
    step_ns: int = 100_000_000,
    of_one: int = 1,
    cut: int = 0,
) -> list[ChunkIndex]:
    """Of a file of these messages (channel, data), which the library reads as they are.

    Inputs are ``step_ns`` apart; each with its outputs is ``of_one`` messages, a nanosecond apart.  The file is flushed
    before message ``cut``.
    """
    file = BytesIO()
    stream = McapStream(file, chunk_bytes=CHUNK_BYTES, compression=compression, together=True)
    stream.start("", "")
    schema = stream.register_schema("S", "", b"")
    for number in range(1, 4):
        assert stream.register_channel(f"/{number}", "cdr", schema, {}) == number
    for number, (channel, data) in enumerate(messages):
        given = bytearray(data)
        if number == cut:
            stream.flush()
        log_time = number // of_one * step_ns + number % of_one
        stream.add_message(channel, log_time, b"", memoryview(given), 5, number)
        given[:] = bytes(len(given))  # the caller may do with it what he likes
    stream.finish()
    assert stream.size == len(file.getvalue())
    file.seek(0)
    read = [
        (channel.id, bytes(message.data), message.log_time, message.sequence)
        for _, channel, message in make_reader(file, validate_crcs=True).iter_messages(log_time_order=False)
    ]
    times = [number // of_one * step_ns + number % of_one for number in range(len(messages))]
    assert read == [(*message, times[number], number) for number, message in enumerate(messages)]
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
    found: list[Compression] = ["none", "lz4", "zstd", "auto"]
    assert [len(chunks(messages, compression)) for compression in found] == [2, 2, 1, 1]


def noise() -> bytes:
    return _CHANCE.randbytes(2 * LARGE)


@table(("compression", "outputs"), [(name, count) for name in ("auto", "zstd") for count in (1, 2)])
def test_of_an_input_and_its_equal_outputs_one_remains(compression: Compression, outputs: int) -> None:
    """Also if the file is flushed between them: the next chunks begin with an input again."""
    of_one = 1 + outputs
    pictures = [noise() for _ in range(200)]
    messages = [(channel, each) for each in pictures for channel in range(1, of_one + 1)]
    found = chunks(messages, compression, of_one=of_one, cut=7)
    assert {each.compression for each in found[5:]} == {"zstd"}
    assert sum(each.compressed_size for each in found) < 1.1 * sum(map(len, pictures))
    assert all(each.message_start_time % 100_000_000 == 0 for each in found[5:]), "a chunk begins with an input"


@table("compression", ["auto", "zstd"])
def test_what_becomes_a_quarter_smaller_is_compressed_and_what_does_not_is_not(compression: Compression) -> None:
    """Few levels without any repetition: only the slower level of zstd makes them smaller (entropy: 4.6 of 8 bits)."""
    levels = [(1, bytes(_CHANCE.choices(range(24), k=2 * LARGE))) for _ in range(99)]
    found = chunks(levels, compression)
    assert {each.compression for each in found} == {"zstd"}
    assert sum(each.compressed_size for each in found) < 0.75 * 99 * 2 * LARGE
    assert "zstd" not in dict(runs(chunks([(1, noise()) for _ in range(33)], compression)))


def test_a_stream_is_stored_as_it_is_until_it_shrinks() -> None:
    found = chunks([(1, noise()) for _ in range(40)] + [(2, b"small")] + [(1, SAME)] * 40, "auto")
    assert found[0].compression == ""
    assert found[-1].compression == "zstd"


def test_beside_a_stream_that_shrinks_another_one_costs_no_more_than_itself() -> None:
    found = chunks([each for _ in range(64) for each in ((1, noise()), (2, SAME), (3, b"small"))], "auto")
    assert sum(each.compressed_size for each in found) < 1.1 * 64 * 2 * LARGE


def test_auto_has_no_time_for_zstd_where_too_much_comes() -> None:
    pictures = [(1, SAME)] * 40
    assert {each.compression for each in chunks(pictures, "auto", step_ns=100_000_000)} == {"zstd"}
    few_ns = NS_PER_S * 2 * LARGE // 80_000_000  # 80 MB a second
    found = chunks([(1, SAME)] * 45_000, "auto", step_ns=few_ns)
    assert runs(found)[-1][0] == "lz4"


def test_equal_entries_give_equal_files() -> None:
    messages = [(number % 3 + 1, noise() if number % 2 else SAME) for number in range(200)]
    assert chunks(messages, "auto") == chunks(messages, "auto")


@pytest.mark.parametrize("compression", ["none", "lz4", "zstd", "auto"])
def test_any_sizes(compression: Compression) -> None:
    chance = random.Random(2)
    sizes = (0, 1, 30, 300, LARGE - 1, LARGE, CHUNK_BYTES, 3 * CHUNK_BYTES)
    chunks([(chance.randint(1, 2), chance.randbytes(chance.choice(sizes))) for _ in range(300)], compression)
    assert chunks([], compression) == []
