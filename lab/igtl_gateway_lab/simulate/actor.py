"""Actors: the programs of a scenario, each a pure machine, so that one story is played live and offline.

An actor speaks one protocol.  Time is an argument (UTC nanoseconds) and chance a seeded generator, so the same
actors give the same bytes on a manual clock (``stage``), and play on a real ROS 2 graph or a real OpenIGTLink
connection when something live drives them.  An actor never waits: it returns the time of its next call.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from enum import Enum
from typing import Any, Protocol, runtime_checkable

from igtl_gateway.convert.rosmsg import RosMessage
from igtl_gateway.wire import Message


class ActorProtocol(Enum):
    """What an actor speaks."""

    ROS = "ros"
    IGTL = "igtl"


@dataclass(frozen=True, slots=True)
class Publishes:
    """What is published on a ROS topic: its type as ``"std_msgs/msg/String"``.

    ``latched``: the last message is for late subscribers, too (transient local).  ``recorded``: it is for the recording
    although the gateway has nothing to do with it (``bridge --record-topics``).
    """

    type: str
    latched: bool = False
    recorded: bool = False


@dataclass(frozen=True, slots=True)
class RosSent:
    """A message for a ROS topic, one of those in the actor's ``publishes``."""

    topic: str
    message: RosMessage


#: A message from an actor: of ROS the first, of OpenIGTLink the second.
Sent = RosSent | Message


@dataclass(frozen=True, slots=True)
class RosReceived:
    """A message that came on a ROS topic: its type as ``"std_msgs/msg/String"`` and its CDR bytes."""

    topic: str
    type: str
    cdr: bytes


#: A message to an actor: of ROS the first, of OpenIGTLink the decoded message.
Received = RosReceived | Message


@dataclass(frozen=True, slots=True)
class ActorReport:
    """How a scenario went for one actor.

    Attributes:
        good: whether what should have happened has happened.
        lines: for people, one fact a line.
        facts: the same as JSON values.
    """

    good: bool
    lines: tuple[str, ...] = ()
    facts: dict[str, Any] = field(default_factory=dict)


@runtime_checkable
class Preparable(Protocol):
    """An actor that has something to compute first; live, before the story begins."""

    def prepare(self) -> None:
        """Compute it, once; without it, it is computed when it is needed."""


class Actor(Protocol):
    """One program of a scenario.

    Attributes:
        name: lower case, unique in its scenario; the ROS node or the OpenIGTLink program is called so.
        side: what it speaks.
        subscribes: ROS topic → type of its subscriptions; an actor of OpenIGTLink receives all messages to it.
        publishes: ROS topic → type and durability: a publisher has to be found by its readers before it begins.
            Empty for an actor of OpenIGTLink.
    """

    name: str
    side: ActorProtocol
    subscribes: dict[str, str]
    publishes: dict[str, Publishes]

    def begin(self, now_ns: int) -> None:
        """The connection is up, or the node has found its peers.  Called once, before all else."""

    @property
    def due_ns(self) -> int | None:
        """Its next due time, UTC ns; None: not before it receives a message."""

    def act(self, now_ns: int) -> Iterable[Sent]:
        """The messages that it sends now that it is due."""

    def receive(self, now_ns: int, received: Received) -> Iterable[Sent]:
        """What it answers to a message."""

    @property
    def done(self) -> bool:
        """Whether its part is over; the scenario ends when that of every actor is."""

    def report(self) -> ActorReport:
        """How it went."""
