"""Comparison by rows of arrays against the plain way, entry by entry: equal reports of any two sessions."""

from __future__ import annotations

import random
from dataclasses import asdict, replace
from itertools import islice
from pathlib import Path

import pytest

from igtl_gateway.app.comparison import compare_recordings
from igtl_gateway.base.errors import GatewayError
from igtl_gateway.cli import main
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.record.sessionfile.columns import Unfit
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.record.sessionfile.writer import SessionWriter
from igtl_gateway.replay import diff as by_rows
from igtl_gateway.replay.compare import EXACT, LeafDecoder, Tolerance
from tests.places import FIXTURES, is_light
from tests.record import samples
from tests.record.sessionfile.test_index import DEFINITIONS, bag, messages
from tests.replay import plain_diff
from tests.tables import table
from tools import mcap_mutations
from tools.mcap_build import Chunk

SECOND = 1_000_000_000
#: Messages and bytes that wait for a match, and messages that are searched; the small ones are often full.
WINDOWS = ((1024, 32 << 20, 16), (20, 1 << 20, 4), (20, 30_000, 4), (5, 5_000, 3))

Report = tuple[list[str], int, float]


def facts(report: by_rows.DiffReport | plain_diff.DiffReport) -> Report:
    return [repr(asdict(each)) for each in report.streams], report.stamp_offset_ns, report.offset_ns


def compared(one: Path, other: Path, tolerance: Tolerance = EXACT, globs: tuple[str, ...] = ()) -> list[Report | str]:
    """What the plain way, columns, and columns beside entries find; or how they refuse."""

    def decoder(file: SessionFile) -> LeafDecoder:
        return LeafDecoder(file.definitions)

    def plain(first: SessionFile, second: SessionFile) -> Report:
        sides = (plain_diff.DiffInput(each.entries(), decoder(each)) for each in (first, second))
        return facts(plain_diff.diff(*sides, tolerance=tolerance, globs=globs))

    def columns(first: SessionFile, second: SessionFile) -> Report:
        sides = (by_rows.DiffInput((), decoder(each), each.columns()) for each in (first, second))
        return facts(by_rows.diff(*sides, tolerance=tolerance, globs=globs))

    def mixed(first: SessionFile, second: SessionFile) -> Report:
        sides = (
            by_rows.DiffInput(first.entries(), decoder(first)),
            by_rows.DiffInput((), decoder(second), second.columns()),
        )
        return facts(by_rows.diff(*sides, tolerance=tolerance, globs=globs))

    found: list[Report | str] = []
    for way in (plain, columns, mixed):
        try:
            with SessionFile.open(one) as first, SessionFile.open(other) as second:
                found.append(way(first, second))
        except GatewayError as error:
            found.append(f"{type(error).__name__}: {error}")
    return found


