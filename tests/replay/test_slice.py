"""A slice is a session: it verifies, its window holds what was recorded, and its prologue is short."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from itertools import pairwise

import pytest

from igtl_gateway.config.configuration import Config
from igtl_gateway.convert.units import UNITS
from igtl_gateway.gateway import LINK_UP, Session
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.groups import input_groups
from igtl_gateway.gateway.log.note import Note
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.replay.slice import Slice, SliceReport
from igtl_gateway.replay.slice_state import SMALL_BYTES, Depth, SliceWindow
from igtl_gateway.replay.verify import DeclaredLosses, verify
from tests.places import FIXTURES
from tests.tables import table

NAMES = ("star", "paper-types", "every-type")
PARTS = ((0.0, 1.0), (0.0, 0.2), (0.3, 0.6), (0.5, 0.55), (0.9, 1.0))


@cache
def recorded(name: str) -> tuple[list[Entry], Config]:
    with SessionFile.open(FIXTURES / f"{name}.mcap") as file:
        return list(file.entries()), Config.from_dict(json.loads(file.session["config"]))


def window(entries: list[Entry], part: tuple[float, float], *globs: str) -> SliceWindow:
    start_ns, span_ns = entries[0].stamp_ns, entries[-1].stamp_ns - entries[0].stamp_ns
    return SliceWindow(start_ns + int(part[0] * span_ns), start_ns + int(part[1] * span_ns) + 1, globs)


def cut(entries: list[Entry], config: Config, wanted: SliceWindow) -> tuple[list[Entry], SliceReport]:
    part = Slice(lambda: entries, config, wanted)
    return list(part.entries()), part.report


def content(entry: Entry) -> object:
    return (entry.stamp_ns, entry.kind, entry.channel, entry.links, entry.data())


@pytest.mark.slow
@table("part", PARTS)
@table("name", NAMES)
def test_a_slice_verifies_and_holds_what_was_recorded(name: str, part: tuple[float, float]) -> None:
    entries, config = recorded(name)
    wanted = window(entries, part)
    made, report = cut(entries, config, wanted)
    found = verify(made, config)
    assert found.good, found.differences[0]
    assert [entry.seq for entry in made] == list(range(1, len(made) + 1))
    assert all(one.stamp_ns < other.stamp_ns for one, other in pairwise(made))
    inside = [
        entry
        for group in input_groups(entries)
        if wanted.start_ns <= group.input.stamp_ns < wanted.end_ns
        for entry in (group.input, *group.outputs)
    ]
    assert report.inputs + report.outputs == len(inside)
    assert list(map(content, made[len(made) - len(inside) :])) == list(map(content, inside))
    assert not report.computed and not report.differing


def test_the_prologue_is_short_and_has_no_picture_that_was_followed_by_another() -> None:
    entries, config = recorded("star")
    made, report = cut(entries, config, window(entries, (0.5, 0.6)))
    assert report.depth is Depth.STATE
    assert report.prologue < 30 < report.inputs
    before = [entry for entry in made if entry.stamp_ns < window(entries, (0.5, 0.6)).start_ns]
    large = [entry.channel for entry in before if entry.kind is Kind.ROS_IN and entry.size > SMALL_BYTES]
    assert large and len(large) == len(set(large))


@pytest.mark.parametrize("glob", ["TRANSFORM/*", "Camera", "/star/status"])
def test_streams_are_chosen_by_input_or_by_output_and_the_rest_is_left_out(glob: str) -> None:
    entries, config = recorded("star")
    made, report = cut(entries, config, window(entries, (0.25, 0.75), glob))
    assert verify(made, config).good
    streams = {entry.channel for entry in made if entry.kind is Kind.ROS_IN}
    expected = {
        "TRANSFORM/*": {"/star/tool", "/star/camera_pose"},
        "Camera": {"/star/camera/image"},
        "/star/status": {"/star/status"},
    }
    assert streams == expected[glob]
    assert report.inputs > 1 and not report.computed


@pytest.mark.parametrize("glob", ["TRANSFORM/*", "STRING/**", "/igtl/in/*/image"])
@pytest.mark.parametrize("name", ["paper-types", "every-type"])
def test_what_depends_on_streams_that_are_left_out_is_computed_and_told(name: str, glob: str) -> None:
    entries, config = recorded(name)
    made, report = cut(entries, config, window(entries, (0.1, 0.9), glob))
    assert verify(made, config).good
    assert report.computed <= 5
    assert len(made) < len(entries) / 2


@table("globs", [(), ("TRANSFORM/**",)])
def test_what_the_window_computes_is_computed_once(monkeypatch: pytest.MonkeyPatch, globs: tuple[str, ...]) -> None:
    entries, config = recorded("star")
    computed: list[int] = []
    original = Session.recorded

    def counted(self: Session, given: Entry) -> list[Entry]:
        computed.append(given.seq)
        return original(self, given)

    monkeypatch.setattr(Session, "recorded", counted)
    found, report = cut(entries, config, window(entries, (0.3, 0.6), *globs))
    assert report.inputs > 100 and not report.differing
    assert len(computed) == 2 * report.prologue + report.inputs
    assert len(found) > report.inputs and report.ledger


def test_a_part_of_a_slice_is_one_too() -> None:
    entries, config = recorded("star")
    once, _ = cut(entries, config, window(entries, (0.2, 0.8)))
    wanted = window(entries, (0.4, 0.6))
    twice, _ = cut(once, config, wanted)
    directly, _ = cut(entries, config, wanted)
    assert list(map(content, twice)) == list(map(content, directly))


def test_what_was_recorded_stays_even_where_todays_gateway_says_otherwise(monkeypatch: pytest.MonkeyPatch) -> None:
    entries, config = recorded("paper-types")
    wanted = window(entries, (0.5, 1.0))
    before, _ = cut(entries, config, wanted)
    monkeypatch.setitem(UNITS, "mm", 999)
    after, report = cut(entries, config, wanted)
    assert report.differing and not verify(after, config).good
    assert {content(entry) for entry in before if entry.stamp_ns >= wanted.start_ns} <= set(map(content, after))


@table(("size", "is_small"), [(4_096, True), (4_097, False)])
def test_a_small_input_has_4_kib(size: int, is_small: bool) -> None:
    """Of each stream the last input before the window is there, and the first one if it is small."""
    inputs = [
        Entry(number, 1_000 * number, Kind.ROS_IN, "/topic", "std_msgs/msg/String", (bytes(size),))
        for number in range(1, 5)
    ]
    made, report = cut(inputs, Config(), SliceWindow(4_000, 5_000))
    kept = [entry.stamp_ns for entry in made if entry.kind is Kind.ROS_IN]
    assert kept == ([1_000] if is_small else []) + [3_000, 4_000]
    assert report.depth is Depth.STATE


def lost(entries: list[Entry], which: Callable[[Entry], bool]) -> list[Entry]:
    index = next(index for index, entry in enumerate(entries) if which(entry))
    return [*entries[:index], *entries[index + 1 :]]


def test_what_the_recorder_lost_stays_a_gap() -> None:
    entries, config = recorded("star")
    wanted = window(entries, (0.5, 0.6))
    cutting = lost(entries, lambda e: e.kind is Kind.IGTL_OUT and e.stamp_ns > wanted.start_ns)
    made, report = cut(cutting, config, wanted)
    missing = set(range(1, made[-1].seq + 1)) - {entry.seq for entry in made}
    assert len(missing) == 1 and report.differing == 1
    assert verify(made, config).differing == 1
    assert verify(made, config, DeclaredLosses(1, {"(others)": 1})).good


def test_a_link_that_is_gone_is_not_in_the_prologue() -> None:
    entries, config = recorded("every-type")
    end = entries[-1]
    wanted = SliceWindow(end.stamp_ns + 1, end.stamp_ns + 2)
    last = replace(end, seq=end.seq + 1, stamp_ns=end.stamp_ns + 1, kind=Kind.ROS_IN, channel="/x", payload=(b"",))
    made, _ = cut([*entries, last], config, wanted)
    up: set[int] = set()
    for entry in entries:
        if entry.kind is Kind.LINK:
            up = up | set(entry.links) if Note.unpack(entry.data()).code == LINK_UP else up - set(entry.links)
    assert {link for entry in made if entry.kind is Kind.LINK for link in entry.links} == up


def test_groups_are_inputs_with_all_that_follows() -> None:
    entries, _ = recorded("paper-types")
    found = list(input_groups(entries))
    assert sum(1 + len(group.outputs) for group in found) == len(entries)
    assert sum(group.extent for group in found) == entries[-1].seq
    assert list(input_groups(entries[1:2])) == []


#: Size of an input of the prologue, and whether another one of its stream follows → whether it stays.
@table(
    ("size", "followed", "stays"),
    [(100_000, True, False), (100_000, False, True), (100, True, True), (100, False, True)],
)
def test_a_prologue_loses_pictures_that_others_follow(size: int, followed: bool, stays: bool) -> None:
    def picture(seq: int, stamp_ns: int) -> Entry:
        return Entry(seq, stamp_ns, Kind.ROS_IN, "/topic", "std_msgs/msg/String", (bytes(size),))

    inputs = [picture(1, 2_000)] if followed else []
    inputs.append(replace(picture(2, 5_000), channel="/other"))
    part = Slice(lambda: inputs, Config(), SliceWindow(4_000, 6_000), before=[picture(1, 1_000)])
    assert len(list(part.entries())) >= 1
    assert [entry.stamp_ns for entry in part.before()] == [1_000] * stays
