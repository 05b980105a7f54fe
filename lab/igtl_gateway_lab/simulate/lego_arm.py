"""The arm of the LEGO scenario: three motors, two links that parallel rods keep apart, and a pen that stays upright.

As with the parallel-link arm of the paper, upper arm and forearm are driven from the base: their angles are those
against the table, and the pen holder keeps its direction.  With a = turntable, b = upper arm, c = forearm (radians,
b and c above the horizontal), metres:

    r = UPPER cos b + FORE cos c + HOLDER        x = r cos a,  y = r sin a
    z = SHOULDER + UPPER sin b + FORE sin c − PEN

What makes it a toy: the encoders of the motors count whole degrees, and the gears have play, so the pen lags behind
the motors wherever they turn back.  The sizes are those of beams with a pitch of 8 mm; the play is an assumption.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from igtl_gateway.base.errors import ConfigError
from igtl_gateway_lab.simulate.star_numbers import Array

SHOULDER_M = 0.112  #: height of the upper joint above the table
UPPER_M, FORE_M = 0.144, 0.160
HOLDER_M, PEN_M = 0.048, 0.096  #: from the wrist to the pen, and from there down to its tip

Angles = tuple[float, float, float]
Point = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Joint:
    """A motor and what it drives.

    Attributes:
        name: as in JointState.
        low_deg, high_deg: where the joint ends, degrees.
        gear: turns of the motor for one of the joint: its encoder counts degrees of the motor.
        play_deg: how far the joint can be moved while the motor stands.
    """

    name: str
    low_deg: float
    high_deg: float
    gear: int
    play_deg: float


#: The turntable by 8 : 56 teeth; the links by worm gears, whose play the weight of the arm takes up almost completely.
JOINTS = (
    Joint("turntable", -75.0, 75.0, 7, 0.5),
    Joint("upper_arm", 5.0, 110.0, 24, 0.1),
    Joint("forearm", -100.0, 15.0, 24, 0.1),
)
#: The links must keep this much of an angle between them: stretched or folded they would block.
_BETWEEN_DEG = (25.0, 165.0)


def tip_of(angles: Angles) -> Point:
    """Where the tip of the pen is in the frame of the base, metres."""
    a, b, c = angles
    reach = UPPER_M * math.cos(b) + FORE_M * math.cos(c) + HOLDER_M
    height = SHOULDER_M + UPPER_M * math.sin(b) + FORE_M * math.sin(c) - PEN_M
    return reach * math.cos(a), reach * math.sin(a), height


def skeleton_of(angles: Angles) -> Array:
    """(6, 3) table, shoulder, elbow, wrist, pen holder, tip: the arm as a line."""
    a, b, c = angles
    elbow = UPPER_M * math.cos(b), SHOULDER_M + UPPER_M * math.sin(b)
    wrist = elbow[0] + FORE_M * math.cos(c), elbow[1] + FORE_M * math.sin(c)
    holder = wrist[0] + HOLDER_M, wrist[1]
    side = ((0.0, 0.0), (0.0, SHOULDER_M), elbow, wrist, holder, (holder[0], holder[1] - PEN_M))
    return np.array([(reach * math.cos(a), reach * math.sin(a), height) for reach, height in side])


def angles_of(tip: Point) -> Angles:
    """The angles that bring the tip of the pen to a point: elbow up.  Raises ConfigError where there are none."""
    x, y, z = tip
    # the triangle of shoulder, elbow and wrist
    reach, height = math.sqrt(x * x + y * y) - HOLDER_M, z + PEN_M - SHOULDER_M
    far = math.sqrt(reach * reach + height * height)
    if not abs(UPPER_M - FORE_M) < far < UPPER_M + FORE_M:
        raise _unreachable(tip, f"{far * 1000:.1f} mm from the shoulder to the wrist, expected less than 304 mm")
    upward = math.atan2(height, reach)
    at_shoulder = math.acos((UPPER_M**2 + far**2 - FORE_M**2) / (2 * UPPER_M * far))
    upper = upward + at_shoulder
    fore = math.atan2(height - UPPER_M * math.sin(upper), reach - UPPER_M * math.cos(upper))
    angles = (math.atan2(y, x), upper, fore)
    check_reach(angles, tip)
    return angles


def check_reach(angles: Angles, tip: Point) -> None:
    """Raises ConfigError where a joint would have to go beyond its end, or the links would block."""
    for joint, angle in zip(JOINTS, angles, strict=True):
        degrees = math.degrees(angle)
        if not joint.low_deg <= degrees <= joint.high_deg:
            ends = f"{joint.low_deg:g}° … {joint.high_deg:g}°"
            raise _unreachable(tip, f"{joint.name} at {degrees:.1f}°, expected {ends}")
    low, high = _BETWEEN_DEG
    between = 180.0 - math.degrees(angles[1] - angles[2])
    if not low <= between <= high:
        raise _unreachable(tip, f"{between:.1f}° between the links, expected {low:g}° … {high:g}°")


def _unreachable(tip: Point, found: str) -> ConfigError:
    x, y, z = (1000 * value for value in tip)
    return ConfigError(f"pen to ({x:.1f}, {y:.1f}, {z:.1f}) mm: found {found}")


class Drives:
    """Three motors with their gears: the readings of the encoders, and the true positions of the joints.

    The motors follow without error to the nearest count of their encoders.  A joint stays where it is until the
    gears have taken up their play.
    """

    def __init__(self, angles: Angles) -> None:
        self._counts = _counts(angles)
        self._joints = self.encoders

    @property
    def encoders(self) -> Angles:
        """What the brick knows, radians."""
        a, b, c = (math.radians(count / joint.gear) for count, joint in zip(self._counts, JOINTS, strict=True))
        return a, b, c

    @property
    def joints(self) -> Angles:
        """True positions of the joints, radians; unknown to the robot."""
        return self._joints

    def go(self, angles: Angles) -> None:
        """Turn the motors to where the joints would be at ``angles``, were there no play."""
        self._counts = _counts(angles)
        a, b, c = (
            min(max(now, motor - math.radians(joint.play_deg / 2)), motor + math.radians(joint.play_deg / 2))
            for now, motor, joint in zip(self._joints, self.encoders, JOINTS, strict=True)
        )
        self._joints = a, b, c

    def jog(self, angles: Angles) -> None:
        """One look of an operator: turn the motors by as much as the joints are off; the play may swallow it."""
        a, b, c = (motor + wanted - now for motor, wanted, now in zip(self.encoders, angles, self._joints, strict=True))
        self.go((a, b, c))


def _counts(angles: Angles) -> tuple[int, int, int]:
    a, b, c = (round(math.degrees(angle) * joint.gear) for angle, joint in zip(angles, JOINTS, strict=True))
    return a, b, c
