"""What a recording has for programs: the messages of its ROS topics, in order, read as they are needed."""

from __future__ import annotations

import struct
from collections import deque
from collections.abc import Collection, Iterator
from dataclasses import dataclass, replace

from igtl_gateway.addon import NS_PER_S
from igtl_gateway.addon.reading import Kind, Qos, SessionFile
from igtl_gateway.addons.resim.frames import NEVER

_ROS = frozenset({Kind.ROS_IN, Kind.ROS_OUT})
#: What programs with ``use_sim_time`` read; a recording without it gets it, with session time.
CLOCK, _CLOCK_TYPE, _CLOCK_NS = "/clock", "rosgraph_msgs/msg/Clock", 10_000_000
_CLOCK_CDR = struct.Struct("<4sII")


@dataclass(frozen=True, slots=True)
class RecordedTopic:
    """A ROS topic of the recording: its type, its QoS, and its messages by direction as the gateway saw it.

    Attributes:
        name: the topic.
        type: ROS type of its messages.
        qos: as recorded; the default where the file has none.
        from_gateway: messages that the gateway published; what programs may have received from it.
        from_others: messages that others published.
    """

    name: str
    type: str
    qos: Qos
    from_gateway: int
    from_others: int


@dataclass(frozen=True, slots=True)
class RecordedInput:
    """A recorded message.

    Attributes:
        number: its number among all ROS messages of the recording, from 1.
        time_ns: when the gateway had it, session time in UTC ns.
        topic: its topic.
        type: its ROS type.
        data: CDR with its encapsulation.
        source_ns: stamp of its sender; that of the gateway where the recording has none.
        is_ours: whether the gateway published it.
    """

    number: int
    time_ns: int
    topic: str
    type: str
    data: bytes
    source_ns: int
    is_ours: bool


def input_name(link: int, stream: str) -> str:
    """Return the name of an OpenIGTLink stream (``TYPE/device``) that the gateway sent on a link."""
    return f"link{link}/{stream}"


def topics_of(file: SessionFile) -> dict[str, RecordedTopic]:
    """Return the ROS topics of a recording by name, and /clock; of several types of one topic, the first."""
    found: dict[str, RecordedTopic] = {}
    for channel in file.channels:
        if channel.kind not in _ROS or not channel.count:
            continue
        before = found.get(channel.topic)
        if before and before.type != channel.type:
            continue
        ours = channel.count if channel.kind is Kind.ROS_OUT else 0
        qos = channel.qos or (before.qos if before else Qos())
        found[channel.topic] = RecordedTopic(
            channel.topic,
            channel.type,
            qos,
            ours + (before.from_gateway if before else 0),
            channel.count - ours + (before.from_others if before else 0),
        )
    ticks = (file.end_ns - file.start_ns) // _CLOCK_NS + 1
    found.setdefault(CLOCK, RecordedTopic(CLOCK, _CLOCK_TYPE, Qos(), ticks, 0))
    return found


def _clock(number: int, time_ns: int) -> RecordedInput:
    seconds, rest_ns = divmod(time_ns, NS_PER_S)
    data = _CLOCK_CDR.pack(b"\0\1\0\0", seconds & 0xFFFFFFFF, rest_ns)
    return RecordedInput(number, time_ns, CLOCK, _CLOCK_TYPE, data, time_ns, True)


class Inputs:
    """The messages in order, of which the next ones can be looked at and given back.

    Args:
        file: the recording.
        links: links whose OpenIGTLink messages to the peer are inputs, too.
        since_ns: session time from which on there are any; what was latched before comes then.
    """

    def __init__(self, file: SessionFile, links: Collection[int] = (), since_ns: int = 0) -> None:
        coming = _read(file, links)
        self._coming = _since(coming, since_ns, _latched(file)) if since_ns > file.start_ns else coming
        self._waiting: deque[RecordedInput] = deque()

    def peek(self) -> RecordedInput | None:
        """The next message; None at the end."""
        if not self._waiting:
            following = next(self._coming, None)
            if following is None:
                return None
            self._waiting.append(following)
        return self._waiting[0]

    def pop(self) -> RecordedInput:
        """Take the message that `peek` returned."""
        return self._waiting.popleft()

    def give_back(self, message: RecordedInput) -> None:
        """Put a message back, before all others."""
        self._waiting.appendleft(message)


def _latched(file: SessionFile) -> set[str]:
    """The topics whose last message a new subscription gets."""
    return {name for name, topic in topics_of(file).items() if topic.qos.latched}


def _since(coming: Iterator[RecordedInput], since_ns: int, latched: set[str]) -> Iterator[RecordedInput]:
    """Leave out what is before a time, except the last message of each latched topic."""
    kept: dict[str, RecordedInput] = {}
    for message in coming:
        if message.time_ns >= since_ns:
            yield from (replace(each, time_ns=since_ns) for each in sorted(kept.values(), key=lambda each: each.number))
            yield message
            break
        if message.topic in latched:
            kept[message.topic] = message
    yield from coming


def _read(file: SessionFile, links: Collection[int]) -> Iterator[RecordedInput]:
    kinds = _ROS | {Kind.IGTL_OUT} if links else _ROS
    number = 0
    has_clock = any(channel.topic == CLOCK for channel in file.channels)
    clock_ns = NEVER if has_clock else file.start_ns
    for entry in file.entries_of_kinds(kinds):
        if entry.seq and entry.kind in kinds:
            stamp_ns = entry.stamp_ns
            while clock_ns <= stamp_ns:
                number += 1
                yield _clock(number, clock_ns)
                clock_ns += _CLOCK_NS
            if entry.kind is Kind.IGTL_OUT:
                for link in filter(links.__contains__, entry.links):
                    number += 1
                    name = input_name(link, entry.channel)
                    yield RecordedInput(number, stamp_ns, name, entry.type, entry.data(), stamp_ns, True)
                continue
            number += 1
            source_ns = entry.source_ns or stamp_ns
            ours = entry.kind is Kind.ROS_OUT
            yield RecordedInput(number, stamp_ns, entry.channel, entry.type, entry.data(), source_ns, ours)
    while clock_ns <= file.end_ns:
        number += 1
        yield _clock(number, clock_ns)
        clock_ns += _CLOCK_NS
