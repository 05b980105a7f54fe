"""The C++ peer on Debian's libopenigtlink (1.11), compiled once and driven through its pipes.

It sends and receives every type that the library has a class for (``ENCODERS``); ``LEFT_OUT`` names the
unusable classes.  Quirks of that library that a test sees beside those:

- It knows header version 1 only.  The peer program skips a version 2 message by its size and reports it
  with ``"skipped": true`` and without content, as it does for types that it does not decode.
- Reserved bytes (TDATA, QTDATA, TRAJ, IMGMETA, LBMETA) go out as they are in memory.  The peer program fills
  all memory with ``JUNK`` first: the worst case, and the same in every run.
- POLYDATA attributes other than point scalar, vector and normal (types 0, 1, 2) and tensors go out with 9
  components declared and 9·n floats: the data first, then whatever was in memory.  It reads 9·n floats of
  them too, whatever is declared, so a conforming one displaces those that follow; of cell scalars it loses
  the number of components (9).
- An image's ``wire_matrix`` is sent with spacing 1, so it reaches the wire bit for bit; give ``matrix``
  (4 × 4, unit columns) and ``spacing`` instead to let the library multiply them.
- A string ends at its first NUL; names inside bodies are read up to one byte less than their field.
- The scan time of IMGMETA passes through nanoseconds by an older rule than today's, see ``STAMP_NS``.
- Tracking types other than 1 to 4 arrive as 1, scalar types of IMGMETA that it does not know as 0.
- The table of names in its GET_BIND and STT_BIND is not padded to an even size.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import subprocess
import tempfile
import threading
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from types import TracebackType
from typing import IO, Any

import numpy as np

from tests.peers import Inbox, Message, PeerError

SOURCE = Path(__file__).with_name("igtl_peer.cpp")
INCLUDE = Path("/usr/include/openigtlink")
COMPILE = ("-std=c++17", "-O1", "-isystem", str(INCLUDE))
LINK = ("-pthread", "-lOpenIGTLink")

#: numpy's name of each scalar type of IMAGE.
SCALARS = {2: "i1", 3: "u1", 4: "i2", 5: "u2", 6: "i4", 7: "u4", 10: "f4", 11: "f8"}
#: Those of NDARRAY: complex numbers are listed as real, imaginary, real …
NDARRAY_SCALARS = SCALARS | {13: "f8"}
LITTLE_ENDIAN = 2
#: COLORT: entries of 16 bits (others are bytes).
MAP_UINT16 = 5

#: What stands in bytes that the library never writes.
JUNK = 0xA5
#: How far its conversion between ticks and nanoseconds is from today's library's at most (measured: 19 earlier on
#: reading, 22 later on writing).
STAMP_NS = 22

#: What 1.11 cannot do without harm: (type, direction) → case and reason.  Sending one raises ValueError.
LEFT_OUT = {
    ("POSITION", "send"): "the 12- and 24-byte forms: packing them corrupts the heap",
    ("POLYDATA", "send"): "no points: uninitialised memory goes out with a right CRC",
    ("SENSOR", "send"): "a status (there is no setter), or more than 255 values (the length wraps)",
    ("NDARRAY", "send"): "no dimension: it copies from a null pointer",
    ("NDARRAY", "receive"): "no dimension: it copies to a null pointer and ends",
    ("BIND", "send"): "no children (uninitialised memory goes out), or a name above 20 bytes (cut, its rest unwritten)",
    ("GET_BIND", "send"): "no children: 4 uninitialised bytes go out",
    ("GET_BIND", "receive"): "all: read by the layout of BIND, beyond the end",
    ("STT_BIND", "send"): "no children, or an interval: 8 uninitialised bytes go out in its place",
    ("STT_BIND", "receive"): "all: read by the layout of BIND, beyond the end",
    ("STT_TDATA", "receive"): "a name of all 32 bytes: read on beyond a buffer without NUL",
    ("STT_QTDATA", "receive"): "a name of all 32 bytes: read on beyond a buffer without NUL",
}


def available() -> str | None:
    """None if the peer can be compiled here, else what is missing (for ``pytest.skip``)."""
    if shutil.which("g++") is None:
        return "no C++ compiler: apt-get install g++"
    if not (INCLUDE / "igtlMessageBase.h").exists():
        return "no OpenIGTLink library: apt-get install libopenigtlink-dev"
    return None


def build(cache_dir: Path | None = None, source: Path = SOURCE) -> Path:
    """The compiled peer or other program; compiled on the first call for this source and these flags (about 3 s).

    Raises:
        PeerError: it does not compile; the text is the compiler's output.
    """
    directory = cache_dir or Path(tempfile.gettempdir()) / f"igtl-gateway-peers-{os.getuid()}"
    directory.mkdir(mode=0o700, parents=True, exist_ok=True)
    digest = hashlib.sha256(source.read_bytes() + repr(COMPILE + LINK).encode()).hexdigest()[:16]
    program = directory / f"{source.stem}-{digest}"
    if not program.exists():
        # under another name first: test processes may compile at the same time
        with tempfile.TemporaryDirectory(dir=directory) as scratch:
            fresh = Path(scratch) / source.stem
            command = ["g++", *COMPILE, "-o", str(fresh), str(source), *LINK]
            result = subprocess.run(command, capture_output=True, text=True, check=False)
            if result.returncode:
                raise PeerError(f"{' '.join(command)}:\n{result.stdout}{result.stderr}")
            fresh.replace(program)
    return program


class ReferencePeer:
    """One process of the C++ peer.

    Attributes:
        port: where a server listens, or where a client is connected to.
        events: what the program reported beside messages (``connected``, ``disconnected`` …), in order.
    """

    def __init__(self, *arguments: str) -> None:
        """Start the program; ``client`` and ``server`` are the way in."""
        self.port = 0
        self.events: list[dict[str, Any]] = []
        self._inbox = Inbox()
        self._is_client = arguments[0] == "client"
        self._stderr = tempfile.TemporaryFile()
        self._process = subprocess.Popen(
            [str(build()), *arguments], stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=self._stderr
        )
        assert self._process.stdin is not None and self._process.stdout is not None
        self._commands: IO[bytes] = self._process.stdin
        self._command_lock = threading.Lock()
        self._reader = threading.Thread(target=self._read, args=(self._process.stdout,), daemon=True)
        self._reader.start()

    @classmethod
    def client(cls, host: str, port: int, timeout_s: float = 10.0) -> ReferencePeer:
        """A peer connected to ``host:port``; raises PeerError if no server listens there."""
        return cls._started(timeout_s, "connected", "client", host, str(port))

    @classmethod
    def server(cls, port: int = 0, timeout_s: float = 10.0) -> ReferencePeer:
        """A listening peer, on any free port by default; it takes one client after the other."""
        return cls._started(timeout_s, "listening", "server", str(port))

    @classmethod
    def _started(cls, timeout_s: float, event: str, *arguments: str) -> ReferencePeer:
        peer = cls(*arguments)
        try:
            peer.wait_for_event(event, timeout_s=timeout_s)
        except BaseException:
            peer.close()
            raise
        peer.port = peer.events[0].get("port", int(arguments[-1]))
        return peer

    @property
    def messages(self) -> list[Message]:
        """Everything received so far, in order."""
        return self._inbox.messages

    def send(self, type_name: str, device: str, content: Mapping[str, Any], sec: int = 0, frac: int = 0) -> None:
        """Encode and send one message; waits for a connection, not for the bytes to be out.

        Args:
            type_name: one of ENCODERS.
            device: device name, at most 20 bytes.
            content: with the corpus' keys; IMAGE pixels as ``data`` (values or raw bytes) or ``data_hex``.
            sec, frac: the time stamp as on the wire (``frac`` in 2⁻³² s).

        Raises:
            ValueError: the library would spoil its memory on this (see the top of this file).
            PeerError, TimeoutError: there is no connection.  What the library refuses is raised by the next
                ``receive``.
        """
        words = [type_name, _text(device), str(sec), str(frac), *ENCODERS[type_name](content)]
        self.wait_connected()
        self._command(" ".join(words))

    def send_raw(self, data: bytes) -> None:
        """Send bytes as they are, in one write."""
        self.wait_connected()
        self._command(f"RAW {_text(data)}")

    def receive(self, type_name: str | None = None, device: str | None = None, timeout_s: float = 10.0) -> Message:
        """Take the next message of that type and device; raises TimeoutError or PeerError without one."""
        return self._inbox.receive(type_name, device, timeout_s)

    def wait_connected(self, timeout_s: float = 10.0) -> None:
        """Wait until there is a connection."""
        self._inbox.wait_until(lambda: self._link_events()[-1:] == ["connected"], "connected", timeout_s)

    def wait_for_event(self, event: str, count: int = 1, timeout_s: float = 10.0) -> dict[str, Any]:
        """The ``count``-th event of that name, waited for."""
        found: list[dict[str, Any]] = []

        def arrived() -> bool:
            found[:] = [entry for entry in self.events if entry["event"] == event]
            return len(found) >= count

        self._inbox.wait_until(arrived, event, timeout_s)
        return found[count - 1]

    def disconnect(self) -> None:
        """Close the present connection; a server goes on listening."""
        self._command("CLOSE")

    def close(self) -> None:
        """End the program."""
        try:
            with self._command_lock:
                self._commands.close()  # end of commands = quit
        except BrokenPipeError:
            pass  # it ended by itself
        try:
            self._process.wait(timeout=5)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._reader.join()
        self._stderr.close()

    def __enter__(self) -> ReferencePeer:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _command(self, line: str) -> None:
        with self._command_lock:
            self._commands.write(line.encode() + b"\n")
            self._commands.flush()

    def _link_events(self) -> list[str]:
        return [event["event"] for event in self.events if event["event"] in ("connected", "disconnected")]

    def _read(self, stdout: IO[bytes]) -> None:
        for line in stdout:
            entry = json.loads(line.decode(errors="surrogateescape"))
            if "event" not in entry:
                self._inbox.put(entry)
                continue
            self._inbox.changed(lambda entry=entry: self.events.append(entry))  # type: ignore[misc]
            if entry["event"] == "error" or (entry["event"] == "disconnected" and self._is_client):
                self._inbox.end(str(entry))
        stdout.close()
        code = self._process.wait()
        self._stderr.seek(0)
        self._inbox.end(f"igtl_peer ended with code {code}: {self._stderr.read().decode(errors='replace')[-2000:]}")


def _text(value: str | bytes) -> str:
    data = value.encode(errors="surrogateescape") if isinstance(value, str) else value
    return data.hex() or "-"


def _numbers(values: Any) -> list[str]:
    """Words of any nesting of numbers; a float's text reads back as the same float."""
    return [repr(value) for value in np.asarray(values, dtype=np.float64).ravel().tolist()]


