"""Arms with CRTK topics: every name both ways, and the guard in front of commands."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from igtl_gateway.base.buffers import join
from igtl_gateway.base.stamp import NS_PER_MS, NS_PER_S, ns_to_ticks
from igtl_gateway.config.configuration import Config
from igtl_gateway.convert import crtk
from igtl_gateway.convert.arms import ArmsRow
from igtl_gateway.convert.common_msgs import (
    Empty,
    JointState,
    Joy,
    OperatingState,
    PoseStamped,
    StringStamped,
    TwistStamped,
    WrenchStamped,
)
from igtl_gateway.convert.poses import rotation_matrix
from igtl_gateway.convert.rosmsg import Header, RosMessage, String, TransformStamped
from igtl_gateway.gateway import LINKS_TOPIC, joint_order
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.fates import REFUSED_COMMANDS
from igtl_gateway.gateway.log.note import Note
from igtl_gateway.replay.verify import verify
from igtl_gateway.wire import Message
from igtl_gateway.wire.bind import Bind, BindChild
from igtl_gateway.wire.body import Body
from igtl_gateway.wire.ndarray import NdArray
from igtl_gateway.wire.sensor import Sensor
from igtl_gateway.wire.text import String as Text
from igtl_gateway.wire.transform import Position, Transform
from tests.places import ROOT
from tests.script import T0_NS, Script
from tests.tables import table

STAMP_NS = T0_NS + 7 * NS_PER_S
POSE = (0.1, -0.02, 0.123456789, 0.0, 0.0, math.sin(0.2), math.cos(0.2))
JOINTS = JointState(
    Header(STAMP_NS), ("yaw", "pitch", "insertion"), np.array([0.1, -0.2, 0.13]), np.array([0.0, 1.0, 2.0])
)

#: A message of each ROS type of the table, with a stamp.
MESSAGES: dict[str, RosMessage] = {
    message.TYPE: message
    for message in (
        PoseStamped(Header(STAMP_NS, "ECM"), POSE),
        JOINTS,
        TwistStamped(Header(STAMP_NS, "ECM"), (0.1, 0.2, 0.3, 1.0, 2.0, 3.0)),
        WrenchStamped(Header(STAMP_NS, "ECM"), (1.0, 2.0, 3.0, 0.1, 0.2, 0.3)),
        OperatingState(Header(STAMP_NS), "ENABLED", is_homed=True),
        StringStamped(Header(STAMP_NS), "home"),
        Joy(Header(STAMP_NS), buttons=np.array([2], np.int32)),
        String("PSM1: out of reach"),
        Empty(),
    )
}
STATES = [row for row in crtk.NAMES if not row.motion]
COMMANDS = [row for row in crtk.NAMES if row.motion]


def matrix(pose: tuple[float, ...] = POSE) -> Transform:
    (a, b, c), (d, e, f), (g, h, i) = rotation_matrix(pose[3:])  # type: ignore[arg-type]
    return Transform((a, d, g, b, e, h, c, f, i, *pose[:3]))


def arm(**limits: Any) -> Script:
    """A gateway with an arm whose peer may command all of it."""
    script = Script(Config(crtk=(ArmsRow("/PSM*", **limits),), allow_in=("*/servo_*", "*/move_*", "*/state_command")))
    script.up(1)
    return script


def measured(script: Script, pose: tuple[Any, ...] = POSE, frame: str = "ECM") -> None:
    now_ns = script.now_ns
    script.ros("/PSM1/measured_cp", PoseStamped(Header(now_ns, frame), pose))
    script.ros("/PSM1/measured_js", JointState(Header(now_ns), JOINTS.name, JOINTS.position))


def send(script: Script, name: str, content: Body, igtl_type: str) -> list[str]:
    return script.igtl(Message(igtl_type, f"PSM1/{name}", content, ns_to_ticks(script.now_ns)))


# -- states -----------------------------------------------------------------------------------------------------------


@table("row", STATES, ids=lambda row: row.name)
@table("base", ["PSM1", "ECM/jaw"])
def test_each_state_goes_to_peers_and_from_peers_to_its_topic(row: crtk.CrtkName, base: str) -> None:
    device, message = f"{base}/{row.name}", MESSAGES[row.ros_type]
    script = Script(Config(profile="crtk"))
    script.up(1)
    script.igtl(Message("STRING", "hello", Text(b"hi"), header_version=2))
    script.ros(f"/{device}", message)
    (sent,) = script.sent()
    assert sent.type == row.igtl_type
    assert sent.device_name == device if len(device) <= 20 else sent.device_name.startswith(device[:15])
    if hasattr(message, "header"):
        assert sent.ticks == ns_to_ticks(STAMP_NS)
    other = Script(Config(profile="crtk", allow_in=(device,)))
    other.up(1)
    other.igtl(sent)  # a name of more than 20 bytes is in its metadata
    got: Any = type(message).unpack(other.published(f"/{device}"))
    assert got.TYPE == row.ros_type
    if isinstance(message, JointState):
        np.testing.assert_array_equal(got.position, message.position)
        np.testing.assert_array_equal(got.velocity, message.velocity)
        assert len(got.effort) == 0 and got.header.stamp_ns == pytest.approx(STAMP_NS, abs=1)
    elif isinstance(message, PoseStamped):
        np.testing.assert_allclose(got.pose, POSE, atol=1e-7)
    elif isinstance(message, Joy):
        assert got.buttons.tolist() == [2]
    elif isinstance(message, String):
        assert got == message
    else:
        assert got == dataclasses.replace(message, header=got.header)  # type: ignore[type-var]


def test_lengths_are_metres_also_for_states_that_stay_below_igtl_in() -> None:
    script = Script(Config(profile="crtk:/PSM*"))
    script.up(1)
    script.ros("/PSM1/measured_cp", MESSAGES[PoseStamped.TYPE])
    (sent,) = script.sent()
    assert isinstance(sent.content, Transform)
    np.testing.assert_allclose(np.array(sent.content.wire_matrix[9:]), np.array(POSE[:3]), rtol=1e-7)
    script.igtl(Message("TRANSFORM", "PSM1/measured_cp", matrix(), ns_to_ticks(STAMP_NS)))
    got = TransformStamped.unpack(script.published("/igtl/in/PSM1_measured_cp/transform"))
    np.testing.assert_allclose(np.array(got.translation), np.array(POSE[:3]), rtol=1e-6)
    assert not script.gateway.subscription("/MTML/measured_cp", PoseStamped.TYPE), "another arm"
    assert not script.gateway.subscription("/igtl/in/x/status", String.TYPE)
    assert not script.gateway.subscription("/measured_cp", PoseStamped.TYPE), "without a namespace"


def test_names_of_joints_pass_as_metadata_to_peers_that_read_them() -> None:
    script = Script(Config(profile="crtk"))
    script.up(1)
    script.igtl(Message("STRING", "hello", Text(b"hi"), header_version=2))
    script.ros("/PSM1/measured_js", JOINTS)
    (sent,) = script.sent()
    assert ("JointNames", "yaw,pitch,insertion") in [(item.key, item.text) for item in sent.metadata]
    other = Script(Config(profile="crtk", allow_in=("PSM1/measured_js",)))
    other.up(1)
    other.igtl(sent)
    assert JointState.unpack(other.published("/PSM1/measured_js")).name == JOINTS.name


@pytest.mark.parametrize("name", ["measured_js", "measured_cp", "measured_cv", "operating_state"])
def test_a_stamp_of_0_means_not_valid_and_is_not_sent(name: str) -> None:
    script = Script(Config(profile="crtk"))
    script.up(1)
    message: Any = MESSAGES[crtk.BY_NAME[name].ros_type]
    invalid = dataclasses.replace(message, header=Header(0, "ECM"))
    assert script.ros(f"/PSM1/{name}", invalid, source_ns=STAMP_NS) == ["note not_valid"]
    assert script.ros(f"/PSM1/{name}", invalid, source_ns=STAMP_NS) == [], "noted once"
    assert script.gateway.ledger.to_dict()["ros_in"][f"/PSM1/{name}"]["dropped"] == {"not_valid": 2}
    assert script.ros(f"/PSM1/{name}", message) == [f"igtl {crtk.BY_NAME[name].igtl_type}/PSM1/{name} v1 to 1"]


def test_three_arms_by_a_glob_and_one_that_appears_later() -> None:
    script = Script(Config(profile="crtk:/PSM*"))
    script.up(1)
    for number in (1, 2, 3):
        assert script.gateway.subscription(f"/PSM{number}/measured_js", JointState.TYPE)
        assert script.ros(f"/PSM{number}/measured_js", JOINTS) == [f"igtl NDARRAY/PSM{number}/measured_js v1 to 1"]
    assert script.ros("/ECM/measured_js", JOINTS) == []


# -- commands ---------------------------------------------------------------------------------------------------------

GOOD: dict[str, tuple[str, Body]] = {
    "servo_cp": ("TRANSFORM", matrix()),
    "move_cp": ("TRANSFORM", matrix()),
    "servo_jp": ("SENSOR", Sensor(np.array([0.1, -0.2, 0.13], ">f8"))),
    "move_jp": ("SENSOR", Sensor(np.array([0.5, -0.2, 0.13], ">f8"))),
    "servo_jr": ("SENSOR", Sensor(np.array([0.0, 0.001, 0.0], ">f8"))),
    "move_jr": ("SENSOR", Sensor(np.array([0.3, 0.0, 0.0], ">f8"))),
    "servo_cf": ("SENSOR", Sensor(np.array([1.0, 0, 0, 0, 0.1, 0], ">f8"))),
    "state_command": ("STRING", Text(b"enable")),
    "hold": ("STRING", Text(b"")),
    "free": ("STRING", Text(b"")),
}


@table("row", COMMANDS, ids=lambda row: row.name)
def test_a_command_reaches_the_robot_only_if_it_is_allowed(row: crtk.CrtkName) -> None:
    igtl_type, content = GOOD[row.name]
    device = f"PSM1/{row.name}"
    for config, allowed in ((Config(profile="crtk"), False), (Config(profile="crtk", allow_in=(device,)), True)):
        script = Script(config)
        script.up(1)
        measured(script)
        lines = script.igtl(Message(igtl_type, device, content, ns_to_ticks(script.now_ns)))
        if not allowed:
            assert lines == ["note command_not_allowed"]
            row_of = script.gateway.ledger.to_dict()["igtl_in"][f"{igtl_type}/{device}"]
            assert row_of["dropped"] == {"command_not_allowed": 1}
            assert not script.gateway.subscription(f"/{device}", row.ros_type), "nor from ROS to peers"
        else:
            assert lines == [f"ros /{device}"]
            assert row.ros_type in {entry.type for entry in script.last}
            assert script.ros(f"/{device}", MESSAGES[row.ros_type]) == [], "a device goes in one direction"
    assert set(GOOD) == {row.name for row in COMMANDS}


def test_a_command_of_ros_goes_to_peers_only_if_it_is_allowed_out() -> None:
    script = Script(Config(profile="crtk", allow_out=("PSM1/servo_cp",)))
    script.up(1)
    assert script.ros("/PSM1/servo_cp", MESSAGES[PoseStamped.TYPE]) == ["igtl TRANSFORM/PSM1/servo_cp v1 to 1"]
    assert script.ros("/PSM2/servo_cp", MESSAGES[PoseStamped.TYPE]) == []


NAN, INF = math.nan, math.inf
TURNED = (*POSE[:3], *(math.sin(0.9) * np.array([0.6, 0.8, 0.0])), math.cos(0.9))
R = matrix().wire_matrix
BOX = (-0.2, -0.2, 0.0, 0.2, 0.2, 0.2)


def changed(**at: float) -> Transform:
    numbers = list(R)
    for index, value in at.items():
        numbers[int(index[1:])] = value
    return Transform(tuple(numbers))


def shifted(x: float, y: float = POSE[1], z: float = POSE[2]) -> Transform:
    return Transform((*R[:9], x, y, z))


def joint_array(value: float) -> NdArray:
    return NdArray(11, (6, 2), np.full(12, value, ">f8").view(np.uint8).data)


def joints(*values: float) -> Sensor:
    return Sensor(np.array(values, ">f8"))


LIMITS: dict[str, Any] = {"joint_min": (-1.0, -1.0, 0.0), "joint_max": (1.0, 1.0, 0.2)}
#: name of the command, type, content, age in ms (None: no stamp), limits, code of the refusal
BAD: tuple[tuple[str, str, Body, float | None, dict[str, Any], str], ...] = (
    ("servo_cp", "TRANSFORM", matrix(), 501.5, {}, "command_old"),
    ("servo_cp", "TRANSFORM", matrix(), 60_000, {}, "command_old"),
    ("move_cp", "TRANSFORM", matrix(), 20, {"max_age_s": 0.01}, "command_old"),
    ("state_command", "STRING", Text(b"enable"), 900, {}, "command_old"),
    ("servo_cp", "TRANSFORM", matrix(), -700, {}, "command_early"),
    ("servo_cp", "TRANSFORM", matrix(), None, {}, "command_unstamped"),
    ("servo_cp", "TRANSFORM", changed(_9=NAN), 0, {}, "command_not_finite"),
    ("servo_cp", "TRANSFORM", changed(_0=NAN), 0, {}, "command_not_finite"),
    ("move_cp", "TRANSFORM", changed(_11=INF), 0, {}, "command_not_finite"),
    ("servo_cp", "TRANSFORM", changed(_0=-INF), 0, {}, "command_not_finite"),
    ("servo_cp", "TRANSFORM", Transform((2.0, 0, 0, 0, 2, 0, 0, 0, 2, *POSE[:3])), 0, {}, "command_not_rigid"),
    ("servo_cp", "TRANSFORM", Transform((0.0,) * 9 + POSE[:3]), 0, {}, "command_not_rigid"),
    ("move_cp", "TRANSFORM", Transform((1.0, 0, 0, 0, 1, 0, 0, 0, -1, *POSE[:3])), 0, {}, "command_not_rigid"),
    ("servo_cp", "TRANSFORM", Transform((1.0, 0.01, 0, 0, 1, 0, 0, 0, 1, *POSE[:3])), 0, {}, "command_not_rigid"),
    ("move_cp", "TRANSFORM", shifted(0.2001), 0, {"workspace": BOX}, "command_workspace"),
    ("move_cp", "TRANSFORM", shifted(100.0), 0, {"workspace": BOX}, "command_workspace"),
    ("move_cp", "TRANSFORM", shifted(0.1, z=0.3), 0, {"workspace": (0.1, 0.0, 0.1, 0.05)}, "command_workspace"),
    ("servo_cp", "TRANSFORM", shifted(POSE[0] + 0.03), 0, {}, "command_speed"),
    ("servo_cp", "TRANSFORM", shifted(POSE[0] * 1000), 0, {}, "command_speed"),
    ("servo_cp", "TRANSFORM", shifted(POSE[0] + 0.003), 0, {"max_speed": 0.01}, "command_speed"),
    ("servo_cp", "TRANSFORM", matrix(TURNED), 0, {}, "command_speed"),
    ("servo_cp", "SENSOR", joints(0, 0, 0), 0, {}, "command_type"),
    ("servo_cp", "POSITION", Position(POSE[:3], (0.0, 0.0, 0.0, 1.0)), 0, {}, "command_type"),
    ("servo_jp", "TRANSFORM", matrix(), 0, {}, "command_type"),
    ("servo_jp", "SENSOR", joints(0.1, -0.2), 0, {}, "command_joint_count"),
    ("servo_jp", "SENSOR", joints(), 0, {}, "command_joint_count"),
    ("move_jp", "SENSOR", joints(0.1, -0.2, 0.1, 0.0), 0, {}, "command_joint_count"),
    ("move_jp", "SENSOR", joints(0.1, -0.2, 0.21), 0, LIMITS, "command_joint_range"),
    ("move_jp", "SENSOR", joints(-1.5, -0.2, 0.1), 0, LIMITS, "command_joint_range"),
    ("move_jr", "SENSOR", joints(0.0, -0.9, 0.0), 0, LIMITS, "command_joint_range"),
    ("move_jp", "SENSOR", joints(0.1, NAN, 0.1), 0, LIMITS, "command_not_finite"),
    ("servo_jp", "SENSOR", joints(0.3, -0.2, 0.13), 0, {}, "command_joint_speed"),
    ("servo_jr", "SENSOR", joints(0.0, 0.0, 0.5), 0, {}, "command_joint_speed"),
    ("servo_jp", "SENSOR", joints(0.1, -0.2, 0.14), 0, {"joint_speed": (1.0, 1.0, 0.05)}, "command_joint_speed"),
    ("servo_cf", "SENSOR", joints(4.0, 4.0, 0, 0, 0, 0), 0, {}, "command_force"),
    ("servo_cf", "SENSOR", joints(0, 0, 0, 0, 0, 0.6), 0, {}, "command_force"),
    ("servo_cf", "SENSOR", joints(0, 0, 0), 0, {}, "command_joint_count"),
    ("state_command", "STRING", Text(b"explode"), 0, {}, "command_word"),
    ("state_command", "STRING", Text(b""), 0, {}, "command_word"),
)


@table(("name", "igtl_type", "content", "age_ms", "limits", "code"), BAD)
def test_a_bad_command_is_refused_with_its_reason_and_nothing_is_published(
    name: str, igtl_type: str, content: Body, age_ms: float | None, limits: dict[str, Any], code: str
) -> None:
    script = arm(**limits)
    measured(script)
    ticks = 0 if age_ms is None else ns_to_ticks(script.now_ns - round(age_ms * NS_PER_MS))
    assert script.igtl(Message(igtl_type, f"PSM1/{name}", content, ticks)) == [f"note {code}"]
    (note,) = [entry for entry in script.last if entry.kind is Kind.NOTE]
    text = Note.unpack(note.data()).text
    assert text.startswith(f"PSM1/{name}: ") and "found" in text and "expected" in text, text
    assert {entry.channel for entry in script.last if entry.kind is Kind.ROS_OUT} <= {LINKS_TOPIC}
    good_type, good = GOOD[name]
    assert script.igtl(Message(good_type, f"PSM1/{name}", good, ns_to_ticks(script.now_ns)))[-1] == f"ros /PSM1/{name}"


def test_every_code_has_a_bad_case() -> None:
    elsewhere = {"command_not_allowed", "command_backwards", "command_frame", "command_unknown_state"}
    elsewhere |= {"command_behind", "command_unheard", "command_newcomer", "command_late", "command_failed"}
    assert {code for *_, code in BAD} | elsewhere == set(REFUSED_COMMANDS)


def test_commands_out_of_order_twice_or_in_another_frame_are_refused() -> None:
    script = arm()
    measured(script)
    now_ns = script.now_ns
    at = [ns_to_ticks(now_ns + step * NS_PER_MS) for step in range(5)]
    assert script.igtl(Message("TRANSFORM", "PSM1/servo_cp", matrix(), at[2]))[-1] == "ros /PSM1/servo_cp"
    assert script.igtl(Message("TRANSFORM", "PSM1/servo_cp", matrix(), at[2])) == ["note command_backwards"]
    assert script.igtl(Message("TRANSFORM", "PSM1/servo_cp", matrix(), at[1]), link=2) == ["note command_backwards"]
    assert script.igtl(Message("TRANSFORM", "PSM1/servo_cp", matrix(), at[3])) == ["ros /PSM1/servo_cp"]
    assert PoseStamped.unpack(script.published("/PSM1/servo_cp")).header.frame_id == "ECM", "that of measured_cp"
    # a gateway writes frames into the metadata of header version 2
    other = Script(Config(profile="crtk", allow_out=("**",)))
    other.up(1)
    other.igtl(Message("STRING", "hello", Text(b"hi"), header_version=2))
    for frame, line in (("ECM", "ros /PSM1/servo_cp"), ("camera", "note command_frame")):
        other.ros("/PSM1/servo_cp", PoseStamped(Header(script.now_ns + 5 * NS_PER_MS, frame), POSE))
        (sent,) = other.sent()
        assert script.igtl(sent)[-1] == line, frame
    script.now_ns += 2 * NS_PER_S  # measured_cp is too old to show the right frame
    for name in ("servo_cp", "move_cp"):
        other.ros(f"/PSM1/{name}", PoseStamped(Header(script.now_ns, "camera"), POSE))
        (sent,) = other.sent()
        assert script.igtl(sent)[-1] == "note command_unknown_state", name


def test_without_a_recent_state_a_speed_limit_refuses_and_without_limits_it_passes() -> None:
    script = arm()
    for name in ("servo_cp", "servo_jp", "servo_jr", "move_jp"):
        igtl_type, content = GOOD[name]
        assert send(script, name, content, igtl_type) == ["note command_unknown_state"], name
    measured(script)
    script.now_ns += 2 * NS_PER_S
    assert send(script, "servo_cp", matrix(), "TRANSFORM") == ["note command_unknown_state"]
    free = arm(max_speed=0.0, max_turn_speed=0.0)
    assert send(free, "servo_cp", matrix(), "TRANSFORM")[-1] == "ros /PSM1/servo_cp"


def test_a_moving_tool_passes_at_its_speed_and_a_pause_allows_no_jump() -> None:
    script = arm(max_speed=0.1)
    measured(script)
    for step in range(1, 40):  # 0.09 m/s at 1 kHz
        lines = send(script, "servo_cp", shifted(POSE[0] + step * 0.00009), "TRANSFORM")
        assert lines[-1] == "ros /PSM1/servo_cp", (step, lines)
    script.now_ns += 400 * NS_PER_MS
    assert send(script, "servo_cp", shifted(POSE[0] + 0.02), "TRANSFORM") == ["note command_speed"]
    script.now_ns += 400 * NS_PER_MS
    measured(script)
    assert send(script, "servo_cp", shifted(POSE[0] + 0.02), "TRANSFORM") == ["note command_speed"]
    assert send(script, "servo_cp", matrix(), "TRANSFORM") == ["ros /PSM1/servo_cp"]


def test_a_command_inside_a_bind_meets_the_same_guard() -> None:
    script = Script(Config(profile="crtk"))
    script.up(1)
    child = BindChild("TRANSFORM", "PSM1/servo_cp", join(matrix().pack()))
    lines = script.igtl(Message("BIND", "all", Bind((child,)), ns_to_ticks(script.now_ns)))
    assert "note command_not_allowed" in lines
    assert not [line for line in lines if "/PSM1/servo_cp" in line]


ODD = (
    "PSM1/servo_cp/",
    "/PSM1/servo_cp",
    "PSM1//servo_cp",
    "PSM1/ servo_cp",
    "PSM 1/servo_cp",
    "../servo_cp",
    "servo_cp",
)


@table("device", [*ODD, "igtl/servo_cp", "1/servo_cp", "PSM1/servo_cp\n"])
def test_an_odd_name_is_no_device_of_a_robot(device: str) -> None:
    script = Script(Config(profile="crtk", allow_in=("**",)))
    script.up(1)
    script.igtl(Message("TRANSFORM", device, matrix(), ns_to_ticks(script.now_ns)))
    topics = {entry.channel for entry in script.last if entry.kind is Kind.ROS_OUT}
    assert all(topic.startswith(("/igtl/in/", "/tf")) or topic == "/igtl/links" for topic in topics), topics


def test_no_command_and_no_state_of_an_arm_is_compiled() -> None:
    """Neither the fast path nor the native passage, which copies what is compiled, passes them."""
    script = arm()
    for step in range(20):
        measured(script)
        send(script, "servo_cp", shifted(POSE[0] + step * 1e-5), "TRANSFORM")
        send(script, "state_command", Text(b"enable"), "STRING")
        send(script, "free_tool", matrix(), "TRANSFORM")  # not of CRTK
    fast = script.gateway.fast_path
    compiled = [bytes(name).rstrip(b"\0") for _, name in fast.to_ros]
    assert len(compiled) == 1 and b"PSM1/free_tool" in compiled[0]
    assert not fast.to_igtl


def test_the_document_has_each_name_and_each_code() -> None:
    page = (ROOT / "docs" / "how-to" / "crtk.md").read_text("utf-8")
    for row in crtk.NAMES:
        assert f"| `{row.name}` | {row.ros_type.replace('/msg/', '/')} | {row.igtl_type} |" in page
    for code, meaning in REFUSED_COMMANDS.items():
        assert f"| `{code}` | {meaning} |" in page


# -- the log ----------------------------------------------------------------------------------------------------------

_NUMBERS = st.floats(-0.3, 0.3)


@settings(max_examples=25, deadline=None)
@given(st.lists(st.tuples(st.integers(0, 7), st.integers(0, 60), st.tuples(_NUMBERS, _NUMBERS, _NUMBERS)), max_size=25))
def test_random_sessions_verify(steps: list[tuple[int, int, tuple[float, float, float]]]) -> None:
    config = Config(
        profile="crtk:/PSM*",
        crtk=(ArmsRow("/PSM1", workspace=BOX),),
        allow_in=("PSM1/servo_*", "PSM*/move_*"),
    )
    script = Script(config)
    script.up(1)
    for kind, wait_ms, (x, y, z) in steps:
        script.now_ns += wait_ms * NS_PER_MS
        stamp = ns_to_ticks(script.now_ns - 3 * NS_PER_MS)
        match kind:
            case 0:
                measured(script, (x, y, z, 0.0, 0.0, 0.0, 1.0))
            case 1:
                script.ros(
                    "/PSM2/measured_cp", PoseStamped(Header(0 if x > 0 else script.now_ns), (x, y, z, *POSE[3:]))
                )
            case 2 | 3:
                script.igtl(Message("TRANSFORM", "PSM1/servo_cp", shifted(x / 10, y / 10, z / 10), stamp))
            case 4:
                script.igtl(Message("SENSOR", "PSM1/servo_jp", joints(x, y, z), stamp))
            case 5:
                script.igtl(Message("TRANSFORM", f"PSM{1 + (x > 0)}/move_cp", shifted(x, y, z), stamp))
            case 6:
                script.igtl(Message("STRING", "PSM1/state_command", Text(b"home"), stamp))
            case _:
                script.igtl(Message("NDARRAY", "PSM2/measured_js", joint_array(x), stamp))
    report = verify(iter(script.log), Config.from_dict(config.to_dict()))
    assert report.good, report.differences[0]


@table("names", [JOINTS.name[:2], (*JOINTS.name, "roll")])
def test_a_state_whose_names_do_not_fit_its_joints_is_none(names: tuple[str, ...]) -> None:
    """Of sensor_msgs/JointState: all arrays have the same length.  It is not known which joints are shown."""
    script = arm()
    command = Sensor(np.zeros(len(JOINTS.position), ">f8"))
    script.ros("/PSM1/measured_js", JointState(Header(script.now_ns), names, JOINTS.position))
    assert send(script, "move_jp", command, "SENSOR") == ["note command_unknown_state"]
    script.ros("/PSM1/measured_js", JointState(Header(script.now_ns), (), JOINTS.position))
    assert send(script, "move_jp", command, "SENSOR") == ["ros /PSM1/move_jp"]


@pytest.mark.parametrize(
    ("config", "times"),
    [
        (Config(profile="crtk", allow_in=("*/servo_jp",)), 1),
        (Config(crtk=(ArmsRow("/PSM*"),), allow_in=("*/servo_jp",)), 1),
        (Config(profile="crtk"), 0),
        (Config(allow_in=("*/servo_jp",)), 0),
    ],
)
def test_states_are_read_for_the_names_of_joints_only_where_peers_may_command(
    config: Config, times: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At 1 kHz, reading each state of a robot that no peer may command is time for nothing."""
    read: list[str] = []
    found = joint_order.names_of_state

    def names_of_state(entry: Entry) -> tuple[str, ...]:
        read.append(entry.channel)
        return found(entry)

    monkeypatch.setattr(joint_order, "names_of_state", names_of_state)
    script = Script(config)
    for _ in range(3):
        script.ros("/PSM1/measured_js", JOINTS)
    assert read == ["/PSM1/measured_js"] * times, "the first that names them is enough"
