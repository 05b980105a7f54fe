"""The soak: a bridge that records, under the mixed load, while peers come and go.

    python tools/soak.py --seconds 3600 --folder /tmp/soak

Strategy: the programs of ``igtl-gateway bench`` are the steady peers: a node that sends, a node that hears, a client
that does both; every message has a number, so losses are known end to end.  Beside them guests (``soak_guest.py``)
come at random moments, listen, talk, read slowly or not at all, and leave politely, by RST, in mid-message or by
kill −9, as the seed says; a further ROS node has endpoints that come and go, and is ended and killed itself.  Every few
seconds memory, threads and file descriptors of the bridge and of its recorder are taken, with queues and counts from
``--metrics``.  The recording is split; each part is verified when it is complete, and deleted when it is as it should
be.

In the end the guests leave, threads and descriptors have to come back to what they were before the first came, the
bridge is interrupted, and judged: see ``judge``.  The exit code is 1 if anything is not as it should be.

Pictures and clouds have the sizes of the mixed load, but content that compresses: two thirds of what an hour records,
460 GB, would be noise.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
import urllib.request
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from random import Random
from typing import Any

import numpy as np

from igtl_gateway.bench import cases, payloads, programs
from igtl_gateway.bench.cases import CASES, Direction, Stream, payload
from igtl_gateway.bench.figures import Passage, latency
from igtl_gateway.bench.jobs import Job, Part
from igtl_gateway.bench.processes import BenchError, Event, Program, ours
from igtl_gateway.convert import rosmsg
from igtl_gateway.session.ledger import gaps
from igtl_gateway.wire.image import Image
from igtl_gateway.wire.polydata import Cells, PolyData

GUEST = Path(__file__).with_name("soak_guest.py")

_START_S, _HEARD_S, _CALM_S, _VERIFY_S = 180.0, 60.0, 90.0, 3600.0
_MB = 1e6
_PICTURE, _CLOUD = "scan-vga", "grid-30k"

#: What a guest does, and how it leaves, as often as it stands here.
MANNERS = ("listen", "listen", "listen", "talk", "talk", "talk", "talk", "slow", "slow", "deaf")
_LEAVES = ("politely", "reset", "killed", "middle")
_MOST_GUESTS = 3
_STAY_S, _DEAF_S = 8.0, 75.0
_NODE_LEAVES = ("politely", "interrupted", "killed")
_MOST_NODE_STAY_S = 60.0
#: So long the recorder does nothing at the beginning, so that its queue has been as long as it gets.
_RECORDER_RESTS_S = 2.0

Sample = dict[str, Any]


# -- what is sent ----------------------------------------------------------------------------------------------------


def _scan(width: int, height: int) -> payloads.Payload:
    """A picture of rings, as an ultrasonic phantom shows them: of the size of noise, but it compresses."""
    y, x = np.mgrid[:height, :width]
    rings = (np.hypot(x - width / 2, y) // 24 * 16).astype(np.uint8)
    data = np.repeat(rings.ravel(), 3).tobytes()
    return replace(
        payloads.image(width, height),
        ros=lambda header: rosmsg.Image(header, height, width, "rgb8", 0, 3 * width, data),
        content=lambda _number: Image((width, height, 1), 3, data, 3),
    )


def _grid(count: int) -> payloads.Payload:
    """A cloud of the same six hundred points, again and again."""
    index = np.arange(count) % 600
    xyz = np.column_stack([index % 30, index // 30, np.full(count, 500)]).astype(np.float64)
    fields = tuple(rosmsg.PointField(name, 4 * axis, 7, 1) for axis, name in enumerate("xyz"))
    data = (xyz / 1000).astype("<f4").tobytes()
    vertices = Cells(1, np.array([count, *range(count)], ">u4"))
    return replace(
        payloads.cloud(count),
        ros=lambda header: rosmsg.PointCloud2(header, 1, count, fields, False, 12, len(data), data, True),
        content=lambda _number: PolyData(xyz.astype(">f4"), vertices),
    )


def know_payloads() -> None:
    """Have the programs of the measurement know them, too; in this process."""
    cases.PAYLOADS |= {_PICTURE: partial(_scan, 640, 480), _CLOUD: partial(_grid, 30_000)}


def streams(scale: float) -> tuple[Stream, ...]:
    """The mixed load, at ``scale`` times its rates."""
    kinds = {"image-vga": _PICTURE, "cloud-30k": _CLOUD}
    return tuple(
        replace(stream, kind=kinds.get(stream.kind, stream.kind), rate_hz=scale * stream.rate_hz)
        for stream in CASES["mixed"].streams
    )


# -- settings and what is found --------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Settings:
    """See the command line."""

    seconds: float
    seed: int
    folder: Path
    scale: float
    part_s: float
    sample_s: float
    guest_s: float
    growth_mb: float
    disk_gb: float
    keep: bool

    @property
    def warm_s(self) -> float:
        """What is before does not count for the line: a third, five minutes at most."""
        return min(self.seconds / 3, 300.0)

    @property
    def most_stay_s(self) -> float:
        """How long a guest stays at most; in a short run not so long that queues grow beyond those of its beginning."""
        return min(self.seconds / 8, 30.0)


@dataclass
class Found:
    """What a soak brought to light, filled as it goes on."""

    samples: list[Sample] = field(default_factory=list)
    baseline: Sample = field(default_factory=dict)
    end: Sample = field(default_factory=dict)
    guests: Counter[str] = field(default_factory=Counter)
    parts: list[dict[str, Any]] = field(default_factory=list)
    notes: Counter[str] = field(default_factory=Counter)
    passages: list[dict[str, Any]] = field(default_factory=list)
    stopped: Event = field(default_factory=dict)
    failures: list[str] = field(default_factory=list)


@dataclass(frozen=True, slots=True)
class Check:
    """One thing that is judged."""

    name: str
    good: bool
    text: str


def say(text: str) -> None:
    print(f"{time.strftime('%H:%M:%S', time.gmtime())} {text}", flush=True)


class Deck:
    """Draws from what there is by chance, but everything before anything comes again."""

    def __init__(self, rng: Random, cards: Sequence[str]) -> None:
        self._rng, self._cards = rng, cards
        self._left: list[str] = []

    def draw(self) -> str:
        if not self._left:
            self._left = self._rng.sample(self._cards, len(self._cards))
        return self._left.pop()


# -- guests ----------------------------------------------------------------------------------------------------------


class Guests:
    """Brings them in, and out, until closed."""

    def __init__(self, port: int, settings: Settings, found: Found) -> None:
        self._port, self._settings, self._found = port, settings, found
        self._rng = Random(settings.seed)
        self._manners, self._leaves = Deck(self._rng, MANNERS), Deck(self._rng, _LEAVES)
        self._node_leaves = Deck(self._rng, _NODE_LEAVES)
        self._over = threading.Event()
        self._here: list[tuple[subprocess.Popen[bytes], float]] = []  # and when it is killed
        self._node: subprocess.Popen[bytes] | None = None
        self._node_until = 0.0
        self._shared: set[str] = set()
        self.many = 0
        made = payload("transform").igtl_maker("Guest"), payload(_PICTURE).igtl_maker("Guest")
        for name, make in zip(("small", "picture"), made, strict=True):
            (settings.folder / name).write_bytes(bytes(make(1)))
        self._thread = threading.Thread(target=self._run, name="guests")
        self._thread.start()

    def close(self) -> None:
        """All leave."""
        self._over.set()
        self._thread.join()

    def tidy(self) -> None:
        """Remove the shared memory of nodes that were killed, which nobody else has."""
        names = self._shared | {f"{name}_el" for name in self._shared}
        for maps in Path("/proc").glob("[0-9]*/maps"):
            try:
                names -= set(_shared(maps))
            except OSError:
                continue  # it has gone
        for name in names:
            Path(name).unlink(missing_ok=True)

    def _run(self) -> None:
        try:
            # The worst at once and at first: what memory it takes stays with the process, and is no growth later.
            for _ in range(_MOST_GUESTS):
                self._come("deaf", "politely", min(0.6 * self._settings.warm_s, _DEAF_S))
            due = time.monotonic()
            while not self._over.wait(0.1):
                now = time.monotonic()
                self._look(now)
                if now >= due:
                    due = now + self._rng.expovariate(1 / self._settings.guest_s)
                    stay = min(self._rng.expovariate(1 / _STAY_S), self._settings.most_stay_s)
                    if len(self._here) < _MOST_GUESTS:
                        self._come(self._manners.draw(), self._leaves.draw(), stay)
        finally:
            for process, _ in self._here:
                process.kill()
                process.wait()
            self._here.clear()
            if self._node:
                self._node_goes(self._node, "politely")
            self.many = 0

    def _come(self, manner: str, leave: str, stay: float) -> None:
        self._found.guests[f"{manner}, {leave}"] += 1
        words = [str(self._port), str(self._settings.folder), str(self._rng.getrandbits(32)), manner, leave, f"{stay}"]
        process = subprocess.Popen([sys.executable, "-I", "-S", str(GUEST), "igtl", *words])
        self._here.append((process, time.monotonic() + stay if leave == "killed" else float("inf")))

    def _look(self, now: float) -> None:
        """Kill whose time has come, forget who has gone; the same for the node."""
        for process, until in self._here:
            if now >= until:
                process.kill()
        self._here = [(process, until) for process, until in self._here if process.poll() is None]
        self.many = len(self._here)
        if self._node and (now >= self._node_until or self._node.poll() is not None):
            self._node_goes(self._node, self._node_leaves.draw())
        elif not self._node:
            self._node_until = now + self._rng.uniform(0.2, 1) * min(_MOST_NODE_STAY_S, self._settings.seconds / 3)
            words = ["ros", str(self._rng.getrandbits(31))]
            self._node = subprocess.Popen(
                [sys.executable, str(GUEST), *words], stdin=subprocess.PIPE, stderr=subprocess.DEVNULL
            )

    def _node_goes(self, node: subprocess.Popen[bytes], leave: str) -> None:
        self._found.guests[f"ROS node, {leave}"] += 1
        try:
            self._shared |= set(_shared(Path(f"/proc/{node.pid}/maps")))
        except OSError:
            pass  # it has gone before
        assert node.stdin
        match leave:
            case "killed":
                node.kill()
            case "interrupted":
                node.send_signal(signal.SIGINT)
        node.stdin.close()
        try:
            node.wait(20)
        except subprocess.TimeoutExpired:
            self._found.failures.append(f"the ROS node did not leave ({leave})")
            node.kill()
            node.wait()
        self._node = None


def _shared(maps: Path) -> Iterator[str]:
    """Files of shared memory that a process has."""
    for line in maps.read_text("utf-8", "replace").splitlines():
        name = line.rpartition(" ")[2]
        if name.startswith("/dev/shm/"):
            yield name


# -- parts of the recording ------------------------------------------------------------------------------------------


class Verifier:
    """Verifies parts as they are completed, one after the other, and deletes those that are as they should be."""

    def __init__(self, folder: Path, settings: Settings, found: Found) -> None:
        self._folder, self._settings, self._found = folder, settings, found
        self._over = threading.Event()
        self._lock = threading.Lock()
        self._next = 0
        self._threads: list[threading.Thread] = []
        self._begin()

    def close(self) -> None:
        """The recording has ended: verify what is left, two at a time, as there is nothing else to do."""
        self._over.set()
        self._begin()
        for thread in self._threads:
            thread.join()

    def _begin(self) -> None:
        thread = threading.Thread(target=self._run, name="verifier")
        self._threads.append(thread)
        thread.start()

    def _run(self) -> None:
        while True:
            over = self._over.is_set()
            if path := self._due(over):
                self._verify(path)
            elif over:
                return
            else:
                self._over.wait(0.5)

    def _due(self, over: bool) -> Path | None:
        """The next part, if it is complete."""
        with self._lock:
            this, following = (self._folder / f"{self._folder.name}_{self._next + more}.mcap" for more in (0, 1))
            if not (following.exists() or (over and this.exists())):
                return None
            self._next += 1
            return this

    def _verify(self, path: Path) -> None:
        size = path.stat().st_size
        begun = time.monotonic()
        command = ["nice", "-n", "5", *ours("verify", str(path), "--json")]
        done = subprocess.run(command, capture_output=True, text=True, timeout=_VERIFY_S, check=False)
        part: dict[str, Any] = {
            "part": path.name,
            "bytes": size,
            "seconds": round(time.monotonic() - begun, 1),
            "code": done.returncode,
        }
        try:
            part |= {name: value for name, value in json.loads(done.stdout).items() if name not in ("file", "config")}
            part["differences"] = part["differences"][:20]
        except ValueError:
            part |= {"good": False, "error": done.stderr[-2000:]}
        self._found.parts.append(part)
        if not part["good"] or done.returncode:
            say(f"{path.name} DOES NOT VERIFY: {json.dumps(part)[:2000]}")
        elif not self._settings.keep:
            path.unlink()


# -- samples ---------------------------------------------------------------------------------------------------------


def _process(pid: int) -> Sample:
    """Memory in MB, threads, descriptors and CPU time of a process."""
    root = Path(f"/proc/{pid}")
    status = dict(line.split(":", 1) for line in (root / "status").read_text("ascii", "replace").splitlines())
    cpu = (root / "stat").read_text("ascii", "replace").rpartition(")")[2].split()
    return {
        **{
            word: round(float(status[name].split()[0]) * 1024 / _MB, 2)
            for word, name in (("rss_mb", "VmRSS"), ("anon_mb", "RssAnon"), ("shared_mb", "RssShmem"))
        },
        "threads": int(status["Threads"]),
        "fds": len(os.listdir(root / "fd")),
        "cpu_s": (int(cpu[11]) + int(cpu[12])) / os.sysconf("SC_CLK_TCK"),
    }


def _children(pid: int) -> list[int]:
    found: list[int] = []
    for task in Path(f"/proc/{pid}/task").iterdir():
        try:
            found += map(int, (task / "children").read_text("ascii").split())
        except OSError:
            continue  # a thread that has ended
    return found


def take(pid: int, url: str) -> Sample:
    """How the bridge is now; its recorder's process is the largest of its children."""
    with urllib.request.urlopen(url.removesuffix("/metrics") + "/status", timeout=30) as answer:
        facts = json.load(answer)
    others = [_process(child) for child in _children(pid)]
    queues = facts["queues"].values()
    recorder = facts["recorder"]
    return {
        "gateway": _process(pid),
        "recorder": max(others, key=lambda one: one["rss_mb"]),
        "processes": 1 + len(others),
        "peers": sum(peer["connected"] for peer in facts["peers"]),
        "queued_messages": sum(queue["messages"] for queue in queues),
        "queued_mb": round(sum(queue["bytes"] for queue in queues) / _MB, 2),
        "recorder_queued_mb": round(recorder["queued_bytes"] / _MB, 2),
        "recorder_dropped": recorder["dropped_entries"],
        "entries": facts["entries"],
        "load": os.getloadavg()[0],
    }


