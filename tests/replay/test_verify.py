"""Verification finds nothing in an honest session and names the field where something was changed."""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from io import BytesIO
from itertools import islice
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader

from igtl_gateway.base.errors import ConversionError
from igtl_gateway.base.version import __version__
from igtl_gateway.cli import main
from igtl_gateway.config.configuration import Config, ToRosRow
from igtl_gateway.convert import table as table_module
from igtl_gateway.convert.table import TO_IGTL, TO_ROS
from igtl_gateway.convert.units import UNITS
from igtl_gateway.gateway import core, streams
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.groups import input_groups
from igtl_gateway.gateway.log.note import Note
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.record.sessionfile.writer import SessionWriter
from igtl_gateway.replay.verify import MAX_KEPT, UNKNOWN, DeclaredLosses, Difference, VerifyReport, compare, verify
from igtl_gateway_lab.simulate.catalogue import SCENARIOS
from igtl_gateway_lab.simulate.scenario import Scenario
from tests.files import write_anew
from tests.gateway.test_guard import pose
from tests.places import FIXTURES
from tests.script import Script
from tests.tables import table

SCENARIO: Scenario = SCENARIOS["paper-types"]


@pytest.fixture(scope="module")
def entries() -> list[Entry]:
    return list(SCENARIO.entries())


def first(report: VerifyReport) -> str:
    return str(report.differences[0])


def changed(entries: list[Entry], where: Callable[[Entry], bool], change: Callable[[bytes], bytes]) -> list[Entry]:
    """The entries with the payload of the first one that fits changed."""
    index = next(index for index, entry in enumerate(entries) if where(entry))
    entry = entries[index]
    return [*entries[:index], replace(entry, payload=(change(entry.data()),)), *entries[index + 1 :]]


def is_out(entry: Entry, channel: str) -> bool:
    return entry.kind in (Kind.IGTL_OUT, Kind.ROS_OUT) and entry.channel == channel


def test_an_honest_session_verifies(entries: list[Entry]) -> None:
    report = verify(entries, SCENARIO.config)
    assert report.good
    assert report.inputs + report.outputs == len(entries)
    assert report.equal == report.outputs