def session(rng: random.Random, count: int) -> list[Entry]:
    """Entries of every kind; in some sessions many messages are equal."""
    entries: list[Entry] = []
    now, alike = samples.START_NS, rng.random() < 0.5
    for seq in range(1, count + 1):
        now += rng.choice((1, 1_000, 1_000_000, 1_000_000, 50_000_000))
        source_ns = rng.choice((0, now - 5, now - 5_000))
        match rng.randrange(9):
            case 0 | 1:
                body = bytes([rng.randrange(3)]) * 48 if alike else rng.randbytes(48)
                kind, links = rng.choice((Kind.IGTL_IN, Kind.IGTL_OUT)), rng.choice(((1,), (1,), (1, 2)))
                entry = samples.igtl(seq, kind, device=rng.choice("ab"), body=body, links=links, source_ns=source_ns)
            case 2 | 3:
                text = rng.choice("xyz") if alike else str(rng.random())
                entry = samples.ros(
                    seq, rng.choice((Kind.ROS_IN, Kind.ROS_OUT)), topic=rng.choice(("/a", "/b")), text=text
                )
                entry = replace(entry, source_ns=source_ns)
            case 4:
                kind = rng.choice((Kind.NOTE, Kind.EDGE_NOTE, Kind.LINK))
                entry = samples.note(seq, kind, code=rng.choice(("bad", "good")), links=rng.choice(((1,), (2,))))
            case 5:
                body = bytes(rng.randrange(20_000))
                entry = samples.igtl(seq, message_type="STRING", device="big", body=body, source_ns=source_ns)
            case _:
                entry = samples.ros(seq, topic="/fast", text=str(seq // rng.choice((1, 1, 5))))
        entries.append(replace(entry, stamp_ns=now))
    return entries


def changed(rng: random.Random, entries: list[Entry]) -> list[Entry]:
    """The entries with some left out, doubled, swapped, later, or with another byte, stamp or link."""
    entries = list(entries)
    for _ in range(rng.choice((0, 1, 1, 2, 5, 40))):
        if len(entries) < 3:
            break
        at, there = rng.randrange(len(entries)), rng.randrange(len(entries))
        here = entries[at]
        match rng.randrange(9):
            case 0:
                del entries[at]
            case 1:
                del entries[at : at + rng.randrange(60)]
            case 2:
                other = entries[there]
                entries[at], entries[there] = (
                    replace(other, stamp_ns=here.stamp_ns),
                    replace(here, stamp_ns=other.stamp_ns),
                )
            case 3 if here.channel:
                data = bytearray(here.data())
                data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
                entries[at] = replace(here, payload=(bytes(data),))
            case 4:
                entries.insert(at, replace(entries[there], stamp_ns=here.stamp_ns))
            case 5:
                by_ns = rng.choice((1, SECOND, 10 * SECOND))
                entries[at:] = [replace(each, stamp_ns=each.stamp_ns + by_ns) for each in entries[at:]]
            case 6 if here.source_ns:
                entries[at] = replace(here, source_ns=here.source_ns + rng.choice((1, 5_000)))
            case 7 if here.kind in (Kind.IGTL_IN, Kind.IGTL_OUT):
                entries[at] = replace(here, links=(3,))
            case 8 if rng.random() < 0.2:
                entries = [each for each in entries if each.channel != here.channel]
    found, last = [], 0
    for seq, entry in enumerate(entries, 1):
        last = max(last + 1, entry.stamp_ns)
        found.append(replace(entry, seq=seq, stamp_ns=last))
    return found


def write(path: Path, entries: list[Entry], rng: random.Random) -> Path:
    compression, chunk_bytes = rng.choice(("lz4", "zstd", "none")), rng.choice((500, 5_000, 100_000, 1 << 20))
    writer = SessionWriter(path, {}, compression=compression, chunk_bytes=chunk_bytes, overwrite=True)  # type: ignore[arg-type]
    for entry in entries:
        writer.write(entry)
    writer.close({})
    return path


def check_random_pair(folder: Path, seed: int) -> None:
    rng = random.Random(seed)
    one = session(rng, rng.choice((0, 1, 5, 50, 500)))
    other = changed(rng, one) if rng.random() < 0.9 else session(rng, 200)
    if rng.random() < 0.2:
        one, other = other, one
    tolerance, globs = Tolerance(mm=rng.choice((0, 0, 1))), rng.choice(((), (), ("/a", "TRANSFORM/**")))
    paths = write(folder / "one.mcap", one, rng), write(folder / "other.mcap", other, rng)
    with pytest.MonkeyPatch.context() as patch:
        for module in (by_rows, plain_diff):
            for name, value in zip(("WINDOW", "WINDOW_BYTES", "AHEAD"), WINDOWS[seed % len(WINDOWS)], strict=True):
                patch.setattr(module, name, value)
        plain, columns, mixed = compared(*paths, tolerance, globs)
    assert columns == plain, seed
    assert mixed == plain, seed


@table("seed", range(12))
def test_two_sessions(tmp_path: Path, seed: int) -> None:
    check_random_pair(tmp_path, seed)


@pytest.mark.slow
def test_many_sessions(tmp_path: Path) -> None:
    for seed in range(1_000, 1_300):
        check_random_pair(tmp_path, seed)


@table("path", sorted(FIXTURES.glob("*.mcap")), gate=is_light)
def test_a_fixture_beside_itself_and_another(path: Path) -> None:
    for other in (path, FIXTURES / "paper-types.mcap"):
        plain, columns, mixed = compared(path, other)
        assert columns == plain and mixed == plain and not isinstance(plain, str)


def run_at_a_lag(lag: int, count: int = 2_100) -> list[Entry]:
    """A fast stream whose messages are later than those of another stream, behind a first entry at the same time."""
    entries = [replace(samples.igtl(1), stamp_ns=samples.START_NS)]
    for number in range(count):
        entry = samples.ros(number + 2, text=str(number))
        entries.append(replace(entry, stamp_ns=samples.START_NS + (number + 1 + lag) * 1_000_000))
    return entries


@table("lag", [1, 1_024, 1_025], gate=lambda lag: lag > 1_024)
def test_a_stream_that_is_later_on_one_side(tmp_path: Path, lag: int) -> None:
    rng = random.Random(lag)
    one, other = write(tmp_path / "a.mcap", run_at_a_lag(0), rng), write(tmp_path / "b.mcap", run_at_a_lag(lag), rng)
    for pair in ((one, other), (other, one)):
        plain, columns, mixed = compared(*pair)
        assert columns == plain and mixed == plain


@pytest.mark.slow
def test_mutants_are_compared_or_refused_alike(tmp_path: Path) -> None:
    refused = equal = 0
    last = None
    for name, data in islice(mcap_mutations.cases(52), 80):
        paths = tmp_path / "a.mcap", tmp_path / "b.mcap"
        paths[0].write_bytes(data)
        paths[1].write_bytes(data if last is None else last)
        plain, columns, mixed = compared(*paths)
        assert columns == plain and mixed == plain, name
        refused, equal = refused + isinstance(plain, str), equal + (not isinstance(plain, str))
        last = data
    assert refused > 10 and equal > 10


def test_times_after_2262_are_compared(tmp_path: Path) -> None:
    for name, late in (("a", 1 << 63), ("b", (1 << 63) + 7)):
        (tmp_path / f"{name}.mcap").write_bytes(bag(Chunk((*DEFINITIONS, *messages(5, late)))).finish())
    plain, columns, mixed = compared(tmp_path / "a.mcap", tmp_path / "b.mcap")
    assert columns == plain and mixed == plain and not isinstance(plain, str)


def test_a_file_that_has_no_columns_is_read_entry_by_entry_and_named(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    path = FIXTURES / "paper-types.mcap"
    assert "by_entry" not in compare_recordings(path, path, (), EXACT).to_dict()

    def columns(*_: object) -> None:
        raise Unfit

    monkeypatch.setattr(SessionFile, "columns", columns)
    assert compare_recordings(path, path, (), EXACT).to_dict()["by_entry"] == [str(path)] * 2
    assert main(["diff", str(path), str(path)]) == 0
    assert f"{path}: an older version, read entry by entry" in capsys.readouterr().out
