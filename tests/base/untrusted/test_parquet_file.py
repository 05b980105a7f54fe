"""Parquet files of others: equal to what pyarrow reads, and bombs that end at the limits before they unpack."""

from __future__ import annotations

import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from pyarrow import parquet

from igtl_gateway.base.errors import GatewayError, LimitExceeded
from igtl_gateway.base.untrusted.limits import FileLimits, limits_in_force
from igtl_gateway.base.untrusted.parquet_file import parquet_columns, read_parquet, read_parquet_schema
from tests.tables import table

MIB = 1 << 20
#: Small limits, so that small bombs are above them.
SMALL = FileLimits(memory=4 * MIB, free=MIB, ratio=50, count=2_000)


def written(path: Path, table: pa.Table, **options: Any) -> Path:
    parquet.write_table(table, path, **options)
    return path


def good_tables() -> dict[str, pa.Table]:
    numbers = np.arange(3_000, dtype=np.float32)
    return {
        "numbers": pa.table({"a": numbers, "b": numbers.astype(np.int64), "c": numbers > 5}),
        "vectors": pa.table({"v": pa.FixedSizeListArray.from_arrays(pa.array(numbers), 3)}),
        "texts": pa.table({"s": [f"text {number % 7}" for number in range(1_000)], "t": ["ä", None] * 500}),
        "lists": pa.table({"s": [["a", "b"], [], None, ["a" * 100]], "n": [[[1.0]], [[2.0, 3.0], []], None, []]}),
        "structures": pa.table({
            "s": [{"x": "a", "y": 1}, None], "m": pa.array([[("k", "v")], []], pa.map_("string", "string")),
        }),
        "categories": pa.table({"d": pa.array(["a", "b", "a"]).dictionary_encode()}),
        "bytes": pa.table({
            "b": [b"\xff\xfe", b""], "f": pa.array([b"abcd", b"efgh"], pa.binary(4)),
            "l": pa.array(["x", "y"], pa.large_string()),
        }),
        "nothing": pa.table({"a": pa.array([], pa.int64()), "s": pa.array([], pa.string())}),
        "no columns": pa.table({}),
    }  # fmt: skip


@table("name", good_tables())
@table(
    "options",
    [
        {},
        {"compression": "zstd", "row_group_size": 100},
        {"use_dictionary": False, "data_page_version": "2.0"},
        {"data_page_size": 64, "compression": "none", "dictionary_pagesize_limit": 16, "write_batch_size": 8},
        {"row_group_size": 2},
    ],
    ids=["usual", "row groups", "pages of version 2", "small pages", "small row groups"],
)  # fmt: skip
def test_a_sound_file_is_what_pyarrow_reads(name: str, options: dict[str, Any], tmp_path: Path) -> None:
    path = written(tmp_path / "a.parquet", good_tables()[name], **options)
    found, expected = read_parquet(path), parquet.read_table(path, partitioning=None)
    assert found.schema.equals(expected.schema, check_metadata=True) and found.equals(expected)
    assert read_parquet_schema(path).equals(expected.schema)


@pytest.mark.parametrize("encoding", ["DELTA_BYTE_ARRAY", "DELTA_LENGTH_BYTE_ARRAY", "PLAIN"])
def test_every_encoding_of_strings(encoding: str, tmp_path: Path) -> None:
    table = pa.table({"s": [f"prefix {number}" for number in range(300)]})
    path = written(tmp_path / "a.parquet", table, use_dictionary=False, column_encoding={"s": encoding})
    assert read_parquet(path).equals(table)


def zeros(path: Path) -> None:
    table = pa.table({"a": np.zeros(3 * MIB, np.float32)})
    written(path, table, compression="zstd", use_dictionary=False)


def runs(path: Path) -> None:
    written(path, pa.table({"a": np.full(3 * MIB, 7, np.int64)}))


def absent(path: Path) -> None:
    written(path, pa.table({"a": pa.nulls(3 * MIB, pa.float64())}))