def test_a_changed_converter_constant_is_named(entries: list[Entry], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(UNITS, "mm", 999)
    report = verify(entries, SCENARIO.config)
    assert not report.good
    assert "content.matrix[0][3]" in " ".join(map(str, report.differences))
    assert "translation[0]: recorded 0.1, computed" in first(report), first(report)


def test_another_configuration_is_named(entries: list[Entry]) -> None:
    report = verify(entries, Config(base_frame="elsewhere"))
    assert "header.frame_id: recorded 'igtl', computed 'elsewhere'" in " ".join(map(str, report.differences))


@table(
    ("channel", "at", "field"),
    [
        ("TRANSFORM/ToolToBase", 58 + 36, "content.matrix[0][3]"),
        ("TRANSFORM/ToolToBase", 35, "timestamp.sec"),
        ("TRANSFORM/ToolToBase", 57, "crc"),
        ("STRING/Greeting", 58 + 4, "content.string"),
        ("IMAGE/Mono8", 58 + 72, "content.data[0]"),
        ("POLYDATA/Surface", 58 + 40, "content.points[0][0]"),
        ("/igtl/in/ProbeToTracker/transform", 4, "header.stamp_ns"),
        ("/igtl/in/Surface/mesh", -1, "vertices[3][2]"),
        ("/igtl/in/Grey/image", -1, "data"),
    ],
)
def test_one_changed_byte_is_named(entries: list[Entry], channel: str, at: int, field: str) -> None:
    def flip(data: bytes) -> bytes:
        position = at % len(data)
        return data[:position] + bytes([data[position] ^ 1]) + data[position + 1 :]

    report = verify(changed(entries, lambda entry: is_out(entry, channel), flip), SCENARIO.config)
    assert report.differing == 1
    assert report.differences[0].field == field
    assert report.differences[0].stream == channel
    assert report.by_stream == {channel: 1}


def test_bytes_that_do_not_decode_are_compared_as_bytes(entries: list[Entry]) -> None:
    report = verify(changed(entries, lambda e: is_out(e, "/igtl/in/Greeting/string"), lambda d: d[:5]), SCENARIO.config)
    assert report.differences[0].field.startswith("byte ")


@table("cut", [1, 20, 58, 60])
@table("channel", ["IMAGE/Mono8", "POLYDATA/Surface", "STRING/Greeting"])
def test_a_message_that_was_cut_is_a_difference_not_a_failure(entries: list[Entry], channel: str, cut: int) -> None:
    report = verify(changed(entries, lambda e: is_out(e, channel), lambda d: d[:-cut]), SCENARIO.config)
    assert report.differing == 1


@pytest.mark.slow
@table("bit", range(0, 58 * 8, 3))
def test_any_bit_of_a_header_is_a_difference_not_a_failure(entries: list[Entry], bit: int) -> None:
    def flip(data: bytes) -> bytes:
        return data[: bit // 8] + bytes([data[bit // 8] ^ 1 << bit % 8]) + data[bit // 8 + 1 :]

    outs = [replace(e, payload=(flip(e.data()),)) for e in entries if e.kind is Kind.IGTL_OUT]
    wanted = [e for e in entries if e.kind is Kind.IGTL_OUT]
    assert all(compare(one, other, 1) for one, other in zip(outs, wanted, strict=True))


def without(entries: list[Entry], which: Callable[[Entry], bool]) -> tuple[list[Entry], Entry]:
    """The entries without the first one that fits, and that one."""
    entry = next(entry for entry in entries if which(entry))
    return [other for other in entries if other is not entry], entry


def declared(entry: Entry) -> DeclaredLosses:
    return DeclaredLosses(1, {entry.channel or entry.kind.value: 1})


def test_a_missing_output_is_a_finding_unless_it_was_declared_for_its_stream(entries: list[Entry]) -> None:
    cut, gone = without(entries, lambda entry: entry.kind is Kind.ROS_OUT)
    report = verify(cut, SCENARIO.config)
    assert not report.good and report.differing == 1 and not report.lost
    assert "recorded 'nothing'" in first(report)
    report = verify(cut, SCENARIO.config, declared(gone))
    assert report.good and report.lost == 1 and report.equal == report.outputs
    assert verify(cut, SCENARIO.config, DeclaredLosses(1, {"(others)": 1})).good
    assert not verify(cut, SCENARIO.config, DeclaredLosses(1, {"/another": 1})).good


def test_a_missing_input_excuses_its_outputs_and_no_others(entries: list[Entry]) -> None:
    cut, gone = without(entries, lambda entry: entry.channel == "POINT/Target")
    report = verify(cut, SCENARIO.config)
    assert not report.good
    assert report.differences[0].stream == UNKNOWN and report.differences[0].seq == gone.seq
    report = verify(cut, SCENARIO.config, declared(gone))
    assert report.good and report.missing == 1 and report.orphans > 0
    assert report.equal + report.orphans == report.outputs
    worse = changed(cut, lambda entry: is_out(entry, "/igtl/in/Grey/image"), lambda data: data[:-1] + b"\xff")
    assert verify(worse, SCENARIO.config, declared(gone)).by_stream == {"/igtl/in/Grey/image": 1}


@table("index", range(0, 119, 7))
def test_no_entry_goes_missing_unseen(entries: list[Entry], index: int) -> None:
    cut = entries[:index] + entries[index + 1 :]
    report = verify(cut, SCENARIO.config)
    assert not report.good
    assert report.differences[0].seq <= entries[index].seq + 1


def test_a_stream_whose_first_message_was_lost_opens_later() -> None:
    with SessionFile.open(FIXTURES / "star.mcap") as file:
        begun = [entry for group in islice(input_groups(file.entries()), 20) for entry in (group.input, *group.outputs)]
    cut, gone = without(begun, lambda entry: entry.channel == "/star/tool")
    report = verify(cut, SCENARIOS["star"].config, declared(gone))
    assert (report.missing, report.orphans, report.late, report.differing) == (1, 2, 1, 0)


def test_a_part_of_a_session_may_say_elsewhere_what_the_guard_found() -> None:
    config = Config(watch=True, to_ros=(ToRosRow(max_age_s=0.5),))
    script = Script(config)
    for index in range(60):
        script.now_ns += 200_000_000
        lag_ns = 10**9 if 10 < index < 30 else 0
        script.igtl(pose(script.now_ns - lag_ns, (0.1, 0.2, 0.3) if index < 25 else (100.0, 200.0, 300.0)))
    codes = [Note.unpack(entry.data()).code for entry in script.log if entry.kind is Kind.NOTE]
    assert {"stale", "fresh", "unit_jump"} < set(codes)
    assert verify(script.log, config).good
    begin = next(at for at, entry in enumerate(script.log) if entry.stamp_ns > script.log[0].stamp_ns + 3 * 10**9)
    while not script.log[begin].kind.is_input:
        begin += 1
    report = verify(script.log[begin:], config, DeclaredLosses(midway=True), before=script.log[:1])
    assert report.good, report.differences
    assert report.late and report.equal
    whole = verify(script.log[begin:], config, before=script.log[:1])
    assert not whole.good


def test_two_swapped_messages_are_found(entries: list[Entry]) -> None:
    one, other = [index for index, entry in enumerate(entries) if entry.kind is Kind.ROS_IN][2:4]
    swapped = list(entries)
    for here, there in ((one, other), (other, one)):
        place = entries[here]
        swapped[here] = replace(entries[there], seq=place.seq, stamp_ns=place.stamp_ns)
    assert verify(swapped, SCENARIO.config).differences[0].cause == entries[one].seq


def test_what_was_cut_off_is_excused_where_nobody_counted(entries: list[Entry]) -> None:
    last = next(index for index in reversed(range(len(entries))) if entries[index].kind is Kind.IGTL_OUT)
    cut = entries[:last]
    assert not verify(cut, SCENARIO.config).good
    report = verify(cut, SCENARIO.config, DeclaredLosses.of({}, None))
    assert report.good and report.lost >= 1


@table(
    ("session", "ledger", "losses"),
    [
        ({}, {"streams": {}}, DeclaredLosses()),
        ({}, None, DeclaredLosses(uncounted=True)),
        (
            {},
            {"recorder": {"dropped_entries": 2, "dropped": {"/a": 2}, "left_out_entries": 1, "left_out": {"/a": 1}}},
            DeclaredLosses(3, {"/a": 3}),
        ),
        ({}, {"recovered": {"whole": True}}, DeclaredLosses()),
        ({}, {"recovered": {"whole": False}}, DeclaredLosses(uncounted=True)),
        ({"part": "0"}, {}, DeclaredLosses()),
        ({"part": "1"}, {}, DeclaredLosses(midway=True)),
        ({"snapshot_seconds": "5"}, {}, DeclaredLosses(midway=True)),
    ],
)
def test_losses_are_read_from_the_recording(
    session: dict[str, str], ledger: dict[str, Any] | None, losses: DeclaredLosses
) -> None:
    assert DeclaredLosses.of(session, ledger) == losses


def test_a_part_begins_where_it_begins_with_the_inputs_before_it(entries: list[Entry]) -> None:
    start = next(index for index, entry in enumerate(entries) if entry.kind.is_input and index > 60)
    before = [entry for entry in entries[:start] if entry.kind.is_input]
    assert verify(entries[start:], SCENARIO.config, DeclaredLosses(midway=True), before=before).good
    assert not verify(entries[start:], SCENARIO.config, before=before).good


def test_differences_are_told_in_units(entries: list[Entry], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(UNITS, "mm", 1001)
    report = verify(entries, SCENARIO.config)
    assert re.search(r"\(0\.3\d* mm\)", str(report.firsts["TRANSFORM/ToolToBase"]))
    assert set(report.firsts) == set(report.by_stream)
    assert report.differing == sum(report.by_stream.values()) > len(report.by_stream)


EVERY: Scenario = SCENARIOS["every-type"]


@pytest.fixture(scope="module")
def every_type() -> list[Entry]:
    return list(EVERY.entries())


def test_any_bit_of_any_output_of_every_type_is_found(every_type: list[Entry]) -> None:
    """One bit in each output but notes (there the wording is free), at a place that its number chooses."""
    turned = []
    for entry in every_type:
        if entry.kind in (Kind.IGTL_OUT, Kind.ROS_OUT):
            data = bytearray(entry.data())
            bit = entry.seq * 7919 % (len(data) * 8)
            data[bit // 8] ^= 1 << bit % 8
            turned.append(replace(entry, payload=(bytes(data),)))
        else:
            turned.append(entry)
    report = verify(turned, EVERY.config)
    outputs = [entry for entry in every_type if entry.kind in (Kind.IGTL_OUT, Kind.ROS_OUT)]
    assert [difference.seq for difference in report.differences] == [entry.seq for entry in outputs]
    assert [difference.stream for difference in report.differences] == [entry.channel for entry in outputs]


@pytest.mark.slow
@pytest.mark.parametrize("offset", [0, 60, -1])
def test_a_byte_of_any_message_of_every_type_that_came_in_is_found(every_type: list[Entry], offset: int) -> None:
    """Header version, content and last byte of each: the gateway refuses it, or gives a different output."""
    taken = [g for g in input_groups(every_type) if g.input.kind is Kind.IGTL_IN and g.outputs[0].kind is not Kind.NOTE]
    assert len(taken) > 100
    for group in taken[::13]:
        data = bytearray(group.input.data())
        data[offset % len(data)] ^= 1
        turned = replace(group.input, payload=(bytes(data),))
        log = [
            turned if entry is group.input else entry for entry in every_type[: group.input.seq + len(group.outputs)]
        ]
        report = verify(log, EVERY.config)
        assert report.differing, turned.channel
        assert report.differences[0].cause == turned.seq


@pytest.mark.slow
@pytest.mark.parametrize("table", ["TO_ROS", "TO_IGTL"])
def test_a_mutation_of_any_converter_is_found(
    every_type: list[Entry], table: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each row of the conversion table refuses in turn; sampled, for time."""
    rows: Sequence[Any] = {"TO_ROS": TO_ROS, "TO_IGTL": TO_IGTL}[table]

    def refuse(*_: object) -> object:
        raise ConversionError("a mutant")

    for row in rows[::6]:
        mutant = replace(row, convert=refuse)
        with monkeypatch.context() as patch:
            for module in (streams, core):
                for name in ("rows_to_ros", "row_to_igtl"):
                    if hasattr(module, name):
                        patch.setattr(module, name, mutated(getattr(table_module, name), row, mutant))
            report = verify(every_type, EVERY.config)
        assert not report.good, row


def mutated(find: Callable[..., Any], row: object, mutant: object) -> Callable[..., Any]:
    """A look-up in the conversion table that finds the mutant in place of the row."""

    def found(*arguments: Any) -> Any:
        rows = find(*arguments)
        if isinstance(rows, tuple | list):
            return tuple(mutant if one is row else one for one in rows)
        return mutant if rows is row else rows

    return found


def test_any_bit_of_a_recorded_payload_is_found_in_the_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    whole = (FIXTURES / "paper-types.mcap").read_bytes()
    summary = make_reader(BytesIO(whole)).get_summary()
    assert summary
    for chunk in summary.chunk_indexes:
        end = chunk.chunk_start_offset + chunk.chunk_length
        for at in range(end - chunk.compressed_size, end, 3_001):
            data = bytearray(whole)
            data[at] ^= 1 << at % 8
            path = tmp_path / "bad.mcap"
            write_anew(path, data)
            assert main(["verify", str(path)]) == 1
            assert "bad.mcap: entries" in capsys.readouterr().err


def test_the_report_names_versions_and_streams(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config = tmp_path / "other.toml"
    config.write_text('[gateway]\nbase_frame = "elsewhere"\n', "utf-8")
    star = str(FIXTURES / "star.mcap")
    assert main(["verify", star, "--config", str(config), "--all"]) == 1
    told = capsys.readouterr().out
    assert f"verified by {__version__}" in told and f"recorded by igtl-gateway {__version__}" in told
    assert main(["verify", star, "--config", str(config), "--json"]) == 1
    facts = json.loads(capsys.readouterr().out)
    assert facts["differing"] == sum(facts["by_stream"].values())
    assert facts["firsts"].keys() == facts["by_stream"].keys()
    assert len(facts["differences"]) == min(MAX_KEPT, facts["differing"])
    assert all(stream in told for stream in facts["by_stream"])


def test_a_configuration_of_another_release_is_a_clear_error(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "future.mcap"
    writer = SessionWriter(path, {"config": '{"warp_drive": true}', "igtl_gateway_version": "9.9"})
    writer.close({})
    assert main(["verify", str(path)]) == 2
    told = capsys.readouterr().err
    assert "warp_drive" in told and "9.9" in told and "--config" in told
    empty = tmp_path / "empty.toml"
    empty.write_text("", "utf-8")
    assert main(["verify", str(path), "--config", str(empty)]) == 0


def test_an_output_that_nothing_caused_is_a_finding(entries: list[Entry]) -> None:
    ghost = next(entry for entry in entries if entry.kind is Kind.ROS_OUT)
    report = verify([*entries, replace(ghost, seq=entries[-1].seq + 1)], SCENARIO.config)
    assert "computed 'nothing'" in first(report)


def test_notes_are_compared_by_code_not_by_wording(entries: list[Entry]) -> None:
    def where(entry: Entry) -> bool:
        return entry.kind is Kind.NOTE

    assert verify(changed(entries, where, lambda d: d.replace(b"goes", b"flows")), SCENARIO.config).good
    report = verify(changed(entries, where, lambda d: d.replace(b'"code":"', b'"code":"un', 1)), SCENARIO.config)
    assert report.differences[0].field == "note.code"


def test_a_declared_loss_of_a_stream_is_used_once(entries: list[Entry]) -> None:
    counts = Counter(entry.channel for entry in entries if entry.kind is Kind.ROS_OUT)
    (stream, number), *_ = counts.most_common(1)
    assert number > 1
    cut, gone = without(entries, lambda entry: is_out(entry, stream))
    cut, _ = without(cut, lambda entry: is_out(entry, stream))
    assert verify(cut, SCENARIO.config, DeclaredLosses(2, {stream: 2})).lost == 2
    report = verify(cut, SCENARIO.config, DeclaredLosses(2, {gone.channel: 1}))
    assert (report.lost, report.differing) == (1, 1)


def test_losses_of_several_streams_are_no_more_than_all_that_were_declared(entries: list[Entry]) -> None:
    channels = list(dict.fromkeys(entry.channel for entry in entries if entry.kind is Kind.ROS_OUT))[:2]
    cut = entries
    for channel in channels:
        cut, _ = without(cut, partial(is_out, channel=channel))
    by_stream = dict.fromkeys(channels, 1)
    for declared in (2, 1, 0):
        report = verify(cut, SCENARIO.config, DeclaredLosses(declared, by_stream))
        assert (report.lost, report.differing) == (declared, 2 - declared)


def test_a_part_may_begin_behind_one_lost_input(entries: list[Entry]) -> None:
    """Its first outputs are those of an input that the recorder lost; without a declared loss they are of nothing."""
    begin = next(at for at in range(20, len(entries)) if not entries[at].kind.is_input)
    end = next(at for at in range(begin, len(entries)) if entries[at].kind.is_input)
    part = entries[begin:end]
    assert part
    report = verify(part, SCENARIO.config, DeclaredLosses(1, {"(others)": 1}, midway=True), before=entries[:1])
    assert report.orphans == len(part) and report.good
    assert not verify(part, SCENARIO.config, DeclaredLosses(midway=True), before=entries[:1]).good


def test_of_many_differences_each_stream_has_its_first_and_no_list_grows_beyond_its_bound() -> None:
    report = VerifyReport()
    for number in range(2 * MAX_KEPT):
        for stream in (f"A{number}", "B"):
            report.add(Difference(number, number, stream, "field", "one", "other"))
    assert report.differing == 4 * MAX_KEPT and not report.good
    assert len(report.differences) == len(report.firsts) == MAX_KEPT
    assert report.firsts["B"].seq == 0, "the first, not the last"
    assert report.by_stream["B"] == 2 * MAX_KEPT and len(report.by_stream) == 2 * MAX_KEPT + 1
