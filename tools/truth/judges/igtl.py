"""Streams of OpenIGTLink by pyigtl, message by message."""

from __future__ import annotations

import socket
from collections.abc import Iterator

import numpy as np
from pyigtl.messages import MessageBase

from tools.truth import world
from tools.truth.judges.samples import Sample


def received(address: tuple[str, int], timeout_s: float) -> bytes:
    """All bytes that a server sends until it closes the connection.  Raises OSError."""
    with socket.create_connection(address, timeout_s) as link:
        link.settimeout(timeout_s)
        parts = []
        while part := link.recv(1 << 16):
            parts.append(part)
    return b"".join(parts)


def by_pyigtl(data: bytes) -> Iterator[Sample]:
    """The messages in a stream of bytes."""
    at = 0
    while at + MessageBase.IGTL_HEADER_SIZE <= len(data):
        header = MessageBase.parse_header(data[at : at + MessageBase.IGTL_HEADER_SIZE])
        start = at + MessageBase.IGTL_HEADER_SIZE
        at = start + header["body_size"]
        message = MessageBase.create_message(header["message_type"])
        if header["message_type"] == "POLYDATA":  # pyigtl 0.3.4 raises TypeError for all of them
            continue
        if message is None or at > len(data):
            continue
        message.unpack(header, data[start:at])
        yield from _of(message, f"{header['message_type']}/{header['device_name']}", round(header["timestamp"] * 1e9))


def _of(message: object, stream: str, source_ns: int) -> Iterator[Sample]:
    kind = stream.partition("/")[0]
    found: object = message
    if kind == "TRANSFORM":
        yield Sample(stream, "", "pose", np.array(found.matrix), source_ns)  # type: ignore[attr-defined]
    elif kind == "IMAGE":
        pixels = np.squeeze(found.image)  # type: ignore[attr-defined]
        if pixels.shape == (world.HEIGHT, world.WIDTH):
            yield Sample(stream, "", "picture", pixels, source_ns)
        elif pixels.shape == (world.DEPTH_HEIGHT, world.DEPTH_WIDTH):
            yield Sample(stream, "", "depth", pixels, source_ns)
    elif kind == "STRING":
        text = found.string  # type: ignore[attr-defined]
        if text.startswith("at "):
            yield Sample(stream, "", "text", text, source_ns)
    elif kind == "POINT":
        for name, place in zip(found.names, found.positions, strict=True):  # type: ignore[attr-defined]
            yield Sample(stream, name, "plan", place, source_ns)
