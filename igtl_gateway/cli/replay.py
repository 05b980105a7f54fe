"""``igtl-gateway replay``: a recording drives OpenIGTLink peers, a ROS graph, or both."""

from __future__ import annotations

import argparse
from contextlib import ExitStack, suppress
from pathlib import Path
from threading import Event, Thread
from typing import Any

from igtl_gateway.app.faulty import FaultyFeed
from igtl_gateway.app.player import Jump, Player
from igtl_gateway.app.player_services import PlayerServices
from igtl_gateway.app.replay_account import ReplayAccount, account_lines
from igtl_gateway.app.replay_plan import plan_replay, planned_entries
from igtl_gateway.cli import admission
from igtl_gateway.cli.common import (
    add_addresses,
    add_faults,
    add_send,
    config_to_run,
    count_text,
    size_text,
    stop_event,
    with_sends,
)
from igtl_gateway.cli.keys import FASTER, HELP, NEXT, PAUSE, QUIT, SLOWER, can_read_keys, keyboard, read_lines
from igtl_gateway.cli.replay_sides import ReplaySides, open_sides
from igtl_gateway.cli.terminal import cell, print_json, print_line
from igtl_gateway.clock import SystemClock
from igtl_gateway.edges.ros.edge import RosEdge
from igtl_gateway.errors import ConfigError, GatewayError
from igtl_gateway.faults import CLOCK_STEP, LOSS, Fate, Faults
from igtl_gateway.replay.moment import moment
from igtl_gateway.replay.playback import checked_rate
from igtl_gateway.replay.restamp import MODES, Restamper
from igtl_gateway.replay.simclock import DEFAULT_HZ, period_ns, with_ticks
from igtl_gateway.replay.timeline import SessionTimeline, clock_steps_of
from igtl_gateway.session.entry import Entry
from igtl_gateway.sessionfile.reader import SessionFile
from igtl_gateway.stamp import NS_PER_S

EXAMPLES = """\
  igtl-gateway replay fixtures/star.mcap --to igtl                 serve the session to the first client
  igtl-gateway replay out.mcap --to igtl --as-fast-as-possible     the same bytes in the same order, at once
  igtl-gateway replay out.mcap --to igtl --connect 127.0.0.1:18944 be the client
  igtl-gateway replay out.mcap --to igtl --connect tls://or1.clinic:18944 --tls-cert me.pem --tls-ca clinic.pem
  igtl-gateway replay out.mcap --to ros --rate 0.5                 publish what ROS heard, at half speed
  igtl-gateway replay out.mcap --to ros --clock --loop             again and again, for nodes with use_sim_time
  igtl-gateway replay out.mcap --to both --start 12.5 --duration 3 a part, to both sides, in the order of the log
  igtl-gateway replay out.mcap --to igtl --restamp now             stamps of today, for peers that refuse old ones
  igtl-gateway replay out.mcap --to igtl --step                    one message for each press of →
  igtl-gateway replay out.mcap --to igtl --through-gateway         recorded inputs through today's converters
  igtl-gateway replay out.mcap --to igtl --fault loss=1%,jitter=20ms,corrupt=0.1% --seed 7   over a bad line
  igtl-gateway replay bag.mcap --to igtl --send /camera/image=Cam  a rosbag2 MCAP file: its topics as devices
  igtl-gateway replay out.mcap --to igtl --streams 'IMAGE/*'       some streams only

T is in seconds from the beginning, in UTC seconds, or a time as 2026-11-21T08:00:00Z.  A replay that begins or jumps
into the middle sends what was latched before (static transforms, plans, surfaces, last status) first.

keys, on a terminal: space pause or go on, → next message while paused, ↑ ↓ rate ±10 %, q end
exit code 1 if it is stopped, or if ROS refuses messages (a type that is not installed): the others are sent.

services, with --to ros, as of `ros2 bag play`: ~/pause ~/resume ~/toggle_paused ~/is_paused ~/seek ~/play_next ~/burst
~/set_rate ~/get_rate of /igtl_gateway_replay

At every rate the same messages go out in the same order; a slow reader slows the replay down, nothing is dropped."""