# -- the run ---------------------------------------------------------------------------------------------------------


def _parts(settings: Settings, direction: Direction) -> tuple[Part, ...]:
    return tuple(Part(stream, direction, stream.topic(direction)) for stream in streams(settings.scale))


def _program(stack: ExitStack, job: Job) -> Program:
    command = [sys.executable, str(Path(__file__).resolve()), "--program", job.to_json()]
    return stack.enter_context(Program(f"{job.side} {job.name}", command))


@contextmanager
def _closing(thing: Any) -> Iterator[Any]:
    try:
        yield thing
    finally:
        thing.close()


def soak(settings: Settings) -> Found:
    """Run it.  Raises BenchError when a steady program, or the bridge, did not do its part."""
    found = Found()
    recording = settings.folder / "soak.mcap"
    words = ["bridge", "--json", "--listen", "127.0.0.1:0", "--metrics", "0", "--record", str(recording), "--overwrite"]
    words += ["--split-duration", str(settings.part_s), "--duration", str(2 * settings.seconds + 600)]
    for stream in streams(settings.scale):
        topic, device = (way(Direction.ROS_TO_IGTL) for way in (stream.topic, stream.device))
        words += ["--send", f"{topic}={device}:{payload(stream.kind).igtl_type}"]
    out, back = (_parts(settings, direction) for direction in Direction)
    with ExitStack() as stack:
        bridge = stack.enter_context(Program("gateway", ours(*words)))
        job = partial(Job, seconds=settings.seconds)
        sender = job("ros", "soak_sender", out, (), times=str(settings.folder / "sender.npz"))
        listener = job("ros", "soak_listener", (), back, times=str(settings.folder / "listener.npz"))
        nodes = [(one, _program(stack, one)) for one in (sender, listener)]
        started = bridge.wait_for("started", _START_S)
        place, url = started["listen"][0], started["metrics"]
        client = job(
            "igtl",
            "client",
            back,
            out,
            times=str(settings.folder / "client.npz"),
            address=(place["host"], place["port"]),
        )
        steady = [*nodes, (client, _program(stack, client))]
        verifier = stack.enter_context(_closing(Verifier(recording.with_suffix(""), settings, found)))
        _meet(steady)
        for one, program in steady:
            if one.sends:
                program.order("begin")
        begun = time.monotonic()
        rest = threading.Event()
        rest.wait(min(5.0, settings.seconds / 10))
        found.baseline = take(bridge.pid, url) | {"at_s": round(time.monotonic() - begun, 2)}
        _rest_recorder(bridge, rest)
        guests = stack.enter_context(_closing(Guests(place["port"], settings, found)))
        _watch(settings, found, bridge, url, begun, guests, steady, rest)
        guests.close()
        sent = {one.name: program.wait_for("sent", 120)["messages"] for one, program in steady if one.sends}
        say(f"sent {sent}; guests have left")
        found.end = _calm(found, bridge, url, begun, rest)
        for _, program in steady:
            program.end()
        found.passages = _passages(settings, steady)
        bridge.interrupt(120)
        found.stopped = bridge.wait_for("stopped", 60, lambda event: _note(found, event))
        say("the bridge has stopped; verifying what is left")
        guests.tidy()
        verifier.close()
    return found


