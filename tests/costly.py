"""The most expensive messages of each type that are valid: of one table, for tests, attackers and measurements."""

from __future__ import annotations

import numpy as np

from igtl_gateway.wire import Message
from igtl_gateway.wire.polydata import SCALAR, Attribute, PolyData


def polydata_of_attributes(number: int) -> Message:
    """POLYDATA with this number of attributes of one name."""
    one = Attribute.of(SCALAR, "a", np.zeros((1, 1)))
    return Message("POLYDATA", "Costly", PolyData(np.zeros((1, 3), ">f4"), attributes=(one,) * number))
