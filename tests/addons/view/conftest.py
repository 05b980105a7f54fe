"""Messages drawn into a real recording of rerun, and read back."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

from igtl_gateway.gateway.log.entry import Entry, Kind

START_NS = 1_767_225_600_000_000_000
STEP_NS = 10_000_000


def without_time(line: str) -> str:
    """A line of the log without the column of times since the first entry."""
    time, text = line[:13], line[13:]
    assert re.fullmatch(r" *-?\d+\.\d{3} s  | {13}", time), line
    return text


@dataclass
class Drawn:
    """The content of a recording, and the notes of the drawing."""

    view: Any
    batches: dict[str, list[Any]] = field(default_factory=dict)
    static_batches: dict[str, list[Any]] = field(default_factory=dict)

    def rows(self, path: str) -> list[dict[str, Any]]:
        """Rows of an entity in the order of entries; times as numbers of nanoseconds."""
        rows = [row for batch in self.batches.get(path, []) for row in _rows(batch)]
        return sorted(rows, key=lambda row: row["entry"])

    def static(self, path: str) -> dict[str, Any]:
        """What an entity is at all times."""
        told: dict[str, Any] = {}
        for batch in self.static_batches.get(path, []):
            for row in _rows(batch):
                told |= row
        return told

    def one(self, path: str) -> dict[str, Any]:
        """The only row of an entity."""
        (row,) = self.rows(path)
        return row

    def count(self, path: str) -> int:
        return sum(batch.num_rows for batch in self.batches.get(path, []))

    def log(self) -> list[str]:
        return [without_time(row["TextLog:text"][0]) for row in self.rows("session/log")]


def _rows(batch: Any) -> list[dict[str, Any]]:
    columns = {}
    for name in batch.schema.names:
        column = batch.column(name)
        if "RowId" not in name:
            columns[name] = (column.cast("int64") if str(column.type).startswith("timestamp") else column).to_pylist()
    rows = ({name: values[row] for name, values in columns.items()} for row in range(batch.num_rows))
    return [{name: value for name, value in row.items() if value is not None} for row in rows]


Draw = Callable[..., Drawn]


def messages(*said: Any, topic: str = "/topic", kind: Kind = Kind.ROS_IN) -> list[Entry]:
    """Entries of ROS messages, 10 ms apart; each ``said`` is a message, or (topic, message)."""
    entries = []
    for number, each in enumerate(said, 1):
        channel, message = each if isinstance(each, tuple) else (topic, each)
        stamp_ns = START_NS + number * STEP_NS
        entries.append(Entry(number, stamp_ns, kind, channel, message.TYPE, (message.pack(),)))
    return entries


def read_back(path: Path, view: Any = None) -> Drawn:
    """All of a recording of rerun."""
    from rerun.chunk import RrdReader

    drawn = Drawn(view)
    for chunk in RrdReader(str(path)).store().stream():
        batches = drawn.static_batches if chunk.is_static else drawn.batches
        batches.setdefault(chunk.entity_path.removeprefix("/"), []).append(chunk.to_record_batch())
    return drawn


@pytest.fixture
def draw(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Draw:
    """Draws entries or messages: ``draw(message, …)``, ``draw(entries=…)``, with the options of ``SessionView``."""
    pytest.importorskip("rerun", reason="rerun is not installed (extra 'view')")
    monkeypatch.setenv("RERUN_STRICT", "1")
    from igtl_gateway.addons.view import stream
    from igtl_gateway.addons.view.session import SessionView

    def drawing(*said: Any, entries: Iterable[Entry] = (), topic: str = "/topic", **options: Any) -> Drawn:
        path = tmp_path / "drawn.rrd"
        recording = stream.to_file(path, "test")
        view = SessionView(recording, **options)
        for entry in [*messages(*said, topic=topic), *entries]:
            view.take(entry)
        view.finish()
        stream.close(recording)
        return read_back(path, view)

    return drawing
