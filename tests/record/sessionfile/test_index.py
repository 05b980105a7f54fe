"""The index of a file: from its summary, or by a pass over the file; and what neither may claim."""

from __future__ import annotations

import struct
from dataclasses import replace
from functools import cache
from io import BytesIO
from pathlib import Path

import pytest

from igtl_gateway.base.errors import DamagedRecording, LimitExceeded
from igtl_gateway.base.untrusted import limits
from igtl_gateway.record.sessionfile.contents import Index
from igtl_gateway.record.sessionfile.index import read_index
from tests.files import RefusingStream
from tests.tables import table
from tools import mcap_build as build
from tools.mcap_build import Assembly, Chunk, Record

PATH = Path("bag.mcap")

DEFINITIONS: tuple[Record, ...] = (
    (build.SCHEMA, build.schema(1, "std_msgs/msg/Empty", "ros2msg", b"")),
    (build.CHANNEL, build.channel(1, 1, "/a", "cdr")),
)


def messages(*times: int) -> tuple[Record, ...]:
    return tuple((build.MESSAGE, build.message(1, at, time, time, b"payload")) for at, time in enumerate(times))


def bag(*parts: Record | Chunk) -> Assembly:
    return build.assemble([(build.HEADER, build.header("ros2", "test")), *parts])


def index_of(data: bytes) -> Index:
    return read_index(PATH, BytesIO(data))


TWO_CHUNKS = bag(
    Chunk((*DEFINITIONS, *messages(5, 6))),
    Chunk(messages(7, 9), "zstd"),
    (build.ATTACHMENT, build.attachment("a", "text/plain", b"abc")),
    (build.METADATA, build.metadata("m", {"a": "b"})),
)


def test_a_summary_is_taken_as_it_is() -> None:
    found = index_of(TWO_CHUNKS.finish())
    assert not found.scanned
    assert (found.start_ns, found.end_ns, found.counts) == (5, 9, {1: 4})
    assert [(chunk.start_ns, chunk.end_ns, chunk.channels) for chunk in found.chunks] == [(5, 6, [1]), (7, 9, [1])]
    assert [place.name for place in (*found.attachments, *found.metadata)] == ["a", "m"]


@table(
    "missing",
    [
        {build.SCHEMA}, {build.CHANNEL}, {build.SCHEMA, build.CHANNEL}, {build.STATISTICS}, {build.CHUNK_INDEX},
        {build.ATTACHMENT_INDEX}, {build.METADATA_INDEX}, set(range(16)),
    ],
    ids=str,
)  # fmt: skip
@table("crc", [None, 0])
def test_what_a_summary_leaves_out_is_looked_for(missing: set[int], crc: int | None) -> None:
    whole = index_of(TWO_CHUNKS.finish())
    rest = [each for each in TWO_CHUNKS.summary if each[0] not in missing]
    found = index_of(build.finish(TWO_CHUNKS.data, rest, crc=crc))
    assert found.scanned
    assert (found.schemas, found.channels) == (whole.schemas, whole.channels)
    assert (found.start_ns, found.end_ns, found.counts) == (5, 9, {1: 4})
    assert (found.attachments, found.metadata) == (whole.attachments, whole.metadata)
    assert [(chunk.at, chunk.length, chunk.size) for chunk in found.chunks] == [
        (chunk.at, chunk.length, chunk.size) for chunk in whole.chunks
    ]


def test_messages_outside_of_chunks_are_runs() -> None:
    found = index_of(
        bag(*DEFINITIONS, *messages(3, 1), (build.METADATA, build.metadata("m", {})), *messages(2)).finish()
    )
    assert [(chunk.start_ns, chunk.end_ns, chunk.loose) for chunk in found.chunks] == [(1, 3, True), (2, 2, True)]
    assert (found.counts, found.start_ns, found.end_ns) == ({1: 3}, 1, 3)


