"""Blocks of arrays against entries one by one."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import igtl_gateway
from igtl_gateway.base.errors import DamagedRecording
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.record.sessionfile import records
from igtl_gateway.record.sessionfile.bulk import block_of, gathered, numbers_at
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.record.sessionfile.records import Malformed
from igtl_gateway.record.sessionfile.writer import SessionWriter
from tests.places import FIXTURES

MESSAGES = (Kind.IGTL_IN, Kind.IGTL_OUT, Kind.ROS_IN, Kind.ROS_OUT)
Rows = list[tuple[int, int, int, bytes]]


def rows_by_stream(file: SessionFile) -> dict[tuple[Kind, str, str], Rows]:
    found: dict[tuple[Kind, str, str], Rows] = {}
    for entry in file.entries():
        if entry.kind in MESSAGES:
            row = (entry.seq, entry.stamp_ns, entry.source_ns, entry.data())
            found.setdefault((entry.kind, entry.channel, entry.type), []).append(row)
    return found


def rows_of_blocks(file: SessionFile, key: tuple[Kind, str, str], start_ns: int = 0, end_ns: int = 1 << 62) -> Rows:
    (channel,) = (each for each in file.channels if (each.kind, each.stream, each.entry_type) == key)
    return [
        (number, time, source, bytes(block.payload(index)))
        for block in file.blocks(channel, start_ns, end_ns)
        for index, (number, time, source) in enumerate(
            zip(block.numbers.tolist(), block.times.tolist(), block.source_times.tolist(), strict=True)
        )
    ]


@pytest.mark.parametrize("name", ["star", "every-type", "lego"])
def test_blocks_are_the_entries_of_each_stream(name: str) -> None:
    with SessionFile.open(FIXTURES / f"{name}.mcap") as file:
        expected = rows_by_stream(file)
        for channel in file.channels:
            key = (channel.kind, channel.stream, channel.entry_type)
            if channel.kind in MESSAGES and channel.stream and channel.count:
                assert rows_of_blocks(file, key) == expected[key]
                assert file.span(channel) == (expected[key][0][1], expected[key][-1][1])


def test_a_window_has_its_first_moment_and_not_its_last() -> None:
    key = (Kind.IGTL_OUT, "TRANSFORM/ToolToBase", "TRANSFORM")
    with SessionFile.open(FIXTURES / "star.mcap") as file:
        rows = rows_of_blocks(file, key)
        assert rows_of_blocks(file, key, rows[400][1], rows[900][1]) == rows[400:900]


def entries() -> list[Entry]:
    """Messages to different links, with and without a stamp, some of which equal gateway time."""
    found = []
    for number in range(1, 400):
        links = tuple(range(1, 2 + number % 3))
        source = (0, number * 1000, number * 1000 - 7)[number % 3]
        payload = bytes([number % 251]) * (58 + number % 5)
        found.append(Entry(number, number * 1000, Kind.IGTL_OUT, "STRING/A", "STRING", (payload,), links, source))
    return found


def test_messages_with_different_heads_are_found(tmp_path: Path) -> None:
    with_writer(tmp_path / "a.mcap", entries(), chunk_bytes=4096)
    with SessionFile.open(tmp_path / "a.mcap") as file:
        expected = [(each.seq, each.stamp_ns, each.source_ns, each.data()) for each in entries()]
        assert rows_of_blocks(file, (Kind.IGTL_OUT, "STRING/A", "STRING")) == expected


def with_writer(path: Path, given: list[Entry], chunk_bytes: int) -> None:
    writer = SessionWriter(path, {}, chunk_bytes=chunk_bytes, compression="none")
    for entry in given:
        writer.write(entry)
    writer.close({})


def test_a_file_without_index_is_read_entry_by_entry(tmp_path: Path) -> None:
    with_writer(tmp_path / "a.mcap", entries(), chunk_bytes=4096)
    with SessionFile.open(tmp_path / "a.mcap") as file:
        assert file.is_indexed
    with SessionFile.open(tmp_path / "a.mcap") as file:
        for chunk in file._index.chunks:
            file._index.chunks[file._index.chunks.index(chunk)] = replace(chunk, places=b"")
        expected = [(each.seq, each.stamp_ns, each.source_ns, each.data()) for each in entries()]
        assert rows_of_blocks(file, (Kind.IGTL_OUT, "STRING/A", "STRING")) == expected
        assert not file.is_indexed


@pytest.mark.parametrize("shift", [0, 3, 8, 15, 20])
def test_a_damaged_message_index_is_an_error_and_no_other_messages(tmp_path: Path, shift: int) -> None:
    path = tmp_path / "a.mcap"
    with_writer(path, entries(), chunk_bytes=4096)
    with SessionFile.open(path) as file:
        chunk = file._index.chunks[1]
    data = bytearray(path.read_bytes())
    data[chunk.at + chunk.length + records.HEAD.size + shift] ^= 1
    path.write_bytes(data)
    with SessionFile.open(path) as file:
        expected = [(each.seq, each.stamp_ns, each.source_ns, each.data()) for each in entries()]
        try:
            assert rows_of_blocks(file, (Kind.IGTL_OUT, "STRING/A", "STRING")) == expected
        except DamagedRecording as error:
            assert "igtl-gateway recover" in str(error)


def test_numbers_outside_of_the_data_are_malformed() -> None:
    data = np.arange(16, dtype=np.uint8)
    assert numbers_at(data, np.array([0, 12]), "<u4").tolist() == [0x03020100, 0x0F0E0D0C]
    assert gathered(data, np.array([1, 14]), 2).tolist() == [[1, 2], [14, 15]]
    for place in (-1, 13):
        with pytest.raises(Malformed):
            numbers_at(data, np.array([place]), "<u4")


def test_a_block_of_entries_has_their_payloads() -> None:
    block = block_of(entries()[:3])
    assert [bytes(block.payload(index)) for index in range(3)] == [each.data() for each in entries()[:3]]
    assert [bytes(block.where(slice(1, 2)).payload(0))] == [entries()[1].data()]


@pytest.mark.parametrize("name", ["star", "every-type", "lego"])
def test_each_channel_is_found_by_its_own_index(name: str) -> None:
    """Whatever was read before: a seek too few would send all but the first channel the slow way."""
    with SessionFile.open(FIXTURES / f"{name}.mcap") as file:
        counts = file._index.counts
        for number in sorted(counts, reverse=True):
            blocks = list(file._chunks.blocks([number], 0, 1 << 62, whole=True, is_wire=False))
            assert sum(map(len, blocks)) == counts[number]
            first, last = file._chunks.span([number])
            times = np.concatenate([block.times for block in blocks])
            assert (first, last) == (int(times.min()), int(times.max()))


def test_each_message_is_read_by_its_time_and_chunks_are_forgotten() -> None:
    with igtl_gateway.open("fixtures/star.mcap") as recording:
        stream = recording["/star/camera/image"]
        every = [
            (block.times[row], bytes(block.payload(row))) for block in stream.blocks() for row in range(len(block))
        ]
        for time_ns, payload in every[::-1]:
            (block,) = stream.blocks_between(int(time_ns), int(time_ns) + 1)
            assert (block.times.tolist(), bytes(block.payload(0))) == ([time_ns], payload)
        assert list(stream.blocks_between(int(every[0][0]) + 1, int(every[1][0]))) == []
        reader = recording._source.file._chunks
        assert reader._kept and reader._size
        recording.forget_chunks()
        assert not reader._kept and not reader._size
