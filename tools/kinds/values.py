"""The values that a field of a file can have, by its type, and the maker that puts one of them into a file.

A *kind* is ``FIELD=CHOICE``: the field by its place in the grammar (``interface.if_tsresol.length``), the choice by its
name in :data:`CHOICES`.  The seed decides everything else: contents, and which of several such fields is struck.
"""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Callable, Mapping, Sequence
from random import Random
from typing import Any, TypeVar

T = TypeVar("T")

#: More digits than Python converts, and more than a float holds.
LONG, LARGE = "9" * 5_000, "9" * 400
_DEEP = 5_000


def _numbers(bits: int, *, signed: bool = False) -> dict[str, int]:
    low, high = (-(1 << bits - 1), (1 << bits - 1) - 1) if signed else (0, (1 << bits) - 1)
    named = {"0": 0, "1": 1, "2": 2, "low": low, "high": high, "high-1": high - 1, "half": high // 2 + 1}
    named |= {f"2^{power}": 1 << power for power in (15, 16, 30, 31, 32, 62, 63) if 1 << power <= high}
    return named | {f"10^{power}": 10**power for power in (4, 6, 9, 12, 18) if 10**power <= high}


_FLOATS = {
    "nan": math.nan, "inf": math.inf, "-inf": -math.inf, "-0": -0.0, "1e308": 1e308, "-1e308": -1e308, "3e38": 3e38,
    "1e-310": 1e-310, "5e-324": 5e-324, "1e19": 1e19, "2^63": 2.0**63, "-1": -1.0, "0": 0.0,
}  # fmt: skip
_TEXTS = {
    "empty": "", "digits": LONG, "large": LARGE, "long": "a" * 450_000, "AToB": "A" + "ToB" * 2_000,
    "AToBs": "A" + "ToB" * 150_000, "AToB-": "A" + "ToB" * 100_000 + "-", "slashes": "/" * 5_000, "/a/a": "/a" * 4_000,
    "glob": "/*" + "a*" * 60 + "b", "stars": "*" * 2_000, "escape": "\x1b[2J\x1b]0;x\x07", "forged": "a\nb: forged\r",
    "bidi": "\u202egnp.exe", "nul": "a\0b", "path": "../../etc/passwd", "-1": "-1", "1e999": "1e999", "nan": "nan",
    "superscript": "²", "spaces": " " * 5_000, "braces": "{" * 200, "brackets": "[" * _DEEP, "percent": "%s%n{}",
    "encoding": f"8UC{LONG}", "half": "a\ud800", "undecodable": "a\udcff", "surrogates": "\udc80" * 50,
    "type": "std_msgs/msg/String", "quote": "'\"\\", "emoji": "\U0001f600" * 300,
}  # fmt: skip
#: Values of JSON, YAML and TOML, as they are written.
_WRITTEN = {
    "null": "null", "true": "true", "-1": "-1", "0": "0", "1.5": "1.5", "1e308": "1e308", "-1e308": "-1e308",
    "1e999": "1e999", "NaN": "NaN", "Infinity": "-Infinity", "digits": LONG, "-digits": f"-{LONG}", "large": LARGE,
    "2^63": str(1 << 63), "2^64": str(1 << 64), "list": "[]", "object": "{}", "lists": "[[], [[]]]", "text": '"x"',
    "empty": '""', "deep": "[" * _DEEP + "]" * _DEEP, "deeper": '{"a":' * 70 + "1" + "}" * 70, "half": '"a\\ud800"',
    "text of digits": f'"{LONG}"', "escape": '"\\u001b[2J\\n"', "long": f'"{"a" * 100_000}"', "nothing": "",
    "AToB": '"A' + "ToB" * 2_000 + '"', "glob": '"/*' + "a*" * 60 + 'b"', "many": f"[{'1,' * 20_000}1]",
    "nulls": "[null, null]", "hex": "0x" + "f" * 600, "alias": "*a", "tag": "!!python/name:os.system x",
    "date": "9999-12-31T23:59:59.999Z", "braces": '"{device} {0} {x.y}"',
}  # fmt: skip
_LENGTHS: dict[str, Callable[[int], int]] = {
    "0": lambda _: 0, "1": lambda _: 1, "less": lambda true: max(true - 1, 0), "more": lambda true: true + 1,
    "half": lambda true: true // 2, "double": lambda true: 2 * true + 1, "2^16": lambda _: 1 << 16,
    "2^31-1": lambda _: (1 << 31) - 1, "2^31": lambda _: 1 << 31, "2^32-1": lambda _: (1 << 32) - 1,
    "10^6": lambda _: 10**6, "2^62": lambda _: 1 << 62, "2^63": lambda _: 1 << 63, "2^64-1": lambda _: (1 << 64) - 1,
}  # fmt: skip
_BYTES: dict[str, Callable[[bytes], bytes]] = {
    "none": lambda _: b"", "cut": lambda true: true[: len(true) // 2], "less": lambda true: true[:-1],
    "more": lambda true: true + b"\0", "twice": lambda true: true * 2, "zeros": lambda true: bytes(len(true)),
    "ones": lambda true: b"\xff" * len(true), "not UTF-8": lambda true: b"\xff\xfe" + true[2:],
    "a million": lambda _: bytes(1_000_000),
}  # fmt: skip
#: Patterns over 8 bytes of any field: edges of integers and floats of both sizes and byte orders.
_WORDS = {
    f"{name}{order}": struct.pack(f"{order}{code}", value)
    for order in "<>"
    for name, code, value in (
        ("0", "Q", 0), ("ones", "Q", (1 << 64) - 1), ("half", "Q", 1 << 63), ("most", "Q", (1 << 63) - 1),
        ("f64 nan", "d", math.nan), ("f64 inf", "d", math.inf), ("f64 1e308", "d", 1e308), ("f64 tiny", "d", 5e-324),
        ("f32 nan", "f", math.nan), ("f32 inf", "f", math.inf), ("f32 3e38", "f", 3e38),
        ("u32 most", "I", (1 << 31) - 1),
        ("u32 ones", "I", (1 << 32) - 1), ("u32 1", "I", 1), ("u16 ones", "H", (1 << 16) - 1), ("u16 1", "H", 1),
        ("u8 ones", "B", 255), ("u8 1", "B", 1), ("u8 0", "B", 0),
    )
}  # fmt: skip

#: Type of a field → name of a choice → its value, or a function of the true one.
CHOICES: Mapping[str, Mapping[str, Any]] = {
    **{f"u{bits}": _numbers(bits) for bits in (8, 16, 32, 64)},
    **{f"i{bits}": _numbers(bits, signed=True) for bits in (8, 16, 32, 64)},
    "float": _FLOATS,
    "text": _TEXTS,
    "written": _WRITTEN,
    "length": _LENGTHS,
    "bytes": _BYTES,
    "word": _WORDS,
}


class Maker:
    """Writes the values of one file, all of them true except those of the kind.

    Args:
        seed: of the random values that the kind leaves open.
        kind: ``FIELD=CHOICE``; "": all values are true.

    Attributes:
        fields: name → type of the fields so far.
        rng: for the contents.
    """

    def __init__(self, seed: int, kind: str = "") -> None:
        self.fields: dict[str, str] = {}
        self.rng = Random(seed)
        self._seed = seed
        self._field, _, self._choice = kind.rpartition("=")
        self._share = self.rng.choice((1.0, 1.0, 0.3))

    def one_of(self, name: str, options: Sequence[T], key: Callable[[T], str] = str) -> T:
        """Return an option: that of the kind, whose field begins with ``NAME.OPTION.``, or one by the seed."""
        asked = [each for each in options if self._field.startswith(f"{name}.{key(each)}.")]
        return asked[0] if asked else options[self._seed % len(options)]

    def number(self, name: str, true: int, code: str) -> int:
        return int(self._made(name, code, true))

    def float(self, name: str, true: float) -> float:
        return float(self._made(name, "float", true))

    def text(self, name: str, true: str) -> str:
        return str(self._made(name, "text", true))

    def coded(self, name: str, true: str) -> bytes:
        """Return a string as bytes, in UTF-8 as far as it can be."""
        text = self.text(name, true)
        try:
            return text.encode("utf-8", "surrogateescape")
        except UnicodeEncodeError:
            return text.encode("utf-8", "surrogatepass")

    def length(self, name: str, true: int, bits: int = 32) -> int:
        return int(self._made(name, "length", true)) % (1 << bits)

    def blob(self, name: str, true: bytes) -> bytes:
        return bytes(self._made(name, "bytes", true))

    def words(self, name: str, true: bytes, most: int = 96, step: int = 2) -> bytes:
        """Bytes of no known fields: a pattern at one of their offsets."""
        data = bytearray(true)
        for at in range(0, min(len(true), most), step):
            word = self._made(f"{name}@{at}", "word", b"")
            data[at : at + len(word)] = word
        return bytes(data[: len(true)])

    def written(self, name: str, true: str) -> str:
        """A value of JSON, YAML or TOML as it is written."""
        return str(self._made(name, "written", true))

    def json(self, name: str, document: Any) -> str:
        """A JSON document with its leaves, keys, lists and objects as fields."""
        if isinstance(document, dict) and document:
            rows = (
                f"{json.dumps(self.text(f'{name}.(key)', str(key)))}: {self.json(f'{name}.{key}', value)}"
                for key, value in document.items()
            )
            return self.written(name, f"{{{', '.join(rows)}}}")
        if isinstance(document, list) and document:
            return self.written(name, f"[{', '.join(self.json(f'{name}[]', each) for each in document)}]")
        return self.written(name, json.dumps(document))

    def _made(self, name: str, code: str, true: Any) -> Any:
        if self.fields.setdefault(name, code) != code:
            raise ValueError(f"found the field {name} as {self.fields[name]} and as {code}, expected one type")
        if name != self._field or self.rng.random() >= self._share:
            return true
        value = CHOICES[code][self._choice]
        return value(true) if callable(value) else value
