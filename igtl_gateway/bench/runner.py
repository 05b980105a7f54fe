"""Runs a case: the gateway, the programs on both sides, and the same programs without it."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

from igtl_gateway.bench.cases import FLOOD, Case, Direction, Stream, payload
from igtl_gateway.bench.figures import Passage, latency, ratio
from igtl_gateway.bench.peers import LIBRARY, Library, command, times_of
from igtl_gateway.bench.processes import Program, Usage, ours
from igtl_gateway.bench.programs import Job, Part
from igtl_gateway.clock import Clock
from igtl_gateway.stamp import NS_PER_S

#: Messages before those that count: so many seconds' worth, but not more.
_WARM_S, _WARM_MOST, _WARM_FLOOD = 0.5, 200, 20
_START_S = 120.0  # a first start compiles igtl_msgs
_HEARD_S = 60.0
_LOOK_S = 0.25
#: Nothing more arrives after so long a silence.
_SILENCE_S = 3.0
_LARGE_SILENCE_S, _LARGE_BYTES = 20.0, 4 << 20
#: Messages that the floor is measured with, at most: its median is all that is used.
_FLOOR_COUNT = 300
#: The gateway ends by itself where nobody is left to end it: so long after its runs.
_GATEWAY_S = 600.0

Row = dict[str, Any]
Address = tuple[str, int]


@dataclass(frozen=True, slots=True)
class Extent:
    """How long a case runs.

    Attributes:
        seconds: how long.
        count: messages of each stream, instead; 0: by ``seconds``.
    """

    seconds: float = 10.0
    count: int = 0

    def messages(self, stream: Stream) -> int:
        """How many of a stream are measured; 0: as many as go into the time."""
        return self.count or (0 if stream.rate_hz == FLOOD else max(1, round(self.seconds * stream.rate_hz)))


@dataclass(frozen=True, slots=True)
class Plan:
    """What is measured of a case.

    Attributes:
        case: which.
        directions: which ways; several streams, or a mixed load, go all ways at once.
        extent: how long.
        floor: measure the bare hops too.
        record: the gateway records.
        peer: whose program is on the side of OpenIGTLink, "" for ours; see ``peers``.
    """

    case: Case
    directions: tuple[Direction, ...]
    extent: Extent
    floor: bool = True
    record: bool = False
    peer: str = ""


@dataclass(frozen=True, slots=True)
class Passed:
    """What came of one run of streams.

    Attributes:
        passages: by device.
        seconds: from the first message to the last arrival.
        begin, end: what the gateway had used, where there is one.
    """

    passages: dict[str, Passage]
    seconds: float
    begin: Usage | None = None
    end: Usage | None = None


@dataclass(frozen=True)
class _Gateway:
    """The gateway's process, and what it told of its recording at its end."""

    program: Program
    recorded: Row = field(default_factory=dict)

    @cached_property
    def address(self) -> Address:
        """Where it waits for OpenIGTLink peers, as soon as it does."""
        place = self.program.wait_for("started", _START_S)["listen"][0]
        return place["host"], place["port"]


