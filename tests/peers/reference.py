"""The C++ peer on Debian's libopenigtlink (1.11), compiled once and driven through its pipes.

Quirks of that library that a test sees:

- It knows header version 1 only.  The peer program skips a version 2 message by its size and reports it
  with ``"skipped": true`` and without content, as it does for types that it does not decode.
- POSITION goes out in the 28-byte form only (encoding the short forms corrupts the library's heap).
- POLYDATA without points is not sent either: the library sends uninitialised memory with a right CRC.
- POLYDATA attributes other than point scalar, vector and normal (types 0, 1, 2) and tensors go out with 9
  components declared and 9·n floats: the data first, then whatever was in memory.  It reads 9·n floats of
  them too, whatever is declared, so a conforming one displaces those that follow; of cell scalars it loses
  the number of components (9).  Texture coordinates it does not know.
- An image's ``wire_matrix`` is sent with spacing 1, so it reaches the wire bit for bit; give ``matrix``
  (4 × 4, unit columns) and ``spacing`` instead to let the library multiply them.
- A text ends at its first NUL; names inside bodies are read up to one byte less than their field.
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
LITTLE_ENDIAN = 2


def available() -> str | None:
    """None if the peer can be compiled here, else what is missing (for ``pytest.skip``)."""
    if shutil.which("g++") is None:
        return "no C++ compiler: apt-get install g++"
    if not (INCLUDE / "igtlMessageBase.h").exists():
        return "no OpenIGTLink library: apt-get install libopenigtlink-dev"
    return None


def build(cache_dir: Path | None = None) -> Path:
    """The compiled peer; compiled on the first call for this source and these flags (about 3 s).

    Raises:
        PeerError: it does not compile; the text is the compiler's output.
    """
    directory = cache_dir or Path(tempfile.gettempdir()) / f"igtl-gateway-peers-{os.getuid()}"
    directory.mkdir(mode=0o700, parents=True, exist_ok=True)
    digest = hashlib.sha256(SOURCE.read_bytes() + repr(COMPILE + LINK).encode()).hexdigest()[:16]
    program = directory / f"igtl_peer-{digest}"
    if not program.exists():
        # under another name first: test processes may compile at the same time
        with tempfile.TemporaryDirectory(dir=directory) as scratch:
            fresh = Path(scratch) / "igtl_peer"
            command = ["g++", *COMPILE, "-o", str(fresh), str(SOURCE), *LINK]
            result = subprocess.run(command, capture_output=True, text=True, check=False)
            if result.returncode:
                raise PeerError(f"{' '.join(command)}:\n{result.stdout}{result.stderr}")
            fresh.replace(program)
    return program


class ReferencePeer:
    """One process of the C++ peer.

    Attributes:
        port: where a server listens, or where a client is connected to.
        events: what the program said beside messages (``connected``, ``disconnected`` …), in order.
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
        """A peer connected to ``host:port``; raises PeerError if nobody listens there."""
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


def _position(content: Mapping[str, Any]) -> list[str]:
    if content.get("pack", "all") != "all":
        raise ValueError(f"POSITION pack: found {content['pack']}, expected all (1.11 corrupts its heap otherwise)")
    return _numbers([*content["position"], *content["quaternion"]])


def _string(content: Mapping[str, Any]) -> list[str]:
    return [str(content.get("encoding", 3)), content.get("string_hex") or _text(content["string"])]


def _status(content: Mapping[str, Any]) -> list[str]:
    return [
        *_integers((content["code"], content.get("subcode", 0))),
        _text(content.get("error_name", "")),
        _text(content.get("status_string", "")),
    ]


def _point(content: Mapping[str, Any]) -> list[str]:
    words = [str(len(content["elements"]))]
    for element in content["elements"]:
        words += [_text(element["name"]), _text(element["group"]), *_integers(element["rgba"])]
        words += [*_numbers(element["position"]), *_numbers(element["diameter"]), _text(element["owner"])]
    return words


def _polydata(content: Mapping[str, Any]) -> list[str]:
    points = content.get("points", [])
    if not len(points):
        raise ValueError(
            "POLYDATA points: found none, expected one at least (1.11 sends uninitialised memory otherwise)"
        )
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


#: Content (with the corpus' keys) → words of the program's command, by type.
ENCODERS: dict[str, Callable[[Mapping[str, Any]], list[str]]] = {
    "TRANSFORM": _transform,
    "POSITION": _position,
    "STRING": _string,
    "STATUS": _status,
    "POINT": _point,
    "POLYDATA": _polydata,
    "IMAGE": _image,
}
