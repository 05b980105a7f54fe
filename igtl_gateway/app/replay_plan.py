"""The plan of a replay: which entries it sends to which side, and the functions that send them."""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence, Set
from dataclasses import dataclass
from itertools import chain, groupby
from operator import itemgetter

from igtl_gateway.app.replay_listeners import Listeners
from igtl_gateway.app.replay_settings import Side
from igtl_gateway.app.rows import send_row
from igtl_gateway.base.errors import ConfigError, RosError
from igtl_gateway.base.near import did_you_mean, near_streams, unmatched, without_match
from igtl_gateway.base.qos import Qos
from igtl_gateway.config.configuration import Config
from igtl_gateway.edges.ros.edge import RosEdge
from igtl_gateway.edges.tcp import TcpEdge
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.replay.latched import latched_state_rule, part_of_session
from igtl_gateway.replay.source import first_form_only, is_stream_of, one_side_of_relay, select_entries, through_gateway

#: QoS of topics without one in the file.
PLAYED_QOS = Qos(depth=100)

#: Kinds of entries for each side: preferably what the gateway sent to it, else what it sent to the gateway.
_OUTPUTS = {"igtl": Kind.IGTL_OUT, "ros": Kind.ROS_OUT}
_SIDES_INPUTS = {"igtl": Kind.IGTL_IN, "ros": Kind.ROS_IN}
_IGTL = frozenset({Kind.IGTL_IN, Kind.IGTL_OUT})
_RECOMPUTED = "outputs that this version computes from the recorded inputs"

#: Messages by which programs ask, answer and show that they are there: types, and beginnings of types.
_ASKING = ("GET_", "STT_", "STP_", "RTS_")
_ANSWERS = frozenset({"STATUS", "CAPABILITY"})

#: Number of streams that an error names.
_NAMED_STREAMS = 12

#: Interval of the checks of the stop event.
_POLL_S = 0.2

#: Sends one entry; returns whether a peer was connected or ROS received it.  Raises RosError if ROS refuses it.
Send = Callable[[Entry], bool]
#: Sends several entries; returns the same.
SendAll = Callable[[Sequence[Entry]], bool]


@dataclass(frozen=True, slots=True)
class ReplayPlan:
    """The entries that a replay sends.

    Attributes:
        kinds: the kinds of entries that are sent.
        recompute: whether the gateway of this version computes the outputs again from the recorded inputs.
        why: description for people.
    """

    kinds: frozenset[Kind]
    recompute: bool
    why: str


def plan_replay(file: SessionFile, to: str, recompute: bool, side: Side = "") -> ReplayPlan:
    """Return the plan for a target (``igtl``, ``ros`` or ``both``) and the side whose messages it receives.

    ``gateway``: the recorded outputs of the gateway.  With ``recompute``, or if the recording has only inputs, these
    are computed again.  ``peers``: what the programs of the target sent themselves.  By default ROS receives both, as
    in ``ros2 bag play``, and OpenIGTLink peers receive the outputs; what peers sent, if there are no outputs but
    queries, answers and pings.
    """
    if to == "both":
        igtl, ros = plan_replay(file, "igtl", recompute, side), plan_replay(file, "ros", recompute, side)
        # one log for both: if one side needs recomputed outputs, the other side gets them, too
        why = f"to OpenIGTLink {igtl.why}; to ROS {ros.why}"
        return ReplayPlan(igtl.kinds | ros.kinds, igtl.recompute or ros.recompute, why)
    present = {channel.kind for channel in file.channels if channel.count}
    output, own = _OUTPUTS[to], _SIDES_INPUTS[to]
    feeding = Kind.ROS_IN if to == "igtl" else Kind.IGTL_IN
    recompute = recompute or (feeding in present and output not in present)
    if to == "ros":
        # messages of ROS nodes are part of the traffic of a ROS graph, as in `ros2 bag play`
        side = side or "both"
    elif not side and not recompute and (instead := _peers_instead(file, present)):
        return ReplayPlan(frozenset({own}), False, instead)
    kinds = frozenset({own} if side == "peers" else {own, output} if side == "both" else {output})
    recompute = recompute and output in kinds
    return ReplayPlan(kinds, recompute, _why(to, side, recompute))