_FASTER, _SLOWER = 1.1, 0.9
#: A year: longer than a session, shorter than what a clock of the system cannot wait for.
_LONGEST_S = 366 * 86_400.0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("file", metavar="FILE", type=Path, help="a recording, or a rosbag2 MCAP file")
    parser.add_argument("--to", choices=("igtl", "ros", "both"), required=True, help="the side to drive")
    add_addresses(parser, admission.peer_address, "[tls://]HOST:PORT")
    admission.add_tls(parser)
    parser.add_argument("--through-gateway", action="store_true", help="send what today's gateway makes of the inputs")
    parser.add_argument(
        "--config", type=Path, metavar="TOML", help="with --through-gateway: instead of the recorded one"
    )
    add_send(parser)
    pace = parser.add_mutually_exclusive_group()
    pace.add_argument("--rate", type=float, default=1.0, metavar="R", help="recorded seconds per second (%(default)s)")
    pace.add_argument("--as-fast-as-possible", action="store_true", help="no pauses")
    pace.add_argument(
        "--speed-of-light",
        action="store_true",
        help="no pauses, in lock-step: the next message goes when the kernel has taken the last one for every peer, "
        "and every reliable ROS reader has acknowledged it",
    )
    parser.add_argument("--start", metavar="T", help="begin here (default: at the beginning)")
    end = parser.add_mutually_exclusive_group()
    end.add_argument("--end", metavar="T", help="end after this moment")
    end.add_argument("--duration", type=float, metavar="S", help="end so many recorded seconds after the start")
    parser.add_argument("--loop", action="store_true", help="begin again at the end, until stopped")
    parser.add_argument("--start-paused", action="store_true", help="wait for the key or the service")
    parser.add_argument(
        "--step",
        action="store_true",
        help="paused, one message for each → or Enter; without a terminal one for each line of standard input",
    )
    parser.add_argument("--delay", type=float, default=0.0, metavar="S", help="wait before the first message")
    parser.add_argument(
        "--restamp",
        choices=MODES,
        default="keep",
        help="all stamps in the messages, at any depth: as they are (default), the time of sending, or all moved by "
        "one constant so that the first is now (anew after each jump)",
    )
    parser.add_argument(
        "--clock",
        type=float,
        nargs="?",
        const=DEFAULT_HZ,
        metavar="HZ",
        help=f"publish the recording's time on /clock, so many times a recorded second (default {DEFAULT_HZ:.0f})",
    )
    parser.add_argument(
        "--wait-peers",
        type=int,
        metavar="N",
        help="begin when N peers are connected (default 1), or N ROS subscribers are there on each topic (default 0)",
    )
    parser.add_argument(
        "--streams", action="append", default=[], metavar="GLOB", help="only these: TYPE/device, device or topic"
    )
    add_faults(parser)
    parser.add_argument(
        "--no-digest",
        action="store_true",
        help="do not compute the SHA-256 of what is sent, which large pictures have to wait for",
    )
    parser.add_argument("--json", action="store_true", help="print jumps and the outcome as JSON lines")


def run(options: argparse.Namespace) -> int:
    _check(options)
    with SessionFile.open(options.file) as file, stop_event() as stop, ExitStack() as at_end, ExitStack() as stack:
        start_ns, end_ns = _part(options, file)
        config = with_sends(config_to_run(file.session, options.config), options.send)
        how = plan_replay(file, options.to, options.through_gateway)
        _tell(options, f"{options.file}: {how.why}")
        pace = SessionTimeline(clock_steps_of(file))
        side = open_sides(options, file, how, stop, stack, lambda text: _tell(options, text))
        if side is None:
            _tell(options, "stopped before the replay began")
            return 1

        account = ReplayAccount.of(file, how)
        faults = Faults.parse(options.fault)
        faulty = FaultyFeed(faults, options.seed, lambda fate: _tell_fault(options, fate)) if faults else None
        role = "client" if options.connect and not options.listen else "server"

        def feed(from_ns: int | None) -> Any:
            account.begin()
            entries = planned_entries(
                file, config, how, options.streams, from_ns, end_ns, role, account.passed_over, account.made
            )
            entries = faulty(entries) if faulty else entries
            return with_ticks(entries, from_ns, period_ns(options.clock), pace) if options.clock else entries

        player = Player(
            feed,
            side.send,
            SystemClock(),
            stop,
            rate=None if options.as_fast_as_possible or options.speed_of_light else options.rate,
            paused=options.step or options.start_paused,
            loop=options.loop,
            span=(start_ns or file.start_ns, file.end_ns if end_ns is None else end_ns),
            start_ns=start_ns,
            restamp=_restamper(options, file),
            on_jump=lambda jump: _tell_jump(options, file, jump),
            send_all=side.send_all,
            digest=not options.no_digest,
            pace=pace,
        )
        complete = False

        def report() -> None:
            _report(options, player, side, complete, faulty, account, start_ns is not None or end_ns is not None)

        # when the edges are closed: what still left then counts as sent, and what did not does not
        at_end.callback(report)
        _controls(options, file, player, side, stop, stack)
        stop.wait(options.delay)
        try:
            player.run()
        finally:
            complete = side.finish() and not stop.is_set()
    if complete and not player.played.messages:
        why = next(iter(player.played.refused), ("", "see `igtl-gateway info`, and --send"))[1]
        raise GatewayError(f"{options.file}: nothing in it goes to {options.to}: {why}")
    return 0 if (complete or options.loop) and not player.played.refused else 1