def long_strings(path: Path) -> None:
    written(path, pa.table({"s": pa.array(["x" * 100_000] * 2_000).dictionary_encode()}), store_schema=False)


def long_strings_in_lists(path: Path) -> None:
    strings = pa.array(["x" * 100_000] * 2_000).dictionary_encode()
    table = pa.table({"s": pa.ListArray.from_arrays(pa.array([0, 2_000]), strings)})
    written(path, table, store_schema=False)


def common_prefixes(path: Path) -> None:
    table = pa.table({"s": ["x" * 20_000 + str(number) for number in range(500)]})
    written(path, table, use_dictionary=False, column_encoding={"s": "DELTA_BYTE_ARRAY"})


def many_vectors(path: Path) -> None:
    values = pa.array(np.zeros(3 * MIB, np.float32))
    written(path, pa.table({"v": pa.FixedSizeListArray.from_arrays(values, MIB)}))


def many_columns(path: Path) -> None:
    written(path, pa.table({f"c{number}": [1] for number in range(2_100)}))


def many_row_groups(path: Path) -> None:
    written(path, pa.table({"a": np.arange(2_100)}), row_group_size=1)


def many_pages(path: Path) -> None:
    table = pa.table({"a": np.arange(2_100)})
    written(path, table, data_page_size=1, write_batch_size=1, use_dictionary=False)


BOMBS: list[Callable[[Path], None]] = [
    zeros, runs, absent, long_strings, long_strings_in_lists, common_prefixes, many_vectors, many_columns,
    many_row_groups, many_pages,
]  # fmt: skip


@pytest.mark.slow
@table("bomb", BOMBS, ids=lambda each: each.__name__)
def test_a_bomb_ends_at_a_limit_and_takes_no_memory(bomb: Callable[[Path], None], tmp_path: Path) -> None:
    path = tmp_path / "bomb.parquet"
    bomb(path)
    before = pa.total_allocated_bytes()
    tracemalloc.start()
    pool = pa.default_memory_pool()
    with limits_in_force(SMALL), pytest.raises(LimitExceeded, match=r"expected at most .*--limit") as error:
        read_parquet(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert str(path) in str(error.value)
    assert peak < 8 * MIB and pa.total_allocated_bytes() - before < 8 * MIB and pool.bytes_allocated() < 64 * MIB


def test_damage_anywhere_is_one_error(tmp_path: Path) -> None:
    """Every byte of a file changed, and every length: read, or refused with one line."""
    path = written(tmp_path / "a.parquet", good_tables()["lists"])
    data = path.read_bytes()
    random = np.random.default_rng(29)
    for _ in range(600):
        changed = bytearray(data)
        for place in random.integers(0, len(data), int(random.integers(1, 4))).tolist():
            changed[place] = int(random.integers(0, 256))
        path.write_bytes(changed[: int(random.integers(1, len(data)))] if random.random() < 0.2 else changed)
        try:
            with limits_in_force(SMALL):
                read_parquet(path)
        except GatewayError as error:
            assert str(path) in str(error) and "\n" not in str(error)


@table("name", good_tables())
def test_columns_one_by_one_are_those_of_the_table(name: str, tmp_path: Path) -> None:
    expected = good_tables()[name]
    path = written(tmp_path / "a.parquet", expected, row_group_size=100)
    with parquet_columns(path) as found:
        assert found.rows == expected.num_rows
        assert found.schema == read_parquet_schema(path)
        for column in expected.schema.names:
            assert found.read([column])[column].equals(read_parquet(path)[column])


def test_of_a_large_table_one_column_takes_the_memory_of_a_column(tmp_path: Path) -> None:
    numbers = np.arange(400_000) % 7
    path = written(tmp_path / "a.parquet", pa.table({f"c{number}": numbers for number in range(16)}))
    with parquet_columns(path) as found:
        before = pa.total_allocated_bytes()
        column = found.read(["c3"])
        assert pa.total_allocated_bytes() - before < 2 * numbers.nbytes, column.schema