def is_of_dialogue(igtl_type: str) -> bool:
    """Return whether messages of a type ask, answer or show that the sender is there, and carry no data of devices."""
    return igtl_type.startswith(_ASKING) or igtl_type in _ANSWERS


def _peers_instead(file: SessionFile, present: Set[Kind]) -> str:
    """Return why OpenIGTLink peers receive what peers sent, and not the recorded outputs; "" if they receive these."""
    if Kind.IGTL_OUT not in present:
        return "the recorded messages from peers (none were sent to peers)"
    sent, received = (
        {channel.stream for channel in file.channels if channel.count and channel.kind is kind}
        for kind in (Kind.IGTL_OUT, Kind.IGTL_IN)
    )
    # a stream without a name shares its channel with others, of any type
    if all(name and is_of_dialogue(name.partition("/")[0]) for name in sent) and not all(
        is_of_dialogue(name.partition("/")[0]) for name in received
    ):
        types = ", ".join(sorted({name.partition("/")[0] for name in sent}))
        return f"the recorded messages from peers (only {types} was sent to peers: --side gateway)"
    return ""


def _why(to: str, side: Side, recompute: bool) -> str:
    """Return the description of a plan for people."""
    if to == "igtl":
        own, recorded = "the recorded messages from peers", "the recorded bytes"
    else:
        own, recorded = "the messages that ROS nodes published", "the recorded messages of the gateway"
    outputs = _RECOMPUTED if recompute else recorded
    if to == "ros" and side == "both" and not recompute:
        return "the recorded ROS messages"
    return {"peers": own, "both": f"{outputs}, and {own}"}.get(side, outputs)


def check_streams(
    file: SessionFile, config: Config, how: ReplayPlan, streams: Sequence[str], place: str = "--streams"
) -> list[str]:
    """Return the globs that match no stream of the plan, each with a near name if there is one.

    If outputs are computed again, or streams share a channel of the file, :func:`unplayed` finds them at the end.
    Raises ConfigError if none of them matches one: a replay of nothing should not wait for peers.  If outputs are
    computed again, or streams share a channel of the file, the entries are read until one matches.
    """
    found = {channel.stream for channel in file.channels if channel.count and channel.kind in how.kinds}
    without = without_match(streams, found)
    is_known = not how.recompute and all(found)
    if len(without) < len(streams) or not streams:
        return [f"{glob}: {unmatched(glob, found)}" for glob in without] if is_known else []
    if not is_known:
        found = set()
        for entry in planned_entries(file, config, how, ()):
            if is_stream_of(entry.kind, entry.channel, streams):
                return []
            found.add(entry.channel)
    names = sorted(found)
    few = ", ".join(names[:_NAMED_STREAMS]) + (" …" if len(names) > _NAMED_STREAMS else "")
    expected = f"one of these streams: {few}" if names else "a recording with messages for this side"
    question = did_you_mean(near for glob in without for near in near_streams(glob, names))
    text = f"{place}: found {', '.join(map(repr, without))}, expected {expected}"
    raise ConfigError(f"{text}; {question}" if question else text)


def unplayed(streams: Iterable[str], played: Iterable[str]) -> list[str]:
    """Return the globs that match no stream that was played, each with a near name if there is one.

    Args:
        streams: the globs.
        played: ``TYPE/device`` or topics.
    """
    names = set(played)
    return [f"{glob}: {unmatched(glob, names, 'stream of the replay')}" for glob in without_match(streams, names)]


