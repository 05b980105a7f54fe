"""TRANSFORM and POSITION/QTRANS: a pose, as matrix or as quaternion."""

from __future__ import annotations

import math
import struct
from struct import Struct
from typing import Any, ClassVar

from igtl_gateway.base.buffers import Buffer
from igtl_gateway.base.errors import MalformedBody
from igtl_gateway.base.quantities import counted
from igtl_gateway.base.values import value
from igtl_gateway.base.versions import Self
from igtl_gateway.wire.layout import Field, Layout, compile_struct
from igtl_gateway.wire.traits import SHORT, Traits


@value(frozen=True, slots=True)
class Transform:
    """TRANSFORM: a pose as the upper three rows of a 4 × 4 matrix, column by column (``Protocol/transform.md``).

    Attributes:
        wire_matrix: R11 R21 R31 | R12 R22 R32 | R13 R23 R33 | TX TY TZ; translation in millimetres.
    """

    PROTOCOL: ClassVar[str] = "1"
    TRAITS: ClassVar[Traits] = Traits(SHORT)
    LAYOUT: ClassVar[Layout] = (Field("wire_matrix", "f32", 12),)
    _MATRIX: ClassVar[Struct] = compile_struct(LAYOUT)

    wire_matrix: tuple[float, ...]

    @classmethod
    def unpack(cls, content: memoryview) -> Self:
        if content.nbytes != cls._MATRIX.size:
            raise MalformedBody("TRANSFORM content", counted(content.nbytes, "byte"), f"{cls._MATRIX.size} bytes")
        return cls(unpack_floats(cls._MATRIX, content))

    def pack(self) -> list[Buffer]:
        return [pack_floats(self._MATRIX, self.wire_matrix, "TRANSFORM matrix")]

    @classmethod
    def from_rows(cls, rows: list[list[float]]) -> Self:
        """From a matrix given as (at least three) rows of four."""
        return cls(tuple(rows[row][column] for column in range(4) for row in range(3)))

    @property
    def rows(self) -> list[list[float]]:
        """The 4 × 4 matrix as rows."""
        m = self.wire_matrix
        return [[m[row], m[row + 3], m[row + 6], m[row + 9]] for row in range(3)] + [[0.0, 0.0, 0.0, 1.0]]

    def describe(self) -> dict[str, Any]:
        return {"matrix": self.rows}


@value(frozen=True, slots=True)
class Position:
    """POSITION: a pose as position and quaternion (``Protocol/position.md``).

    Accepted: three lengths.  28 bytes contain all values; 24 omit w, which is √(1 − x² − y² − z²); 12 omit the
    rotation.  The short forms are in the code of the reference library, not in the document.

    Sent: all 28 bytes.

    Attributes:
        position: x, y, z in millimetres.
        quaternion: x, y, z, w (scalar last).
        form: ``"all"``, ``"quaternion3"`` or ``"position_only"``: what is on the wire.
    """

    PROTOCOL: ClassVar[str] = "1"
    TRAITS: ClassVar[Traits] = Traits(SHORT)
    LAYOUT: ClassVar[Layout] = (Field("position", "f32", 3), Field("quaternion", "f32", 4))
    #: ``form`` → what is on the wire.
    _FORMS: ClassVar[dict[str, Struct]] = {
        "all": compile_struct(LAYOUT),
        "quaternion3": Struct(">6f"),
        "position_only": compile_struct(LAYOUT[:1]),
    }
    LENGTHS: ClassVar[str] = "28, 24 or 12 bytes"
    position: tuple[float, ...]
    quaternion: tuple[float, ...] = (0.0, 0.0, 0.0, 1.0)
    form: str = "all"

    @classmethod
    def unpack(cls, content: memoryview) -> Self:
        form = _FORM_OF_SIZE.get(content.nbytes)
        if form is None:
            raise MalformedBody("POSITION content", counted(content.nbytes, "byte"), cls.LENGTHS)
        values = unpack_floats(cls._FORMS[form], content)
        position, rotation = values[:3], values[3:]
        if form == "position_only":
            rotation = (0.0, 0.0, 0.0, 1.0)
        elif form == "quaternion3":
            rest = 1.0 - math.fsum(value * value for value in rotation)
            rotation = (*rotation, math.sqrt(max(rest, 0.0)))
        return cls(position, rotation, form)

    def pack(self) -> list[Buffer]:
        layout = self._FORMS[self.form]
        values = (*self.position, *self.quaternion)[: layout.size // 4]
        return [pack_floats(layout, values, "POSITION")]

    def describe(self) -> dict[str, Any]:
        return {"pack": self.form, "position": list(self.position), "quaternion": list(self.quaternion)}


_FORM_OF_SIZE = {layout.size: form for form, layout in Position._FORMS.items()}


# -- float32 ⇄ Python's float64 ---------------------------------------------------------------------------------------
#
# Processors make a signalling NaN quiet when they convert it; ``struct`` lets them.  A message is written back as it
# was read, so NaNs are converted by their bits here.  A sum is NaN where a number is: the quickest look at them all.

_DOUBLE = Struct(">d")
_WORD = Struct(">I")


def unpack_floats(layout: Struct, content: memoryview, offset: int = 0) -> tuple[float, ...]:
    """The float32 numbers of ``layout`` at ``offset``, every bit of a NaN kept."""
    values = layout.unpack_from(content, offset)
    if math.isnan(sum(values)):
        words = struct.unpack_from(f">{len(values)}I", content, offset)
        values = tuple(_nan_of(word) if math.isnan(value) else value for value, word in zip(values, words, strict=True))
    return values


def _nan_of(word: int) -> float:
    bits = (word & 0x80000000) << 32 | 0x7FF << 52 | (word & 0x7FFFFF) << 29
    (value,) = _DOUBLE.unpack(bits.to_bytes(8, "big"))
    return float(value)


def pack_floats(layout: Struct, values: tuple[float, ...], place: str) -> bytes:
    """The mirror of ``unpack_floats``; a number too large for float32 is MalformedBody, not OverflowError."""
    try:
        data = layout.pack(*values)
    except (OverflowError, struct.error) as error:
        raise MalformedBody(place, values, f"{layout.size // 4} float32 numbers ({error})") from None
    if math.isnan(sum(values)):
        words = zip(values, _WORD.iter_unpack(data), strict=True)
        data = b"".join(_WORD.pack(_word_of(value) if math.isnan(value) else word) for value, (word,) in words)
    return data


def _word_of(nan: float) -> int:
    bits = int.from_bytes(_DOUBLE.pack(nan), "big")
    payload = bits >> 29 & 0x7FFFFF
    return bits >> 32 & 0x80000000 | 0x7F800000 | (payload or 0x400000)  # without payload it would be infinity
