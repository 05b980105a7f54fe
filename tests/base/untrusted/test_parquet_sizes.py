"""Sizes that a Parquet file states: their sums, which strings may be numbers, footers and pages that lie."""

from __future__ import annotations

import io
import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from pyarrow import parquet

from igtl_gateway.base.errors import DamagedRecording, LimitExceeded
from igtl_gateway.base.untrusted.limits import FileLimits, limits_in_force
from igtl_gateway.base.untrusted.parquet_sizes import check_sizes
from tests.base.untrusted.thrift_bytes import structure, zigzag
from tests.tables import table

MIB = 1 << 20
SMALL = FileLimits(memory=4 * MIB, free=MIB, ratio=50, count=2_000)


def sizes(path: Path) -> tuple[int, int, list[str]]:
    with path.open("rb") as stream:
        return check_sizes(stream, path)


def written(path: Path, content: Mapping[str, Any], **options: Any) -> Path:
    parquet.write_table(pa.table(dict(content)), path, **options)
    return path


STRINGS = ["text " * 5 + str(number % 3) for number in range(100)]


@table(
    ("options", "columns"),
    [
        ({}, ["s"]),
        ({"row_group_size": 7}, ["s"]),
        ({"use_dictionary": False}, ["s"]),
        ({"use_dictionary": False, "column_encoding": {"s": "DELTA_BYTE_ARRAY"}}, []),
        ({"use_dictionary": False, "column_encoding": {"s": "DELTA_LENGTH_BYTE_ARRAY"}}, []),
        ({"data_page_version": "2.0", "compression": "zstd"}, ["s"]),
    ],
)
def test_rows_bytes_and_strings_that_may_be_numbers(
    options: dict[str, Any], columns: list[str], tmp_path: Path
) -> None:
    path = written(tmp_path / "a.parquet", {"n": np.arange(100), "s": STRINGS}, **options)
    assert sizes(path) == (100, path.stat().st_size, columns)


def test_columns_in_lists_and_structures_have_paths(tmp_path: Path) -> None:
    content = {"l": [["a", "b"], None, ["c"]], "d": [{"x": "a", "y": 1}] * 3}
    assert sizes(written(tmp_path / "a.parquet", content))[2] == ["d.x", "l.list.element"]


def test_values_count_with_their_bytes_in_memory(tmp_path: Path) -> None:
    """A million zeros of four bytes, which pack to nothing; lists have offsets, too."""
    path = written(tmp_path / "a.parquet", {"a": np.zeros(1_000_000, np.float32)}, compression="zstd")
    with limits_in_force(SMALL), pytest.raises(LimitExceeded, match="bytes of all values: found 4000000, expected"):
        sizes(path)
    lists = pa.FixedSizeListArray.from_arrays(pa.array(np.zeros(400_000, np.float32)), 4)
    with limits_in_force(SMALL), pytest.raises(LimitExceeded, match="bytes of all values: found 4800000, expected"):
        sizes(written(tmp_path / "b.parquet", {"a": lists}, compression="zstd"))


def footer(tmp_path: Path, fields: dict[int, Any], before: bytes = b"") -> Path:
    """A file that is a footer only."""
    data, path = structure(fields), tmp_path / "a.parquet"
    path.write_bytes(b"PAR1" + before + data + struct.pack("<I", len(data)) + b"PAR1")
    return path


ROOT = {4: b"schema", 5: 1}
#: A column of int32, and one row group with it: one page at byte 4 of 12 bytes.
COLUMN = {1: 1, 3: 0, 4: b"a"}
CHUNK = {3: {5: 1, 7: 12, 9: 4}}
GROUP = {1: [CHUNK], 3: 1}


@table(
    ("fields", "text"),
    [
        ({4: []}, "a.parquet: schema: found no list of structures, expected one"),
        ({2: 5, 4: []}, "schema: found no list of structures"),
        ({2: [ROOT, COLUMN]}, "row groups: found no list of structures"),
        ({2: [{4: b"schema"}], 4: []}, "schema: found no number of columns, expected one"),
        ({2: [ROOT, COLUMN, COLUMN], 4: []}, "schema: found more elements than it states, expected 2"),
        ({2: [ROOT, {4: b"a"}], 4: []}, "a: found type NoneType with the width NoneType, expected one of Parquet"),
        ({2: [ROOT, {1: 9, 4: b"a"}], 4: []}, "a: found type 9 with the width NoneType"),
        ({2: [ROOT, {1: 7, 2: -1, 4: b"a"}], 4: []}, "a: found type 7 with the width -1"),
        ({2: [ROOT, {1: 1, 2: 4, 4: b"a\n" + b"x" * 200, 5: 0}], 4: [{3: 1}]}, "row group 0: found no list"),
        ({2: [ROOT, COLUMN], 4: [{1: [CHUNK]}]}, "rows: found NoneType in field 3, expected an integer of 0 or more"),
        ({2: [ROOT, COLUMN], 4: [{1: [], 3: 1}]}, "row group 0: found 0 columns and 1 row, expected 1"),
        ({2: [{4: b"s", 5: 0}], 4: [{1: [], 3: 1}]}, "row group 0: found 0 columns and 1 row, expected 0"),
        ({2: [ROOT, COLUMN], 4: [{1: [{2: 1}], 3: 1}]}, "row group 0, a: found no metadata, expected them"),
        (
            {2: [ROOT, COLUMN], 4: [{1: [{3: {5: 2, 7: 12, 9: 4}}], 3: 1}]},
            "row group 0, a: found 2 values in 1 row, expected one for each",
        ),
        (
            {2: [ROOT, COLUMN], 4: [{1: [{3: {5: 1, 7: 12, 9: 4}}], 3: 2}]},
            "found 1 value in 2 rows, expected one for each",
        ),
        ({2: [ROOT, COLUMN], 4: [{1: [{3: {5: 1, 9: 4}}], 3: 1}]}, "found NoneType in field 7"),
        (
            {2: [ROOT, COLUMN], 4: [{1: [{3: {5: 1, 7: 10**6, 9: 4}}], 3: 1}]},
            "row group 0, a: found bytes 4 to 1000004, expected a part of",
        ),
        ({2: [ROOT, COLUMN], 4: [GROUP]}, "row group 0, a: byte 4: found a page of NoneType bytes for NoneType"),
    ],
)
def test_a_footer_that_lies(fields: dict[int, Any], text: str, tmp_path: Path) -> None:
    path = footer(tmp_path, fields, bytes(12))
    with pytest.raises(DamagedRecording) as error:
        sizes(path)
    assert text in str(error.value) and str(path) in str(error.value) and "\n" not in str(error.value)


