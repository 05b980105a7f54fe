"""One attacker in a process of its own: any number of links that send the same bytes again and again.

    python tools/attacks.py NAME PORT LINKS RATE SECONDS

RATE: messages per second of all links together; 0: as fast as the bridge reads.  The bytes are made before the attack
begins, so that it costs little, and answers are read and thrown away.  ``names`` has all of them.  It prints a line
when its links are connected, and the number of messages at the end.
"""

from __future__ import annotations

import select
import socket
import struct
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from itertools import count, cycle
from pathlib import Path

from fastcrc import crc64

sys.path.insert(0, str(Path(__file__).parents[1]))

from igtl_gateway.wire import Message, encode
from igtl_gateway.wire.body import Body
from igtl_gateway.wire.image import Image
from igtl_gateway_lab.simulate.every_igtl import command_content, contents, query
from tests.costly import TABLE

_CHUNK_BYTES = 64 << 10
_TICK_S = 0.002
_PICTURE = (480, 480)  # 225 kB of 8 bits: more than a chunk, as a camera sends it
#: One query of each kind: with and without an answer, with and without a body.
_QUERIES = (
    *("GET_STATUS", "GET_CAPABIL", "GET_TDATA", "GET_IMAGE", "GET_BIND", "STT_TDATA", "STT_IMAGE", "STP_TDATA"),
    *("RTS_TDATA", "RTS_STATUS"),
)
#: Device names of the attack that invents them.
_NAMES = 20_000


def message(igtl_type: str, body: bytes, *, device: str = "Attack", crc: int | None = None) -> bytes:
    """A message of header version 1."""
    checked = crc64.ecma_182(body) if crc is None else crc
    return struct.pack(">H12s20sQQQ", 1, igtl_type.encode(), device.encode(), 0, len(body), checked) + body


def _encoded(igtl_type: str, device: str, content: Body) -> bytes:
    made = Message(igtl_type, device, content, header_version=2 if igtl_type == "COMMAND" else 1)
    return b"".join(bytes(part) for part in encode(made))


def _types() -> Iterator[tuple[str, list[bytes]]]:
    """The first message of every type that has content, and some queries."""
    seen = set()
    for igtl_type, device, content in contents():
        if igtl_type not in seen:
            seen.add(igtl_type)
            yield igtl_type, [_encoded(igtl_type, device, content)]
    for name in _QUERIES:
        yield name, [_encoded(name, "Attack", query(name))]


def _picture() -> bytes:
    width, height = _PICTURE
    head = struct.pack(">HBBBB3H", 1, 1, 3, 2, 1, width, height, 1)
    matrix = struct.pack(">12f", 1, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0)
    return head + matrix + struct.pack(">6H", 0, 0, 0, width, height, 1) + bytes(width * height)


def _attacks() -> dict[str, list[bytes]]:
    pose = struct.pack(">12f", 1, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0)
    big = bytes(range(256)) * 240
    made = dict(_types())
    made["COMMAND"] = [_encoded("COMMAND", "Attack", command_content(number, "Attack")) for number in range(200)]
    made["wrong CRC"] = [message("TRANSFORM", pose, crc=1)]
    made["wrong size"] = [message("TRANSFORM", pose[:44])]
    made["NaN"] = [message("TRANSFORM", struct.pack(">12f", *[float("nan")] * 12))]
    made["no body"] = [message("TRANSFORM", b"")]
    made["invented names"] = [message("TRANSFORM", pose, device=f"D{number}") for number in range(_NAMES)]
    made["invented types"] = [message(f"T{number}", pose) for number in range(_NAMES)]
    made["denied"] = [message("DENIED", pose)]
    made["STRING of 60 kB"] = [message("STRING", struct.pack(">HH", 3, len(big)) + big)]
    made["IMAGE of 225 kB"] = [message("IMAGE", _picture())]
    made["IMAGE, wrong CRC"] = [message("IMAGE", _picture(), crc=1)]
    made["IMAGE of 6 MB, wrong CRC"] = [message("IMAGE", bytes(6 << 20), crc=1)]
    made["unknown, 1 MB"] = [message("UNKNOWN", bytes(1 << 20))]
    return made


#: What a program sends that has a connection for each message.
_STRING = message("STRING", struct.pack(">HH", 3, 5) + b"Hello")

#: The most expensive valid messages of each type.
_COSTLY = {f"most: {row.name}": row for row in TABLE}
#: A short message of which a whole volume is copied.
_PARTS = "most: IMAGE, parts of a volume"

#: Attacks that are made of connections.
_MANNERS = ("connect and leave", "half a header", "a message and reset", "a message and leave")


def names() -> list[str]:
    """The names of all attacks but those of ``costly``."""
    return [*_attacks(), *_MANNERS]


