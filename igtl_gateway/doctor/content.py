"""Measurements of a message's content for the rules: lengths, rotations, names."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from igtl_gateway.convert.units import ieee_754
from igtl_gateway.wire.body import Body
from igtl_gateway.wire.elements import Elements
from igtl_gateway.wire.image import Image
from igtl_gateway.wire.point import Points
from igtl_gateway.wire.polydata import PolyData
from igtl_gateway.wire.tracking import QuaternionTrackingData, TrackingData
from igtl_gateway.wire.transform import Position, Transform

#: Maximum number of positions of a message that are measured: enough to distinguish metres and millimetres.
MAX_POSITIONS = 10_000
Floats = npt.NDArray[np.float64]
_NO_FLOATS: Floats = np.empty((0, 3))


def _none() -> Floats:
    return _NO_FLOATS


@dataclass(frozen=True, slots=True)
class ContentMeasures:
    """The measurements of one message.

    Attributes:
        positions: (n, 3), in the unit of the message.
        pose: whether the positions are those of poses, not of a shape.
        rotations: (n, 3, 3) matrices; their columns are directions.
        quaternions: (n, 4) x, y, z, w.
        spacing: of an image: three distances between pixels, in the unit of the message.
        full_names: names of elements that fill their field.
    """

    positions: Floats = field(default_factory=_none)
    pose: bool = True
    rotations: Floats = field(default_factory=_none)
    quaternions: Floats = field(default_factory=_none)
    spacing: tuple[float, ...] = ()
    full_names: tuple[str, ...] = ()

    @property
    def has_rotations_by_rows(self) -> bool:
        """Whether the twelve numbers of each matrix are rotations if they are read row by row."""
        columns = np.concatenate([self.rotations.transpose(0, 2, 1), self.positions[:, None]], axis=1)
        rows = columns.reshape(-1, 3, 4)[:, :, :3]
        off = np.abs(rows @ rows.transpose(0, 2, 1) - np.eye(3)).max()
        return bool(off < _BY_ROWS)

    @property
    @ieee_754
    def is_finite(self) -> bool:
        """Whether there is no NaN or infinity."""
        # numbers are float32 on the wire, so a sum of finite ones is finite
        return math.isfinite(self.positions.sum() + self.rotations.sum() + self.quaternions.sum())


NOTHING = ContentMeasures()
#: Tolerance for rotations that are read row by row: float32 and the noise of a tracker.
_BY_ROWS = 0.02


@ieee_754
def measure_content(content: Body) -> ContentMeasures:
    """Return the lengths, rotations and names of a content; ``NOTHING`` if its type has none."""
    match content:
        case Transform():
            return _matrices(_floats(content.wire_matrix).reshape(1, 12))
        case Position():
            return ContentMeasures(
                _floats(content.position).reshape(1, 3), True, quaternions=_floats([content.quaternion])
            )
        case TrackingData():
            return _matrices(_floats(content.elements["matrix"]), _full_names(content))
        case QuaternionTrackingData():
            elements = content.elements
            return ContentMeasures(
                _floats(elements["position"]),
                quaternions=_floats(elements["quaternion"]),
                full_names=_full_names(content),
            )
        case Points():
            return ContentMeasures(_floats(content.elements["position"]), False, full_names=_full_names(content))
        case PolyData():
            return ContentMeasures(_floats(content.points[:MAX_POSITIONS]), False)
        case Image():
            matrix = _floats(content.wire_matrix).reshape(4, 3)
            return ContentMeasures(spacing=tuple(np.linalg.norm(matrix[:3], axis=1).tolist()))
        case _:
            return NOTHING


def _floats(values: Any) -> Floats:
    return np.asarray(values, np.float64)


def _matrices(matrices: Floats, full_names: tuple[str, ...] = ()) -> ContentMeasures:
    parts = matrices.reshape(-1, 4, 3)
    # the matrix is column by column on the wire
    return ContentMeasures(parts[:, 3], True, parts[:, :3].transpose(0, 2, 1), full_names=full_names)


def _full_names(content: Elements) -> tuple[str, ...]:
    """Return the names without a final zero: NumPy removes zeros at the end, so these are as long as their field."""
    names = content.elements["name"][:MAX_POSITIONS]
    return tuple(name.decode("utf-8", "replace") for name in names.tolist() if len(name) == names.dtype.itemsize)
