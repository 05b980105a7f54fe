"""Programs on other implementations of OpenIGTLink as peers, with the interface of ``tests.peers``.

Each program of ``programs/`` uses the library of others that it is named after, and speaks the same lines.  It is
called with ``client HOST PORT`` or ``server PORT``, and prints ``ready``.  A line on its standard input is a message to
send: type, device, stamp (UTC ns; 0: none), then the words of the content; text has ``=`` before it and is quoted as in
a URL.  A line on its standard output is a message that it has read: type, device, seconds and fraction of the stamp,
header version, and the words of the content; or ``error`` and its reason.

Strategy: what leads from a content to words and back is one row for each type here, so that a program has only calls of
its library.
"""

from __future__ import annotations

import subprocess
import threading
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from types import TracebackType
from typing import Any
from urllib.parse import quote, unquote

from tests.integration.bridge import free_port
from tests.peers import Inbox, Message, PeerError
from tests.peers.reference import SCALARS

Words = list[str]
_START_S = 20.0


class LinePeer:
    """A program of ``programs/`` that runs.

    Attributes:
        port: where a server listens, or where a client connects to.
    """

    def __init__(self, command: Sequence[str], role: str, port: int) -> None:
        self.port = port
        self._inbox = Inbox()
        self._ready = threading.Event()
        words = [*command, role, *(["127.0.0.1"] if role == "client" else []), str(port)]
        self._process = subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        threading.Thread(target=self._read, daemon=True).start()
        if not self._ready.wait(_START_S):
            self.close()
            raise PeerError(f"{words}: not ready within {_START_S} s")

    def send(self, type_name: str, device: str, content: Mapping[str, Any], sec: int = 0, frac: int = 0) -> None:
        """Have one message sent.  Raises PeerError for a type without words."""
        if type_name not in CODECS:
            raise PeerError(f"no words for {type_name}")
        stamp_ns = sec * 10**9 + (frac * 10**9 >> 32)
        self.write([type_name, _quoted(device), str(stamp_ns), *CODECS[type_name][0](content)])

    def write(self, words: Sequence[str]) -> None:
        """Have a message with these words sent."""
        assert self._process.stdin
        self._process.stdin.write(" ".join(words) + "\n")
        self._process.stdin.flush()

    def receive(self, type_name: str | None = None, device: str | None = None, timeout_s: float = 10.0) -> Message:
        """Take the next message of that type and device; raises TimeoutError without one."""
        return self._inbox.receive(type_name, device, timeout_s)

    def forget(self) -> None:
        """Forget what has arrived, and no one asked for."""
        with suppress(TimeoutError):
            while True:
                self._inbox.receive(None, None, 0.2)

    def close(self) -> None:
        """End the program."""
        with suppress(OSError):
            self._process.kill()
        self._process.wait()

    def __enter__(self) -> LinePeer:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _read(self) -> None:
        assert self._process.stdout
        for line in self._process.stdout:
            kind, *words = line.split() or [""]
            if kind == "ready":
                self._ready.set()
            elif kind == "error":
                text = unquote(words[0][1:])
                self._inbox.put({"type": "error", "device_name": "", "text": text, "content": {}})
            elif len(words) >= 4:
                device, sec, frac, version, *rest = words
                codec = CODECS.get(kind)
                try:
                    content = codec[1](rest) if codec else {}
                except (ValueError, IndexError, TypeError):
                    content = {"words": " ".join(rest)}
                self._inbox.put(
                    {
                        "header_version": int(version),
                        "type": kind,
                        "device_name": unquote(device[1:]),
                        "timestamp": {"sec": int(float(sec)), "frac": int(float(frac))},
                        "content": content,
                    }
                )
        self._inbox.end("the program has ended")


class Implementation:
    """What starts the peers of one implementation.

    Args:
        command: of its program, without the role.
    """

    def __init__(self, command: Sequence[str]) -> None:
        self._command = command

    def client(self, host: str, port: int) -> LinePeer:
        assert host == "127.0.0.1"
        return LinePeer(self._command, "client", port)

    def server(self) -> LinePeer:
        return LinePeer(self._command, "server", free_port())


# -- contents ⇄ words -------------------------------------------------------------------------------------------------


