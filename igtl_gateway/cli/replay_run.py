"""``igtl-gateway replay``: send a recording to OpenIGTLink peers, to ROS, or to both."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from threading import Event, Thread

from igtl_gateway.app.player import Jump, Player
from igtl_gateway.app.player_services import PlayerServices
from igtl_gateway.app.replay_options import ReplayOptions
from igtl_gateway.app.replay_settings import REPLAY
from igtl_gateway.app.replay_sides import ReplaySides
from igtl_gateway.app.replaying import ReplayEvents, run_replay
from igtl_gateway.base.errors import ConfigError
from igtl_gateway.cli.common import stop_event
from igtl_gateway.cli.keys import FASTER, HELP, NEXT, PAUSE, QUIT, SLOWER, can_read_keys, keyboard, read_lines
from igtl_gateway.cli.replay_report import print_report
from igtl_gateway.cli.settings import all_values
from igtl_gateway.cli.terminal import print_json, print_line
from igtl_gateway.config.faults import Fate
from igtl_gateway.edges.ros.edge import RosEdge
from igtl_gateway.gateway.log.entry import Entry
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.replay.moment import since_text

_FASTER, _SLOWER = 1.1, 0.9


def run(options: argparse.Namespace) -> int:
    if options.start_paused and not options.step and options.to == "igtl" and not can_read_keys():
        raise ConfigError("--start-paused: found no terminal for the keys, expected one, or --to ros for the services")
    how = ReplayOptions.of(all_values(options, REPLAY), tuple(options.ros_args))
    events = ReplayEvents(
        on_line=lambda text: _print_status(options, text),
        jumped=lambda jump, start_ns: _print_jump(options, jump, start_ns),
        fault=lambda fate: _print_fault(options, fate),
        controls=lambda file, player, side: _controls(options, file, player, side, stop),
        ended=lambda result: print_report(how, result, as_json=options.json),
    )
    with stop_event() as stop:
        result = run_replay(options.file, how, stop, events)
    return 0 if result and (result.complete or options.loop) and not any(each.at_once for each in result.refused) else 1


@contextmanager
def _controls(
    options: argparse.Namespace, file: SessionFile, player: Player, side: ReplaySides, stop: Event
) -> Iterator[None]:
    """Connect keyboard and services to the player, as a context."""

    def obey(command: str) -> None:
        if command == PAUSE:
            player.toggle()
            _print_status(
                options, f"paused at {since_text(file.start_ns, player.position_ns)}" if player.paused else "resumed"
            )
        elif command == NEXT:
            player.step()
        elif command in (FASTER, SLOWER) and (rate := player.rate):
            player.set_rate(rate * (_FASTER if command == FASTER else _SLOWER))
            _print_status(options, f"rate {player.rate:.3g}")
        elif command == QUIT:
            stop.set()

    services = PlayerServices(player)

    def offer(edge: RosEdge) -> None:
        if reason := services.serve(edge):
            _print_status(options, f"! the services to pause, step and seek are not available: {reason}")

    with ExitStack() as stack:
        if side.ros:
            # beside the replay: the first time their types are compiled
            Thread(target=offer, args=(side.ros,), name="igtl-services", daemon=True).start()
            stack.callback(services.close)
        if can_read_keys():
            _print_status(options, HELP)
            stack.enter_context(keyboard(obey))
        elif options.step and not side.ros:
            # waits for each message, so that the end of the lines does not come before
            read_lines(lambda: player.burst(1), stop.set)
        yield


def _print_status(options: argparse.Namespace, text: str) -> None:
    # also called by the edges' threads: whether there still is a reader, the report finds out in ours
    with suppress(BrokenPipeError):
        print_line(text, error=options.json, flush=True, log=True)


def _print_jump(options: argparse.Namespace, jump: Jump, start_ns: int) -> None:
    to_ns = start_ns if jump.to_ns is None else jump.to_ns
    if options.json:
        print_json({"event": "jump", "why": jump.why, "from_ns": jump.from_ns, "to_ns": to_ns})
    else:
        route = f"from {since_text(start_ns, jump.from_ns)} to {since_text(start_ns, to_ns)}"
        _print_status(options, f"= jump ({jump.why}): {route}")


def _print_fault(options: argparse.Namespace, fate: Fate[Entry]) -> None:
    if options.json:
        entry = fate.message
        print_json({"event": "fault", "stream": entry.channel, "entry": entry.seq, "faults": fate.reportable})
