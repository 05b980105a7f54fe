"""The movement of hostile streams: sizes that change, values that are not finite or too large, too many streams."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

import igtl_gateway
from igtl_gateway.addons.sync.lag import measure_lag
from igtl_gateway.addons.sync.lags import movement, movements, picture_components
from igtl_gateway.addons.sync.signal import Signal, moves
from igtl_gateway.base.errors import GatewayError
from igtl_gateway.convert.common_msgs import JointState
from igtl_gateway.convert.rosmsg import Header
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.record.sessionfile.writer import SessionWriter


@pytest.mark.filterwarnings("error")
def test_pictures_that_cannot_be_compared_are_left_out() -> None:
    """Of another size, with NaN in big-endian floats, or with values whose squares are not finite."""
    ramp = np.arange(20) * np.ones((20, 1))
    pictures = [ramp * number for number in range(40)]
    hostile = [np.ones((10, 20)), np.full((20, 20), np.nan, ">f4"), np.full((20, 20), 1e299), np.ones((1, 1))]
    found = picture_components([*pictures, *hostile])
    assert np.isfinite(found[:40]).all()
    assert np.isnan(found[40:]).all()
    assert np.allclose(np.abs(found[:40, 0]), np.abs(picture_components(pictures)[:, 0]))
    assert np.isnan(picture_components(hostile[1:2])).all()
    assert picture_components([]).shape == (0, 1)


STEP_NS = 50_000_000
HOSTILE: dict[str, tuple[npt.NDArray[Any], npt.NDArray[Any]]] = {
    "1e308": (np.arange(400) * STEP_NS, np.where(np.arange(400) % 9, np.sin(np.arange(400) / 7), 1e308)),
    "1e59": (np.arange(400) * STEP_NS, 1e59 * np.sin(np.arange(400) ** 1.5 / 50)),
    "1e-300": (np.arange(400) * STEP_NS, 1e-300 * np.sin(np.arange(400) / 7)),
    "one stamp": (np.zeros(400, np.int64), np.sin(np.arange(400) / 7)),
    "centuries": (np.append(np.arange(399) * 1_000, 8 * 10**18), np.sin(np.arange(400) / 7)),
    "before 1970": (np.append(-8 * 10**18, np.arange(399) * STEP_NS), np.sin(np.arange(400) / 7)),
}


@pytest.mark.slow
@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_values_and_stamps_are_refused(name: str) -> None:
    times, values = HOSTILE[name]
    hostile = Signal.of(times, values)
    honest = Signal.of(np.arange(400) * STEP_NS, np.sin(np.arange(400) ** 1.5 / 40))
    assert not measure_lag(hostile, honest).verdict.has_lag
    assert not measure_lag(honest, hostile).verdict.has_lag
    moves(hostile)


def test_more_streams_than_can_be_measured(tmp_path: Path) -> None:
    """Devices with a message each are left out; too many with movement need names."""
    for name, messages, text in (("short", 1, ""), ("long", 30, "found 101 input streams, expected up to 100")):
        path = tmp_path / f"{name}.mcap"
        writer = SessionWriter(path, {"imported_format": "a test"})
        seq = 0
        for number in range(101):
            for _ in range(messages):
                seq += 1
                joints = JointState(Header(0, ""), ("a",), np.array([1.0]), np.array([]), np.array([])).pack()
                writer.write(Entry(seq, 10**9 + seq, Kind.ROS_IN, f"/joints{number}", JointState.TYPE, (joints,)))
        writer.close({})
        with igtl_gateway.open(path) as recording:
            if text:
                with pytest.raises(GatewayError, match=text):
                    movements([recording])
            else:
                assert movements([recording]) == ([], {})


def test_joints_of_two_arms_in_turn_and_in_any_order_are_one_movement(tmp_path: Path) -> None:
    random = np.random.default_rng(1)
    paths = []
    for name, in_turn in (("whole", False), ("turn", True)):
        path = tmp_path / f"{name}.mcap"
        writer = SessionWriter(path, {"imported_format": "a test"})
        for number in range(400):
            at = number * 0.01
            values = {f"{side}_{n}": float(np.sin(n * at + ord(side))) for side in "lr" for n in (1, 2, 3)}
            own = [each for each in values if not in_turn or each[0] == "lr"[number % 2]]
            names = [own[place] for place in random.permutation(len(own))] if in_turn else own
            joints = JointState(Header(0, ""), tuple(names), np.array([values[each] for each in names])).pack()
            at_ns = 10**9 + int(at * 1e9)
            writer.write(Entry(number + 1, at_ns, Kind.ROS_IN, "/joint_states", JointState.TYPE, (joints,), (), at_ns))
        writer.close({})
        paths.append(path)
    with igtl_gateway.open(paths[0]) as whole, igtl_gateway.open(paths[1]) as turn:
        one, other = movement(whole["/joint_states"]), movement(turn["/joint_states"])
    assert len(other.times_ns) > 390
    shared = np.isin(one.times_ns, other.times_ns)
    best = [np.abs(one.values[shared] - column[:, None]).max(axis=0).min() for column in other.values.T]
    assert max(best) < 1e-3, "each column is one joint, between two of its values"
