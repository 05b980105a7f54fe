"""Plays a scenario live: a real bridge, and each actor in its own process, with commands to begin and to end.

The events of the programs are JSON lines.  They have a process group of their own: a Ctrl-C on the terminal is the
stage's, which ends them in order, actors before bridge, so that all messages are in the recording.  A stage that is
killed takes them with it: actors end when their standard input does, and on Linux the kernel interrupts every program.
"""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from enum import Enum
from queue import Empty, SimpleQueue

from igtl_gateway.base.child import Child
from igtl_gateway.base.clock import Clock
from igtl_gateway.base.errors import GatewayError
from igtl_gateway.base.stamp import NS_PER_S
from igtl_gateway_lab.programs import Event, parse_event
from igtl_gateway_lab.simulate.actor import Actor, ActorProtocol, ActorReport

_LOOK_S = 0.2  # how soon a Ctrl-C or a time-out is seen
_END_S = 15.0  # for a program to end after the command
_BRIDGE = "bridge"
#: The actors read all types; a bridge does not know that of programs that it does not recognise.
_ALL_TYPES = ("--no-cautious",)

Address = tuple[str, int]


class StageError(GatewayError):
    """A program of the stage did not start, or died."""


class StageEnd(Enum):
    """How a story ended."""

    OVER = "over"  #: every actor was done
    TIMEOUT = "time-out"
    INTERRUPTED = "interrupted"


@dataclass(frozen=True, slots=True)
class ActorResult:
    """What an actor's program reported.

    Attributes:
        side: what it speaks.
        done: whether its part was over.
        report: how it went.
        sent, received: messages by stream.
    """

    side: ActorProtocol
    done: bool
    report: ActorReport
    sent: dict[str, int] = field(default_factory=dict)
    received: dict[str, int] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class StageOutcome:
    """How it went.

    Attributes:
        end: why it ended.
        waiting: what was still waited for, by program, when the time was over before it began.
        parts: the actors' reports.
        seconds: from begin to end.
        warnings: what the programs complained of, each once.
        recording: what the bridge recorded; None without our own bridge, or before its end.
    """

    end: StageEnd
    waiting: dict[str, str]
    parts: dict[str, ActorResult]
    seconds: float
    warnings: tuple[str, ...]
    recording: Event | None

    @property
    def good(self) -> bool:
        """Whether the story came to its end and every actor is content."""
        reported = all(part.done and part.report.good for part in self.parts.values())
        return self.end is StageEnd.OVER and bool(self.parts) and reported


@dataclass(frozen=True, slots=True)
class StagePlan:
    """What is played.

    Attributes:
        actors: those that play here.
        command: the command line of an actor's program, given its name and, for OpenIGTLink, how to meet the gateway.
        bridge: arguments of a bridge of our own (None: the user runs one) without its addresses.
        connect: where the OpenIGTLink actors find the gateway; None: at the bridge of our own.
        listen: where they wait for it, instead.
        serve: where a bridge of our own waits for OpenIGTLink programs that are not ours.
        start_s: how long it may take until everybody is ready.
        limit_s: how long the story may take from there.
    """

    actors: Sequence[Actor]
    command: Callable[[str, Sequence[str]], Sequence[str]]
    bridge: Sequence[str] | None
    start_s: float
    limit_s: float
    connect: Address | None = None
    listen: Address | None = None
    serve: Address = ("127.0.0.1", 0)


