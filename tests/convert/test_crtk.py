"""Names of CRTK: which paths are devices of an arm, and in which namespaces they lie."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from igtl_gateway.convert.common_msgs import OperatingState
from igtl_gateway.convert.crtk import BY_NAME, NAMES, STATE_COMMANDS, Motion, namespaces, row_of
from igtl_gateway.convert.table import TO_ROS
from tests.tables import table

_LEVEL = st.from_regex(r"[A-Za-z_][A-Za-z0-9_]{0,5}", fullmatch=True)


@given(st.lists(_LEVEL.filter(lambda level: level != "igtl"), min_size=1, max_size=4), st.sampled_from(sorted(BY_NAME)))
def test_a_device_below_any_namespace_has_the_row_of_its_last_level(levels: list[str], name: str) -> None:
    path = "/".join([*levels, name])
    found = row_of(path)
    assert found is not None and found.name == name
    assert row_of(f"igtl/{path}") is None, "a device of the gateway itself"
    assert row_of(f"/{path}") is None, "a topic"
    assert [each.lstrip("/").split("/") for each in namespaces(path)] == [
        levels[:count] for count in range(len(levels), 0, -1)
    ]


@table(
    "path",
    [
        "", "measured_cp", "PSM1", "PSM1/", "PSM1/measured", "PSM1/measured_cp/", "PSM1//measured_cp",
        "1PSM/measured_cp", "PSM 1/measured_cp", "PSM1/measured_cp\n", "PSMä/measured_cp", "PSM-1/measured_cp",
        "igtl/measured_cp", "igtl/PSM1/measured_cp", "PSM1/MEASURED_CP",
    ],
)  # fmt: skip
def test_other_paths_are_no_devices_of_an_arm(path: str) -> None:
    assert row_of(path) is None


def test_an_arm_whose_name_begins_as_our_own_is_one() -> None:
    assert row_of("igtl_arm/measured_cp") is BY_NAME["measured_cp"]


def test_namespaces_are_those_of_ros_the_innermost_first() -> None:
    assert namespaces("PSM1/jaw/measured_js") == ["/PSM1/jaw", "/PSM1"]
    assert namespaces("measured_js") == []


def test_names_are_unique_and_their_rows_exist() -> None:
    assert len(BY_NAME) == len(NAMES)
    kinds = {row.kind for row in TO_ROS}
    assert {row.kind for row in NAMES} <= kinds


@table(
    ("name", "ros_type", "igtl_type", "motion", "streamed"),
    [
        # servo_: the robot follows at once; move_: it plans its own motion
        ("servo_cp", "geometry_msgs/msg/PoseStamped", "TRANSFORM", Motion.POSE, True),
        ("move_cp", "geometry_msgs/msg/PoseStamped", "TRANSFORM", Motion.POSE, False),
        ("servo_jp", "sensor_msgs/msg/JointState", "SENSOR", Motion.JOINTS, True),
        ("move_jp", "sensor_msgs/msg/JointState", "SENSOR", Motion.JOINTS, False),
        ("servo_jr", "sensor_msgs/msg/JointState", "SENSOR", Motion.JOINT_STEPS, True),
        ("move_jr", "sensor_msgs/msg/JointState", "SENSOR", Motion.JOINT_STEPS, False),
        ("servo_cf", "geometry_msgs/msg/WrenchStamped", "SENSOR", Motion.WRENCH, True),
        ("state_command", "crtk_msgs/msg/StringStamped", "STRING", Motion.STATE, False),
        ("hold", "std_msgs/msg/Empty", "STRING", Motion.STOP, False),
        ("free", "std_msgs/msg/Empty", "STRING", Motion.STOP, False),
    ],
)
def test_commands_are_these(name: str, ros_type: str, igtl_type: str, motion: Motion, streamed: bool) -> None:
    row = BY_NAME[name]
    assert (row.ros_type, row.igtl_type, row.motion, row.streamed) == (ros_type, igtl_type, motion, streamed)


def test_everything_else_is_a_state_of_the_robot() -> None:
    states = [row for row in NAMES if row.motion is None]
    assert len(states) == len(NAMES) - 10
    assert not any(row.streamed for row in states)
    assert {row.ros_type for row in states if row.name == "operating_state"} == {f"{OperatingState.TYPE}"}


@pytest.mark.parametrize("word", ["enable", "disable", "pause", "resume", "home", "unhome"])
def test_words_of_state_commands(word: str) -> None:
    assert word in STATE_COMMANDS
