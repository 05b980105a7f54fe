"""``igtl-gateway replay``: send a recording to OpenIGTLink peers, to ROS, or to both."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from threading import Event, Thread

from igtl_gateway.app.bridge_options import addresses, secured
from igtl_gateway.app.bridge_options import tls as tls_files
from igtl_gateway.app.player import Jump, Player
from igtl_gateway.app.player_services import PlayerServices
from igtl_gateway.app.replay_sides import ReplayOptions, ReplaySides
from igtl_gateway.app.replaying import ReplayEvents, run_replay, since_text
from igtl_gateway.base.errors import ConfigError
from igtl_gateway.cli import admission
from igtl_gateway.cli.common import stop_event
from igtl_gateway.cli.keys import FASTER, HELP, NEXT, PAUSE, QUIT, SLOWER, can_read_keys, keyboard, read_lines
from igtl_gateway.cli.options import (
    RECORDING_OR_BAG,
    add_config,
    add_file,
    add_json,
    add_streams,
    default,
)
from igtl_gateway.cli.replay_report import print_report
from igtl_gateway.cli.ros_arguments import add_ros_arguments
from igtl_gateway.cli.settings import add_faults, add_settings, common_options
from igtl_gateway.cli.terminal import print_json, print_line
from igtl_gateway.config.faults import Fate
from igtl_gateway.config.settings import PROFILE_NAMES
from igtl_gateway.convert.profiles import AUTO
from igtl_gateway.edges.ros.edge import RosEdge
from igtl_gateway.gateway.log.entry import Entry
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.replay.restamp import MODES
from igtl_gateway.replay.simclock import DEFAULT_HZ

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
COMMON = common_options(
    *("--to", "--json", "--start", "--end", "--duration", "--streams", "--through-gateway", "--restamp"),
    *("--rate", "--as-fast-as-possible", "--loop", "--step", "--clock"),
)

_FASTER, _SLOWER = 1.1, 0.9


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_file(parser, RECORDING_OR_BAG)
    parser.add_argument(
        "--to", choices=("igtl", "ros", "both"), required=True, help="send to OpenIGTLink peers, to ROS, or to both"
    )
    add_json(parser, "print jumps, faults and the result as JSON lines")
    parser.add_argument(
        "--no-digest",
        action="store_true",
        help="do not compute the SHA-256 of the sent bytes, which delays large images",
    )
    group = parser.add_argument_group("addresses and security")
    add_settings(group, "listen", "connect", "allow")
    admission.add_tls(group)
    _add_forms(parser.add_argument_group("what the peers can read"))
    _add_selection(parser.add_argument_group("selection of messages"))
    _add_pace(parser.add_argument_group("pace"))
    add_ros_arguments(parser.add_argument_group("ROS"), "remapping, namespace, log level")
    add_faults(parser)
    parser.set_defaults(fault="", seed=0)


def _add_forms(group: argparse._ArgumentGroup) -> None:
    forms = group.add_mutually_exclusive_group()
    forms.add_argument(
        "--profile",
        choices=PROFILE_NAMES,
        default=AUTO,
        help="profile of all OpenIGTLink peers: messages that it cannot read are adapted or left out "
        + default(f"{AUTO}, detected from their messages"),
    )
    forms.add_argument(
        "--exact", action="store_true", help="send the recorded bytes, also those at which a peer may lose the stream"
    )


def _add_selection(group: argparse._ArgumentGroup) -> None:
    group.add_argument("--start", metavar="TIME", help="start at this time " + default("the beginning"))
    end = group.add_mutually_exclusive_group()
    end.add_argument("--end", metavar="TIME", help="stop after this time " + default("the end"))
    end.add_argument("--duration", type=float, metavar="SECONDS", help="stop after this much recorded time")
    add_streams(group)
    add_settings(group, "to_igtl")
    group.add_argument(
        "--through-gateway",
        action="store_true",
        help="recompute the outputs from the recorded inputs with this version, and send them",
    )
    add_config(group, "with --through-gateway: use this configuration (TOML) instead of the recorded one")
    group.add_argument(
        "--restamp",
        choices=MODES,
        default="keep",
        help="stamps in the messages, at any depth; now: the time of sending; shift: all moved by one offset, so that "
        "the first is now, again after each jump " + default("keep"),
    )


def _add_pace(group: argparse._ArgumentGroup) -> None:
    pace = group.add_mutually_exclusive_group()
    pace.add_argument(
        "--rate", type=float, default=1.0, metavar="FACTOR", help="recorded seconds per second " + default("1.0")
    )
    pace.add_argument("--as-fast-as-possible", action="store_true", help="send without pauses")
    pace.add_argument(
        "--speed-of-light",
        action="store_true",
        help="send without pauses, one message at a time: wait until the kernel has accepted the message for every "
        "peer and every reliable ROS subscriber has acknowledged it",
    )
    group.add_argument("--loop", action="store_true", help="repeat until stopped")
    group.add_argument("--start-paused", action="store_true", help="wait for the key or the ROS service to resume")
    group.add_argument(
        "--step",
        action="store_true",
        help="start paused and send one message per → or Enter; without a terminal, per line of standard input",
    )
    group.add_argument(
        "--delay", type=float, default=0.0, metavar="SECONDS", help="wait before the first message " + default(0)
    )
    group.add_argument(
        "--wait-peers",
        type=int,
        metavar="N",
        help="wait for N connected peers, or for N ROS subscribers on each topic " + default("1 peer, 0 subscribers"),
    )
    group.add_argument(
        "--clock",
        type=float,
        nargs="?",
        const=DEFAULT_HZ,
        metavar="HZ",
        help="publish the recorded time on /clock at this rate of recorded time "
        + default(f"{DEFAULT_HZ:.0f} if HZ is not given"),
    )


def run(options: argparse.Namespace) -> int:
    if options.start_paused and not options.step and options.to == "igtl" and not can_read_keys():
        raise ConfigError("--start-paused: found no terminal for the keys, expected one, or --to ros for the services")
    events = ReplayEvents(
        on_line=lambda text: _print_status(options, text),
        jumped=lambda jump, start_ns: _print_jump(options, jump, start_ns),
        fault=lambda fate: _print_fault(options, fate),
        controls=lambda file, player, side: _controls(options, file, player, side, stop),
        ended=lambda result: print_report(options, result),
    )
    with stop_event() as stop:
        result = run_replay(options.file, _replay_options(options), stop, events)
    return 0 if result and (result.complete or options.loop) and not any(each.at_once for each in result.refused) else 1


def _replay_options(options: argparse.Namespace) -> ReplayOptions:
    """The options of the command line as those of a replay.  Raises ConfigError."""
    listen, connect = ((), ()) if options.to == "ros" else addresses(options.listen, options.connect)
    tls_listen, tls_connect = secured(vars(options), listen, connect)
    return ReplayOptions(
        options.to,
        listen,
        connect,
        tuple(options.allow),
        tls_files(vars(options)),
        tls_listen,
        tls_connect,
        options.config,
        tuple(options.send),
        options.start,
        options.end,
        options.duration,
        tuple(options.streams),
        options.through_gateway,
        options.restamp,
        None if options.as_fast_as_possible or options.speed_of_light else options.rate,
        options.speed_of_light,
        options.loop,
        options.step or options.start_paused,
        options.delay,
        options.wait_peers,
        options.clock,
        options.fault,
        options.seed,
        not options.no_digest,
        tuple(options.ros_args),
        options.profile,
        options.exact,
    )


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
