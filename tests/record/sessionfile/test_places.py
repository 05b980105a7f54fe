"""The place of a message: the mcap library has the same bytes there, whatever the compression and the order."""

from __future__ import annotations

import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import lz4.frame  # type: ignore[import-untyped]
import pytest
import zstandard
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from igtl_gateway.base.errors import DamagedRecording
from igtl_gateway.record.sessionfile.places import MessagePlace, messages_at
from tests.tables import table

TOPICS = ("/a", "/b")
HEAD = struct.Struct("<BQHIQQ")


def written(path: Path, *, times: tuple[int, ...] = (), **options: Any) -> Path:
    """A file with messages of two topics, several in a chunk, some of one time."""
    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=300, **options)
        writer.start()
        channels = [writer.register_channel(topic, "cdr", 0) for topic in TOPICS]
        for number, time_ns in enumerate(times or (100, 200, 200, 300, 400, 500, 500, 600)):
            data = bytes([number]) * (40 + number)
            writer.add_message(channels[number % 2], time_ns, data, time_ns, sequence=number)
        writer.finish()  # type: ignore[no-untyped-call]
    return path


def bytes_of(place: MessagePlace) -> bytes:
    """The record at a place, by the libraries of the compressions."""
    data = place.path.read_bytes()
    stored = data[place.data_at : place.data_at + place.data_length]
    unpack = {"": bytes, "lz4": lz4.frame.decompress, "zstd": zstandard.ZstdDecompressor().decompress}
    found: bytes = unpack[place.compression](stored)[place.offset : place.offset + place.length]
    if place.file_at is not None:
        assert data[place.file_at : place.file_at + place.length] == found
    assert place.chunk_at is None or data[place.chunk_at] == 6
    return found


@table(
    "options",
    [
        {"compression": CompressionType.NONE},
        {"compression": CompressionType.LZ4},
        {"compression": CompressionType.ZSTD},
        {"use_chunking": False},
        {"times": (500, 100, 400, 200, 300, 100)},
    ],
)
def test_the_library_has_the_same_bytes_there(options: Mapping[str, Any], tmp_path: Path) -> None:
    path = written(tmp_path / "a.mcap", **options)
    with path.open("rb") as stream:
        expected = {
            (channel.topic, message.sequence): message for _, channel, message in make_reader(stream).iter_messages()
        }
    times = {message.log_time for message in expected.values()}
    found = list(messages_at(path, times))
    assert {(each.topic, each.sequence) for each in found} == expected.keys() and len(found) == len(expected)
    for each in found:
        record, message = bytes_of(each), expected[each.topic, each.sequence]
        opcode, length, _, sequence, log_time, publish_time = HEAD.unpack_from(record)
        assert (opcode, length, sequence, log_time) == (5, len(record) - 9, message.sequence, message.log_time)
        assert publish_time == message.publish_time and record[HEAD.size :] == message.data


def test_only_messages_of_these_times_are_found(tmp_path: Path) -> None:
    path = written(tmp_path / "a.mcap")
    assert [each.sequence for each in messages_at(path, {200, 500})] == [1, 2, 5, 6]
    assert not list(messages_at(path, {150, 1 << 63})) and not list(messages_at(path, set()))


def test_a_damaged_chunk_is_named(tmp_path: Path) -> None:
    path = written(tmp_path / "a.mcap", compression=CompressionType.NONE)
    place = next(messages_at(path, {100}))
    data = bytearray(path.read_bytes())
    data[place.data_at + place.offset + 40] ^= 1
    path.write_bytes(data)
    with pytest.raises(DamagedRecording, match=r"chunk at offset .* igtl-gateway recover"):
        list(messages_at(path, {100}))
