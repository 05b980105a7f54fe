"""``igtl-gateway replay``: a recording drives OpenIGTLink peers or a ROS graph."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from contextlib import ExitStack, suppress
from pathlib import Path
from threading import Event
from typing import Any

from igtl_gateway.app.player import PLAYED_QOS, Plan, Player, igtl_sender, plan, planned, ros_sender
from igtl_gateway.cli.common import (
    add_addresses,
    add_send,
    addresses,
    count,
    print_json,
    recorded_config,
    size,
    stop_event,
    with_sends,
)
from igtl_gateway.clock import SystemClock
from igtl_gateway.edges.tcp import TcpEdge
from igtl_gateway.errors import ConfigError, GatewayError
from igtl_gateway.replay.mcap_reader import SessionFile
from igtl_gateway.replay.playback import PlaybackClock
from igtl_gateway.replay.source import fits
from igtl_gateway.session.entry import Entry

EXAMPLES = """\
  igtl-gateway replay fixtures/star.mcap --to igtl                 serve the session to the first client
  igtl-gateway replay out.mcap --to igtl --as-fast-as-possible     the same bytes in the same order, at once
  igtl-gateway replay out.mcap --to igtl --connect 127.0.0.1:18944 be the client
  igtl-gateway replay out.mcap --to ros --rate 0.5                 publish what ROS heard, at half speed
  igtl-gateway replay out.mcap --to igtl --through-gateway         recorded inputs through today's converters
  igtl-gateway replay bag.mcap --to igtl --send /camera/image=Cam  a rosbag2 MCAP file: its topics as devices
  igtl-gateway replay out.mcap --to igtl --streams 'IMAGE/*'       some streams only

