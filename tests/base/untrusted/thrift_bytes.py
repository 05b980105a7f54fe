"""Structures in the compact protocol of Thrift, written as thrift-compact-protocol.md describes them."""

from __future__ import annotations

from typing import Any


def varint(number: int) -> bytes:
    found = b""
    while number > 127:
        found += bytes([number & 127 | 128])
        number >>= 7
    return found + bytes([number])


def zigzag(number: int) -> bytes:
    return varint(number * 2 if number >= 0 else -number * 2 - 1)


def written(value: Any) -> tuple[int, bytes]:
    """Kind and bytes of a value, as the document describes them."""
    match value:
        case int():
            return 6, zigzag(value)
        case bytes():
            return 8, varint(len(value)) + value
        case list():
            kinds = {written(each)[0] for each in value} or {6}
            (kind,) = kinds
            head = bytes([len(value) << 4 | kind]) if len(value) < 15 else bytes([0xF0 | kind]) + varint(len(value))
            return 9, head + b"".join(written(each)[1] for each in value)
        case dict():
            return 12, structure(value)
        case _:
            raise TypeError(value)


def structure(fields: dict[int, Any]) -> bytes:
    """In short form where the numbers allow it."""
    found, before = b"", 0
    for number, value in fields.items():
        kind, data = (1 if value else 2, b"") if isinstance(value, bool) else written(value)
        step = number - before
        found += (bytes([step << 4 | kind]) if 0 < step < 16 else bytes([kind]) + zigzag(number)) + data
        before = number
    return found + b"\0"
