"""A compiled stream of an OpenIGTLink device: fills the numbers of a message into the CDR templates of its topics."""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from igtl_gateway.base.buffers import Buffer
from igtl_gateway.base.stamp import NS_PER_S
from igtl_gateway.convert.assembly import Form, VolumeAssembler
from igtl_gateway.convert.express import FillTemplate
from igtl_gateway.convert.igtl_msgs import Metadata, Volume
from igtl_gateway.convert.rosmsg import Image, Marker, Mesh, PointCloud2
from igtl_gateway.gateway.fastpath.tools import has_tools
from igtl_gateway.gateway.guarded_stream import GuardedStream
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.fates import CONVERTED, UNSUBSCRIBED
from igtl_gateway.gateway.log.ledger import Ledger
from igtl_gateway.gateway.to_ros.subscribers import HasSubscriber

#: The assembler with the latest image of a device, and form and dtype of the images of a stream.
Assembly = tuple[VolumeAssembler, Form, np.dtype[Any]]

#: Entry, latched topic and ROS stamp (UTC ns) → what ``Subscribers.waiting`` has for the topic.
Defer = Callable[[Entry, str, int], Any]

#: Topic, ROS type, form and counts of each output.
Outputs = tuple[tuple[str, str, tuple[Any, ...], dict[str, int]], ...]
#: Outputs of a message, and what it was converted to.
Prepared = tuple[Outputs, tuple[Any, ...]]


class Passed(NamedTuple):
    """The last message of those that have passed natively.

    Attributes:
        seq, stamp_ns, source_ns, links: of its entry.
        payload: its bytes; of a large one, those before the content may be others.
        waits: bits of the outputs that wait for their first subscriber.
    """

    seq: int
    stamp_ns: int
    source_ns: int
    payload: Buffer
    waits: int
    links: tuple[int, ...]


#: Gateway time (UTC ns) that no message has, in place of one that is not known yet.
_NO_TIME = 0
#: ROS types that begin with the only stamp that is set, and its place in CDR; and one without any.
_HEADED = frozenset({Image.TYPE, PointCloud2.TYPE, Marker.TYPE, Metadata.TYPE, Volume.TYPE})
_STAMPLESS = Mesh.TYPE
_STAMP, _STAMP_AT = struct.Struct("<iI"), 4
#: The translation in OpenIGTLink.
_PLACE = struct.Struct(">3f")


