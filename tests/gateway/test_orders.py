"""Orders: what the edge may write, and how a session knows what it did not write."""

from __future__ import annotations

from dataclasses import replace

import pytest

from igtl_gateway.base.buffers import join
from igtl_gateway.base.qos import Qos
from igtl_gateway.base.stamp import NS_PER_MS, ns_to_ticks
from igtl_gateway.gateway import Session
from igtl_gateway.gateway.core import Gateway
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.groups import input_groups
from igtl_gateway.gateway.log.note import Level, Note
from igtl_gateway.gateway.orders import (
    ORDERS,
    UNWRITTEN,
    Heard,
    Order,
    Unwritten,
    is_unwritten,
    note_of,
    orders_of,
    unwritten,
)
from igtl_gateway.wire import Message
from igtl_gateway.wire.bind import Bind, BindChild
from igtl_gateway.wire.text import String
from igtl_gateway.wire.transform import Transform
from tests.gateway.test_command_motion import Robot

ORDER = Order("PSM1/servo_cp", "/PSM1/servo_cp", "t", b"", Qos(1), 1_000, 500 * NS_PER_MS, 10 * NS_PER_MS, begins=False)
SOON_NS = 1_000 + NS_PER_MS


@pytest.mark.parametrize(
    ("order", "heard", "age_ms", "passed_ms", "code"),
    [
        (ORDER, Heard(1), 1, 10, ""),
        (ORDER, Heard(1), 1, None, ""),
        (ORDER, Heard(0), 1, 10, "command_unheard"),
        (ORDER, Heard(0, joined=True), 1, 10, "command_unheard"),
        (ORDER, Heard(1, joined=True, unsettled=True), 1, None, "command_unheard"),
        (replace(ORDER, begins=True), Heard(1, unsettled=True), 1, None, "command_unheard"),
        (ORDER, Heard(2, joined=True), 1, 10, "command_newcomer"),
        (replace(ORDER, begins=True), Heard(2, joined=True), 1, 10, ""),
        (ORDER, Heard(1), 498, 10, ""),
        (ORDER, Heard(1), 500, 10, "command_late"),
        (replace(ORDER, max_age_ns=NS_PER_MS), Heard(1), 0.85, 10, ""),
        (replace(ORDER, max_age_ns=0), Heard(1), 5_000, 10, ""),
        (replace(ORDER, stamp_ns=0), Heard(1), 5_000, 10, ""),
        (ORDER, Heard(1), 1, 9.99, "command_speed"),
        (replace(ORDER, speed_code="command_joint_speed"), Heard(1), 1, 0, "command_joint_speed"),
    ],
)
def test_what_may_be_written(order: Order, heard: Heard, age_ms: float, passed_ms: float | None, code: str) -> None:
    passed_ns = None if passed_ms is None else round(passed_ms * NS_PER_MS)
    refused = unwritten(order, heard, 1_000 + round(age_ms * NS_PER_MS), passed_ns)
    assert (refused.code if refused else "") == code
    if refused:
        assert refused.text.startswith("PSM1/servo_cp: found ")
        assert "expected" in refused.text


def test_a_note_has_what_was_not_written() -> None:
    orders = {0: Unwritten("command_unheard", "text"), 12: Unwritten("command_late", "other")}
    note = Note.unpack(note_of("TRANSFORM/PSM1/servo_cp", orders).pack())
    assert orders_of(note) == orders
    assert (note.code, note.stream) == (UNWRITTEN, "TRANSFORM/PSM1/servo_cp")


@pytest.mark.parametrize(
    "data", [{}, {ORDERS: 1}, {ORDERS: {"x": ["a", "b"]}}, {ORDERS: {"0": "ab"}}, {ORDERS: {"0": [1, "b"]}}]
)
def test_a_note_of_others_has_none(data: dict[str, object]) -> None:
    note = Note(Level.INFO, UNWRITTEN, "", "", data)
    assert orders_of(note) == {}
    assert orders_of(replace(note, code="other", data={ORDERS: {"0": ["a", "b"]}})) == {}


class Edge:
    """Refuses the orders whose numbers it is given, and remembers all."""

    def __init__(self, robot: Robot, refuses: dict[int, str]) -> None:
        self.orders: list[Order] = []
        self._refuses = refuses
        robot.gateway.write = self.write

    def write(self, order: Order) -> Unwritten | None:
        self.orders.append(order)
        code = self._refuses.get(len(self.orders))
        return Unwritten(code, f"{order.device}: {code}") if code else None


def again(robot: Robot) -> list[Entry]:
    """Compute a session again from its inputs."""
    session = Session(Gateway(robot.gateway.config, fast_path=False))
    entries: list[Entry] = []
    for group in input_groups(robot.log):
        entries += [group.input, *session.recorded(group.input)]
    return entries


