"""The programs of an integration test: the gateway's command line, foreign ROS 2 nodes, a plain socket.

Each ROS test run has a domain of its own, away from those of ``conftest``: nodes of other tests must not be seen.
"""

from __future__ import annotations

import json
import os
import queue
import signal
import socket
import struct
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

from fastcrc import crc64

from tests import domains
from tests.places import ROOT

#: Far longer than anything takes here: reaching it is a failure, not a measurement.
TIMEOUT_S = 45.0
#: A start takes more computing than all else: a second, which is ten where twenty programs share two cores.
START_S = 60.0
HEADER_SIZE = 58

#: The second is for a bridge that must be alone with its nodes while another runs.
DOMAIN, SECOND_DOMAIN = domains.reserve(), domains.reserve()

Event = dict[str, Any]


def environment(**changes: str) -> dict[str, str]:
    """Of every program here."""
    return os.environ | {"PYTHONPATH": str(ROOT), "ROS_DOMAIN_ID": str(DOMAIN), "PYTHONUNBUFFERED": "1"} | changes


def children(process: int) -> list[int]:
    """The processes that it has started."""
    tasks = Path(f"/proc/{process}/task").iterdir()
    return [int(word) for task in tasks for word in (task / "children").read_text().split()]


@dataclass(frozen=True)
class Result:
    """How a program ended."""

    code: int
    out: str
    err: str


class Program:
    """A process whose lines are collected as they come."""

    def __init__(self, command: Sequence[str], env: dict[str, str] | None = None, stdin: int | None = None) -> None:
        self._stderr = tempfile.TemporaryFile()
        self.process = subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL if stdin is None else stdin,
            stdout=subprocess.PIPE,
            stderr=self._stderr,
            env=env or environment(),
            cwd=tempfile.gettempdir(),
        )
        self.lines: list[str] = []
        self._ended = False
        self._changed = threading.Condition()
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def take(self, line: str) -> None:
        """One line of standard output, in the reader's thread and under its lock."""
        self.lines.append(line)

    def wait_until(self, condition: Callable[[], bool], what: str, timeout_s: float = TIMEOUT_S) -> None:
        """Wait for something that follows from its lines; fails when it cannot come any more."""
        with self._changed:
            self._changed.wait_for(lambda: condition() or self._ended, timeout_s)
            if not condition():
                end = f"ended with {self.process.poll()}" if self._ended else f"not within {timeout_s} s"
                raise AssertionError(f"no {what}: {end}\n{self.said()}")

    def said(self) -> str:
        """The last of its output, for a failure's text."""
        return "\n".join(self.lines[-25:])[-6000:] + "\n--- stderr:\n" + self.stderr()[-4000:]

    def stderr(self) -> str:
        size = os.fstat(self._stderr.fileno()).st_size
        return os.pread(self._stderr.fileno(), size, 0).decode(errors="replace")

    def end(self, number: int | None = signal.SIGINT) -> Result:
        """Send a signal (None: it ends by itself) and wait for the end."""
        if number is not None and self.process.poll() is None:
            self.process.send_signal(number)
        try:
            code = self.process.wait(TIMEOUT_S)
        except subprocess.TimeoutExpired:
            raise AssertionError(f"does not end\n{self.said()}") from None
        self._reader.join()
        return Result(code, "".join(f"{line}\n" for line in self.lines), self.stderr())

    def close(self) -> None:
        """End it by all means."""
        if self.process.poll() is None:
            self.process.kill()
        self.process.wait()
        self._reader.join()
        self._stderr.close()

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            with self._changed:
                self.take(line.decode(errors="surrogateescape").rstrip("\n"))
                self._changed.notify_all()
        self.process.stdout.close()
        with self._changed:
            self._ended = True
            self._changed.notify_all()


def gateway(*arguments: str, **changes: str) -> Program:
    """The command line; ``changes`` are environment variables."""
    return Program([sys.executable, "-m", "igtl_gateway", *arguments], environment(**changes))


