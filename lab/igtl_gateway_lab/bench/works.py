"""What else takes time: to start, to record, to replay and to verify."""

from __future__ import annotations

import json
import os
import socket
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import median_low

import numpy as np

from igtl_gateway.base.clock import Clock
from igtl_gateway.base.stamp import NS_PER_S
from igtl_gateway.config.configuration import Config, ToIgtlRow
from igtl_gateway.gateway import LINK_UP, Gateway, Session
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.note import Level, Note
from igtl_gateway.record.recorder import Recorder
from igtl_gateway_lab.bench import offline
from igtl_gateway_lab.bench.bridges import HOP, free_port
from igtl_gateway_lab.bench.cases import CASES, BenchStream, Direction, payload
from igtl_gateway_lab.bench.figures import Row
from igtl_gateway_lab.bench.jobs import Job, JobStream
from igtl_gateway_lab.bench.processes import BenchError, Program, Usage
from igtl_gateway_lab.bench.runner import NATIVE, PYTHON, Runner
from igtl_gateway_lab.programs import ours

_STARTS = 5
_IDLE_S = 20.0
_START_S = 120.0
_RECORDED_S = 10  # seconds of the mixed load, of the recorded session
_LARGE_BYTES, _HEAD_BYTES = 100_000, 200  # of messages that are made noise of, and what stays of them
_QUEUED_BYTES = 24 << 20  # small enough that the recorder keeps up: a burst would allocate memory again
_WRITTEN_BYTES = 4 << 20  # more than the largest message of the mixed load
_REPLAYED = {"transform": 20_000, "image-fullhd": 30}
_STAR_S = 12.0  # what the scenario lasts
_PATIENCE_S = 300.0
_LOOK_S = 0.2
_KNOCK_S = 0.002


@dataclass(frozen=True, slots=True)
class WorkContext:
    """What a work is done with.

    Attributes:
        folder: for recordings.
        clock: monotonic.
        print_status: prints a status line.
        programs: which programs measure, see ``runner``.
        against: commands of other bridges to measure.
        duration_s: of the recordings that are made.
    """

    folder: Path
    clock: Clock
    print_status: Callable[[str], None]
    programs: str = PYTHON
    against: tuple[str, ...] = ()
    duration_s: float = 10.0


@dataclass(frozen=True, slots=True)
class Work:
    """Something to measure: one line for people, and what gives its rows."""

    text: str
    run: Callable[[WorkContext], list[Row]]


def start_up(shop: WorkContext) -> list[Row]:
    """From the command to the open port, where a peer that calls again and again is let in, and to the node in ROS."""
    ports, nodes, memory = [], [], 0.0
    for _ in range(_STARTS):
        shop.print_status("start-up")
        port = free_port()
        begun_ns = shop.clock.monotonic_ns()
        with Program("gateway", ours("bridge", "--json", "--listen", f"127.0.0.1:{port}")) as gateway:
            _knock(port, gateway, shop.clock)
            ports.append((shop.clock.monotonic_ns() - begun_ns) / NS_PER_S)
            gateway.wait_for("started", _START_S)
            nodes.append((shop.clock.monotonic_ns() - begun_ns) / NS_PER_S)
            memory = Usage.of(gateway.pid).rss_mb
            gateway.interrupt_and_wait()
    return [
        {
            "case": "start-up",
            "starts": _STARTS,
            "port_p50_s": round(median_low(ports), 3),
            "port_max_s": round(max(ports), 3),
            "node_p50_s": round(median_low(nodes), 3),
            "node_max_s": round(max(nodes), 3),
            "gateway_rss_mb": round(memory, 1),
        }
    ]


def _knock(port: int, gateway: Program, clock: Clock) -> None:
    """Wait until the port is open.  Raises BenchError."""
    deadline_ns = clock.monotonic_ns() + int(_START_S * NS_PER_S)
    while True:
        try:
            socket.create_connection(("127.0.0.1", port), timeout=_KNOCK_S).close()
            return
        except (ConnectionRefusedError, TimeoutError):
            gateway.check()
            if clock.monotonic_ns() > deadline_ns:
                raise BenchError(f"the gateway has not opened its port within {_START_S:g} s") from None
            threading.Event().wait(_KNOCK_S)


def idle(shop: WorkContext) -> list[Row]:
    """What it costs to be awake: a peer and a node are connected, and nothing passes."""
    runner = Runner(shop.folder, shop.clock, shop.print_status)
    rows = []
    for name in ("", *shop.against, *((HOP,) if shop.programs == NATIVE else ())):
        shop.print_status(" ".join(filter(None, ("idle", name))))
        row: Row = {"case": "idle"} | ({"bridge": name} if name else {})
        rows.append(row | runner.idle(name, shop.programs, _IDLE_S))
    return rows


def recording(shop: WorkContext) -> list[Row]:
    """The mixed load through the recorder alone, as fast as it writes: from the first entry until the file is closed.

    Twice, for it depends on what becomes smaller: nothing does of a picture with the noise of a camera.
    """
    second = list(_mixed_second(shop.clock))
    noise = np.random.default_rng(1)
    rows = []
    for what, entries in (("mixed", second), ("mixed, noise", [_noisy(entry, noise) for entry in second])):
        shop.print_status(f"recording {what}")
        rows.append({"case": "recording", "what": what} | _recorded(shop, entries))
    return rows


