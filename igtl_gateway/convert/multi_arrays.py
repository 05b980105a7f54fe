"""Int8MultiArray … Float64MultiArray of std_msgs as values: their definitions differ only in the number."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from igtl_gateway.convert.common_msgs import MultiArrayLayout
from igtl_gateway.convert.structs import Array, Struct, number_sequence, struct_of


@dataclass(frozen=True, slots=True)
class MultiArray(Struct):
    """Base of the classes in ``MULTI_ARRAYS``."""

    layout: MultiArrayLayout
    data: Array


def _multi_array(name: str, number: str) -> type[MultiArray]:
    kind = type(name, (MultiArray,), {"__slots__": (), "__doc__": f"std_msgs/msg/{name}: data (n,) {number}."})
    kind.TYPE = f"std_msgs/msg/{name}"  # type: ignore[attr-defined]
    kind.FIELDS = (struct_of(MultiArrayLayout), number_sequence(number))  # type: ignore[attr-defined]
    return kind


#: numpy type → class of std_msgs that holds such an array: Int8MultiArray … Float64MultiArray.
MULTI_ARRAYS: dict[str, type[MultiArray]] = {
    np.dtype(number).str[1:]: _multi_array(f"{name}MultiArray", number)
    for name, number in (
        *(("Int8", "int8"), ("UInt8", "uint8"), ("Int16", "int16"), ("UInt16", "uint16")),
        *(("Int32", "int32"), ("UInt32", "uint32"), ("Float32", "float32"), ("Float64", "float64")),
    )
}
