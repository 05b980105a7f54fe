"""Text of many megabytes, converted in pieces: in one call it would have the interpreter for tens of milliseconds."""

from __future__ import annotations

import codecs
import sys
from collections.abc import Iterator

#: From here on, text is converted in pieces of this size (bytes or characters).
LONG, _PIECE = 1 << 20, 256 << 10

_BOM = 2  # bytes of the mark of UTF-16


def decoded(data: bytes, codec: str, errors: str = "strict") -> str:
    """Return ``data.decode(codec, errors)``.  Raises UnicodeDecodeError; its positions may be those of a piece."""
    if len(data) < LONG:
        return data.decode(codec, errors)
    begin = 0
    if codec == "utf-16":  # in pieces, it would need its mark
        marks = {codecs.BOM_UTF16_LE: "utf-16-le", codecs.BOM_UTF16_BE: "utf-16-be"}
        begin = _BOM if data[:_BOM] in marks else 0
        codec = marks.get(data[:_BOM], f"utf-16-{sys.byteorder[0]}e")
    pieces = (data[at : at + _PIECE] for at in range(begin, len(data), _PIECE))
    return _joined(pieces, codec, errors)


def encoded(text: str) -> list[bytes]:
    """Return ``text.encode("utf-8", "surrogateescape")``, in pieces."""
    return [text[at : at + _PIECE].encode("utf-8", "surrogateescape") for at in range(0, len(text), _PIECE)]


def replaced(text: str) -> str:
    """Return text whose undecodable bytes, as surrogates, are replaced."""
    if text.isascii():
        return text
    return _joined(iter(encoded(text)), "utf-8", "replace")


def _joined(pieces: Iterator[bytes], codec: str, errors: str) -> str:
    decoder = codecs.getincrementaldecoder(codec)(errors)
    parts = [decoder.decode(piece) for piece in pieces]
    return "".join([*parts, decoder.decode(b"", final=True)])
