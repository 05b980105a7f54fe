"""The arm: where it can go, and how a toy is off."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from igtl_gateway.base.errors import ConfigError
from igtl_gateway_lab.simulate.lego_arm import JOINTS, PEN_M, Drives, angles_of, skeleton_of, tip_of

SHEET = st.tuples(st.floats(0.13, 0.30), st.floats(-0.10, 0.10), st.floats(-0.005, 0.06))


@given(tip=SHEET)
def test_every_place_of_the_sheet_is_reached(tip: tuple[float, float, float]) -> None:
    angles = angles_of(tip)
    assert tip_of(angles) == pytest.approx(tip, abs=1e-12)
    for joint, angle in zip(JOINTS, angles, strict=True):
        assert joint.low_deg <= math.degrees(angle) <= joint.high_deg


def test_the_skeleton_ends_at_the_tip_and_its_beams_keep_their_lengths() -> None:
    for tip in ((0.2, 0.05, 0.0), (0.29, -0.09, 0.03)):
        points = skeleton_of(angles_of(tip))
        assert points[-1] == pytest.approx(tip, abs=1e-12) and points[0] == pytest.approx((0, 0, 0))
        lengths = np.sqrt(np.sum(np.diff(points, axis=0) ** 2, 1))
        assert lengths == pytest.approx([0.112, 0.144, 0.160, 0.048, 0.096])
        assert points[-2] - points[-1] == pytest.approx((0, 0, PEN_M)), "the pen stays upright"


@pytest.mark.parametrize(
    ("tip", "told"),
    [
        ((0.5, 0.0, 0.0), r"pen to \(500.0, 0.0, 0.0\) mm: found 452.* mm from the shoulder to the wrist"),
        ((0.03, 0.22, 0.0), r"found turntable at 82.2°, expected -75° … 75°"),
        ((0.06, 0.0, 0.0), r"found .*upper_arm at 1\d\d|between the links"),
        ((0.20, 0.0, -0.2), r"found (upper_arm|forearm|\d+)"),
        ((0.35, 0.0, 0.02), r"between the links, expected 25° … 165°"),
    ],
)
def test_where_it_cannot_go_is_said(tip: tuple[float, float, float], told: str) -> None:
    with pytest.raises(ConfigError, match=told):
        angles_of(tip)


def test_encoders_count_whole_degrees_of_the_motors() -> None:
    drives = Drives(angles_of((0.2, 0.03, 0.01)))
    for joint, angle in zip(JOINTS, drives.encoders, strict=True):
        counts = math.degrees(angle) * joint.gear
        assert counts == pytest.approx(round(counts), abs=1e-9)


def test_gears_have_play_wherever_a_motor_turns_back() -> None:
    joint, start = JOINTS[0], (0.0, 1.0, -1.0)
    drives = Drives(start)
    play = math.radians(joint.play_deg)
    drives.go((play, 1.0, -1.0))
    behind = drives.encoders[0] - drives.joints[0]
    assert behind == pytest.approx(play / 2), "pushed from one side"
    stood = drives.joints[0]
    drives.go((play / 2, 1.0, -1.0))
    assert drives.joints[0] == stood, "within the play the joint stands"
    drives.go((-play, 1.0, -1.0))
    assert drives.joints[0] - drives.encoders[0] == pytest.approx(play / 2), "pushed from the other side"


def test_an_operator_gets_the_pen_itself_to_the_place() -> None:
    wanted = angles_of((0.25, -0.06, 0.0))
    drives = Drives(angles_of((0.25, 0.06, 0.02)))
    goal = np.array(tip_of(wanted))

    def off() -> tuple[float, float]:
        """How far the pen, and what the brick takes for it, are from the goal, mm."""
        real, told = np.array(tip_of(drives.joints)), np.array(tip_of(drives.encoders))
        return 1000 * float(np.linalg.norm(real - goal)), 1000 * float(np.linalg.norm(told - goal))

    drives.go(wanted)
    real, told = off()
    assert real > 0.8 and told < 0.4, "the brick thinks that it is there"
    for _ in range(5):
        drives.jog(wanted)
    real, told = off()
    assert real < 0.4 and told > 0.8, "now it is, and the brick does not know"
