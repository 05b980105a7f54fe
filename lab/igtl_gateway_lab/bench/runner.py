"""Runs a case: the gateway or another bridge, the programs on both sides, and the same programs without it."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, nullcontext
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

from igtl_gateway.base.clock import Clock
from igtl_gateway.base.stamp import NS_PER_S
from igtl_gateway.record.seal.keys import SigningKey
from igtl_gateway_lab.bench import bridges, flame
from igtl_gateway_lab.bench.bridges import HOP, START_S, Address, Bridge, wait_ready
from igtl_gateway_lab.bench.cases import CASES, FLOOD, BenchStream, Case, Direction, payload
from igtl_gateway_lab.bench.figures import Row, Transmission, in_turn, latency, lateness
from igtl_gateway_lab.bench.floors import against_floor, against_hop, against_mixed_floor
from igtl_gateway_lab.bench.jobs import Job, JobStream
from igtl_gateway_lab.bench.peers import LIBRARY, PEERS, Library, command, times_of
from igtl_gateway_lab.bench.probe import compile_probe
from igtl_gateway_lab.bench.processes import BenchError, Program, Usage, wakeups
from igtl_gateway_lab.bench.stalled import NAMES, STALLED
from igtl_gateway_lab.bench.window import window
from igtl_gateway_lab.programs import ours

#: Warm-up before the messages that count: seconds, the largest number of messages, and the number of a flood.
_WARM_S, _WARM_MOST, _WARM_FLOOD = 0.5, 200, 20
_HEARD_S = 60.0
_LOOK_S = 0.25
#: After this time without a message none will arrive: DDS might wait for a heartbeat, every 3 s, to send again.
_SILENCE_S = 8.0
_LARGE_SILENCE_S, _LARGE_BYTES = 20.0, 4 << 20
#: Messages that the floor is measured with, at most: its median is all that is used; and for how long in a flood.
_FLOOR_COUNT, _FLOOR_FLOOD_S = 300, 3.0
#: After the connection of all programs, until discovery is over.
_SETTLE_S = 3.0
#: A gateway without a parent ends itself this long after its runs.
_GATEWAY_S = 600.0

#: Which programs measure; those in Python need no compiler.
NATIVE, PYTHON = "native", "python"

#: Stands for what was passed: device and client.
Passages = Mapping[tuple[str, int], Transmission]


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
        hop: measure a bridge that does nothing but the hop, too.
        against: commands of other bridges to measure.
        programs: ``NATIVE`` or ``PYTHON``.
        zenoh: the ROS side is over Zenoh, with a router of its own; only ``PYTHON`` has programs for it.
        record: the gateway records.
        seal: it seals the recording.
        peer: whose program is on the side of OpenIGTLink, "" for ours; see ``peers``.
        clients: how many there are on the side of OpenIGTLink, all of which receive everything.
        flame: file for a picture of where the gateway spends its time.
    """

    case: Case
    directions: tuple[Direction, ...]
    extent: Extent
    floor: bool = True
    hop: bool = False
    against: tuple[str, ...] = ()
    programs: str = PYTHON
    zenoh: bool = False
    record: bool = False
    seal: bool = False
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

    passages: Passages
    seconds: float
    begin: Usage | None = None
    end: Usage | None = None


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
        self._endpoint = ""  # of the router, while something is measured over Zenoh

    def measure(self, plan: BenchPlan) -> list[Row]:
        """The rows of a case: those of the gateway, then those of the other bridges.  Raises BenchError."""
        if not plan.zenoh:
            return self._measure(plan)
        self._endpoint = f"tcp/127.0.0.1:{bridges.free_port()}"
        try:
            with Program("router", ours("zenoh-router", "--listen", self._endpoint)):
                return [row | {"middleware": "zenoh"} for row in self._measure(plan)]
        finally:
            self._endpoint = ""

    def _measure(self, plan: BenchPlan) -> list[Row]:
        rows = self._of_bridge(plan, "")
        for command_line in plan.against:
            try:
                rows += self._of_bridge(plan, command_line)
            except BenchError as error:  # what has been measured so far remains
                self._print_status(f"left out: {command_line}: {error}")
        if plan.hop:
            rows += self._of_bridge(plan, HOP)
        if plan.peer:
            hop = self._bare(self._briefly(plan), LIBRARY)["p50_ms"] if plan.peer == LIBRARY else None
            rows = [row | {"peer": plan.peer, "peer_hop_p50_ms": hop} for row in rows]
        elif plan.floor and plan.case.together:
            self._status(plan, "floor")
            floors = self._bare_together(plan)
            rows = [row | against_mixed_floor(row, floors[row["direction"], row["stream"]]) for row in rows]
        elif plan.floor:
            self._status(plan, "floor")
            brief = self._briefly(plan)
            ros, tcp = self._bare(brief, "ros"), self._bare(brief, "igtl")
            middleware = "zenoh" if plan.zenoh else "dds"
            rows = [row | against_floor(row, ros, tcp, middleware) for row in rows]
        return against_hop(rows) if plan.hop else rows

    def idle(self, name: str, programs: str, seconds: float) -> Row:
        """What a bridge uses while one peer and one ROS node are connected and nothing passes.  Raises BenchError."""
        plan = BenchPlan(CASES["transform"], tuple(Direction), Extent(seconds), programs=programs)
        out, back = (self._parts(plan, direction) for direction in Direction)
        with self._bridge(plan, name) as bridge, ExitStack() as stack:
            node = self._job(plan, "ros", "bench_node", sends=out, hears=back)
            peer = self._job(plan, "igtl", "client", sends=back, hears=out, address=bridge.address)
            started = [self._start(stack, job) for job in (node, peer)]
            wait_ready(started, bridge)
            self._rest.wait(_SETTLE_S)
            pid = bridge.program.pid
            begun_ns, begin, waited = self._clock.monotonic_ns(), Usage.of(pid), wakeups(pid)
            self._rest.wait(seconds)
            spent_s = (self._clock.monotonic_ns() - begun_ns) / NS_PER_S
            end, woken = Usage.of(pid), wakeups(pid)
            for program in started:
                program.order("knock")
                program.order("begin")
                program.end()
        return {
            "seconds": seconds,
            "gateway_cpu_percent": round(100 * (_spent_s(begin, end, bridge)) / spent_s, 3),
            "wakeups_per_s": round(sum(count - waited.get(task, 0) for task, count in woken.items()) / spent_s, 1),
            "threads": len(woken),
            "gateway_rss_mb": round(end.rss_mb, 1),
        }

    # -- bridges -------------------------------------------------------------------------------------------------

    def _of_bridge(self, plan: BenchPlan, name: str) -> list[Row]:
        """The rows of the gateway (""), of the hop, or of a command."""
        runs: list[tuple[Sequence[Direction], RunResult]] = []
        turns = [plan.directions] if plan.case.at_once else [(direction,) for direction in plan.directions]
        with self._bridge(plan, name) as bridge:
            for directions in turns:
                self._status(
                    plan,
                    *(way.value for way in directions),
                    plan.peer,
                    "recording" * plan.record,
                    "sealing" * plan.seal,
                    name,
                )
                runs.append((directions, self._through_bridge(plan, directions, bridge)))
        marks: Row = {"programs": plan.programs} | ({"bridge": name} if name else {})
        return [row | bridge.recorded | marks for run in runs for row in self._rows(plan, *run, bridge)]

    def _bridge(self, plan: BenchPlan, name: str) -> AbstractContextManager[Bridge]:
        if name:
            return bridges.foreign(name, plan.case, self._probe)
        longest = max(
            plan.extent.count / stream.rate_hz if stream.rate_hz and plan.extent.count else plan.extent.seconds
            for stream in plan.case.streams
        )
        recording = self._folder / "recording.mcap" if plan.record else None
        key = self._key if plan.seal else None
        return bridges.gateway(plan.case, _GATEWAY_S + len(Direction) * longest, recording, key, self._endpoint)

    @cached_property
    def _key(self) -> Path:
        path = self._folder / "recorder.key"
        path.touch(0o600)
        path.write_bytes(SigningKey.generate().private_pem())
        return path

    @cached_property
    def _probe(self) -> Path:
        return compile_probe(self._folder)

    def _status(self, plan: BenchPlan, *words: str) -> None:
        self._print_status(" ".join(filter(None, (plan.case.name, *words))))

    def _through_bridge(self, plan: BenchPlan, directions: Sequence[Direction], bridge: Bridge) -> RunResult:
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
            # the nodes start beside the bridge, which takes as long
            programs = [(job, self._start(stack, job)) for job in nodes]
            client = self._job(plan, plan.peer or "igtl", "client", sends=back, hears=hears, address=bridge.address)
            programs.append((client, self._start(stack, client)))
            if plan.case.stalls:
                hears = tuple(replace(part, client=STALLED, progress="") for part in out)
                idler = self._job(plan, "igtl", "stalled", hears=hears, address=bridge.address)
                programs.append((idler, self._start(stack, idler)))
            wait_ready([program for _, program in programs], bridge)
            return self._passed(programs, plan, bridge)

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
                place = hearing.wait_for("listening", START_S)
                address = (place["host"], place["port"])
            sender = self._job(plan, side, "bench_sender", sends=parts, address=address)
            sending = self._start(stack, sender)
            wait_ready((hearing, sending), None)
            passed = self._passed([(listener, hearing), (sender, sending)], plan, None)
        return latency(list(passed.passages.values()))

    def _bare_together(self, plan: BenchPlan) -> dict[tuple[str, str], Row]:
        """The streams of both ways over bare DDS and over bare TCP, at the same time; by direction and kind.

        Each message then has a latency in DDS and one in TCP: their sum is its floor.
        """
        ways = {direction: self._parts(plan, direction) for direction in plan.directions}
        out, back = (ways.get(direction, ()) for direction in Direction)
        bare = tuple(replace(part, topic=f"/bench/floor/{part.device}") for part in (*out, *back))
        with ExitStack() as stack:
            server = self._job(plan, "igtl", "server", sends=out, hears=back, listen=True)
            listener = self._job(plan, "ros", "bench_listener", hears=bare)
            sender = self._job(plan, "ros", "bench_sender", sends=bare)
            started = [(job, self._start(stack, job)) for job in (server, listener, sender)]
            place = started[0][1].wait_for("listening", START_S)
            client = self._job(plan, "igtl", "client", sends=back, hears=out, address=(place["host"], place["port"]))
            started.insert(1, (client, self._start(stack, client)))
            wait_ready([program for _, program in started], None)
            self._drive(started, plan, None)
        tcp, dds = _passages(started[:2]), _passages(started[2:])
        floors: dict[tuple[str, str], Row] = {}
        for direction, parts in ways.items():
            kinds: dict[str, list[Transmission]] = {}
            for part in parts:
                sums = in_turn(dds[part.device, 0], tcp[part.device, 0])
                kinds.setdefault(part.stream.kind, []).append(replace(sums, warm=warm(part.stream)))
            floors |= {(direction.value, kind): latency(sums) for kind, sums in kinds.items()}
        return floors

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
        native = str(self._probe) if plan.programs == NATIVE else ""
        zenoh = self._endpoint if side == "ros" else ""
        return Job(side, name, sends, hears, plan.extent.seconds, times, address, listen, native, zenoh)

    def _start(self, stack: ExitStack, job: Job) -> Program:
        return stack.enter_context(Program(f"{job.side} {job.name}", command(job, self._library)))

    def _passed(self, programs: Sequence[tuple[Job, Program]], plan: BenchPlan, bridge: Bridge | None) -> RunResult:
        """One run of programs that are ready."""
        begun_ns, begin, end = self._drive(programs, plan, bridge)
        passages = _passages(programs)
        # not until now: where something is lost, we have waited for it
        last_ns = max((int(one.received.max()) for one in passages.values() if len(one.received)), default=begun_ns)
        return RunResult(passages, (last_ns - begun_ns) / NS_PER_S, begin, end)

    def _drive(
        self, programs: Sequence[tuple[Job, Program]], plan: BenchPlan, bridge: Bridge | None
    ) -> tuple[int, Usage | None, Usage | None]:
        """Knock, begin, wait until all have arrived or nothing more does, end; all programs are ready.

        Returns:
            When they began, monotonic, and what the bridge had used then and at the end.
        """
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
                    for other in (*((bridge.program,) if bridge else ()), *(program for _, program in programs)):
                        other.check()  # it may be the cause
                    raise
        if bridge:
            self._rest.wait(bridge.unsteady_s(self._clock.monotonic_ns()))
        with flame.drawn(bridge.program, plan.flame) if bridge and plan.flame else nullcontext():
            begin = Usage.of(bridge.program.pid) if bridge else None
            begun_ns = self._clock.monotonic_ns()
            for _, program in senders:
                program.order("begin")
            if bridge and plan.case.stalls:
                (idler,) = [program for job, program in listeners if job.name == "stalled"]
                bridge.stall.run(idler, plan.extent.seconds, self._rest.wait, self._clock.monotonic_ns)
            sent = sum(program.wait_for("sent", self._limit_s(job))["messages"] for job, program in senders)
            self._wait_for_arrivals([program for _, program in listeners], sent * plan.clients, plan)
            end = Usage.of(bridge.program.pid) if bridge else None
        for _, program in programs:
            program.end()
        return begun_ns, begin, end

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
    def _rows(plan: BenchPlan, directions: Sequence[Direction], passed: RunResult, bridge: Bridge) -> list[Row]:
        kinds: dict[str, list[BenchStream]] = {}
        for stream in plan.case.streams:
            kinds.setdefault(stream.kind, []).append(stream)
        usage = _usage(passed, sum(len(passage.numbers) for passage in passed.passages.values()), bridge)
        rows: list[Row] = []
        for direction in directions:
            for kind, streams in kinds.items():
                row: Row = {"case": plan.case.name}
                if plan.case.together:
                    row["stream"] = kind
                rate_hz = streams[0].rate_hz or None
                row |= {"direction": direction.value, "rate_hz": rate_hz, "recording": plan.record}
                row |= {"sealed": True} if plan.seal else {}
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
                    waits = bridge.stall.to_row(stream, passage) if client == STALLED else {}
                    rows.append(row | {"client": NAMES[client]} | latency([passage]) | late | waits | usage)
        return rows


