"""A merged session that is written in columns is that of its messages, one after the other in order of time."""

from __future__ import annotations

import errno
import heapq
import json
import math
import random
from collections.abc import Iterator, Sequence
from dataclasses import replace
from io import BufferedWriter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.records import Channel, Schema

from igtl_gateway.addons.merge import merging, writer
from igtl_gateway.addons.merge.clock_graph import Clock
from igtl_gateway.addons.merge.offsets import ClockOffset, Piece
from igtl_gateway.addons.merge.writer import MergedPart, write_merged
from igtl_gateway.base.errors import GatewayError, RecordingError
from igtl_gateway.base.version import __version__
from igtl_gateway.gateway.log.entry import Entry
from igtl_gateway.record.sessionfile import chunk_rows, layout, merged, stream
from igtl_gateway.record.sessionfile.channels import SEQUENCES
from igtl_gateway.record.sessionfile.chunk_columns import Row
from igtl_gateway.record.sessionfile.merged import Method
from igtl_gateway.record.sessionfile.new_file import create_file
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.record.sessionfile.stream import McapStream
from igtl_gateway.replay.state_before import messages_before
from tests.places import FIXTURES
from tests.replay.test_state_before import parts as split
from tests.tables import table
from tools.recheck import random_session, written

FACTS: dict[str, Any] = {"latencies": [], "left_out": []}
_Timed = tuple[int, int, Schema | None, Channel, Row, bool]


def one_by_one(path: Path, parts: Sequence[MergedPart]) -> int:
    """Write a merged session, message by message."""
    file = create_file(path)
    mcap = McapStream(file, compression="zstd")
    mcap.start(layout.MCAP_PROFILE, f"igtl-gateway {__version__}")
    for part in parts:
        for each in part.file.attachments():
            part.digest.attachment(each)
            name = merged.ATTACHMENT_OF.format(part.name) + each.name
            mcap.add_attachment(name, each.media_type, each.data, each.log_time, each.create_time)
    numbers = merged.ChannelNumbers(merged.ChannelWriter(mcap).register)
    known: dict[int, tuple[Channel, Channel]] = {}
    rows: list[list[tuple[int, int, int]]] = [[] for _ in parts]
    count = 0

    def put_numbers(index: int) -> None:
        part, found = parts[index], np.array(rows[index], np.uint64)
        name = merged.NUMBERS_OF.format(part.name) + str(part.count)
        mcap.add_attachment(name, "application/octet-stream", merged.pack_numbers(found))
        part.count += 1
        rows[index].clear()

    for time_ns, index, schema, channel, row, is_before in heapq.merge(
        *(timed(part, index) for index, part in enumerate(parts)), key=lambda each: each[:2]
    ):
        part = parts[index]
        _, sequence, log_ns, publish_ns, start, end, data = row
        if id(channel) not in known:
            here = (merged.channel_before if is_before else merged.channel_of_part)(part.name, channel)
            known[id(channel)] = channel, here
        by_ns = (part.to_reference(log_ns) if is_before else time_ns) - log_ns
        if not is_before:
            part.digest.message(schema, channel, row)
            rows[index].append((sequence, log_ns, publish_ns))
        count += 1
        moved_ns = publish_ns + by_ns if 0 < publish_ns + by_ns < 1 << 63 else publish_ns
        mcap.add_message(
            numbers.of(schema, known[id(channel)][1]), time_ns, b"", memoryview(data)[start:end],
            time_ns if publish_ns == log_ns else moved_ns, count % SEQUENCES,
        )  # fmt: skip
        if len(rows[index]) == merged.NUMBERS:
            put_numbers(index)
    mcap.flush()
    for index in range(len(parts)):
        if rows[index]:
            put_numbers(index)
    facts = [merged_facts(part) for part in parts]
    text = json.dumps({**FACTS, "parts": facts}, sort_keys=True)
    mcap.add_metadata(merged.MERGE_METADATA, layout.seal({merged.MERGE_KEY: text}))
    mcap.finish()
    file.close()
    return count


def merged_facts(part: MergedPart) -> dict[str, Any]:
    session, ledger = part.file.recorded_session, part.file.recorded_ledger
    return {
        **part.facts, "name": part.name, "digest": part.digest.finish(session, ledger), "profile": layout.MCAP_PROFILE,
        "library": session.get("igtl_gateway_version", ""), "session": session, "ledger": ledger,
    }  # fmt: skip


def timed(part: MergedPart, index: int) -> Iterator[_Timed]:
    last = 0
    start_ns = part.to_reference(part.file.start_ns)
    for schema, channel, row in messages_before(part.file) if 0 <= start_ns < 1 << 63 else ():
        yield start_ns, index, schema, channel, row, True
    for schema, channel, row in part.file.messages():
        last = max(last, part.to_reference(row[2]))
        yield last, index, schema, channel, row, False


def clock(chance: random.Random, start_ns: int) -> Clock:
    """A clock that is ahead, drifts, or was set."""
    pieces = [Piece(0, chance.randrange(-(10**9), 10**9))]
    for _ in range(chance.randrange(3)):
        pieces.append(
            Piece(start_ns + chance.randrange(10**9), chance.randrange(-(10**8), 10**8), chance.choice([0.0, 50_000.7]))
        )
    pieces.sort(key=lambda piece: piece.start_ns)
    return Clock(tuple(ClockOffset(Method.GIVEN, tuple(pieces)) for _ in range(chance.randrange(1, 3))))


