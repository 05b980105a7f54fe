"""Columns against entries one by one: sound files, chunks that overlap, and mutants, refused with the same line."""

from __future__ import annotations

import random
from collections.abc import Iterator
from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
from mcap.records import Message

from igtl_gateway.base.errors import DamagedRecording, GatewayError
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.record.sessionfile import chunks, layout, order
from igtl_gateway.record.sessionfile import columns as columns_module
from igtl_gateway.record.sessionfile.columns import (
    END_NS,
    EntryColumns,
    Stream,
    Unfit,
    WireHead,
    in_larger_blocks,
)
from igtl_gateway.record.sessionfile.copying import CopyWriter
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.record.sessionfile.writer import SessionWriter
from tests.places import FIXTURES
from tests.record import samples
from tests.record.sessionfile.test_index import DEFINITIONS, bag, messages
from tests.tables import table
from tools import mcap_mutations
from tools.mcap_build import Chunk

#: Mutants that the gate reads twice.
CASES = 300


def fields(entry: Entry) -> tuple[object, ...]:
    return (
        entry.seq, entry.stamp_ns, entry.kind, entry.channel, entry.type, bytes(entry.data()), entry.links,
        entry.source_ns,
    )  # fmt: skip


def by_columns(file: SessionFile) -> Iterator[tuple[object, ...]]:
    """The fields of all entries: those of messages from the columns, notes from objects."""
    for columns in file.columns():
        yield from fields_of(columns)


def fields_of(columns: EntryColumns) -> list[tuple[object, ...]]:
    wire = columns.wire()
    places = {row: place for place, row in enumerate(wire.rows.tolist())}
    sources = columns.source_times()
    found: list[tuple[object, ...]] = []
    for row in range(len(columns)):
        stream = columns.streams[int(columns.channels[row])]
        number, time_ns = int(columns.numbers[row]), int(columns.times[row])
        if row in places:
            at = places[row]
            head = wire.known[int(wire.heads[at])]
            kind = Kind.IGTL_OUT if wire.outgoing[at] else Kind.IGTL_IN
            data = columns.data[int(wire.begins[at]) : int(wire.ends[at])]
            found.append((number, time_ns, kind, head.channel, head.type, data, head.links, int(wire.source_times[at])))
        elif stream.kind in (Kind.ROS_IN, Kind.ROS_OUT):
            data = bytes(columns.payload(row))
            found.append((number, time_ns, stream.kind, stream.channel, stream.type, data, (), int(sources[row])))
        else:
            found.append(fields(columns.entry(row)))
    return found


def read_both(path: Path) -> tuple[object, object]:
    """Entries and the refusal behind them, as each way finds them."""

    def drained(rows: Iterator[object]) -> tuple[list[object], str]:
        found: list[object] = []
        try:
            found.extend(rows)
        except GatewayError as error:
            return found, f"{type(error).__name__}: {error}"
        return found, ""

    with SessionFile.open(path) as file:
        one = drained(map(fields, file.entries()))
        objects = drained(fields(entry) for columns in file.columns() for entry in columns.entries())
        other = drained(by_columns(file))
    assert objects == one
    if other != one:  # the columns of a chunk with a message that is not as its fields state are not returned
        assert other[1] == one[1] and other[0] == one[0][: len(other[0])] and "entry" in one[1]
    return one


@table("path", sorted(FIXTURES.glob("*.mcap")))
def test_columns_are_the_entries(path: Path) -> None:
    found, why = read_both(path)
    assert found and not why


@table("small", [0, 8 << 20])
@table("seed", range(6))
def test_chunks_that_overlap_or_are_large(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, small: int, seed: int
) -> None:
    for module in (chunks, order):
        monkeypatch.setattr(module, "SMALL_BYTES", small)
        monkeypatch.setattr(module, "BATCH", 7)
    chance = random.Random(seed)
    parts = []
    for _ in range(6):
        stamps = [chance.randrange(0, 60 if seed % 2 else 1000) for _ in range(chance.randrange(1, 30))]
        parts.append(Chunk((*DEFINITIONS, *messages(*stamps)), chance.choice(("", "lz4", "zstd"))))
    (tmp_path / "a.mcap").write_bytes(bag(*parts).finish())
    read_both(tmp_path / "a.mcap")