class Stage:
    """Runs the programs of a plan; every one has ended when ``run`` returns or raises.

    Args:
        plan: see there.
        clock: for the time limit.
        stop: set from outside to end early.
        on_event: called with ``(program, event)`` for each event that is shown.
    """

    def __init__(
        self, plan: StagePlan, clock: Clock, stop: threading.Event, on_event: Callable[[str, Event], None]
    ) -> None:
        self._plan = plan
        self._clock = clock
        self._stop = stop
        self._on_event = on_event
        self._events: SimpleQueue[tuple[str, Event | None]] = SimpleQueue()
        self._programs: dict[str, Child] = {}
        self._ended: set[str] = set()
        self._deadline_ns = clock.monotonic_ns() + round(plan.start_s * NS_PER_S)
        self._state: dict[str, set[str]] = {"ready": set(), "done": set()}
        self._waiting: dict[str, str] = {}
        self._reports: dict[str, Event] = {}
        self._warnings: dict[str, None] = {}
        self._places: dict[str, Address] = {}
        self._recording: Event | None = None
        self._failed = ""
        self._ending = False

    def run(self) -> StageOutcome:
        """Play it.  Raises StageError if a program cannot start or dies."""
        seconds = 0.0
        try:
            end = self._start()
            if end is None:
                begun_ns = self._clock.monotonic_ns()
                self._deadline_ns = begun_ns + round(self._plan.limit_s * NS_PER_S)
                for actor in self._plan.actors:
                    self._programs[actor.name].write("begin\n")
                self._on_event("", {"event": "begun"})
                names = {actor.name for actor in self._plan.actors}
                end = self._wait(lambda: names <= self._state["done"]) or StageEnd.OVER
                seconds = (self._clock.monotonic_ns() - begun_ns) / NS_PER_S
            self._end()
        finally:
            for program in self._programs.values():
                program.kill()
        waiting = {name: what for name, what in self._waiting.items() if name not in self._state["ready"]}
        parts = {actor.name: self._part(actor) for actor in self._plan.actors if actor.name in self._reports}
        return StageOutcome(end, waiting, parts, seconds, tuple(self._warnings), self._recording)

    # -- the course ---------------------------------------------------------------------------------------------

    def _start(self) -> StageEnd | None:
        """Start everything; None when all are ready, else why it ended before."""
        plan = self._plan
        ours = [actor for actor in plan.actors if actor.side is ActorProtocol.IGTL]
        for actor in plan.actors:
            if actor.side is ActorProtocol.ROS:
                self._run(actor.name, plan.command(actor.name, ()))
        if plan.listen:
            for actor in ours:
                self._run(actor.name, plan.command(actor.name, ("--listen", _text(plan.listen))))
        connect = plan.connect
        if plan.bridge is not None:
            if plan.listen:
                if end := self._wait(lambda: len(self._places) == len(ours)):
                    return end
                where = [word for actor in ours for word in ("--connect", _text(self._places[actor.name]))]
            else:
                where = ["--listen", _text(plan.serve)]
            self._run(
                _BRIDGE, (sys.executable, "-m", "igtl_gateway", "bridge", "--json", *_ALL_TYPES, *plan.bridge, *where)
            )
            if end := self._wait(lambda: _BRIDGE in self._state["ready"]):
                return end
            connect = self._places.get(_BRIDGE)
        if not plan.listen and connect:
            for actor in ours:
                self._run(actor.name, plan.command(actor.name, ("--connect", _text(connect))))
        names = {actor.name for actor in plan.actors}
        return self._wait(lambda: names <= self._state["ready"])

    def _end(self) -> None:
        """End the actors, take their reports, then end the bridge."""
        self._ending = True  # that its peers go is no news any more
        bridge = self._programs.get(_BRIDGE)
        actors = {name: program for name, program in self._programs.items() if program is not bridge}
        for program in actors.values():
            program.close_input()
        self._drain(actors)
        if bridge:
            bridge.interrupt()
            self._drain({_BRIDGE: bridge})
        if self._failed:
            raise StageError(self._failed)

    def _drain(self, programs: dict[str, Child]) -> None:
        """Handle the events of these programs until they have ended."""
        deadline_ns = self._clock.monotonic_ns() + round(_END_S * NS_PER_S)
        while not self._ended.issuperset(programs):
            if self._clock.monotonic_ns() > deadline_ns:
                stuck = ", ".join(name for name in programs if name not in self._ended)
                self._failed = self._failed or f"{stuck}: did not end within {_END_S:g} s"
                return
            self._take(_LOOK_S)

    def _wait(self, condition: Callable[[], bool]) -> StageEnd | None:
        """Take events until the condition holds (None), or why it did not come to that."""
        while not condition():
            if self._failed:
                self._end()
            if self._stop.is_set():
                return StageEnd.INTERRUPTED
            if self._clock.monotonic_ns() > self._deadline_ns:
                return StageEnd.TIMEOUT
            self._take(_LOOK_S)
        return None

    # -- programs and their events ------------------------------------------------------------------------------

    def _run(self, name: str, command: Sequence[str]) -> None:
        self._programs[name] = start_program(name, command, self._events)

    def _take(self, timeout_s: float) -> None:
        """The next event, if one comes in time."""
        try:
            name, event = self._events.get(timeout=timeout_s)
        except Empty:
            return
        if event is None:
            self._ended.add(name)
            if not (name in self._reports or (name == _BRIDGE and self._recording is not None)):
                self._failed = self._failed or f"{name}: {exit_reason(self._programs[name])}"
            return
        match event.get("event"):
            case "started":
                listening = event["listen"]
                if listening:
                    self._places[name] = (listening[0]["host"], listening[0]["port"])
                self._state["ready"].add(name)
            case "listening":
                self._places[name] = (event["host"], event["port"])
            case "waiting":
                self._waiting[name] = event["for"]
            case "ready" | "done" as state:
                self._state[state].add(name)
            case "warning":
                self._warnings[event["text"]] = None
            case "report":
                self._reports[name] = event
            case "stopped":
                self._recording = event.get("recording", {})
            case _ if event.get("level") in ("WARN", "ERROR") and not self._ending:
                self._warnings[f"{name}: {event['text']}"] = None
            case _:
                return
        self._on_event(name, event)

    def _part(self, actor: Actor) -> ActorResult:
        event = self._reports[actor.name]
        report = ActorReport(event["good"], tuple(event["lines"]), event["facts"])
        return ActorResult(actor.side, actor.name in self._state["done"], report, event["sent"], event["received"])


def start_program(name: str, command: Sequence[str], events: SimpleQueue[tuple[str, Event | None]]) -> Child:
    """Start a program whose events are put into a queue, with its name; ``None`` at its end."""

    def on_line(line: str) -> None:
        if (event := parse_event(line)) is not None:
            events.put((name, event))

    return Child(name, command, on_line=on_line, on_end=lambda: events.put((name, None)))


def exit_reason(program: Child) -> str:
    """Return why a program has ended: the last line of its standard error, without our own prefix."""
    line = program.exit_reason()
    if not line:
        return f"ended unexpectedly with exit code {program.wait()}"
    return line.partition(": ")[2] if line.startswith("igtl-gateway ") else line


def _text(address: Address) -> str:
    host, port = address
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"