class Bridge(Program):
    """``igtl-gateway bridge --json`` on a free port, ready for peers.

    Attributes:
        events: the events that it reported, in order.
        port: where it listens; 0 without a server.
    """

    def __init__(self, *arguments: str, listen: bool = True, within: Sequence[str] = (), **changes: str) -> None:
        """``within``: a program that runs it, and its arguments."""
        self.events: list[Event] = []
        where = ["--listen", "127.0.0.1:0"] if listen else []
        command = [*within, sys.executable, "-m", "igtl_gateway", "bridge", "--json", *where, *arguments]
        super().__init__(command, environment(**changes))
        try:
            self.wait_until(lambda: bool(self.events), "start", START_S)
            (started,) = self.wait_events(lambda event: event["event"] == "started", "start")
        except BaseException:
            self.close()
            raise
        self.port: int = started["listen"][0]["port"] if listen else 0

    def take(self, line: str) -> None:
        super().take(line)
        self.events.append(json.loads(line))

    def wait_events(self, wanted: Callable[[Event], bool], what: str, count: int = 1) -> list[Event]:
        """The first ``count`` such events, waited for."""
        self.wait_until(lambda: sum(map(wanted, self.events)) >= count, what)
        return list(filter(wanted, self.events))[:count]

    def wait_code(self, code: str, count: int = 1, **fields: Any) -> Event:
        """The ``count``-th note with that code and these other fields."""

        def wanted(event: Event) -> bool:
            return event.get("code") == code and all(event[key] == value for key, value in fields.items())

        return self.wait_events(wanted, f"note {code} {fields}", count)[-1]

    def resident_bytes(self) -> int:
        """Its resident memory, without what it shares with files and other processes."""
        for line in Path(f"/proc/{self.process.pid}/status").read_text().splitlines():
            if line.startswith("RssAnon:"):
                return int(line.split()[1]) << 10
        raise AssertionError("no RssAnon")


class RosClient(Program):
    """A foreign ROS 2 node, see ``ros_client``; or another program with its commands, and the arguments of it."""

    def __init__(
        self,
        name: str,
        *,
        subscribe: dict[str, str] | None = None,
        advertise: dict[str, str] | None = None,
        domain: int = DOMAIN,
        within: Sequence[str] = (),
        program: Sequence[str] = ("ros_client.py",),
        **changes: str,
    ) -> None:
        """``subscribe`` and ``advertise``: type by topic, done when this returns; ``within`` as for ``Bridge``."""
        self._answers: queue.Queue[dict[str, Any]] = queue.Queue()
        self._pending: list[tuple[str, Any]] = []
        script, *arguments = program
        script = str(Path(__file__).parent / script)
        by = [sys.executable] if script.endswith(".py") else []
        env = environment(ROS_DOMAIN_ID=str(domain), **changes)
        super().__init__([*within, *by, script, *arguments, name], env, stdin=subprocess.PIPE)
        for topic, kind in (subscribe or {}).items():
            self.subscribe(topic, kind)
        for topic, kind in (advertise or {}).items():
            self.advertise(topic, kind)

    def take(self, line: str) -> None:
        if not line.startswith("{"):
            return super().take(line)  # Fast DDS writes its errors there, too
        value = json.loads(line)
        if "topic" in value:
            self._pending.append((value["topic"], value["message"]))
            return
        self._answers.put(value)

    def subscribe(self, topic: str, kind: str, **qos: Any) -> None:
        self._do("subscribe", topic, type=kind, **qos)

    def advertise(self, topic: str, kind: str, **qos: Any) -> None:
        self._do("advertise", topic, type=kind, **qos)

    def wait_readers(self, *topics: str, count: int = 1) -> None:
        """Wait until each publisher has the given number of subscribers."""
        for topic in topics:
            self._do("readers", topic, count=count)

    def publish(self, topic: str, fields: dict[str, Any]) -> None:
        self._do("publish", topic, fields=fields)

    def again(self, topic: str, sec: int) -> None:
        self._do("again", topic, sec=sec)

    def call(self, service: str, kind: str, fields: dict[str, Any]) -> None:
        """Call a service; the response is what ``receive`` gives for its name."""
        self._do("call", service, type=kind, fields=fields)

    def receive(self, topic: str) -> Any:
        """The next message of that topic."""
        self.wait_until(lambda: any(name == topic for name, _ in self._pending), f"message on {topic}")
        with self._changed:
            index = next(index for index, (name, _) in enumerate(self._pending) if name == topic)
            return self._pending.pop(index)[1]

    def received(self, topic: str) -> list[Any]:
        """All messages of that topic that were received and not asked for."""
        with self._changed:
            return [message for name, message in self._pending if name == topic]

    def waiting(self, topic: str) -> int:
        """Messages of that topic that were received and not asked for."""
        with self._changed:
            return sum(name == topic for name, _ in self._pending)

    def close(self) -> None:
        assert self.process.stdin is not None
        try:
            self.process.stdin.close()
            self.process.wait(5)
        except (BrokenPipeError, subprocess.TimeoutExpired):
            pass  # ended by force
        super().close()

    def __enter__(self) -> RosClient:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _do(self, name: str, topic: str, **arguments: Any) -> None:
        assert self.process.stdin is not None
        self.process.stdin.write(json.dumps({"do": name, "topic": topic, **arguments}).encode() + b"\n")
        self.process.stdin.flush()
        try:
            answer = self._answers.get(timeout=2 * TIMEOUT_S)
        except queue.Empty:
            raise AssertionError(f"{name} {topic}: no answer\n{self.stderr()[-4000:]}") from None
        if "failed" in answer:
            raise AssertionError(answer["failed"])


