"""What ``recover`` writes is read by every reader, and what it does not carry has a name."""

from __future__ import annotations

import json
from array import array
from collections.abc import Callable, Mapping
from dataclasses import replace
from io import BytesIO
from itertools import islice
from pathlib import Path
from random import Random
from types import MappingProxyType, SimpleNamespace
from typing import Any

import pytest
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader

from igtl_gateway.base.errors import GatewayError, LimitExceeded
from igtl_gateway.base.untrusted.limits import limits_in_force, parse_limits
from igtl_gateway.cli import main
from igtl_gateway.config.configuration import Config
from igtl_gateway.gateway.log.entry import Entry
from igtl_gateway.record.sessionfile import layout, recovery
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.record.sessionfile.recovery import recover
from igtl_gateway.record.sessionfile.salvage import Salvage
from igtl_gateway.record.sessionfile.salvage_report import SalvageReport
from igtl_gateway.record.sessionfile.stream import McapStream
from igtl_gateway.record.sessionfile.writer import SessionWriter
from tests.places import FIXTURES
from tests.record import samples
from tests.tables import table
from tools import mcap_build as build
from tools import mcap_mutations
from tools.mcap_build import Chunk, Record

Parts = list[Record | Chunk]
_DEEP = "[" * 300 + "]" * 300
_CONFIG = json.dumps(Config().to_dict())


def _session(
    facts: dict[str, str], entries: list[Entry] | None = None, ledger: Mapping[str, Any] = MappingProxyType({})
) -> bytes:
    memory = BytesIO()
    writer = SessionWriter(Path("a.mcap"), {"config": _CONFIG, **facts}, memory=memory, chunk_bytes=1500)
    for entry in samples.every_kind(8) if entries is None else entries:
        writer.write(entry)
    writer.close({"streams": {}, **ledger})
    return memory.getvalue()


def _shifted(*numbers: int, by_ns: int) -> list[Entry]:
    """Entries of which some have another time; chunks are small, so that times of chunks are out of order, too."""
    return [replace(entry, stamp_ns=entry.stamp_ns + by_ns * (entry.seq in numbers)) for entry in samples.every_kind(8)]


def _recovered(tmp_path: Path, data: bytes) -> tuple[recovery.Recovery, Path]:
    source, out = tmp_path / "a.mcap", tmp_path / "b.mcap"
    source.write_bytes(data)
    out.unlink(missing_ok=True)
    found = recover(source, out)
    _check_every_reader(out, found)
    return found, out


def _check_every_reader(out: Path, found: recovery.Recovery) -> None:
    with SessionFile.open(out) as file:
        assert sum(1 for _ in file.entries()) == file.entry_count
        file.prologue()
        recorded = (file.ledger or {})["recovered"]
        assert recorded == found.facts and recorded["whole"] is found.report.whole
    with out.open("rb") as stream:
        assert sum(1 for _ in make_reader(stream).iter_messages()) == found.report.messages
    if not found.notes:
        with AnyReader([out]) as bag:
            assert sum(1 for _ in bag.messages()) == found.report.messages


@pytest.mark.slow
@table("numbers", [(20,), (5, 6, 7), (1,), tuple(range(30, 40))])
@table("by_ns", [10**15, -(10**15), 1 << 62], gate=lambda by_ns: by_ns < 0)
def test_times_out_of_order_cost_only_these_entries(tmp_path: Path, numbers: tuple[int, ...], by_ns: int) -> None:
    entries = _shifted(*numbers, by_ns=by_ns)
    found, out = _recovered(tmp_path, _session({}, entries))
    left_out = {int(loss.text.split(":")[0].removeprefix("entry ")) for loss in found.report.lost}
    with SessionFile.open(out) as file:
        kept = [entry.seq for entry in file.entries()]
    assert left_out <= set(numbers) and sorted([*kept, *left_out]) == [entry.seq for entry in entries]
    assert found.report.whole is not bool(left_out)
    assert left_out or numbers == (1,), "only the first entries may be earlier without being out of order"
    if left_out:
        assert all(loss.what == "number" and "is out of order" in loss.text for loss in found.report.lost)
    again, _ = _recovered(tmp_path, out.read_bytes())
    assert not again.report.lost and again.facts["earlier"] == found.facts