def warm(stream: BenchStream) -> int:
    """How many messages at the beginning do not count."""
    if stream.rate_hz == FLOOD:
        return _WARM_FLOOD
    return max(1, min(_WARM_MOST, round(_WARM_S * stream.rate_hz)))


def _usage(passed: RunResult, arrived: int, bridge: Bridge) -> Row:
    """What the bridge used meanwhile, by all streams together."""
    begin, end = passed.begin, passed.end
    if begin is None or end is None or not arrived:
        return {}
    cpu_s = _spent_s(begin, end, bridge)
    return {
        "gateway_cpu_percent": round(100 * cpu_s / passed.seconds, 1),
        "gateway_cpu_us_per_message": round(1e6 * cpu_s / arrived, 1),
        "recorder_cpu_percent": round(100 * (end.children_cpu_s - begin.children_cpu_s) / passed.seconds, 1),
        "gateway_rss_mb": round(end.rss_mb, 1),
        "gateway_rss_growth_mb": round(end.rss_mb - begin.rss_mb, 1),
        "gateway_rss_peak_mb": round(end.peak_mb, 1),
    }


def _spent_s(begin: Usage, end: Usage, bridge: Bridge) -> float:
    """CPU time of a bridge; the gateway's child is its recorder, that of another might be the bridge itself."""
    children_s = end.children_cpu_s - begin.children_cpu_s if bridge.foreign else 0.0
    return end.cpu_s - begin.cpu_s + children_s


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
