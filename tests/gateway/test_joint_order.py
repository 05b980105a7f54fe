"""Joints of a command and of the state of an arm are compared by name, in the order that the arm had at first."""

from __future__ import annotations

import random
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from igtl_gateway.app.recording import state_rule
from igtl_gateway.base.stamp import NS_PER_S, ns_to_ticks
from igtl_gateway.config.configuration import Config
from igtl_gateway.convert.arms import ArmsRow
from igtl_gateway.convert.common_msgs import JointState
from igtl_gateway.convert.rosmsg import Header
from igtl_gateway.gateway.joint_order import places
from igtl_gateway.gateway.log.entry import Kind
from igtl_gateway.record.prologue import Prologue
from igtl_gateway.replay.verify import DeclaredLosses, verify
from igtl_gateway.wire import Item, Message
from igtl_gateway.wire.sensor import Sensor
from tests.script import Script
from tests.tables import table

NAMES = ("yaw", "pitch", "insertion")
STATE = (0.5, -0.3, 0.1)
TOPIC, COMMAND = "/PSM1/measured_js", "PSM1/servo_jp"
LIMITS: dict[str, Any] = {"joint_min": (0.4, -0.4, 0.0), "joint_max": (0.7, -0.2, 0.2)}


def arm(**limits: Any) -> Script:
    script = Script(Config(crtk=(ArmsRow("/PSM*", **limits),), allow_in=("*/servo_*", "*/move_*")))
    script.up(1)
    return script


def measured(script: Script, names: Sequence[str] = NAMES, at: Sequence[float] = STATE, stamp_ns: int = -1) -> None:
    stamp_ns = script.now_ns if stamp_ns < 0 else stamp_ns
    script.ros(TOPIC, JointState(Header(stamp_ns), tuple(names), np.array(at, float)))


def turned(order: Sequence[int], values: Sequence[Any]) -> list[Any]:
    return [values[index] for index in order]


def send(script: Script, values: Sequence[float], names: Sequence[str] = (), name: str = "servo_jp") -> list[str]:
    items = (Item.of("JointNames", ",".join(names)),) if names else ()
    ticks = ns_to_ticks(script.now_ns)
    version = 2 if names else 1
    message = Message("SENSOR", f"PSM1/{name}", Sensor(np.array(values, ">f8")), ticks, version, metadata=items)
    return [line for line in script.igtl(message) if line != "ros /igtl/in/PSM1_servo_jp/metadata"]


def refusal(script: Script) -> str:
    (note,) = [note for note in script.notes if note.code.startswith("command_")]
    return note.text


PASSED, UNKNOWN = f"ros /{COMMAND}", "note command_unknown_state"
NEAR = (0.505, -0.305, 0.105)


@table("order", [(2, 0, 1), (1, 0, 2), (2, 1, 0), (1, 2, 0)])
@table("limits", [{}, LIMITS])
def test_a_state_in_another_order_is_compared_by_name(order: tuple[int, ...], limits: dict[str, Any]) -> None:
    """By position, the first one would be refused, and the second one would throw the arm."""
    script = arm(**limits)
    measured(script)
    measured(script, turned(order, NAMES), turned(order, STATE))
    assert send(script, NEAR)[-1] == PASSED
    got = JointState.unpack(script.published(f"/{COMMAND}"))
    assert got.position.tolist() == list(NEAR) and got.name == ()
    other = arm()
    measured(other)
    measured(other, turned(order, NAMES), turned(order, STATE))
    assert send(other, turned(order, NEAR)) == ["note command_joint_speed"]


def test_two_publishers_that_take_turns_in_two_orders_are_one_arm() -> None:
    script, order = arm(), (2, 0, 1)
    for step in range(40):
        at = [value + 0.0005 * step for value in STATE]
        if step % 2:
            measured(script, turned(order, NAMES), turned(order, at))
        else:
            measured(script, NAMES, at)
        assert send(script, [value + 0.0005 * step for value in NEAR])[-1] == PASSED, step


@table(
    ("names", "at"),
    [
        (("yaw", "pitch", "roll"), STATE),
        (("yaw", "pitch"), STATE[:2]),
        (("yaw", "pitch", "insertion", "jaw"), (*STATE, 0.0)),
        (("yaw", "yaw", "pitch"), STATE),
        ((), STATE),
    ],
)
@table("name", ["servo_jp", "servo_jr", "move_jp", "move_jr"])
def test_a_state_with_other_names_refuses_until_the_first_ones_come_again(
    names: tuple[str, ...], at: tuple[float, ...], name: str
) -> None:
    script = arm(**LIMITS)
    measured(script)
    measured(script, names, at)
    values = (0.0, 0.0, 0.0) if name.endswith("jr") else NEAR
    assert send(script, values, name=name) == [UNKNOWN]
    text = refusal(script)
    assert "found " in text and "expected 'yaw', 'pitch', 'insertion'" in text and TOPIC in text, text
    measured(script)
    assert send(script, values, name=name)[-1] == f"ros /PSM1/{name}"