def check_sends(file: SessionFile, how: ReplayPlan, sends: Sequence[str]) -> None:
    """Raise ConfigError for a row of ``--send`` without effect: nothing is computed, or no ROS node sent the topic."""
    topics = {channel.topic for channel in file.channels if channel.count and channel.kind is Kind.ROS_IN}
    for text in sends:
        if not how.recompute:
            raise ConfigError(
                "--send: found recorded outputs, expected --through-gateway: the option has no effect here"
            )
        if send_row(text)["topic"] not in topics:
            few = ", ".join(sorted(topics)[:_NAMED_STREAMS]) or "a recording of ROS topics"
            raise ConfigError(f"--send: found {text!r}, expected a topic that ROS nodes sent: {few}")


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
    """Return the entries of a plan, in order, from ``start_ns`` to ``end_ns`` (UTC ns).

    Messages that were latched before ``start_ns`` come first; the index of the file finds them.  If outputs are
    computed again, or the recording is of a relay, the file is read from its beginning: the outputs depend on all
    earlier inputs, and the receivers of a relay's messages follow from the earlier links.

    Args:
        role: in a relay's recording, the sender of the messages: ``"server"`` or ``"client"``.
        passed_over: counts the recorded messages of the side that are not sent, by reason.
        made: counts the computed outputs, by kind.
    """
    latched = {(channel.topic, channel.type) for channel in file.channels if channel.qos and channel.qos.latched}

    def is_latched(topic: str, ros_type: str) -> bool:
        return (topic, ros_type) in latched

    if how.recompute or config.relay:
        found = file.entries()
    elif start_ns is None:
        found = file.entries_of_kinds(how.kinds)
    else:
        found = file.entries_with_state(start_ns, latched_state_rule(is_latched))
    if how.recompute:
        has_links = any(c.kind is Kind.LINK for c in file.channels if c.count)
        entries = through_gateway(found, config, has_links=has_links, before=file.prologue(), made=made)
    else:
        entries = chain((entry for entry in file.prologue() if entry.kind.is_input), found)
    # a relay sends one form of a message, and with fault injection several messages of a stream after one input
    mine = passed_over if Kind.IGTL_OUT in how.kinds else None
    entries = one_side_of_relay(role, entries, mine) if config.relay else first_form_only(entries, mine)
    return select_entries(part_of_session(entries, start_ns, end_ns, is_latched), how.kinds, streams, passed_over)


def connected(edge: TcpEdge) -> list[int]:
    """Return the numbers of the connected links."""
    return [link.number for link in edge.links() if link.connected]


def igtl_sender_of_many(edge: TcpEdge, listeners: Listeners, stop: threading.Event) -> SendAll:
    """Return a function that sends several entries to every peer that can read them, without lock-step.

    Once ``stop`` is set, it does not wait for full queues.
    """

    def send(entries: Sequence[Entry]) -> bool:
        links = connected(edge)
        for to, members in groupby(listeners.fit_all(entries, links), key=itemgetter(1)):
            edge.send_all(to, [(payload, channel) for payload, _, channel in members], stop.is_set)
        return bool(links)

    return send


def igtl_sender(edge: TcpEdge, listeners: Listeners, stop: threading.Event | None = None) -> Send:
    """Return a function that sends an entry to every connected peer that can read it.

    The edge should have ``when_full="block"``: with another setting, a full queue drops messages.

    Args:
        stop: for lock-step: wait after each message until the kernel has accepted it for every peer, or this is set.
    """

    def send(entry: Entry) -> bool:
        links = connected(edge)
        for payload, members in listeners.fit(entry, links):
            edge.send(members, payload, entry.channel, True)
        while stop and not stop.is_set() and not edge.flush(_POLL_S):
            pass
        return bool(links)

    return send


def ros_sender(edge: RosEdge, file: SessionFile, stop: threading.Event | None = None) -> Send:
    """Return a function that publishes an entry on its topic with the recorded quality of service.

    It returns True also without a subscriber.

    Args:
        stop: for lock-step: wait after each message until all reliable subscribers acknowledge it, or this is set.
    """
    offered = {(channel.topic, channel.type): channel.qos for channel in file.channels}

    def send(entry: Entry) -> bool:
        qos = offered.get((entry.channel, entry.type)) or PLAYED_QOS
        if reason := edge.publish(entry.channel, entry.type, entry.data(), qos):
            raise RosError(reason)
        while stop and not stop.is_set() and not edge.wait_acked(entry.channel, _POLL_S):
            pass
        return True

    return send


def both_sender(igtl: Send, ros: Send) -> Send:
    """Return a function that sends each entry to its side."""
    return lambda entry: (igtl if entry.kind in _IGTL else ros)(entry)
