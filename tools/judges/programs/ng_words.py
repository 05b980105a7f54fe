"""Values of a message as words, the same in every language: what the programs and the judge of openigtlink-ng compare.

A word is ``i`` and an integer, ``I`` and integers, ``F`` and floats as the hex digits of big-endian float64 (each NaN
as the quiet one: ways of reading differ in its bits only, which the bytes show), ``x`` and bytes or text in hex, or
``n`` and the number of the elements that follow.  The order is that of the fields in a schema of openigtlink-ng, which
is that of the wire; with a schema the words are values again.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import numpy as np

Field = dict[str, Any]
INTEGERS = {f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)}
FLOATS = {"float32", "float64"}


def integer(value: int) -> str:
    return f"i{int(value)}"


def integers(values: Iterable[int]) -> str:
    return "I" + ",".join(map(str, map(int, values)))


def floats(values: Any) -> str:
    with np.errstate(invalid="ignore"):  # signalling NaN
        numbers = np.atleast_1d(np.asarray(values, np.float64)).astype(">f8")
    numbers[np.isnan(numbers)] = np.nan
    return "F" + numbers.tobytes().hex()


def octets(data: bytes | bytearray | memoryview) -> str:
    return "x" + bytes(data).hex()


def text(value: str | bytes) -> str:
    return octets(value.encode("utf-8", "surrogateescape") if isinstance(value, str) else value)


def written(fields: Sequence[Field], value: Any) -> Iterator[str]:
    """The words of an object, or of a dict, with these fields."""
    for field in fields:
        one = value[field["name"]] if isinstance(value, dict) else getattr(value, field["name"])
        yield from _written(field, one)


def _written(field: Field, value: Any) -> Iterator[str]:
    kind, element = field["type"], field.get("element_type")
    if kind in INTEGERS:
        yield integer(value)
    elif kind in FLOATS:
        yield floats(value)
    elif kind != "array":
        yield text(value)
    elif isinstance(element, dict):
        yield f"n{len(value)}"
        for one in value:
            yield from written(element["fields"], one) if element["type"] == "struct" else _written(element, one)
    elif element in FLOATS:
        yield floats(value)
    elif element == "uint8":
        yield octets(value)
    else:
        yield integers(value)


def read(fields: Sequence[Field], words: Iterator[str]) -> dict[str, Any]:
    """The values of these fields by their names."""
    return {field["name"]: _read(field, words) for field in fields}


def _read(field: Field, words: Iterator[str]) -> Any:
    kind, element = field["type"], field.get("element_type")
    word = next(words)
    body = word[1:]
    if word[0] == "i":
        return int(body)
    if word[0] == "I":
        return list(map(int, body.split(","))) if body else []
    if word[0] == "F":
        numbers = np.frombuffer(bytes.fromhex(body), ">f8").tolist()
        return numbers if kind == "array" else numbers[0]
    if word[0] == "x":
        data = bytes.fromhex(body)
        return data if kind == "array" or field.get("encoding") == "binary" else data.decode("ascii")
    assert isinstance(element, dict)
    read_one = (
        (lambda: read(element["fields"], words)) if element["type"] == "struct" else (lambda: _read(element, words))
    )
    return [read_one() for _ in range(int(body))]
