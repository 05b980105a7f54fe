"""The cache of compiled streams: which streams are compiled, when they are compiled, and when they are dropped."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any

from igtl_gateway.base.buffers import Buffer
from igtl_gateway.base.errors import ConversionError
from igtl_gateway.config.configuration import Config
from igtl_gateway.gateway.fastpath import compile_to_igtl, compile_to_ros
from igtl_gateway.gateway.fastpath.common import CompileContext, Key, NativeStreams, ToIgtlKey, ToRosKey
from igtl_gateway.gateway.fastpath.compiled_to_igtl import CompiledToIgtl
from igtl_gateway.gateway.fastpath.compiled_to_ros import CompiledToRos
from igtl_gateway.gateway.fastpath.metadata import Blocks, to_ros_key
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.ledger import Ledger
from igtl_gateway.gateway.outcome import Outcome
from igtl_gateway.gateway.peers import Peers
from igtl_gateway.gateway.streams import Streams
from igtl_gateway.gateway.to_igtl.beforehand import RosBeforehand, RosResults
from igtl_gateway.gateway.to_igtl.origin import IgtlOrigin
from igtl_gateway.gateway.to_ros.beforehand import Beforehand, Results
from igtl_gateway.gateway.to_ros.route import RosOrigin
from igtl_gateway.gateway.to_ros.subscribers import Subscribers
from igtl_gateway.gateway.to_ros.volumes import Volumes
from igtl_gateway.wire.cost import AT_ONCE_NS, cost_ns
from igtl_gateway.wire.header import HEADER_SIZE

#: Maximum number of compiled streams in each direction; further streams take the full path.
MAX_STREAMS = 4_096

#: Streams that are compiled from their first message; further ones of peers from their second: a peer that invents
#: names would have each of them compiled, which takes a third of the time of its message, and kept.
MOST_AT_ONCE = 64

#: Number of times that a stream is compiled until its peer changes, or, if it goes to the peers, any of them does:
#: one whose messages never fit keeps the full path.
MAX_COMPILED = 8

#: Messages of a peer that a compiled stream has passed, from which on its compilation does not count: a landmark that
#: is added changes the next messages, too.
WORTH = 16

#: Size of messages, and number of streams to peers, that are compiled again at once when the peers change.
_LARGEST_LEARNED = 32 << 10
_MOST_LEARNED = 32

#: Messages of compiled streams are converted before they have a number from this size on: then small ones do not wait.
LARGE_BYTES = 64 << 10

#: A compiled stream, and what it has converted a message to; or what is done beforehand for the full path.
Prepared = tuple[CompiledToIgtl | CompiledToRos, Any] | Results | RosResults

#: See ``FastPath.prepare``.
PrepareMessage = Callable[[Kind, Buffer, str, str, tuple[int, ...], int], Prepared | None]

#: Entry number, gateway time (UTC ns), kind, payload, channel, type, links, source stamp and the result of ``prepare``
#: of an input → its entry and the entries that it causes; nothing if the input must take the full path.
FastHandler = Callable[
    [int, int, Kind, Sequence[Buffer], str, str, tuple[int, ...], int, Prepared | None], list[Entry] | None
]


class FastPath:
    """The cache of compiled streams.

    Args:
        latest: topic → its latest message.
        enabled: compile streams; False: every message takes the full path.

    Attributes:
        native: the native passage, with a copy of some compiled streams; None: there is none.
    """

    def __init__(
        self,
        config: Config,
        ledger: Ledger,
        peers: Peers,
        streams: Streams,
        subscribers: Subscribers,
        volumes: Volumes,
        latest: dict[str, Entry],
        beforehand: Beforehand,
        ros_beforehand: RosBeforehand,
        *,
        enabled: bool,
    ) -> None:
        self.to_ros: dict[ToRosKey, CompiledToRos] = {}
        self.to_igtl: dict[ToIgtlKey, CompiledToIgtl] = {}
        self.native: NativeStreams | None = None
        self._compiled: dict[Key, int] = {}  # number of times
        self._blocks = Blocks(MAX_STREAMS)
        # what small streams to peers were compiled from, and those that are to be compiled again
        self._learned: dict[Key, tuple[Entry, IgtlOrigin]] = {}
        self._outdated: list[ToIgtlKey] = []
        self._common = CompileContext(config, ledger, streams.qos, streams.advertise, subscribers.waiting)
        self._peers = peers
        self._subscribers = subscribers
        self._volumes = volumes
        self._latest = latest
        self._beforehand = beforehand
        self._ros_beforehand = ros_beforehand
        self._frames_go_out = bool(config.tf_out)
        self._enabled = enabled
        peers.changed = self._peer_changed

    def take(
        self,
        seq: int,
        stamp_ns: int,
        kind: Kind,
        payload: Sequence[Buffer],
        channel: str,
        type_name: str,
        links: tuple[int, ...],
        source_ns: int,
        prepared: Prepared | None = None,
    ) -> list[Entry] | None:
        """Return the entries of the compiled stream, if there is one that fits the message; see ``FastHandler``."""
        entries: list[Entry] | None = None
        native = self.native
        stream, made = (None, None) if prepared is None else self._ready(prepared)
        if kind is Kind.ROS_IN:
            topic_key = (channel, type_name)
            if to_igtl := self.to_igtl.get(topic_key):
                if native:
                    native.collect(topic_key, to_igtl)
                if not isinstance(prepared, RosResults):  # else it was found not to fit
                    ready = made if stream is to_igtl else None
                    entries = to_igtl(seq, stamp_ns, payload, channel, type_name, source_ns, ready)
                if entries is None:
                    self._drop(self.to_igtl, topic_key)
                elif native and entries:
                    native.handled(topic_key, to_igtl)
        elif kind is Kind.IGTL_IN:
            device_key = to_ros_key(links[0], payload[0])
            if to_ros := self.to_ros.get(device_key):
                if native:
                    native.collect(device_key, to_ros)
                ask = self._subscribers.ask
                if isinstance(prepared, Results):
                    entries = to_ros.left(payload, ask)
                else:
                    entries = to_ros(seq, stamp_ns, payload, links, ask, made if stream is to_ros else None)
                if entries is None:
                    self._drop_device(device_key, to_ros)
                elif native and entries:
                    native.handled(device_key, to_ros)
        if native and not entries:
            native.collect_all()
        return entries

    def _ready(self, prepared: Prepared) -> tuple[Any, Any]:
        """Have what was prepared for the full path there; return what was prepared for a compiled stream."""
        if isinstance(prepared, tuple):
            return prepared
        if isinstance(prepared, Results):
            self._beforehand.results = prepared
        else:
            self._ros_beforehand.results = prepared
        return None, None

    def prepare(
        self,
        kind: Kind,
        payload: Buffer,
        channel: str,
        type_name: str,
        links: tuple[int, ...],
        source_ns: int,
    ) -> Prepared | None:
        """Convert a message without the sequence lock, from any thread; None if nothing is gained by that.

        The result is for ``take``, which uses it if the stream is the same then.
        """
        is_large = len(payload) >= LARGE_BYTES or (kind is Kind.IGTL_IN and cost_ns(payload) >= AT_ONCE_NS)
        made: tuple[Any, ...] | bool
        if kind is Kind.ROS_IN:
            to_igtl = self.to_igtl.get((channel, type_name))
            made = to_igtl is None or (is_large and to_igtl.prepare((payload,), source_ns))
            if to_igtl and isinstance(made, tuple):
                return to_igtl, made
            if made:
                with suppress(Exception):  # the full path meets it as well, and notes it
                    return self._ros_beforehand.work(channel, type_name, payload)
        elif kind is Kind.IGTL_IN and len(payload) >= HEADER_SIZE:
            to_ros = self.to_ros.get(to_ros_key(links[0], payload))
            made = to_ros is None or (is_large and to_ros.prepare((payload,), self._subscribers.ask))
            if to_ros and isinstance(made, tuple):
                return to_ros, made
            if made:
                with suppress(Exception):  # the full path meets it as well, and notes it
                    return self._beforehand.work(payload, links[0])
        return None

    def collect(self) -> None:
        """Take over what the native passage has counted."""
        if self.native:
            self.native.collect_all()

    def receivers(self) -> dict[str, int]:
        """Return stream to peers → peers that get each message, of compiled streams; callable from any thread."""
        found: dict[str, int] = {}
        for stream in list(self.to_igtl.values()):
            mine: dict[str, int] = {}
            for output, links, _ in stream.outputs:  # one for each version of the header
                mine[output.channel] = mine.get(output.channel, 0) + links
            found |= mine
        return found

    def end_full_path(self) -> None:
        """Compile again what the input has made outdated, and inform the native passage of it."""
        self._beforehand.results = None
        self._ros_beforehand.results = None
        for key in self._outdated:
            self._compile_again(key)
        self._outdated.clear()
        if self.native:
            self.native.handled_in_full()

    def _compile_again(self, key: ToIgtlKey) -> None:
        """Compile a stream for the peers as they are now, from the message from which it was compiled before."""
        entry, origin = self._learned.pop(key)
        with suppress(ConversionError):
            self._learn_to_igtl(entry, origin)
        if self.native:
            self.native.replace(key, self.to_igtl.get(key))

    def _drop(self, streams: dict[Any, Any], key: Key) -> None:
        del streams[key]
        self._learned.pop(key, None)
        if self.native:
            self.native.drop(key)

    def _drop_device(self, key: ToRosKey, stream: CompiledToRos) -> None:
        if stream.passed >= WORTH:
            self._compiled[key] = self._compiled.get(key, 1) - 1
        self._drop(self.to_ros, key)

    def drop_misfit(self, entry: Entry) -> None:
        """Drop the compiled stream of a recorded input that does not fit it, as `take` does."""
        if entry.kind is Kind.ROS_IN:
            if (topic := (entry.channel, entry.type)) in self.to_igtl:
                self._drop(self.to_igtl, topic)
        elif stream := self.to_ros.get(key := to_ros_key(entry.links[0], entry.payload[0])):
            if stream.left(entry.payload, None) is None:
                self._drop_device(key, stream)

    def offer(self, entry: Entry) -> None:
        """Let the native passage copy the compiled stream of a recorded input that took the full path."""
        if self.native is None:
            return
        if entry.kind is Kind.ROS_IN:
            topic = entry.channel, entry.type
            if to_igtl := self.to_igtl.get(topic):
                self.native.handled(topic, to_igtl)
        elif entry.kind is Kind.IGTL_IN and entry.links and entry.size >= HEADER_SIZE:
            key = to_ros_key(entry.links[0], entry.payload[0])
            if to_ros := self.to_ros.get(key):
                self.native.handled(key, to_ros)

    def learn(self, entry: Entry, outcome: Outcome) -> None:
        """Compile the stream of a message that took the full path, if possible."""
        if not self._enabled or not outcome.is_good:
            return
        try:
            if entry.kind is Kind.IGTL_IN:
                self._learn_to_ros(entry, outcome.origin)
            else:
                self._learn_to_igtl(entry, outcome.origin)
        except ConversionError:  # an output without a subscriber, which the full path has not converted
            return

    def _learn_to_ros(self, entry: Entry, origin: RosOrigin) -> None:
        key = to_ros_key(entry.links[0], entry.payload[0])
        plain = entry.type in compile_to_ros.TYPES and not self._frames_go_out
        if plain and compile_to_ros.may_repeat(origin.to.warnings) and self._admits(key) and self._comes_again(key):
            assembler, peer = self._volumes.get(origin.to.device_name), self._peers.get(entry.links[0])
            frames = peer.frames if peer else None
            compiled = compile_to_ros.compile_to_ros(entry, origin, self._common, assembler, frames, self._beforehand)
            self._store(self.to_ros, key, compiled)

    def _learn_to_igtl(self, entry: Entry, origin: IgtlOrigin) -> None:
        key = (entry.channel, entry.type)
        if entry.type in compile_to_igtl.TYPES and self._may_compile(key):
            peers = tuple(self._peers.all())
            compiled = compile_to_igtl.compile_to_igtl(entry, origin, self._common, self._latest, peers)
            self._store(self.to_igtl, key, compiled)
            if compiled and entry.size <= _LARGEST_LEARNED and len(self._learned) < _MOST_LEARNED:
                self._learned[key] = entry, origin

    def _admits(self, key: ToRosKey) -> bool:
        """Return whether a stream may be compiled with its metadata; an older one of its device is dropped for it."""
        if not self._blocks.admits(key):
            return False
        if oldest := self._blocks.add(key):
            self._compiled.pop(oldest, None)
            if oldest in self.to_ros:
                self._drop(self.to_ros, oldest)
        return True

    def _comes_again(self, key: Key) -> bool:
        """Return whether a stream of a peer may be compiled: beyond `MOST_AT_ONCE` from its second message on."""
        is_new = MOST_AT_ONCE <= len(self._compiled) < MAX_STREAMS and key not in self._compiled
        if is_new:
            self._compiled[key] = 0
        return not is_new and self._may_compile(key)

    def _may_compile(self, key: Key) -> bool:
        """Return whether a stream is not compiled and may be."""
        if key in self.to_ros or key in self.to_igtl:
            return False
        times = self._compiled.get(key)
        return times < MAX_COMPILED if times is not None else len(self._compiled) < MAX_STREAMS

    def _store(self, streams: dict[Any, Any], key: Key, compiled: object | None) -> None:
        """Store a compiled stream; None: this stream cannot be compiled."""
        self._compiled[key] = self._compiled.get(key, 0) + 1 if compiled else MAX_COMPILED
        if compiled:
            streams[key] = compiled

    def _peer_changed(self, link: int) -> None:
        """Drop the compiled streams from a peer, and those to all peers: each has a list of them.

        Those from the other peers stay, and small streams to peers are compiled again at once: otherwise all of them
        would take the full path at the same time, whenever a peer comes or goes.
        """
        if len(self._compiled) >= MAX_STREAMS:  # others have their chance
            self.drop_compiled()
            return
        for topic_key in list(self.to_igtl):
            if topic_key in self._learned:
                del self.to_igtl[topic_key]
                self._outdated.append(topic_key)
            else:
                self._drop(self.to_igtl, topic_key)
        for device_key in [key for key in self.to_ros if key[0] == link]:
            self._drop(self.to_ros, device_key)
        self._blocks.drop(link)
        self._compiled = {key: times for key, times in self._compiled.items() if _is_of_another(key, link)}

    def drop_compiled(self) -> None:
        """Drop all compiled streams, because settings have changed."""
        self.to_ros.clear()
        self.to_igtl.clear()
        self._compiled.clear()
        self._blocks.clear()
        self._learned.clear()
        self._outdated.clear()
        if self.native:
            self.native.drop_all()


def _is_of_another(key: Key, link: int) -> bool:
    """Return whether a stream comes from a peer, and not from this one."""
    return isinstance(key[0], int) and key[0] != link


def no_fast_path(*_input: object) -> None:
    """The fast path of a core without one: every message takes the full path."""