def _quoted(text: str) -> str:
    return "=" + quote(text, safe="")


def _numbers(values: Any) -> Words:
    return [repr(float(value)) for value in values]


def _columns(matrix: Any) -> Words:
    return _numbers(matrix[row][column] for column in range(4) for row in range(3))


def _matrix(words: Words) -> list[list[float]]:
    values = [float(word) for word in words[:12]]
    return [[values[3 * column + row] for column in range(4)] for row in range(3)] + [[0.0, 0.0, 0.0, 1.0]]


def _image(content: Mapping[str, Any]) -> Words:
    head = [*content["dimensions"], content["scalar_type"], content["num_components"]]
    head += [content["endian"], content["coordinate"]]
    return [*map(str, head), *_numbers(content["wire_matrix"]), "=" + str(content["data_hex"])]


def _read_image(words: Words) -> Message:
    size = [int(float(word)) for word in words[:3]]
    scalar, components, endian, coordinate = (int(float(word)) for word in words[3:7])
    data = bytes.fromhex(words[-1][1:])
    found = {"dimensions": size, "scalar_type": scalar, "num_components": components, "endian": endian}
    return found | {
        "coordinate": coordinate,
        "wire_matrix": [float(word) for word in words[7:19]],
        "data_hex": data.hex(),
        "data": list(data) if SCALARS.get(scalar) == "u1" else [],
    }


def _points(content: Mapping[str, Any]) -> Words:
    words: Words = []
    for one in content["elements"]:
        words += [_quoted(one["name"]), _quoted(one["group"]), *map(str, one["rgba"]), *_numbers(one["position"])]
        words += [*_numbers([one["diameter"]]), _quoted(one["owner"])]
    return words


def _read_points(words: Words) -> Message:
    values = [float(word) for word in words[1:]]
    return {"elements": [{"position": values[at : at + 3]} for at in range(0, 3 * int(words[0]), 3)]}


def _tools(content: Mapping[str, Any]) -> Words:
    words: Words = []
    for one in content["elements"]:
        words += [_quoted(one["name"]), str(one["type"]), *_columns(one["matrix"])]
    return words


def _read_tools(words: Words) -> Message:
    rows = [words[at : at + 14] for at in range(0, len(words), 14)]
    return {
        "elements": [{"name": unquote(row[0][1:]), "type": int(row[1]), "matrix": _matrix(row[2:])} for row in rows]
    }


def _read_status(words: Words) -> Message:
    code, subcode, name, text = words
    named = {"error_name": unquote(name[1:]), "status_string": unquote(text[1:])}
    return {"code": int(code), "subcode": int(subcode), **named}


def _status(content: Mapping[str, Any]) -> Words:
    texts = (content["error_name"], content["status_string"])
    return [str(content["code"]), str(content["subcode"]), *map(_quoted, texts)]


#: Type → what makes words of its content, and a content of words.
CODECS: dict[str, tuple[Callable[[Mapping[str, Any]], Words], Callable[[Words], Message]]] = {
    "TRANSFORM": (lambda content: _columns(content["matrix"]), lambda words: {"matrix": _matrix(words)}),
    "POSITION": (
        lambda content: _numbers([*content["position"], *content["quaternion"]]),
        lambda words: {"position": [*map(float, words[:3])], "quaternion": [*map(float, words[3:7])]},
    ),
    "STRING": (
        lambda content: [_quoted(content["string"])],
        lambda words: {"string": unquote(words[0][1:]) if words else ""},
    ),
    "STATUS": (_status, _read_status),
    "IMAGE": (_image, _read_image),
    "POINT": (_points, _read_points),
    "TDATA": (_tools, _read_tools),
    "SENSOR": (
        lambda content: ["0", *_numbers(content["values"])],
        lambda words: {"values": [float(word) for word in words]},
    ),
    "NDARRAY": (
        lambda content: [str(content["scalar_type"]), str(len(content["size"])), *_numbers(content["data"])],
        lambda words: {"data": [float(word) for word in words]},
    ),
    "CAPABILITY": (
        lambda content: [*map(_quoted, content["types"])],
        lambda words: {"types": [unquote(word[1:]) for word in words]},
    ),
}
