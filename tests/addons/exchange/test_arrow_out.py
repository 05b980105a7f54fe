"""Parquet and Arrow files: every number is that of the CSV files, and readers of other projects read them."""

from __future__ import annotations

import csv
import random
import sqlite3
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pandas
import pyarrow as pa
import pytest
from pyarrow import parquet

import igtl_gateway
from igtl_gateway.addons.exchange import arrow_out
from igtl_gateway.addons.exchange.arrow_names import DatabaseColumns, sql_name
from igtl_gateway.addons.exchange.targets import export_to
from igtl_gateway.api.arrow_tables import fitted, unified
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.record.sessionfile.writer import SessionWriter
from igtl_gateway.wire.message import Item, Message, encode
from igtl_gateway.wire.transform import Transform
from tests.addons.exchange import plain_arrow
from tests.addons.exchange.exported import exported
from tests.addons.exchange.test_chosen_rows import definition_of, session
from tests.places import FIXTURES, is_light
from tests.tables import table


def in_csv(field: pa.Field) -> str:
    """The name of a field in CSV."""
    return (field.metadata or {}).get(b"field", field.name.encode()).decode()


def plain(table: pa.Table) -> list[dict[str, Any]]:
    """The rows of a file with the names of CSV and stamps as integers, without pictures that are elsewhere."""
    elsewhere = {name.removesuffix("_entry") for name in table.column_names if name.endswith("_entry")}
    return [
        {
            in_csv(field): _plain(field, value)
            for field in table.schema
            if field.name not in elsewhere and field.name.removesuffix("_entry") not in elsewhere
            for value in [row[field.name]]
        }
        for row in _rows(table)
    ]


def _rows(table: pa.Table) -> list[dict[str, Any]]:
    """Rows of Python, which has no times with nanoseconds."""
    columns = [_integers(column.combine_chunks()).to_pylist() for column in table.columns]
    return [dict(zip(table.column_names, row, strict=True)) for row in zip(*columns, strict=True)]


def _integers(array: pa.Array) -> pa.Array:
    return array.cast(_integer(array.type)) if not pa.types.is_map(array.type) else array


def _integer(kind: pa.DataType) -> pa.DataType:
    if pa.types.is_timestamp(kind):
        assert kind == pa.timestamp("ns", tz="UTC")
        return pa.int64()
    if pa.types.is_list(kind):
        return pa.list_(_integer(kind.value_type))
    if pa.types.is_struct(kind):
        return pa.struct([pa.field(each.name, _integer(each.type)) for each in kind])
    return kind


def _plain(field: pa.Field, value: Any) -> Any:
    kind = field.type
    if pa.types.is_list(kind) and value is not None:
        return [_plain(kind.value_field, each) for each in value]
    if pa.types.is_struct(kind) and value is not None:
        return {in_csv(each): _plain(each, value[each.name]) for each in kind}
    return value


ONE = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)


def cells(name: str, value: Any) -> Iterator[tuple[str, Any]]:
    """A value of a table as cells of CSV."""
    if isinstance(value, dict):
        for key, inner in value.items():
            yield from cells(f"{name}.{key}", inner)
    elif isinstance(value, bytes):
        yield from cells(name, list(value))
    elif isinstance(value, list):
        for index, inner in enumerate(value):
            yield from cells(f"{name}.{index}", inner)
    else:
        yield name, "" if value is None else str(value).replace("\0", "\ufffd")


def lines(row: dict[str, Any]) -> Iterator[dict[str, str]]:
    """A row of a table as rows of CSV: one for each element of its lists of structs."""
    nested = {
        name: value
        for name, value in row.items()
        if isinstance(value, list) and value and isinstance(value[0], dict) and "." not in name
    }
    rest = dict(cell for name, value in row.items() if name not in nested for cell in cells(name, value))
    for item in range(max(map(len, nested.values()), default=1)):
        more = {"item": str(item)} if nested else {}
        for name, value in nested.items():
            if item < len(value):
                more |= dict(cells(name, value[item]))
        yield rest | more