def _meet(steady: Sequence[tuple[Job, Program]]) -> None:
    """Wait until every steady listener has heard every stream."""
    for _, program in steady:
        program.wait_for("ready", _START_S)
    for one, program in steady:
        if one.sends:
            program.order("knock")
    for one, program in steady:
        missing = {part.key for part in one.hears}
        while missing:
            missing.discard(program.wait_for("heard", _HEARD_S)["key"])


def _rest_recorder(bridge: Program, rest: threading.Event) -> None:
    """Stop the recorder's process for a while."""
    child = max(_children(bridge.pid), key=lambda pid: _process(pid)["rss_mb"])
    os.kill(child, signal.SIGSTOP)
    try:
        rest.wait(_RECORDER_RESTS_S)
    finally:
        os.kill(child, signal.SIGCONT)


def _watch(
    settings: Settings,
    found: Found,
    bridge: Program,
    url: str,
    begun: float,
    guests: Guests,
    steady: Sequence[tuple[Job, Program]],
    rest: threading.Event,
) -> None:
    """Take samples until the time is over."""
    told = 0.0
    with (settings.folder / "samples.jsonl").open("w", encoding="ascii") as file:
        while (at := time.monotonic() - begun) < settings.seconds:
            bridge.check()
            for _, program in steady:
                program.check()
            sample = {"at_s": round(at, 2), "guests": guests.many} | take(bridge.pid, url)
            found.samples.append(sample)
            file.write(json.dumps(sample) + "\n")
            file.flush()
            used = sum(path.stat().st_size for path in settings.folder.rglob("*.mcap"))
            free = shutil.disk_usage(settings.folder).free
            if used > settings.disk_gb * 1e9 or free < 10e9:
                raise BenchError(f"the recording has {used / 1e9:.1f} GB, {free / 1e9:.1f} GB are free: no room")
            if at >= told:
                told += settings.seconds / 60
                say(_line(sample, found, used))
            rest.wait(max(0.0, begun + at + settings.sample_s - time.monotonic()))


