"""The live half of ``igtl-gateway simulate``: what is run, what is shown, and one actor's own program."""

from __future__ import annotations

import argparse
import importlib.util
import os
import sys
import tempfile
import threading
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from igtl_gateway.base.clock import SystemClock
from igtl_gateway.base.errors import ConfigError, RecordingError, Unavailable
from igtl_gateway.base.extras import missing
from igtl_gateway.base.near import one_of
from igtl_gateway.base.quantities import count_text, duration_text, size_text
from igtl_gateway.cli.common import stop_event
from igtl_gateway.cli.options import DEFAULT_HOST, DEFAULT_PORT
from igtl_gateway.cli.terminal import clear_live_line, flush_outputs, is_terminal, live_line, print_json, print_line
from igtl_gateway.edges.ros.env import prepare_environment
from igtl_gateway.edges.ros_interfaces.cache import make_ready
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.replay.recorded_config import config_to_run
from igtl_gateway.replay.verify import DeclaredLosses, verify
from igtl_gateway.replay.verify import VerifyReport as Verification
from igtl_gateway_lab.programs import Event
from igtl_gateway_lab.simulate.actor import Actor, ActorProtocol, ActorReport
from igtl_gateway_lab.simulate.scenario import SYNTHETIC, Scenario
from igtl_gateway_lab.stage.actor import ActorProgram, IgtlEndpoint
from igtl_gateway_lab.stage.live import Stage, StageEnd, StageOutcome, StagePlan

#: Option → field of ``Load``.
LOAD_OPTIONS = {"type": "type", "size": "size", "rate": "rate_hz", "count": "count", "sender": "sender"}

_SIDES = {ActorProtocol.ROS: "ROS 2 node", ActorProtocol.IGTL: "OpenIGTLink program"}
#: A bridge without a parent ends this many seconds after the limits of the stage.
_BRIDGE_S = 60.0
_PATIENCE_S = 3600.0
#: A first start compiles igtl_msgs for this environment.
_START_S = 180.0
_WARNINGS = 5


def play_live(options: argparse.Namespace, scenario: Scenario) -> int:
    """Play it live and print the outcome."""
    if not scenario.actors:
        raise ConfigError(f"{options.name} has no actors to play live: write it with -o FILE")
    side = ActorProtocol(options.side) if options.side else None
    actors = [actor for actor in scenario.cast(options.duration) if side in (None, actor.side)]
    own_bridge = side is None or (side is ActorProtocol.ROS and options.listen is not None)
    _check(options, side, own_bridge, actors)
    if side is None or own_bridge:
        # a scenario must neither receive from other robots nor disturb them
        os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
        os.environ.setdefault("ROS_DOMAIN_ID", str(os.getpid() % 100 + 1))
    out = _StageOutput(options.name, scenario, actors, options.json)
    with tempfile.TemporaryDirectory(prefix="igtl-gateway-simulate-") as folder, stop_event() as stop:
        record = options.record or Path(folder) / f"{options.name}.mcap"
        bridge = _bridge(options, scenario, actors, Path(folder), record) if own_bridge else None
        plan = _plan(options, scenario, actors, bridge)
        out.started(plan, options)
        outcome = Stage(plan, SystemClock(), stop, out.event).run()
        try:
            verification = _verified(record) if outcome.recording else None
        except RecordingError as error:  # the outcome is reported all the same
            verification = None
            outcome = replace(outcome, warnings=(*outcome.warnings, f"the recording cannot be verified: {error}"))
        good = outcome.good and (verification.good if verification else not own_bridge)
        out.ended(outcome, verification, good, bool(options.record))
    return 0 if good else 1


def _check(options: argparse.Namespace, side: ActorProtocol | None, own_bridge: bool, actors: Sequence[Actor]) -> None:
    """Raises ConfigError for what does not fit together."""
    if options.connect and side is not ActorProtocol.IGTL:
        raise ConfigError("--connect is for --side igtl: otherwise the actors connect to a bridge of their own")
    if options.record and not own_bridge:
        raise ConfigError("--record: with --side the bridge is yours, and records with `igtl-gateway bridge --record`")
    if options.view and not own_bridge:
        raise ConfigError("--view: with --side the bridge is yours, and shows itself with `igtl-gateway bridge --view`")
    ours = sum(actor.side is ActorProtocol.IGTL for actor in actors)
    if options.listen and ours > 1 and options.listen[1]:
        raise ConfigError(f"--listen: found one port, expected port 0 (any) for {ours} OpenIGTLink programs")
    if not actors:
        raise ConfigError(f"--side {options.side}: {options.name} has no actors of that side")
    if any(actor.side is ActorProtocol.ROS for actor in actors) and importlib.util.find_spec("rclpy") is None:
        raise Unavailable(f"{missing('rclpy')}; -o FILE plays offline, without ROS")
    if own_bridge or any(actor.side is ActorProtocol.ROS for actor in actors):
        make_ready()  # its programs wait for each other, and a terminal shows the progress


