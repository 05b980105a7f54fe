"""The gateway on manual time: the very core that the bridge runs, fed by a test instead of by sockets and ROS.

No socket, no ROS and no clock: what comes out depends on what was fed alone, so that a test of it never waits and
never flickers.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from igtl_gateway import __version__
from igtl_gateway.buffers import Buffer, join
from igtl_gateway.config import Config
from igtl_gateway.convert.rosmsg import RosMessage
from igtl_gateway.gateway import LINK_DOWN, LINK_UP, TICK, Session, make_core
from igtl_gateway.globs import matches
from igtl_gateway.replay.source import select_entries
from igtl_gateway.session.entry import Entry, Kind
from igtl_gateway.session.note import Level, Note
from igtl_gateway.sessionfile.reader import SessionFile
from igtl_gateway.sessionfile.writer import SessionWriter
from igtl_gateway.stamp import NS_PER_S
from igtl_gateway.testing.rostypes import unpack
from igtl_gateway.wire import Message, decode, encode

#: When a session begins, unless told otherwise: 2026-01-01T00:00:00Z.
START_NS = 1_767_225_600_000_000_000

#: How soon a gateway that is still due is asked again, as the bridge does.
_TICK_NS = 50_000_000

_MESSAGES_IN = frozenset({Kind.IGTL_IN, Kind.ROS_IN})
_INPUTS = frozenset(kind for kind in Kind if kind.is_input)


@dataclass(frozen=True, slots=True)
class Sent:
    """An OpenIGTLink message that went out.

    Attributes:
        stream: ``TYPE/device``.
        data: all of its bytes.
        links: the peers that got it.
    """

    stream: str
    data: bytes
    links: tuple[int, ...]

    @property
    def message(self) -> Message:
        """Decoded, CRC checked.  Raises WireError."""
        return decode(self.data)


@dataclass(frozen=True, slots=True)
class Published:
    """A ROS message that was published; ``cdr`` is what ``rclpy.serialization.deserialize_message`` takes."""

    topic: str
    type: str
    cdr: bytes

    @property
    def message(self) -> Any:
        """Decoded, as a class of ``convert.rosmsg``, ``convert.common_msgs`` or ``convert.igtl_msgs``.

        Raises ConfigError for a type that the gateway does not know.
        """
        return unpack(self.type, self.cdr)


class Outputs:
    """What one or several inputs caused, in order; ``entries`` are the lines of the session log."""

    def __init__(self, entries: Iterable[Entry]) -> None:
        self.entries = [entry for entry in entries if not entry.kind.is_input]

    def igtl(self, stream: str = "**") -> list[Sent]:
        """The OpenIGTLink messages whose ``TYPE/device`` fits the glob, such as ``"TRANSFORM/*"``."""
        found = (entry for entry in self.entries if entry.kind is Kind.IGTL_OUT and matches(stream, entry.channel))
        return [Sent(entry.channel, entry.data(), entry.links) for entry in found]

    def ros(self, topic: str = "**") -> list[Published]:
        """The ROS messages whose topic fits the glob, such as ``"/igtl/in/**"``."""
        found = (entry for entry in self.entries if entry.kind is Kind.ROS_OUT and matches(topic, entry.channel))
        return [Published(entry.channel, entry.type, entry.data()) for entry in found]

    def notes(self, code: str = "**") -> list[Note]:
        """What the gateway had to say, such as ``"bad_crc"``."""
        notes = (Note.unpack(entry.data()) for entry in self.entries if entry.kind is Kind.NOTE)
        return [note for note in notes if matches(code, note.code)]


class ManualGateway:
    """A gateway whose inputs and time are the test's.

    Attributes:
        config: what it was made with.
        now_ns: its time, UTC nanoseconds; it stands still except for ``advance`` and ``play``.
        log: everything so far, inputs and outputs: a session as it would be recorded.

    Args:
        config: a ``Config``; or a path: of a configuration file, or of a recording (``.mcap``) for what was in force
            that day; or None for the default one.
        start_ns: the time at which it begins.
        settings: of ``[gateway]`` and rows, by name; they go before those of ``config``.

    Raises ConfigError for a setting that is wrong, UnsupportedRecording or DamagedRecording.
    """

    def __init__(self, config: Config | Path | str | None = None, *, start_ns: int = START_NS, **settings: Any) -> None:
        base = Config() if config is None else config_of(config)
        self.config = Config.from_dict(base.to_dict() | settings) if settings else base
        self.now_ns = start_ns
        self.log: list[Entry] = []
        self._gateway = make_core(self.config)
        self._session = Session(self._gateway)
        self._links = 0

    @property
    def outputs(self) -> Outputs:
        """Everything that it said so far."""
        return Outputs(self.log)

    def connect(self, **facts: Any) -> int:
        """A peer connects; gives the number of its link.  ``facts``: ``peer`` (its address), ``role`` …"""
        self._links += 1
        known = {"peer": f"127.0.0.1:{50_000 + self._links}", "local": "127.0.0.1:18944", "role": "server"}
        note = Note(Level.INFO, LINK_UP, "connected", data=known | facts)
        self._feed(Kind.LINK, (note.pack(),), links=(self._links,))
        return self._links

    def disconnect(self, link: int) -> Outputs:
        """A peer goes."""
        return self._feed(Kind.LINK, (Note(Level.INFO, LINK_DOWN, "disconnected").pack(),), links=(link,))

    def from_peer(self, message: Message | bytes, link: int | None = None) -> Outputs:
        """A peer sends one whole message; without ``link`` the one that connected last does (and connects, if none)."""
        if link is None:
            link = self._links or self.connect()
        data = message if isinstance(message, bytes) else join(encode(message))
        return self._feed(Kind.IGTL_IN, (data,), links=(link,))

    def from_ros(self, topic: str, message: RosMessage | bytes, ros_type: str = "", source_ns: int = 0) -> Outputs:
        """A ROS node publishes a message: a class of ``convert.rosmsg`` and its like, or CDR and the type's name.

        With rclpy, CDR is what ``rclpy.serialization.serialize_message`` gives.
        """
        if isinstance(message, bytes):
            return self._feed(Kind.ROS_IN, (message,), topic, ros_type, source_ns=source_ns)
        return self._feed(Kind.ROS_IN, (message.pack(),), topic, message.TYPE, source_ns=source_ns)

    def advance(self, seconds: float) -> Outputs:
        """Time passes: what waits for it (time-outs, pings) happens at its moment."""
        first, end_ns = len(self.log), self.now_ns + round(seconds * NS_PER_S)
        due_ns = self._gateway.due_ns
        while due_ns is not None and due_ns <= end_ns:
            self.now_ns = max(self.now_ns, due_ns)
            self._feed(Kind.EDGE_NOTE, (Note(Level.INFO, TICK, "a deadline has come").pack(),))
            before_ns, due_ns = due_ns, self._gateway.due_ns
            if due_ns is not None and due_ns <= before_ns:
                due_ns = self.now_ns + _TICK_NS
        self.now_ns = end_ns
        return Outputs(self.log[first:])

    def play(self, recording: Path | str, streams: Sequence[str] = ()) -> Outputs:
        """Feed the inputs of a recording at their moments; of messages only those of streams that fit a glob.

        Raises UnsupportedRecording or DamagedRecording.
        """
        first = len(self.log)
        with SessionFile.open(recording) as file:
            for entry in file.prologue():
                self._replay(entry)
            del self.log[first:]  # what was before: its state counts, its words were said that day
            wanted = {entry.seq for entry in select_entries(file.entries(), _MESSAGES_IN, streams)} if streams else None
            for entry in select_entries(file.entries(), _INPUTS):
                if wanted is not None and entry.kind in _MESSAGES_IN and entry.seq not in wanted:
                    continue
                self._replay(entry)
        return Outputs(self.log[first:])

    def _replay(self, entry: Entry) -> None:
        """Feed a recorded input."""
        self.now_ns = max(self.now_ns, entry.stamp_ns) if self.log else entry.stamp_ns
        self._links = max(self._links, *entry.links, 0)
        self._feed(entry.kind, entry.payload, entry.channel, entry.type, entry.links, entry.source_ns)

    def save(self, path: Path | str, *, overwrite: bool = False) -> None:
        """Write the log as a recording, to be replayed, verified or compared with.  Raises RecordingError."""
        session = {"igtl_gateway_version": __version__, "config": json.dumps(self.config.to_dict(), sort_keys=True)}
        writer = SessionWriter(
            Path(path),
            session,
            qos_of=lambda topic, ros_type: self._gateway.qos(topic) or self._gateway.subscription(topic, ros_type),
            compression="zstd",
            overwrite=overwrite,
        )
        for entry in self.log:
            writer.write(entry)
        writer.close({"streams": self._gateway.ledger.to_dict()})

    def _feed(
        self,
        kind: Kind,
        payload: Sequence[Buffer],
        channel: str = "",
        type_name: str = "",
        links: tuple[int, ...] = (),
        source_ns: int = 0,
    ) -> Outputs:
        entries = self._session.input(
            self.now_ns, kind, payload, channel=channel, type_name=type_name, links=links, source_ns=source_ns
        )
        self.log += [replace(entry, payload=(entry.data(),)) for entry in entries]
        return Outputs(entries)


def config_of(config: Config | Path | str) -> Config:
    """A configuration as it is, of a configuration file, or of a recording."""
    if isinstance(config, Config):
        return config
    path = Path(config)
    if path.suffix != ".mcap":
        return Config.from_toml(path)
    with SessionFile.open(path) as file:
        return recorded_config(file)


def recorded_config(file: SessionFile) -> Config:
    """The configuration that was in force; the default one where the recording tells none.  Raises ConfigError."""
    return Config.from_dict(json.loads(file.session.get("config", "{}")))
