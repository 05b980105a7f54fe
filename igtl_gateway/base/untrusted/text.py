"""Untrusted text: printed without control characters; JSON and TOML parsed within the limits."""

from __future__ import annotations

import json
import re
import unicodedata
from typing import Any

from igtl_gateway.base.errors import DamagedRecording
from igtl_gateway.base.untrusted import limits
from igtl_gateway.base.untrusted.numbers import bounded_integer, check_numbers
from igtl_gateway.base.versions import tomllib

#: Unicode categories that move the cursor, reorder or break lines: control, format, surrogate, line, paragraph.
_UNSAFE = frozenset({"Cc", "Cf", "Cs", "Zl", "Zp"})


def printable(text: str) -> str:
    """Return untrusted text as one safe line for a terminal.

    Control characters become ``\\x1b``, others that hide or reorder text ``\\u202e``.
    """
    if text.isprintable():
        return text
    return "".join(_escape(char) if unicodedata.category(char) in _UNSAFE else char for char in text)


def _escape(char: str) -> str:
    code = ord(char)
    return f"\\x{code:02x}" if code < 256 else f"\\u{code:04x}" if code < 1 << 16 else f"\\U{code:08x}"


def json_line(value: Any, *, ascii_only: bool = False) -> str:
    """Return JSON on one line, with the characters escaped that control a terminal."""
    text = json.dumps(value, ensure_ascii=ascii_only, default=str)
    if text.isprintable():
        return text
    return "".join(
        json.dumps(char)[1:-1] if ord(char) > 126 and unicodedata.category(char) in _UNSAFE else char for char in text
    ).replace("\x7f", "\\u007f")


def parse_json(text: str, place: str) -> Any:
    """Parse JSON within the limits of memory and depth.  Raises DamagedRecording."""
    limits.check_limit("free", len(text), place)
    check_nesting(text, place)
    try:
        return json.loads(text, parse_int=bounded_integer)
    except (ValueError, RecursionError) as error:
        raise DamagedRecording(f"{place}: found invalid JSON: {error}, expected a whole document") from None


def parse_toml(data: bytes, place: str) -> dict[str, Any]:
    """Parse TOML within the limits of memory, count and depth.  Raises DamagedRecording."""
    limits.check_limit("free", len(data), place)
    limits.check_limit("count", sum(map(data.count, (b"\n", b",", b"=", b"."))), place)
    if found := _LONG_NUMBER.search(data):
        raise DamagedRecording(
            f"{place}: byte {found.start()}: found a number of more than 1,000 digits, expected fewer"
        )
    try:
        text = data.decode()
        check_nesting(text, place)
        for line in text.split("\n"):
            if line.count(".") > limits.current_limits().depth:
                # parsing is quadratic in the dots of a key; dots in strings and numbers do not count
                limits.check_limit("depth", _FREE_DOTS.sub("", line).count("."), place)
        document = tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        raise DamagedRecording(f"{place}: is not valid TOML: {error}") from None
    check_numbers(document, place)
    return document


#: A number with 1,000 digits or more: no setting has that, and Python prints at most 4,300 digits.
_LONG_NUMBER = re.compile(rb"=\s*[+-]?(?:0x)?[0-9a-fA-F_]{1000}")
#: Strings, comments and numbers of TOML.
_FREE_DOTS = re.compile(r""""[^"]*"|'[^']*'|#.*|[0-9]\.[0-9]""")


def check_nesting(text: str, place: str) -> None:
    """Raise LimitExceeded if brackets nest deeper than the limit; brackets in strings count, too."""
    if text.count("[") + text.count("{") <= limits.current_limits().depth:
        return
    depth = 0
    for char in text:
        if char in "[{":
            depth += 1
            limits.check_limit("depth", depth, place)
        elif char in "]}":
            depth -= 1