def _integers(values: Iterable[int]) -> list[str]:
    return [str(int(value)) for value in values]


def _transform(content: Mapping[str, Any]) -> list[str]:
    return _numbers(content["matrix"][:3])


def _check(type_name: str, harmless: bool) -> None:
    """Raise ValueError for what the library would spoil its memory on."""
    if not harmless:
        raise ValueError(f"{type_name} is not sent with {LEFT_OUT[type_name, 'send']}")


def _position(content: Mapping[str, Any]) -> list[str]:
    _check("POSITION", content.get("pack", "all") == "all")
    return _numbers([*content["position"], *content["quaternion"]])


def _string(content: Mapping[str, Any]) -> list[str]:
    return [str(content.get("encoding", 3)), content.get("string_hex") or _text(content["string"])]


def _status(content: Mapping[str, Any]) -> list[str]:
    return [
        *_integers((content["code"], content.get("subcode", 0))),
        _text(content.get("error_name", "")),
        _text(content.get("status_string", "")),
    ]


def _texts(element: Mapping[str, Any], *keys: str) -> list[str]:
    return [_text(element[key]) for key in keys]


#: One element → words, by type of list.
ELEMENTS: dict[str, Callable[[Mapping[str, Any]], list[str]]] = {
    "POINT": lambda element: [
        *_texts(element, "name", "group"),
        *_integers(element["rgba"]),
        *_numbers([*element["position"], element["diameter"]]),
        *_texts(element, "owner"),
    ],
    "TRAJ": lambda element: [
        *_texts(element, "name", "group"),
        *_integers([element["type"], *element["rgba"]]),
        *_numbers([*element["entry"], *element["target"], element["diameter"]]),
        *_texts(element, "owner"),
    ],
    "TDATA": lambda element: [
        *_texts(element, "name"),
        *_integers([element["type"]]),
        *_numbers(element["matrix"][:3]),
    ],
    "QTDATA": lambda element: [
        *_texts(element, "name"),
        *_integers([element["type"]]),
        *_numbers([*element["position"], *element["quaternion"]]),
    ],
    "IMGMETA": lambda element: [
        *_texts(element, "name", "device_name", "modality", "patient_name", "patient_id"),
        *_integers([element["timestamp"]["sec"], element["timestamp"]["nanosec"]]),
        *_integers([*element["size"], element["scalar_type"]]),
    ],
    "LBMETA": lambda element: [
        *_texts(element, "name", "device_name"),
        *_integers([element["label"], *element["rgba"], *element["size"]]),
        *_texts(element, "owner"),
    ],
}