class Runner:
    """See the module.

    Args:
        folder: for times and recordings.
        clock: monotonic time of all processes.
        tell: called with a line for people now and then.
    """

    def __init__(self, folder: Path, clock: Clock, tell: Callable[[str], None]) -> None:
        self._folder = folder
        self._clock = clock
        self._tell = tell
        self._runs = 0
        self._rest = threading.Event()
        self._library = Library(folder)
        self._floors: dict[tuple[str, float, int], tuple[float | None, float | None]] = {}

    def measure(self, plan: Plan) -> list[Row]:
        """The rows of a case.  Raises BenchError."""
        rows: list[Row] = []
        turns = [plan.directions] if plan.case.together else [(direction,) for direction in plan.directions]
        with self._gateway(plan) as gateway:
            for directions in turns:
                ways = ", ".join(direction.value for direction in directions)
                self._tell(f"{plan.case.name} {ways}{f' {plan.peer}' if plan.peer else ''}")
                passed = self._through_gateway(plan, directions, gateway)
                rows += self._rows(plan, directions, passed)
        rows = [row | gateway.recorded for row in rows]
        if plan.peer:
            hop = self._bare(self._briefly(plan), LIBRARY) if plan.peer == LIBRARY else None
            rows = [row | {"peer": plan.peer, "peer_hop_p50_ms": hop} for row in rows]
        elif plan.floor and not plan.case.together:
            hops = self._floor(plan)
            for row in rows:
                self._add_floor(row, hops)
        return rows

    # -- the gateway ---------------------------------------------------------------------------------------------

    @contextmanager
    def _gateway(self, plan: Plan) -> Iterator[_Gateway]:
        longest = max(
            plan.extent.count / stream.rate_hz if stream.rate_hz and plan.extent.count else plan.extent.seconds
            for stream in plan.case.streams
        )
        seconds = _GATEWAY_S + len(Direction) * longest
        words = ["bridge", "--json", "--listen", "127.0.0.1:0", "--duration", str(seconds)]
        for stream in plan.case.streams:
            topic, device = (f(Direction.ROS_TO_IGTL) for f in (stream.topic, stream.device))
            words += ["--send", f"{topic}={device}:{payload(stream.kind).igtl_type}"]
        if plan.record:
            words += ["--record", str(self._folder / "recording.mcap"), "--overwrite"]
        with Program("gateway", ours(*words)) as program:
            gateway = _Gateway(program)
            yield gateway
            program.interrupt()
            if plan.record:
                told = program.wait_for("stopped", _START_S)["recording"]
                gateway.recorded["recorder_dropped"] = told["dropped"]
                gateway.recorded["recorded_mb"] = round(told["bytes"] / 1e6, 1)

    def _through_gateway(self, plan: Plan, directions: Sequence[Direction], gateway: _Gateway) -> Passed:
        parts = {direction: self._parts(plan.case.streams, direction, plan.extent) for direction in directions}
        out = parts.get(Direction.ROS_TO_IGTL, ())
        back = parts.get(Direction.IGTL_TO_ROS, ())
        nodes = []
        if out:
            nodes.append(self._job(plan, "ros", "bench_sender", sends=out))
        if back:
            nodes.append(self._job(plan, "ros", "bench_listener", hears=back))
        with ExitStack() as stack:
            # the nodes start beside the gateway, which takes as long
            programs = [(job, self._start(stack, job)) for job in nodes]
            client = self._job(plan, plan.peer or "igtl", "client", sends=back, hears=out, address=gateway.address)
            programs.append((client, self._start(stack, client)))
            for _, program in programs:
                program.wait_for("ready", _START_S)
            return self._passed(programs, plan, gateway.program.pid)

    # -- the floor -----------------------------------------------------------------------------------------------

    def _floor(self, plan: Plan) -> tuple[float | None, float | None]:
        """Medians in ms of a bare hop over DDS and over TCP, with the same bytes at the same rate."""
        brief = self._briefly(plan)
        (stream,) = plan.case.streams
        key = (stream.kind, stream.rate_hz, brief.extent.count)
        if key not in self._floors:
            self._tell(f"{plan.case.name} floor")
            self._floors[key] = (self._bare(brief, "ros"), self._bare(brief, "igtl"))
        return self._floors[key]

    @staticmethod
    def _briefly(plan: Plan) -> Plan:
        """As long as a median needs."""
        (stream,) = plan.case.streams
        return replace(plan, extent=Extent(count=min(_FLOOR_COUNT, plan.extent.messages(stream) or _FLOOR_COUNT)))

    def _bare(self, plan: Plan, side: str) -> float | None:
        parts = tuple(
            replace(part, topic=f"/bench/floor/{part.device}")
            for part in self._parts(plan.case.streams, Direction.ROS_TO_IGTL, plan.extent)
        )
        with ExitStack() as stack:
            listener = self._job(plan, side, "bench_listener", hears=parts, listen=True)
            hearing = self._start(stack, listener)
            address = ("127.0.0.1", 0)
            if side != "ros":
                place = hearing.wait_for("listening", _START_S)
                address = (place["host"], place["port"])
            sender = self._job(plan, side, "bench_sender", sends=parts, address=address)
            sending = self._start(stack, sender)
            for program in (hearing, sending):
                program.wait_for("ready", _START_S)
            passed = self._passed([(listener, hearing), (sender, sending)], plan, None)
        told: float | None = latency(list(passed.passages.values()))["p50_ms"]
        return told

    @staticmethod
    def _add_floor(row: Row, hops: tuple[float | None, float | None]) -> None:
        dds, tcp = hops
        floor = round(dds + tcp, 4) if dds is not None and tcp is not None else None
        row |= {
            "floor_dds_p50_ms": dds,
            "floor_tcp_p50_ms": tcp,
            "floor_p50_ms": floor,
            "ratio": ratio(row["p50_ms"], floor),
        }

    # -- one run -------------------------------------------------------------------------------------------------

    @staticmethod
    def _parts(streams: Sequence[Stream], direction: Direction, extent: Extent) -> tuple[Part, ...]:
        parts = []
        for stream in streams:
            count = extent.messages(stream)
            parts.append(Part(stream, direction, stream.topic(direction), count + warm(stream) if count else 0))
        return tuple(parts)

    def _job(
        self,
        plan: Plan,
        side: str,
        name: str,
        *,
        sends: tuple[Part, ...] = (),
        hears: tuple[Part, ...] = (),
        address: Address = ("127.0.0.1", 0),
        listen: bool = False,
    ) -> Job:
        self._runs += 1
        times = str(self._folder / f"times-{self._runs}.npz")
        return Job(side, name, sends, hears, plan.extent.seconds, times, address, listen)

    def _start(self, stack: ExitStack, job: Job) -> Program:
        return stack.enter_context(Program(f"{job.side} {job.name}", command(job, self._library)))

    def _passed(self, programs: Sequence[tuple[Job, Program]], plan: Plan, gateway: int | None) -> Passed:
        """Knock, begin, wait until all have arrived or nothing more does, end; all programs are ready."""
        senders = [(job, program) for job, program in programs if job.sends]
        listeners = [(job, program) for job, program in programs if job.hears]
        for _, program in senders:
            program.order("knock")
        for job, program in listeners:
            missing = {part.device for part in job.hears}
            while missing:
                missing.discard(program.wait_for("heard", _HEARD_S)["device"])
        begin = Usage.of(gateway) if gateway else None
        begun_ns = self._clock.monotonic_ns()
        for _, program in senders:
            program.order("begin")
        sent = sum(program.wait_for("sent", self._limit_s(job))["messages"] for job, program in senders)
        self._wait_for_arrivals([program for _, program in listeners], sent, plan)
        seconds = (self._clock.monotonic_ns() - begun_ns) / NS_PER_S
        end = Usage.of(gateway) if gateway else None
        for _, program in programs:
            program.end()
        return Passed(_passages(programs), seconds, begin, end)

    def _wait_for_arrivals(self, listeners: Sequence[Program], sent: int, plan: Plan) -> None:
        large = any(payload(stream.kind).size > _LARGE_BYTES for stream in plan.case.streams)
        patience_ns = round((_LARGE_SILENCE_S if large else _SILENCE_S) * NS_PER_S)
        last, changed_ns = -1, self._clock.monotonic_ns()
        while True:
            for program in listeners:
                program.order("count")
            arrived = sum(program.wait_for("count", _HEARD_S)["messages"] for program in listeners)
            now_ns = self._clock.monotonic_ns()
            if arrived != last:
                last, changed_ns = arrived, now_ns
            if arrived >= sent or now_ns - changed_ns > patience_ns:
                return
            self._rest.wait(_LOOK_S)

    @staticmethod
    def _limit_s(job: Job) -> float:
        longest = max(part.count / part.stream.rate_hz if part.stream.rate_hz else 0 for part in job.sends)
        return 2 * max(longest, job.seconds) + _HEARD_S

    def _rows(self, plan: Plan, directions: Sequence[Direction], passed: Passed) -> list[Row]:
        rows: list[Row] = []
        for direction in directions:
            kinds: dict[str, list[Stream]] = {}
            for stream in plan.case.streams:
                kinds.setdefault(stream.kind, []).append(stream)
            for kind, streams in kinds.items():
                passages = [replace(passed.passages[stream.device(direction)], warm=warm(stream)) for stream in streams]
                row: Row = {"case": plan.case.name}
                if plan.case.together:
                    row["stream"] = kind
                row |= {"direction": direction.value, "rate_hz": streams[0].rate_hz or None, "recording": plan.record}
                rows.append(row | latency(passages))
        arrived = sum(len(passage.numbers) for passage in passed.passages.values())
        usage = _usage(passed, arrived)
        return [row | usage for row in rows]


