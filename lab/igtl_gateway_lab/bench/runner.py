"""Runs a case: the gateway, the programs on both sides, and the same programs without it."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, nullcontext
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

from igtl_gateway.clock import Clock
from igtl_gateway.stamp import NS_PER_S
from igtl_gateway_lab.bench import flame
from igtl_gateway_lab.bench.cases import FLOOD, BenchStream, Case, Direction, payload
from igtl_gateway_lab.bench.figures import Transmission, latency, lateness, ratio
from igtl_gateway_lab.bench.jobs import Job, JobStream
from igtl_gateway_lab.bench.peers import LIBRARY, PEERS, Library, command, times_of
from igtl_gateway_lab.bench.processes import BenchError, Program, Usage
from igtl_gateway_lab.bench.stalled import NAMES, STALLED, Stall
from igtl_gateway_lab.bench.window import window
from igtl_gateway_lab.programs import ours

#: Warm-up before the messages that count: seconds, the largest number of messages, and the number of a flood.
_WARM_S, _WARM_MOST, _WARM_FLOOD = 0.5, 200, 20
_START_S = 120.0  # a first start compiles igtl_msgs
_HEARD_S = 60.0
_LOOK_S = 0.25
#: After this time without a message none will arrive: DDS might wait for a heartbeat, every 3 s, to send again.
_SILENCE_S = 8.0
_LARGE_SILENCE_S, _LARGE_BYTES = 20.0, 4 << 20
#: Messages that the floor is measured with, at most: its median is all that is used; and for how long in a flood.
_FLOOR_COUNT, _FLOOR_FLOOD_S = 300, 3.0
#: A gateway without a parent ends itself this long after its runs.
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

    def messages(self, stream: BenchStream) -> int:
        """How many of a stream are measured; 0: as many as go into the time."""
        return self.count or (0 if stream.rate_hz == FLOOD else max(1, round(self.seconds * stream.rate_hz)))


@dataclass(frozen=True, slots=True)
class BenchPlan:
    """What is measured of a case.

    Attributes:
        case: which.
        directions: which ways.
        extent: how long.
        floor: measure the bare hops too.
        record: the gateway records.
        peer: whose program is on the side of OpenIGTLink, "" for ours; see ``peers``.
        clients: how many there are on the side of OpenIGTLink, all of which receive everything.
        flame: file for a picture of where the gateway spends its time.
    """

    case: Case
    directions: tuple[Direction, ...]
    extent: Extent
    floor: bool = True
    record: bool = False
    peer: str = ""
    clients: int = 1
    flame: Path | None = None


@dataclass(frozen=True, slots=True)
class RunResult:
    """What came of one run of streams.

    Attributes:
        passages: by device and client.
        seconds: from the order to begin to the last arrival.
        begin, end: what the gateway had used, where there is one.
    """

    passages: dict[tuple[str, int], Transmission]
    seconds: float
    begin: Usage | None = None
    end: Usage | None = None


@dataclass(frozen=True)
class _Gateway:
    """The gateway's process, and its report on the recording at its end."""

    program: Program
    stall: Stall
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
        print_status: called with a status line.
    """

    def __init__(self, folder: Path, clock: Clock, print_status: Callable[[str], None]) -> None:
        self._folder = folder
        self._clock = clock
        self._print_status = print_status
        self._runs = 0
        self._rest = threading.Event()
        self._library = Library(folder)

    def measure(self, plan: BenchPlan) -> list[Row]:
        """The rows of a case.  Raises BenchError."""
        runs: list[tuple[Sequence[Direction], RunResult]] = []
        turns = [plan.directions] if plan.case.at_once else [(direction,) for direction in plan.directions]
        with self._gateway(plan) as gateway:
            for directions in turns:
                marks = (plan.peer, "recording" if plan.record else "")
                self._print_status(" ".join(filter(None, (plan.case.name, *(way.value for way in directions), *marks))))
                runs.append((directions, self._through_gateway(plan, directions, gateway)))
        rows = [row | gateway.recorded for run in runs for row in self._rows(plan, *run, gateway.stall)]
        if plan.peer:
            hop = self._bare(self._briefly(plan), LIBRARY)["p50_ms"] if plan.peer == LIBRARY else None
            rows = [row | {"peer": plan.peer, "peer_hop_p50_ms": hop} for row in rows]
        elif plan.floor and not plan.case.together:
            self._print_status(f"{plan.case.name} floor")
            brief = self._briefly(plan)
            dds, tcp = self._bare(brief, "ros"), self._bare(brief, "igtl")
            rows = [row | against_floor(row, dds, tcp) for row in rows]
        return rows

    # -- the gateway ---------------------------------------------------------------------------------------------

    @contextmanager
    def _gateway(self, plan: BenchPlan) -> Iterator[_Gateway]:
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
            gateway = _Gateway(program, Stall())
            yield gateway
            program.interrupt_and_wait()
            told = program.wait_for("stopped", _START_S, gateway.stall.note)
            if plan.record:
                gateway.recorded["recorder_dropped"] = told["recording"]["dropped"]
                gateway.recorded["recorded_mb"] = round(told["recording"]["bytes"] / 1e6, 1)

    def _through_gateway(self, plan: BenchPlan, directions: Sequence[Direction], gateway: _Gateway) -> RunResult:
        parts = {direction: self._parts(plan, direction) for direction in directions}
        out = parts.get(Direction.ROS_TO_IGTL, ())
        back = parts.get(Direction.IGTL_TO_ROS, ())
        nodes = []
        if out:
            nodes.append(self._job(plan, "ros", "bench_sender", sends=out))
        if back:
            nodes.append(self._job(plan, "ros", "bench_listener", hears=back))
        hears = tuple(replace(part, client=client) for client in range(plan.clients) for part in out)
        with ExitStack() as stack:
            # the nodes start beside the gateway, which takes as long
            programs = [(job, self._start(stack, job)) for job in nodes]
            client = self._job(plan, plan.peer or "igtl", "client", sends=back, hears=hears, address=gateway.address)
            programs.append((client, self._start(stack, client)))
            if plan.case.stalls:
                hears = tuple(replace(part, client=STALLED, progress="") for part in out)
                idler = self._job(plan, "igtl", "stalled", hears=hears, address=gateway.address)
                programs.append((idler, self._start(stack, idler)))
            for _, program in programs:
                program.wait_for("ready", _START_S)
            return self._passed(programs, plan, gateway)

    # -- the floor -----------------------------------------------------------------------------------------------

    @staticmethod
    def _briefly(plan: BenchPlan) -> BenchPlan:
        """As long as a median needs, or a rate."""
        (stream,) = plan.case.streams
        extent = Extent(count=min(_FLOOR_COUNT, plan.extent.messages(stream) or _FLOOR_COUNT))
        if stream.rate_hz == FLOOD:
            extent = Extent(min(_FLOOR_FLOOD_S, plan.extent.seconds))
        return replace(plan, extent=extent, clients=1)

    def _bare(self, plan: BenchPlan, side: str) -> Row:
        """Figures of a bare hop with the same bytes at the same rate."""
        parts = tuple(
            replace(part, topic=f"/bench/floor/{part.device}")
            for part in self._parts(plan, Direction.ROS_TO_IGTL, side)
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
        return latency(list(passed.passages.values()))

    # -- one run -------------------------------------------------------------------------------------------------

    def _parts(self, plan: BenchPlan, direction: Direction, hearer: str = "") -> tuple[JobStream, ...]:
        """The streams to send; ``hearer`` is the receiver, if it does not follow from the plan."""
        self._runs += 1
        parts = []
        for stream in plan.case.streams:
            count = plan.extent.messages(stream)
            part = JobStream(stream, direction, stream.topic(direction), count + warm(stream) if count else 0)
            # programs by others do not report their progress; all except one receive in ROS
            hears = hearer or (plan.peer if direction is Direction.ROS_TO_IGTL else "ros")
            if stream.rate_hz == FLOOD and hears not in PEERS:
                progress = str(self._folder / f"progress-{self._runs}-{part.device}")
                part = replace(part, window=window(stream.kind, direction), progress=progress)
            parts.append(part)
        return tuple(parts)

    def _job(
        self,
        plan: BenchPlan,
        side: str,
        name: str,
        *,
        sends: tuple[JobStream, ...] = (),
        hears: tuple[JobStream, ...] = (),
        address: Address = ("127.0.0.1", 0),
        listen: bool = False,
    ) -> Job:
        self._runs += 1
        times = str(self._folder / f"times-{self._runs}.npz")
        return Job(side, name, sends, hears, plan.extent.seconds, times, address, listen)

    def _start(self, stack: ExitStack, job: Job) -> Program:
        return stack.enter_context(Program(f"{job.side} {job.name}", command(job, self._library)))

    def _passed(self, programs: Sequence[tuple[Job, Program]], plan: BenchPlan, gateway: _Gateway | None) -> RunResult:
        """Knock, begin, wait until all have arrived or nothing more does, end; all programs are ready."""
        senders = [(job, program) for job, program in programs if job.sends]
        listeners = [(job, program) for job, program in programs if job.hears]
        for _, program in senders:
            program.order("knock")
        for job, program in listeners:
            missing = {part.key for part in job.hears}
            while missing:
                try:
                    missing.discard(program.wait_for("heard", _HEARD_S)["key"])
                except BenchError:
                    for _, other in programs:
                        other.check()  # it may be the cause
                    raise
        with flame.drawn(gateway.program, plan.flame) if gateway and plan.flame else nullcontext():
            begin = Usage.of(gateway.program.pid) if gateway else None
            begun_ns = self._clock.monotonic_ns()
            for _, program in senders:
                program.order("begin")
            if gateway and plan.case.stalls:
                (idler,) = [program for job, program in listeners if job.name == "stalled"]
                gateway.stall.run(idler, plan.extent.seconds, self._rest.wait, self._clock.monotonic_ns)
            sent = sum(program.wait_for("sent", self._limit_s(job))["messages"] for job, program in senders)
            self._wait_for_arrivals([program for _, program in listeners], sent * plan.clients, plan)
            end = Usage.of(gateway.program.pid) if gateway else None
        for _, program in programs:
            program.end()
        passages = _passages(programs)
        # not until now: where something is lost, we have waited for it
        last_ns = max((int(one.received.max()) for one in passages.values() if len(one.received)), default=begun_ns)
        return RunResult(passages, (last_ns - begun_ns) / NS_PER_S, begin, end)

    def _wait_for_arrivals(self, listeners: Sequence[Program], sent: int, plan: BenchPlan) -> None:
        large = any(payload(stream.kind).size > _LARGE_BYTES for stream in plan.case.streams) and not plan.case.stalls
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

    @staticmethod
    def _rows(plan: BenchPlan, directions: Sequence[Direction], passed: RunResult, stall: Stall) -> list[Row]:
        kinds: dict[str, list[BenchStream]] = {}
        for stream in plan.case.streams:
            kinds.setdefault(stream.kind, []).append(stream)
        usage = _usage(passed, sum(len(passage.numbers) for passage in passed.passages.values()))
        rows: list[Row] = []
        for direction in directions:
            for kind, streams in kinds.items():
                row: Row = {"case": plan.case.name}
                if plan.case.together:
                    row["stream"] = kind
                rate_hz = streams[0].rate_hz or None
                row |= {"direction": direction.value, "rate_hz": rate_hz, "recording": plan.record}
                heard: dict[int, list[tuple[BenchStream, Transmission]]] = {}
                for stream in streams:
                    for (device, client), passage in passed.passages.items():
                        if device == stream.device(direction):
                            heard.setdefault(client, []).append((stream, replace(passage, warm=warm(stream))))
                passages = [passage for pairs in heard.values() for _, passage in pairs]
                late = lateness(passages, rate_hz) if rate_hz else {}
                if not plan.case.stalls:
                    rows.append(row | latency(passages) | late | usage)
                    continue
                for client, ((stream, passage),) in sorted(heard.items()):
                    told = stall.to_row(stream, passage) if client == STALLED else {}
                    rows.append(row | {"client": NAMES[client]} | latency([passage]) | late | told | usage)
        return rows


def against_floor(row: Row, dds: Row, tcp: Row) -> Row:
    """What stands in a row of the bare hops: in a flood their rates, else their medians and how many times those."""
    if row["rate_hz"] is None:
        return {"floor_dds_per_s": dds["received_per_s"], "floor_tcp_per_s": tcp["received_per_s"]}
    hops = (dds["p50_ms"], tcp["p50_ms"])
    floor = round(sum(hops), 4) if None not in hops else None
    return {
        "floor_dds_p50_ms": hops[0],
        "floor_tcp_p50_ms": hops[1],
        "floor_p50_ms": floor,
        "ratio": ratio(row["p50_ms"], floor),
    }


def warm(stream: BenchStream) -> int:
    """How many messages at the beginning do not count."""
    if stream.rate_hz == FLOOD:
        return _WARM_FLOOD
    return max(1, min(_WARM_MOST, round(_WARM_S * stream.rate_hz)))


def _usage(passed: RunResult, arrived: int) -> Row:
    """What the gateway used meanwhile, by all streams together."""
    begin, end = passed.begin, passed.end
    if begin is None or end is None or not arrived:
        return {}
    cpu_s = end.cpu_s - begin.cpu_s
    return {
        "gateway_cpu_percent": round(100 * cpu_s / passed.seconds, 1),
        "gateway_cpu_us_per_message": round(1e6 * cpu_s / arrived, 1),
        "recorder_cpu_percent": round(100 * (end.children_cpu_s - begin.children_cpu_s) / passed.seconds, 1),
        "gateway_rss_mb": round(end.rss_mb, 1),
        "gateway_rss_growth_mb": round(end.rss_mb - begin.rss_mb, 1),
        "gateway_rss_peak_mb": round(end.peak_mb, 1),
    }


def _passages(programs: Sequence[tuple[Job, Program]]) -> dict[tuple[str, int], Transmission]:
    """What the programs wrote, by device and client."""
    columns: dict[str, Any] = {}
    for job, _ in programs:
        columns |= times_of(job)
    return {
        (part.device, part.client): Transmission(
            columns[f"sent {part.device}"], columns[f"numbers {part.key}"], columns[f"received {part.key}"]
        )
        for job, _ in programs
        for part in job.hears
    }
