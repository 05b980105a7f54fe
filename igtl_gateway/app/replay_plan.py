"""What a replay sends to which side, and by what."""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import chain

from igtl_gateway.config import Config
from igtl_gateway.edges.ros.edge import RosEdge
from igtl_gateway.edges.tcp import TcpEdge
from igtl_gateway.errors import RosError
from igtl_gateway.qos import Qos
from igtl_gateway.replay.latched import latched_state_rule, part_of_session
from igtl_gateway.replay.source import first_form_only, one_side_of_relay, select_entries, through_gateway
from igtl_gateway.session.entry import Entry, Kind
from igtl_gateway.sessionfile.reader import SessionFile

#: For topics of which the file tells no quality of service.
PLAYED_QOS = Qos(depth=100)

#: What goes to each side, by preference: what the gateway sent; else what could stand for it.
_OUTPUTS = {"igtl": Kind.IGTL_OUT, "ros": Kind.ROS_OUT}
_SIDES_INPUTS = {"igtl": Kind.IGTL_IN, "ros": Kind.ROS_IN}
_IGTL = frozenset({Kind.IGTL_IN, Kind.IGTL_OUT})

#: Between two looks at the stop event.
_LOOK_S = 0.2

#: Sends one entry; tells whether anybody was there.  Raises RosError where ROS refuses it.
Send = Callable[[Entry], bool]
#: The same of several.
SendAll = Callable[[Sequence[Entry]], bool]


@dataclass(frozen=True, slots=True)
class ReplayPlan:
    """What a replay sends, and why.

    Attributes:
        kinds: the kinds of entries that are sent.
        recompute: the inputs go through today's gateway first.
        why: one sentence for people.
    """

    kinds: frozenset[Kind]
    recompute: bool
    why: str


def plan_replay(file: SessionFile, side: str, recompute: bool) -> ReplayPlan:
    """How to drive a side (``igtl``, ``ros``, ``both``): as it was, through the gateway, or by what it said itself."""
    if side == "both":
        igtl, ros = plan_replay(file, "igtl", recompute), plan_replay(file, "ros", recompute)
        # one log for both: what one side needs computed, the other gets computed as well
        why = f"to OpenIGTLink {igtl.why}; to ROS {ros.why}"
        return ReplayPlan(igtl.kinds | ros.kinds, igtl.recompute or ros.recompute, why)
    present = {channel.kind for channel in file.channels if channel.count}
    output, own = _OUTPUTS[side], _SIDES_INPUTS[side]
    feeding = Kind.ROS_IN if side == "igtl" else Kind.IGTL_IN
    if side == "ros":
        # what ROS nodes said themselves is part of what a ROS graph heard that day, as in `ros2 bag play`
        kinds = frozenset({output, own})
        if recompute or (feeding in present and output not in present):
            return ReplayPlan(kinds, True, "recorded inputs through today's gateway, and what ROS nodes published")
        return ReplayPlan(kinds, False, "what was published that day")
    if recompute or (feeding in present and output not in present):
        return ReplayPlan(frozenset({output}), True, "recorded inputs through today's gateway")
    if output in present:
        return ReplayPlan(frozenset({output}), False, "the bytes that were sent that day")
    return ReplayPlan(frozenset({own}), False, "what the peers sent that day (nothing was sent to them)")


def planned_entries(
    file: SessionFile,
    config: Config,
    how: ReplayPlan,
    streams: Iterable[str],
    start_ns: int | None = None,
    end_ns: int | None = None,
    role: str = "server",
    passed_over: Counter[str] | None = None,
    made: Counter[Kind] | None = None,
) -> Iterator[Entry]:
    """The entries of a plan, in order; those that were latched before ``start_ns`` (UTC) first, none after ``end_ns``.

    What was latched is looked up by the index.  But the gateway is fed from the beginning in any case: what it says
    depends on all that it was told; and to whom a relay spoke, its links tell.

    Args:
        role: whose words of a relay's recording are played: those of the ``"server"`` or of the ``"client"``.
        passed_over: counts what is recorded for the side, but not sent, by reason.
        made: counts the outputs of today's gateway.
    """
    latched = {(channel.topic, channel.type) for channel in file.channels if channel.qos and channel.qos.latched}

    def is_latched(topic: str, ros_type: str) -> bool:
        return (topic, ros_type) in latched

    if how.recompute or config.relay:
        found = file.entries()
    elif start_ns is None:
        found = file.entries_of(how.kinds)
    else:
        found = file.entries_from(start_ns, latched_state_rule(is_latched))
    entries: Iterable[Entry] = chain(file.prologue(), found)
    if how.recompute:
        has_links = any(c.kind is Kind.LINK for c in file.channels if c.count)
        entries = through_gateway(entries, config, has_links=has_links, made=made)
    # a relay sends in one form only, and with faults several messages of a stream behind one input
    mine = passed_over if Kind.IGTL_OUT in how.kinds else None
    entries = one_side_of_relay(role, entries, mine) if config.relay else first_form_only(entries, mine)
    return select_entries(part_of_session(entries, start_ns, end_ns, is_latched), how.kinds, streams, passed_over)


def igtl_sender_of_many(edge: TcpEdge, stop: threading.Event) -> SendAll:
    """As :func:`igtl_sender`, not in lock-step, for many entries at a time; once ``stop`` is set it waits no more."""

    def send(entries: Sequence[Entry]) -> bool:
        links = [link.number for link in edge.links() if link.connected]
        edge.send_all(links, [(entry.payload, entry.channel) for entry in entries], stop.is_set)
        return bool(links)

    return send


def igtl_sender(edge: TcpEdge, stop: threading.Event | None = None) -> Send:
    """Sends to every peer that is there.  The edge should have been made with ``when_full="block"``.

    Args:
        stop: lock-step: a message is waited for until the kernel has taken it for every peer, or this is set.
    """

    def send(entry: Entry) -> bool:
        links = [link.number for link in edge.links() if link.connected]
        edge.send(links, entry.payload, entry.channel, True)
        while stop and not stop.is_set() and not edge.flush(_LOOK_S):
            pass
        return bool(links)

    return send


def ros_sender(edge: RosEdge, file: SessionFile, stop: threading.Event | None = None) -> Send:
    """Publishes on the recorded topics with the recorded quality of service; a graph always counts as listening.

    Args:
        stop: lock-step: a message is waited for until every reliable reader has acknowledged it, or this is set.
    """
    offered = {(channel.topic, channel.type): channel.qos for channel in file.channels}

    def send(entry: Entry) -> bool:
        qos = offered.get((entry.channel, entry.type)) or PLAYED_QOS
        if reason := edge.publish(entry.channel, entry.type, entry.data(), qos):
            raise RosError(reason)
        while stop and not stop.is_set() and not edge.wait_acked(entry.channel, _LOOK_S):
            pass
        return True

    return send


def both_sender(igtl: Send, ros: Send) -> Send:
    """Each entry to its side."""
    return lambda entry: (igtl if entry.kind in _IGTL else ros)(entry)
