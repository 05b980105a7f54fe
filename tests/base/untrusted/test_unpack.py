"""Bombs, honest and lying, in each packing; what is good comes out whole."""

from __future__ import annotations

import bz2
import io
import tracemalloc
from collections.abc import Callable

import lz4.frame  # type: ignore[import-untyped]
import pytest
import zstandard

from igtl_gateway.base.errors import DamagedRecording, LimitExceeded
from igtl_gateway.base.untrusted import limits, unpack
from tests.tables import table

MIB = 1 << 20
PACKINGS: list[tuple[unpack.Packing, Callable[[bytes], bytes]]] = [
    ("bz2", bz2.compress),
    ("lz4", lz4.frame.compress),
    ("zstd", zstandard.ZstdCompressor().compress),
    ("zstd", zstandard.ZstdCompressor(write_content_size=False).compress),
]
unpacked = unpack.unpack_within_limits
SMALL = limits.FileLimits(free=MIB, ratio=10)


@pytest.mark.parametrize(("packing", "packed"), PACKINGS)
def test_whole_pieces_come_out(packing: unpack.Packing, packed: Callable[[bytes], bytes]) -> None:
    for data in (b"", b"x", bytes(range(256)) * 1000):
        assert unpacked(packing, packed(data), len(data), "a chunk") == data


@pytest.mark.parametrize(("packing", "packed"), PACKINGS)
def test_a_size_that_is_too_large_or_a_lie(packing: unpack.Packing, packed: Callable[[bytes], bytes]) -> None:
    bomb = packed(bytes(32 * MIB))
    with limits.limits_in_force(SMALL):
        with pytest.raises(LimitExceeded, match=r"a chunk: found 33554432, expected at most .* \(--limit ratio=10\)"):
            unpacked(packing, bomb, 32 * MIB, "a chunk")
        tracemalloc.start()
        with pytest.raises(DamagedRecording, match="a chunk: found more than 100 unpacked bytes, expected 100"):
            unpacked(packing, bomb, 100, "a chunk")
        assert tracemalloc.get_traced_memory()[1] < 8 * MIB
        tracemalloc.stop()
    with pytest.raises(DamagedRecording, match="found 5 unpacked bytes, expected 9"):
        unpacked(packing, packed(b"12345"), 9, "a chunk")


@table("packing", ["bz2", "lz4", "zstd"])
@table("data", [b"", b"\0" * 40, b"BZh91AY&SY" + b"\xff" * 30, b"\x28\xb5\x2f\xfd\xff\xff\xff"])
def test_what_is_not_packed_is_refused(packing: unpack.Packing, data: bytes) -> None:
    with pytest.raises(DamagedRecording, match="a chunk"):
        unpacked(packing, data, 10, "a chunk")


def test_zstd_of_unknown_size() -> None:
    bomb = zstandard.ZstdCompressor(write_content_size=False).compress(bytes(32 * MIB))
    with limits.limits_in_force(SMALL), pytest.raises(LimitExceeded, match="a message"):
        unpack.unpack_zstd_of_any_size(bomb, "a message")
    assert unpack.unpack_zstd_of_any_size(bomb, "a message") == bytes(32 * MIB)
    with pytest.raises(DamagedRecording, match="a message: found invalid zstd data"):
        unpack.unpack_zstd_of_any_size(b"\0" * 40, "a message")


def test_files_of_zstd() -> None:
    data = bytes(range(256)) * 8192
    packed = zstandard.ZstdCompressor().compress(data)
    out = io.BytesIO()
    unpack.unpack_zstd_file(io.BytesIO(packed * 2), out, len(packed), 2 * len(data), "bag.db3.zstd")
    assert out.getvalue() == data * 2
    out = io.BytesIO()
    with pytest.raises(LimitExceeded, match=r"bag\.db3\.zstd: \d+ packed bytes: found \d+, expected at most 1048576"):
        unpack.unpack_zstd_file(io.BytesIO(packed), out, len(packed), MIB, "bag.db3.zstd")
    assert len(out.getvalue()) <= MIB
    with pytest.raises(DamagedRecording, match=r"bag\.db3\.zstd"):
        unpack.unpack_zstd_file(io.BytesIO(b"\0" * 100), io.BytesIO(), 100, MIB, "bag.db3.zstd")


@pytest.mark.parametrize(
    "error", [MemoryError(), zstandard.ZstdError("decompression error: Allocation error : not enough memory")]
)
def test_too_little_memory_is_no_damage(monkeypatch: pytest.MonkeyPatch, error: Exception) -> None:
    def fail(*_: object, **__: object) -> bytes:
        raise error

    monkeypatch.setattr(unpack, "_at_most", fail)
    with pytest.raises(MemoryError):
        unpacked("lz4", lz4.frame.compress(bytes(100)), 100, "here")
