"""Scenarios: synthetic inputs from both sides, and the session that the real gateway makes of them.

Nothing is faked but the world: every input goes through the same ``Session`` as live traffic, so a simulated
recording holds both sides and verifies like any other.  A scenario is either a list of inputs, or a cast of actors
that react to each other; only the latter can be played live.
"""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, fields, replace
from typing import Any

from igtl_gateway.base.buffers import join
from igtl_gateway.config.configuration import Config
from igtl_gateway.convert.rosmsg import RosMessage
from igtl_gateway.gateway import TICK, Gateway, Session
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.note import Level, Note
from igtl_gateway.wire import Message, encode
from igtl_gateway_lab.simulate.actor import Actor
from igtl_gateway_lab.simulate.load import Load
from igtl_gateway_lab.simulate.stage import came, play_offline, went

#: Metadata of every recording of a scenario.
SYNTHETIC = "yes: no robot, no patient, no camera"


@dataclass(frozen=True, slots=True)
class ScenarioInput:
    """Something that reaches the gateway at ``time_ns`` (UTC); fields as those of ``Entry``."""

    time_ns: int
    kind: Kind
    payload: bytes
    channel: str = ""
    type: str = ""
    link: int = 0
    source_ns: int = 0

    def entries(self, session: Session) -> list[Entry]:
        """Return its entry in the log of a session, followed by the entries that it causes."""
        return session.input(
            self.time_ns,
            self.kind,
            (self.payload,),
            channel=self.channel,
            type_name=self.type,
            links=(self.link,) if self.link else (),
            source_ns=self.source_ns,
        )


Inputs = Callable[[float | None], Iterable[ScenarioInput]]
#: The actors of a story of the given number of seconds (None: its own length), new with each call.
Cast = Callable[[float | None], tuple[Actor, ...]]


@dataclass(frozen=True, slots=True)
class Scenario:
    """A synthetic session: ``inputs`` or ``actors``.

    Attributes:
        title: one line; it contains the word synthetic.
        config: how the gateway is configured.
        inputs: returns the inputs of a session of the given number of seconds (None: its own length), in order of time.
        actors: gives those who make the session among themselves.
        limit_s: a story that takes so much longer than it was asked to is stuck.
        loaded: the same with another load, where it has one.
    """

    title: str
    config: Config
    inputs: Inputs | None = None
    actors: Cast | None = None
    limit_s: float = 120.0
    loaded: Callable[[Load], Scenario] | None = None

    def __post_init__(self) -> None:
        if (self.inputs is None) == (self.actors is None):
            raise ValueError(f"scenario {self.title!r}: expected inputs or actors, and not both")

    def cast(self, duration_s: float | None = None) -> tuple[Actor, ...]:
        """New actors for a story of the given number of seconds; empty if there are only inputs."""
        return self.actors(duration_s) if self.actors else ()

    def entries(
        self, duration_s: float | None = None, gateway: Gateway | None = None, cast: tuple[Actor, ...] = ()
    ) -> Iterator[Entry]:
        """The session log, outputs included.

        Args:
            duration_s: see ``inputs``.
            gateway: a new one with this configuration unless given.
            cast: of whom the caller wants the reports; fresh ones unless given.
        """
        if self.inputs is None:
            limit_s = self.limit_s + (duration_s or 0.0)
            yield from play_offline(cast or self.cast(duration_s), self.config, limit_s=limit_s, gateway=gateway)
            return
        session = Session(gateway or Gateway(self.config))
        for given in self.inputs(duration_s):
            yield from given.entries(session)


def merge_inputs(*sources: Iterable[ScenarioInput]) -> Iterator[ScenarioInput]:
    """Several sources in order of time; at equal times in the order given."""
    return heapq.merge(*sources, key=lambda item: item.time_ns)


def link_up_input(time_ns: int, link: int, peer: str) -> ScenarioInput:
    """A peer connects to the (imagined) server."""
    return ScenarioInput(time_ns, Kind.LINK, came(peer).pack(), link=link)


def link_down_input(time_ns: int, link: int, peer: str) -> ScenarioInput:
    """The peer closes."""
    return ScenarioInput(time_ns, Kind.LINK, went(peer).pack(), link=link)


def note_input(time_ns: int, code: str, text: str) -> ScenarioInput:
    """A note of its own, such as that all this is synthetic."""
    return ScenarioInput(time_ns, Kind.EDGE_NOTE, Note(Level.INFO, code, text).pack())


def peer_input(time_ns: int, link: int, message: Message) -> ScenarioInput:
    """A message from a peer."""
    return ScenarioInput(time_ns, Kind.IGTL_IN, join(encode(message)), link=link)


def ros_input(time_ns: int, topic: str, message: RosMessage, sent_ns: int = 0) -> ScenarioInput:
    """A message of a ROS topic."""
    return ScenarioInput(time_ns, Kind.ROS_IN, message.pack(), topic, message.TYPE, source_ns=sent_ns)


def tick_input(time_ns: int) -> ScenarioInput:
    """A tick of the gateway, whether it is due or not."""
    return ScenarioInput(time_ns, Kind.EDGE_NOTE, Note(Level.INFO, TICK, "a deadline has come").pack())


def stamped(message: RosMessage, stamp_ns: int) -> RosMessage:
    """The message with this stamp, where its type has one; those of a TFMessage all get it."""
    names = {field.name for field in fields(message)}  # type: ignore[arg-type]
    changes: dict[str, Any] = {}
    if "header" in names:
        changes["header"] = replace(message.header, stamp_ns=stamp_ns)  # type: ignore[attr-defined]
    if "timestamp_ns" in names:
        changes["timestamp_ns"] = stamp_ns
    if "transforms" in names:
        changes["transforms"] = tuple(stamped(one, stamp_ns) for one in message.transforms)  # type: ignore[attr-defined]
    return replace(message, **changes)  # type: ignore[type-var]
