"""Parquet and Arrow files: every number is that of the CSV files, and readers of other projects read them."""

from __future__ import annotations

import csv
import random
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pandas
import pyarrow as pa
import pytest
from pyarrow import parquet

import igtl_gateway
from igtl_gateway.addons.exchange import arrow_out
from igtl_gateway.addons.exchange.targets import export_to
from igtl_gateway.api.arrow_tables import fitted, unified
from igtl_gateway.base.errors import GatewayError
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.record.sessionfile.writer import SessionWriter
from igtl_gateway.replay.state_before import with_state
from igtl_gateway.wire.message import Item, Message, encode
from igtl_gateway.wire.transform import Transform
from tests.addons.exchange import plain_arrow
from tests.addons.exchange.test_chosen_rows import definition_of, session
from tests.places import FIXTURES
from tests.tables import table

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
        found = [line for row in table.to_pylist() for line in lines(row)]
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
    assert schema.field("time_ns").metadata == {b"unit": b"ns"}
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
    image = parquet.read_table(tmp_path / "out" / "igtl_out.IMAGE_Camera.parquet")
    assert {len(pixels.as_py()) for pixels in image["pixels"]} == {320 * 240 * 3}


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


def _exported(write: Any, path: Path, out: Path, globs: tuple[str, ...], form: Any) -> tuple[object, ...]:
    account, why = None, ""
    try:
        with SessionFile.open(path) as file:
            account = write(with_state(file), out, globs, form)
    except GatewayError as error:
        why = f"{type(error).__name__}: {error}"
    files = {each.name: each.read_bytes() for each in out.iterdir()} if out.exists() else {}
    facts = (
        (account.rows, account.files, account.notes, account.others, list(account.senders.notes())) if account else ()
    )
    return why, files, facts


def _is_the_same(path: Path, folder: Path, globs: tuple[str, ...] = (), form: Any = None) -> None:
    folder.mkdir()
    form = form or arrow_out._Ipc()
    plain = _exported(plain_arrow.export, path, folder / "plain", globs, form)
    assert _exported(arrow_out._export, path, folder / "found", globs, form) == plain


@table("path", [path for path in sorted(FIXTURES.glob("*.mcap")) if path.stem not in ("brain", "lego")])
def test_a_fixture_is_written_as_message_by_message(tmp_path: Path, path: Path) -> None:
    _is_the_same(path, tmp_path / path.stem)


@table("seed", range(20))
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