def warm(stream: Stream) -> int:
    """How many messages at the beginning do not count."""
    if stream.rate_hz == FLOOD:
        return _WARM_FLOOD
    return max(1, min(_WARM_MOST, round(_WARM_S * stream.rate_hz)))


def _usage(passed: Passed, arrived: int) -> Row:
    """What the gateway used meanwhile, by all streams together."""
    begin, end = passed.begin, passed.end
    if begin is None or end is None:
        return {}
    cpu_s = end.cpu_s - begin.cpu_s
    return {
        "gateway_cpu_percent": round(100 * cpu_s / passed.seconds, 1),
        "gateway_cpu_us_per_message": round(1e6 * cpu_s / arrived, 1) if arrived else None,
        "recorder_cpu_percent": round(100 * (end.children_cpu_s - begin.children_cpu_s) / passed.seconds, 1),
        "gateway_rss_mb": round(end.rss_mb, 1),
        "gateway_rss_growth_mb": round(end.rss_mb - begin.rss_mb, 1),
        "gateway_rss_peak_mb": round(end.peak_mb, 1),
    }


def _passages(programs: Sequence[tuple[Job, Program]]) -> dict[str, Passage]:
    """What the programs wrote, by device."""
    columns: dict[str, Any] = {}
    for job, _ in programs:
        columns |= times_of(job)
    devices = [name.partition(" ")[2] for name in columns if name.startswith("sent ")]
    return {
        device: Passage(columns[f"sent {device}"], columns[f"numbers {device}"], columns[f"received {device}"])
        for device in devices
    }