def _noisy(entry: Entry, noise: np.random.Generator) -> Entry:
    """A large message with other content, which cannot be compressed."""
    if entry.size < _LARGE_BYTES:
        return entry
    return replace(entry, payload=(entry.data()[:_HEAD_BYTES] + noise.bytes(entry.size - _HEAD_BYTES),))


def _recorded(shop: WorkContext, second: Sequence[Entry]) -> Row:
    """How fast the entries of a second are recorded, again and again."""
    path = shop.folder / "throughput.mcap"
    floor_s = _written_s(shop, path, second)
    rest = threading.Event()
    recorder = _recorder(path, Config(), shop.clock)
    stamp_ns = shop.clock.utc_ns()
    entries = [replace(entry, seq=seq, stamp_ns=stamp_ns + seq) for seq, entry in _repeated(second)]
    begun_ns = shop.clock.monotonic_ns()
    before = Usage.of(os.getpid())
    for entry in entries:
        recorder(entry)
        if not entry.seq % 64:
            while recorder.counters()["queued_bytes"] > _QUEUED_BYTES:
                rest.wait(0.002)
    while recorder.counters()["queued_bytes"]:
        rest.wait(0.002)
    after = Usage.of(os.getpid())
    summary = recorder.close({})
    seconds = (shop.clock.monotonic_ns() - begun_ns) / NS_PER_S
    path.unlink()
    return {
        "entries": summary.entries,
        "dropped": sum(summary.dropped.values()),
        "entries_per_s": round(summary.entries / seconds),
        "mb_per_s": round(_RECORDED_S * sum(entry.size for entry in second) / seconds / 1e6, 1),
        "times_mixed_load": round(_RECORDED_S / seconds, 2),
        "floor_times_mixed_load": round(_RECORDED_S / floor_s, 2),
        # at the rate of the mixed load: of who gives and of who writes
        "gateway_cpu_percent": round(100 * (after.cpu_s - before.cpu_s) / _RECORDED_S, 1),
        "recorder_cpu_percent": round(100 * (after.children_cpu_s - before.children_cpu_s) / _RECORDED_S, 1),
    }


def _repeated(second: Sequence[Entry]) -> Iterator[tuple[int, Entry]]:
    """The entries of all recorded seconds, with their numbers."""
    return enumerate((entry for _ in range(_RECORDED_S) for entry in second), 1)


def _written_s(shop: WorkContext, path: Path, second: Sequence[Entry]) -> float:
    """The floor of a recording: seconds to copy the same payloads into a buffer, and to write it when it is full."""
    buffer, filled = bytearray(_WRITTEN_BYTES), 0
    begun_ns = shop.clock.monotonic_ns()
    with path.open("wb", buffering=0) as file:
        for _, entry in _repeated(second):
            data = entry.data()
            if filled + len(data) > len(buffer):
                file.write(memoryview(buffer)[:filled])
                filled = 0
            buffer[filled : filled + len(data)] = data
            filled += len(data)
        file.write(memoryview(buffer)[:filled])
    seconds = (shop.clock.monotonic_ns() - begun_ns) / NS_PER_S
    path.unlink()
    return seconds


def replay(shop: WorkContext) -> list[Row]:
    """A recording to a local peer, as fast as possible."""
    rows = []
    for kind, count in _REPLAYED.items():
        shop.print_status(f"replay {kind}")
        stream = BenchStream(kind, 0.0)
        path = shop.folder / f"{kind}.mcap"
        record_passage(path, stream, count, shop.clock)
        rows.append({"case": "replay", "what": kind, "sent": count} | _replayed(shop, path, stream, count))
        path.unlink()
    return rows


def verify(shop: WorkContext) -> list[Row]:
    """The synthetic suturing session, and a recording of small messages: until the verdict, the start included."""
    star = shop.folder / "star.mcap"
    _until_end("simulate", ["simulate", "star", "-o", str(star), "--overwrite", "--json"])
    small = shop.folder / "small.mcap"
    count = _REPLAYED["transform"]
    record_passage(small, BenchStream("transform", 0.0), count, shop.clock)
    rows = []
    for name, path in (("star", star), ("transform", small)):
        shop.print_status(f"verify {name}")
        begun_ns = shop.clock.monotonic_ns()
        _until_end("verify", ["verify", str(path), "--json"])
        seconds = (shop.clock.monotonic_ns() - begun_ns) / NS_PER_S
        row: Row = {"case": "verify", "what": name, "seconds": round(seconds, 2)}
        row["mb_per_s"] = round(path.stat().st_size / seconds / 1e6, 1)
        if name == "star":
            row["times_real_time"] = round(_STAR_S / seconds, 1)
        else:
            row["inputs_per_s"] = round(count / seconds)
        rows.append(row)
    return rows


def verbs(shop: WorkContext) -> list[Row]:
    """Each verb on recordings, in turns with the programs of others, see ``offline``."""
    return offline.measure(shop.folder, shop.duration_s, shop.clock, shop.print_status)


