"""The probe of the ultrasound sweep: where a hand holds it, and where the tracker sees it.

Frames as PLUS names them: ``Image`` (pixels), ``Probe`` and ``Reference`` (the sensors on the probe and on the
arm), ``Tracker``.  The phantom's own frame is that of the reference.  Millimetres; plain arithmetic only.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from igtl_gateway.convert.poses import rotation_matrix
from igtl_gateway_lab.simulate.registration import Rigid
from igtl_gateway_lab.simulate.star_numbers import Array, Noise, dot
from igtl_gateway_lab.simulate.ultrasound_phantom import LENGTH_MM, PIXEL_MM, WIDTH

#: A tracker sees a place this badly (mm, one axis, standard deviation).
TRACKING_MM = 0.05
_SEED = 2017


def compose_rigid(outer: Rigid, inner: Rigid) -> Rigid:
    """First ``inner``, then ``outer``."""
    rotation = np.stack([dot(outer.rotation[row], inner.rotation.T) for row in range(3)])
    return Rigid(rotation, outer.apply(inner.translation))


def turned(x: float, y: float, z: float, w: float, translation: Sequence[float]) -> Rigid:
    """Of a quaternion of any length."""
    length = math.sqrt(x * x + y * y + z * z + w * w)
    rotation = rotation_matrix((x / length, y / length, z / length, w / length))
    return Rigid(np.array(rotation), np.array(translation, float))


#: Where the picture's axes (mm, from its first pixel) are on the probe: what a calibration finds.
IMAGE_TO_PROBE = turned(0.004, -0.007, -0.70, 0.71, (12.74, 50.76, -0.5))
#: How the picture lies on the arm when the probe stands upright: rows across it (against u), columns into it.  So who
#: looks at the picture from its front sees the sweep go away from him, and what was swept before it.
_UPRIGHT = (0.0, 1.0, 1.0, 0.0)
#: How the arm lies: the tracker looks down on it, its z up, as viewers have it.
_ARM_TO_TRACKER = (0.96, 0.25, 0.05, 0.09, -208.6, -115.5, -992.7)


@dataclass(frozen=True, slots=True)
class SweepMoment:
    """A moment of the sweep.

    Attributes:
        image_to_reference: where the picture truly is, from millimetres in the picture.
        probe_to_tracker, reference_to_tracker: where the tracker sees both sensors.
    """

    image_to_reference: Rigid
    probe_to_tracker: Rigid
    reference_to_tracker: Rigid


class Hand:
    """A sweep of ``frames`` pictures from one end of the arm to the other."""

    def __init__(self, frames: int) -> None:
        self._frames = frames
        noise = Noise(_SEED, 42)
        self._shake = noise.normal(16, 6)  # a hand's wandering: three shifts, three turns
        self._breath = noise.normal(16, 6)
        self._seen = noise.normal(frames, 2, 3)

    def moment(self, frame: int) -> SweepMoment:
        """What there is to see at picture ``frame``."""
        part = frame / max(self._frames - 1, 1)
        dx, dy, dz, rx, ry, rz = _wander(self._shake, part)
        x, y, z, w = _product(_UPRIGHT, (0.03 * rx, 0.02 * ry, 0.02 * rz, 1.0))
        start = (WIDTH * PIXEL_MM / 2 + 0.6 * dx, LENGTH_MM * part + 0.4 * dy, 0.12 * dz)
        image = turned(x, y, z, w, start)
        dx, dy, dz, rx, ry, rz = _wander(self._breath, part)
        x, y, z, w, *place = _ARM_TO_TRACKER
        x, y, z, w = _product((x, y, z, w), (0.004 * rx, 0.004 * ry, 0.004 * rz, 1.0))
        reference = turned(x, y, z, w, (place[0] + dx, place[1] + 2 * dy, place[2] + dz))
        probe = compose_rigid(reference, compose_rigid(image, IMAGE_TO_PROBE.inverse()))
        seen = [
            Rigid(pose.rotation, pose.translation + TRACKING_MM * error)
            for pose, error in zip((probe, reference), self._seen[frame], strict=True)
        ]
        return SweepMoment(image, seen[0], seen[1])


def _wander(values: Array, part: float) -> list[float]:
    """A smooth path through the rows of ``values``, at 0 … 1 of its length."""
    at = part * (len(values) - 2)
    low = int(at)
    rest = at - low
    rest = rest * rest * (3 - 2 * rest)
    return [float(a * (1 - rest) + b * rest) for a, b in zip(values[low], values[low + 1], strict=True)]


def _product(a: Sequence[float], b: Sequence[float]) -> tuple[float, float, float, float]:
    """Of two quaternions x, y, z, w."""
    ax, ay, az, aw = a
    bx, by, bz, bw = b
    return (
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
        aw * bw - ax * bx - ay * by - az * bz,
    )
