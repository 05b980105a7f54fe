"""Plays the actors of a scenario offline: discrete events on a manual clock, through the real gateway.

Every message travels for a fixed time: from an actor to the gateway, from the gateway to an actor, and from one
ROS actor to another (not through the gateway).  At one time, what arrives goes before who acts, and
both go in the order in which they were asked for; so the same actors give the same session, byte for byte.
"""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterable, Iterator, Sequence

from igtl_gateway.base.buffers import join
from igtl_gateway.base.stamp import NS_PER_MS, NS_PER_S
from igtl_gateway.config.configuration import Config
from igtl_gateway.gateway import LINK_DOWN, LINK_UP, TICK, Gateway, Session
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.note import Level, Note
from igtl_gateway.wire import Message, decode, encode
from igtl_gateway_lab.simulate.actor import Actor, ActorProtocol, Received, RosReceived, RosSent, Sent

START_NS = 1_767_225_600 * NS_PER_S  #: 2026-01-01T00:00:00Z
LIMIT_S = 600.0  #: a story that has not ended by then is stuck

IGTL_NS, ROS_NS = 400_000, 300_000  #: how long a message travels
_SETTLED_NS = 10 * NS_PER_MS  # from the first entry to ``begin``
_FIRST_PORT = 53000
_SAME_TIME = 10_000  # an actor that acts this often at one time never advances it


def play_offline(
    actors: Sequence[Actor],
    config: Config,
    start_ns: int = START_NS,
    limit_s: float = LIMIT_S,
    gateway: Gateway | None = None,
) -> Iterator[Entry]:
    """The session log of a scenario.

    It ends when every actor is done and nothing is on its way any more, when no actor will act again, or after
    ``limit_s`` seconds.  How it went is what the actors report.

    Args:
        actors: fresh ones: they are used up.
        config: how the gateway is configured.
        start_ns: UTC time of the first entry.
        limit_s: see above.
        gateway: a new one with this configuration unless given.
    """
    return _OfflineStage(actors, gateway or Gateway(config), start_ns, start_ns + round(limit_s * NS_PER_S)).run()


def came(peer: str) -> Note:
    """A peer connects to the (imagined) server."""
    data = {"peer": peer, "local": "127.0.0.1:18944", "role": "server"}
    return Note(Level.INFO, LINK_UP, f"{peer} connected", data=data)


def went(peer: str) -> Note:
    """The peer closes."""
    data = {"peer": peer, "local": "127.0.0.1:18944", "role": "server", "reason": "closed by the peer"}
    return Note(Level.INFO, LINK_DOWN, f"{peer} gone: closed by the peer", data=data)