def _line(sample: Sample, found: Found, used: int) -> str:
    gateway, recorder = sample["gateway"], sample["recorder"]
    return (
        f"{sample['at_s']:6.0f} s  RSS {gateway['rss_mb']:.0f} + {recorder['rss_mb']:.0f} MB  threads "
        f"{gateway['threads']} + {recorder['threads']}  fds {gateway['fds']} + {recorder['fds']}  peers "
        f"{sample['peers']}  queued {sample['queued_mb']:.0f} + {sample['recorder_queued_mb']:.0f} MB  not recorded "
        f"{sample['recorder_dropped']}  guests so far {sum(found.guests.values())}  parts verified "
        f"{len(found.parts)}, {used / 1e9:.2f} GB there  load {sample['load']:.1f}"
    )


_BACK = ("threads", "fds")
#: The workers of rclpy's executor, each of which is started when it is first needed, and then stays.
WORKERS = 8
_PROCESSES = ("gateway", "recorder")
_MEMORY = {"rss_mb": "memory (RSS)", "anon_mb": "memory of its own", "shared_mb": "memory shared with others"}


def _calm(found: Found, bridge: Program, url: str, begun: float, rest: threading.Event) -> Sample:
    """Wait until threads and descriptors are what they were before the first guest, and queues empty."""
    deadline = time.monotonic() + _CALM_S
    while True:
        sample = take(bridge.pid, url) | {"at_s": round(time.monotonic() - begun, 2)}
        if _returned(found.baseline, sample) or time.monotonic() > deadline:
            return sample
        rest.wait(1.0)


