"""OpenIGTLink programs in a re-simulation: clients and servers, in lock-step over TCP.

Such a program was a peer of the gateway.  Its inputs are what the gateway sent to that peer (IGTL_OUT of a link of the
recording), its outputs what the peer sent (IGTL_IN).  The library that is preloaded gives it session time and reports
when all its threads wait; messages go through a TCP connection on the loopback interface.  `IgtlLink` stands between
both and the coordinator, for which this is a program with subscriptions and publishers.

The guarantee is weaker than that of ROS programs: a message counts as processed when its bytes have arrived in the
program, all its threads wait, and all that it has sent is here.
"""

from __future__ import annotations

import errno
import socket
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass

from igtl_gateway.addon import ConfigError, GatewayError, SystemClock
from igtl_gateway.addon.igtl import HEADER_SIZE, HEADER_VERSIONS, Framer, Header, crc64, visible
from igtl_gateway.addon.reading import Kind, Qos, SessionFile
from igtl_gateway.addons.resim import frames
from igtl_gateway.addons.resim.coordinator import ProgramFault
from igtl_gateway.addons.resim.frames import DEADLINE, NEVER, EntityFrame, Idle, Published
from igtl_gateway.addons.resim.inputs import RecordedTopic, input_name
from igtl_gateway.addons.resim.link import Link
from igtl_gateway.addons.resim.tcp_state import Connection

HOST = "127.0.0.1"
#: What a program may read to learn its address; in its command, ``{port}`` stands for the port.
HOST_VARIABLE, PORT_VARIABLE = "IGTL_HOST", "IGTL_PORT"
#: Has the library know that the program takes part from its first TCP socket on.
_JOIN_VARIABLE = "IGTL_GATEWAY_RESIM_SOCKETS"
WEAKER = "OpenIGTLink in lock-step by quiet sockets and threads, a weaker guarantee than that of ROS 2 programs"

_NO_LIBRARY = "it is linked statically, or LD_PRELOAD did not reach it"
#: Session time that a program has to connect, or to listen.
_CONNECT_NS = 1_000_000_000
#: Real time in which a client without the library may turn out to be one that has it.
_JOIN_NS = 2_000_000_000
#: Bytes that a blocked send leaves in the socket: when these are read, the program may go on.
_UNBLOCKS = 16_384
#: Messages of one event; more count as a flood.
_MOST_AT_ONCE = 20_000
_READ_BYTES = 1 << 18


@dataclass(frozen=True, slots=True)
class IgtlRole:
    """What an OpenIGTLink program is.

    Attributes:
        is_server: whether it listens; else it connects.
        port: where; 0: one that is free.
        link: whose peer of the recording it replaces; 0: of the only link.
    """

    is_server: bool = False
    port: int = 0
    link: int = 0


def check_role(port: str, link: str, role: IgtlRole) -> None:
    """Check the numbers of a role, whose places have these names.  Raises ConfigError."""
    if not 0 <= role.port < 1 << 16:
        raise ConfigError(f"{port}: found {role.port}, expected 0 to 65535")
    if role.link < 0:
        raise ConfigError(f"{link}: found {role.link}, expected 1 or more")


@dataclass(frozen=True, slots=True)
class RecordedLink:
    """A link of a recording: stream (``TYPE/device``) → messages, by direction as the gateway saw it."""

    number: int
    sent: Mapping[str, int]
    received: Mapping[str, int]

    def topics(self) -> dict[str, RecordedTopic]:
        """Its streams as topics: what went to the peer has the link before its name, what came from it has not."""
        inputs = [(input_name(self.number, stream), stream, count, 0) for stream, count in self.sent.items()]
        outputs = [(stream, stream, 0, count) for stream, count in self.received.items()]
        return {
            name: RecordedTopic(name, stream.partition("/")[0], Qos(), ours, others)
            for name, stream, ours, others in inputs + outputs
        }


def recorded_links(file: SessionFile) -> dict[int, RecordedLink]:
    """Return the links of a recording that have OpenIGTLink messages."""
    found: dict[int, tuple[dict[str, int], dict[str, int]]] = {}
    for entry in file.entries_of_kinds({Kind.IGTL_IN, Kind.IGTL_OUT}):
        if entry.kind in (Kind.IGTL_IN, Kind.IGTL_OUT) and entry.seq:
            for link in entry.links:
                counts = found.setdefault(link, ({}, {}))[entry.kind is Kind.IGTL_IN]
                counts[entry.channel] = counts.get(entry.channel, 0) + 1
    return {number: RecordedLink(number, *found[number]) for number in sorted(found)}


