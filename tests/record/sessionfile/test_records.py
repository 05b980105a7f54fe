"""Records as bytes: what is packed is parsed, the library reads it alike, and cut records are refused."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable
from io import BytesIO
from typing import Any

import pytest
from mcap.data_stream import ReadDataStream
from mcap.records import Attachment, Channel, ChunkIndex, DataEnd, Header, MessageIndex, Metadata, Schema, Statistics

from igtl_gateway.record.sessionfile import records
from igtl_gateway.record.sessionfile.records import HEAD, Malformed
from tools import mcap_build as build

PARSED: list[tuple[Callable[[bytes], Any], Any]] = [
    (records.parse_header, Header(profile="ros2", library="a library")),
    (records.parse_schema, Schema(id=3, data=b"string data", encoding="ros2msg", name="std_msgs/msg/String")),
    (records.parse_channel, Channel(id=1, topic="/a", message_encoding="cdr", metadata={"k": "v"}, schema_id=3)),
    (records.parse_metadata, Metadata(name="m", metadata={"a": "ü", "b": ""})),
    (records.parse_attachment, Attachment(create_time=1, log_time=2, name="n", media_type="text/plain", data=b"abc")),
    (records.parse_statistics, Statistics(1, 2, {1: 5, 2: 6}, 3, 11, 9, 8, 4, 7)),
]


@pytest.mark.parametrize(("parse", "value"), PARSED)
def test_what_the_library_packs_is_parsed(parse: Callable[[bytes], Any], value: Any) -> None:
    content = records.pack(value)[HEAD.size :]
    assert parse(content) == value
    assert parse(content + b"later versions") == value
    for size in range(len(content)):
        with pytest.raises(Malformed):
            parse(content[:size])


def test_an_attachment_whose_checksum_is_wrong() -> None:
    content = bytearray(records.pack(PARSED[4][1])[HEAD.size :])
    content[-6] ^= 1
    with pytest.raises(Malformed, match="its checksum is wrong"):
        records.parse_attachment(bytes(content))
    content[-4:] = bytes(4)  # it has none
    assert records.parse_attachment(bytes(content)).name == "n"


def test_indexes_are_those_of_the_library() -> None:
    packed = records.pack_message_index(7, [100, 0, 200, 40])
    found = MessageIndex.read(ReadDataStream(BytesIO(packed[HEAD.size :])))
    assert (found.channel_id, found.records) == (7, [(100, 0), (200, 40)])
    packed = records.pack_chunk_index(1, 2, 30, 40, [7, 70, 8, 95], 50, "lz4", 60, 80)
    opcode, length = HEAD.unpack_from(packed)
    assert (opcode, length) == (records.CHUNK_INDEX, len(packed) - HEAD.size)
    index = ChunkIndex.read(ReadDataStream(BytesIO(packed[HEAD.size :])))
    assert (index.message_start_time, index.message_end_time) == (1, 2)
    assert (index.chunk_start_offset, index.chunk_length, index.message_index_offsets) == (30, 40, {7: 70, 8: 95})
    assert (index.compression, index.compressed_size, index.uncompressed_size) == ("lz4", 60, 80)


def test_consecutive_records() -> None:
    data = records.pack(PARSED[0][1], PARSED[3][1])
    found = list(records.records(data, "here"))
    assert [opcode for opcode, _, _ in found] == [records.HEADER, records.METADATA]
    assert records.parse_metadata(data[found[1][1] : found[1][2]]) == PARSED[3][1]
    for size in (len(data) - 1, found[0][2] + 4):
        with pytest.raises(Malformed, match="here: found"):
            list(records.records(data[:size], "here"))


def test_the_checksum_goes_on() -> None:
    assert records.crc32(b"cd", records.crc32(b"ab")) == records.crc32(bytearray(b"abcd")) == zlib.crc32(b"abcd")


@pytest.mark.parametrize(
    "content",
    [
        (records.HEADER, records.pack(PARSED[0][1])),
        (records.SCHEMA, records.pack(PARSED[1][1])),
        (records.CHANNEL, records.pack(PARSED[2][1])),
        (records.METADATA, records.pack(PARSED[3][1])),
        (records.ATTACHMENT, records.pack(PARSED[4][1])),
        (records.MESSAGE_INDEX, records.pack_message_index(7, [100, 0, 200, 40])),
        (
            records.CHUNK,
            build.record(
                build.CHUNK, struct.pack("<QQQI", 1, 2, 7, 0) + build.text("lz4") + struct.pack("<Q", 7) + b"content"
            ),
        ),
        (records.DATA_END, records.pack(DataEnd(5))),
    ],
    ids=lambda each: str(each[0]),
)
def test_a_record_ends_where_its_fields_end(content: tuple[int, bytes]) -> None:
    """So a damaged length does not cost the next record."""
    opcode, data = content
    assert data[0] == opcode
    at = HEAD.size
    for each in records.FIELDS[opcode]:
        if isinstance(each, int):
            at += each
        else:
            at += each.size + each.unpack_from(data, at)[0]
    assert at == len(data)