def _list(type_name: str) -> Callable[[Mapping[str, Any]], list[str]]:
    def encode(content: Mapping[str, Any]) -> list[str]:
        elements = content["elements"]
        return [str(len(elements)), *(word for element in elements for word in ELEMENTS[type_name](element))]

    return encode


def _sensor(content: Mapping[str, Any]) -> list[str]:
    """The unit is taken decoded: the library makes the word of it."""
    values, unit = content["values"], content["unit_decoded"]
    _check("SENSOR", content.get("status", 0) == 0 and len(values) < 256)
    pairs = [number for pair in unit["units"] for number in pair]
    return [*_integers([unit["prefix"], *pairs, len(values)]), *_numbers(values)]


def _ndarray(content: Mapping[str, Any]) -> list[str]:
    size, data = content["size"], content["data"]
    _check("NDARRAY", len(size) > 0)
    numbers = np.asarray(data, NDARRAY_SCALARS[content["scalar_type"]])
    return [*_integers([content["scalar_type"], len(size), *size]), _text(numbers.tobytes())]


def _colour_table(content: Mapping[str, Any]) -> list[str]:
    table = np.asarray(content["table"], np.uint16 if content["map_type"] == MAP_UINT16 else np.uint8)
    return [*_integers([content["index_type"], content["map_type"]]), _text(table.tobytes())]


