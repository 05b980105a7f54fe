"""Seals of a file while it is written: the chain of units, the end of the file, the parts of a recording."""

from __future__ import annotations

import hashlib
from pathlib import Path

import blake3
import pytest

from igtl_gateway.record.seal.envelope import parse as parse_envelope
from igtl_gateway.record.seal.keys import SigningKey, verifies
from igtl_gateway.record.seal.statement import NO_HEAD, EndOfFile, PartPlace, Statement, UnitRow, head_after, parse
from igtl_gateway.record.sessionfile import records
from igtl_gateway.record.sessionfile.layout import SEAL_METADATA
from igtl_gateway.record.sessionfile.records import HEAD
from igtl_gateway.record.sessionfile.sealing import (
    ENVELOPE_KEY,
    MOST_UNITS,
    SEAL,
    Sealer,
    SealSeries,
    entry_numbers,
)
from tests.tables import table
from tools import mcap_build as build

KEY = SigningKey.generate()
PLACE = PartPlace("0" * 32)


def sealer(*times_ns: int) -> Sealer:
    clock = iter(times_ns or range(100))
    return Sealer(KEY, "a.mcap", lambda: next(clock), PLACE)


def statement_of(record: bytes) -> Statement:
    """What a seal states; its signature must be that of the key."""
    opcode, length = HEAD.unpack_from(record)
    assert (opcode, length) == (records.METADATA, len(record) - HEAD.size)
    metadata = records.parse_metadata(record[HEAD.size :])
    assert metadata.name == SEAL_METADATA and list(metadata.metadata) == [ENVELOPE_KEY]
    envelope = parse_envelope(metadata.metadata[ENVELOPE_KEY], "seal")
    assert verifies(envelope, KEY.public)
    return parse(envelope, "seal")


def test_a_seal_covers_the_units_since_the_one_before_it_and_that_one() -> None:
    one = sealer(7, 8)
    states = [(len(one), bool(one), one.is_due)]
    one.update(b"head")
    one.update(memoryview(b"er"))
    one.end_unit("header")
    one.update(b"chunk")
    one.end_unit("chunk", 3, 9)
    states.append((len(one), bool(one), one.is_due))
    record = one.seal()
    first = statement_of(record)
    units = (
        UnitRow("header", 6, blake3.blake3(b"header").digest()),
        UnitRow("chunk", 5, blake3.blake3(b"chunk").digest(), 3, 9),
    )
    assert first == Statement(
        "a.mcap", PLACE, 0, 0, 11, NO_HEAD, head_after(NO_HEAD, units), units, 7, KEY.public, (), None
    )
    assert [*states, (len(one), bool(one), one.is_due)] == [(0, True, False), (2, True, True), (0, True, False)]

    one.update(record)
    one.end_unit(SEAL)
    due = [one.is_due]
    one.add(UnitRow("metadata", 4, b"\5" * 32))
    assert [*due, one.is_due] == [False, True], "a seal alone needs no other one"
    second = statement_of(one.seal())
    assert (second.checkpoint, second.start, second.end) == (1, 11, 11 + len(record) + 4)
    assert second.head_before == first.head and second.time_ns == 8
    assert [unit.kind for unit in second.units] == [SEAL, "metadata"]


def test_a_seal_is_full_with_as_many_units_as_a_reader_takes() -> None:
    one = sealer()
    for number in range(MOST_UNITS):
        assert not one.is_full, number
        one.add(UnitRow("chunk", 1, b"\1" * 32))
    assert one.is_full and MOST_UNITS == 1024


def test_the_last_seal_covers_what_follows_it() -> None:
    """What follows states offsets behind the seal: its length is known before its content."""
    one = sealer(7)
    one.update(b"header")
    one.end_unit("header")
    lengths: list[int] = []

    def end(length: int) -> bytes:
        lengths.append(length)
        return b"end of the file at %06d" % length

    record, rest = one.last_seal(end, last_part=True)
    assert rest == b"end of the file at %06d" % len(record) and lengths[-1] == len(record)
    stated = statement_of(record)
    assert stated.end_of_file == EndOfFile(len(rest), blake3.blake3(rest).digest(), True)
    assert stated.time_ns == 7, "one moment, although it is signed twice"
    assert one.last_digest == hashlib.sha256(record).hexdigest()


def test_a_part_that_others_follow_states_so() -> None:
    record, _ = sealer(7).last_seal(lambda _length: b"x", last_part=False)
    assert statement_of(record).end_of_file == EndOfFile(1, blake3.blake3(b"x").digest(), False)


def test_parts_continue_each_other_and_another_recording_does_not() -> None:
    series = SealSeries(KEY, lambda: 5)
    first = series.next_file(Path("folder/a_0.mcap"))
    series.has_begun(first)
    assert series.next_file(Path("folder/a_1.mcap")).part.number == 0, "the one before has no end"
    record, _ = first.last_seal(lambda _length: b"", last_part=False)
    series.next_file(Path("folder/a_1.mcap"))  # which the disk refuses
    second = series.next_file(Path("folder/a_1.mcap"))
    assert (first.part.number, first.part.previous, len(first.part.recording)) == (0, "", 32)
    assert second.part == PartPlace(first.part.recording, 1, hashlib.sha256(record).hexdigest())
    assert statement_of(record).name == "a_0.mcap"
    alone = series.next_file(Path("b.mcap"), alone=True)
    assert alone.part.number == 0 and alone.part.previous == "" and alone.part.recording != first.part.recording
    assert SealSeries(KEY, lambda: 5).next_file(Path("a")).part.recording != first.part.recording


def chunk(*messages: tuple[int, int]) -> tuple[bytes, bytes, tuple[tuple[int, int, int], ...]]:
    """Records, message indexes and their rows, of messages (channel, number)."""
    made = build.Chunk(
        tuple((build.MESSAGE, build.message(channel, number, number, number, b"x")) for channel, number in messages)
    )
    index, rows = b"", []
    for channel, pairs in made.indexes().items():
        packed = b"".join(time.to_bytes(8, "little") + at.to_bytes(8, "little") for time, at in pairs)
        rows.append((channel, len(index), len(pairs)))
        index += build.record(build.MESSAGE_INDEX, channel.to_bytes(2, "little") + build.array(packed))
    return made.plain(), index, tuple(rows)


@table(
    ("messages", "numbers"),
    [
        ([(1, 5)], (5, 5)),
        ([(1, 5), (1, 6), (1, 9)], (5, 9)),
        ([(2, 5), (1, 6), (2, 7)], (5, 7)),
        ([(1, 5), (2, 6), (3, 2**32 - 1)], (5, 2**32 - 1)),
    ],
)
def test_entry_numbers_of_a_chunk(messages: list[tuple[int, int]], numbers: tuple[int, int]) -> None:
    assert entry_numbers(*chunk(*messages)) == numbers


def test_entry_numbers_need_the_head_of_the_last_message_only() -> None:
    plain, index, rows = chunk((1, 5), (1, 6))
    assert entry_numbers(plain[:-1], index, rows) == (5, 6)
    with pytest.raises(AssertionError):
        entry_numbers(b"\0" + plain[1:], index, rows)
