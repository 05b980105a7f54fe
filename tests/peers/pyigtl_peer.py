"""pyigtl (0.3) as a peer, with the interface of ``reference``.

Quirks of pyigtl that are hidden here:

- It keeps the newest message per device name only: its store is replaced by one that keeps all, in order.
- Its outgoing queue silently drops the oldest of more than 100 messages: replaced by an unbounded one.
- A message that cannot be encoded breaks its connection later, in its thread: it is encoded once in
  ``send`` already, so that the error is raised there.
- It converts an image's position from the wire's centre to the corner and back in float32: done in float64
  here, so that ``wire_matrix`` is the wire's.
- Its server takes over SIGINT and SIGTERM: they are given back.

Those that remain: no CRC is checked (so messages have no ``crc_ok``); stamps pass through a float64 (about
240 ns); images are little-endian on sending and whole volumes (a received sub-volume is a traceback on standard
error and a lost connection); text is ASCII on sending, and the strings of a POINT lose blanks at their end on
reading; a server has one client at a time and its thread spins once that client has left; types other than
the four here are not reported, and a POSITION of standard size arrives without content.
"""

from __future__ import annotations

import collections
import signal
from collections.abc import Callable, Mapping
from types import TracebackType
from typing import Any

import numpy as np
import pyigtl

from tests.peers import Inbox, Message, PeerError
from tests.peers.reference import LITTLE_ENDIAN, SCALARS

BIG_ENDIAN = 1
RAS, LPS = 1, 2


class PyigtlPeer:
    """A pyigtl client or server.

    Attributes:
        port: where a server listens, or where a client connects to.
    """

    def __init__(self, connector: Any, port: int) -> None:
        """Run a connector of pyigtl that is not started yet; ``client`` and ``server`` are the way in."""
        self.port = port
        self._inbox = Inbox()
        self._connector = connector
        connector.incoming_messages = _Store(self._inbox)
        connector.outgoing_messages = collections.deque()
        connector.start()

    @classmethod
    def client(cls, host: str, port: int) -> PyigtlPeer:
        """A peer that connects to ``host:port``, again and again until a server listens there."""
        return cls(pyigtl.OpenIGTLinkClient(host, port, start_now=False), port)

    @classmethod
    def server(cls, port: int = 0) -> PyigtlPeer:
        """A peer that listens on 127.0.0.1, on any free port by default.  Call it from the main thread."""
        handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
        server = pyigtl.OpenIGTLinkServer(port, start_now=False)
        for number, handler in handlers.items():
            signal.signal(number, handler)
        return cls(server, server.server_address[1])

    @property
    def messages(self) -> list[Message]:
        """Everything received so far, in order."""
        return self._inbox.messages

    def send(self, type_name: str, device: str, content: Mapping[str, Any], sec: int = 0, frac: int = 0) -> None:
        """Queue one message with content as in the corpus; it goes out as soon as there is a connection.

        Raises:
            PeerError: pyigtl cannot encode it.
        """
        try:
            message = CODECS[type_name][0](content)
            message.device_name = device
            message.timestamp = sec + frac / 2**32
            message.pack()
        except (ValueError, IndexError, NotImplementedError) as error:
            raise PeerError(f"pyigtl cannot send this {type_name}: {error}") from error
        self._connector.send_message(message, wait=False)

    def receive(self, type_name: str | None = None, device: str | None = None, timeout_s: float = 10.0) -> Message:
        """Take the next message of that type and device; raises TimeoutError without one."""
        return self._inbox.receive(type_name, device, timeout_s)

    def close(self) -> None:
        """Stop its threads and close its sockets (up to half a second)."""
        self._connector.stop()

    def __enter__(self) -> PyigtlPeer:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


class _Store(dict[str, Any]):
    """Takes the place of pyigtl's "newest per device" dict; it only ever sets items."""

    def __init__(self, inbox: Inbox) -> None:
        super().__init__()
        self._inbox = inbox

    def __setitem__(self, device: str, message: Any) -> None:
        sec, rest = divmod(message.timestamp, 1.0)
        codec = CODECS.get(message.message_type)
        self._inbox.put(
            {
                "header_version": message.header_version,
                "type": message.message_type,
                "device_name": device,
                "timestamp": {"sec": int(sec), "frac": int(rest * 2**32)},
                "metadata": dict(message.metadata),
                "content": codec[1](message) if codec else {},
            }
        )


