"""What the rules want to know of a message's content: lengths, rotations, names."""

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

#: Positions looked at in one message: enough to tell metres from millimetres in a cloud of a million points.
MAX_POSITIONS = 10_000
Floats = npt.NDArray[np.float64]
_NO_FLOATS: Floats = np.empty((0, 3))


def _none() -> Floats:
    return _NO_FLOATS


@dataclass(frozen=True, slots=True)
class ContentMeasures:
    """Of one message.

    Attributes:
        positions: (n, 3), in the unit of the message.
        pose: they are those of poses, one message after the other, and not of a shape.
        rotations: (n, 3, 3); columns are directions.
        quaternions: (n, 4).
        spacing: of an image: its three distances between pixels.
        full_names: names of elements that fill their field.
    """

    positions: Floats = field(default_factory=_none)
    pose: bool = True
    rotations: Floats = field(default_factory=_none)
    quaternions: Floats = field(default_factory=_none)
    spacing: tuple[float, ...] = ()
    full_names: tuple[str, ...] = ()

    @property
    @ieee_754
    def is_finite(self) -> bool:
        """Whether all numbers are numbers."""
        # float32 on the wire, so that no sum of numbers is infinite
        return math.isfinite(self.positions.sum() + self.rotations.sum() + self.quaternions.sum())


NOTHING = ContentMeasures()


@ieee_754
def measure_content(content: Body) -> ContentMeasures:
    """The lengths, rotations and names in a content; nothing where it has none."""
    match content:
        case Transform():
            return _matrices(_floats(content.wire_matrix).reshape(1, 12))
        case Position():
            return ContentMeasures(
                _floats(content.position).reshape(1, 3), True, quaternions=_floats([content.quaternion])
            )
        case TrackingData():
            return _matrices(_floats(content.elements["matrix"]), _full(content))
        case QuaternionTrackingData():
            elements = content.elements
            return ContentMeasures(
                _floats(elements["position"]),
                quaternions=_floats(elements["quaternion"]),
                full_names=_full(content),
            )
        case Points():
            return ContentMeasures(_floats(content.elements["position"]), False, full_names=_full(content))
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
    # the wire has columns, one after the other
    return ContentMeasures(parts[:, 3], True, parts[:, :3].transpose(0, 2, 1), full_names=full_names)


def _full(content: Elements) -> tuple[str, ...]:
    """NumPy leaves out the zeros at the end, so what is as long as its field has none."""
    names = content.elements["name"][:MAX_POSITIONS]
    return tuple(name.decode("utf-8", "replace") for name in names.tolist() if len(name) == names.dtype.itemsize)
