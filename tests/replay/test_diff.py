"""Two recordings: what is missing, extra or different in which stream, and where."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache

import pytest

from igtl_gateway.base.buffers import join
from igtl_gateway.config.configuration import Config
from igtl_gateway.convert.rosmsg import TransformStamped
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.stream_units import StreamUnits
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.replay.compare import EXACT, LeafDecoder, Tolerance
from igtl_gateway.replay.diff import WINDOW, DiffInput, DiffReport, StreamDiff, diff
from igtl_gateway.wire import Message, encode
from igtl_gateway.wire.transform import Transform
from tests.places import FIXTURES
from tests.record import samples

TOOL = "/star/tool"


@cache
def star() -> tuple[list[Entry], dict[str, str]]:
    with SessionFile.open(FIXTURES / "star.mcap") as file:
        return [entry for entry in file.entries() if entry.size < 100_000], file.definitions


def compared(
    one: list[Entry], other: list[Entry], *globs: str, tolerance: Tolerance = EXACT, foreign: bool = False
) -> DiffReport:
    decoder = LeafDecoder(star()[1])
    return diff(DiffInput(one, decoder), DiffInput(other, decoder), globs=globs, tolerance=tolerance, foreign=foreign)


def stream(report: DiffReport, name: str) -> StreamDiff:
    return next(stream for stream in report.streams if stream.stream == name)


def others_equal(report: DiffReport, *names: str) -> bool:
    return all(stream.equal for stream in report.streams if stream.stream not in names)


def changed(where: Callable[[Entry], bool], change: Callable[[Entry], Entry]) -> list[Entry]:
    return [change(entry) if where(entry) else entry for entry in star()[0]]


def tool(entry: Entry) -> bool:
    return entry.channel == TOOL


def further(by_m: float) -> Callable[[Entry], Entry]:
    def move(entry: Entry) -> Entry:
        pose = TransformStamped.unpack(entry.data())
        x, y, z = pose.translation
        return replace(entry, payload=(replace(pose, translation=(x, y, z + by_m)).pack(),))

    return move


def test_a_recording_equals_itself() -> None:
    report = compared(star()[0], star()[0])
    assert report.equal and report.offset_ns == report.stamp_offset_ns == 0
    assert sum(stream.messages for stream in report.streams) == len(star()[0])


def test_a_later_recording_of_the_same_equals_it_and_tells_the_offset() -> None:
    later = [replace(entry, stamp_ns=entry.stamp_ns + 10**9 + entry.seq % 2 * 10**6) for entry in star()[0]]
    report = compared(star()[0], later)
    assert report.equal
    assert report.offset_ns == pytest.approx(1.0005e9, rel=1e-3)
    assert stream(report, TOOL).jitter_ns <= 0.5e6


@pytest.mark.parametrize("index", [0, 1, 100, -1])
def test_a_message_that_is_gone_is_missing_and_nothing_else_differs(index: int) -> None:
    gone = list(filter(tool, star()[0]))[index]
    without = [entry for entry in star()[0] if entry is not gone]
    report = compared(star()[0], without)
    told = stream(report, TOOL)
    assert (told.missing, told.extra, told.different) == (1, 0, 0)
    assert told.first_missing == gone.seq
    assert others_equal(report, TOOL)
    told = stream(compared(without, star()[0]), TOOL)
    assert (told.missing, told.extra, told.first_extra) == (0, 1, gone.seq)


def test_a_long_gap_is_missing_and_nothing_else_differs() -> None:
    tools = list(filter(tool, star()[0]))
    gone = tools[300:700]
    without = [entry for entry in star()[0] if not (tool(entry) and entry in gone)]
    told = stream(compared(star()[0], without), TOOL)
    assert (told.missing, told.extra, told.different, told.first_missing) == (400, 0, 0, gone[0].seq)
    one, other = ([replace(entry, source_ns=0) for entry in entries] for entries in (star()[0], without))
    told = stream(compared(one, other), TOOL)
    assert (told.missing, told.extra, told.different, told.restamped) == (400, 0, 0, 0)


def test_two_swapped_messages_are_found() -> None:
    entries = list(star()[0])
    one, other = [index for index, entry in enumerate(entries) if tool(entry)][50:52]
    for here, there in ((one, other), (other, one)):
        place, given = star()[0][here], star()[0][there]
        entries[here] = replace(given, seq=place.seq, stamp_ns=place.stamp_ns)
    told = stream(compared(star()[0], entries), TOOL)
    assert (told.missing, told.extra, told.different) == (1, 1, 0)


def test_values_differ_in_millimetres_at_a_place() -> None:
    chosen = list(filter(tool, star()[0]))[70]
    report = compared(star()[0], changed(lambda entry: entry is chosen, further(0.002)))
    told = stream(report, TOOL)
    assert (told.different, told.missing, told.extra, told.mm_at) == (1, 0, 0, 71)
    assert told.mm == pytest.approx(2.0)
    assert told.first is not None and told.first.seq == chosen.seq
    assert told.first.delta.field == "transform" and "message 71" in str(told.first)
    assert others_equal(report, TOOL)


def test_within_the_tolerance_all_is_equal_but_told() -> None:
    noisy = changed(tool, further(0.0005))
    report = compared(star()[0], noisy, tolerance=Tolerance(mm=0.6))
    told = stream(report, TOOL)
    assert report.equal and told.within == told.messages and told.mm == pytest.approx(0.5)
    assert not compared(star()[0], noisy, tolerance=Tolerance(mm=0.4)).equal


def test_noise_does_not_hide_which_message_is_missing() -> None:
    noisy = changed(tool, further(0.0005))
    gone = list(filter(tool, noisy))[33]
    told = stream(compared(star()[0], [e for e in noisy if e is not gone], tolerance=Tolerance(mm=1)), TOOL)
    assert (told.missing, told.first_missing, told.different) == (1, gone.seq, 0)


def shifted(entry: Entry, by_ns: int) -> Entry:
    pose = TransformStamped.unpack(entry.data())
    stamp_ns = pose.header.stamp_ns + by_ns
    moved = replace(pose, header=replace(pose.header, stamp_ns=stamp_ns))
    return replace(entry, payload=(moved.pack(),), source_ns=stamp_ns)


def test_stamps_that_are_all_later_are_equal_and_a_single_one_is_not() -> None:
    tools = list(filter(tool, star()[0]))
    later = [shifted(entry, 5_000_000) for entry in tools]
    report = compared(tools, later)
    assert report.equal and report.stamp_offset_ns == 5_000_000
    later[40] = shifted(tools[40], 9_000_000)
    report = compared(tools, later)
    assert not report.equal and report.stamp_offset_ns == 5_000_000
    told = stream(report, TOOL)
    assert told.restamped == 1 and told.first is not None and told.first.index == 41


def test_streams_are_chosen_by_glob() -> None:
    report = compared(star()[0], star()[0], "TRANSFORM/*", "/star/status")
    assert {one.stream for one in report.streams} == {"TRANSFORM/ToolToBase", "TRANSFORM/CameraToBase", "/star/status"}


def test_a_stream_of_one_side_only_is_missing_as_a_whole() -> None:
    told = stream(compared(star()[0], [entry for entry in star()[0] if not tool(entry)]), TOOL)
    assert told.missing == told.messages > WINDOW and told.other_messages == 0


def test_a_foreign_recording_is_compared_by_its_topics() -> None:
    inputs = [entry for entry in star()[0] if entry.kind is Kind.ROS_IN]
    bag = [replace(entry, seq=number) for number, entry in enumerate(inputs, start=1)]
    report = compared(star()[0], bag, foreign=True)
    assert {one.kind for one in report.streams} == {"ros"}
    assert others_equal(report, *(one.stream for one in report.streams if one.stream.startswith("/igtl")))


def test_memory_holds_a_window_of_each_stream() -> None:
    alive: set[int] = set()
    most = 0

    class Told(bytes):
        def __del__(self) -> None:
            alive.discard(id(self))

    def made(text: str) -> Iterator[Entry]:
        nonlocal most
        for seq in range(1, 8_000):
            data = Told(samples.string_cdr(f"{text} {seq}"))
            alive.add(id(data))
            most = max(most, len(alive))
            yield Entry(seq, seq, Kind.ROS_IN, "/t", "std_msgs/msg/String", (data,))
            del data

    decoder = LeafDecoder()
    report = diff(DiffInput(made("one"), decoder), DiffInput(made("two"), decoder))
    assert report.streams[0].different == 7_999
    assert most < 3 * WINDOW


@pytest.mark.parametrize(("off_ns", "restamped"), [(1_000, 0), (-1_000, 0), (1_001, 1), (-1_001, 1)])
def test_the_rounding_of_a_stamp_is_no_difference(off_ns: int, restamped: int) -> None:
    """A stamp of 32.32 bits that became one of ROS, or went there and back."""
    tools = list(filter(tool, star()[0]))
    later = [shifted(entry, 5_000_000 + off_ns * (number == 40)) for number, entry in enumerate(tools)]
    assert stream(compared(tools, later), TOOL).restamped == restamped


def test_of_equal_deviations_the_first_is_named() -> None:
    given = list(filter(tool, star()[0]))[:6]
    pose = TransformStamped.unpack(given[0].data())
    turned = replace(pose, translation=(0.0, 0.0, 0.25), rotation=(0.0, 0.0, 0.6, 0.8))
    pose = replace(pose, translation=(0.0, 0.0, 0.0), rotation=(0.0, 0.0, 0.0, 1.0))

    def of(*moved: int) -> list[Entry]:
        return [replace(entry, payload=((turned if at in moved else pose).pack(),)) for at, entry in enumerate(given)]

    told = stream(compared(of(), of(2, 4), tolerance=Tolerance(mm=1000, deg=100)), TOOL)
    assert (told.mm, told.mm_at, told.deg_at, told.within) == (250.0, 3, 3, 2)
    assert told.deg == pytest.approx(73.74, abs=0.01)


@pytest.mark.parametrize(("one", "other"), [("mm", "m"), ("m", "mm"), ("m", "m")])
def test_each_recording_has_its_own_units(one: str, other: str) -> None:
    """What one program sends in metres and another one in millimetres is equal."""

    def side(unit: str) -> DiffInput:
        by = 1.0 if unit == "mm" else 0.001
        entries = []
        for number in range(1, 6):
            matrix = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 10.0 * number * by, 20.0 * by, 30.0 * by)
            data = join(encode(Message("TRANSFORM", "Tool", Transform(matrix))))
            entries.append(Entry(number, number * 10**9, Kind.IGTL_IN, "TRANSFORM/Tool", "TRANSFORM", (data,), (1,)))
        return DiffInput(entries, LeafDecoder({}, StreamUnits(Config(igtl_unit=unit))))

    (found,) = diff(side(one), side(other), tolerance=Tolerance(mm=0.01)).streams
    assert found.equal and found.mm < 0.01 and (found.messages, found.other_messages) == (5, 5)
