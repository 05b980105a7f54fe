"""The streams of the native passage: copied from compiled streams, and their counts taken over again.

A stream is copied when Python has passed a message of it by the fast path, and all that it needs is native: the link or
the subscription that it comes from, and the publishers or the links that it goes to.  Until then, Python passes it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Protocol

from igtl_gateway.convert.express import (
    BLUE_FIRST,
    CLOUD,
    LANDMARKS,
    METADATA,
    NUMBERS,
    PICTURE,
    POINT,
    POINTS,
    TEXT,
    TOOLS,
    VOLUME,
)
from igtl_gateway.gateway.fastpath.common import Key
from igtl_gateway.gateway.fastpath.compiled_to_igtl import CompiledToIgtl
from igtl_gateway.gateway.fastpath.compiled_to_ros import CompiledToRos, Passed
from igtl_gateway.gateway.fastpath.metadata import names_of
from igtl_gateway.gateway.guarded_stream import GuardedStream
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.fates import CONVERTED, UNSUBSCRIBED
from igtl_gateway.native.passage import Guard, Link, Passage, Publisher, Stream, Subscription
from igtl_gateway.wire.header import HEADER_SIZE

#: Conversions of bulk that can pass natively.
_FORMS = frozenset({TEXT, POINT, POINTS, CLOUD, PICTURE, BLUE_FIRST, TOOLS, METADATA, VOLUME, LANDMARKS, NUMBERS})

#: Largest message, in bytes, that the passage reads for Python, if the limits of the links permit it.
LARGEST_BYTES = 16 << 20

#: Messages of a stream in Python, after which it is copied if it can be now: half a second at 30 Hz, and 3 % of the
#: time of a message if it never can.
_RETRY_AFTER = 16

#: Numbers of the form of a pose: template, offsets of stamp and message id.
_POSE_FORM = 3

#: Streams of a slice: each takes 10 to 20 µs.
_SLICE = 4

#: Why a stream has no copy.
_BY_PYTHON = "Python has the connection, as with TLS"
_NO_NUMBER = "the recorder has no more streams"
SURFACE = "surfaces have no fast one"

#: Kind, channel, type and links of entries → number of their stream in the recorder's queue; None: it has none.
NumberOf = Callable[[Kind, str, str, tuple[int, ...]], int | None]
#: Kind and number of entries that passed natively.
OnPassed = Callable[[Kind, int], None]


class NativeEdges(Protocol):
    """What the edges have that the native passage can use; None: Python has to pass the message."""

    def link(self, number: int) -> Link | None: ...

    def ignore(self, channel: str, messages: int) -> None:
        """Count messages to links that take nothing any more."""
        ...

    def max_body(self, igtl_type: str) -> int:
        """Return the limit of the bodies of a type, in bytes."""
        ...

    def publisher(self, topic: str, ros_type: str) -> Publisher | None: ...

    def subscription(self, topic: str, ros_type: str) -> Subscription | None: ...


class _Copy:
    """A compiled stream and its copy."""

    def __init__(
        self, compiled: CompiledToRos | CompiledToIgtl, native: Stream, channel: str, ros_type: str, link: int = 0
    ) -> None:
        self.compiled = compiled
        self.link = link  # where it comes from, if that is one
        self.native = native
        self.channel = channel
        self.ros_type = ros_type

    @property
    def is_large(self) -> bool:
        """Its messages are counted when they pass, and given to the links without the sequence lock."""
        return isinstance(self.compiled, CompiledToIgtl) and not self.compiled.is_pose

    @property
    def may_have_counts(self) -> bool:
        """What a link ignores of a large message may be all that is new."""
        return bool(self.native.received) or self.is_large


class _Guards:
    """The states of guarded streams in the passage.

    Compiled streams may share one: a device that sends both header versions is one stream for the guard.
    """

    def __init__(self) -> None:
        self._guards: dict[int, tuple[GuardedStream, Guard]] = {}

    def of(self, watched: GuardedStream) -> Guard:
        if id(watched) not in self._guards:
            self._guards[id(watched)] = watched, Guard()
        return self._guards[id(watched)][1]

    def collect(self, watched: GuardedStream | None) -> None:
        """Take over the state of a guarded stream."""
        found = self._guards.get(id(watched))
        if found and found[1].is_dirty:
            found[0].after_native(*found[1].collect())

    def set(self, watched: GuardedStream | None) -> None:
        """Pass the state of a guarded stream to the passage."""
        if found := self._guards.get(id(watched)):
            found[1].set(*found[0].native_state())

    def collect_all(self) -> None:
        for watched, _ in self._guards.values():
            self.collect(watched)

    def set_all(self) -> None:
        for watched, _ in self._guards.values():
            self.set(watched)

    def clear(self) -> None:
        self._guards.clear()


class PassageStreams:
    """The streams of a passage; see ``NativeStreams`` of the fast path for the methods.

    Args:
        number_of: see ``NumberOf``.
        on_passed: see ``OnPassed``; called when counts are taken over.
        keep: OpenIGTLink type → whether a full send queue must not drop its messages.
    """

    def __init__(
        self,
        passage: Passage,
        edges: NativeEdges,
        number_of: NumberOf,
        on_passed: OnPassed,
        keep: Callable[[str], bool],
    ) -> None:
        self._passage = passage
        self._edges = edges
        self._number_of = number_of
        self._on_passed = on_passed
        self._keep = keep
        self._later = Publisher(0)
        self._later.leave()
        self._copies: dict[Key, _Copy] = {}
        self._removed: list[_Copy] = []  # whose last message may still be on its way to the links
        self._depending: dict[Key, CompiledToRos] = {}  # those with a copy that has to be left to Python at times
        self._guards = _Guards()
        self._tries: dict[Key, int] = {}  # messages that Python has passed since the streams were compiled
        self._missing: dict[Key, tuple[CompiledToRos | CompiledToIgtl, str]] = {}  # those without a copy, and why

    @property
    def count(self) -> int:
        """Number of streams that pass natively."""
        return len(self._copies)

    def states(self) -> dict[tuple[str, str], str]:
        """Return (direction, stream) as in the ledger → why Python passes it; "" if it passes natively."""
        found = {_in_ledger(key, stream): why for key, (stream, why) in self._missing.items()}
        return found | {_in_ledger(key, copy.compiled): "" for key, copy in self._copies.items()}

    def retry(self) -> None:
        """Copy the streams that could not be copied before: what was missing may have come without a message."""
        for key, (stream, _) in list(self._missing.items()):
            self._guards.collect(stream.watched)
            self._copy(key, stream)

    def collect(self, key: Key, stream: CompiledToRos | CompiledToIgtl) -> None:
        if (copy := self._copies.get(key)) and copy.may_have_counts:
            self._collect(copy)
        self._guards.collect(stream.watched)

    def collect_all(self) -> None:
        for copy in self._copies.values():
            if copy.may_have_counts:
                self._collect(copy)
        self.collect_removed()
        self._guards.collect_all()

    def collect_removed(self) -> None:
        """Take over the counts of removed streams, as long as a message of theirs is on its way."""
        removed, self._removed = self._removed, []
        for copy in removed:
            if copy.native.is_in_use:  # before its counts are taken: those of the end come after it
                self._removed.append(copy)
            self._collect(copy)

    def slices(self) -> list[tuple[Key, ...]]:
        """Return all streams, a few at a time: `collect_some` of these takes less time than a message may wait."""
        keys = tuple(self._copies)
        return [keys[at : at + _SLICE] for at in range(0, len(keys), _SLICE)]

    def collect_some(self, keys: Sequence[Key]) -> None:
        """Take over what was counted of some streams, as far as they are still there."""
        for key in keys:
            if copy := self._copies.get(key):
                self.collect(key, copy.compiled)

    def handled(self, key: Key, stream: CompiledToRos | CompiledToIgtl) -> None:
        self._guards.set(stream.watched)
        self._leave_waiting()
        if copy := self._copies.get(key):
            if not copy.native.is_stale:
                return
            self.drop(key)
        tries = self._tries[key] = self._tries.get(key, 0) + 1
        if tries & (tries - 1) and tries % _RETRY_AFTER:  # what is missing may come, such as a subscriber
            return
        self._copy(key, stream)

    def _copy(self, key: Key, stream: CompiledToRos | CompiledToIgtl) -> None:
        """Copy a compiled stream, if that is possible now."""
        if isinstance(stream, CompiledToRos) and isinstance(key[0], int) and isinstance(key[1], bytes):
            copied = self._copy_to_ros(key[0], names_of((key[0], key[1])), stream)
        elif isinstance(stream, CompiledToIgtl) and isinstance(key[0], str) and isinstance(key[1], str):
            copied = self._copy_to_igtl(key[0], key[1], stream)
        else:
            return
        if isinstance(copied, str):
            self._missing[key] = stream, copied
            return
        self._missing.pop(key, None)
        try:
            if stream.watched:
                copied.native.guard_with(self._guards.of(stream.watched))
                self._guards.set(stream.watched)
        except BaseException:  # nothing may pass that is not checked and counted
            copied.native.remove()
            raise
        self._copies[key] = copied
        if isinstance(stream, CompiledToRos) and stream.depends:
            self._depending[key] = stream

    def handled_in_full(self) -> None:
        self._guards.set_all()
        self._leave_waiting()

    def _leave_waiting(self) -> None:
        """Drop the copies of streams of which only Python knows what their next message depends on."""
        for key, compiled, why in [(key, one, one.waits) for key, one in self._depending.items()]:
            if why:
                self.drop(key)
                self._missing[key] = compiled, why

    def drop(self, key: Key) -> None:
        self.replace(key, None)

    def replace(self, key: Key, stream: CompiledToRos | CompiledToIgtl | None) -> None:
        self._tries.pop(key, None)
        self._missing.pop(key, None)
        self._depending.pop(key, None)
        old = self._copies.pop(key, None)
        if old is None:
            return
        try:
            self._collect(old)
            self._guards.collect(old.compiled.watched)
            if stream:
                self._copy(key, stream)
        finally:  # after the copy: a message that comes meanwhile waits for it, and does not go to Python
            old.native.remove()
        if old.is_large:
            self.collect_removed()
            self._removed.append(old)

    def keys_with(self, kind: Kind, channel: str) -> list[Key]:
        """Return the streams whose messages, or the results of them, are entries of a kind and channel."""
        return [key for key, copy in list(self._copies.items()) if _has(copy, kind, channel)]

    def pass_once(self, keys: Sequence[Key]) -> None:
        """Have Python pass the next message of each of these streams; those after it pass natively again."""
        for key in keys:
            self.drop(key)

    def drop_all(self) -> None:
        for key in list(self._copies):
            self.drop(key)
        self._guards.clear()
        self._tries.clear()
        self._missing.clear()

    def _copy_to_ros(self, link_number: int, names: bytes, compiled: CompiledToRos) -> _Copy | str:
        """Return the copy, or why there can be none now."""
        link = self._edges.link(link_number)
        if link and link.is_framed:
            link = None
        if link and not compiled.place_at:
            link.add_large(names, min(LARGEST_BYTES, HEADER_SIZE + self._edges.max_body(compiled.type)))
        number = self._number_of(Kind.IGTL_IN, compiled.channel, compiled.type, (link_number,))
        if why := compiled.waits:
            return why
        if link is None:
            return _BY_PYTHON
        if number is None:
            return _NO_NUMBER
        outputs = []
        for topic, ros_type, form, _ in compiled.outputs:
            publisher = self._edges.publisher(topic, ros_type)
            own_number = self._number_of(Kind.ROS_OUT, topic, ros_type, ())
            if not compiled.place_at and form[0] not in _FORMS:
                return SURFACE
            if publisher is None and form[0] == POINT and not compiled.place_at:
                publisher = self._later  # most messages have no single point, and its topic has no publisher
            if publisher is None:
                return f"{topic} waits for subscribers, or is subscribed to as well"
            if own_number is None:
                return _NO_NUMBER
            of_pose = (*form, 0)[:_POSE_FORM] if compiled.place_at else form  # 0: no message id
            outputs.append((*of_pose, own_number, publisher))
        place = (compiled.place_at,) if compiled.place_at else ()
        add: Callable[..., Stream] = self._passage.to_ros if place else self._passage.to_ros_bulk
        native = add(
            link,
            names,
            compiled.sample,
            *compiled.places,
            compiled.check_crc,
            compiled.own,
            *compiled.ratio,
            *place,
            number,
            tuple(outputs),
            *(() if place else (compiled.keeps,)),
        )
        return _Copy(compiled, native, compiled.channel, compiled.type, link_number)

    def _copy_to_igtl(self, topic: str, ros_type: str, compiled: CompiledToIgtl) -> _Copy | str:
        """As `_copy_to_ros`."""
        subscription = self._edges.subscription(topic, ros_type)
        number = self._number_of(Kind.ROS_IN, topic, ros_type, ())
        if not (compiled.is_pose or compiled.size in _FORMS):
            return SURFACE
        if subscription is None:
            return "the topic is published as well, or this rclpy lacks what the passage needs"
        if number is None:
            return _NO_NUMBER
        outputs: list[tuple[Any, ...]] = []
        for (output, _, _), form in zip(compiled.outputs, compiled.forms, strict=True):
            links = [self._edges.link(one) for one in output.links]
            own_number = self._number_of(Kind.IGTL_OUT, output.channel, output.type, output.links)
            there = tuple(link for link in links if link is not None)
            if len(there) < len(links):
                return _BY_PYTHON
            if own_number is None:
                return _NO_NUMBER
            keep = () if compiled.is_pose else (self._keep(output.type),)
            outputs.append((*form, own_number, output.channel, *keep, there))
        add: Callable[..., Stream] = self._passage.to_igtl if compiled.is_pose else self._passage.to_igtl_bulk
        native = add(
            subscription,
            compiled.sample,
            *(compiled.names if compiled.is_pose else (compiled.names,)),
            compiled.size,
            compiled.own,
            *compiled.ratio,
            number,
            tuple(outputs),
        )
        return _Copy(compiled, native, topic, ros_type)

    def _collect(self, copy: _Copy) -> None:
        """Take over the counts of a stream, its latest message, and the state of its guard."""
        received, converted, unheard, sent, ignored, latest = copy.native.collect()
        compiled = copy.compiled
        if isinstance(compiled, CompiledToIgtl):  # a large message is counted first, and then given to the links
            for (output, _, _), left in zip(compiled.outputs, ignored, strict=True):
                if left:
                    self._edges.ignore(output.channel, left)
        if not received:
            return
        counts = {"received": received, CONVERTED: converted, UNSUBSCRIBED: unheard}
        if isinstance(compiled, CompiledToRos):
            counts["decoded"] = received
            for (_, _, _, counter), number in zip(compiled.outputs, sent, strict=True):
                _add(counter, {"published": number})
            self._on_passed(Kind.IGTL_IN, received)
            self._on_passed(Kind.ROS_OUT, sum(sent))
            compiled.has_passed(received, Passed(*latest, (copy.link,)) if latest else None)
        else:
            for (_, links, counter), number in zip(compiled.outputs, sent, strict=True):
                _add(counter, {"sent": number * links})
            if latest:
                seq, stamp_ns, source_ns, cdr, _ = latest
                for peer in compiled.peers:
                    peer.last_sent_ns = max(peer.last_sent_ns, stamp_ns)  # streams are collected in any order
                    peer.sent += received
                compiled.latest[copy.channel] = Entry(
                    seq, stamp_ns, Kind.ROS_IN, copy.channel, copy.ros_type, (cdr,), (), source_ns
                )
            self._on_passed(Kind.ROS_IN, received)
            self._on_passed(Kind.IGTL_OUT, sum(sent))
        _add(compiled.count, counts)


def _has(copy: _Copy, kind: Kind, channel: str) -> bool:
    compiled = copy.compiled
    if isinstance(compiled, CompiledToRos):
        if kind is Kind.IGTL_IN:
            return compiled.channel == channel
        return kind is Kind.ROS_OUT and any(topic == channel for topic, _, _, _ in compiled.outputs)
    if kind is Kind.ROS_IN:
        return copy.channel == channel
    return kind is Kind.IGTL_OUT and any(output.channel == channel for output, _, _ in compiled.outputs)


def _in_ledger(key: Key, stream: CompiledToRos | CompiledToIgtl) -> tuple[str, str]:
    """Return direction and name of a stream in the ledger."""
    return ("igtl_in", stream.channel) if isinstance(stream, CompiledToRos) else ("ros_in", str(key[0]))


def _add(counter: dict[str, int], numbers: dict[str, int]) -> None:
    for word, number in numbers.items():
        if number:
            counter[word] = counter.get(word, 0) + number