@pytest.mark.parametrize(("name", "form"), [("star", "arrow"), ("every-type", "parquet")])
def test_every_number_is_that_of_csv(name: str, form: str, tmp_path: Path) -> None:
    with SessionFile.open(FIXTURES / f"{name}.mcap") as file:
        table_account = export_to(form, file, tmp_path / "tables", ())
        csv_account = export_to("csv", file, tmp_path / "csv", ())
    assert all(row.declared == row.taken + row.left_out for row in table_account.rows)
    assert [row.stream for row in table_account.rows] == [row.stream for row in csv_account.rows]
    # only what cannot be decoded is left out
    assert sum(row.failed for row in table_account.rows) == sum(row.failed for row in csv_account.rows)
    compared = 0
    for path in sorted((tmp_path / "csv").glob("*.csv")):
        source = tmp_path / "tables" / f"{path.stem}.{form}"
        table = parquet.read_table(source) if form == "parquet" else pa.ipc.open_file(source).read_all()
        found = [line for row in plain(table) for line in lines(row)]
        with path.open(encoding="utf-8", newline="") as stream:
            expected = list(csv.DictReader(stream))
        by_entry: dict[tuple[str, str], dict[str, str]] = {
            (line["entry"], line.get("item", "")): line for line in found
        }
        for line in expected:
            own = by_entry[line["entry"], line.get("item", "")]
            for column, cell in line.items():
                # csv is written before it is known that another peer sends the stream, too
                is_before = column == "link" and not cell
                assert own.get(column, "") == cell or column == "item" or is_before, (path.name, column)
                compared += 1
    assert compared > 5_000


def test_units_are_in_the_schema_and_pandas_reads_the_files(tmp_path: Path) -> None:
    with SessionFile.open(FIXTURES / "star.mcap") as file:
        assert export_to("parquet", file, tmp_path / "out", ()).files == 25
    path = tmp_path / "out" / "igtl_out.TRANSFORM_ToolToBase.parquet"
    schema = parquet.read_schema(path)
    assert schema.field("x_mm").metadata == {b"unit": b"mm"}
    assert schema.field("time").metadata == {b"field": b"time_ns"}
    assert schema.field("time").type == schema.field("source_time").type == pa.timestamp("ns", tz="UTC")
    assert schema.field("r11").metadata is None
    assert {key: schema.metadata[key] for key in (b"stream", b"type", b"direction")} == {
        b"stream": b"TRANSFORM/ToolToBase",
        b"type": b"TRANSFORM",
        b"direction": b"igtl_out",
    }
    frame = pandas.read_parquet(path)
    assert len(frame) == 1200 and frame["x_mm"].iloc[0] == pytest.approx(580.57)
    points = parquet.read_schema(tmp_path / "out" / "igtl_in.POINT_PlanPoints.parquet")
    element = points.field("elements").type.value_type
    assert element.field("diameter_mm").metadata == {b"unit": b"mm"}
    cloud = parquet.read_table(tmp_path / "out" / "igtl_out.POLYDATA_TissueCloud.parquet")
    assert cloud.schema.field("points_mm").type == pa.list_(pa.list_(pa.float32(), 3))
    assert frame["time"].dtype == "datetime64[ns, UTC]"


def test_pictures_are_written_once(tmp_path: Path) -> None:
    with SessionFile.open(FIXTURES / "star.mcap") as file:
        account = export_to("parquet", file, tmp_path / "all", ())
        alone = export_to("parquet", file, tmp_path / "alone", ("out:IMAGE/Camera",))
    sent = parquet.read_table(tmp_path / "all" / "igtl_out.IMAGE_Camera.parquet")
    given = parquet.read_table(tmp_path / "all" / "ros_in.star_camera_image.parquet")
    assert sent["pixels"].null_count == len(sent)
    by_entry = dict(zip(given["entry"].to_pylist(), given["data"].to_pylist(), strict=True))
    found = [by_entry[entry] for entry in sent["pixels_entry"].to_pylist()]
    own = parquet.read_table(tmp_path / "alone" / "igtl_out.IMAGE_Camera.parquet")
    assert own["pixels"].to_pylist() == found, "the same as where its source is not exported"
    assert {len(pixels) for pixels in found} == {320 * 240 * 3}
    assert [note for note in account.notes if note.startswith("pictures once: those of igtl_out.IMAGE_Camera.parquet")]
    assert not [note for note in alone.notes if note.startswith("pictures once")]


def sql_names(kind: pa.DataType, place: str) -> Iterator[str]:
    """The expressions of SQL for what is inside of a column."""
    if pa.types.is_list(kind):
        yield from sql_names(kind.value_type, f"{place}[1]")
    elif pa.types.is_struct(kind):
        for each in kind:
            yield f"{place}.{each.name}"
            yield from sql_names(each.type, f"{place}.{each.name}")