def _check(options: argparse.Namespace) -> None:
    """Refuse what cannot be before anything is opened."""
    if options.to == "ros":
        admission.secured(options, (), ())
    checked_rate(options.rate)
    if options.wait_peers is not None and options.wait_peers < 0:
        raise ConfigError(f"--wait-peers: found {options.wait_peers}, expected 0 or more")
    if not 0 <= options.delay <= _LONGEST_S:
        raise ConfigError(f"--delay: found {options.delay}, expected seconds, 0 or more, at most {_LONGEST_S:,.0f}")
    if options.duration is not None and not 0 < options.duration <= _LONGEST_S:
        raise ConfigError(f"--duration: found {options.duration}, expected seconds, above 0, at most {_LONGEST_S:,.0f}")
    if options.clock is not None:
        period_ns(options.clock)
        if options.to == "igtl":
            raise ConfigError("--clock: found --to igtl, expected --to ros or --to both: /clock is a ROS topic")
    faults = Faults.parse(options.fault)
    if faults and options.to == "ros":
        raise ConfigError("--fault: found --to ros, expected --to igtl or --to both: faults are of OpenIGTLink lines")
    if faults.clock_step_ns and options.restamp == "now":
        raise ConfigError(f"--fault: {CLOCK_STEP}: found --restamp now, which sets all stamps anew, expected another")
    if options.start_paused and not options.step and options.to == "igtl" and not can_read_keys():
        raise ConfigError("--start-paused: needs a terminal for the keys, or --to ros for the services")


def _part(options: argparse.Namespace, file: SessionFile) -> tuple[int | None, int | None]:
    """First and last moment in UTC ns; None where nothing was said."""
    # a file that begins midway begins with the state there, as any part does
    start_ns = file.start_ns if file.prologue() else None
    end_ns = None
    if options.start is not None:
        start_ns = moment(options.start, file.start_ns, "--start")
        if start_ns > file.end_ns:
            raise ConfigError(f"--start: found {_at(file, start_ns)}, expected at most {_at(file, file.end_ns)}")
    if options.end is not None:
        end_ns = moment(options.end, file.start_ns, "--end")
    elif options.duration is not None:
        end_ns = (file.start_ns if start_ns is None else start_ns) + round(options.duration * NS_PER_S)
    if end_ns is not None and end_ns < (start_ns or file.start_ns):
        raise ConfigError(f"--end: found {_at(file, end_ns)}, expected at least {_at(file, start_ns or file.start_ns)}")
    return start_ns, end_ns


def _restamper(options: argparse.Namespace, file: SessionFile) -> Restamper | None:
    if options.restamp == "keep":
        return None
    return Restamper(
        options.restamp, lambda name: _tell(options, f"! stamps of {name} stay: not known here"), file.definitions
    )


def _controls(
    options: argparse.Namespace, file: SessionFile, player: Player, side: ReplaySides, stop: Event, stack: ExitStack
) -> None:
    """Keyboard and services."""

    def obey(command: str) -> None:
        if command == PAUSE:
            player.toggle()
            _tell(options, f"paused at {_at(file, player.position_ns)}" if player.paused else "goes on")
        elif command == NEXT:
            player.step()
        elif command in (FASTER, SLOWER) and (rate := player.rate):
            player.set_rate(rate * (_FASTER if command == FASTER else _SLOWER))
            _tell(options, f"rate {player.rate:.3g}")
        elif command == QUIT:
            stop.set()

    services = PlayerServices(player)

    def offer(edge: RosEdge) -> None:
        if reason := services.serve(edge):
            _tell(options, f"! no services to pause, step or seek: {reason}")

    if side.ros:
        # beside the replay: the first time their types are compiled
        Thread(target=offer, args=(side.ros,), name="igtl-services", daemon=True).start()
        stack.callback(services.close)
    if can_read_keys():
        _tell(options, HELP)
        stack.enter_context(keyboard(obey))
    elif options.step and not side.ros:
        # waits for each message, so that the end of the lines does not come before
        read_lines(lambda: player.burst(1), stop.set)


