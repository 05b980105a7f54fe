"""A recording as a peer: it serves, or connects to, the program under test and says what was said that day."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from itertools import chain
from pathlib import Path
from types import TracebackType
from typing import Literal

from igtl_gateway.app.faulty import DISCONNECT, FaultyFeed, disconnector
from igtl_gateway.buffers import Buffer
from igtl_gateway.clock import SystemClock
from igtl_gateway.config import Config
from igtl_gateway.edges.tcp import TcpEdge
from igtl_gateway.errors import ConfigError, WireError
from igtl_gateway.faults import Faults
from igtl_gateway.replay.source import first_form_only, one_side_of_relay, select_entries, through_gateway
from igtl_gateway.session.entry import Entry, Kind
from igtl_gateway.session.note import Level, Note
from igtl_gateway.sessionfile.reader import SessionFile
from igtl_gateway.stamp import NS_PER_S
from igtl_gateway.testing.gateway import config_of, recorded_config
from igtl_gateway.wire import Header, Message, decode, encode

#: Far longer than anything takes: reaching it is a failure of the program under test.
TIMEOUT_S = 20.0

Side = Literal["gateway", "peers"]


class ReplayPeer:
    """An OpenIGTLink peer that plays a recording; a context manager.

    Attributes:
        host, port: where it listens, or where it connects to.
        received: what the program under test sent, decoded, in order.
        notes: what happened besides: links, and messages that could not be decoded.
        sent: messages played so far.
        faults: what ``fault`` did so far, by its name.

    Args:
        recording: a recording of ours, or an MCAP file of ROS messages alone, which go through the gateway.
        streams: globs of what is played: ``TYPE/device`` or the device name; all if none.
        rate: recorded seconds per second; None: as fast as the program reads.
        header: 1 or 2: header version of all messages; None: as recorded.
        side: ``"gateway"``: play what was sent to the peers of that day, ``"peers"``: what they sent.  Of a recording
            of ``bridge --relay`` the words of the server are played, and to ``connect`` those of the client.
        config: of a recording without OpenIGTLink messages, instead of the recorded one: a ``Config`` or a file.
        connect: (host, port) to connect to, again and again until it is there; None: serve at a free port.
        fault, seed: play it over a bad line: ``"loss=1%,corrupt=0.5%"``, as ``igtl-gateway replay --fault --seed``.

    Raises UnsupportedRecording, DamagedRecording or ConfigError.
    """

    def __init__(
        self,
        recording: Path | str,
        *,
        streams: Sequence[str] = (),
        rate: float | None = None,
        header: Literal[1, 2] | None = None,
        side: Side = "gateway",
        config: Config | Path | str | None = None,
        connect: tuple[str, int] | None = None,
        fault: str = "",
        seed: int = 0,
    ) -> None:
        if rate is not None and not 0 < rate < float("inf"):
            raise ConfigError(f"rate: found {rate}, expected a number above 0, or None")
        self.received: list[Message] = []
        self.notes: list[Note] = []
        self.sent = 0
        self._faulty = FaultyFeed(Faults.parse(fault, "fault"), seed)
        self.faults = self._faulty.counts
        self._streams, self._rate, self._header, self._side = tuple(streams), rate, header, side
        self._role = "client" if connect else "server"
        self._changed = threading.Condition()
        self._stop = threading.Event()
        self._player: threading.Thread | None = None
        self._playing = self._played = False
        self._failure: Exception | None = None
        self._clock = SystemClock()
        self._file = SessionFile.open(recording)
        try:
            self._config = recorded_config(self._file) if config is None else config_of(config)
            self._edge = TcpEdge(
                on_frame=self._on_frame,
                on_link=lambda _link, _up, note: self._on_note(0, note),
                on_note=self._on_note,
                clock=self._clock,
                when_full="block",
            )
            if connect:
                self.host, self.port = connect
                self._edge.connect(*connect)
            else:
                self.host, self.port = self._edge.listen("127.0.0.1", 0)
        except BaseException:
            self._file.close()
            raise
        self._edge.start()

    def wait_connected(self, count: int = 1, timeout_s: float = TIMEOUT_S) -> None:
        """Wait until so many programs are connected.  Raises TimeoutError."""
        if not self._edge.wait_links(count, timeout_s):
            raise TimeoutError(f"not {count} connected with {self.host}:{self.port} within {timeout_s:g} s")

    def play(self) -> None:
        """Begin to play, to all that are connected; again, from the start, when it was done."""
        with self._changed:
            if self._playing:
                raise RuntimeError("it plays already; wait_done() first")
            self._playing, self._played, self._failure, self.sent = True, False, None, 0
        self._player = threading.Thread(target=self._play, name="igtl-replay", daemon=True)
        self._player.start()

    @property
    def done(self) -> bool:
        """Whether all was sent."""
        return self._played

    def wait_done(self, timeout_s: float = TIMEOUT_S) -> None:
        """Wait until all was sent.  Raises TimeoutError, or what was found wrong with the recording."""
        self._wait(lambda: not self._playing, f"all played ({self.sent} messages so far)", timeout_s)
        if self._failure:
            raise self._failure

    def wait_received(self, count: int = 1, type_name: str = "", timeout_s: float = TIMEOUT_S) -> list[Message]:
        """The first ``count`` messages (of that type) from the program, waited for.  Raises TimeoutError."""

        def found() -> list[Message]:
            return [message for message in self.received if type_name in ("", message.type)]

        self._wait(lambda: len(found()) >= count, f"{count} messages {type_name}".rstrip(), timeout_s)
        return found()[:count]

    def close(self) -> None:
        """Disconnect; may be called twice."""
        self._stop.set()
        self._edge.stop()
        if self._player:
            self._player.join()
        self._file.close()

    def __enter__(self) -> ReplayPeer:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    def _wait(self, condition: Callable[[], bool], what: str, timeout_s: float) -> None:
        with self._changed:
            if not self._changed.wait_for(condition, timeout_s):
                told = "; ".join(note.text for note in self.notes[-5:])
                raise TimeoutError(f"not {what} within {timeout_s:g} s.  What happened last: {told or 'nothing'}")

    # ── the player's thread ─────────────────────────────────────────────────────────────────────────────────────

    def _play(self) -> None:
        try:
            self._send_all()
        except Exception as error:  # of the recording: raised where the test waits
            self._failure = error
        with self._changed:
            self._playing, self._played = False, self._failure is None and not self._stop.is_set()
            self._changed.notify_all()

    def _send_all(self) -> None:
        origin: tuple[int, int] | None = None
        disconnect = disconnector(self._edge, self._stop)
        for entry in self._faulty(self._formed(entry) for entry in self._entries()):
            if self._rate is not None:
                origin = origin or (entry.stamp_ns, self._clock.monotonic_ns())
                due_ns = origin[1] + round((entry.stamp_ns - origin[0]) / self._rate)
                self._stop.wait(max(0, due_ns - self._clock.monotonic_ns()) / NS_PER_S)
            if self._stop.is_set():
                return
            links = [link.number for link in self._edge.links() if link.connected]
            self._edge.send(links, entry.payload, entry.channel, True)
            self.sent += 1
            if entry.links == DISCONNECT:
                disconnect()
        self._edge.flush(TIMEOUT_S)

    def _entries(self) -> Iterator[Entry]:
        """What is played, in order."""
        present = {channel.kind for channel in self._file.channels if channel.count}
        entries: Iterable[Entry] = chain(self._file.prologue(), self._file.entries())
        if self._side == "peers":
            return select_entries(self._file.entries(), frozenset({Kind.IGTL_IN}), self._streams)
        if self._config.relay:
            entries = one_side_of_relay(self._role, entries)
        elif Kind.IGTL_OUT not in present:
            entries = through_gateway(entries, self._config, has_links=Kind.LINK in present)
        outputs = select_entries(
            entries if self._config.relay else first_form_only(entries), frozenset({Kind.IGTL_OUT}), self._streams
        )
        return (entry for entry in outputs if entry.stamp_ns >= self._file.start_ns)  # not those of its prologue

    def _formed(self, entry: Entry) -> Entry:
        """In the header version asked for; what cannot be decoded goes as it is."""
        if self._header is None:
            return entry
        data = entry.data()
        try:
            if self._header == Header.unpack(data).version:
                return entry
            message = decode(data)
        except WireError:
            return entry
        return replace(entry, payload=encode(replace(message, header_version=self._header, layout=None)))

    # ── the edge's thread ───────────────────────────────────────────────────────────────────────────────────────

    def _on_frame(self, _link: int, data: Buffer) -> None:
        try:
            message = decode(data)
        except WireError as error:
            self._on_note(0, Note(Level.ERROR, error.code, f"the program sent a message that is wrong: {error}"))
            return
        with self._changed:
            self.received.append(message)
            self._changed.notify_all()

    def _on_note(self, _link: int, note: Note) -> None:
        with self._changed:
            self.notes.append(note)
            self._changed.notify_all()