# ── a plain socket as a peer ───────────────────────────────────────────────────────────────────────────────────────


@dataclass(frozen=True)
class Wire:
    """A message, decoded from its bytes without any library; ``data`` is the whole message."""

    version: int
    type: str
    device: str
    body: bytes
    crc_ok: bool
    data: bytes


def header(type_name: str, size: int, crc: int, *, device: str = "Raw", version: int = 1, ticks: int = 0) -> bytes:
    return struct.pack(">H12s20sQQQ", version, type_name.encode(), device.encode(), ticks, size, crc)


def message(type_name: str, body: bytes, *, device: str = "Raw", version: int = 1) -> bytes:
    """A whole message with a right CRC."""
    return header(type_name, len(body), crc64.ecma_182(body), device=device, version=version) + body


def string(text: str, device: str = "Raw") -> bytes:
    """A STRING in US-ASCII."""
    return message("STRING", struct.pack(">HH", 3, len(text)) + text.encode(), device=device)


def extended(content: bytes, metadata: dict[str, str]) -> bytes:
    """The body of a version 2 message around its content."""
    items = [(key.encode(), value.encode()) for key, value in metadata.items()]
    index = struct.pack(">H", len(items)) + b"".join(struct.pack(">HHI", len(k), 3, len(v)) for k, v in items)
    data = b"".join(k + v for k, v in items)
    return struct.pack(">HHII", 12, len(index), len(data), 0) + content + index + data


def unextended(body: bytes) -> tuple[bytes, dict[str, str]]:
    """Content and metadata of a version 2 body; every size in it has to be right."""
    front, index_size, data_size, _ = struct.unpack_from(">HHII", body)
    assert front == 12
    index_at, at = len(body) - data_size - index_size, len(body) - data_size
    (count,) = struct.unpack_from(">H", body, index_at)
    assert index_size == 2 + 8 * count
    metadata = {}
    for item in range(count):
        key_size, _, value_size = struct.unpack_from(">HHI", body, index_at + 2 + 8 * item)
        key, value = body[at : at + key_size], body[at + key_size : at + key_size + value_size]
        metadata[key.decode()] = value.decode()
        at += key_size + value_size
    assert at == len(body)
    return body[front:index_at], metadata


class RawPeer:
    """A connection that sends any bytes and reads whole messages, only when asked to."""

    def __init__(self, port: int, receive_buffer: int | None = None) -> None:
        self.socket = socket.socket()
        self.socket.settimeout(TIMEOUT_S)
        if receive_buffer is not None:
            self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, receive_buffer)
        self.socket.connect(("127.0.0.1", port))
        self.name = "{}:{}".format(*self.socket.getsockname())

    def send(self, data: bytes) -> None:
        self.socket.sendall(data)

    def receive(self, device: str | None = None, type_name: str | None = None) -> Wire:
        """The next message, of that device and type if they are named."""
        while True:
            head = self._exactly(HEADER_SIZE)
            version, kind, name, _, size, crc = struct.unpack(">H12s20sQQQ", head)
            body = self._exactly(size)
            wire = Wire(version, _text(kind), _text(name), body, crc64.ecma_182(body) == crc, head + body)
            if device in (None, wire.device) and type_name in (None, wire.type):
                return wire

    def everything(self) -> bytes:
        """All that comes until the other side closes."""
        data = bytearray()
        while part := self.socket.recv(1 << 20):
            data += part
        return bytes(data)

    def closed_by_peer(self) -> bool:
        """Read until the other side closes; False if it does not."""
        try:
            while self.socket.recv(1 << 16):
                pass
        except ConnectionResetError:
            return True
        except TimeoutError:
            return False
        return True

    def close(self) -> None:
        self.socket.close()

    def __enter__(self) -> RawPeer:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _exactly(self, size: int) -> bytes:
        data = bytearray()
        while len(data) < size:
            part = self.socket.recv(min(size - len(data), 1 << 20))
            if not part:
                raise ConnectionError(f"closed after {len(data)} of {size} bytes")
            data += part
        return bytes(data)


def _text(field: bytes) -> str:
    return field.partition(b"\0")[0].decode()


def free_port() -> int:
    """A port on which no program listens at this moment."""
    with socket.create_server(("127.0.0.1", 0)) as sock:
        port: int = sock.getsockname()[1]
        return port


@contextmanager
def sending(port: int, data: Callable[[], bytes]) -> Iterator[None]:
    """A peer that sends what a function returns, at 20 Hz."""
    over = threading.Event()

    def send() -> None:
        with RawPeer(port) as peer, suppress(OSError):  # the bridge stops
            while not over.wait(0.05):
                peer.send(data())

    thread = threading.Thread(target=send)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()
