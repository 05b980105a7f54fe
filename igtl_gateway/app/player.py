"""The player: a recording drives OpenIGTLink peers or a ROS graph."""

from __future__ import annotations

import hashlib
import threading
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field

from igtl_gateway.clock import Clock
from igtl_gateway.config import Config
from igtl_gateway.edges.ros import RosEdge
from igtl_gateway.edges.tcp import TcpEdge
from igtl_gateway.qos import Qos
from igtl_gateway.replay.mcap_reader import SessionFile
from igtl_gateway.replay.playback import PlaybackClock, paced
from igtl_gateway.replay.source import once, select, through_gateway
from igtl_gateway.session.entry import Entry, Kind

#: For topics of which the file tells no quality of service.
PLAYED_QOS = Qos(depth=100)

#: What goes to each side, by preference: what the gateway sent; else what could stand for it.
_OUTPUTS = {"igtl": Kind.IGTL_OUT, "ros": Kind.ROS_OUT}
_SIDES_INPUTS = {"igtl": Kind.IGTL_IN, "ros": Kind.ROS_IN}


@dataclass(frozen=True, slots=True)
class Plan:
    """What a replay to one side sends, and why.

    Attributes:
        kinds: the kinds of entries that are sent.
        recompute: the inputs go through today's gateway first.
        why: one sentence for people.
    """

    kinds: frozenset[Kind]
    recompute: bool
    why: str


def plan(file: SessionFile, side: str, recompute: bool) -> Plan:
    """How to drive a side from this file: as it was, through the gateway, or with what that side itself said."""
    present = {channel.kind for channel in file.channels if channel.count}
    output, own = _OUTPUTS[side], _SIDES_INPUTS[side]
    feeding = Kind.ROS_IN if side == "igtl" else Kind.IGTL_IN
    if side == "ros":
        # what ROS nodes said themselves is part of what a ROS graph heard that day, as in `ros2 bag play`
        kinds = frozenset({output, own})
        if recompute or (feeding in present and output not in present):
            return Plan(kinds, True, "recorded inputs through today's gateway, and what ROS nodes published")
        return Plan(kinds, False, "what was published that day")
    if recompute or (feeding in present and output not in present):
        return Plan(frozenset({output}), True, "recorded inputs through today's gateway")
    if output in present:
        return Plan(frozenset({output}), False, "the bytes that were sent that day")
    return Plan(frozenset({own}), False, "what the peers sent that day (nothing was sent to them)")


def planned(file: SessionFile, config: Config, how: Plan, streams: Iterable[str]) -> Iterator[Entry]:
    """The entries of a plan, in order."""
    entries: Iterable[Entry] = file.entries()
    if how.recompute:
        entries = through_gateway(entries, config, has_links=any(c.kind is Kind.LINK for c in file.channels if c.count))
    return select(once(entries), how.kinds, streams)


@dataclass(slots=True)
class Played:
    """What was sent so far."""

    messages: int = 0
    bytes: int = 0
    unheard: int = 0  #: of the messages, those for which nobody was there
    by_stream: dict[str, int] = field(default_factory=dict)
    _hash: "hashlib._Hash" = field(default_factory=hashlib.sha256)  # noqa: UP037

    def add(self, entry: Entry, heard: bool) -> None:
        self.messages += 1
        self.unheard += not heard
        self.by_stream[entry.channel] = self.by_stream.get(entry.channel, 0) + 1
        for part in entry.payload:
            self.bytes += memoryview(part).nbytes
            self._hash.update(part)

    @property
    def digest(self) -> str:
        """SHA-256 of all bytes in the order in which they were sent."""
        return self._hash.hexdigest()


class Player:
    """Sends entries to one side, each when it is due, none lost: a slow reader slows the replay down.

    Args:
        entries: what to send, in order.
        send: sends one entry; may wait; tells whether anybody was there.
        rate: recorded seconds per real second; None: as fast as possible.
        clock: paces.
        stop: ends the playback when set.
    """

    def __init__(
        self,
        entries: Iterable[Entry],
        send: Callable[[Entry], bool],
        rate: float | None,
        clock: Clock,
        stop: threading.Event,
    ) -> None:
        self.played = Played()
        self._entries = paced(entries, PlaybackClock(rate, clock.monotonic_ns), stop.wait)
        self._send = send
        self._stop = stop

    def run(self) -> Played:
        """Play to the end, or until stopped."""
        for entry in self._entries:
            if self._stop.is_set():
                break
            self.played.add(entry, self._send(entry))
        return self.played


def igtl_sender(edge: TcpEdge) -> Callable[[Entry], bool]:
    """Sends to every peer that is there.  The edge should have been made with ``when_full="block"``."""

    def send(entry: Entry) -> bool:
        links = [link.number for link in edge.links() if link.connected]
        edge.send(links, entry.payload, entry.channel, True)
        return bool(links)

    return send


def ros_sender(edge: RosEdge, file: SessionFile) -> Callable[[Entry], bool]:
    """Publishes on the recorded topics with the recorded quality of service; a graph always counts as listening."""
    offered = {(channel.topic, channel.type): channel.qos for channel in file.channels}

    def send(entry: Entry) -> bool:
        qos = offered.get((entry.channel, entry.type)) or PLAYED_QOS
        edge.publish(entry.channel, entry.type, entry.data(), qos)
        return True

    return send