def _returned(before: Sample, after: Sample) -> bool:
    return not after["queued_messages"] and all(
        after[who][what] <= before[who][what] + _spare(who, what) for who in _PROCESSES for what in _BACK
    )


def _spare(who: str, what: str) -> int:
    """How much more there may be than before the first guest."""
    return WORKERS if (who, what) == ("gateway", "threads") else 0


def _note(found: Found, event: Event) -> None:
    if "code" in event:
        found.notes[f"{event['level']} {event['code']}"] += 1


def _passages(settings: Settings, steady: Sequence[tuple[Job, Program]]) -> list[dict[str, Any]]:
    """Of each kind of message and direction: what was sent, what arrived, and how long it was on its way."""
    columns: dict[str, Any] = {}
    for one, _ in steady:
        with np.load(one.times, allow_pickle=False) as file:
            columns |= {name: file[name] for name in file.files}
    rows = []
    for direction in Direction:
        for kind in dict.fromkeys(stream.kind for stream in streams(settings.scale)):
            devices = [stream.device(direction) for stream in streams(settings.scale) if stream.kind == kind]
            passages = [
                Passage(columns[f"sent {device}"], columns[f"numbers {device}"], columns[f"received {device}"])
                for device in devices
            ]
            rows.append({"stream": kind, "direction": direction.value} | latency(passages))
    return rows