At every rate the same messages go out in the same order; a slow reader slows the replay down, nothing is dropped."""

_FLUSH_S = 30.0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("file", metavar="FILE", type=Path, help="a recording, or a rosbag2 MCAP file")
    parser.add_argument("--to", choices=("igtl", "ros"), required=True, help="the side to drive")
    add_addresses(parser)
    parser.add_argument("--through-gateway", action="store_true", help="send what today's gateway makes of the inputs")
    parser.add_argument(
        "--config", type=Path, metavar="TOML", help="with --through-gateway: instead of the recorded one"
    )
    add_send(parser)
    pace = parser.add_mutually_exclusive_group()
    pace.add_argument("--rate", type=float, default=1.0, metavar="R", help="recorded seconds per second (%(default)s)")
    pace.add_argument("--as-fast-as-possible", action="store_true", help="no pauses")
    parser.add_argument(
        "--wait-peers",
        type=int,
        metavar="N",
        help="begin when N peers are connected (default 1), or N ROS subscribers are there on each topic (default 0)",
    )
    parser.add_argument(
        "--streams", action="append", default=[], metavar="GLOB", help="only these: TYPE/device, device or topic"
    )
    parser.add_argument("--json", action="store_true", help="print the outcome as one JSON object")


def run(options: argparse.Namespace) -> int:
    rate = None if options.as_fast_as_possible else options.rate
    PlaybackClock(rate, SystemClock().monotonic_ns)  # refuses a bad rate before anything is opened
    if options.wait_peers is not None and options.wait_peers < 0:
        raise ConfigError(f"--wait-peers: found {options.wait_peers}, expected 0 or more")
    with SessionFile.open(options.file) as file, stop_event() as stop, ExitStack() as stack:
        config = with_sends(recorded_config(file.session, options.config), options.send)
        how = plan(file, options.to, options.through_gateway)
        entries = planned(file, config, how, options.streams)
        _tell(options, f"{options.file}: {how.why}")
        open_side = _open_igtl if options.to == "igtl" else _open_ros
        send, finish = open_side(options, file, how, stop, stack)
        if send is None:
            _tell(options, "stopped before the replay began")
            return 1
        player = Player(entries, send, rate, SystemClock(), stop)
        try:
            player.run()
        finally:
            complete = finish() and not stop.is_set()
            _report(options, player, complete)
    if complete and not player.played.messages:
        raise GatewayError(f"{options.file}: nothing in it goes to {options.to}: see `igtl-gateway info`, and --send")
    return 0 if complete else 1


Opened = tuple[Callable[[Entry], bool] | None, Callable[[], bool]]


def _open_igtl(options: argparse.Namespace, _file: SessionFile, _how: Plan, stop: Event, stack: ExitStack) -> Opened:
    """A sender to OpenIGTLink peers, once they are there."""
    edge = TcpEdge(
        on_frame=lambda _link, _message: None,  # what peers say during a replay is not part of it
        on_link=lambda _link, _up, note: _tell(options, f"= {note.text}"),
        on_note=lambda _link, note: _tell(options, f"! {note.text}"),
        clock=SystemClock(),
        allow=tuple(options.allow),
        when_full="block",
    )
    stack.callback(edge.stop)
    listen, connect = addresses(options)
    for address in listen:
        host, port = edge.listen(*address)
        _tell(options, f"OpenIGTLink server on {host}:{port}")
    for address in connect:
        edge.connect(*address)
    edge.start()
    wanted = 1 if options.wait_peers is None else options.wait_peers
    if wanted:
        _tell(options, f"waiting for {count(wanted, 'peer')}")
    while not edge.wait_links(wanted, 0.2):
        if stop.is_set():
            return None, lambda: False
    return igtl_sender(edge), lambda: edge.flush(0.0 if stop.is_set() else _FLUSH_S)


def _open_ros(options: argparse.Namespace, file: SessionFile, how: Plan, stop: Event, stack: ExitStack) -> Opened:
    """A sender to the ROS graph, its topics advertised."""
    from igtl_gateway.edges.ros import RosEdge
    from igtl_gateway.edges.ros_env import prepare_environment

    prepare_environment()
    edge = RosEdge(
        node_name="igtl_gateway_replay",
        on_message=lambda *_: None,
        wants=lambda *_: None,
        on_note=lambda note: _tell(options, f"= {note.text}"),
    )
    edge.start()
    stack.callback(edge.stop)
    channels = [
        channel for channel in file.channels if channel.kind in how.kinds and fits(channel.topic, options.streams)
    ]
    for channel in channels:
        edge.advertise(channel.topic, channel.type, channel.qos or PLAYED_QOS)
    for topic in sorted({channel.topic for channel in channels}):
        while options.wait_peers and not edge.wait_for_subscribers(topic, options.wait_peers, 0.2):
            if stop.is_set():
                return None, lambda: False
    # whoever listens already is to hear the first message too
    while not edge.wait_ready(0.2):
        if stop.is_set():
            return None, lambda: False
    return ros_sender(edge, file), lambda: stop.is_set() or edge.wait_ready(_FLUSH_S)


def _tell(options: argparse.Namespace, text: str) -> None:
    # also called by the edges' threads: whether there still is a reader, the report finds out in ours
    with suppress(BrokenPipeError):
        print(text, file=sys.stderr if options.json else sys.stdout, flush=True)


def _report(options: argparse.Namespace, player: Player, complete: bool) -> None:
    played = player.played
    if options.json:
        told: dict[str, Any] = {
            "file": str(options.file),
            "complete": complete,
            "messages": played.messages,
            "bytes": played.bytes,
            "unheard": played.unheard,
            "sha256": played.digest,
            "streams": played.by_stream,
        }
        print_json(told)
        return
    print(f"{'sent' if complete else 'stopped after'} {count(played.messages, 'message')}, {size(played.bytes)}")
    if played.unheard:
        print(f"  {played.unheard:,} of them while no peer was connected")
    for stream, number in sorted(played.by_stream.items()):
        print(f"  {stream:<40} {number:>8,}")
    print(f"sha256 {played.digest}", flush=True)