def _limits_s(options: argparse.Namespace, scenario: Scenario) -> tuple[float, float]:
    """How long the start may take, and the story."""
    if options.timeout:
        return options.timeout, options.timeout
    if options.side:  # a person has yet to start the other side, and may play it
        return _PATIENCE_S, _PATIENCE_S
    return _START_S, scenario.limit_s + (options.duration or 0.0)


def _bridge(
    options: argparse.Namespace, scenario: Scenario, actors: Sequence[Actor], folder: Path, record: Path
) -> list[str]:
    """Arguments of a bridge with the scenario's configuration."""
    config = folder / "config.toml"
    config.write_text(scenario.config.to_toml(), "utf-8")
    more = [f"--{name}" for name in ("overwrite", "view") if getattr(options, name)]
    seconds = str(sum(_limits_s(options, scenario)) + _BRIDGE_S)
    beside = sorted({topic for actor in actors for topic, says in actor.publishes.items() if says.recorded})
    topics = ["--record-topics", *beside] if beside else []
    said = ["--custom-data", f"scenario={options.name}", f"synthetic={SYNTHETIC}"]
    return ["--config", str(config), "--record", str(record), *more, "--duration", seconds, *topics, *said]


def _plan(
    options: argparse.Namespace, scenario: Scenario, actors: Sequence[Actor], bridge: list[str] | None
) -> StagePlan:
    words = [sys.executable, "-m", "igtl_gateway", "simulate", options.name, "--peers"]
    # of one side alone: one program replaces the other side
    words.append(str(sum(actor.side is ActorProtocol.IGTL for actor in actors) or 1))
    if options.duration is not None:
        words += ["--duration", str(options.duration)]
    for option in LOAD_OPTIONS:
        if getattr(options, option) is not None:
            words += [f"--{option}", str(getattr(options, option))]

    def command(name: str, where: Sequence[str]) -> list[str]:
        return [*words, "--actor", name, *where]

    limits_s = _limits_s(options, scenario)
    if options.side == "ros":
        return StagePlan(actors, command, bridge, *limits_s, serve=options.listen or (DEFAULT_HOST, 0))
    connect = None if options.listen or bridge else options.connect or (DEFAULT_HOST, DEFAULT_PORT)
    return StagePlan(actors, command, bridge, *limits_s, connect, options.listen)


def _verified(record: Path) -> Verification:
    with SessionFile.open(record) as file:
        losses = DeclaredLosses.of(file.session, file.ledger)
        return verify(file.entries(), config_to_run(file.session), losses, before=file.prologue())


def report_facts(done: bool, report: ActorReport) -> dict[str, Any]:
    """An actor's report as JSON values."""
    return {"done": done, **asdict(report)}


def report_lines(name: str, what: str, done: bool, report: ActorReport) -> list[str]:
    """An actor's report for people."""
    verdict = "done" if done and report.good else "FAILED" if done else "NOT DONE"
    return [f"{name:<12} {verdict}{what}", *(f"             {line}" for line in report.lines)]


