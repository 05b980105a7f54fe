"""SENSOR: up to 255 numbers with their unit (``Protocol/sensor.md``, ``unit.md``), and units as text.

The unit is a word of 64 bits: an SI prefix for the whole product in the upper 4, then six factors of 10 bits, the
first factor uppermost: 6 bits unit, 4 bits exponent (signed).  0 is no unit.

Text is what people and other programs write: ``mm/s^2``, ``N.m``, ``kg``, ``mV``.  There a prefix belongs to its
unit and is raised with it (mm^2 are 10⁻⁶ m²), in the word it belongs to the product.  So a prefix is written at a
unit whose exponent is 1, where both mean the same, and as a factor (``10^3.s^-1``) where there is no such unit.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from struct import Struct
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from igtl_gateway.base.buffers import Buffer
from igtl_gateway.base.errors import MalformedBody, TruncatedMessage
from igtl_gateway.base.quantities import counted
from igtl_gateway.base.versions import Self
from igtl_gateway.wire.layout import Field, Layout, compile_struct
from igtl_gateway.wire.traits import SHORT, Traits

_VALUES = np.dtype(">f8")
MAX_VALUES = 255

UnitParts = tuple[tuple[int, int], ...]


@dataclass(frozen=True, slots=True, eq=False)
class Sensor:
    """SENSOR: up to 255 numbers with their unit.

    Equality is that of the bytes on the wire.

    Attributes:
        values: (n,) float64, n ≤ 255; a view on the received bytes.
        unit: unit word; 0 = none.  Upper 4 bits: prefix; then six times 6 bits unit, 4 bits exponent.
        status: reserved by the protocol, 0.
    """

    PROTOCOL: ClassVar[str] = "2"
    TRAITS: ClassVar[Traits] = Traits(SHORT)
    LAYOUT: ClassVar[Layout] = (
        Field("length", "u8", 1, "number of values"),
        Field("status", "u8"),
        Field("unit", "u64"),
        Field("values", "f64", "length", "in the unit"),
    )
    _HEAD: ClassVar[Struct] = compile_struct(LAYOUT)

    values: npt.NDArray[np.float64]
    unit: int = 0
    status: int = 0

    @classmethod
    def unpack(cls, content: memoryview) -> Self:
        if content.nbytes < cls._HEAD.size:
            raise TruncatedMessage(
                "SENSOR content", counted(content.nbytes, "byte"), f"at least {cls._HEAD.size} bytes"
            )
        length, status, unit = cls._HEAD.unpack_from(content)
        expected = cls._HEAD.size + length * _VALUES.itemsize
        if content.nbytes != expected:
            raise MalformedBody(
                "SENSOR content",
                counted(content.nbytes, "byte"),
                f"{counted(expected, 'byte')} for {counted(length, 'value')}",
            )
        return cls(np.frombuffer(content[cls._HEAD.size :], _VALUES), unit, status)

    def pack(self) -> list[Buffer]:
        try:
            head = self._HEAD.pack(len(self.values), self.status, self.unit)
        except struct.error as error:
            found = f"{counted(len(self.values), 'value')}, status {self.status}, unit {self.unit}"
            raise MalformedBody("SENSOR", found, f"at most {MAX_VALUES} values, 8 and 64 bits ({error})") from None
        # at most 2 KiB: one buffer is cheaper than a second one
        return [head + np.asarray(self.values, _VALUES).tobytes()]

    def __eq__(self, other: object) -> bool:
        return self.pack() == other.pack() if isinstance(other, Sensor) else NotImplemented

    # holds an array that its owner may change: no key of a dict
    __hash__ = None  # type: ignore[assignment]

    def describe(self) -> dict[str, Any]:
        prefix, parts = unit_parts(self.unit)
        return {
            "length": len(self.values),
            "status": self.status,
            "unit": f"{self.unit:016x}",
            "unit_decoded": {"prefix": prefix, "units": [list(part) for part in parts]},
            "values": self.values.tolist(),
        }


# -- unit words ---------------------------------------------------------------------------------------------------

_FACTORS = 6
_PREFIX_AT = 60
_SIGN = 8
#: The exponents of the protocol; the four bits of -8 are unused.
_MAX_EXPONENT = 7


def unit_parts(word: int) -> tuple[int, UnitParts]:
    """Prefix code and six pairs of unit code and exponent (-8 … 7) of a unit word, as they stand there."""
    parts = []
    for index in range(_FACTORS):
        bits = word >> 10 * (_FACTORS - 1 - index)
        parts.append((bits >> 4 & 0x3F, ((bits & 0xF) ^ _SIGN) - _SIGN))
    return word >> _PREFIX_AT & 0xF, tuple(parts)


def unit_word(prefix: int, parts: Sequence[tuple[int, int]]) -> int:
    """The unit word of a prefix code and up to six pairs of unit code and exponent: inverse of ``unit_parts``.

    Raises ValueError for more pairs, and for numbers that their bits cannot hold.
    """
    if not 0 <= prefix <= 0xF or len(parts) > _FACTORS:
        raise ValueError(
            f"found prefix {prefix} and {counted(len(parts), 'unit')}, expected 0 … 15 and at most {_FACTORS}"
        )
    word = prefix << _PREFIX_AT
    for index, (unit, exponent) in enumerate(parts):
        if not (0 <= unit <= 0x3F and -_SIGN <= exponent < _SIGN):
            raise ValueError(f"found unit {unit} with exponent {exponent}, expected 0 … 63 with -8 … 7")
        word |= (unit << 4 | exponent & 0xF) << 10 * (_FACTORS - 1 - index)
    return word


# -- units as text ------------------------------------------------------------------------------------------------

#: Prefix code → symbol and power of ten.  8 is unused.
PREFIXES = {
    0x0: ("", 0), 0x1: ("da", 1), 0x2: ("h", 2), 0x3: ("k", 3), 0x4: ("M", 6), 0x5: ("G", 9), 0x6: ("T", 12),
    0x7: ("P", 15), 0x9: ("d", -1), 0xA: ("c", -2), 0xB: ("m", -3), 0xC: ("u", -6), 0xD: ("n", -9), 0xE: ("p", -12),
    0xF: ("f", -15),
}  # fmt: skip

#: Symbol of unit code 1, 2, ….  The unit of mass is the gram.
UNITS = (
    "m", "g", "s", "A", "K", "mol", "cd", "rad", "sr", "Hz", "N", "Pa", "J", "W", "C", "V", "F", "Ohm", "S", "Wb",
    "T", "H", "lm", "lx", "Bq", "Gy", "Sv",
)  # fmt: skip

_PREFIX_OF_POWER = {power: code for code, (_, power) in PREFIXES.items()}
#: Every symbol with every prefix → unit code and power of ten.  No two are the same.
_SYMBOLS = {
    prefix + unit: (code, power) for prefix, power in PREFIXES.values() for code, unit in enumerate(UNITS, start=1)
}
#: Other ways to write the same signs.
_SPELLINGS = str.maketrans({"µ": "u", "μ": "u", "Ω": "Ohm", "\u2126": "Ohm", "·": ".", "*": ".", "²": "^2", "³": "^3"})
_OPERATOR = re.compile(r"([./])")
_FACTOR = re.compile(r"([A-Za-z]+)(?:\^(-?[0-9]{1,2}))?")
_TEN = re.compile(r"10\^(-?[0-9]{1,2})")
_WORD = re.compile(r"0x[0-9A-Fa-f]{1,16}")


def unit_text(word: int) -> str:
    """A unit word as text, such as ``"mm/s^2"``; ``""`` for 0.

    A unit with exponent 0 is shown as with 1: the document's own example of a torque is written so, by mistake.
    A word with codes that the protocol does not know is shown as a number: ``"0x8000000000000000"``.
    """
    prefix, parts = unit_parts(word)
    if prefix not in PREFIXES or not all(
        unit <= len(UNITS) and abs(exponent) <= _MAX_EXPONENT and (unit or not exponent) for unit, exponent in parts
    ):
        return f"0x{word:016x}"
    symbol, power = PREFIXES[prefix]
    factors = [(UNITS[unit - 1], exponent or 1) for unit, exponent in parts if unit]
    at = next((index for index, (_, exponent) in enumerate(factors) if exponent == 1), None)
    text = ""
    if at is not None:
        factors[at] = (symbol + factors[at][0], 1)
    elif power:
        text = f"10^{power}"
    # strokes only at the end, as in J/g/K: then it is clear which factors are below them
    below = [exponent < 0 for _, exponent in factors]
    quotient = below == sorted(below) and not all(below)
    for name, exponent in factors:
        stroke = quotient and exponent < 0
        if text:
            text += "/" if stroke else "."
        shown = -exponent if stroke else exponent
        text += name if shown == 1 else f"{name}^{shown}"
    return text


def parse_unit(text: str) -> int:
    """Return the unit word of a string: the inverse of ``unit_text``, and all other unambiguous spellings.

    Factors are joined by ``.`` (``·``, ``*``) or divided by ``/``, which goes for the one next factor; each may
    have a prefix, which is raised with it, and an exponent: ``N/mm^2`` are meganewtons per square metre.

    Raises ValueError for what is no unit of the protocol, more than six factors, exponents beyond ±7, prefixes
    whose product is no prefix, and a product behind a stroke (is the ``K`` of ``J/g.K`` below it?).
    """
    plain = text.strip().translate(_SPELLINGS)
    if not plain:
        return 0
    if _WORD.fullmatch(plain):
        return int(plain, 16)
    first, *rest = _OPERATOR.split(plain)
    power, divided = 0, False
    parts: list[tuple[int, int]] = []
    for operator, factor in [(".", first), *zip(rest[::2], rest[1::2], strict=True)]:
        sign = 1 if operator == "." else -1
        if divided and sign > 0:
            raise ValueError(f"unit {text!r}: found a product behind '/', expected '/' for each factor below it")
        divided = sign < 0
        if ten := _TEN.fullmatch(factor):
            power += sign * int(ten[1])
        elif not (factor == "1" and not parts and sign > 0):
            unit, exponent, factor_power = _parse_factor(factor, text)
            parts.append((unit, sign * exponent))
            power += sign * factor_power * exponent
    if power not in _PREFIX_OF_POWER:
        raise ValueError(f"unit {text!r}: found prefixes of 10^{power} in all, expected a power with a prefix")
    try:
        return unit_word(_PREFIX_OF_POWER[power], parts)
    except ValueError as error:
        raise ValueError(f"unit {text!r}: {error}") from None


def _parse_factor(factor: str, text: str) -> tuple[int, int, int]:
    """Unit code, exponent, power of ten of the prefix (not yet raised)."""
    match = _FACTOR.fullmatch(factor)
    if match is None or match[1] not in _SYMBOLS:
        raise ValueError(f"unit {text!r}: found {factor!r}, expected one of {' '.join(UNITS)}, or with a prefix")
    exponent = 1 if match[2] is None else int(match[2])
    if not 1 <= abs(exponent) <= _MAX_EXPONENT:
        raise ValueError(f"unit {text!r}: found exponent {exponent}, expected ±1 … ±{_MAX_EXPONENT}")
    unit, power = _SYMBOLS[match[1]]
    return unit, exponent, power
