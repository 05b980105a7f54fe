"""A file read by ranges, whatever the requests are."""

from __future__ import annotations

import io
import random
from pathlib import Path

import pytest

from igtl_gateway.base.errors import DamagedRecording
from igtl_gateway.record.sessionfile.ranges import RangeFile, named

BLOCK = 1000
DATA = random.Random(1).randbytes(9 * BLOCK + 123)


class Bytes(RangeFile):
    def __init__(self) -> None:
        super().__init__(len(DATA), BLOCK)
        self.fetched: list[tuple[int, int]] = []

    def fetch(self, start: int, count: int) -> bytes:
        self.fetched.append((start, count))
        return DATA[start : start + count]


def test_small_reads_share_requests_and_large_ones_are_one() -> None:
    raw = Bytes()
    assert raw.read(10) == DATA[:10]
    assert raw.read(10) == DATA[10:20]
    assert raw.seek(-20, io.SEEK_END) == len(DATA) - 20
    assert raw.read(500) == DATA[-20:]
    assert raw.read(1) == b""
    raw.seek(150)
    assert raw.read(5 * BLOCK) == DATA[150 : 150 + 5 * BLOCK]
    assert raw.fetched == [(0, BLOCK), (9 * BLOCK, 123), (150, 5 * BLOCK)]
    assert (raw.requests, raw.bytes_read) == (3, 6 * BLOCK + 123)


def test_errors_name_the_url() -> None:
    with pytest.raises(DamagedRecording, match=r"^https://host/a\.mcap\?key=1: cut off$"):
        with named(path := Path("https://host/a.mcap"), "https://host/a.mcap?key=1"):
            raise DamagedRecording(f"{path}: cut off")
