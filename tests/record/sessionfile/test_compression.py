"""Unpacking: right bytes, or a sentence; never more memory than was promised."""

from __future__ import annotations

import tracemalloc
import zlib
from collections.abc import Callable

import lz4.frame  # type: ignore[import-untyped]
import pytest
import zstandard

from igtl_gateway.record.sessionfile.compression import (
    NAMES,
    Compression,
    compress,
    declared_size,
    decompress,
)
from igtl_gateway.record.sessionfile.records import Malformed
from tests.tables import table

DATA = b"a chunk of records" * 100

PACKED: dict[str, tuple[str, Callable[[bytes], bytes]]] = {
    "none": ("", bytes),
    "lz4": ("lz4", lz4.frame.compress),
    "lz4 without its size": ("lz4", lambda data: lz4.frame.compress(data, store_size=False)),
    "zstd": ("zstd", zstandard.compress),
    "zstd without its size": ("zstd", zstandard.ZstdCompressor(write_content_size=False).compress),
    "zstd in two frames": ("zstd", lambda data: zstandard.compress(data[:50]) + zstandard.compress(data[50:])),
}


@pytest.mark.parametrize("name", PACKED)
def test_what_was_packed_comes_back(name: str) -> None:
    compression, pack = PACKED[name]
    assert decompress(compression, pack(DATA), len(DATA), zlib.crc32(DATA)) == DATA


@table("name", PACKED)
@table("size", [0, 10, len(DATA) - 1, len(DATA) + 1, 1 << 20])
def test_a_size_that_lies_is_found_out(name: str, size: int) -> None:
    compression, pack = PACKED[name]
    with pytest.raises(Malformed, match=f"expected {size}"):
        decompress(compression, pack(DATA), size, 0)


def test_a_wrong_checksum_is_named() -> None:
    with pytest.raises(Malformed, match=r"found checksum [0-9a-f]{8}, expected 00000001"):
        decompress("", DATA, len(DATA), 1)


@pytest.mark.parametrize("compression", ["lz4", "zstd"])
@pytest.mark.parametrize("packed", [b"", b"x" * 40, bytes(40)])
def test_what_was_not_packed_is_refused(compression: str, packed: bytes) -> None:
    with pytest.raises(Malformed, match="cannot be unpacked"):
        decompress(compression, packed, 100, 0)


def test_a_compression_that_nobody_knows_is_named() -> None:
    with pytest.raises(Malformed, match="found compression 'bz2'"):
        decompress("bz2", b"", 0, 0)


@pytest.mark.parametrize("name", PACKED)
def test_a_bomb_costs_what_it_says(name: str) -> None:
    compression, pack = PACKED[name]
    bomb = pack(bytes(100_000_000))
    tracemalloc.start()
    with pytest.raises(Malformed):
        decompress(compression, bomb, 1000, 0)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 1_000_000


@pytest.mark.parametrize("compression", NAMES)
def test_parts_are_packed_as_one(compression: Compression) -> None:
    packed = b"".join(compress(compression, (DATA, memoryview(DATA)), 2 * len(DATA)))
    assert decompress(NAMES[compression], packed, 2 * len(DATA), zlib.crc32(DATA * 2)) == DATA * 2


def test_the_size_in_the_frame() -> None:
    sizes = {name: declared_size(compression, pack(DATA)) for name, (compression, pack) in PACKED.items()}
    assert sizes == {
        "none": len(DATA), "lz4": len(DATA), "lz4 without its size": 0, "zstd": len(DATA), "zstd without its size": 0,
        "zstd in two frames": 50,
    }  # fmt: skip
    assert declared_size("zstd", b"nothing") == declared_size("lz4", b"nothing") == 0