def servo(robot: Robot, x: float, after_ms: float) -> str:
    now_ns = robot.now_ns + round(after_ms * NS_PER_MS)
    return robot.servo(x, now_ns, now_ns)


def test_a_refusal_of_the_edge_is_an_input_before_the_command() -> None:
    robot = Robot()
    edge = Edge(robot, {2: "command_late"})
    assert [servo(robot, x, 10) for x in (0.0, 0.001, 0.002)] == ["", "command_late", ""]
    refused = next(number for number, entry in enumerate(robot.log) if is_unwritten(entry))
    kinds = [entry.kind for entry in robot.log[refused : refused + 3]]
    assert kinds == [Kind.EDGE_NOTE, Kind.IGTL_IN, Kind.NOTE]
    numbers = [entry.seq for entry in robot.log]
    assert numbers == list(range(1, len(numbers) + 1))
    stamps = [entry.stamp_ns for entry in robot.log]
    assert stamps == sorted(set(stamps))
    assert again(robot) == robot.log
    assert [round(order.needs_ns / NS_PER_MS, 3) for order in edge.orders] == [0.0, 4.0, 8.0], "since what was written"
    assert [order.begins for order in edge.orders] == [True, False, False]
    assert edge.orders[-1].cdr is robot.log[-1].payload[0], "by which the application knows what is written"


@pytest.mark.parametrize("code", ["command_unheard", "command_newcomer"])
def test_after_it_a_stream_begins_where_the_arm_is(code: str) -> None:
    """50 mm away from the arm it goes on only with what was written before."""
    robot = Robot()
    edge = Edge(robot, {12: code})
    for number in range(11):
        assert servo(robot, 0.002 * number, 10) == ""
    assert servo(robot, 0.022, 10) == code
    assert servo(robot, 0.02, 10) == "command_unknown_state", "no state of the arm after the last command"
    robot.now_ns += 60 * NS_PER_MS
    robot.measure()
    assert servo(robot, 0.026, 10) == "command_speed", "6 mm from the arm"
    assert servo(robot, 0.0245, 1) == ""
    assert [order.begins for order in edge.orders[-2:]] == [False, True]
    assert servo(robot, 0.026, 10) == "", "it goes on"
    assert again(robot) == robot.log


def test_of_the_commands_in_a_bind_each_has_its_own_answer() -> None:
    robot = Robot(max_speed=0.0, max_turn_speed=0.0)
    edge = Edge(robot, {2: "command_unheard", 3: "command_late"})
    at = Transform((1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0))
    children = [
        BindChild("TRANSFORM", "PSM1/servo_cp", join(at.pack())),
        BindChild("STRING", "PSM1/state_command", join(String.of("home").pack())),
        BindChild("STRING", "PSM1/state_command", join(String.of("explode").pack())),
        BindChild("TRANSFORM", "PSM2/servo_cp", join(at.pack())),
    ]
    lines = robot.igtl(Message("BIND", "all", Bind(tuple(children)), ns_to_ticks(robot.now_ns)))
    assert [line for line in lines if "PSM" in line] == ["ros /PSM1/servo_cp"]
    assert [line for line in lines if line.startswith("note command")] == [
        "note command_unheard",
        "note command_word",
        "note command_late",
    ]
    assert len(edge.orders) == 3
    assert again(robot) == robot.log


@pytest.mark.parametrize("after_ns", [-5_000_000, 0, 1, 2, 3])
def test_the_note_of_a_refusal_has_a_stamp_of_its_own_also_when_the_clock_stands(after_ns: int) -> None:
    robot = Robot()
    Edge(robot, {2: "command_late"})
    assert servo(robot, 0.0, 10) == ""
    last_ns = robot.log[-1].stamp_ns
    at = Transform((1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0))
    command = Message("TRANSFORM", "PSM1/servo_cp", at, ns_to_ticks(robot.now_ns + 20 * NS_PER_MS))
    robot.now_ns = last_ns + after_ns - NS_PER_MS
    assert "note command_late" in robot.igtl(command)
    stamps = [entry.stamp_ns for entry in robot.log]
    assert stamps == sorted(set(stamps)), "strictly increasing"
    assert [entry.seq for entry in robot.log] == list(range(1, len(stamps) + 1))


def test_a_note_whose_message_is_not_there_refuses_no_other_one() -> None:
    """As in a part of a session that has not all of its streams."""
    robot = Robot()
    robot.session.input(
        robot.now_ns + 1,
        Kind.EDGE_NOTE,
        (note_of("TRANSFORM/PSM2/servo_cp", {0: Unwritten("command_late", "late")}).pack(),),
        links=(1,),
    )
    assert servo(robot, 0.0, 10) == ""
