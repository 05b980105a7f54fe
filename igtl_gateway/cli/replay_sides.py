"""The sides of ``replay``: opened, waited for, closed at the end."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field
from threading import Event

from igtl_gateway.app.faulty import all_with_disconnects, disconnector, with_disconnects
from igtl_gateway.app.replay_plan import (
    PLAYED_QOS,
    ReplayPlan,
    Send,
    SendAll,
    both_sender,
    igtl_sender,
    igtl_sender_of_many,
    ros_sender,
)
from igtl_gateway.cli import admission
from igtl_gateway.cli.common import count_text
from igtl_gateway.cli.options import addresses
from igtl_gateway.clock import SystemClock
from igtl_gateway.edges.ros.edge import RosEdge
from igtl_gateway.edges.ros.env import prepare_environment
from igtl_gateway.edges.tcp import TcpEdge
from igtl_gateway.replay.simclock import CLOCK_TOPIC, CLOCK_TYPE
from igtl_gateway.replay.source import matches_any
from igtl_gateway.session.note import Note
from igtl_gateway.sessionfile.reader import SessionFile

_FLUSH_S = 30.0
_LOOK_S = 0.2

Tell = Callable[[str], None]


@dataclass(slots=True)
class ReplaySides:
    """The open sides.

    Attributes:
        send: sends one entry.
        finish: waits until all that was sent is on its way; False if that took too long.
        ros: the edge, where ROS is driven.
        send_all: sends several; None: they go one by one.
        failed: topic → messages that ROS did not take, at the end.
        undelivered: messages that did not leave for their peer, once for each peer; and whether there was never more
            than one peer at a time, so that no peer received these messages.  Called when the edge is closed.
    """

    send: Send
    finish: Callable[[], bool]
    ros: RosEdge | None = None
    send_all: SendAll | None = None
    failed: Callable[[], Mapping[str, int]] = dict
    undelivered: Callable[[], tuple[int, bool]] = lambda: (0, True)


def open_sides(
    options: argparse.Namespace, file: SessionFile, how: ReplayPlan, stop: Event, stack: ExitStack, tell: Tell
) -> ReplaySides | None:
    """The side or sides of ``--to``, once all that is waited for is there; None if ``stop`` came first."""
    igtl = ros = None
    if options.to != "igtl":
        # before waiting for peers: a missing ROS is reported immediately
        prepare_environment(lock_step=options.speed_of_light)
        RosEdge.check()
    if options.to != "ros":
        igtl = _open_igtl(options, stop, stack, tell)
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
            failed=ros.failed,
            undelivered=igtl.undelivered,
        )
    return igtl or ros


def _open_igtl(options: argparse.Namespace, stop: Event, stack: ExitStack, tell: Tell) -> ReplaySides | None:
    """A sender to OpenIGTLink peers, once they are there."""
    listen, connect = addresses(options.listen, options.connect)
    tls_listen, tls_connect = admission.secured(vars(options), listen, connect)
    peers = _Peers(tell)
    edge = TcpEdge(
        on_frame=lambda _link, _message: None,  # messages of peers are not part of a replay
        on_link=peers,
        on_note=lambda _link, note: tell(f"! {note.text}"),
        clock=SystemClock(),
        allow=tuple(options.allow),
        when_full="block",
        tls=admission.tls(vars(options)),
    )
    stack.callback(edge.stop)
    for address in listen:
        host, port = edge.listen(*address, tls=address in tls_listen)
        tell(f"OpenIGTLink server on {host}:{port}")
    for address in connect:
        edge.connect(*address, tls=address in tls_connect)
    edge.start()
    wanted = 1 if options.wait_peers is None else options.wait_peers
    if wanted:
        tell(f"waiting for {count_text(wanted, 'peer')}")
    while not edge.wait_links(wanted, _LOOK_S):
        if stop.is_set():
            return None
    send = igtl_sender(edge, stop if options.speed_of_light else None)
    send_all = None if options.speed_of_light else igtl_sender_of_many(edge, stop)
    if options.fault:
        disconnect = disconnector(edge, stop)
        send, send_all = with_disconnects(send, disconnect), send_all and all_with_disconnects(send_all, disconnect)

    def undelivered() -> tuple[int, bool]:
        gone = edge.counters()[0]
        return sum(gone.dropped.values()) + sum(gone.ignored.values()), peers.most <= 1

    return ReplaySides(
        send, lambda: edge.flush(0.0 if stop.is_set() else _FLUSH_S), send_all=send_all, undelivered=undelivered
    )


@dataclass(slots=True)
class _Peers:
    """Reports links, and counts how many are up at a time."""

    tell: Tell
    most: int = 0
    _up: set[int] = field(default_factory=set)

    def __call__(self, link: int, up: bool, note: Note) -> None:
        self.tell(f"= {note.text}")
        (self._up.add if up else self._up.discard)(link)
        self.most = max(self.most, len(self._up))


def _open_ros(
    options: argparse.Namespace, file: SessionFile, how: ReplayPlan, stop: Event, stack: ExitStack, tell: Tell
) -> ReplaySides | None:
    """A sender to the ROS graph, its topics advertised."""
    edge = RosEdge(
        node_name="igtl_gateway_replay",
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
    for channel in channels:
        edge.advertise(channel.topic, channel.type, channel.qos or PLAYED_QOS)
    if options.clock:
        edge.advertise(CLOCK_TOPIC, CLOCK_TYPE, PLAYED_QOS)
    for topic in sorted({channel.topic for channel in channels}):
        while options.wait_peers and not edge.wait_for_subscribers(topic, options.wait_peers, _LOOK_S):
            if stop.is_set():
                return None
    # existing subscribers must receive the first message too
    while not edge.wait_ready(_LOOK_S):
        if stop.is_set():
            return None
    send = ros_sender(edge, file, stop if options.speed_of_light else None)

    def failed() -> Mapping[str, int]:
        return {
            topic: counts["failed"]
            for topic, counts in edge.counters().items()
            if counts["failed"] and not (options.clock and topic == CLOCK_TOPIC)
        }

    return ReplaySides(send, lambda: stop.is_set() or edge.wait_ready(_FLUSH_S), edge, failed=failed)
