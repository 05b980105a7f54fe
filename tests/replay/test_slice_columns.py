"""A slice that is made in columns is the file that the careful way makes, group by group."""

from __future__ import annotations

import json
import random
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import pytest

from igtl_gateway.base.buffers import join
from igtl_gateway.base.errors import DamagedRecording
from igtl_gateway.cli import main
from igtl_gateway.config.configuration import Config
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.note import Level, Note
from igtl_gateway.gateway.orders import UNWRITTEN
from igtl_gateway.native.passage import is_compiled
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.record.sessionfile.stream_rows import ColumnsWriter
from igtl_gateway.record.sessionfile.writer import SessionWriter
from igtl_gateway.replay.recheck import message_counts
from igtl_gateway.replay.recorded_config import config_to_run
from igtl_gateway.replay.slice import Slice, SliceReport
from igtl_gateway.replay.slice_columns import state_in_columns
from igtl_gateway.replay.slice_state import Depth, SliceWindow, find_prologue
from tests.places import FIXTURES, is_light
from tests.tables import table
from tools.recheck import CHANGES, FEW_CHANGES, random_session, written

pytestmark = pytest.mark.skipif(not is_compiled(), reason="needs the compiled passage")

PATHS = sorted(FIXTURES.glob("*.mcap"))
PARTS = ((0.0, 0.4), (0.35, 0.7), (0.9, 1.1), (0.5, 0.5001))


def windows(file: SessionFile, parts: Sequence[tuple[float, float]] = PARTS) -> Iterator[SliceWindow]:
    span_ns = file.end_ns - file.start_ns
    for part in parts:
        start_ns, end_ns = (file.start_ns + int(share * span_ns) for share in part)
        yield SliceWindow(start_ns, end_ns + 1)


def made(path: Path, window: SliceWindow, out: Path, *, in_columns: bool) -> SliceReport | str:
    """Write the slice; return the report, or the refusal."""
    with SessionFile.open(path) as file:
        try:
            part = Slice(
                file.entries, config_to_run(file.session), window, file.entries_starting_at, file.prologue(),
                file.columns if in_columns else None, message_counts(file),
            )  # fmt: skip
        except DamagedRecording as error:
            out.unlink(missing_ok=True)
            return str(error)
        writer = SessionWriter(
            out, {}, definition_of=file.definition_of, compression="zstd", chunk_bytes=30_000,
            prologue=part.before(), overwrite=True,
        )  # fmt: skip
        part.write(writer)
        writer.close({"streams": part.report.ledger})
        return part.report


def both(path: Path, window: SliceWindow, folder: Path) -> int:
    """Write the slice in columns and with care, and compare results and files; return how many were compiled."""
    quick = made(path, window, folder / "columns", in_columns=True)
    careful = made(path, window, folder / "care", in_columns=False)
    if isinstance(quick, str) or isinstance(careful, str):
        assert quick == careful
        return 0
    assert replace(quick, compiled=0) == careful
    assert (folder / "columns").read_bytes() == (folder / "care").read_bytes()
    return quick.compiled


@pytest.mark.slow
@table("path", PATHS, ids=lambda path: str(path.stem))
def test_a_slice_of_a_fixture_is_the_same_file(path: Path, tmp_path: Path) -> None:
    with SessionFile.open(path) as file:
        found = list(windows(file))
    for window in found:
        both(path, window, tmp_path)


@table("seed", range(2), gate=lambda seed: seed < 1)
def test_a_slice_of_a_random_session_is_the_same_file(seed: int, tmp_path: Path) -> None:
    chance = random.Random(seed)
    config, entries = random_session(chance)
    path = written(tmp_path / "a.mcap", config, entries, chunk_bytes=chance.choice([2_000, 20_000, 1 << 20]))
    parts = [tuple(sorted((chance.random(), chance.random() * 1.1))) for _ in range(3)]
    with SessionFile.open(path) as file:
        found = list(windows(file, parts))  # type: ignore[arg-type]
    compiled = sum(both(path, window, tmp_path) for window in [*found, SliceWindow(0, file.end_ns + 1)])
    assert compiled > len(entries) // 10


