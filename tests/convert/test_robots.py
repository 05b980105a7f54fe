"""States of robots as words, and what a game pad or a list of numbers becomes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from igtl_gateway.base.errors import ConversionError
from igtl_gateway.convert import robots
from igtl_gateway.convert.common_msgs import JointState, Joy, OperatingState
from igtl_gateway.convert.context import ToIgtlContext, ToRosContext
from igtl_gateway.convert.igtl_msgs import MetadataItem
from igtl_gateway.convert.rosmsg import Header
from igtl_gateway.wire.ndarray import NdArray
from igtl_gateway.wire.sensor import MAX_VALUES, Sensor
from igtl_gateway.wire.text import String
from tests.tables import table

TO = ToRosContext("arm", 5, "base", "tool")

#: Text → state, homed, busy.
STATES = {
    "ENABLED": ("ENABLED", False, False),
    "ENABLED homed": ("ENABLED", True, False),
    "ENABLED busy": ("ENABLED", False, True),
    "PAUSED homed busy": ("PAUSED", True, True),
    "homed": ("homed", False, False),
    "": ("", False, False),
}


@table("text", STATES)
def test_states_are_words(text: str) -> None:
    found = robots.string_to_state(String.of(text), TO)
    assert found == OperatingState(Header(5, "base"), *STATES[text])
    back = robots.state_to_string(found, ToIgtlContext())
    assert isinstance(back.content, String)
    assert (back.content.text, back.stamp_ns, back.frame_id) == (text, 5, "base")


def test_buttons_are_values_up_to_those_of_a_sensor() -> None:
    joy = Joy(Header(7, "pad"), np.zeros(0, np.float32), np.arange(MAX_VALUES, dtype=np.int32))
    found = robots.joy_to_sensor(joy, ToIgtlContext())
    assert isinstance(found.content, Sensor)
    assert (found.content.values.tolist(), found.stamp_ns) == (list(range(MAX_VALUES)), 7)
    more = Joy(Header(7, "pad"), np.zeros(0, np.float32), np.arange(MAX_VALUES + 1, dtype=np.int32))
    with pytest.raises(ConversionError, match=f"found {MAX_VALUES + 1} buttons, expected at most {MAX_VALUES}"):
        robots.joy_to_sensor(more, ToIgtlContext())


@table(("names", "values", "known"), [("a,b", [1.0, 2.0], True), ("", [1.0, 2.0], False), ("a,b", [1.0], False)])
def test_values_of_a_command_are_positions_of_joints(names: str, values: list[float], known: bool) -> None:
    """With the names of its metadata, if there are as many."""
    metadata = (MetadataItem(robots.JOINT_NAMES, 0, names),) if names else ()
    found = robots.sensor_to_joints(Sensor(np.array(values, ">f8")), replace(TO, metadata=metadata))
    assert (found.header, found.name) == (Header(5, "base"), tuple(names.split(",")) if known else ())
    assert found.position.tolist() == values and found.position.dtype == np.float64


@table(
    ("positions", "velocities", "efforts", "count"),
    [
        ([0.5], [], [], 1),
        ([0.5], [0.25], [1.0], 1),
        ([], [0.25], [], 1),
        ([0.5, 0.0], [], [1.0, 2.0], 2),
        ([0.0] * robots.MAX_JOINTS, [], [], robots.MAX_JOINTS),
        ([], [], [], 0),
        ([0.5], [0.25, 0.5], [], 0),
        ([0.5, 0.0], [0.25], [], 0),
        ([0.0] * (robots.MAX_JOINTS + 1), [], [], 0),
    ],
)
def test_joints_are_an_array_and_come_back(
    positions: list[float], velocities: list[float], efforts: list[float], count: int
) -> None:
    """One joint is the least; a value of a joint that is not known is marked so."""
    vectors = [np.array(each, np.float64) for each in (positions, velocities, efforts)]
    names = tuple(f"j{number}" for number in range(max(map(len, vectors))))
    message = JointState(Header(5, "base"), names, *vectors)
    if not count:
        with pytest.raises(ConversionError, match=f"expected one number of joints from 1 to {robots.MAX_JOINTS:,}"):
            robots.joints_to_array(message, ToIgtlContext())
        return
    found = robots.joints_to_array(message, ToIgtlContext())
    assert isinstance(found.content, NdArray) and robots.is_joint_state(found.content)
    assert found.content.size == (6, count)
    assert robots.joint_names(found.metadata) == names
    back = robots.array_to_joints(found.content, replace(TO, metadata=found.metadata))
    assert back.name == names
    for one, other in zip(vectors, (back.position, back.velocity, back.effort), strict=True):
        assert one.tolist() == other.tolist()