def _capability(content: Mapping[str, Any]) -> list[str]:
    return [str(len(content["types"])), *map(_text, content["types"])]


def _start(content: Mapping[str, Any]) -> list[str]:
    return [*_integers([content["resolution"]]), *_texts(content, "coordinate_name")]


def _reply(content: Mapping[str, Any]) -> list[str]:
    return _integers([content["status"]])


def _nothing(_: Mapping[str, Any]) -> list[str]:
    return []


def _bind(content: Mapping[str, Any]) -> list[str]:
    children = content["children"]
    names = [child["name"].encode(errors="surrogateescape") for child in children]
    _check("BIND", len(children) > 0 and all(len(name) <= 20 for name in names))
    words = [str(len(children))]
    for child, name in zip(children, names, strict=True):
        words += [child["type"], _text(name), *ENCODERS[child["type"]](child["content"])]
    return words


def _bind_query(type_name: str) -> Callable[[Mapping[str, Any]], list[str]]:
    def encode(content: Mapping[str, Any]) -> list[str]:
        children = content["children"]
        _check(type_name, len(children) > 0)
        return [str(len(children)), *(word for child in children for word in (child["type"], _text(child["name"])))]

    return encode


def _polydata(content: Mapping[str, Any]) -> list[str]:
    points = content.get("points", [])
    _check("POLYDATA", len(points) > 0)
    words = [str(len(points)), *_numbers(points)]
    for section in ("vertices", "lines", "polygons", "triangle_strips"):
        cells = content.get(section, [])
        words.append(str(len(cells)))
        for cell in cells:
            words += _integers((len(cell), *cell))
    attributes = content.get("attributes", [])
    words.append(str(len(attributes)))
    for attribute in attributes:
        words += _integers((attribute["type"], attribute["ncomponents"], attribute["n"]))
        words += [_text(attribute["name"]), *_numbers(attribute["data"])]
    return words


def _image(content: Mapping[str, Any]) -> list[str]:
    dimensions = content["dimensions"]
    endian = content.get("endian", LITTLE_ENDIAN)
    if "wire_matrix" in content:
        spacing, columns = (1, 1, 1), content["wire_matrix"]
    else:
        spacing, columns = content["spacing"], np.asarray(content["matrix"])[:3].T
    data = content.get("data")
    if "data_hex" in content:
        pixels = bytes.fromhex(content["data_hex"])
    elif isinstance(data, bytes):
        pixels = data
    else:
        scalar = ("<" if endian == LITTLE_ENDIAN else ">") + SCALARS[content["scalar_type"]]
        pixels = np.asarray(data).astype(scalar).tobytes()
    return [
        *_integers(dimensions),
        *_numbers(spacing),
        *_integers((content["scalar_type"], content.get("num_components", 1), endian, content.get("coordinate", 1))),
        *_integers(content.get("subvol_offset", (0, 0, 0))),
        *_integers(content.get("subvol_size", dimensions)),
        *_numbers(columns),
        _text(pixels),
    ]


#: Queries that are a header only.
WITHOUT_CONTENT = (
    "GET_CAPABIL",
    "GET_COLORT",
    "GET_IMAGE",
    "GET_IMGMETA",
    "GET_LBMETA",
    "GET_POINT",
    "GET_POLYDATA",
    "GET_STATUS",
    "GET_TRAJ",
    "GET_TRANS",
    "STP_BIND",
    "STP_QTDATA",
    "STP_TDATA",
)

#: Content (with the corpus' keys) → words of the program's command, by type.
ENCODERS: dict[str, Callable[[Mapping[str, Any]], list[str]]] = {
    "TRANSFORM": _transform,
    "POSITION": _position,
    "STRING": _string,
    "STATUS": _status,
    "POLYDATA": _polydata,
    "IMAGE": _image,
    "SENSOR": _sensor,
    "NDARRAY": _ndarray,
    "COLORT": _colour_table,
    "CAPABILITY": _capability,
    "BIND": _bind,
    "GET_BIND": _bind_query("GET_BIND"),
    "STT_BIND": _bind_query("STT_BIND"),
    **{type_name: _list(type_name) for type_name in ELEMENTS},
    **dict.fromkeys(("STT_TDATA", "STT_QTDATA"), _start),
    **dict.fromkeys(("RTS_TDATA", "RTS_QTDATA", "RTS_BIND"), _reply),
    **dict.fromkeys(WITHOUT_CONTENT, _nothing),
}