def link_of(role: IgtlRole, links: Mapping[int, RecordedLink], name: str) -> RecordedLink:
    """Return the link whose peer a program replaces.  Raises ConfigError."""
    if role.link in links:
        return links[role.link]
    known = ", ".join(str(number) for number in links) or "none"
    if role.link:
        raise ConfigError(f"{name}: found link {role.link}, expected one of the links with messages: {known}")
    if len(links) != 1:
        raise ConfigError(f"{name}: found no choice of a link, expected one of the links with messages: {known}")
    return next(iter(links.values()))


class IgtlSide:
    """The gateway's side of a program that is about to start: its port, and the environment that states it.

    Raises ConfigError where the port is in use.
    """

    def __init__(self, role: IgtlRole, name: str) -> None:
        self._role, self._name = role, name
        self._listener = socket.socket()
        self._clock = SystemClock()
        self._seen_ns = 0
        self._accepted: socket.socket | None = None
        if not role.is_server:
            self._listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            self._listener.bind((HOST, 0 if role.is_server else role.port))
        except OSError as error:
            raise ConfigError(f"{name}: found port {role.port}, expected a free one: {error.strerror}") from error
        free = int(self._listener.getsockname()[1])
        self.port = (role.port or free) if role.is_server else free
        if role.is_server:
            self._listener.close()
        else:
            self._listener.listen()
            self._listener.setblocking(False)

    def command(self, words: Sequence[str]) -> tuple[str, ...]:
        return tuple(word.replace("{port}", str(self.port)) for word in words)

    @property
    def environment(self) -> dict[str, str]:
        return {_JOIN_VARIABLE: "1", HOST_VARIABLE: HOST, PORT_VARIABLE: str(self.port)}

    def look(self) -> None:
        """Raise ProgramFault if the program has connected or listens, but the library in it has not connected."""
        if not (made := self.connect()):
            return
        if self._role.is_server:
            made.close()
        now_ns = self._clock.monotonic_ns()
        self._seen_ns = self._seen_ns or now_ns
        if now_ns - self._seen_ns > _JOIN_NS or self._role.is_server:
            what = "listens" if self._role.is_server else "connected"
            raise ProgramFault(f"{self._name}: {what} without session time: {_NO_LIBRARY}")

    def connect(self) -> socket.socket | None:
        """The connection; None if there is none yet."""
        if not self._role.is_server:
            return self._accept()
        made = socket.socket()
        try:
            made.connect((HOST, self.port))
        except OSError:
            made.close()
            return None
        return made

    def has_second(self) -> bool:
        """Whether a client has connected once more."""
        if self._role.is_server:
            return False
        with suppress(BlockingIOError):
            self._listener.accept()[0].close()
            return True
        return False

    def _accept(self) -> socket.socket | None:
        if not self._accepted:
            with suppress(BlockingIOError):
                self._accepted = self._listener.accept()[0]
        return self._accepted

    @property
    def missing(self) -> str:
        """What is wrong if there is no connection."""
        what = "did not listen at" if self._role.is_server else "did not connect to"
        return f"{self._name}: {what} {HOST}:{self.port} within {_CONNECT_NS / 1e9:g} s of session time"

    def close(self) -> None:
        self._listener.close()
        if self._accepted:
            self._accepted.close()