class _StageOutput:
    """Lines for people, with a live one on a terminal; or one JSON object at the end."""

    def __init__(self, name: str, scenario: Scenario, actors: Sequence[Actor], as_json: bool) -> None:
        self._name = name
        self._scenario = scenario
        self._sides = {actor.name: actor.side for actor in actors}
        self._json = as_json
        self._alone = False
        self._begun = False
        self._terminal = is_terminal() and not as_json
        self._state = {actor.name: "starts" for actor in actors}

    def started(self, plan: StagePlan, options: argparse.Namespace) -> None:
        if self._json:
            return
        self._alone = bool(options.side)
        print_line(f"{self._name}: {self._scenario.title}")
        if plan.bridge is None and options.side == "ros":
            print_line("             waits for a bridge of yours in this ROS 2 domain that has an OpenIGTLink peer")
            print_line(f"             igtl-gateway simulate {self._name} --print-config > its.toml")
            print_line("             igtl-gateway bridge --config its.toml")
        flush_outputs()
        self._status()

    def event(self, name: str, event: Event) -> None:
        """Print an event of a program."""
        if self._json:
            return
        match event["event"]:
            case "started":
                places = [f"{one['host']}:{one['port']}" for one in event["listen"]]
                clients = [f"{one['host']}:{one['port']}" for one in event["connect"]]
                where = f"server on {places[0]}" if places else f"client of {', '.join(clients)}"
                self._line(name, f"OpenIGTLink {where}; ROS 2 domain {os.environ.get('ROS_DOMAIN_ID', '0')}")
            case "listening":
                self._line(name, f"OpenIGTLink server on {event['host']}:{event['port']}")
            case "ready":
                self._state[name] = "ready"
                self._line(name, f"{_SIDES[self._sides[name]]}, ready")
            case "waiting":
                self._state[name] = f"waits for {event['for']}"
                if self._alone and not self._terminal:
                    self._line(name, self._state[name])
            case "done":
                self._state[name] = "done"
            case "warning":
                self._line(name, f"? {event['text']}")
            case "begun":
                self._state = dict.fromkeys(self._state, "plays")
                self._begun = True
                self._line("", "begun; Ctrl-C ends")
        self._status()

    def ended(self, outcome: StageOutcome, verification: Verification | None, good: bool, kept: bool) -> None:
        if self._json:
            print_json(_facts(self._name, outcome, verification, good))
            return
        self._clear()
        for name, part in outcome.parts.items() if self._begun else ():
            sent, received = sum(part.sent.values()), sum(part.received.values())
            what = f"  {_SIDES[part.side]}: {sent:,} sent, {received:,} received"
            print_line(*report_lines(name, what, part.done, part.report))
        for name, what in outcome.waiting.items():
            print_line(f"{name:<12} waited for {what}")
        for text in outcome.warnings[:_WARNINGS]:
            print_line(f"?            {text}")
        if len(outcome.warnings) > _WARNINGS:
            print_line(
                f"?            and {count_text(len(outcome.warnings) - _WARNINGS, 'more warning')}: --json shows all"
            )
        if outcome.recording and verification:
            where = f"{outcome.recording['path']}: " if kept else ""
            entries = count_text(outcome.recording["entries"], "entry", "entries")
            if lost := outcome.recording["dropped"]:
                entries += f", LOST {lost:,}"
            verdict = (
                f"verified: all {count_text(verification.equal, 'output')} equal, byte for byte"
                if verification.good
                else f"DIFFERENT: {verification.differences[0]}"
            )
            print_line(f"recording    {where}{entries}, {size_text(outcome.recording['bytes'])}; {verdict}")
        why = "" if outcome.end is StageEnd.OVER else f" ({outcome.end.value})"
        print_line(f"{self._name}: {'passed' if good else 'FAILED'}{why}, {duration_text(outcome.seconds * 1e9)}")

    def _line(self, name: str, text: str) -> None:
        self._clear()
        print_line(f"{name:<12} {text}", flush=True)

    def _clear(self) -> None:
        if self._terminal:
            clear_live_line()

    def _status(self) -> None:
        if self._terminal:
            line = " | ".join(f"{name} {state}" for name, state in self._state.items())
            live_line(line)


def _facts(name: str, outcome: StageOutcome, verification: Verification | None, good: bool) -> dict[str, Any]:
    facts: dict[str, Any] = {
        "scenario": name,
        "good": good,
        "end": outcome.end.value,
        "seconds": round(outcome.seconds, 3),
        "actors": {
            name: {
                "side": part.side.value,
                **report_facts(part.done, part.report),
                "sent": part.sent,
                "received": part.received,
            }
            for name, part in outcome.parts.items()
        },
        "waiting": outcome.waiting,
        "warnings": outcome.warnings,
    }
    if outcome.recording and verification:
        facts["recording"] = outcome.recording
        facts["verified"] = {"good": verification.good, "outputs": verification.outputs, "equal": verification.equal}
    return facts


def play_actor(options: argparse.Namespace, scenario: Scenario) -> int:
    """The program of one actor: a line on its standard input begins the story, and the end of the input ends it."""
    cast = scenario.cast(options.duration)
    actor = next((one for one in cast if one.name == options.actor), None)
    if actor is None:
        raise ConfigError(
            f"--actor: found {options.actor!r}, expected {one_of(options.actor, (one.name for one in cast))}"
        )
    if actor.side is ActorProtocol.ROS:
        prepare_environment()
    connection = IgtlEndpoint(options.listen or options.connect or (DEFAULT_HOST, DEFAULT_PORT), bool(options.listen))
    program = ActorProgram(actor, cast, scenario.config, options.peers, connection, SystemClock(), print_json)
    threading.Thread(target=_read_commands, args=(program.begin, program.end), name="igtl-orders", daemon=True).start()
    program.run()
    return 0


def _read_commands(begin: Callable[[], None], end: Callable[[], None]) -> None:
    # not sys.stdin: a thread that waits there holds a lock that the end of the program needs
    while os.read(0, 1 << 10):
        begin()
    end()
