"""Fixed-width text of OpenIGTLink: zero-padded byte fields ⇄ str, without losing a byte.

Decoding keeps everything but the trailing zeros: invalid UTF-8 becomes surrogates, and what a
sloppy sender left behind the first NUL stays in the string, so that encoding gives the same bytes again.
``visible`` is the text as people and programs are meant to read it.
"""

from __future__ import annotations

from functools import lru_cache

from igtl_gateway.base.errors import MalformedBody
from igtl_gateway.base.long_text import replaced
from igtl_gateway.base.quantities import counted

#: Names come again and again: those of fields in headers are remembered.
_NAME = 32
_names = lru_cache(maxsize=4_096)


def decode_text(data: bytes | memoryview) -> str:
    """The text of a zero-padded field (or of any text bytes), losslessly."""
    data = bytes(data)
    return _decoded_name(data) if len(data) <= _NAME else _decoded(data)


def _decoded(data: bytes) -> str:
    return data.rstrip(b"\x00").decode("utf-8", "surrogateescape")


_decoded_name = _names(_decoded)


def encode_text(text: str, width: int, place: str) -> bytes:
    """``text`` as UTF-8, zero-padded to ``width`` bytes.  Raises MalformedBody if it does not fit."""
    data = text.encode("utf-8", "surrogateescape")
    if len(data) > width:
        raise MalformedBody(
            place, f"{visible(text)!r} ({counted(len(data), 'byte')})", f"at most {counted(width, 'byte')} of UTF-8"
        )
    return data.ljust(width, b"\x00")


def cut_text(text: str, width: int) -> str:
    """``text`` cut to ``width`` bytes of UTF-8, never inside a character."""
    data = text.encode("utf-8", "surrogateescape")
    return text if len(data) <= width else data[:width].decode("utf-8", "ignore")


def visible(text: str) -> str:
    """``text`` up to its first NUL, undecodable bytes replaced: for display, names and conversion."""
    return _visible_name(text) if len(text) <= _NAME else _visible(text)


def _visible(text: str) -> str:
    return replaced(text.partition("\x00")[0] if "\x00" in text else text)


_visible_name = _names(_visible)
