"""Contents without a codec, and how numbers are described."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from igtl_gateway.wire.body import Raw, describe_crc, describe_values
from tests.tables import table
from tests.wire.handmade import crc64


def test_raw_shows_its_beginning() -> None:
    assert Raw(b"").describe() == {}
    assert Raw(bytes(100)).describe() == {"raw_size": 100, "raw_hex": "00" * 64}
    assert Raw(bytes(range(64))).describe()["raw_hex"] == bytes(range(64)).hex()


def test_raw_is_a_view() -> None:
    data = memoryview(b"abc")
    assert Raw.unpack(data).data is data
    assert Raw(data).pack() == [data]
    assert Raw(b"").pack() == []


@given(st.binary(max_size=40))
def test_the_checksum_is_that_of_the_standard(data: bytes) -> None:
    assert describe_crc(data) == f"{crc64(data):016x}"


@table("dtype", ["u1", "<i2", ">i2", "<f4", ">f8"])
def test_up_to_256_values_are_shown_one_by_one(dtype: str) -> None:
    values = np.arange(257) % 100
    assert describe_values(values[:256].astype(dtype)) == values[:256].tolist()
    big = values.astype(np.dtype(dtype).newbyteorder(">"))
    assert describe_values(values.astype(dtype)) == {"count": 257, "crc64": f"{crc64(big.tobytes()):016x}"}


def test_complex_values_are_two_each() -> None:
    assert describe_values(np.array([1 - 2j, 3], "<c16")) == [1.0, -2.0, 3.0, 0.0]
    many = np.full(129, 1 - 2j, "<c16")
    assert describe_values(many[:128]) == [1.0, -2.0] * 128
    assert describe_values(many) == {"count": 258, "crc64": f"{crc64(many.astype('>c16').tobytes()):016x}"}


def test_every_second_value_is_described_as_a_list_of_its_own() -> None:
    values = np.arange(1000, dtype="<u4")
    assert describe_values(values[:20:2]) == list(range(0, 20, 2))
    assert describe_values(values[::2]) == describe_values(values[::2].copy())
