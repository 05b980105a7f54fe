"""The index by a pass over the data: what it finds, and what stops it."""

from __future__ import annotations

from dataclasses import replace
from io import BytesIO
from pathlib import Path

import pytest

from igtl_gateway.base.errors import LimitExceeded
from igtl_gateway.base.untrusted import limits
from igtl_gateway.record.sessionfile import scan as scanning
from igtl_gateway.record.sessionfile.contents import Index
from igtl_gateway.record.sessionfile.records import Malformed
from igtl_gateway.record.sessionfile.scan import scan
from tests.record.sessionfile.test_index import DEFINITIONS, bag, messages
from tools import mcap_build as build
from tools.mcap_build import Chunk


def scanned(data: bytes) -> Index:
    return scan(Path("bag.mcap"), BytesIO(data), len(data), len(data))


def test_chunks_runs_and_named_records() -> None:
    made = bag(
        Chunk((*DEFINITIONS, *messages(5, 6)), "lz4"),
        (build.ATTACHMENT, build.attachment("a", "text/plain", b"abc")),
        *messages(9, 8),
        (build.METADATA, build.metadata("m", {})),
        Chunk(()),
    )
    found = scanned(made.data)
    assert found.scanned and (found.start_ns, found.end_ns, found.counts) == (5, 9, {1: 4})
    assert [(chunk.start_ns, chunk.end_ns, chunk.loose) for chunk in found.chunks] == [
        (5, 6, False), (8, 9, True), (0, 0, False),
    ]  # fmt: skip
    assert [place.name for place in (*found.attachments, *found.metadata)] == ["a", "m"]
    assert found.channels.keys() == found.schemas.keys() == {1}


@pytest.mark.parametrize("missing", [1, 5, 30])
def test_a_record_that_is_cut(missing: int) -> None:
    data = bag(Chunk((*DEFINITIONS, *messages(5, 6)))).data
    with pytest.raises(Malformed, match="found"):
        scanned(data[:-missing])


def test_the_number_of_records_is_bounded() -> None:
    data = bag(*(Chunk((*DEFINITIONS, *messages(at))) for at in range(30))).data
    with limits.limits_in_force(replace(limits.current_limits(), count=20)), pytest.raises(LimitExceeded, match="=20"):
        scanned(data)


@pytest.mark.parametrize("loose", [True, False])
def test_a_message_that_is_shorter_than_its_head_is_refused(loose: bool) -> None:
    short = (build.MESSAGE, messages(5)[0][1][:21])
    parts = (*DEFINITIONS, short) if loose else (Chunk((*DEFINITIONS, short)),)
    with pytest.raises(Malformed, match="found a message of 21 bytes"):
        scanned(bag(*parts).data)


def test_data_without_an_end_are_indexed_up_to_their_last_record() -> None:
    data = bag(Chunk((*DEFINITIONS, *messages(5))), *messages(7, 8)).data
    end = len(data) - len(build.record(build.DATA_END, bytes(4)))
    found = scanned(data[:end])
    assert [(chunk.start_ns, chunk.end_ns, chunk.loose) for chunk in found.chunks] == [(5, 5, False), (7, 8, True)]


@pytest.mark.parametrize(("times", "lengths"), [(1, [1]), (3, [3]), (4, [4]), (5, [4, 1]), (8, [4, 4]), (9, [4, 4, 1])])
def test_messages_outside_of_chunks_are_read_in_pieces(
    times: int, lengths: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A piece ends with the message that fills it."""
    some = messages(*range(10, 10 + times))
    size = len(build.record(*some[0]))
    monkeypatch.setattr(scanning, "_PIECE", 4 * size)
    found = scanned(bag(*DEFINITIONS, *some).data)
    assert [chunk.length for chunk in found.chunks] == [number * size for number in lengths]
    assert all(chunk.loose for chunk in found.chunks)
    assert [chunk.start_ns for chunk in found.chunks] == [10 + sum(lengths[:at]) for at in range(len(lengths))]
