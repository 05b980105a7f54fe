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
    assert [opcode for opcode, _, _ in records.records(file.chunk(two)[1], "")] == [records.MESSAGE] * 2
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


INNER = bag(Chunk((*DEFINITIONS, *messages(1, 2, 3, 4)))).finish()
OUTER = bag(
    (build.ATTACHMENT, build.attachment("prologue", "application/octet-stream", INNER)),
    Chunk((*DEFINITIONS, *messages(7, 9))),
    (build.ATTACHMENT, build.attachment("last", "application/octet-stream", INNER)),
    Chunk((*DEFINITIONS, *messages(11))),
).data


def chunks_in(data: bytes) -> list[tuple[int, int]]:
    """Place and end of the chunks that are found, by distance from the end of the whole file."""
    return [(span.at, span.end) for span in spans(data) if span.opcode == records.CHUNK]


def test_what_is_in_an_attachment_that_is_cut_off_or_damaged_is_not_of_the_file() -> None:
    own = chunks_in(OUTER)
    attachments = [span for span in spans(OUTER) if span.opcode == records.ATTACHMENT]
    assert len(own) == 2 and len(attachments) == 2
    for attachment in attachments:
        for cut in range(attachment.at, attachment.end):
            assert set(chunks_in(OUTER[:cut])) <= set(own), cut
        for begin in range(attachment.at, attachment.end, 7):
            # a page of zeros, which costs the head of the attachment, or not
            data = OUTER[: attachment.at] + bytes(begin - attachment.at) + OUTER[begin:]
            assert set(chunks_in(data)) <= set(own), begin
            rest = [each for each in own if each[0] >= attachment.end]
            assert set(rest) <= set(chunks_in(data)) or begin > attachment.end - 60, begin


def test_a_chunk_that_is_cut_off_hides_what_is_in_its_messages() -> None:
    whole = bag(Chunk((*DEFINITIONS, *messages(7))), Chunk(((build.MESSAGE, build.message(1, 8, 8, 8, INNER)),))).data
    own = chunks_in(whole)
    assert len(own) == 2
    for cut in range(own[1][0], own[1][1]):
        assert chunks_in(whole[:cut]) == own[:1], cut


def test_a_record_whose_length_and_fields_are_nonsense_is_not_taken_for_one_that_is_cut_off() -> None:
    whole = bag(*(Chunk((*DEFINITIONS, *messages(number))) for number in (7, 9, 11))).data
    first, *others = chunks_in(whole)
    at, end = first
    for kept in range(1, 8):  # bytes of the head
        data = whole[: at + kept] + b"\xfa" * (60 - kept) + whole[at + 60 :]
        assert end - at > 60 and chunks_in(data) == others, kept


@pytest.mark.parametrize("bit", [0, 3, 7])
def test_a_second_header_is_a_record_like_others(bit: int) -> None:
    """Files that were put together have one: the record before it, whose length is damaged, keeps its end."""
    data = bag(
        Chunk((*DEFINITIONS, *messages(5, 6))),
        (build.METADATA, build.metadata("m", {"a": "b"})),
        (build.HEADER, build.header("ros2", "another")),
        Chunk(messages(7, 9)),
    ).data
    sound = spans(data)
    at = next(number for number, span in enumerate(sound) if number and span.opcode == records.HEADER)
    for place in range(sound[at - 1].at + 1, sound[at - 1].at + HEAD.size):
        damaged = bytearray(data)
        damaged[place] ^= 1 << bit
        assert sound[at - 1 : at + 2] == spans(bytes(damaged))[at - 1 : at + 2], place