def test_a_footer_without_columns_is_a_table_without_columns(tmp_path: Path) -> None:
    assert sizes(footer(tmp_path, {2: [{4: b"s", 5: 0}], 4: []}))[::2] == (0, [])


def test_levels_and_columns_of_a_schema_are_bounded(tmp_path: Path) -> None:
    deep = [{4: b"a", 5: 1}] * 101
    with pytest.raises(LimitExceeded, match="schema: levels: found 101, expected at most 100"):
        sizes(footer(tmp_path, {2: deep, 4: []}))
    many = [{4: b"s", 5: 30}, *[COLUMN] * 30]
    with limits_in_force(FileLimits(count=50)), pytest.raises(LimitExceeded, match="row groups × columns: found 60"):
        sizes(footer(tmp_path, {2: many, 4: [{}, {}]}))


@table(
    ("data", "text"),
    [
        (b"", "found b'' at its end, expected b'PAR1'"),
        (b"PAR1", "found b'' at its end"),
        (b"PAR1" + bytes(8), "found b'\\x00\\x00\\x00\\x00' at its end"),
        (b"PAR1" + struct.pack("<I", 9) + b"PAR1", "found a footer of 9 bytes in 12 bytes"),
        (b"PAR1\x15" + struct.pack("<I", 1) + b"PAR1", "found the end inside of the footer"),
    ],
)
def test_what_is_no_parquet(data: bytes, text: str, tmp_path: Path) -> None:
    (tmp_path / "a.parquet").write_bytes(data)
    with pytest.raises(DamagedRecording) as error:
        sizes(tmp_path / "a.parquet")
    assert f"a.parquet: is not valid Parquet: {text}" in str(error.value)


def page_header(path: Path, **changes: int) -> None:
    """Write one page of three integers whose header has other numbers."""
    fact = {"kind": 0, "unpacked": 24, "packed": 24, "values": 3, "encoding": 0} | changes
    inner = b"".join([b"\x15", zigzag(fact["values"]), b"\x15", zigzag(fact["encoding"]), b"\x15\x06\x15\x06\x00"])
    head = b"".join([b"\x15", zigzag(fact["kind"]), b"\x15", zigzag(fact["unpacked"]), b"\x15", zigzag(fact["packed"])])
    data = head + {0: b"\x2c", 2: b"\x4c"}[fact["kind"]] + inner + b"\0" + struct.pack("<3q", 1, 2, 3)
    stream = io.BytesIO()
    schema = pa.schema([pa.field("a", pa.int64(), nullable=False)])
    parquet.write_table(
        pa.table({"a": [1, 2, 3]}, schema), stream, use_dictionary=False, compression="none", store_schema=False
    )
    whole = stream.getvalue()
    begin = parquet.ParquetFile(stream).metadata.row_group(0).column(0)
    rest = whole[begin.data_page_offset + begin.total_compressed_size :]
    # the footer states the length of the column; the page is as long, or padded to be
    path.write_bytes(whole[:4] + data.ljust(begin.total_compressed_size, b"\0")[: begin.total_compressed_size] + rest)


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"unpacked": 2**31 - 1}, "bytes of a page: found 2147483647, expected at most"),
        ({"values": 2**31 - 1}, "found a page with 2147483647 values, expected at most 3"),
        ({"values": -1}, "found a page with -1 values"),
        ({"packed": 2**31 - 1}, "found a page of 2147483647 bytes"),
        ({"packed": -5}, "found a page of -5 bytes"),
        ({"kind": 2, "values": 2**31 - 1}, "found a page with 2147483647 values, expected at most 24"),
    ],
)
def test_a_page_that_lies(changes: dict[str, int], text: str, tmp_path: Path) -> None:
    page_header(tmp_path / "a.parquet", **changes)
    with pytest.raises(DamagedRecording, match=text):
        sizes(tmp_path / "a.parquet")


def test_a_footer_is_bounded_by_its_length(tmp_path: Path) -> None:
    path = tmp_path / "a.parquet"
    path.write_bytes(b"PAR1" + bytes(100_000) + struct.pack("<I", 100_000) + b"PAR1")
    with limits_in_force(SMALL), pytest.raises(LimitExceeded, match="bytes of the footer: found 100000"):
        sizes(path)