def test_the_earlier_of_two_faults_in_a_chunk_is_named(tmp_path: Path) -> None:
    """A note that cannot be decoded, and behind it a RawMessage that is not as its fields state."""
    path = tmp_path / "a.mcap"
    with (
        SessionFile.open(FIXTURES / "star.mcap") as file,
        CopyWriter(path, "ros2", "test", dict(file.recorded_session), compression="none") as writer,
    ):
        note = wire = 0
        for at, (schema, channel, row) in enumerate(islice(file.messages(), 100), 1):
            _, sequence, log_ns, publish_ns, begin, end, data = row
            assert schema
            if schema.name == layout.NOTE_TYPE and at > 5 and not note:
                note, end = at, end - 1
            elif schema.name == layout.RAW_MESSAGE_TYPE and note and not wire:
                wire, end = at, end - 1
            writer.write(schema, channel, Message(channel.id, log_ns, data[begin:end], publish_ns, sequence))
        writer.close({})
    assert 0 < note < wire
    with SessionFile.open(path) as file:
        columns = next(file.columns())
        assert len(columns) > wire
        with pytest.raises(DamagedRecording, match=r"entry .*: Note") as refused:
            columns.wire()
        with pytest.raises(DamagedRecording) as expected:
            list(file.entries())
        assert str(refused.value) == str(expected.value)


@pytest.mark.slow
def test_mutants_are_read_or_refused_alike(tmp_path: Path) -> None:
    refused = read = 0
    for name, data in islice(mcap_mutations.cases(52), CASES):
        path = tmp_path / "a.mcap"
        path.write_bytes(data)
        try:
            entries, why = read_both(path)
        except GatewayError:  # already when it is opened
            continue
        except AssertionError as error:
            raise AssertionError(name) from error
        refused, read = refused + bool(why), read + bool(entries)
    assert refused > CASES // 20 and read > CASES // 4


def _written(path: Path, entries: list[Entry], chunk_bytes: int = 1 << 20) -> None:
    writer = SessionWriter(path, samples.SESSION, chunk_bytes=chunk_bytes)
    for entry in entries:
        writer.write(entry)
    writer.close({})


def test_a_window_and_some_streams(tmp_path: Path) -> None:
    path = FIXTURES / "star.mcap"

    def wanted(stream: Stream) -> bool:
        return stream.kind is Kind.IGTL_OUT and stream.type == "TRANSFORM"

    with SessionFile.open(path) as file:
        every = [entry for entry in file.entries() if entry.kind is Kind.IGTL_OUT and entry.type == "TRANSFORM"]
        start_ns, end_ns = every[100].stamp_ns, every[300].stamp_ns
        found = [entry for columns in file.columns(start_ns, end_ns, wanted) for entry in columns.entries()]
        assert [fields(entry) for entry in found] == [fields(entry) for entry in every[100:300]]
        whole = next(file.columns())
        assert whole.complete and whole.chunk is not None and len(whole.data) == whole.chunk.size
        assert not next(file.columns(wanted=wanted)).complete
        mask = whole.of(wanted)
        assert [fields(entry) for entry in whole.where(mask).entries()] == [
            fields(entry) for entry in whole.entries() if entry.kind is Kind.IGTL_OUT and entry.type == "TRANSFORM"
        ]


def test_numbers_go_on_beyond_32_bits(tmp_path: Path) -> None:
    entries = [replace(entry, seq=(1 << 32) - 3 + number) for number, entry in enumerate(samples.every_kind(3))]
    _written(tmp_path / "a.mcap", entries, chunk_bytes=500)
    with SessionFile.open(tmp_path / "a.mcap") as file:
        numbers = np.concatenate([columns.numbers for columns in file.columns()])
        assert numbers.tolist() == [entry.seq for entry in file.entries()] == [entry.seq for entry in entries]


def test_a_number_that_repeats_is_refused_behind_those_before_it(tmp_path: Path) -> None:
    entries = samples.every_kind(2)
    entries[5] = replace(entries[5], seq=entries[4].seq)
    _written(tmp_path / "a.mcap", entries)
    found: list[int] = []
    with SessionFile.open(tmp_path / "a.mcap") as file, pytest.raises(DamagedRecording, match="found entry number"):
        for columns in file.columns():
            found += columns.numbers.tolist()
    assert found == [entry.seq for entry in entries[:5]]


def test_times_after_2262_are_as_they_are(tmp_path: Path) -> None:
    late = Chunk((*DEFINITIONS, *messages(5, 1 << 63)))
    (tmp_path / "a.mcap").write_bytes(bag(late).finish())
    with SessionFile.open(tmp_path / "a.mcap") as file:
        (columns,) = file.columns()
        assert columns.times.tolist() == [5, 1 << 63]
    read_both(tmp_path / "a.mcap")


