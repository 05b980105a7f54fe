"""The units of a file: each record with what belongs to it, up to the end of the data section or where it is cut."""

from __future__ import annotations

import io

import blake3
from hypothesis import given
from hypothesis import strategies as st

from igtl_gateway.record.sessionfile.units import FoundUnit, data_end, digest_of, has_footer, kind_of, units
from tests.tables import table
from tools import mcap_build as build

MESSAGES = tuple((build.MESSAGE, build.message(1, number, number, number, b"x")) for number in range(3))
PARTS: list[build.Record | build.Chunk] = [
    (build.HEADER, build.header()),
    (build.SCHEMA, build.schema(1, "a", "", b"")),
    (build.CHANNEL, build.channel(1, 1, "/a", "json")),
    *MESSAGES,
    build.Chunk(MESSAGES),
    build.Chunk(MESSAGES[:1], "zstd"),
    (build.ATTACHMENT, build.attachment("a", "", b"abc")),
    (build.METADATA, build.metadata("m", {"a": "b"})),
    (0x99, b"private"),
]
DATA = build.assemble(PARTS).finish()


def found(data: bytes, at: int = 0) -> list[FoundUnit]:
    return list(units(io.BytesIO(data), at, len(data)))


def test_units_cover_the_data_section_and_each_has_what_belongs_to_it() -> None:
    """The magic is of the header, messages in a row are one unit, and an index is of its chunk."""
    all_units = found(DATA)
    assert [kind_of(unit.opcode) for unit in all_units] == [
        "header", "schema", "channel", "messages", "chunk", "chunk", "attachment", "metadata", "record 0x99",
    ]  # fmt: skip
    ends = [0, *(unit.end for unit in all_units)]
    assert [unit.at for unit in all_units] == ends[:-1]
    assert DATA[ends[-1]] == build.DATA_END
    for unit in all_units:
        assert unit.digest == blake3.blake3(DATA[unit.at : unit.end]).digest()


def test_units_from_a_record_on() -> None:
    third = found(DATA)[2]
    assert found(DATA, third.at) == found(DATA)[2:]


@given(st.integers(0, len(DATA)))
def test_a_cut_file_has_the_units_that_are_whole(size: int) -> None:
    """Messages in a row, and a chunk, may have lost their end: what is there of them counts."""
    whole, cut = found(DATA), found(DATA[:size])
    assert len(cut) <= len(whole)
    for unit, original in zip(cut, whole, strict=False):
        assert unit == original or (unit is cut[-1] and (unit.opcode, unit.at) == (original.opcode, original.at))
    assert all(unit.end <= size for unit in cut)
    end = whole[-1].end
    assert (data_end(io.BytesIO(DATA[:size]), whole[1].at, size) == end) == (size >= end + 9 + 4)


def test_a_record_that_states_more_than_the_file_has_ends_the_units() -> None:
    place = found(DATA)[1].at
    for length in (len(DATA), 2**63, 2**64 - 1):
        assert len(found(DATA[: place + 1] + length.to_bytes(8, "little") + DATA[place + 9 :])) == 1
    assert len(found(DATA[:place] + b"\0" + DATA[place + 1 :])) == 1, "no record has the opcode 0"


def test_where_the_data_section_ends() -> None:
    stream, end = io.BytesIO(DATA), found(DATA)[-1].end
    assert data_end(stream, 8, len(DATA)) == end == data_end(stream, end, len(DATA))
    assert data_end(stream, len(DATA), len(DATA)) is None
    assert data_end(stream, 8, end) is None


def test_a_footer_has_room_for_the_magic_behind_it() -> None:
    for size in range(found(DATA)[-1].end, len(DATA) + 1):
        assert has_footer(io.BytesIO(DATA[:size]), 8, size) == (size == len(DATA)), size


@table(
    ("at", "size", "part"),
    [(0, 5, b"01234"), (3, 4, b"3456"), (8, 100, b"89"), (2, 1, b"2"), (50, 5, b""), (0, 0, b"")],
)
def test_digests_of_ranges(at: int, size: int, part: bytes) -> None:
    assert digest_of(io.BytesIO(b"0123456789"), at, size) == blake3.blake3(part).digest()


def test_a_digest_of_more_than_is_read_at_once() -> None:
    data = bytes(range(256)) * 5000
    assert digest_of(io.BytesIO(data), 1, len(data)) == blake3.blake3(data[1:]).digest()
