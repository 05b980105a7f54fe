"""``record/sessionfile/figures.py``: what a recorder counts is what a pass over the entries counts."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from io import BytesIO
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from igtl_gateway.base.errors import DamagedRecording
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.note import Level, Note
from igtl_gateway.record.sessionfile import entry_counts as counts
from igtl_gateway.record.sessionfile import figures, layout
from igtl_gateway.record.sessionfile.entry_counts import PlainCounts
from igtl_gateway.record.sessionfile.figures import Figures, parse_figures
from igtl_gateway.record.sessionfile.layout import LayoutError
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.record.sessionfile.writer import SessionWriter
from tests.places import FIXTURES
from tests.record import samples
from tests.replay.test_content_columns import ROWS, session
from tests.tables import table

NAMES = sorted(path.stem for path in FIXTURES.glob("*.mcap"))


def entries_of(name: str) -> list[Entry]:
    with SessionFile.open(FIXTURES / f"{name}.mcap") as file:
        return list(file.entries())


def written(path: Path, entries: Iterable[Entry], **options: Any) -> dict[str, str] | None:
    """The figures of a file with these entries."""
    writer = SessionWriter(path, samples.SESSION, counted=True, **options)
    for entry in entries:
        writer.write(entry)
    writer.close({})
    with SessionFile.open(path) as file:
        return file.figures()


@table("name", NAMES)
def test_python_counts_as_c_does(name: str, tmp_path_factory: pytest.TempPathFactory) -> None:
    folder, entries = tmp_path_factory.mktemp("twins"), entries_of(name)
    found = []
    for number, made in enumerate((counts.Counts, PlainCounts)):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(counts, "Counts", made)
            found.append(written(folder / f"{number}.mcap", entries, chunk_bytes=9_000))
    assert found[0] == found[1]
    assert found[0]
    assert (folder / "0.mcap").read_bytes() == (folder / "1.mcap").read_bytes()


@given(rows=ROWS, chunk_bytes=st.sampled_from((300, 9_000)))
def test_python_counts_a_random_session_as_c_does(rows: list[Any], chunk_bytes: int) -> None:
    entries, found = session(rows), []
    for made in (counts.Counts, PlainCounts):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(counts, "Counts", made)
            found.append(_counted(entries, chunk_bytes))
    assert found[0] == found[1]


@given(entries=samples.sessions(), chunk_bytes=st.sampled_from((300, 9_000)))
def test_python_counts_any_entries_as_c_does(entries: list[Entry], chunk_bytes: int) -> None:
    found = []
    for made in (counts.Counts, PlainCounts):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(counts, "Counts", made)
            found.append(_counted(entries, chunk_bytes))
    assert found[0] == found[1]


def _counted(entries: list[Entry], chunk_bytes: int) -> str:
    writer = SessionWriter(Path("memory"), {}, memory=BytesIO(), chunk_bytes=chunk_bytes)
    found = Figures()
    writer.count(figures.FILE, found)
    for entry in entries:
        writer.write(entry)
    writer.close({})
    return found.text()


def test_a_large_message_whose_end_is_not_in_the_chunk(tmp_path: Path) -> None:
    large = samples.igtl(1, body=bytes(2 << 20), source_ns=samples.START_NS - 9_000_000)
    items = written(tmp_path / "a.mcap", [large, samples.ros(2), samples.igtl(3, body=bytes(300_000))])
    assert items
    wire, ros = parse_figures(items[figures.FILE]).streams
    assert (wire.messages, wire.bytes) == (2, large.size + 300_058)
    assert (ros.messages, ros.bytes) == (1, samples.ros(2).size)


def test_where_streams_share_a_channel_there_are_none(tmp_path: Path) -> None:
    many = [samples.igtl(seq, device=f"d{seq}") for seq in range(1, layout.MAX_WIRE_STREAMS + 3)]
    assert written(tmp_path / "a.mcap", many[: layout.MAX_WIRE_STREAMS])
    assert written(tmp_path / "b.mcap", many) is None


def test_a_stamp_beyond_64_bits_and_too_many_links_leave_none(tmp_path: Path) -> None:
    late = Entry(1, (1 << 63) + 5, Kind.ROS_IN, "/a", "std_msgs/msg/Empty", (b"",))
    assert written(tmp_path / "a.mcap", [late]) is None
    many = (samples.igtl(seq, links=(seq,)) for seq in range(1, counts.MOST_LINKS + 2))
    assert written(tmp_path / "b.mcap", many) is None


def test_a_note_about_the_clock_whose_end_is_not_in_the_chunk(tmp_path: Path) -> None:
    data = {"step_ns": 5, "jump_ns": 1_000, "ahead_ns": 0}
    note = Note(Level.WARN, "clock_step", "x" * (1 << 20), data=data).pack()
    entries = [samples.igtl(1), Entry(2, samples.START_NS + 2_000, Kind.EDGE_NOTE, payload=(note,))]
    items = written(tmp_path / "a.mcap", entries)
    assert items and parse_figures(items[figures.FILE]).streams[0].first_ns == samples.START_NS + 1 + 1_000


def right() -> dict[str, Any]:
    """Figures that are right."""
    made = Figures()
    writer = SessionWriter(Path("memory"), {}, memory=BytesIO())
    writer.count(figures.FILE, made)
    for seq in range(1, 30):
        writer.write(samples.igtl(seq, source_ns=samples.START_NS - seq * 1_000_000))
    writer.close({})
    found: dict[str, Any] = json.loads(made.text())
    return found


def changed(place: str, value: Any) -> dict[str, Any]:
    """Figures with another value at a place: ``streams.0.messages``."""
    found = right()
    name, row, column = place.split(".")
    found[name]["rows"][int(row)][found[name]["columns"].index(column)] = value
    return found


@table(
    ("place", "value"),
    [
        *(
            (f"streams.0.{name}", value)
            for name in ("messages", "bytes", "unstamped")
            for value in (-1, 1.5, "3", None)
        ),
        ("streams.0.messages", 0),
        ("streams.0.messages", 30),  # other than the clocks
        ("streams.0.messages", True),
        ("streams.0.kind", "note"),
        ("streams.0.kind", 7),
        ("streams.0.channel", ["a"]),
        ("streams.0.first_ns", 1 << 63),
        ("streams.0.first_ns", samples.START_NS + 99),
        ("streams.0.unstamped", 30),
        ("streams.0.unstamped", 29),  # no ages then
        ("streams.0.median_age_and_range_ns", None),
        ("streams.0.median_age_and_range_ns", [1]),
        ("streams.0.median_age_and_range_ns", [1, -1]),
        ("streams.0.median_age_and_range_ns", [1, 1 << 70]),
        ("streams.0.links", [1 << 32]),
        ("streams.0.links", None),
        ("clocks.0.link", -1),
        ("clocks.0.channel", 1),
        ("clocks.0.messages", 28),
        ("clocks.0.unset", 30),
        ("clocks.0.future", 30),
        ("clocks.0.steps", 16),
        ("clocks.0.least_age_ns", 1 << 62),
        ("clocks.0.first_block", [1, 2]),
        ("clocks.0.last_block", [1, 2, 3]),
    ],
)
def test_what_no_entries_have_is_refused(place: str, value: Any) -> None:
    parse_figures(json.dumps(right()))
    with pytest.raises(LayoutError, match=r"^figures: found "):
        parse_figures(json.dumps(changed(place, value)))


@table(
    "text", ["", "{", "[]", "null", "7", '{"streams": 1}', '{"streams": {"columns": [], "rows": []}}', "[" * 100_000]
)
def test_other_json_is_refused(text: str) -> None:
    with pytest.raises((LayoutError, DamagedRecording)):
        parse_figures(text)


def test_a_row_twice_and_another_number_of_columns_are_refused() -> None:
    changes: tuple[Callable[[list[Any]], None], ...] = (
        lambda rows: rows.append(rows[0]),
        lambda rows: rows[0].append(1),
        lambda rows: rows.append(7),
    )
    for change in changes:
        for name in ("streams", "clocks"):
            found = right()
            change(found[name]["rows"])
            with pytest.raises(LayoutError):
                parse_figures(json.dumps(found))
