"""What passes the gate, and what goes with it."""

from __future__ import annotations

import pytest

from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.record import selection
from igtl_gateway.record.selection import Selection, SelectionFilter, StateInputRule
from tests.record import samples

RULE = StateInputRule(frozenset({"/igtl/links"}), frozenset({"COMMAND"}), frozenset({"/tf"}))


def passed(gate: SelectionFilter, entries: list[Entry]) -> list[int]:
    return [entry.seq for given in entries for entry in gate.take(given)]


@pytest.mark.parametrize(
    ("chosen", "inside", "outside"),
    [
        (Selection(), ["TRANSFORM/a", "/chatter"], []),
        (Selection(include=("TRANSFORM/*",)), ["TRANSFORM/a"], ["IMAGE/a", "/chatter"]),
        (Selection(include=("a",)), ["TRANSFORM/a", "IMAGE/a"], ["TRANSFORM/b", "/a"]),
        (Selection(exclude=("/camera/**",)), ["/chatter", "IMAGE/a"], ["/camera/left/image"]),
        (Selection(("IMAGE/*",), ("IMAGE/b",)), ["IMAGE/a"], ["IMAGE/b", "/chatter"]),
    ],
)
def test_globs_fit_streams_devices_and_topics(chosen: Selection, inside: list[str], outside: list[str]) -> None:
    for names, expected in ((inside, True), (outside, False)):
        for name in names:
            kind = Kind.ROS_IN if name.startswith("/") else Kind.IGTL_IN
            assert (Entry(1, 1, kind, name) in chosen) == expected, name


def test_an_input_takes_its_outputs_with_it() -> None:
    gate = SelectionFilter(Selection(exclude=("IMAGE/*",)), RULE)
    entries = [
        samples.igtl(1, message_type="IMAGE", device="a"),
        samples.ros(2, Kind.ROS_OUT, topic="/igtl/in/a/image"),
        samples.igtl(3),
        samples.ros(4, Kind.ROS_OUT),
        samples.igtl(5, message_type="IMAGE", device="a"),
    ]
    assert passed(gate, entries) == [3, 4]
    gate.end()
    assert gate.left_out == {"IMAGE/a": 2, "/igtl/in/a/image": 1}


@pytest.mark.parametrize(
    "telling",
    [samples.note(3), samples.ros(3, Kind.ROS_OUT, topic="/igtl/links"), samples.ros(3, Kind.ROS_OUT, topic="/tf")],
    ids=["note", "links", "frames"],
)
def test_an_input_by_which_the_gateway_learned_is_recorded_whole(telling: Entry) -> None:
    gate = SelectionFilter(Selection(exclude=("**",)), RULE)
    entries = [samples.igtl(1), samples.ros(2, Kind.ROS_OUT), telling, samples.ros(4, Kind.ROS_OUT)]
    assert passed(gate, entries) == [1, 2, 3, 4]
    assert passed(gate, [samples.igtl(5), samples.ros(6, Kind.ROS_OUT)]) == []


@pytest.mark.parametrize("paused", [False, True])
def test_links_notes_and_commands_are_always_recorded(paused: bool) -> None:
    gate = SelectionFilter(Selection(exclude=("**",)), RULE)
    gate.paused = paused
    entries = [
        samples.note(1, Kind.LINK),
        samples.note(2, Kind.EDGE_NOTE),
        samples.igtl(3, message_type="COMMAND"),
        samples.ros(4, topic="/tf"),
    ]
    assert passed(gate, entries) == [1, 2, 3, 4]


def test_a_pause_acts_between_inputs() -> None:
    gate = SelectionFilter(Selection(), RULE)
    assert passed(gate, [samples.igtl(1)]) == [1]
    gate.paused = True
    assert passed(gate, [samples.ros(2, Kind.ROS_OUT), samples.igtl(3)]) == [2]
    gate.paused = False
    assert passed(gate, [samples.ros(4, Kind.ROS_OUT), samples.igtl(5)]) == [5]
    assert gate.left_out == {"TRANSFORM/ProbeToTracker": 1, "/chatter": 1}


def test_what_is_counted_by_stream_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(selection, "MAX_STREAMS", 2)
    gate = SelectionFilter(Selection(exclude=("**",)), RULE)
    passed(gate, [samples.igtl(seq, device=f"n{seq}") for seq in range(1, 6)])
    gate.end()
    assert gate.left_out == {"TRANSFORM/n1": 1, "TRANSFORM/n2": 1, "(others)": 3}


def test_a_recording_says_what_was_chosen() -> None:
    assert Selection().facts() == {}
    assert Selection(("a", "b"), ("c",)).facts() == {"record_include": '["a", "b"]', "record_exclude": '["c"]'}


def test_what_the_guard_of_a_robot_knows_is_recorded_in_any_case() -> None:
    rule = StateInputRule(robots=("/PSM*/measured_cp", "/PSM1/servo_cp"))
    gate = SelectionFilter(Selection(exclude=("**",)), rule)
    entries = [
        samples.ros(1, topic="/PSM1/measured_cp"),
        samples.ros(2, topic="/PSM1/measured_cv"),
        samples.igtl(3),
        samples.ros(4, Kind.ROS_OUT, topic="/PSM1/servo_cp"),
        samples.igtl(5),
        samples.ros(6, Kind.ROS_OUT, topic="/PSM2/servo_cp"),
    ]
    assert passed(gate, entries) == [1, 3, 4]
