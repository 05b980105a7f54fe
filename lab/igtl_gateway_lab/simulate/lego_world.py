"""What is really there in the LEGO scenario, and no program knows: where the sheet lies, what the pen draws on it.

Two get to see something of it: the operator, who brings the pen to a cross by eye, and the camera above, which sees the
ink on the printed sheet and so in coordinates of the image.  Millimetres; the base is the robot's.
"""

from __future__ import annotations

import math

import numpy as np

from igtl_gateway.convert.poses import rotation_matrix, unit_quaternion
from igtl_gateway_lab.simulate.lego_sheet import CHECKS, HEIGHT_MM, LANDMARKS, on_sheet
from igtl_gateway_lab.simulate.registration import Rigid, distances, rms
from igtl_gateway_lab.simulate.star_numbers import Array, Noise, rounded

_EYE_MM = 0.3  #: how well an operator sees whether the pen is on a cross, each way
_CAMERA_MM = 0.1
_TURN = math.radians(8)  #: of the sheet on the table
_TILT = (0.0044, -0.0035)  #: half of that of the table, radians
_MIDDLE, _MIDDLE_IN_BASE = np.array([0.0, -18.0, HEIGHT_MM]), np.array([215.0, 0.0, 0.0])


class World:
    """The sheet and the ink on it.

    Attributes:
        ink: segments that the pen has drawn, as the camera sees them: pairs of points, image.
        skipped: how often the pen should have drawn and did not touch the paper.
    """

    def __init__(self, seed: int) -> None:
        half = _TURN / 2
        rotation: Array = np.array(rotation_matrix(unit_quaternion((*_TILT, math.sin(half), math.cos(half)))))
        self._sheet = Rigid(rotation, _MIDDLE_IN_BASE - Rigid(rotation, np.zeros(3)).apply(_MIDDLE))
        self._eye = Noise(seed, 41).normal(len(LANDMARKS) + len(CHECKS), 2) * _EYE_MM
        self._pen: Array | None = None  # where it has just drawn
        self.ink: list[tuple[Array, Array]] = []
        self.skipped = 0

    @property
    def drawing(self) -> bool:
        """Whether the pen is on the paper."""
        return self._pen is not None

    def crosses(self, names: list[str]) -> Array:
        """Where the operator takes these crosses to be (base).  Raises KeyError for one that is not on the sheet."""
        places = dict(zip((*LANDMARKS, *CHECKS), on_sheet(LANDMARKS | CHECKS), strict=True))
        seen = np.array([places[name] for name in names])
        seen[:, :2] += np.resize(self._eye, (len(names), 2))
        return self._sheet.apply(seen)

    def draw(self, tip: Array) -> None:
        """The pen is pressed down with its tip at (base) ``tip``: it leaves a line if it reaches the paper."""
        before, self._pen = self._pen, None
        x, y, height = self._sheet.inverse().apply(tip).tolist()
        if height > HEIGHT_MM:
            self.skipped += 1
            return
        self._pen = rounded(np.array([x, y, HEIGHT_MM]), _CAMERA_MM)
        if before is not None:
            self.ink.append((before, self._pen))

    def lift(self) -> None:
        """The pen is up."""
        self._pen = None

    def error_of(self, registration: Rigid) -> float:
        """How far a registration (image → base) puts the crosses from where they are (rms)."""
        crosses = on_sheet(LANDMARKS | CHECKS)
        return rms(distances(registration.apply(crosses), self._sheet.apply(crosses)))