def test_a_header_that_cannot_be_read_is_named_and_rosbags_reads_the_rest(tmp_path: Path) -> None:
    data = _session({})
    for bad in (data.replace(b"igtl-gateway", b"igtl-gatew\xff\xff", 1), bytes(16) + data[16:]):
        found, _ = _recovered(tmp_path, bad)
        assert [(loss.what, loss.text) for loss in found.report.lost] == [
            ("header", "not readable: which program wrote the file")
        ]
        assert not (found.notes or found.report.whole)


@pytest.mark.slow
@table(
    ("key", "text"),
    [
        *(
            (layout.CONFIGURATION_KEY, text)
            for text in ("null", "[]", '"text"', _DEEP, '{"max_age_s": ' + "9" * 5000 + "}")),
        (layout.CUSTOM_KEY, json.dumps({"a": "b"})[:-1] + ', "c": ' + _DEEP + "}"),
        (layout.CUSTOM_KEY, "7"),
        (layout.INCLUDE_KEY, "{"),
        (layout.SNAPSHOT_KEY, "soon"),
        ("slice_of", "a.mcap"),
    ],
)  # fmt: skip
def test_an_unusable_item_is_left_out_and_named(tmp_path: Path, key: str, text: str) -> None:
    data = _session({key: text})
    if key == layout.CONFIGURATION_KEY:
        parts = build.parse(data)
        data = build.assemble(
            [part for part in parts if isinstance(part, Chunk) or part[0] != build.ATTACHMENT]
        ).finish()
    found, out = _recovered(tmp_path, data)
    [loss] = found.report.lost
    assert loss.what == "metadata" and f"{key!r} of the session metadata: " in loss.text and len(loss.text) <= 300
    with SessionFile.open(out) as file:
        assert key not in file.session
        assert file.entry_count == len(samples.every_kind(8))
    assert main(["info", str(out)]) == 0
    assert main(["recover", str(out), "-o", str(tmp_path / "c.mcap")]) == 0  # its ledger is read, too


def test_the_configuration_of_the_attachment_stands_for_a_damaged_one(tmp_path: Path) -> None:
    parts = build.parse(_session({}))
    for at, part in enumerate(parts):
        if not isinstance(part, Chunk) and part[0] == build.METADATA and b"igtl_gateway.session" in part[1]:
            parts[at] = (build.METADATA, build.metadata(
                layout.SESSION_METADATA, layout.seal({layout.FORMAT_VERSION_KEY: "1", "config": "null"})
            ))  # fmt: skip
    found, out = _recovered(tmp_path, build.assemble(parts).finish())
    assert found.report.whole
    with SessionFile.open(out) as file:
        assert file.session["config"] == _CONFIG


def test_chunks_that_overlap_beyond_the_limit_are_sorted(tmp_path: Path) -> None:
    """Each chunk spans the whole time, and all of them together are more than a reader holds."""
    count, size = 20, 200_000
    parts: Parts = [(build.HEADER, build.header("ros2", "somebody"))]
    head = (
        (build.SCHEMA, build.schema(1, "std_msgs/msg/String", "ros2msg", b"string data\n")),
        (build.CHANNEL, build.channel(1, 1, "/chatter", "cdr", {})),
    )
    text = samples.string_cdr("x" * size)
    for number in range(count):
        messages = tuple(
            (build.MESSAGE, build.message(1, number, at, at, data))
            for at, data in ((1000 + number, text), (10**9 + number, samples.string_cdr("end")))
        )
        parts.append(Chunk((*head, *messages), "zstd"))
    data = build.assemble(parts).finish()
    (tmp_path / "a.mcap").write_bytes(data)
    with limits_in_force(parse_limits(["free=2000000", "ratio=2"])):
        with SessionFile.open(tmp_path / "a.mcap") as file, pytest.raises(LimitExceeded, match="chunks that overlap"):
            list(file.entries())
        found, out = _recovered(tmp_path, data)
        assert found.report.whole and found.report.messages == 2 * count
        with SessionFile.open(out) as file:
            times = [entry.stamp_ns for entry in file.entries()]
    assert times == sorted([*range(1000, 1000 + count), *range(10**9, 10**9 + count)])