# -- the judgement ---------------------------------------------------------------------------------------------------


def trend(at_s: Sequence[float], values: Sequence[float], windows: int = 50) -> float:
    """How much a robust line grows from the first to the last time.

    The line goes through the least value of each of so many windows of time (a queue that is filled for a while, and
    emptied again, is no growth), by Theil and Sen: its slope is the median of the slopes between all pairs.
    """
    times, found = np.asarray(at_s, float), np.asarray(values, float)
    edges = np.linspace(times[0], times[-1], windows + 1)
    number = np.clip(np.searchsorted(edges, times, "right") - 1, 0, windows - 1)
    least = [np.flatnonzero(number == one)[np.argmin(found[number == one])] for one in np.unique(number)]
    x, y = times[least], found[least]
    first, second = np.triu_indices(len(least), 1)
    if not len(first):
        raise ValueError(f"found {len(values)} samples, expected some more for a line")
    slope = float(np.median((y[second] - y[first]) / (x[second] - x[first])))
    return slope * float(times[-1] - times[0])


def judge(settings: Settings, found: Found) -> list[Check]:
    """Everything that has to be so."""
    checks = []

    def check(name: str, good: bool, text: str) -> None:
        checks.append(Check(name, bool(good), text))

    counted = [sample for sample in found.samples if sample["at_s"] >= settings.warm_s]
    at_s = [sample["at_s"] for sample in counted]
    for who in _PROCESSES:
        for what in ("rss_mb", "anon_mb", "shared_mb"):
            memory = [sample[who][what] for sample in counted]
            growth = trend(at_s, memory)
            check(
                f"{_MEMORY[what]} of the {who} is flat",
                growth <= settings.growth_mb,
                f"the line grows by {growth:+.1f} MB in {at_s[-1] - at_s[0]:.0f} s (at most {settings.growth_mb:g}), "
                f"between {min(memory):.0f} and {max(memory):.0f} MB",
            )
        for what in _BACK:
            before, after, spare = found.baseline[who][what], found.end[who][what], _spare(who, what)
            most = max(sample[who][what] for sample in found.samples)
            line = trend(at_s, [sample[who][what] for sample in counted])
            check(
                f"{what} of the {who} are flat, and return",
                after <= before + spare and line < 1 + spare,
                f"{before} before the first guest, at most {most}, {after} when all had left; the line grows by "
                f"{line:+.2f}" + (f"; {spare} of them are started when first needed" if spare else ""),
            )
    told = found.stopped["ledger"]
    open_ends = [*gaps(told), *told.get("gaps", ())]
    check("the ledger closes", not open_ends, "; ".join(open_ends) or "by stream, by peer and in sum")
    recorded, entries = found.stopped["recording"], sum(found.stopped["counts"].values())
    check(
        "the recording is complete",
        not recorded["failure"] and not recorded["dropped"] and recorded["entries"] == entries,
        f"{recorded['entries']:,} of {entries:,} entries, {recorded['dropped']:,} lost by the recorder"
        + (f": {recorded['failure']}" if recorded["failure"] else ""),
    )
    good = [part for part in found.parts if part["good"] and not part["code"]]
    verified = sum(part["inputs"] + part["outputs"] for part in good)
    numbers = {what: sum(part[what] for part in good) for what in ("equal", "lost", "missing", "orphans", "late")}
    files = sum(1 for path in recorded["files"] if str(path).endswith(".mcap"))
    check(
        "the recording verifies",
        len(good) == len(found.parts) == files and verified == recorded["entries"],
        f"{len(good)} of {files} parts, {verified:,} entries; outputs equal {numbers.pop('equal'):,}, {numbers}",
    )
    arrived = [row["delivered"] for row in found.passages]
    check(
        "every stream arrives to the end",
        all(arrived),
        ", ".join(f"{row['stream']} {row['direction']} {row['delivered']:,}/{row['sent']:,}" for row in found.passages),
    )
    manners = {name.split(",")[0] for name in found.guests}
    expected = {*MANNERS, "ROS node"}
    check("guests of all manners came", manners >= expected, f"{sum(found.guests.values()):,} guests")
    check("nothing else failed", not found.failures, "; ".join(found.failures) or "nothing")
    return checks