def costly() -> list[str]:
    """The names of the attacks with the most expensive valid message of a type."""
    return [*_COSTLY, _PARTS]


def _parts() -> list[bytes]:
    """A volume of 60 MB, and 500 times a row of it."""
    size = (1_000, 1_000, 60)
    volume = Image(size, 3, bytes(60_000_000), 1)
    part = Image(size, 3, bytes(1_000), 1, subvol_offset=(0, 0, 0), subvol_size=(1_000, 1, 1))
    return [_encoded("IMAGE", "Attack", volume), *[_encoded("IMAGE", "Attack", part)] * 500]


class _Flooder:
    """One link that sends whole messages as fast as it may."""

    def __init__(self, port: int, chunks: Iterator[tuple[bytes, int]]) -> None:
        self.sock = socket.create_connection(("127.0.0.1", port))
        self.sock.setblocking(False)
        self._chunks = chunks
        self._rest = memoryview(b"")

    def send(self, most: int) -> int:
        """Send at least this number of messages, if the bridge takes them; return how many began."""
        sent = 0
        while True:
            if not self._rest and sent >= most:
                return sent
            if not self._rest:
                chunk, number = next(self._chunks)
                self._rest, sent = memoryview(chunk), sent + number
            try:
                self._rest = self._rest[self.sock.send(self._rest) :]
            except BlockingIOError:
                return sent

    def drain(self) -> None:
        with suppress(BlockingIOError):
            while self.sock.recv(1 << 20):
                pass


def _chunks(messages: list[bytes], per_chunk: int) -> Iterator[tuple[bytes, int]]:
    """Pieces of the endless row of these messages, each with its number of messages."""
    per_chunk = max(1, min(per_chunk, _CHUNK_BYTES // max(map(len, messages))))
    pieces = [messages[at : at + per_chunk] for at in range(0, len(messages), per_chunk)]
    if len(messages) == 1:
        pieces = [messages * per_chunk]
    return cycle([(b"".join(piece), len(piece)) for piece in pieces])


def flood(messages: list[bytes], port: int, links: int, rate: float, seconds: float) -> int:
    """Send for this time; return the number of messages that were sent."""
    per_chunk = 1_000 if not rate else max(1, round(rate * _TICK_S / links))
    flooders = [_Flooder(port, _chunks(messages, per_chunk)) for _ in range(links)]
    print("ready", flush=True)
    begun, sent, turn = time.monotonic(), 0, 0
    while (now := time.monotonic()) < begun + seconds:
        sockets = [flooder.sock for flooder in flooders]
        readable, writable, _ = select.select(sockets, [] if rate else sockets, [], _TICK_S)
        by_sock = {flooder.sock: flooder for flooder in flooders}
        for sock in readable:
            try:
                by_sock[sock].drain()
            except OSError:
                flooders.remove(by_sock[sock])
        if not flooders:
            break
        for sock in writable:
            with suppress(OSError):
                sent += by_sock[sock].send(1)
        while rate and sent < (now - begun) * rate:
            turn += 1
            with suppress(OSError):
                number = flooders[turn % len(flooders)].send(per_chunk)
                sent += number or 1  # what a full link did not take is not made up for
        if rate:
            time.sleep(_TICK_S)
    return sent


def churn(manner: str, port: int, links: int, rate: float, seconds: float) -> int:
    """Connect again and again, with this number of links at a time."""
    endings: dict[str, Callable[[socket.socket], None]] = {
        "connect and leave": lambda sock: None,
        "half a header": lambda sock: sock.sendall(bytes(29)),
        "a message and reset": _reset,
        "a message and leave": lambda sock: sock.sendall(_STRING),
    }
    print("ready", flush=True)
    begun, open_links = time.monotonic(), list[socket.socket]()
    for made in count(1):
        if time.monotonic() >= begun + seconds:
            return made
        with suppress(OSError):
            sock = socket.create_connection(("127.0.0.1", port))
            endings[manner](sock)
            open_links.append(sock)
        if len(open_links) >= links:
            open_links.pop(0).close()
        if rate:
            time.sleep(max(0.0, begun + made / rate - time.monotonic()))
    return 0


def _reset(sock: socket.socket) -> None:
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    sock.sendall(message("GET_STATUS", b""))


def main() -> None:
    name, port, links, rate, seconds = sys.argv[1:]
    where = (int(port), int(links), float(rate), float(seconds))
    if name in _MANNERS:
        sent = churn(name, *where)
    else:
        if name in _COSTLY:
            messages = [_COSTLY[name].data()]
        else:
            messages = _parts() if name == _PARTS else _attacks()[name]
        sent = flood(messages, *where)
    print(sent, flush=True)


if __name__ == "__main__":
    main()
