"""The streams of the native passage: copied from compiled streams, and their counts taken over again.

A stream is copied when Python has passed a message of it by the fast path, and all that it needs is native: the link or
the subscription that it comes from, and the publishers or the links that it goes to.  Until then, Python passes it.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

from igtl_gateway.convert.express import CLOUD, POINT, POINTS, TEXT
from igtl_gateway.gateway.fastpath.common import Key
from igtl_gateway.gateway.fastpath.compiled_to_igtl import CompiledToIgtl
from igtl_gateway.gateway.fastpath.compiled_to_ros import CompiledToRos
from igtl_gateway.gateway.guarded_stream import GuardedStream
from igtl_gateway.gateway.outcome import CONVERTED, UNSUBSCRIBED
from igtl_gateway.passage import Link, Passage, Publisher, Stream, Subscription
from igtl_gateway.session.entry import Entry, Kind

#: Conversions of bulk that can pass natively: the others are of large messages.
_FORMS = frozenset({TEXT, POINT, POINTS, CLOUD})

#: Kind, channel, type and links of entries → number of their stream in the recorder's queue; None: it has none.
NumberOf = Callable[[Kind, str, str, tuple[int, ...]], int | None]
#: Kind and number of entries that passed natively.
OnPassed = Callable[[Kind, int], None]


class NativeEdges(Protocol):
    """What the edges have that the native passage can use; None: Python has to pass the message."""

    def link(self, number: int) -> Link | None: ...

    def publisher(self, topic: str, ros_type: str) -> Publisher | None: ...

    def subscription(self, topic: str, ros_type: str) -> Subscription | None: ...


class _Copy:
    """A compiled stream and its copy."""

    def __init__(self, compiled: CompiledToRos | CompiledToIgtl, native: Stream, channel: str, ros_type: str) -> None:
        self.compiled = compiled
        self.native = native
        self.channel = channel
        self.ros_type = ros_type
        self.watched: GuardedStream | None = compiled.watched

    def set_guard(self) -> None:
        if self.watched:
            self.native.set_guard(*self.watched.native_state())


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
        self._copies: dict[Key, _Copy] = {}
        self._tries: dict[Key, int] = {}  # messages that Python has passed since the streams were compiled

    @property
    def count(self) -> int:
        """Number of streams that pass natively."""
        return len(self._copies)

    def collect(self, key: Key) -> None:
        if (copy := self._copies.get(key)) and copy.native.received:
            self._collect(copy)

    def collect_all(self) -> None:
        for copy in self._copies.values():
            if copy.native.received:
                self._collect(copy)

    def handled(self, key: Key, stream: object) -> None:
        if copy := self._copies.get(key):
            if not copy.native.is_stale:
                copy.set_guard()
                return
            self.drop(key)
        tries = self._tries[key] = self._tries.get(key, 0) + 1
        if tries & (tries - 1):  # at 1, 2, 4, 8 … messages: what is missing may come, such as a subscriber
            return
        if isinstance(stream, CompiledToRos) and isinstance(key[0], int) and isinstance(key[1], bytes):
            copied = self._copy_to_ros(key[0], key[1], stream)
        elif isinstance(stream, CompiledToIgtl) and isinstance(key[0], str) and isinstance(key[1], str):
            copied = self._copy_to_igtl(key[0], key[1], stream)
        else:
            return
        if copied:
            copied.set_guard()
            self._copies[key] = copied

    def handled_in_full(self, entry: Entry) -> None:
        if not self._copies:
            return
        if entry.kind is Kind.ROS_IN:
            copy = self._copies.get((entry.channel, entry.type))
            copies = [copy] if copy else []
        elif entry.kind is Kind.IGTL_IN:  # the same device on the same link, whatever else the header has
            copies = [copy for key, copy in self._copies.items() if key[0] == entry.links[0]]
        else:
            copies = list(self._copies.values())
        for copy in copies:
            copy.set_guard()

    def drop(self, key: Key) -> None:
        self._tries.pop(key, None)
        if copy := self._copies.pop(key, None):
            self._collect(copy)
            copy.native.remove()

    def drop_all(self) -> None:
        for key in list(self._copies):
            self.drop(key)
        self._tries.clear()

    def _copy_to_ros(self, link_number: int, names: bytes, compiled: CompiledToRos) -> _Copy | None:
        link = self._edges.link(link_number)
        number = self._number_of(Kind.IGTL_IN, compiled.channel, compiled.type, (link_number,))
        if not compiled.is_plain or link is None or number is None:
            return None
        outputs = []
        for topic, ros_type, form, _ in compiled.outputs:
            publisher = self._edges.publisher(topic, ros_type)
            own_number = self._number_of(Kind.ROS_OUT, topic, ros_type, ())
            if publisher is None or own_number is None or (not compiled.place_at and form[0] not in _FORMS):
                return None
            outputs.append((*form, own_number, publisher))
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
        )
        return _Copy(compiled, native, compiled.channel, compiled.type)

    def _copy_to_igtl(self, topic: str, ros_type: str, compiled: CompiledToIgtl) -> _Copy | None:
        subscription = self._edges.subscription(topic, ros_type)
        number = self._number_of(Kind.ROS_IN, topic, ros_type, ())
        if subscription is None or number is None or not (compiled.is_pose or compiled.size in _FORMS):
            return None
        outputs: list[tuple[Any, ...]] = []
        for (output, _, _), form in zip(compiled.outputs, compiled.forms, strict=True):
            links = [self._edges.link(one) for one in output.links]
            own_number = self._number_of(Kind.IGTL_OUT, output.channel, output.type, output.links)
            there = tuple(link for link in links if link is not None)
            if len(there) < len(links) or own_number is None:
                return None
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
        received, converted, unheard, sent, latest, state, looks = copy.native.collect()
        if not received:
            return
        compiled = copy.compiled
        counts = {"received": received, CONVERTED: converted, UNSUBSCRIBED: unheard}
        if isinstance(compiled, CompiledToRos):
            counts["decoded"] = received
            for (_, _, _, counter), number in zip(compiled.outputs, sent, strict=True):
                _add(counter, {"published": number})
            self._on_passed(Kind.IGTL_IN, received)
            self._on_passed(Kind.ROS_OUT, sum(sent))
        else:
            for (_, links, counter), number in zip(compiled.outputs, sent, strict=True):
                _add(counter, {"sent": number * links})
            if latest:
                seq, stamp_ns, source_ns, cdr = latest
                for peer in compiled.peers:
                    peer.said_ns = stamp_ns
                    peer.sent += received
                compiled.latest[copy.channel] = Entry(
                    seq, stamp_ns, Kind.ROS_IN, copy.channel, copy.ros_type, (cdr,), (), source_ns
                )
            self._on_passed(Kind.ROS_IN, received)
            self._on_passed(Kind.IGTL_OUT, sum(sent))
        _add(compiled.count, counts)
        if copy.watched:
            copy.watched.after_native(state, looks)


def _add(counter: dict[str, int], numbers: dict[str, int]) -> None:
    for word, number in numbers.items():
        if number:
            counter[word] = counter.get(word, 0) + number