def _make_transform(content: Mapping[str, Any]) -> Any:
    return pyigtl.TransformMessage(np.asarray(content["matrix"]))


def _read_transform(message: Any) -> Message:
    return {"matrix": message.matrix.tolist()}


def _make_string(content: Mapping[str, Any]) -> Any:
    return pyigtl.StringMessage(content["string"])


def _read_string(message: Any) -> Message:
    return {"string": message.string}


def _make_point(content: Mapping[str, Any]) -> Any:
    def column(key: str) -> list[Any]:
        return [element[key] for element in content["elements"]]

    return pyigtl.PointMessage(
        positions=column("position"),
        names=column("name"),
        rgba_colors=column("rgba"),
        diameters=column("diameter"),
        groups=column("group"),
        owners=column("owner"),
    )


def _read_point(message: Any) -> Message:
    rows = zip(
        message.names,
        message.groups,
        message.rgba_colors,
        message.positions,
        message.diameters,
        message.owners,
        strict=True,
    )
    return {
        "elements": [
            {
                "name": name,
                "group": group,
                "rgba": list(rgba),
                "position": list(position),
                "diameter": diameter,
                "owner": owner,
            }
            for name, group, rgba, position, diameter, owner in rows
        ]
    }


def _make_image(content: Mapping[str, Any]) -> Any:
    size = content["dimensions"]
    if list(content.get("subvol_size", size)) != list(size):
        raise NotImplementedError("sub-volumes")
    if content.get("endian", LITTLE_ENDIAN) != LITTLE_ENDIAN:
        raise NotImplementedError("big-endian pixels")
    scalar = np.dtype("<" + SCALARS[content["scalar_type"]])
    data = content.get("data")
    if "data_hex" in content:
        data = bytes.fromhex(content["data_hex"])
    pixels = np.frombuffer(data, scalar) if isinstance(data, bytes) else np.asarray(data).astype(scalar)
    components = content.get("num_components", 1)
    message = pyigtl.ImageMessage(pixels.reshape([*reversed(size), *([components] if components > 1 else [])]))
    message.world_coordinate_system = "ras" if content.get("coordinate", RAS) == RAS else "lps"
    message.ijk_to_world_matrix = _moved(content["wire_matrix"], size, -0.5)
    return message


def _read_image(message: Any) -> Message:
    image = message.image
    size = [image.shape[2], image.shape[1], image.shape[0]]
    matrix = message.ijk_to_world_matrix
    wire_matrix = _moved(matrix[:3].T.ravel(), size, +0.5)[:3].T.ravel()
    scalar_type = next(number for number, name in SCALARS.items() if np.dtype(name) == image.dtype.newbyteorder("="))
    return {
        "num_components": image.shape[3] if image.ndim == 4 else 1,
        "scalar_type": scalar_type,
        "endian": BIG_ENDIAN if image.dtype.byteorder == ">" else LITTLE_ENDIAN,
        "coordinate": RAS if message.world_coordinate_system == "ras" else LPS,
        "dimensions": size,
        "wire_matrix": wire_matrix.astype(np.float32).tolist(),
        "data_size": image.nbytes,
        "data": image.ravel().tolist(),
        "data_hex": image.tobytes().hex(),
    }


def _moved(columns: Any, size: list[int], extents: float) -> np.ndarray[Any, np.dtype[np.float64]]:
    """4 × 4 of the columns T S N P, with P moved by ``extents`` of the volume (first to last voxel)."""
    matrix = np.eye(4)
    matrix[:3] = np.asarray(columns, dtype=np.float64).reshape(4, 3).T
    matrix[:3, 3] += matrix[:3, :3] @ (extents * (np.asarray(size) - 1))
    return matrix


#: How a type's content becomes pyigtl's message, and back.
CODECS: dict[str, tuple[Callable[[Mapping[str, Any]], Any], Callable[[Any], Message]]] = {
    "TRANSFORM": (_make_transform, _read_transform),
    "STRING": (_make_string, _read_string),
    "POINT": (_make_point, _read_point),
    "IMAGE": (_make_image, _read_image),
}