# -- reports ---------------------------------------------------------------------------------------------------------


def report(settings: Settings, found: Found, checks: Sequence[Check]) -> dict[str, Any]:
    """All of it, for programs."""
    streams_told = found.stopped["ledger"].get("streams", {})
    dropped: Counter[str] = Counter()
    for direction, books in streams_told.items():
        for fates in books.values():
            for reason, number in fates.get("dropped", {}).items():
                dropped[f"{direction} {reason}"] += number
    return {
        "good": all(check.good for check in checks),
        "settings": {name: str(value) if name == "folder" else value for name, value in asdict(settings).items()},
        "checks": [asdict(check) for check in checks],
        "passages": found.passages,
        "guests": dict(sorted(found.guests.items())),
        "notes": dict(sorted(found.notes.items())),
        "dropped": dict(sorted(dropped.items())),
        "counts": found.stopped["counts"],
        "recording": {name: value for name, value in found.stopped["recording"].items() if name != "files"},
        "parts": found.parts,
        "baseline": found.baseline,
        "end": found.end,
        "samples": found.samples,
        "ledger": found.stopped["ledger"],
    }


_PANELS: tuple[tuple[str, str, Callable[[Sample], float]], ...] = (
    ("RSS of the gateway, MB", "#1f77b4", lambda sample: float(sample["gateway"]["rss_mb"])),
    ("of this its own, MB", "#1f77b4", lambda sample: float(sample["gateway"]["anon_mb"])),
    ("RSS of the recorder, MB", "#2ca02c", lambda sample: float(sample["recorder"]["rss_mb"])),
    ("threads of the gateway", "#d62728", lambda sample: float(sample["gateway"]["threads"])),
    ("file descriptors of the gateway", "#9467bd", lambda sample: float(sample["gateway"]["fds"])),
    ("waiting in queues to peers, MB", "#8c564b", lambda sample: float(sample["queued_mb"])),
    ("waiting in the recorder's queue, MB", "#7f7f7f", lambda sample: float(sample["recorder_queued_mb"])),
)
_WIDTH, _LEFT, _RIGHT, _PANEL, _GAP, _TOP = 860, 60, 30, 70, 28, 48
_POINTS = 400