def both(paths: Sequence[Path], clocks: Sequence[Clock], folder: Path) -> None:
    counts = []
    for name, write in (("columns", lambda path, parts: write_merged(path, parts, FACTS)), ("messages", one_by_one)):
        files = [SessionFile.open(path) for path in paths]
        parts = [
            MergedPart(f"r{at}", file, clocks[at].to_reference, clocks[at].exactly_to_reference, {})
            for at, file in enumerate(files)
        ]
        counts.append(write(folder / name, parts))
        for file in files:
            file.close()
    assert counts[0] == counts[1] > 0
    assert (folder / "columns").read_bytes() == (folder / "messages").read_bytes()


@table("numbers", [7, 1 << 16])
@table("seed", range(4))
def test_random_sessions(numbers: int, seed: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(merged, "NUMBERS", numbers)
    chance = random.Random(seed)
    paths, clocks = [], []
    for at in range(chance.choice([2, 3])):
        config, entries = random_session(chance, 100)
        paths.append(written(tmp_path / f"{at}.mcap", config, entries, chunk_bytes=chance.choice([500, 1 << 20])))
        clocks.append(clock(chance, entries[0].stamp_ns) if at else Clock())
    both(paths, clocks, tmp_path)


def test_fixtures_with_equal_times(tmp_path: Path) -> None:
    """Also a part that begins midway, and one after it."""
    paths = [FIXTURES / "star.mcap", FIXTURES / "paper-types.mcap", FIXTURES / "star.mcap", split(tmp_path)[1]]
    both(paths, [Clock()] * 4, tmp_path)


def test_without_the_compiled_part(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for module in (chunk_rows, stream):
        monkeypatch.setattr(module, "add_columns", None)
    both([FIXTURES / "paper-types.mcap", FIXTURES / "crtk.mcap"], [Clock()] * 2, tmp_path)


def test_a_time_that_the_offset_moves_out_of_all_calendars_is_named(tmp_path: Path) -> None:
    config, entries = random_session(random.Random(1), 20)
    path = written(tmp_path / "a.mcap", config, entries)
    far = Clock((ClockOffset(Method.GIVEN, (Piece(entries[5].stamp_ns, 1 << 62), Piece(entries[9].stamp_ns, 0))),))
    with pytest.raises(GatewayError, match=f"found time {entries[0].stamp_ns} ns, which the offset moves out"):
        both([path, path], [Clock(), far], tmp_path)


@table("seed", range(200))
def test_times_in_columns_are_those_of_each(seed: int) -> None:
    chance = random.Random(seed)
    start_ns = 1_700_000_000 * 10**9
    some = clock(chance, start_ns)
    if seed % 3 == 0:  # lines that only exact arithmetic gets right, or that no clock has
        odd = Piece(
            chance.choice([0, -(1 << 63), 1 << 61]), chance.choice([0, 1 << 61]), chance.choice([0.5, -3e9, 7e-9])
        )
        some = Clock((*some.chain, ClockOffset(Method.GIVEN, (odd, Piece(start_ns, 5, math.pi)))))
    top = chance.choice([1 << 50, 1 << 64])
    times = [chance.choice([start_ns + chance.randrange(10**10), chance.randrange(top)]) for _ in range(30)]
    if seed % 2:
        times = [start_ns + chance.randrange(10**10) for _ in range(30)]
    found = some.exactly_to_reference(np.array(times, np.uint64))
    assert found.tolist() == [some.to_reference(time_ns) for time_ns in times]


@table("seed", range(3))
def test_what_passes_in_columns_is_what_passes_by_entries(seed: int, tmp_path: Path) -> None:
    config, entries = random_session(random.Random(seed), 150)
    repeated = [entry for entry in entries for _ in range(1 + (entry.seq % 5 == 0))]
    path = written(tmp_path / "a.mcap", config, numbered(repeated), chunk_bytes=2_000)
    with SessionFile.open(path) as file:
        recorder = merging._Recorder("a", path, file, {})
        found, expected = merging._passed_in_columns(recorder), merging._passed_by_entries(recorder)
    assert found
    for one, other in zip(found, expected, strict=True):
        assert len(other.times) > 20
        for column in ("times", "streams"):
            np.testing.assert_array_equal(getattr(one, column), getattr(other, column))
        assert one.names == other.names
        equal, expected_equal = (np.unique(each.keys, return_inverse=True)[1] for each in (one, other))
        first = {int(key): at for at, key in reversed(list(enumerate(equal)))}
        expected_first = {int(key): at for at, key in reversed(list(enumerate(expected_equal)))}
        assert [first[int(key)] for key in equal] == [expected_first[int(key)] for key in expected_equal]


def numbered(entries: Sequence[Entry]) -> list[Entry]:
    return [replace(entry, seq=number) for number, entry in enumerate(entries, 1)]


@pytest.mark.parametrize("step", ["_write", "_facts"])
def test_a_disk_that_is_full_is_named_and_leaves_no_file_open(
    step: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[BufferedWriter] = []

    def create(path: Path) -> BufferedWriter:
        made.append(create_file(path))
        return made[-1]

    def full(*_: object) -> int:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(writer, "create_file", create)
    monkeypatch.setattr(writer, step, full)
    parts = [] if step == "_write" else [None]
    if step == "_facts":
        monkeypatch.setattr(writer, "_write", lambda *_: 0)
    with pytest.raises(RecordingError, match=r"cannot write .*out.mcap: .*No space left on device"):
        write_merged(tmp_path / "out.mcap", parts, {})  # type: ignore[arg-type]
    (file,) = made
    assert file.raw.closed
