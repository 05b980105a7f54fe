"""A module that receives the poses of a tool, measures its path, and sends a warning when the tool is too deep.

It receives OpenIGTLink from a plain socket and does not depend on igtl-gateway.
"""

from __future__ import annotations

import math
import socket
import struct

HEADER = struct.Struct(">H12s20sQQQ")
#: The end of a TRANSFORM's matrix: x, y and z in millimetres.
POSITION = struct.Struct(">36x3f")


class ToolMonitor:
    """A client that connects when it is created; ``run`` returns when the server closes the connection.

    Attributes:
        path_mm: length of the tool's path.
        lowest_mm: lowest z of the tool.
    """

    def __init__(self, host: str, port: int, limit_mm: float) -> None:
        self.path_mm = 0.0
        self.lowest_mm = math.inf
        self._limit_mm = limit_mm
        self._last: tuple[float, float, float] | None = None
        self._socket = socket.create_connection((host, port))

    def run(self) -> None:
        with self._socket:
            while header := self._read(HEADER.size):
                _, kind, device, _, size, _ = HEADER.unpack(header)
                body = self._read(size)
                if kind.rstrip(b"\0") == b"TRANSFORM" and device.rstrip(b"\0") == b"ToolToBase":
                    self._moved(POSITION.unpack_from(body))

    def _moved(self, position: tuple[float, float, float]) -> None:
        if self._last:
            self.path_mm += math.dist(self._last, position)
            if position[2] < self._limit_mm <= self._last[2]:
                self._send(f"tool below {self._limit_mm:g} mm")
        self._last = position
        self.lowest_mm = min(self.lowest_mm, position[2])

    def _send(self, text: str) -> None:
        body = struct.pack(">HH", 3, len(text)) + text.encode("ascii")
        header = HEADER.pack(1, b"STRING", b"ToolMonitor", 0, len(body), crc64(body))
        self._socket.sendall(header + body)

    def _read(self, size: int) -> bytes:
        """Return this number of bytes; ``b""`` at the end of the stream."""
        data = b""
        while len(data) < size and (part := self._socket.recv(size - len(data))):
            data += part
        return data if len(data) == size else b""


def crc64(data: bytes) -> int:
    """Return the CRC-64 (ECMA-182) that OpenIGTLink uses."""
    crc = 0
    for byte in data:
        crc ^= byte << 56
        for _ in range(8):
            crc = (crc << 1 ^ (0x42F0E1EBA9EA3693 if crc >> 63 else 0)) & 0xFFFFFFFFFFFFFFFF
    return crc


if __name__ == "__main__":
    ToolMonitor("127.0.0.1", 18944, limit_mm=180).run()
