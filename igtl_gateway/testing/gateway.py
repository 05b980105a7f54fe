"""The gateway on manual time: the core of the bridge, with the inputs of a test instead of sockets and ROS.

There is no socket, no ROS and no clock.  The outputs depend only on the inputs, so tests never wait and are
reproducible.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from igtl_gateway.base.buffers import Buffer, join
from igtl_gateway.base.errors import ConfigError
from igtl_gateway.base.globs import matches
from igtl_gateway.base.near import unmatched, without_match
from igtl_gateway.base.stamp import NS_PER_S
from igtl_gateway.base.version import __version__
from igtl_gateway.config.configuration import Config
from igtl_gateway.convert.igtl_msgs import LinkStatusList, Metadata, RawMessage
from igtl_gateway.convert.rosmsg import RosMessage
from igtl_gateway.convert.table import TO_IGTL, TO_ROS
from igtl_gateway.gateway import LINK_DOWN, LINK_UP, TICK, Session, make_core
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.groups import input_groups
from igtl_gateway.gateway.log.note import Level, Note
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.record.sessionfile.whole_files import written
from igtl_gateway.record.sessionfile.writer import SessionWriter
from igtl_gateway.replay.source import is_stream_of, select_entries
from igtl_gateway.wire import Message, decode, encode

#: Default time at which a session begins: 2026-01-01T00:00:00Z.
START_NS = 1_767_225_600_000_000_000

#: Interval of ticks while the gateway stays due, as in the bridge.
_TICK_NS = 50_000_000

_MESSAGES_IN = frozenset({Kind.IGTL_IN, Kind.ROS_IN})
_INPUTS = frozenset(kind for kind in Kind if kind.is_input)


_ALL: list[type[RosMessage]] = [
    *(row.message for row in TO_ROS),
    *(row.message for row in TO_IGTL),
    LinkStatusList,
    Metadata,
    RawMessage,
]
#: The classes of all ROS types that the gateway receives or publishes, by the name of the type.
CLASSES = {kind.TYPE: kind for kind in _ALL}


def unpack(ros_type: str, cdr: Buffer) -> RosMessage:
    """Decode ``cdr``.  Raises ConfigError for a type that the gateway does not know."""
    kind = CLASSES.get(ros_type)
    if kind is None:
        raise ConfigError(f"found a message of type {ros_type}, expected one of {', '.join(sorted(CLASSES))}")
    return kind.unpack(cdr)


@dataclass(frozen=True, slots=True)
class Sent:
    """An OpenIGTLink message that the gateway sent.

    Attributes:
        stream: ``TYPE/device``.
        data: all of its bytes.
        links: the links that it was sent to.
    """

    stream: str
    data: bytes
    links: tuple[int, ...]

    @property
    def message(self) -> Message:
        """The decoded message; the CRC is checked.  Raises WireError."""
        return decode(self.data)


@dataclass(frozen=True, slots=True)
class Published:
    """A ROS message that the gateway published; ``rclpy.serialization.deserialize_message`` accepts ``cdr``."""

    topic: str
    type: str
    cdr: bytes

    @property
    def message(self) -> Any:
        """The decoded message, a class of ``convert.rosmsg``, ``convert.common_msgs`` or ``convert.igtl_msgs``.

        Raises ConfigError for a type that the gateway does not know.
        """
        return unpack(self.type, self.cdr)


class Outputs:
    """The outputs of one or several inputs, in order; ``entries`` are those of the session log."""

    def __init__(self, entries: Iterable[Entry]) -> None:
        self.entries = [entry for entry in entries if not entry.kind.is_input]

    def igtl(self, stream: str = "**") -> list[Sent]:
        """Return the OpenIGTLink messages whose ``TYPE/device`` matches the glob, such as ``"TRANSFORM/*"``."""
        found = (entry for entry in self.entries if entry.kind is Kind.IGTL_OUT and matches(stream, entry.channel))
        return [Sent(entry.channel, entry.data(), entry.links) for entry in found]

    def ros(self, topic: str = "**") -> list[Published]:
        """Return the ROS messages whose topic matches the glob, such as ``"/igtl/in/**"``."""
        found = (entry for entry in self.entries if entry.kind is Kind.ROS_OUT and matches(topic, entry.channel))
        return [Published(entry.channel, entry.type, entry.data()) for entry in found]

    def notes(self, code: str = "**") -> list[Note]:
        """Return the notes whose code matches the glob, such as ``"bad_crc"``."""
        notes = (Note.unpack(entry.data()) for entry in self.entries if entry.kind is Kind.NOTE)
        return [note for note in notes if matches(code, note.code)]


class ManualGateway:
    """A gateway whose inputs and time come from a test.

    Attributes:
        config: the configuration in use.
        now_ns: gateway time, UTC nanoseconds; only ``advance`` and ``play`` change it.
        log: all inputs and outputs: the session as it would be recorded.

    Args:
        config: a ``Config``; or the path of a configuration file; or the path of a recording (``.mcap``), for the
            recorded configuration; or None for the default configuration.
        start_ns: gateway time at the beginning, UTC.
        settings: of ``[gateway]`` and rows, by name; they override those of ``config``.

    Raises ConfigError for an invalid setting, UnsupportedRecording or DamagedRecording.
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
        """All outputs since the beginning."""
        return Outputs(self.log)

    def connect(self, **facts: Any) -> int:
        """Connect a peer and return the number of its link.  ``facts``: ``peer`` (its address), ``role`` …"""
        self._links += 1
        known = {"peer": f"127.0.0.1:{50_000 + self._links}", "local": "127.0.0.1:18944", "role": "server"}
        note = Note(Level.INFO, LINK_UP, "connected", data=known | facts)
        self._feed(Kind.LINK, (note.pack(),), links=(self._links,))
        return self._links

    def disconnect(self, link: int) -> Outputs:
        """Disconnect a peer."""
        return self._feed(Kind.LINK, (Note(Level.INFO, LINK_DOWN, "disconnected").pack(),), links=(link,))

    def from_peer(self, message: Message | bytes, link: int | None = None) -> Outputs:
        """Feed a complete message of a peer; by default of the last connected peer, which is connected if necessary."""
        if link is None:
            link = self._links or self.connect()
        data = message if isinstance(message, bytes) else join(encode(message))
        return self._feed(Kind.IGTL_IN, (data,), links=(link,))

    def from_ros(self, topic: str, message: RosMessage | bytes, ros_type: str = "", source_ns: int = 0) -> Outputs:
        """Feed a message of a ROS node: an object such as those of ``convert.rosmsg``, or CDR and the name of the type.

        With rclpy, ``rclpy.serialization.serialize_message`` returns CDR.
        """
        if isinstance(message, bytes):
            return self._feed(Kind.ROS_IN, (message,), topic, ros_type, source_ns=source_ns)
        return self._feed(Kind.ROS_IN, (message.pack(),), topic, message.TYPE, source_ns=source_ns)

    def advance(self, seconds: float) -> Outputs:
        """Advance the gateway time; timeouts and pings occur when they are due."""
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
        """Feed the inputs of a recording at their times; of messages only those of streams that match a glob.

        Raises UnsupportedRecording or DamagedRecording; ConfigError for a glob that matches no recorded input.
        """
        first = len(self.log)
        with SessionFile.open(recording) as file:
            wanted = _wanted(file, streams) if streams else None
            for group in input_groups(file.prologue()):
                with self._session.judged(group.outputs):
                    self._replay(group.input)
            del self.log[first:]  # the prologue only sets the state; its outputs belong to the original session
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
        """Write the log as a recording, for replay, verification or comparison.  Raises ConfigError, GatewayError."""
        session = {"igtl_gateway_version": __version__, "config": json.dumps(self.config.to_dict(), sort_keys=True)}
        with written(Path(path), overwrite=overwrite) as place:
            writer = SessionWriter(
                place,
                session,
                qos_of=lambda topic, ros_type: self._gateway.qos(topic) or self._gateway.subscription(topic, ros_type),
                compression="zstd",
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


def _wanted(file: SessionFile, streams: Sequence[str]) -> set[int]:
    """Return the numbers of the input messages of some streams.  Raises ConfigError."""
    names: set[str] = set()
    numbers: set[int] = set()
    for entry in select_entries(file.entries(), _MESSAGES_IN):
        names.add(entry.channel)
        if is_stream_of(entry.kind, entry.channel, streams):
            numbers.add(entry.seq)
    if wrong := [f"{glob}: {unmatched(glob, names, 'recorded input')}" for glob in without_match(streams, names)]:
        raise ConfigError(f"streams: {'; '.join(wrong)}")
    return numbers


def config_of(config: Config | Path | str) -> Config:
    """Return the given configuration, or that of a configuration file or of a recording.  Raises ConfigError."""
    if isinstance(config, Config):
        return config
    path = Path(config)
    if path.suffix != ".mcap":
        return Config.from_toml(path)
    with SessionFile.open(path) as file:
        return recorded_config(file)


def recorded_config(file: SessionFile) -> Config:
    """Return the recorded configuration; the default one if the recording has none.  Raises ConfigError."""
    return Config.from_dict(json.loads(file.session.get("config", "{}")))