def picture(samples: Sequence[Sample], seconds: float, title: str) -> str:
    """One panel for each figure, over time in minutes; of samples that fall together the least and the largest."""
    height = _TOP + len(_PANELS) * (_PANEL + _GAP) + 16
    lines = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {_WIDTH} {height}" font-family="sans-serif" '
        'font-size="11">',
        f'<rect width="{_WIDTH}" height="{height}" fill="white"/>',
        f'<text x="10" y="18" font-size="14">{title}</text>',
    ]
    for index, (name, colour, of) in enumerate(_PANELS):
        top = _TOP + index * (_PANEL + _GAP)
        bottom, values = top + _PANEL, [of(sample) for sample in samples]
        most = max(*values, 1.0) * 1.05

        def x(sample: Sample) -> float:
            return _LEFT + float(sample["at_s"]) / seconds * (_WIDTH - _LEFT - _RIGHT)

        def y(value: float, bottom: float = bottom, most: float = most) -> float:
            return bottom - value / most * _PANEL

        lines.append(f'<path d="M{_LEFT} {top} V{bottom} H{_WIDTH - _RIGHT}" stroke="#888888" fill="none"/>')
        lines.append(f'<text x="{_LEFT}" y="{top - 5}">{name}: {min(values):g} to {max(values):g}</text>')
        lines.append(f'<text x="{_LEFT - 6}" y="{y(max(values)) + 4:.0f}" text-anchor="end">{max(values):.0f}</text>')
        lines.append(f'<text x="{_LEFT - 6}" y="{bottom + 4}" text-anchor="end">0</text>')
        step = max(1, 2 * len(samples) // _POINTS)
        points = []
        for begin in range(0, len(samples), step):
            few = values[begin : begin + step]
            points += [f"{x(samples[begin]):.1f} {y(value):.1f}" for value in dict.fromkeys((min(few), max(few)))]
        lines.append(f'<path d="M{" L".join(points)}" stroke="{colour}" fill="none"/>')
    for part in range(7):
        at = _LEFT + part / 6 * (_WIDTH - _LEFT - _RIGHT)
        lines.append(
            f'<text x="{at:.0f}" y="{height - 8}" text-anchor="middle">{part / 6 * seconds / 60:.3g} min</text>'
        )
    return "\n".join([*lines, "</svg>"]) + "\n"


def words(told: dict[str, Any]) -> list[str]:
    """The same for people."""
    lines = [f"{'ok  ' if check['good'] else 'BAD '} {check['name']}: {check['text']}" for check in told["checks"]]
    lines.append("stream        direction     sent       arrived    p50 ms    p99 ms")
    for row in told["passages"]:
        lines.append(
            f"{row['stream']:<13} {row['direction']:<12} {row['sent']:>10,} {row['delivered']:>10,} "
            f"{row['p50_ms'] or 0:9.2f} {row['p99_ms'] or 0:9.1f}"
        )
    for name in ("guests", "notes", "dropped", "counts", "recording"):
        lines.append(f"{name}: {', '.join(f'{key} {value}' for key, value in told[name].items()) or 'none'}")
    return lines


def main(arguments: Sequence[str]) -> int:
    know_payloads()
    if arguments and arguments[0] == "--program":
        return programs.main(arguments[1:])
    parser = argparse.ArgumentParser(description="A bridge that records, for long, while peers come and go.")
    parser.add_argument("--seconds", type=float, default=60.0, help="how long (%(default)g)")
    parser.add_argument("--seed", type=int, default=1, help="of the guests (%(default)s)")
    parser.add_argument("--folder", type=Path, required=True, help="for the recording, samples and reports; may exist")
    parser.add_argument("--scale", type=float, default=1.0, help="times the rates of the mixed load (%(default)g)")
    parser.add_argument("--part-s", type=float, help="seconds of each part of the recording (a sixtieth, at least 5)")
    parser.add_argument("--sample-s", type=float, help="seconds between samples (one or five)")
    parser.add_argument(
        "--guest-s", type=float, default=4.0, help="a guest comes so often, on the average (%(default)g)"
    )
    parser.add_argument("--growth-mb", type=float, default=20.0, help="what flat may grow by (%(default)g)")
    parser.add_argument("--disk-gb", type=float, default=35.0, help="at most so large (%(default)g)")
    parser.add_argument("--keep", action="store_true", help="keep the parts that verify")
    options = parser.parse_args(arguments)
    long = options.seconds >= 600
    settings = Settings(
        options.seconds,
        options.seed,
        options.folder,
        options.scale,
        options.part_s or max(5.0, options.seconds / 60),
        options.sample_s or (5.0 if long else 1.0),
        options.guest_s,
        options.growth_mb,
        options.disk_gb,
        options.keep,
    )
    settings.folder.mkdir(parents=True, exist_ok=True)
    # neither hear nor disturb other robots
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    os.environ.setdefault("ROS_DOMAIN_ID", str(os.getpid() % 100 + 1))
    try:
        found = soak(settings)
    except BenchError as error:
        say(f"BAD  {error}")
        return 1
    told = report(settings, found, judge(settings, found))
    (settings.folder / "soak.json").write_text(json.dumps(told, indent=1, default=str), "utf-8")
    title = f"Soak of {settings.seconds / 60:g} min at {settings.scale:g} times the mixed load, seed {settings.seed}"
    (settings.folder / "soak.svg").write_text(picture(found.samples, settings.seconds, title), "utf-8")
    text = "\n".join(words(told))
    (settings.folder / "soak.txt").write_text(text + "\n", "utf-8")
    print(text, flush=True)
    return 0 if told["good"] else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
