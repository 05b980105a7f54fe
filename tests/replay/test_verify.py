"""Verification finds nothing in an honest session and names the field where something was changed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest

from igtl_gateway.config import Config
from igtl_gateway.convert.units import UNITS
from igtl_gateway.replay.verify import Report, compare, verify
from igtl_gateway.session.entry import Entry, Kind
from igtl_gateway.simulate.catalogue import SCENARIOS
from igtl_gateway.simulate.scenario import Scenario

SCENARIO: Scenario = SCENARIOS["paper-types"]


@pytest.fixture(scope="module")
def entries() -> list[Entry]:
    return list(SCENARIO.entries())


def first(report: Report) -> str:
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
    assert "translation[0] was 0.1, is now" in first(report), first(report)


def test_another_configuration_is_named(entries: list[Entry]) -> None:
    report = verify(entries, Config(base_frame="elsewhere"))
    assert "header.frame_id was 'igtl', is now 'elsewhere'" in " ".join(map(str, report.differences))


@pytest.mark.parametrize(
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


@pytest.mark.parametrize("cut", [1, 20, 58, 60])
@pytest.mark.parametrize("channel", ["IMAGE/Mono8", "POLYDATA/Surface", "STRING/Greeting"])
def test_a_message_that_was_cut_is_a_difference_not_a_failure(entries: list[Entry], channel: str, cut: int) -> None:
    report = verify(changed(entries, lambda e: is_out(e, channel), lambda d: d[:-cut]), SCENARIO.config)
    assert report.differing == 1


@pytest.mark.parametrize("bit", range(0, 58 * 8, 3))
def test_any_bit_of_a_header_is_a_difference_not_a_failure(entries: list[Entry], bit: int) -> None:
    def flip(data: bytes) -> bytes:
        return data[: bit // 8] + bytes([data[bit // 8] ^ 1 << bit % 8]) + data[bit // 8 + 1 :]

    outs = [replace(e, payload=(flip(e.data()),)) for e in entries if e.kind is Kind.IGTL_OUT]
    wanted = [e for e in entries if e.kind is Kind.IGTL_OUT]
    assert all(compare(one, other, 1) for one, other in zip(outs, wanted, strict=True))


def test_a_missing_output_is_a_finding_unless_the_recorder_declared_it(entries: list[Entry]) -> None:
    index = next(index for index, entry in enumerate(entries) if entry.kind is Kind.ROS_OUT)
    cut = entries[:index] + entries[index + 1 :]
    report = verify(cut, SCENARIO.config)
    assert not report.good and report.lost == 1
    assert "was 'nothing'" in first(report)
    assert verify(cut, SCENARIO.config, declared_lost=1).good


def test_an_output_that_nothing_caused_is_a_finding(entries: list[Entry]) -> None:
    ghost = next(entry for entry in entries if entry.kind is Kind.ROS_OUT)
    report = verify([*entries, replace(ghost, seq=entries[-1].seq + 1)], SCENARIO.config)
    assert "is now 'nothing'" in first(report)


def test_notes_are_compared_by_code_not_by_wording(entries: list[Entry]) -> None:
    def where(entry: Entry) -> bool:
        return entry.kind is Kind.NOTE

    assert verify(changed(entries, where, lambda d: d.replace(b"goes", b"flows")), SCENARIO.config).good
    report = verify(changed(entries, where, lambda d: d.replace(b'"code":"', b'"code":"un', 1)), SCENARIO.config)
    assert report.differences[0].field == "note.code"