def test_messages_to_different_links_have_heads_of_their_own(tmp_path: Path) -> None:
    entries = [
        Entry(number, number * 1000, Kind.IGTL_OUT, "STRING/A", "STRING", (bytes(58),), tuple(range(number % 100)))
        for number in range(1, 400)
    ]
    _written(tmp_path / "a.mcap", entries, chunk_bytes=4096)
    with SessionFile.open(tmp_path / "a.mcap") as file:
        wires = [columns.wire() for columns in file.columns(wanted=lambda stream: stream.kind is Kind.IGTL_OUT)]
    found = [wire.known[head].links for wire in wires for head in wire.heads.tolist()]
    assert found == [entry.links for entry in entries]
    assert len(wires[0].known) == 100 and wires[0].known[0] == WireHead("STRING/A", "STRING", (0,))


def test_heads_beyond_those_that_are_learned_are_read_all_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A file in which each message has other links costs no more than in proportion to its size."""
    monkeypatch.setattr(columns_module, "_LEARNED_HEADS", 3)
    kinds, stamps = (Kind.IGTL_OUT, Kind.IGTL_IN), (0, 5, 7_000)
    entries = [
        Entry(n, n * 1000, kinds[n % 2], f"STRING/{n % 2}", "STRING", (bytes(58),), (n % 9,), stamps[n % 3])
        for n in range(1, 400)
    ]
    _written(tmp_path / "a.mcap", entries, chunk_bytes=4096)
    with SessionFile.open(tmp_path / "a.mcap") as file:
        for columns in file.columns():
            wire = columns.wire()
            expected = entries[int(columns.numbers[0]) - 1 :][: len(wire)]
            assert [wire.known[head].links for head in wire.heads.tolist()] == [entry.links for entry in expected]
            assert wire.outgoing.tolist() == [entry.kind is Kind.IGTL_OUT for entry in expected]
            assert wire.source_times.tolist() == [entry.source_ns for entry in expected]
            assert set((wire.ends - wire.begins).tolist()) == {58}
            assert len(wire.known) < 30


def test_a_file_of_an_older_version_is_not_read_in_columns(monkeypatch: pytest.MonkeyPatch) -> None:
    with SessionFile.open(FIXTURES / "star.mcap") as file:
        monkeypatch.setattr(file, "format_version", 0)
        with pytest.raises(Unfit):
            file.columns()


def test_from_a_time_on_or_up_to_one_is_not_a_file_that_lacks_messages(tmp_path: Path) -> None:
    """Only what has all messages has as many as the index counts."""
    _written(tmp_path / "a.mcap", samples.every_kind(20), chunk_bytes=500)
    with SessionFile.open(tmp_path / "a.mcap") as file:
        times = [entry.stamp_ns for entry in file.entries()]
        middle = times[len(times) // 2]

        def count(start_ns: int, end_ns: int) -> int:
            return sum(len(columns) for columns in file.columns(start_ns, end_ns))

        before = sum(time < middle for time in times)
        assert [count(0, END_NS), count(0, middle), count(middle, END_NS)] == [len(times), before, len(times) - before]
        assert [count(times[0], times[-1] + 1), count(times[-1], END_NS), count(0, times[0])] == [len(times), 1, 0]
        file._index.counts[max(file._index.counts)] += 1
        assert count(middle, END_NS) == len(times) - before
        with pytest.raises(DamagedRecording, match=f"{len(times) + 1}"):
            count(0, END_NS)


@pytest.mark.parametrize(("most", "most_bytes"), [(10**6, 1 << 30), (40, 1 << 30), (10**6, 3_000), (1, 1)])
def test_joined_blocks_have_the_same_entries(most: int, most_bytes: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also those of large entries, which are joined with none, and those before damage."""
    monkeypatch.setattr(columns_module, "_LARGE_ENTRIES", 2_000)

    def damaged(blocks: Iterator[EntryColumns]) -> Iterator[EntryColumns]:
        for block in blocks:
            for begin in range(0, len(block), 7):
                part = block.where(slice(begin, begin + 7))
                first, last = int(part.begins.min()), int(part.ends.max())
                yield replace(part, data=part.data[first:last], begins=part.begins - first, ends=part.ends - first)
        raise DamagedRecording("here")

    with SessionFile.open(FIXTURES / "crtk.mcap") as file:
        expected = [row for columns in file.columns() for row in fields_of(columns)]
        blocks = in_larger_blocks(damaged(file.columns()), most, most_bytes)
        found, sizes = [], []
        with pytest.raises(DamagedRecording, match="here"):
            for block in blocks:
                found += fields_of(block)
                sizes.append(len(block))
    assert found == expected
    assert max(sizes) <= max(most, 7)
    assert (max(sizes) > 7) == (most > 7)
