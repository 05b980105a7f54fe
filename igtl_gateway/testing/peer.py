"""A recording as a peer: it listens for the program under test, or connects to it, and sends recorded messages."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import Literal

from igtl_gateway.app.faulty import DISCONNECT, FaultyFeed, disconnector
from igtl_gateway.app.replay_listeners import accepted_by_all
from igtl_gateway.app.replay_plan import check_streams, plan_replay, planned_entries, unplayed
from igtl_gateway.app.replay_settings import Side
from igtl_gateway.base.buffers import Buffer
from igtl_gateway.base.clock import SystemClock
from igtl_gateway.base.errors import ConfigError, WireError
from igtl_gateway.base.quantities import counted
from igtl_gateway.base.stamp import NS_PER_S
from igtl_gateway.config.configuration import Config
from igtl_gateway.config.faults import Faults
from igtl_gateway.edges.tcp import TcpEdge
from igtl_gateway.gateway.log.entry import Entry
from igtl_gateway.gateway.log.note import Level, Note
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.replay.recorded_config import recorded_acceptance
from igtl_gateway.testing.gateway import config_of, recorded_config
from igtl_gateway.wire import Header, Message, decode, encode
from igtl_gateway.wire.header import READING

#: Default timeout, far longer than any expected delay: reaching it is a failure of the program under test.
TIMEOUT_S = 20.0


class ReplayPeer:
    """An OpenIGTLink peer that plays a recording; a context manager.

    Attributes:
        host, port: the address that it listens on or connects to.
        received: decoded messages of the program under test, in order.
        notes: link events, and messages that could not be decoded.
        sent: number of messages that were sent.
        faults: number of applied faults, by name.

    Args:
        recording: a session file; or an MCAP file with ROS messages only, which the gateway converts.
        streams: globs of the streams to play, ``TYPE/device`` or the device name; all by default.  Each has to match
            a stream.
        rate: recorded seconds per second; None: as fast as the program reads.
        header: header version of all messages, 1 or 2; None: as recorded.
        side: ``"gateway"``: play the messages that the gateway sent to peers; ``"peers"``: play those that the peers
            sent; ``"both"``; by default those of the gateway, or those of the peers if the gateway sent only queries,
            answers and pings.  Of a recording of ``bridge --relay`` the messages of the server are played, or with
            ``connect`` those of the client.
        config: configuration for a recording without OpenIGTLink messages, instead of the recorded one: a ``Config``
            or a file.
        connect: (host, port) to connect to, with retries until there is a server; None: listen on a free port.
        fault, seed: fault injection such as ``"loss=1%,corrupt=0.5%"``, as ``igtl-gateway replay --fault --seed``.

    Raises UnsupportedRecording, DamagedRecording or ConfigError.
    """

    def __init__(
        self,
        recording: Path | str,
        *,
        streams: Sequence[str] = (),
        rate: float | None = None,
        header: Literal[1, 2] | None = None,
        side: Side = "",
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
        self.faults, self._has_faults = self._faulty.counts, bool(fault)
        self._streams, self._rate, self._header = tuple(streams), rate, header
        self._role = "client" if connect else "server"
        self._changed = threading.Condition()
        self._stop = threading.Event()
        self._player: threading.Thread | None = None
        self._playing = self._played = False
        self._failure: Exception | None = None
        self._clock = SystemClock()
        self._file = SessionFile.open(recording)
        try:
            self._acceptance = recorded_acceptance(self._file)
            self._config = recorded_config(self._file) if config is None else config_of(config)
            self._plan = plan_replay(self._file, "igtl", recompute=False, side=side)
            if faults := check_streams(self._file, self._config, self._plan, self._streams, "streams"):
                raise ConfigError(f"streams: {'; '.join(faults)}")
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
        """Wait until ``count`` programs are connected.  Raises TimeoutError."""
        if not self._edge.wait_links(count, timeout_s):
            raise TimeoutError(
                f"{self.host}:{self.port}: not {count} program{'s' * (count != 1)} connected within {timeout_s:g} s"
            )

    def play(self) -> None:
        """Start to play to all connected programs; after the end of a playback, start again from the beginning."""
        with self._changed:
            if self._playing:
                raise RuntimeError("found a playback in progress, expected none; call wait_done() first")
            self._playing, self._played, self._failure, self.sent = True, False, None, 0
        self._player = threading.Thread(target=self._play, name="igtl-replay", daemon=True)
        self._player.start()

    @property
    def done(self) -> bool:
        """Whether all messages were sent."""
        return self._played

    def wait_done(self, timeout_s: float = TIMEOUT_S) -> None:
        """Wait until all messages are sent.  Raises TimeoutError, or the error of the recording."""
        self._wait(lambda: not self._playing, f"all messages sent ({self.sent} so far)", timeout_s)
        if self._failure:
            raise self._failure

    def wait_received(self, count: int = 1, type_name: str = "", timeout_s: float = TIMEOUT_S) -> list[Message]:
        """Wait for ``count`` messages (of this type) from the program, and return them.  Raises TimeoutError."""

        def found() -> list[Message]:
            return [message for message in self.received if type_name in ("", message.type)]

        self._wait(
            lambda: len(found()) >= count, f"{counted(count, 'message')} {type_name}".rstrip() + " received", timeout_s
        )
        return found()[:count]

    def close(self) -> None:
        """Disconnect; may be called more than once."""
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

    def _wait(self, condition: Callable[[], bool], state: str, timeout_s: float) -> None:
        with self._changed:
            if not self._changed.wait_for(condition, timeout_s):
                notes = "; ".join(note.text for note in self.notes[-5:])
                raise TimeoutError(f"not {state} within {timeout_s:g} s; last notes: {notes or 'none'}")

    # ── the player's thread ─────────────────────────────────────────────────────────────────────────────────────

    def _play(self) -> None:
        try:
            self._send_all()
        except Exception as error:  # of the recording: wait_done() raises it in the thread of the test
            self._failure = error
        with self._changed:
            self._playing, self._played = False, self._failure is None and not self._stop.is_set()
            self._changed.notify_all()

    def _send_all(self) -> None:
        origin: tuple[int, int] | None = None
        played: set[str] = set()
        disconnect = disconnector(self._edge, self._stop)
        for entry in self._faulty(self._with_header_version(entry) for entry in self._entries()):
            if self._rate is not None:
                origin = origin or (entry.stamp_ns, self._clock.monotonic_ns())
                due_ns = origin[1] + round((entry.stamp_ns - origin[0]) / self._rate)
                self._stop.wait(max(0, due_ns - self._clock.monotonic_ns()) / NS_PER_S)
            if self._stop.is_set():
                return
            links = [link.number for link in self._edge.links() if link.connected]
            self._edge.send(links, entry.payload, entry.channel, True)
            self.sent += 1
            played.add(entry.channel)
            if entry.links == DISCONNECT:
                disconnect()
        self._edge.flush(TIMEOUT_S)
        if not self._has_faults and (faults := unplayed(self._streams, played)):
            raise ConfigError(f"streams: {'; '.join(faults)}")

    def _entries(self) -> Iterator[Entry]:
        """Return the messages to play, in order."""
        start_ns = self._file.start_ns  # without the messages of the prologue
        planned = planned_entries(self._file, self._config, self._plan, self._streams, role=self._role)
        return (entry for entry in planned if entry.stamp_ns >= start_ns)

    def _with_header_version(self, entry: Entry) -> Entry:
        """Return the message with the requested header version; unchanged if it cannot be decoded.

        A wrong checksum that the session accepted is corrected.
        """
        if not self._acceptance.check_crc:
            entry = replace(entry, payload=accepted_by_all(entry.payload, self._acceptance))
        if self._header is None:
            return entry
        data = entry.data()
        try:
            if self._header == Header.unpack(data).version:
                return entry
            message = self._acceptance.message(data)
        except WireError:
            return entry
        return replace(entry, payload=encode(replace(message, header_version=self._header, layout=None)))

    # ── the edge's thread ───────────────────────────────────────────────────────────────────────────────────────

    def _on_frame(self, _link: int, data: Buffer) -> None:
        try:
            message = decode(data, reading=READING)
        except WireError as error:
            self._on_note(0, Note(Level.ERROR, error.code, f"the program sent an invalid message: {error}"))
            return
        with self._changed:
            self.received.append(message)
            self._changed.notify_all()

    def _on_note(self, _link: int, note: Note) -> None:
        with self._changed:
            self.notes.append(note)
            self._changed.notify_all()