@pytest.fixture(scope="module")
def every_type(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The tables of every type."""
    out = tmp_path_factory.mktemp("tables") / "out"
    with SessionFile.open(FIXTURES / "every-type.mcap") as file:
        export_to("parquet", file, out, ())
    return out


def test_sql_takes_each_column_without_quotes(every_type: Path) -> None:
    duckdb = pytest.importorskip("duckdb", reason="needs DuckDB")
    seen: set[str] = set()
    connection = duckdb.connect()
    for path in sorted(every_type.iterdir()):
        schema = parquet.read_schema(path)
        names = [each for field in schema for each in (field.name, *sql_names(field.type, f"t.{field.name}"))]
        if set(names) <= seen:
            continue
        seen.update(names)
        found = connection.sql(f"SELECT {', '.join(names)} FROM '{path}' t ORDER BY time LIMIT 1")
        assert len(found.to_arrow_table().columns) == len(names)
        assert len({name.lower() for name in schema.names}) == len(schema.names)
        with closing(sqlite3.connect(":memory:")) as other:
            other.execute(f"CREATE TABLE t ({', '.join(schema.names)})")
            other.execute(f"SELECT {', '.join(schema.names)} FROM t")
    assert len(seen) > 150
    path = every_type / "igtl_in.TRANSFORM_MarkerToCamera.parquet"
    (zone,) = connection.execute(f"SELECT DISTINCT typeof(time) FROM '{path}'").fetchone()
    assert zone.startswith("TIMESTAMP"), zone
    where = "time > '2000-01-01' AND epoch_ns(time) >= epoch_ns(source_time)"
    taken = connection.execute(f"SELECT count(*) FROM '{path}' WHERE {where}").fetchone()
    assert taken[0] == parquet.read_metadata(path).num_rows


@table(
    ("name", "expected"),
    [
        ("x_mm", "x_mm"),
        ("transform.translation.x_m", "transform_translation_x_m"),
        ("position.0", "position_0"),
        ("0", "n0"),
        ("end", "end_"),
        ("Values", "Values_"),
        ("äö", "field"),
        ("a-b c", "a_b_c"),
    ],
)
def test_a_name_for_sql(name: str, expected: str) -> None:
    assert sql_name(name) == expected


def test_two_names_stay_two() -> None:
    found = DatabaseColumns(frozenset()).table(
        pa.table({"a.b": [1], "a_b": [2], "A-B": [3], "time": [4], "time_ns": [5]})
    )
    assert found.column_names == ["a_b", "a_b_2", "A_B_3", "time", "time_2"]
    assert [column[0].as_py() for column in found.columns[:4]] == [1, 2, 3, 4]


def test_stamps_are_times_and_durations_are_numbers(every_type: Path) -> None:
    found = {(field.name, str(field.type)) for path in every_type.iterdir() for field in parquet.read_schema(path)}
    assert ("header_stamp", "timestamp[ns, tz=UTC]") in found
    assert ("lifetime_ns", "int64") in found
    assert not [name for name, _ in found if name.endswith("stamp_ns")]


def recorded(path: Path, contents: list[Transform]) -> SessionFile:
    writer = SessionWriter(path, {})
    for number, content in enumerate(contents, 1):
        kind = "TRANSFORM"
        data = b"".join(bytes(part) for part in encode(Message(kind, "A", content)))
        writer.write(Entry(number, number, Kind.IGTL_IN, f"{kind}/A", kind, (data,), (1,)))
    writer.close({})
    return SessionFile.open(path)


@pytest.mark.parametrize("form", ["parquet", "arrow"])
def test_later_messages_may_add_columns(form: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(arrow_out, "_ROWS", 2)
    identity = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
    contents = [Transform((*identity, float(number), 0.0, 0.0)) for number in range(5)]
    with recorded(tmp_path / "a.mcap", contents) as file:
        entries = list(file.entries())
    head = bytearray(entries[0].data()[:58])
    head[42:58] = bytes(16)  # a body of no bytes, with their CRC
    writer = SessionWriter(tmp_path / "b.mcap", {})
    for entry in entries:
        writer.write(entry)
    writer.write(Entry(6, 6, Kind.IGTL_IN, "TRANSFORM/A", "TRANSFORM", (bytes(head),), (1,)))
    writer.close({})
    with SessionFile.open(tmp_path / "b.mcap") as file:
        account = export_to(form, file, tmp_path / "out", ())
    assert [(row.declared, row.taken) for row in account.rows] == [(6, 6)]
    (path,) = (tmp_path / "out").iterdir()
    table = parquet.read_table(path) if form == "parquet" else pa.ipc.open_file(path).read_all()
    assert table["x_mm"].to_pylist() == [0.0, 1.0, 2.0, 3.0, 4.0, None]
    assert table["entry"].to_pylist() == [1, 2, 3, 4, 5, 6]


@pytest.mark.parametrize("form", ["parquet", "arrow"])
def test_metadata_is_a_column_of_those_that_have_it(form: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(arrow_out, "_ROWS", 2)  # the column comes with a later table
    pose = Transform((1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 2.0, 3.0, 4.0))
    items = (Item.of("MessageIDString", "7"), Item.of("Bediener", "Müller"), Item.of("", ""), Item("raw", b"\xff\0"))
    twice = (Item.of("a", "1"), Item.of("a", "2"))
    messages = [
        *(Message("TRANSFORM", "A", pose, header_version=version) for version in (1, 1, 2)),
        *(Message("TRANSFORM", "A", pose, header_version=2, metadata=each) for each in (items, twice)),
    ]
    writer = SessionWriter(tmp_path / "a.mcap", {})
    for number, message in enumerate(messages, 1):
        data = b"".join(bytes(part) for part in encode(message))
        writer.write(Entry(number, number, Kind.IGTL_IN, "TRANSFORM/A", "TRANSFORM", (data,), (1,)))
    writer.close({})
    with SessionFile.open(tmp_path / "a.mcap") as file:
        assert [(row.declared, row.taken) for row in export_to(form, file, tmp_path / "out", ()).rows] == [(5, 5)]
    (path,) = (tmp_path / "out").iterdir()
    table = parquet.read_table(path) if form == "parquet" else pa.ipc.open_file(path).read_all()
    assert table["x_mm"].to_pylist() == [2.0] * 5
    own = [[(item.key, item.text) for item in each] for each in (items, twice)]
    assert table["metadata"].to_pylist() == [None, None, None, *own]
    with igtl_gateway.open(tmp_path / "a.mcap") as recording:
        assert recording["TRANSFORM/A"].to_arrow()["metadata"].to_pylist() == [None, None, None, *own]
        assert recording["TRANSFORM/A"].to_pandas()["metadata"].iloc[4] == own[1]


def test_columns_of_different_types_become_text() -> None:
    one, two = pa.table({"a": [1, 2], "b": [1.5, 2.5]}), pa.table({"a": ["x"], "c": [[{"d": 1}]]})
    wider = unified(one.schema, two.schema)
    assert fitted(one, wider).to_pydict() == {"a": ["1", "2"], "b": [1.5, 2.5], "c": [None, None]}
    assert fitted(two, wider).to_pydict() == {"a": ["x"], "b": [None], "c": [[{"d": 1}]]}


def _is_the_same(path: Path, folder: Path, globs: tuple[str, ...] = (), form: Any = None) -> None:
    folder.mkdir()
    form = form or arrow_out._Ipc()
    plain = exported(plain_arrow.export, path, folder / "plain", globs, form)
    assert exported(arrow_out._export, path, folder / "found", globs, form) == plain


@table("path", [path for path in sorted(FIXTURES.glob("*.mcap")) if path.stem not in ("brain", "lego")], gate=is_light)
def test_a_fixture_is_written_as_message_by_message(tmp_path: Path, path: Path) -> None:
    _is_the_same(path, tmp_path / path.stem)


@table("seed", range(20), gate=lambda seed: seed < 7)
def test_so_is_a_random_session(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, seed: int) -> None:
    """Also in small tables, and with more streams than there may be files."""
    rng = random.Random(seed)
    monkeypatch.setattr(arrow_out, "_ROWS", rng.choice((7, 50, 20_000)))
    monkeypatch.setattr(arrow_out, "_BYTES", rng.choice((5_000, 64 << 20)))
    monkeypatch.setattr(arrow_out, "_MAX_FILES", rng.choice((4, 500, 500)))
    path, chunk = tmp_path / "a.mcap", rng.choice((3_000, 20_000, 1 << 20))
    writer = SessionWriter(path, {}, definition_of=definition_of, chunk_bytes=chunk, overwrite=True)
    for entry in session(rng, rng.choice((5, 100, 300))):
        writer.write(entry)
    writer.close({})
    globs = rng.choice(((), (), ("TRANSFORM/*",), ("in:TRANSFORM/A@1", "/any"), ("/pose",)))
    _is_the_same(path, tmp_path / str(seed), globs, rng.choice((arrow_out._Ipc(), arrow_out._Parquet())))
    monkeypatch.undo()


def test_peers_with_other_units_have_files_of_their_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for module in (arrow_out, plain_arrow):
        units = SimpleNamespace(of=lambda _kind, _channel, _type, links: "m" if 2 in links else "mm")
        monkeypatch.setattr(module, "recorded_units", lambda _, units=units: units)
    writer = SessionWriter(tmp_path / "a.mcap", {})
    for number in range(1, 40):
        data = b"".join(encode(Message("TRANSFORM", "A", Transform((*ONE, number, 0.0, 0.0)))))
        link = 1 + number % 3 % 2
        writer.write(Entry(number, number, Kind.IGTL_IN, "TRANSFORM/A", "TRANSFORM", (data,), (link,)))
    writer.close({})
    _is_the_same(tmp_path / "a.mcap", tmp_path / "out")
    assert len(list((tmp_path / "out" / "found").iterdir())) == 2