def _tell(options: argparse.Namespace, text: str) -> None:
    # also called by the edges' threads: whether there still is a reader, the report finds out in ours
    with suppress(BrokenPipeError):
        print_line(text, error=options.json, flush=True)


def _tell_jump(options: argparse.Namespace, file: SessionFile, jump: Jump) -> None:
    to_ns = file.start_ns if jump.to_ns is None else jump.to_ns
    if options.json:
        print_json({"event": "jump", "why": jump.why, "from_ns": jump.from_ns, "to_ns": to_ns})
    else:
        _tell(options, f"= jump ({jump.why}): from {_at(file, jump.from_ns)} to {_at(file, to_ns)}")


def _tell_fault(options: argparse.Namespace, fate: Fate[Entry]) -> None:
    if options.json:
        entry = fate.message
        print_json({"event": "fault", "stream": entry.channel, "entry": entry.seq, "faults": fate.reportable})


def _at(file: SessionFile, recorded_ns: int | None) -> str:
    """A moment for people, from the beginning of the file."""
    return "the beginning" if recorded_ns is None else f"{(recorded_ns - file.start_ns) / NS_PER_S:+.3f} s"


def _report(
    options: argparse.Namespace,
    player: Player,
    side: ReplaySides,
    complete: bool,
    faulty: FaultyFeed | None,
    account: ReplayAccount,
    partial: bool,
) -> None:
    """What was sent, what was not and why; after the edges are closed."""
    played = player.played
    refused = dict(played.refused)
    for stream, number in side.failed().items():  # those that were held for their subscribers, and failed then
        if later := number - sum(many for (name, _), many in played.refused.items() if name == stream):
            refused[stream, "ROS did not take it"] = later
    failed = sum(refused.values()) - played.refused.total()
    undelivered, single = side.undelivered()
    facts = None
    if account.passes == 1:  # a loop or a jump sends messages again
        facts = account.facts(
            played,
            failed=failed,
            left=undelivered if single else 0,
            lost=faulty.counts[LOSS] if faulty else 0,
            partial=partial,
            stopped=not complete,
        )
    if options.json:
        told: dict[str, Any] = {
            "file": str(options.file),
            "complete": complete,
            "messages": played.messages - failed,
            "bytes": played.bytes,
            "unheard": played.unheard,
            "undelivered": undelivered,
            "refused": [
                {"stream": stream, "messages": number, "reason": reason}
                for (stream, reason), number in sorted(refused.items())
            ],
            "sha256": played.digest,
            "streams": played.by_stream,
            "account": facts,
        }
        if options.to == "both":
            told["sides"] = {
                name: {"messages": part.messages, "bytes": part.bytes, "sha256": part.digest}
                for name, part in sorted(player.sides.items())
            }
        if faulty:
            told["faults"] = {"fault": options.fault, "seed": options.seed, "counts": faulty.counts}
        print_json(told)
        return
    sent = count_text(played.messages - failed, "message")
    print_line(f"{'sent' if complete else 'stopped after'} {sent}, {size_text(played.bytes)}")
    if played.unheard:
        print_line(f"  {played.unheard:,} of them while no peer was connected")
    if undelivered:
        print_line(f"  {undelivered:,} of them were still queued for a peer when it left")
    if faulty:
        counts = faulty.counts
        hit = ", ".join(f"{name} {counts[name]:,}" for name in sorted(counts) if name != "messages" and counts[name])
        print_line(f"faults (seed {options.seed}): of {count_text(counts['messages'], 'message')}: {hit or 'none hit'}")
    for stream, number in sorted(played.by_stream.items()):
        print_line(f"  {cell(stream, 40)} {number:>8,}")
    for line in account_lines(facts) if facts else ():
        print_line(line)
    for (stream, reason), number in sorted(refused.items()):
        print_line(f"! not published: {count_text(number, 'message')} of {stream}: {reason}")
    if options.to == "both" and played.digest:
        for name, part in sorted(player.sides.items()):
            print_line(f"{name}: sha256 {part.digest}")
    if played.digest:
        print_line(f"sha256 {played.digest}")