class IgtlLink:
    """One program for the coordinator, as `Link` is one: it takes and gives the same frames.

    Args:
        name: of the program, for messages.
        side: the gateway's side of it.
        library: the connection of the library in it.
        recorded: whose peer it replaces.
        start_ns: session time.
        on_remark: called with the name, and what the program does beside its messages.
    """

    def __init__(
        self,
        name: str,
        side: IgtlSide,
        library: Link,
        recorded: RecordedLink,
        start_ns: int,
        on_remark: Callable[[str, frames.Remark], None],
    ) -> None:
        self._name, self._side, self._library, self._recorded = name, side, library, recorded
        self._start_ns, self._now_ns, self._on_remark = start_ns, start_ns, on_remark
        self._socket: socket.socket | None = None
        self._connection: Connection | None = None
        self._idle = Idle(start_ns, NEVER, DEADLINE, 0)
        self._number = 0
        self._coming: deque[frames.Incoming] = deque()
        self._limit = (start_ns, -1)
        self._ready: deque[frames.FromProgram] = deque()
        self._rest = memoryview(b"")
        self._framer = Framer()
        self._publishers: dict[str, int] = {}
        self._has_closed = False

    # -- for the coordinator ------------------------------------------------------------------------------------------

    def send(self, data: bytes) -> None:
        """Take frames of the coordinator.  Raises Gone."""
        for frame in frames.split(data):
            match frame:
                case frames.Incoming():
                    self._coming.append(frame)
                case frames.RunTo():
                    self._limit = (frame.time_ns, frame.class_)
                case frames.Dropped():
                    self._coming.clear()
                case frames.Ended():
                    self._library.send(frames.end())

    def receive(self) -> frames.FromProgram:
        """Return the next frame for the coordinator.  Raises ProgramFault and Gone."""
        if not self._socket:
            self._begin()
        while not self._ready:
            self._advance()
        return self._ready.popleft()

    def rest(self) -> Iterator[frames.FromProgram]:
        """Yield what the program has sent before it ended, or came to no rest."""
        with suppress(ProgramFault):
            if self._socket:
                self._drain(self._now_ns)
        while self._ready:
            yield self._ready.popleft()

    def close(self) -> None:
        if self._socket:
            self._socket.close()
        if self._connection:
            self._connection.close()

    # -- events -------------------------------------------------------------------------------------------------------

    def _begin(self) -> None:
        """Wait until the program is connected and idle."""
        self._take_idle()
        while not (made := self._side.connect()):
            if self._idle.next_ns > self._start_ns + _CONNECT_NS:
                raise ProgramFault(self._side.missing)
            self._library.send(frames.run_to(self._idle.next_ns, self._idle.next_class))
            self._take_idle()
        made.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        made.setblocking(False)
        self._socket, self._connection = made, Connection(made)
        for stream in self._recorded.sent:
            self._announce("s", input_name(self._recorded.number, stream), stream)
        for stream in self._recorded.received:
            self._publisher(stream)
        self._settle(self._idle.time_ns)
        self._ready.append(self._rested())

    def _advance(self) -> None:
        """Let the next event within the limit happen, or rest."""
        own = (self._idle.next_ns, self._idle.next_class)
        message = self._coming[0] if self._coming else None
        if message and (message.time_ns, message.class_) <= min(own, self._limit):
            self._coming.popleft()
            time_ns, self._number = message.time_ns, message.number
            if time_ns > self._idle.time_ns:
                self._look(time_ns)  # the clock is right before the first byte arrives
            self._rest = memoryview(bytes(self._rest) + message.data)
            self._push()
            self._settle(time_ns)
        elif own <= self._limit and own[0] != NEVER:
            self._library.send(frames.run_to(*own))
            self._take_idle()
            self._settle(own[0], has_looked=True)
        else:
            self._ready.append(self._rested())

    def _rested(self) -> Idle:
        return Idle(self._idle.time_ns, self._idle.next_ns, self._idle.next_class, self._number)

    def _look(self, time_ns: int) -> None:
        """Have the library report when all threads wait."""
        self._library.send(frames.look(time_ns))
        self._take_idle()

    def _take_idle(self) -> None:
        """Wait for the library's report."""
        while True:
            frame = self._library.receive()
            if isinstance(frame, Idle):
                self._idle = frame
                return
            if isinstance(frame, frames.Remark):
                self._on_remark(self._name, frame)
            elif not isinstance(frame, frames.Progress):
                raise ProgramFault(f"{self._name}: takes part in ROS 2, too, expected an OpenIGTLink program")

    def _settle(self, time_ns: int, *, has_looked: bool = False) -> None:
        """Go on until nothing is under way in either direction and all threads wait; outputs get this time."""
        count = 0
        self._now_ns = time_ns
        while True:
            if not has_looked:
                self._await(arrived=True)
                self._look(time_ns)
            self._await(arrived=False)
            moved, messages = self._drain(time_ns)
            count += messages
            if count > _MOST_AT_ONCE:
                raise ProgramFault(
                    f"{self._name}: flooded the session with messages: found {count:,} in one event, "
                    f"expected at most {_MOST_AT_ONCE:,}"
                )
            if moved < _UNBLOCKS and not self._push():
                if not self._hangs():
                    break
                self._library.look()
            has_looked = False
        at = f"at {(time_ns - self._start_ns) / 1e9:.6f} s of the session"
        if self._has_closed:
            raise ProgramFault(f"{self._name}: closed its connection {at}", is_end=True)
        if self._side.has_second():
            raise ProgramFault(
                f"{self._name}: opened a second connection {at}, expected one: a program stands for one link (--link)"
            )

    def _hangs(self) -> bool:
        """Whether the program has read, waits for nothing that comes, and leaves what has arrived."""
        if self._idle.next_ns != NEVER or self._has_closed or not self._connection:
            return False
        return 0 < self._connection.unread() < self._connection.sent

    def _await(self, *, arrived: bool) -> None:
        """Wait until what was sent has arrived in the program, or what it has sent has arrived here."""
        if self._connection and not self._has_closed:
            self._connection.wait(arrived=arrived)

    # -- bytes --------------------------------------------------------------------------------------------------------

    def _push(self) -> int:
        """Send what is left to be sent, as far as the program takes it; the number of bytes."""
        assert self._socket and self._connection
        sent = 0
        while self._rest:
            try:
                count = self._socket.send(self._rest)
            except BlockingIOError:
                break
            except OSError:
                self._has_closed = True
                self._rest = memoryview(b"")
                break
            self._rest = self._rest[count:]
            sent += count
        self._connection.sent += sent
        return sent

    def _drain(self, time_ns: int) -> tuple[int, int]:
        """Read what has arrived; the number of bytes and of messages."""
        assert self._socket and self._connection
        size = count = 0
        while not self._has_closed and size < 1 << 26:
            try:
                data = self._socket.recv(_READ_BYTES)
            except BlockingIOError:
                break
            except OSError as error:
                if error.errno not in (errno.ECONNRESET, errno.EPIPE):
                    raise
                data = b""
            with suppress(OSError):
                self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_QUICKACK, 1)
            if not data:
                self._has_closed = True
                break
            size += len(data)
            self._connection.received += len(data)
            try:
                messages = self._framer.feed(data)
            except GatewayError as error:
                raise self._garbage(str(error), time_ns) from None
            if self._framer.pending >= HEADER_SIZE:
                self._check(self._framer.pending_head())
            for message in messages:
                self._output(bytes(message), time_ns)
            count += len(messages)
        return size, count

    def _output(self, data: bytes, time_ns: int) -> None:
        header = self._check(data)
        if (crc := crc64(data[HEADER_SIZE:])) != header.crc:
            raise self._garbage(f"{visible(header.type)}: found CRC {header.crc:016x}, expected {crc:016x}", time_ns)
        stream = f"{header.type}/{header.device_name}"
        self._ready.append(Published(self._publisher(stream), time_ns, data))

    def _check(self, data: bytes) -> Header:
        """Return the header at the start of a message.  Raises ProgramFault."""
        header = Header.unpack(data)
        if header.version not in HEADER_VERSIONS or not header.type or not header.type.isascii():
            raise self._garbage(
                f"header: found version {header.version} and type {visible(header.type)!r}, expected a known version "
                "and the name of a type",
                self._idle.time_ns,
            )
        return header

    def _garbage(self, what: str, time_ns: int) -> ProgramFault:
        at_s = (time_ns - self._start_ns) / 1e9
        return ProgramFault(f"{self._name}: sent what is no OpenIGTLink message at {at_s:.6f} s of the session: {what}")

    def _publisher(self, stream: str) -> int:
        if stream not in self._publishers:
            self._publishers[stream] = self._announce("p", stream, stream)
        return self._publishers[stream]

    def _announce(self, kind: str, name: str, stream: str) -> int:
        number = len(self._publishers) + 1 + (len(self._recorded.sent) if kind == "p" else 1_000_000)
        if kind == "s":
            number += list(self._recorded.sent).index(stream)
        is_reliable = kind == "p"
        type_ = stream.partition("/")[0]
        self._ready.append(EntityFrame(kind, True, number, is_reliable, False, True, 10, name, type_, self._name, ""))
        return number
