"""The sides of a replay: opened, waited for, closed at the end."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from threading import Event

from igtl_gateway.app.faulty import all_with_disconnects, disconnector, with_disconnects
from igtl_gateway.app.replay_calls import Calls, is_of_calls, open_calls
from igtl_gateway.app.replay_listeners import Listeners
from igtl_gateway.app.replay_options import ReplayOptions
from igtl_gateway.app.replay_plan import (
    PLAYED_QOS,
    ReplayPlan,
    Send,
    SendAll,
    both_sender,
    connected,
    igtl_sender,
    igtl_sender_of_many,
    ros_sender,
)
from igtl_gateway.base.buffers import Buffer
from igtl_gateway.base.clock import SystemClock
from igtl_gateway.base.stamp import NS_PER_MS, ns_to_ticks
from igtl_gateway.config.notations import uses_websocket
from igtl_gateway.edges.ros.edge import RosEdge
from igtl_gateway.edges.ros.env import prepare_environment
from igtl_gateway.edges.ros.host import NodeHost
from igtl_gateway.edges.tcp import LinkCounters, TcpEdge
from igtl_gateway.edges.tcp.sockets import address_text
from igtl_gateway.gateway.dialogue.probing import REPLAY_REPLY, REPLY_DEVICE
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.note import Note
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.replay.recorded_config import recorded_acceptance
from igtl_gateway.replay.simclock import CLOCK_TOPIC, CLOCK_TYPE
from igtl_gateway.replay.source import matches_any
from igtl_gateway.wire import Message, encode

_FLUSH_S = 30.0
_LOOK_S = 0.2
#: Longest wait for the discovery of servers that are called.
_SERVERS_S = 2.0
#: Longest wait for the first message of peers, which may show what they are; 3D Slicer sends one at once.
_HELLO_NS, _HELLO_LOOK_S = 500 * NS_PER_MS, 0.01
#: `doctor` announces itself within this time.
_LEAST_NS = 300 * NS_PER_MS

OnLine = Callable[[str], None]


@dataclass(slots=True)
class ReplaySides:
    """The open sides.

    Attributes:
        send: sends one entry.
        finish: waits until all that was sent is on its way; False if that took too long.
        ros: the edge, where ROS is driven.
        send_all: sends several; None: they go one by one.
        admit: returns an entry as the connected peers can read it; None if none of them can.
        admit_all: the same for several, without those that none can read; None: they go one by one.
        listeners: the OpenIGTLink peers; None: there is no such side.
        failed: topic → messages that ROS did not take, at the end.
        traffic: link → its traffic so far.
        calls: what is done with recorded services and actions; None: nothing.
        undelivered: messages that did not leave for their peer, once for each peer; and whether there was never more
            than one peer at a time, so that no peer received these messages.  Called when the edge is closed.
    """

    send: Send
    finish: Callable[[], bool]
    ros: RosEdge | None = None
    send_all: SendAll | None = None
    admit: Callable[[Entry], Entry | None] = lambda entry: entry
    admit_all: Callable[[Sequence[Entry]], Sequence[Entry]] | None = None
    listeners: Listeners | None = None
    failed: Callable[[], Mapping[str, int]] = dict
    calls: Calls | None = None
    traffic: Callable[[], Mapping[int, LinkCounters]] = dict
    undelivered: Callable[[], tuple[int, bool]] = lambda: (0, True)


def open_sides(
    options: ReplayOptions,
    file: SessionFile,
    how: ReplayPlan,
    stop: Event,
    stack: ExitStack,
    tell: OnLine,
    *,
    relay: bool = False,
) -> ReplaySides | None:
    """The side or sides of ``--to``, once all that is waited for is there; None if ``stop`` came first.

    ``relay``: whether the recording is of a relay.
    """
    igtl = ros = None
    if options.to != "igtl":
        # before waiting for peers: a missing ROS is reported immediately
        prepare_environment(lock_step=options.lock_step)
        RosEdge.check()
    if options.to != "ros":
        igtl = _open_igtl(options, file, stop, stack, tell, relay=relay)
        if igtl is None:
            return None
    if options.to != "igtl":
        ros = _open_ros(options, file, how, stop, stack, tell)
        if ros is None:
            return None
    if igtl and ros:
        finishes = (igtl.finish, ros.finish)
        return ReplaySides(
            both_sender(igtl.send, ros.send),
            lambda: all([finish() for finish in finishes]),
            ros.ros,
            admit=igtl.admit,
            listeners=igtl.listeners,
            failed=ros.failed,
            calls=ros.calls,
            traffic=igtl.traffic,
            undelivered=igtl.undelivered,
        )
    return igtl or ros


def _open_igtl(
    options: ReplayOptions, file: SessionFile, stop: Event, stack: ExitStack, tell: OnLine, *, relay: bool
) -> ReplaySides | None:
    """A sender to OpenIGTLink peers, once they are there."""
    listeners = Listeners(options.profile, options.exact, relay, recorded_acceptance(file))
    peers = _Peers(tell, listeners)
    clock = SystemClock()

    def on_frame(link: int, data: Buffer) -> None:
        """Take a message of a listener: it is outside of the replay, but shows what the peer is."""
        if listeners.on_frame(link, data) and not peers.begun:
            tell("= igtl-gateway doctor looks at this replay: it does not count as a peer")
            reply = Message("STATUS", REPLY_DEVICE, REPLAY_REPLY, ns_to_ticks(clock.utc_ns()))
            edge.send((link,), encode(reply), f"STATUS/{REPLY_DEVICE}", True)

    edge = TcpEdge(
        on_frame=on_frame,
        on_link=peers,
        on_note=lambda _link, note: tell(f"! {note.text}"),
        clock=clock,
        allow=options.allow,
        when_full="block",
        tls=options.tls,
        origins=options.allow_origin,
    )
    stack.callback(edge.stop)
    for address in options.listen:
        host, port = edge.listen(*address, tls=address in options.tls_listen, websocket=uses_websocket(address))
        tell(f"OpenIGTLink server on {address_text((host, port))}")
    for address in options.connect:
        edge.connect(*address, tls=address in options.tls_connect)
    edge.start()
    wanted = 1 if options.wait_peers is None else options.wait_peers
    if wanted:
        tell(f"waiting for {wanted:,} peer{'s' * (wanted != 1)}")
    if not _wait_for_peers(edge, listeners, wanted, clock, stop):
        return None
    peers.begun = True
    send = igtl_sender(edge, listeners, stop if options.lock_step else None)
    send_all = None if options.lock_step else igtl_sender_of_many(edge, listeners, stop)
    if options.fault:
        disconnect = disconnector(edge, stop)
        send, send_all = with_disconnects(send, disconnect), send_all and all_with_disconnects(send_all, disconnect)

    def undelivered() -> tuple[int, bool]:
        gone = edge.counters()[0]
        return sum(gone.dropped.values()) + sum(gone.ignored.values()), peers.most <= 1

    return ReplaySides(
        send,
        lambda: edge.flush(0.0 if stop.is_set() else _FLUSH_S),
        send_all=send_all,
        admit=lambda entry: listeners.admit(entry, connected(edge)),
        admit_all=lambda entries: listeners.admit_all(entries, connected(edge)),
        listeners=listeners,
        traffic=edge.counters,
        undelivered=undelivered,
    )


def _wait_for_peers(edge: TcpEdge, listeners: Listeners, wanted: int, clock: SystemClock, stop: Event) -> bool:
    """Wait until this number of peers is there and may have shown what they are; False if ``stop`` came first.

    One that goes at once, such as a scan of ports, and `doctor`, which announces itself, do not count.
    """

    def counted() -> int:
        return sum(link not in listeners.probes for link in connected(edge))

    while True:
        while not edge.wait_links(wanted, _LOOK_S) or counted() < wanted:
            if stop.wait(_HELLO_LOOK_S):
                return False
        if not wanted:
            return True
        begun_ns = clock.monotonic_ns()
        while (waited_ns := clock.monotonic_ns() - begun_ns) < _HELLO_NS and not stop.wait(_HELLO_LOOK_S):
            if not listeners.has_silent or (waited_ns >= _LEAST_NS and not listeners.awaits_hello):
                break
        if counted() >= wanted or stop.is_set():
            return True


@dataclass(slots=True)
class _Peers:
    """Reports links, and counts how many are up at a time."""

    tell: OnLine
    listeners: Listeners
    most: int = 0
    begun: bool = False
    _up: set[int] = field(default_factory=set)

    def __call__(self, link: int, up: bool, note: Note) -> None:
        self.tell(f"= {note.text}")
        self.listeners.on_link(link, up, note)
        (self._up.add if up else self._up.discard)(link)
        self.most = max(self.most, len(self._up))


def _open_ros(
    options: ReplayOptions, file: SessionFile, how: ReplayPlan, stop: Event, stack: ExitStack, tell: OnLine
) -> ReplaySides | None:
    """A sender to the ROS graph, its topics advertised."""
    edge = RosEdge(
        host=NodeHost("igtl_gateway_replay", arguments=options.ros_args),
        on_message=lambda *_: None,
        wants=lambda *_: None,
        on_note=lambda note: tell(f"= {note.text}"),
    )
    edge.start()
    stack.callback(edge.stop)
    channels = [
        channel
        for channel in file.channels
        if channel.kind in how.kinds and matches_any(channel.topic, options.streams)
    ]
    calls = open_calls(options.services, file, [each.topic for each in channels if each.kind is Kind.ROS_IN], edge)
    if calls:
        channels = [each for each in channels if each.kind is not Kind.ROS_IN or each.topic not in calls.instead]
    for channel in channels:
        edge.advertise(channel.topic, channel.type, channel.qos or PLAYED_QOS)
    if options.clock_hz:
        edge.advertise(CLOCK_TOPIC, CLOCK_TYPE, PLAYED_QOS)
    # nodes subscribe to the topics of services and actions only if they look into them
    waited_for = {channel.topic for channel in channels if not is_of_calls(channel.topic)}
    for topic in sorted(waited_for):
        while options.wait_peers and not edge.wait_for_subscribers(topic, options.wait_peers, _LOOK_S):
            if stop.is_set():
                return None
    # existing subscribers must receive the first message too
    while not edge.wait_ready(_LOOK_S):
        if stop.is_set():
            return None
    if calls:  # the graph is known, and what it serves
        calls.start(options.rate, tell)
        calls.wait_for_servers(_SERVERS_S)
    while calls and options.wait_peers and not calls.wait_for_servers(_LOOK_S):
        if stop.is_set():
            return None
    publish = ros_sender(edge, file, stop if options.lock_step else None)

    def send(entry: Entry) -> bool:
        return bool(calls and entry.channel in calls.instead and calls.send(entry)) or publish(entry)

    def finish() -> bool:
        if calls:
            calls.finish(stop)
        return stop.is_set() or edge.wait_ready(_FLUSH_S)

    def failed() -> Mapping[str, int]:
        return {
            topic: counts["failed"]
            for topic, counts in edge.counters().items()
            if counts["failed"] and not (options.clock_hz and topic == CLOCK_TOPIC)
        }

    return ReplaySides(send if calls else publish, finish, edge, failed=failed, calls=calls)
