"""The records of a damaged file: found behind any damage, with their own ends."""

from __future__ import annotations

from io import BytesIO
from pathlib import Path

import pytest

from igtl_gateway.record.sessionfile import records
from igtl_gateway.record.sessionfile.damaged import DamagedFile, RecordSpan
from igtl_gateway.record.sessionfile.records import HEAD, MAGIC, Malformed
from tests.record.sessionfile.test_index import DEFINITIONS, bag, messages
from tools import mcap_build as build
from tools.mcap_build import Chunk

DATA = bag(
    Chunk((*DEFINITIONS, *messages(5, 6))),
    (build.METADATA, build.metadata("m", {"a": "b"})),
    Chunk(messages(7, 9), "zstd"),
    (build.ATTACHMENT, build.attachment("a", "text/plain", b"abc")),
).data


def opened(data: bytes) -> DamagedFile:
    return DamagedFile(Path("bag.mcap"), BytesIO(data))


def spans(data: bytes) -> list[RecordSpan]:
    return list(opened(data).walk())


SOUND = spans(DATA)


def test_a_sound_file() -> None:
    assert SOUND[0] == RecordSpan(records.HEADER, len(MAGIC), SOUND[1].at)
    assert [span.at for span in SOUND[1:]] == [span.end for span in SOUND[:-1]]
    assert SOUND[-1].end == len(DATA)
    file = opened(DATA)
    one, two = (span for span in SOUND if span.opcode == records.CHUNK)
    assert (file.chunk_compression(one), file.chunk_compression(two)) == ("", "zstd")
    assert (file.chunk_times(one), file.chunk_times(two)) == ((5, 6), (7, 9))
    assert [opcode for opcode, _, _ in records.records(file.chunk(two), "")] == [records.MESSAGE] * 2
    attachment = next(span for span in SOUND if span.opcode == records.ATTACHMENT)
    found = file.attachment(attachment)
    assert found and found.data == b"abc"


@pytest.mark.parametrize("bit", [0, 3, 7])
def test_a_damaged_length_does_not_cost_the_next_record(bit: int) -> None:
    for at, span in enumerate(SOUND[:-1]):
        for place in range(span.at + 1, span.at + HEAD.size):
            data = bytearray(DATA)
            data[place] ^= 1 << bit
            assert SOUND[at + 1] in spans(bytes(data)), (span, place)


def test_bytes_between_records_are_one_span() -> None:
    cut = SOUND[2].at
    found = spans(DATA[:cut] + b"\xff" * 100 + DATA[cut:])
    assert RecordSpan(0, cut, cut + 100) in found
    assert [span.opcode for span in found if span.opcode] == [span.opcode for span in SOUND]


def test_a_chunk_with_one_damaged_field_is_read() -> None:
    span = next(span for span in SOUND if span.opcode == records.CHUNK)
    expected = opened(DATA).chunk(span)
    size_at = span.at + HEAD.size + 16
    for at in range(size_at, size_at + 8):
        data = bytearray(DATA)
        data[at] ^= 1
        assert opened(bytes(data)).chunk(span) == expected
    data = bytearray(DATA)
    data[span.end - 1] ^= 1
    with pytest.raises(Malformed, match="its checksum is wrong"):
        opened(bytes(data)).chunk(span)
