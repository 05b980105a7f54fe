"""Soak test: a recording bridge under the mixed load, while peers connect and disconnect.

    python -m tools.evidence.soak --seconds 3600 --folder /tmp/soak

Strategy: the programs of ``igtl-gateway bench`` are the permanent peers: a node that sends, a node that receives, and a
client that does both; every message has a number, so losses are detected end to end.  Meanwhile short-lived peers
(``soak_guest.py``) connect at random times.  They read, send, read slowly or not at all, and disconnect in an orderly
way, with RST, inside a message or by SIGKILL; the seed determines all of it.  A further ROS node creates and removes
endpoints, and is stopped and killed itself.  Every few seconds the test reads memory, threads and file descriptors of
the bridge and of its recorder, and queues and counts from ``--metrics``.  The recording is split; each complete part is
verified, and deleted if it verifies.

At the end the short-lived peers disconnect, threads and descriptors must return to their initial numbers, the
bridge is interrupted, and the checks run: see ``judge``.  The exit code is 1 if a check fails.  Ctrl-C ends the test
early, and the checks run as well.

Images and clouds have the sizes of the mixed load, but compressible content: otherwise two thirds of the 460 GB of an
hour would be noise.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import signal
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from igtl_gateway_lab.bench import programs
from igtl_gateway_lab.bench.cases import Direction, payload
from igtl_gateway_lab.bench.figures import Transmission, latency
from igtl_gateway_lab.bench.jobs import Job, JobStream
from igtl_gateway_lab.bench.processes import BenchError, Program
from igtl_gateway_lab.programs import Event, ours
from tools.evidence.soak_findings import Found, Sample, Settings, say
from tools.evidence.soak_guests import Guests
from tools.evidence.soak_judge import BACK, PROCESSES, judge, picture, report, spare, words
from tools.evidence.soak_load import know_payloads, streams
from tools.evidence.soak_watch import Verifier, children, process, take

_START_S, _HEARD_S, _CALM_S = 180.0, 60.0, 90.0
#: So long the recorder does nothing at the beginning, so that its queue has been as long as it gets.
_RECORDER_RESTS_S = 2.0
_LOOKS = 4


def _parts(settings: Settings, direction: Direction) -> tuple[JobStream, ...]:
    return tuple(JobStream(stream, direction, stream.topic(direction)) for stream in streams(settings.scale))


def _program(stack: ExitStack, job: Job) -> Program:
    command = [sys.executable, "-m", "tools.evidence.soak", "--program", job.to_json()]
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
        found.baseline = _baseline(bridge, url, rest) | {"at_s": round(time.monotonic() - begun, 2)}
        _rest_recorder(bridge, rest)
        guests = stack.enter_context(_closing(Guests(place["port"], settings, found)))
        try:
            _watch(settings, found, bridge, url, begun, guests, steady, rest)
            guests.close()
            sent = {one.name: program.wait_for("sent", 120)["messages"] for one, program in steady if one.sends}
            say(f"sent {sent}; short-lived peers have disconnected")
        except KeyboardInterrupt:
            say("interrupted: the checks use the data so far")
            guests.close()
        found.end = _calm(found, bridge, url, begun, rest)
        for _, program in steady:
            program.end()
        found.passages = _passages(settings, steady)
        bridge.interrupt_and_wait(120)
        found.stopped = bridge.wait_for("stopped", 60, lambda event: _note(found, event))
        say("the bridge has stopped; verifying what is left")
        verifier.close()
    return found


def _meet(steady: Sequence[tuple[Job, Program]]) -> None:
    """Wait until every permanent receiver has received every stream."""
    for _, program in steady:
        program.wait_for("ready", _START_S)
    for one, program in steady:
        if one.sends:
            program.order("knock")
    for one, program in steady:
        missing = {part.key for part in one.hears}
        while missing:
            missing.discard(program.wait_for("heard", _HEARD_S)["key"])


def _baseline(bridge: Program, url: str, rest: threading.Event) -> Sample:
    """The state before the first short-lived peer: the maximum of a few samples, because between two parts the recorder
    has a file less."""
    looks = []
    for _ in range(_LOOKS):
        looks.append(take(bridge.pid, url))
        rest.wait(0.2)
    most = {who: looks[-1][who] | {what: max(look[who][what] for look in looks) for what in BACK} for who in PROCESSES}
    return looks[-1] | most


def _rest_recorder(bridge: Program, rest: threading.Event) -> None:
    """Stop the recorder's process for a while."""
    child = max(children(bridge.pid), key=lambda pid: process(pid)["rss_mb"])
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
        f"{sample['recorder_dropped']}  short-lived peers so far {sum(found.guests.values())}  parts verified "
        f"{len(found.parts)}, {used / 1e9:.2f} GB on disk  load {sample['load']:.1f}"
    )


def _calm(found: Found, bridge: Program, url: str, begun: float, rest: threading.Event) -> Sample:
    """Wait until threads and descriptors have their initial numbers, and queues are empty."""
    deadline = time.monotonic() + _CALM_S
    while True:
        sample = take(bridge.pid, url) | {"at_s": round(time.monotonic() - begun, 2)}
        if _returned(found.baseline, sample) or time.monotonic() > deadline:
            return sample
        rest.wait(1.0)


def _returned(before: Sample, after: Sample) -> bool:
    return not after["queued_messages"] and all(
        after[who][what] <= before[who][what] + spare(who, what) for who in PROCESSES for what in BACK
    )


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
                Transmission(columns[f"sent {device}"], columns[f"numbers {device}"], columns[f"received {device}"])
                for device in devices
            ]
            last = min(float(one.numbers.max(initial=0)) / max(1, len(one.sent)) for one in passages)
            rows.append({"stream": kind, "direction": direction.value, "last": round(last, 4)} | latency(passages))
    return rows


def main(arguments: Sequence[str]) -> int:
    know_payloads()
    if arguments and arguments[0] == "--program":
        return programs.main(arguments[1:])
    parser = argparse.ArgumentParser(description="A bridge that records, for long, while peers come and go.")
    parser.add_argument("--seconds", type=float, default=60.0, help="duration (default: %(default)g)")
    parser.add_argument("--seed", type=int, default=1, help="seed of the short-lived peers (default: %(default)s)")
    parser.add_argument("--folder", type=Path, required=True, help="directory for the recording, samples and reports")
    parser.add_argument(
        "--scale", type=float, default=1.0, help="factor for the rates of the mixed load (default: %(default)g)"
    )
    parser.add_argument("--part-s", type=float, help="seconds of each part of the recording (a sixtieth, at least 5)")
    parser.add_argument("--sample-s", type=float, help="seconds between samples (one or five)")
    parser.add_argument(
        "--guest-s", type=float, default=4.0, help="mean interval between short-lived peers (default: %(default)g)"
    )
    parser.add_argument(
        "--growth-mb", type=float, default=20.0, help="accepted growth of memory (default: %(default)g)"
    )
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
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.default_int_handler)  # in the background of a shell, too
    settings.folder.mkdir(parents=True, exist_ok=True)
    # neither receive from other robots nor disturb them
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
