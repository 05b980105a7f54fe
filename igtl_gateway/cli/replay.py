"""``igtl-gateway replay``: send a recording to OpenIGTLink peers, to ROS, or to both."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from threading import Event, Thread

from igtl_gateway.app.player import Jump, Player
from igtl_gateway.app.player_services import PlayerServices
from igtl_gateway.app.replay_options import REPLAY, ReplayOptions
from igtl_gateway.app.replay_sides import ReplaySides
from igtl_gateway.app.replaying import ReplayEvents, run_replay
from igtl_gateway.base.errors import ConfigError
from igtl_gateway.cli.common import stop_event
from igtl_gateway.cli.keys import FASTER, HELP, NEXT, PAUSE, QUIT, SLOWER, can_read_keys, keyboard, read_lines
from igtl_gateway.cli.options import RECORDING_OR_BAG, add_file
from igtl_gateway.cli.replay_report import print_report
from igtl_gateway.cli.ros_arguments import add_ros_arguments
from igtl_gateway.cli.settings import add_settings, all_values, common_options, faults_text
from igtl_gateway.cli.terminal import print_json, print_line
from igtl_gateway.config.faults import Fate
from igtl_gateway.edges.ros.edge import RosEdge
from igtl_gateway.gateway.log.entry import Entry
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.replay.moment import since_text

EXAMPLES = """\
  # serve the session to the first client
  igtl-gateway replay fixtures/star.mcap --to igtl
  # the same bytes in the same order, without pauses
  igtl-gateway replay out.mcap --to igtl --as-fast-as-possible
  # connect to a server
  igtl-gateway replay out.mcap --to igtl --connect 127.0.0.1:18944
  # connect to a server with TLS
  igtl-gateway replay out.mcap --to igtl --connect tls://or1.clinic:18944 \\
      --tls-cert me.pem --tls-ca clinic.pem
  # publish the recorded ROS messages at half speed
  igtl-gateway replay out.mcap --to ros --rate 0.5
  # repeat, with /clock for nodes with use_sim_time
  igtl-gateway replay out.mcap --to ros --clock --loop
  # seconds 12.5 to 15.5, to peers and ROS in the recorded order
  igtl-gateway replay out.mcap --to both --start 12.5 --duration 3
  # set all stamps to the time of sending, for peers that reject old stamps
  igtl-gateway replay out.mcap --to igtl --restamp now
  # one message for each press of →
  igtl-gateway replay out.mcap --to igtl --step
  # recompute the outputs from the recorded inputs with this version
  igtl-gateway replay out.mcap --to igtl --through-gateway
  # inject faults
  igtl-gateway replay out.mcap --to igtl \\
      --fault loss=1%,jitter=20ms,corrupt=0.1% --seed 7
  # send a topic of a rosbag2 MCAP file as a device
  igtl-gateway replay bag.mcap --to igtl --send /camera/image=Cam
  # send the recorded bytes, whatever the peer can read
  igtl-gateway replay out.mcap --to igtl --exact
  # select streams
  igtl-gateway replay out.mcap --to igtl --streams 'IMAGE/*'

TIME is in seconds from the beginning, in UTC seconds, or a date and time such
as 2026-11-21T08:00:00Z.  A replay that starts or jumps into the middle first
sends the latched state before it: static transforms, plans, surfaces and the
last status.  At every rate the same messages are sent in the same order.  A
slow reader slows the replay down; nothing is dropped.

keys on a terminal:
  space  pause or resume            ↑ ↓  change the rate by 10 %
  →      next message while paused  q    quit

ROS services of /igtl_gateway_replay, with --to ros, as in `ros2 bag play`:
  ~/pause ~/resume ~/toggle_paused ~/is_paused ~/seek ~/play_next ~/burst
  ~/set_rate ~/get_rate

exit code 1 if the replay is stopped, or if ROS rejects messages (for example
of a type that is not installed); the other messages are sent."""

#: Options that the short help shows.
COMMON = common_options(REPLAY)

_FASTER, _SLOWER = 1.1, 0.9


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_file(parser, RECORDING_OR_BAG)
    add_settings(parser, REPLAY, fault_injection=faults_text())
    add_ros_arguments(parser.add_argument_group("ROS"), "remapping, namespace, log level")


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
        print_line(text, error=options.json, flush=True)


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
