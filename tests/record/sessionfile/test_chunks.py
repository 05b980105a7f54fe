"""One chunk: read within the limits, and taken apart in order of time."""

from __future__ import annotations

from io import BytesIO

import pytest

from igtl_gateway.base.errors import LimitExceeded
from igtl_gateway.record.sessionfile import chunks
from igtl_gateway.record.sessionfile.chunks import batches, check_chunk, packed_chunk
from igtl_gateway.record.sessionfile.contents import ChunkEntry
from igtl_gateway.record.sessionfile.records import Malformed
from tests.record.sessionfile.test_index import DEFINITIONS, messages
from tools.mcap_build import Chunk

PLAIN = Chunk((*DEFINITIONS, *messages(5, 9, 7, 7, 6))).plain()


@pytest.mark.parametrize("small", [0, 8 << 20])
def test_messages_are_in_order_of_time_and_then_of_the_file(monkeypatch: pytest.MonkeyPatch, small: int) -> None:
    monkeypatch.setattr(chunks, "SMALL_BYTES", small)
    monkeypatch.setattr(chunks, "BATCH", 2)
    rows = [row for batch in batches(PLAIN) for row in batch]
    assert [(time_ns, sequence) for _, sequence, time_ns, *_ in rows] == [(5, 0), (6, 4), (7, 2), (7, 3), (9, 1)]
    assert all(row[6][row[4] : row[5]] == b"payload" for row in rows)


def test_a_chunk_that_is_not_where_the_index_has_it() -> None:
    with pytest.raises(Malformed, match="expected a chunk of 60 bytes"):
        packed_chunk(BytesIO(bytes(100)), ChunkEntry(0, 0, 8, 60, 10), "a")


@pytest.mark.parametrize(("packed", "size"), [(10, 1 << 40), (1_000, 300_000_000)])
def test_a_chunk_cannot_fill_the_memory(packed: int, size: int) -> None:
    with pytest.raises(LimitExceeded):
        check_chunk(packed, size, "chunk")
    check_chunk(packed, 1_000_000, "chunk")