def test_a_ledger_too_deep_for_another_recovery(tmp_path: Path) -> None:
    earlier: dict[str, Any] = {"by": "igtl-gateway", "from": "a", "whole": True, "lost": [], "more_lost": 0}
    for _ in range(61):
        earlier = {**earlier, "earlier": earlier}
    for depth, lost in ((earlier["earlier"], []), (earlier, ["ledger"])):
        found, _ = _recovered(tmp_path, _session({}, ledger={"recovered": depth}))
        assert [loss.what for loss in found.report.lost] == lost


@pytest.mark.parametrize(
    ("bend", "why"), [(lambda reader: None, "read 77 messages, found 0"), (None, "ValueError: no")]
)
def test_a_file_that_another_library_refuses_is_not_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
    bend: Callable[[object], None] | None, why: str,
) -> None:  # fmt: skip
    source, out = tmp_path / "a.mcap", tmp_path / "b.mcap"
    source.write_bytes(_session({}))

    def refuse(_: object) -> object:
        if bend is None:
            raise ValueError("no")
        return make_reader(BytesIO((build.assemble([(build.HEADER, build.header())])).finish()))

    monkeypatch.setattr(recovery, "make_reader", refuse)
    assert main(["recover", str(source), "-o", str(out)]) == 1
    assert why.replace("77", str(len(samples.every_kind(8)))) in capsys.readouterr().err
    assert not out.exists()


def _check_mutant(tmp_path: Path, name: str, data: bytes, capsys: pytest.CaptureFixture[str]) -> None:
    source, out = tmp_path / "a.mcap", tmp_path / "b.mcap"
    source.write_bytes(data)
    out.unlink(missing_ok=True)
    code = main(["recover", str(source), "-o", str(out), "--json"])
    told = capsys.readouterr()
    assert out.exists() or (code and told.err), name
    if not out.exists():
        return
    facts = json.loads(told.out)
    assert (code == 0) is facts["whole"] is not bool(facts["lost"] or not facts["closed"]), name
    for verb in ("info", "verify", "doctor"):
        found = main([verb, str(out)])
        errors = capsys.readouterr().err
        is_refused = any(each in errors for each in ("another program", "found an import", "no messages that can"))
        assert not errors or is_refused, f"{name}: {verb}: {found}: {errors}"
    with out.open("rb") as stream:
        assert sum(1 for _ in make_reader(stream).iter_messages()) == facts["messages"], name