class CompiledToRos:
    """A compiled stream of one device from one link.

    Args:
        fill: ``pose_to_ros`` or ``bulk_to_ros``, with its arguments ``sample`` and ``places`` (``at``, ``size``).
        entry: entry of the message that the stream is compiled from.
        forms: topic, ROS type and form of each output.
        place_at: offset of the translation in the message, for poses.
        waiting: last messages of latched topics without a subscriber, and the latched topics of ``forms``.
        volume: for images, of which later messages may be parts.
        passed_over: counts messages that the search for PLUS leaves out.
        keeps: the native passage keeps the last message, for the first subscriber of a latched topic.
        defer: keeps a message for latched topics without a subscriber; None: then the full path takes it.

    Attributes:
        sample, places, ratio, check_crc, own, watched, place_at: the arguments.
        outputs: topic, ROS type, form and counts of each output.
        channel, type: of the stream.
        count: counts of the stream.
        keeps: the last message is kept for later ones, which may be parts of it, or for the first subscriber.
        passed: number of messages.
    """

    def __init__(
        self,
        fill: FillTemplate,
        sample: bytes,
        places: tuple[int, int],
        entry: Entry,
        forms: Sequence[tuple[str, str, tuple[Any, ...]]],
        ratio: tuple[float, float],
        check_crc: bool,
        own: bool,
        ledger: Ledger,
        watched: GuardedStream | None,
        place_at: int | None,
        waiting: tuple[dict[str, Any], frozenset[str]],
        volume: Assembly | None = None,
        defer: Defer | None = None,
        passed_over: Callable[[int], None] | None = None,
        *,
        keeps: bool = False,
    ) -> None:
        self._fill = fill
        self.sample = sample
        self.places = places
        self.watched = watched
        self._place, self.place_at = _PLACE if place_at else None, place_at or 0
        self.channel, self.type = entry.channel, entry.type
        self._forms = tuple(form for _, _, form in forms)
        self.outputs = tuple(
            (topic, ros_type, form, ledger.counter("ros_out", topic)) for topic, ros_type, form in forms
        )
        self.ratio = ratio
        self.check_crc = check_crc
        self.own = own
        self.count = ledger.counter("igtl_in", entry.channel)
        self._waiting, self._latched = waiting
        self._volume = volume
        self._defer = defer
        self._passed_over = passed_over
        self.keeps = keeps or volume is not None
        self.passed = 0
        self._is_patched = all(ros_type in _HEADED or ros_type == _STAMPLESS for _, ros_type, _ in forms)

    @property
    def depends(self) -> bool:
        """Whether the native passage has to leave it to Python at times; see ``waits``."""
        return bool(self._latched) or self.keeps

    @property
    def waits(self) -> str:
        """Why only Python can pass its next message; "" if there is no cause."""
        if not self.keeps and not self._latched.isdisjoint(self._waiting):
            return "a latched topic of it waits for its first subscriber"
        if self._volume and not self._volume[0].takes(self._volume[1]):
            return "its images may be parts of a volume"
        return ""

    def has_passed(self, messages: int, last: Passed | None) -> None:
        """Take over what later messages depend on: how many have passed, and the last one if the stream ``keeps``."""
        if last and self.keeps:
            shown_ns = last.source_ns if self.own and last.source_ns > 0 else last.stamp_ns
            payload = (last.payload,)
            entry = Entry(
                *(last.seq, last.stamp_ns, Kind.IGTL_IN, self.channel, self.type, payload, last.links, last.source_ns)
            )
            late = (topic for number, (topic, _, _, _) in enumerate(self.outputs) if last.waits >> number & 1)
            self._keep(entry, shown_ns, frozenset(late))
        self.passed += messages
        if self._passed_over is not None:
            self._passed_over(messages)

    def _keep(self, entry: Entry, shown_ns: int, later: frozenset[str]) -> None:
        """Keep a message for those that may be parts of it, and for the first subscribers of topics."""
        payload = entry.payload[0]
        if self._volume:
            (at, size), (assembler, form, dtype) = self.places, self._volume
            if entry.seq > assembler.used:  # streams of two links with one device are taken over in any order
                assembler.keep(form, dtype, memoryview(payload)[at : len(payload) - size])
                assembler.used = entry.seq
        for topic in self._latched:
            self._waiting.pop(topic, None)
        if self._defer is not None:
            self._waiting.update((topic, self._defer(entry, topic, shown_ns)) for topic in later)

    def prepare(self, payload: Sequence[Buffer], ask: HasSubscriber | None) -> Prepared | bool:
        """Convert a message before it has a number; else return whether the full path has to convert it.

        False: the result depends on others.  Where its stamp is gateway time, it gets that later: ``_stamped``.
        """
        outputs = self._wanted(ask)
        made = self._convert(payload, outputs, _NO_TIME) if outputs else None
        if made is None:
            return True
        return (outputs, made) if made[1] != _NO_TIME or self._is_patched else False

    def left(self, payload: Sequence[Buffer], ask: HasSubscriber | None) -> list[Entry] | None:
        """Return what a call returns for a message that ``prepare`` has left to the full path."""
        if not self._wanted(ask):
            return []
        at, tail = self.places
        return [] if has_tools(self._forms, memoryview(payload[0])[at : len(payload[0]) - tail]) else None

    def _wanted(self, ask: HasSubscriber | None) -> Outputs:
        """Return the outputs that have a subscriber."""
        return self.outputs if ask is None else tuple(one for one in self.outputs if ask(one[0], one[1]))

    def _convert(self, payload: Sequence[Buffer], outputs: Outputs, stamp_ns: int) -> tuple[Any, ...] | None:
        at, size = self.places
        forms = self._forms if outputs is self.outputs else tuple(form for _, _, form, _ in outputs)
        return self._fill(payload[0], self.sample, at, size, self.check_crc, self.own, stamp_ns, self.ratio, forms)

    def __call__(
        self,
        seq: int,
        stamp_ns: int,
        payload: Sequence[Buffer],
        links: tuple[int, ...],
        ask: HasSubscriber | None,
        prepared: Prepared | None = None,
    ) -> list[Entry] | None:
        """Return the entries of a message; [] sends it to the full path, None also all further messages.

        ``prepared``: result of ``prepare``.
        """
        outputs = self._wanted(ask)
        if prepared and [one[0] for one in prepared[0]] != [one[0] for one in outputs]:
            prepared = None  # a subscriber has come or gone since
        later: frozenset[str] = frozenset()
        if ask is not None:
            if self._latched:
                later = self._latched - {topic for topic, _, _, _ in outputs}
            if later and self._defer is None:
                return []  # the full path keeps the message for the first subscriber
            if not outputs and self._place is None:
                return []  # without a subscriber, only the full path checks bulk data
        volume = self._volume
        if volume and not volume[0].takes(volume[1]):
            return []
        made = prepared[1] if prepared else self._convert(payload, outputs, stamp_ns)
        if made is None:
            return self.left(payload, ask)
        if prepared and made[1] == _NO_TIME:
            made = _stamped(made, outputs, stamp_ns)
        source_ns, shown_ns = made[0], made[1]
        watched = self.watched
        if watched is not None and not watched.passes_quickly(
            stamp_ns, shown_ns, payload[0], self._place, self.place_at
        ):
            return []
        entries = [Entry(seq, stamp_ns, Kind.IGTL_IN, self.channel, self.type, payload, links, source_ns)]
        step = 0
        for (topic, ros_type, _, published), cdr in zip(outputs, made[2:], strict=True):
            if cdr is None:
                continue
            step += 1
            published["published"] = published.get("published", 0) + 1
            parts = cdr if type(cdr) is tuple else (cdr,)
            entries.append(Entry(seq + step, stamp_ns + step, Kind.ROS_OUT, topic, ros_type, parts, (), shown_ns))
        self._keep(entries[0], shown_ns, later)
        self.has_passed(1, None)
        count = self.count
        count["received"] = count.get("received", 0) + 1
        count["decoded"] = count.get("decoded", 0) + 1
        fate = CONVERTED if step or ask is None else UNSUBSCRIBED
        count[fate] = count.get(fate, 0) + 1
        return entries


def _stamped(made: tuple[Any, ...], outputs: Outputs, stamp_ns: int) -> tuple[Any, ...]:
    """Return what was made without a time, with gateway time: each message as two buffers, so that none is copied."""
    stamp, end = _STAMP.pack(*_seconds(stamp_ns)), _STAMP_AT + _STAMP.size
    parts = (
        cdr if cdr is None or ros_type == _STAMPLESS else (bytes(cdr[:_STAMP_AT]) + stamp, memoryview(cdr)[end:])
        for (_, ros_type, _, _), cdr in zip(outputs, made[2:], strict=True)
    )
    return made[0], stamp_ns, *parts


def _seconds(stamp_ns: int) -> tuple[int, int]:
    """Return seconds and nanoseconds, as ROS has them: the seconds wrap."""
    seconds, rest_ns = divmod(stamp_ns, NS_PER_S)
    return (seconds + (1 << 31)) % (1 << 32) - (1 << 31), rest_ns