class _OfflineStage:
    def __init__(self, actors: Sequence[Actor], gateway: Gateway, start_ns: int, end_ns: int) -> None:
        self._actors = actors
        self._gateway = gateway
        self._session = Session(gateway)
        self._now_ns = start_ns
        self._end_ns = end_ns
        self._links = dict(enumerate((actor for actor in actors if actor.side is ActorProtocol.IGTL), 1))
        self._numbers = {actor.name: link for link, actor in self._links.items()}
        # what is on its way: arrival, serial number, what it does there
        self._coming: list[tuple[int, int, Callable[[], Iterable[Entry]]]] = []
        self._serial = 0

    def run(self) -> Iterator[Entry]:
        label = Note(Level.INFO, "synthetic", "synthetic session: no robot, no patient, no camera")
        yield from self._input(Kind.EDGE_NOTE, label.pack())
        for link in self._links:
            self._now_ns += NS_PER_MS
            yield from self._input(Kind.LINK, came(_address(link)).pack(), link=link)
        self._now_ns += _SETTLED_NS
        for actor in self._actors:
            actor.begin(self._now_ns)
        yield from self._play()
        for link in self._links:
            self._now_ns += NS_PER_MS
            yield from self._input(Kind.LINK, went(_address(link)).pack(), link=link)

    def _play(self) -> Iterator[Entry]:
        acts = 0
        while True:
            arrival_ns = self._coming[0][0] if self._coming else None
            over = all(actor.done for actor in self._actors)
            due_ns, actor = (None, None) if over else self._next_actor()
            tick_ns = None if over else self._gateway.due_ns
            times = [time_ns for time_ns in (arrival_ns, due_ns, tick_ns) if time_ns is not None]
            next_ns = max(min(times, default=self._end_ns), self._now_ns)
            if not times or next_ns >= self._end_ns:
                return
            acts = acts + 1 if next_ns == self._now_ns else 0
            if acts > _SAME_TIME:
                stuck = actor.name if actor else "gateway"
                raise RuntimeError(f"{stuck}: due at {next_ns} ns forever, expected a later time after each act")
            self._now_ns = next_ns
            if arrival_ns is not None and arrival_ns <= next_ns:
                yield from heapq.heappop(self._coming)[2]()
            elif actor and due_ns is not None and due_ns <= next_ns:
                self._send_from(actor, actor.act(next_ns))
            else:
                yield from self._input(Kind.EDGE_NOTE, Note(Level.INFO, TICK, "a deadline has come").pack())

    def _next_actor(self) -> tuple[int | None, Actor | None]:
        """Who acts next, and when: the first of those that are due first."""
        due = [(actor.due_ns, index) for index, actor in enumerate(self._actors)]
        first = min(((time_ns, index) for time_ns, index in due if time_ns is not None), default=None)
        return (first[0], self._actors[first[1]]) if first else (None, None)

    def _send(self, travel_ns: int, arrive: Callable[[], Iterable[Entry]]) -> None:
        self._serial += 1
        heapq.heappush(self._coming, (self._now_ns + travel_ns, self._serial, arrive))

    def _send_from(self, actor: Actor, words: Iterable[Sent]) -> None:
        """Queue the messages that an actor sends now."""
        for message in words:
            if isinstance(message, RosSent):
                self._publish(actor, message)
            else:
                self._send(IGTL_NS, self._to_gateway(message, self._numbers[actor.name]))

    def _to_gateway(self, message: Message, link: int) -> Callable[[], Iterable[Entry]]:
        data = join(encode(message))
        return lambda: self._input(Kind.IGTL_IN, data, link=link)

    def _publish(self, actor: Actor, message: RosSent) -> None:
        topic, ros_type, cdr, sent_ns = message.topic, message.message.TYPE, message.message.pack(), self._now_ns
        if topic not in actor.publishes:
            raise ValueError(
                f"{actor.name}: publishes on {topic}, expected one of {', '.join(actor.publishes) or 'none'}"
            )
        if actor.publishes[topic].recorded or self._gateway.subscription(topic, ros_type):
            self._send(ROS_NS, lambda: self._input(Kind.ROS_IN, cdr, topic, ros_type, source_ns=sent_ns))
        self._to_ros(RosReceived(topic, ros_type, cdr), besides=actor)

    def _to_ros(self, received: RosReceived, besides: Actor | None = None) -> None:
        for actor in self._actors:
            if (
                actor is not besides
                and actor.side is ActorProtocol.ROS
                and actor.subscribes.get(received.topic) == received.type
            ):
                self._send(ROS_NS, self._deliver(actor, received))

    def _deliver(self, actor: Actor, received: Received) -> Callable[[], Iterable[Entry]]:
        def arrive() -> Iterable[Entry]:
            self._send_from(actor, actor.receive(self._now_ns, received))
            return ()

        return arrive

    def _input(
        self, kind: Kind, data: bytes, topic: str = "", ros_type: str = "", *, link: int = 0, source_ns: int = 0
    ) -> list[Entry]:
        """What reaches the gateway now and what it causes, which is put on its way."""
        links = (link,) if link else ()
        entries = self._session.input(
            self._now_ns, kind, (data,), channel=topic, type_name=ros_type, links=links, source_ns=source_ns
        )
        for entry in entries:
            if entry.kind is Kind.ROS_OUT:
                self._to_ros(RosReceived(entry.channel, entry.type, entry.data()))
            elif entry.kind is Kind.IGTL_OUT:
                for one in entry.links:
                    self._send(IGTL_NS, self._deliver(self._links[one], decode(entry.data())))
        return entries


def _address(link: int) -> str:
    return f"127.0.0.1:{_FIRST_PORT + link}"
