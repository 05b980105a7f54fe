"""Arrays and components of rerun, made of the buffers of numpy: nothing is copied or converted.

They are what the classes of rerun make; those convert and check them for as long as it takes to send them.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from importlib.util import find_spec
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import rerun as rr

Array = npt.NDArray[Any]

_PIXELS = pa.list_(pa.field("item", pa.uint8(), nullable=False))


class _WithoutPandas:
    """Finds no pandas."""

    @staticmethod
    def find_spec(name: str, *_: object) -> None:
        """As the import system asks for it."""
        if name == "pandas":
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)


def leave_out_pandas() -> None:
    """Have Arrow do without pandas in this process: it would import it with its first array, which takes 0.25 s."""
    if "pandas" in sys.modules or find_spec("pandas") is None:
        return
    finder: Any = _WithoutPandas()
    sys.meta_path.insert(0, finder)
    try:
        pa.array([0])
    finally:
        sys.meta_path.remove(finder)


@dataclass(frozen=True, slots=True)
class ColumnOf:
    """A column of times or of a component, or the values of a component in one row, as rerun asks for it."""

    name: Any
    values: pa.Array

    def timeline_name(self) -> str:
        """Of times: the time line."""
        return str(self.name)

    def component_descriptor(self) -> Any:
        """Of a component: what it is."""
        return self.name

    def as_arrow_array(self) -> pa.Array:
        """The values."""
        return self.values


def component(archetype: str, name: str, kind: str) -> rr.ComponentDescriptor:
    """What a component is for rerun."""
    return rr.ComponentDescriptor(
        f"{archetype}:{name}", archetype=f"rerun.archetypes.{archetype}", component_type=f"rerun.components.{kind}"
    )


def array_of(kind: pa.DataType, values: Array) -> pa.Array:
    """Numbers of this type as an array of Arrow, which has their buffer."""
    return pa.Array.from_buffers(kind, len(values), [None, pa.py_buffer(np.ascontiguousarray(values))])


def vector_type(kind: pa.DataType, count: int) -> pa.DataType:
    """The type of ``count`` numbers."""
    return pa.list_(pa.field("item", kind, nullable=False), count)


def vectors_of(kind: pa.DataType, values: Array) -> pa.Array:
    """Rows (n, k) of numbers as vectors of this type."""
    return pa.FixedSizeListArray.from_arrays(array_of(kind.value_type, values.reshape(-1)), type=kind)


def each_of(kind: pa.DataType, values: Sequence[Any], looks: Array) -> pa.Array:
    """The value of each row, of which there is one for each look."""
    count = len(looks)
    if len({*values}) > 1:
        return pa.array(values, kind).take(array_of(pa.int32(), looks))
    (value,) = {*values}
    if pa.types.is_string(kind):
        text = value.encode()
        offsets = np.arange(count + 1, dtype=np.int32) * np.int32(len(text))
        return pa.Array.from_buffers(kind, count, [None, pa.py_buffer(offsets), pa.py_buffer(text * count)])
    if pa.types.is_boolean(kind):
        bits = (b"\xff" if value else b"\0") * (count // 8 + 1)
        return pa.Array.from_buffers(kind, count, [None, pa.py_buffer(bits)])
    return array_of(kind, np.full(count, value, kind.to_pandas_dtype()))


def lists_of(values: pa.Array, offsets: Array, kind: pa.DataType | None = None) -> pa.Array:
    """Lists of values; list i has those from ``offsets[i]`` to ``offsets[i + 1]``."""
    return pa.ListArray.from_arrays(array_of(pa.int32(), offsets), values, type=kind)


_BUFFER, _FORMAT = component("Image", "buffer", "ImageBuffer"), component("Image", "format", "ImageFormat")
_PLACES = component("Mesh3D", "vertex_positions", "Position3D")
_TRIANGLES = component("Mesh3D", "triangle_indices", "TriangleIndices")
_TEXTURE_PLACES = component("Mesh3D", "vertex_texcoords", "Texcoord2D")
_TEXTURE = component("Mesh3D", "albedo_texture_buffer", "ImageBuffer")
_TEXTURE_FORMAT = component("Mesh3D", "albedo_texture_format", "ImageFormat")


def image_of_pixels(pixels: Array, model: rr.ColorModel) -> list[ColumnOf]:
    """Return the picture of (height, width) or (height, width, channels) pixels; rerun guesses those of single rows."""
    height, width = pixels.shape[:2]
    return [
        ColumnOf(_BUFFER, _octets(pixels)),
        ColumnOf(_FORMAT, _format(width, height, model, pixels.dtype)),
    ]


def textured_surface(places: Array, triangles: Array, texture_places: Array, texture: Array) -> list[ColumnOf]:
    """Return a surface with a picture on it.

    Args:
        places: (n, 3) metres.
        triangles: (k, 3) numbers of places.
        texture_places: (n, 2) of the places in the picture, 0 … 1.
        texture: (height, width, 3) bytes red, green, blue.
    """
    height, width = texture.shape[:2]
    return [
        ColumnOf(_PLACES, vectors_of(vector_type(pa.float32(), 3), places.astype(np.float32))),
        ColumnOf(_TRIANGLES, vectors_of(vector_type(pa.uint32(), 3), triangles.astype(np.uint32))),
        ColumnOf(_TEXTURE_PLACES, vectors_of(vector_type(pa.float32(), 2), texture_places.astype(np.float32))),
        ColumnOf(_TEXTURE, _octets(texture)),
        ColumnOf(_TEXTURE_FORMAT, _format(width, height, rr.ColorModel.RGB, texture.dtype)),
    ]


def _octets(pixels: Array) -> pa.Array:
    octets = np.ascontiguousarray(pixels).reshape(-1).view(np.uint8)
    return lists_of(array_of(pa.uint8(), octets), np.array([0, len(octets)], np.int32), _PIXELS)


@lru_cache(maxsize=64)
def _format(width: int, height: int, model: rr.ColorModel, dtype: np.dtype[Any]) -> pa.Array:
    image = rr.Image(bytes=b"", width=width, height=height, color_model=model, datatype=dtype)
    (found,) = (each for each in image.as_component_batches() if each.component_descriptor() == _FORMAT)
    return found.as_arrow_array()