def test_mutants(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Of schemas, channels, messages, times, metadata, attachments, indexes; more of them in the next test."""
    for name, data in islice(mcap_mutations.cases(29), 2):
        _check_mutant(tmp_path, name, data, capsys)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2])
def test_more_mutants(tmp_path: Path, capsys: pytest.CaptureFixture[str], seed: int) -> None:
    for name, data in islice(mcap_mutations.cases(seed), 20):
        _check_mutant(tmp_path, name, data, capsys)


@pytest.mark.parametrize("seed", range(4))
def test_random_times(tmp_path: Path, seed: int) -> None:
    """Times of messages and of chunks anywhere: what is left is in order, and the rest is named one by one."""
    chance = Random(seed)
    entries = [
        replace(entry, stamp_ns=chance.choice((entry.stamp_ns, entry.stamp_ns, chance.randrange(1 << 63))))
        for entry in samples.every_kind(8)
    ]
    found, out = _recovered(tmp_path, _session({}, entries))
    with SessionFile.open(out) as file:
        assert file.entry_count + len(found.report.lost) + found.report.more_lost == len(entries)


# -- whole chunks -----------------------------------------------------------------------------------------------------


def _outcome(source: Path, place: Path) -> object:
    """The report, and all messages of the new file with their topics; or the refusal."""
    place.unlink(missing_ok=True)
    try:
        found = recovery.recover(source, place)
    except GatewayError as error:
        return type(error), str(error)
    with SessionFile.open(place) as file:
        messages = [(schema, channel, row[1:4], row[6][row[4] : row[5]]) for schema, channel, row in file.messages()]
        entries = [(entry.seq, entry.stamp_ns, entry.kind, entry.channel, entry.data()) for entry in file.entries()]
        beside = [*file.beside(), *file.attachments()]
    return found.facts, found.report, found.part.topics, found.notes, messages, entries, beside


def _both(source: Path, place: Path) -> tuple[object, object]:
    """With chunks that are copied as they are, and message by message."""
    whole = _outcome(source, place)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Salvage, "read_chunks", Salvage.read)
        return whole, _outcome(source, place)


@pytest.mark.parametrize("name", ["star", "every-type", "lego"])
def test_chunks_are_copied_as_they_are(tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    copied: list[int] = []
    original = McapStream.copy_chunk

    def counted(self: McapStream, data: bytes, crc: int, compression: str, packed: bytes) -> None:
        copied.append(len(packed))
        original(self, data, crc, compression, packed)

    monkeypatch.setattr(McapStream, "copy_chunk", counted)
    one, other = _both(FIXTURES / f"{name}.mcap", tmp_path / "new.mcap")
    assert one == other
    with SessionFile.open(FIXTURES / f"{name}.mcap") as file:
        assert len(copied) == len(file._index.chunks)


@pytest.mark.slow
def test_mutants_are_recovered_alike_with_whole_chunks(tmp_path: Path) -> None:
    for name, data in islice(mcap_mutations.cases(53), 100):
        (tmp_path / "a.mcap").write_bytes(data)
        one, other = _both(tmp_path / "a.mcap", tmp_path / "new.mcap")
        assert one == other, name


def test_a_chunk_whose_definitions_are_others_is_not_copied(tmp_path: Path) -> None:
    """The same bytes would bring another definition of a channel into the new file."""
    topics = ("/a", "/b")
    chunks = [
        Chunk((
            (build.SCHEMA, build.schema(1, "std_msgs/msg/String", "ros2msg", b"string data")),
            (build.CHANNEL, build.channel(1, 1, topic, "cdr", {})),
            (build.MESSAGE, build.message(1, 1, at, at, samples.string_cdr("x"))),
        ))
        for at, topic in enumerate(topics, 5)
    ]  # fmt: skip
    (tmp_path / "a.mcap").write_bytes(build.assemble([(build.HEADER, build.header()), *chunks]).finish())
    one, other = _both(tmp_path / "a.mcap", tmp_path / "new.mcap")
    assert one == other


@pytest.mark.parametrize("most", [0, 10**6])
def test_the_libraries_read_the_ends_of_a_long_whole_recording(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, most: int
) -> None:
    monkeypatch.setattr(recovery, "_READ_BY_ALL", most)
    seen: list[tuple[object, object]] = []
    original = AnyReader.messages

    def messages(self: AnyReader, connections: tuple[()] = (), start: object = None, stop: object = None) -> Any:
        seen.append((start, stop))
        return original(self, connections, start, stop)  # type: ignore[arg-type]

    monkeypatch.setattr(AnyReader, "messages", messages)
    recovery.recover(FIXTURES / "star.mcap", tmp_path / "a.mcap")
    with SessionFile.open(FIXTURES / "star.mcap") as file:
        first, last = file._index.chunks[0], file._index.chunks[-1]
        ends = [(first.start_ns, first.end_ns + 1), (last.start_ns, last.end_ns + 1)]
    assert seen == ([(None, None)] if most else ends)


@pytest.mark.parametrize(
    ("times", "kept", "texts"),
    [
        ([], [], []),
        ([5], [5], []),
        ([5, 5, 6], [5, 5, 6], []),
        ([5, 100, 6, 7], [5, 6, 7], ["entry 1: its time, 100 ns, is out of order: found 5 before it"]),
        ([9, 1, 2, 3], [1, 2, 3], ["entry 0: its time, 9 ns, is out of order: found 1 after it"]),
        ([1, 2, 3, 0], [1, 2, 3], ["entry 3: its time, 0 ns, is out of order: found 3 before it"]),
        (
            [1, 2, 90, 91, 3, 4, 5],
            [1, 2, 3, 4, 5],
            [f"entry {at}: its time, {88 + at} ns, is out of order: found 2 before it" for at in (2, 3)],
        ),
    ],
)
def test_the_longest_part_in_order_stays_and_the_others_are_named(
    times: list[int], kept: list[int], texts: list[str]
) -> None:
    rows = recovery._longest_rising(array("q", times))
    assert [times[row] for row in rows] == kept and rows == sorted(set(rows))
    if not rows:
        return
    file = SimpleNamespace(report=SalvageReport(100, messages=len(times)))
    numbers = array("q", range(len(times)))
    recovery._name_the_others(file, rows, array("q", times), numbers, numbers)  # type: ignore[arg-type]
    assert [loss.text for loss in file.report.lost] == texts
    assert (file.report.messages, file.report.start_ns, file.report.end_ns) == (len(kept), kept[0], kept[-1])