@table("change", sorted(CHANGES), gate=lambda change: change in FEW_CHANGES)
def test_a_slice_of_a_changed_recording_is_the_same_file(change: str, tmp_path: Path) -> None:
    chance = random.Random(change)
    config, entries = random_session(chance, 200)
    path = written(tmp_path / "a.mcap", config, CHANGES[change](entries, chance))
    with SessionFile.open(path) as file:
        found = list(windows(file, ((0.2, 0.6),)))
    for window in found:
        both(path, window, tmp_path)


def unwritten_before(entries: list[Entry], places: Sequence[int]) -> list[Entry]:
    """Notes of commands that were not written before some inputs."""
    made: list[Entry] = []
    for at, entry in enumerate(entries):
        if at in places and entry.kind.is_input:
            note = Note(Level.WARN, UNWRITTEN, UNWRITTEN).pack()
            made.append(Entry(0, entry.stamp_ns - 1, Kind.EDGE_NOTE, payload=(note,)))
        made.append(entry)
    return [replace(entry, seq=number) for number, entry in enumerate(made, 1)]


@table("chunk_bytes", [500, 5_000, 1 << 20])
@table("seed", range(2))
def test_the_state_before_a_window_is_the_same(seed: int, chunk_bytes: int, tmp_path: Path) -> None:
    """Also with notes about the message after them, and where groups are in two chunks."""
    chance = random.Random(seed)
    config, entries = random_session(chance, 300)
    entries = unwritten_before(entries, sorted(chance.sample(range(len(entries)), 9 * (seed % 2))))
    compare_states(written(tmp_path / "a.mcap", config, entries, chunk_bytes=chunk_bytes), 8)


@table("path", PATHS, ids=lambda path: str(path.stem), gate=is_light)
def test_the_state_in_a_fixture_is_the_same(path: Path) -> None:
    compare_states(path, 5)


def compare_states(path: Path, number: int) -> None:
    with SessionFile.open(path) as file:
        for window in windows(file, [(share / number, 2.0) for share in range(number + 2)]):
            expected = find_prologue(file.entries(), window, Depth.STATE)
            found = state_in_columns(file.columns, window)
            assert [content(found[seq]) for seq in sorted(found)] == [
                content(expected[seq]) for seq in sorted(expected)
            ]


def content(entry: Entry) -> object:
    return replace(entry, payload=()), join(entry.payload)


@table("compression", ["zstd", "lz4", "none"])
@table("path", PATHS, ids=lambda path: str(path.stem), gate=is_light)
def test_entries_that_are_written_in_columns_give_the_same_file(path: Path, compression: str, tmp_path: Path) -> None:
    with SessionFile.open(path) as file:
        if file.foreign:
            return
        for name in ("columns", "entries"):
            writer = SessionWriter(
                tmp_path / name, {}, definition_of=file.definition_of, compression=compression, chunk_bytes=10_000  # type: ignore[arg-type]
            )  # fmt: skip
            if name == "entries":
                for entry in file.entries():
                    writer.write(entry)
            else:
                in_bulk = ColumnsWriter(writer)
                for columns in file.columns():
                    in_bulk.write(columns)
            writer.close({})
            times = writer.start_ns, writer.end_ns, writer.entries
            assert times == (file.start_ns, file.end_ns, file.entry_count)
    assert (tmp_path / "columns").read_bytes() == (tmp_path / "entries").read_bytes()


def test_the_output_states_how_the_window_was_computed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source, out = str(FIXTURES / "star.mcap"), str(tmp_path / "part.mcap")
    assert main(["slice", source, "-o", out, "--start", "2", "--end", "5"]) == 0
    assert "inputs with the state at its beginning" in capsys.readouterr().out
    assert main(["slice", source, "-o", out, "--start", "2", "--end", "5", "--overwrite", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert 0 < found["compiled"] <= found["inputs"]
    assert main(["slice", source, "-o", out, "--start", "2", "--streams", "TRANSFORM/*", "--overwrite"]) == 0
    assert "with the state at its beginning" in capsys.readouterr().out


def test_a_relay_is_cut_with_care(tmp_path: Path) -> None:
    config = Config(relay=True)
    path = written(tmp_path / "a.mcap", config, [])
    with SessionFile.open(path) as file:
        part = Slice(file.entries, config, SliceWindow(0, 1), columns=file.columns)
    assert not part.report.compiled