WORKS: dict[str, Work] = {
    "start-up": Work("from the command to the open port and the node in ROS", start_up),
    "idle": Work("20 s with one peer and one ROS node, without messages", idle),
    "recording": Work("the mixed load through the recorder alone, as fast as it writes", recording),
    "replay": Work("20,000 transforms and 30 Full HD pictures, recorded, to a local peer at once", replay),
    "verify": Work("the recorded suturing session and 20,000 transforms", verify),
    "offline": Work("the verbs on recordings of --duration, beside pymcap-cli and rerun", verbs),
}


def _mixed_second(clock: Clock) -> Iterator[Entry]:
    """The entries of one second of the mixed load, both ways, with what the gateway makes of it."""
    streams = CASES["mixed"].streams
    session = _session(streams, clock)
    for stream in streams:
        made = payload(stream.kind)
        device, topic = stream.device(Direction.IGTL_TO_ROS), stream.topic(Direction.ROS_TO_IGTL)
        frame, cdr = bytes(made.igtl_maker(device)(1)), made.ros_maker()(1)
        for _ in range(round(stream.rate_hz)):
            yield from session.input(clock.utc_ns(), Kind.IGTL_IN, (frame,), links=(1,))
            yield from session.input(clock.utc_ns(), Kind.ROS_IN, (cdr,), channel=topic, type_name=made.ros_type)


def record_passage(path: Path, stream: BenchStream, count: int, clock: Clock) -> None:
    """Make a recording with the given number of messages from ROS to OpenIGTLink."""
    made, topic = payload(stream.kind), stream.topic(Direction.ROS_TO_IGTL)
    make = made.ros_maker()
    recorder = _recorder(path, _config((stream,)), clock)
    session = _session((stream,), clock, recorder)
    rest = threading.Event()
    for number in range(1, count + 1):
        cdr = (make(number),)
        for entry in session.input(clock.utc_ns(), Kind.ROS_IN, cdr, channel=topic, type_name=made.ros_type):
            recorder(entry)
        while recorder.counters()["queued_bytes"] > _QUEUED_BYTES:
            rest.wait(0.002)
    recorder.close(session.gateway.ledger.to_dict())


def _config(streams: Sequence[BenchStream]) -> Config:
    way = Direction.ROS_TO_IGTL
    return Config(
        to_igtl=tuple(
            ToIgtlRow(topic=stream.topic(way), device=stream.device(way), type=payload(stream.kind).igtl_type)
            for stream in streams
        )
    )


def _session(streams: Sequence[BenchStream], clock: Clock, recorder: Recorder | None = None) -> Session:
    """A session with one peer."""
    session = Session(Gateway(_config(streams)))
    for entry in session.input(clock.utc_ns(), Kind.LINK, (Note(Level.INFO, LINK_UP, "up").pack(),), links=(1,)):
        if recorder:
            recorder(entry)
    return session


def _recorder(path: Path, config: Config, clock: Clock) -> Recorder:
    facts = {"config": json.dumps(config.to_dict(), sort_keys=True)}
    return Recorder(path, facts, qos_of=lambda *_: None, on_note=lambda _note: None, clock=clock)


def _replayed(shop: WorkContext, path: Path, stream: BenchStream, count: int) -> Row:
    """How fast the recorded messages of a stream reach a peer."""
    part = JobStream(stream, Direction.ROS_TO_IGTL, "", count)
    times = shop.folder / "replayed.npz"
    job = Job("igtl", "peer", (), (part,), 0.0, str(times), listen=True)
    rest = threading.Event()
    with ExitStack() as stack:
        peer = stack.enter_context(Program("peer", [sys.executable, "-m", "igtl_gateway_lab.bench", job.to_json()]))
        place = peer.wait_for("listening", _START_S)
        to = f"{place['host']}:{place['port']}"
        words = [
            "replay",
            str(path),
            "--to",
            "igtl",
            "--exact",
            "--connect",
            to,
            "--as-fast-as-possible",
            "--no-digest",
            "--json",
        ]
        player = stack.enter_context(Program("replay", ours(*words)))
        peer.wait_for("ready", _START_S)
        player.wait_ended(_PATIENCE_S)
        last = -1
        while True:
            peer.order("count")
            arrived = peer.wait_for("count", _PATIENCE_S)["messages"]
            if arrived in (last, count):
                break
            last = arrived
            rest.wait(_LOOK_S)
        peer.end()
    with np.load(times, allow_pickle=False) as file:
        received = file[f"received {part.device}"]
    seconds = (int(received.max()) - int(received.min())) / NS_PER_S if len(received) > 1 else 0.0
    per_s = (len(received) - 1) / seconds if seconds else None
    return {
        "delivered": len(received),
        "received_per_s": round(per_s, 1) if per_s else None,
        "mb_per_s": round(per_s * payload(stream.kind).size / 1e6, 1) if per_s else None,
    }


def _until_end(name: str, words: Sequence[str]) -> None:
    with Program(name, ours(*words)) as program:
        program.wait_ended(_PATIENCE_S)