@pytest.mark.parametrize(
    ("at", "form", "value", "words"),
    [
        (16, "<Q", 0, "found a chunk of [0-9]+ bytes at 0"),
        (16, "<Q", 2**64 - 1, "found a chunk"),
        (24, "<Q", 2**63, "found a chunk of 9223372036854775808 bytes"),
        (24, "<Q", 3, "found a chunk of 3 bytes"),
        (32, "<I", 7, "found 7 bytes of offsets"),
        (32, "<I", 2**32 - 1, "found [0-9]+ bytes at byte 36 of its content"),
    ],
)
def test_a_chunk_index_that_lies_is_damage(at: int, form: str, value: int, words: str) -> None:
    summary = []
    for opcode, content in TWO_CHUNKS.summary:
        bent = bytearray(content)
        if opcode == build.CHUNK_INDEX:
            struct.pack_into(form, bent, at, value)
        summary.append((opcode, bytes(bent)))
    with pytest.raises(DamagedRecording, match=words) as caught:
        index_of(build.finish(TWO_CHUNKS.data, summary))
    assert "igtl-gateway recover bag.mcap" in str(caught.value)


def test_a_chunk_that_is_listed_again_and_again_is_damage() -> None:
    many = [each for each in TWO_CHUNKS.summary for _ in range(50 if each[0] == build.CHUNK_INDEX else 1)]
    counted = [
        (opcode, content[:22] + struct.pack("<I", 100) + content[26:] if opcode == build.STATISTICS else content)
        for opcode, content in many
    ]
    with pytest.raises(DamagedRecording, match="found a chunk at"):
        index_of(build.finish(TWO_CHUNKS.data, counted))


def test_counts_that_contradict_each_other_are_damage() -> None:
    summary = [
        (opcode, struct.pack("<Q", 77) + content[8:] if opcode == build.STATISTICS else content)
        for opcode, content in TWO_CHUNKS.summary
    ]
    with pytest.raises(DamagedRecording, match="found 4 messages by channel, expected 77"):
        index_of(build.finish(TWO_CHUNKS.data, summary))


def test_a_record_that_reaches_beyond_the_data_is_damage() -> None:
    data = bytearray(TWO_CHUNKS.data)
    struct.pack_into("<Q", data, 9, 2**40)
    with pytest.raises(DamagedRecording, match="found a record of 1099511627776 bytes at 8"):
        index_of(build.finish(bytes(data), []))


@cache
def packed_bomb(compression: str) -> tuple[bytes, int]:
    """What a chunk packs, and the size that it has unpacked."""
    plain = Chunk(((0x80, bytes(300_000_000)),), compression).plain()
    return build.COMPRESS[compression](plain), len(plain)


@pytest.mark.slow
@table("compression", ["lz4", "zstd"])
@table("size", [None, 10, 1 << 31, 2**64 - 1])
def test_a_bomb_is_refused_without_an_index_too(compression: str, size: int | None) -> None:
    packed, unpacked = packed_bomb(compression)
    made = bag(Chunk((), compression, packed, unpacked if size is None else size, crc=0))
    with pytest.raises(DamagedRecording):
        index_of(build.finish(made.data, []))


def test_too_many_of_a_sort_are_refused() -> None:
    made = bag(*((build.METADATA, build.metadata("m", {})) for _ in range(30)))
    with (
        limits.limits_in_force(replace(limits.current_limits(), count=20)),
        pytest.raises(LimitExceeded, match="count=20"),
    ):
        index_of(made.finish())


def test_a_pass_over_the_file_must_find_as_many_messages_as_the_summary_has() -> None:
    made = bag(*DEFINITIONS, *messages(5, 6))
    found = build.statistics(3, 1, 1, 0, 0, 0, 5, 6, {1: 3})
    made.summary = [each for each in made.summary if each[0] not in (build.STATISTICS, build.CHANNEL)]
    with pytest.raises(DamagedRecording, match="found 2 messages, expected 3"):
        index_of(replace(made, summary=[*made.summary, (build.STATISTICS, found)]).finish())


def test_a_disk_that_refuses_to_read() -> None:
    with pytest.raises(DamagedRecording, match=r"bag\.mcap: cannot be read: Input/output error"):
        read_index(PATH, RefusingStream(TWO_CHUNKS.finish(), 8))