def test_a_running_stream_stops_at_once_when_another_arm_publishes_its_state() -> None:
    script = arm()
    for _ in range(10):
        measured(script)
        assert send(script, NEAR)[-1] == PASSED
    measured(script, ("a", "b", "c"))
    assert send(script, NEAR) == [UNKNOWN]
    measured(script)
    assert send(script, NEAR)[-1] == PASSED


def test_the_order_is_that_of_the_first_valid_state_with_names() -> None:
    script = arm()
    measured(script, ())  # no names: by position, as long as none has names
    assert send(script, NEAR)[-1] == PASSED
    measured(script, ("pitch", "yaw", "insertion"), stamp_ns=0)  # not valid
    measured(script, ("pitch", "pitch", "insertion"))
    measured(script)
    measured(script, ("insertion", "yaw", "pitch"), (0.1, 0.5, -0.3))
    assert send(script, NEAR)[-1] == PASSED


@table("order", [(0, 1, 2), (2, 0, 1), (1, 0, 2)])
def test_a_command_with_names_is_matched_by_them(order: tuple[int, ...]) -> None:
    script = arm(**LIMITS)
    measured(script)
    assert send(script, turned(order, NEAR), turned(order, NAMES))[-1] == PASSED
    got = JointState.unpack(script.published(f"/{COMMAND}"))
    assert got.position.tolist() == list(NEAR), "robots take it by position"
    assert got.name == NAMES, "or by name"


@table(
    ("values", "names", "line", "words"),
    [
        (NEAR, ("yaw", "pitch", "roll"), UNKNOWN, "'roll', expected those of /PSM1/measured_js: 'yaw', 'pitch'"),
        (NEAR, ("yaw", "yaw", "pitch"), UNKNOWN, "expected those of"),
        (NEAR, ("yaw", "pitch"), "note command_joint_count", "3 values for the joints 'yaw', 'pitch', expected one"),
        (NEAR[:2], ("yaw", "pitch"), UNKNOWN, "expected those of"),
    ],
)
def test_a_command_with_other_names_is_refused(
    values: tuple[float, ...], names: tuple[str, ...], line: str, words: str
) -> None:
    script = arm()
    measured(script)
    assert send(script, values, names) == [line]
    assert words in refusal(script)


def test_a_command_with_names_for_an_arm_without_names_is_refused() -> None:
    script = arm()
    measured(script, ())
    assert send(script, NEAR, NAMES) == [UNKNOWN]
    assert "none has a name" in refusal(script)
    assert send(script, NEAR)[-1] == PASSED


def world(seed: int) -> Script:
    """An arm whose state comes from several publishers, and commands with and without names."""
    chance, script = random.Random(seed), arm(**LIMITS)
    orders = [(0, 1, 2), (2, 0, 1), (1, 0, 2)]
    for step in range(120):
        at = [value + 0.0002 * step for value in STATE]
        order = chance.choice(orders)
        kind = chance.random()
        if kind < 0.55:
            measured(script, turned(order, NAMES), turned(order, at))
        elif kind < 0.6:
            measured(script, chance.choice([(), ("a", "b", "c")]), at)
        elif kind < 0.65:
            script.now_ns += chance.choice([NS_PER_S // 5, NS_PER_S])
        elif kind < 0.85:
            send(script, at)
        else:
            send(script, turned(order, at), turned(order, chance.choice([NAMES, ("a", "b", "c")])))
    return script


@pytest.mark.parametrize("seed", range(30))
def test_sessions_and_their_parts_verify(seed: int) -> None:
    """A part knows the first order, though its prologue has the last state of each topic only."""
    script = world(seed)
    config = script.gateway.config
    report = verify(script.log, config)
    assert report.good and report.equal == report.outputs
    inputs = [at for at, entry in enumerate(script.log) if entry.kind.is_input][2:]
    for at in random.Random(seed).sample(inputs, 4):
        prologue = Prologue(state_rule(config))
        for entry in script.log[:at]:
            prologue.observe(entry)
        part = verify(script.log[at:], config, DeclaredLosses(midway=True), before=prologue.copy().entries())
        assert part.good and part.equal == part.outputs, part.differences[:1]


def test_what_reaches_the_robot_is_within_reach_by_name() -> None:
    """Whatever the order of the state: each published set point is near the arm, joint by joint."""
    count = 0
    for seed in range(40):
        script = world(seed)
        at: dict[str, float] = {}
        for entry in script.log:
            if entry.kind is Kind.ROS_IN and entry.channel == TOPIC:
                state = JointState.unpack(entry.payload[0])
                if set(state.name) == set(NAMES):
                    at = dict(zip(state.name, state.position.tolist(), strict=True))
            elif entry.kind is Kind.ROS_OUT and entry.channel == f"/{COMMAND}":
                goal = dict(zip(NAMES, JointState.unpack(entry.payload[0]).position.tolist(), strict=True))
                assert all(abs(goal[name] - at[name]) <= 0.2 for name in NAMES)
                count += 1
    assert count > 200


@table(
    ("names", "expected"),
    [((), None), (("a", "b"), [0, 1]), (("b", "a"), [1, 0]), (("a", "a"), None), (("a", "b", "c"), None)],
)
def test_places(names: tuple[str, ...], expected: list[int] | None) -> None:
    assert places(names, ("a", "b")) == expected
