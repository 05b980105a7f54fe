"""A study of many synthetic sessions, and what `cohort` does with it: the figures of docs/how-to/cohort.md.

    python tools/evidence/cohort_study.py make study --count 2000 --stars 24
    python tools/evidence/cohort_study.py judge study --verb lint --work /tmp/judge [--s3 http://127.0.0.1:5000]
    python tools/evidence/cohort_study.py scale study --work /tmp/scale

`make` writes sessions of a few scenarios.  Each ends at a random moment and has metadata of its own; every hundredth is
cut off, every hundredth has an output with a changed byte.  `judge` runs a verb with one worker, with two, and with two
whose programs are killed at random moments, and then once more without kills; the three folders must have equal tables,
and a second run must do nothing.  `scale` prints time and CPU time by the number of workers, and
first how much faster several programs that only compute are on this machine.
With --s3, the sessions are uploaded to that server and read from there (AWS_ACCESS_KEY_ID … as for `cohort`).
"""

from __future__ import annotations

import argparse
import json
import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

from igtl_gateway.addons.cohort.columns import TABLES
from igtl_gateway.addons.cohort.results import Results
from igtl_gateway.base.buffers import join
from igtl_gateway.base.stamp import NS_PER_S
from igtl_gateway.config.configuration import Config
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.record.sessionfile.writer import SessionWriter
from igtl_gateway_lab.simulate.stage import play_offline
from igtl_gateway_lab.simulate.star_planner import SuturePlanner
from igtl_gateway_lab.simulate.star_robot import SutureRobot
from igtl_gateway_lab.simulate.star_sensors import Sensors

FIXTURES = Path(__file__).parent.parent / "fixtures"
SMALL = ("acquisition", "paper-types", "acquisition", "paper-types", "acquisition", "crtk")
SEEDS, STAR_S = 4, 12
#: Columns that differ from run to run.
VOLATILE = {"seconds", "requests", "bytes_read", "mark"}
BUCKET = "study"

Template = tuple[dict[str, str], list[Entry]]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    actions = parser.add_subparsers(dest="action", required=True)
    make_parser = actions.add_parser("make")
    make_parser.add_argument("folder", type=Path)
    make_parser.add_argument("--count", type=int, default=2000)
    make_parser.add_argument("--stars", type=int, default=24, help="of these, STAR sessions with a suture plan")
    make_parser.add_argument("--seed", type=int, default=1)
    judge_parser = actions.add_parser("judge")
    judge_parser.add_argument("folder", type=Path)
    judge_parser.add_argument("--verb", default="lint")
    judge_parser.add_argument("--work", type=Path, required=True, help="new folder for the tables")
    judge_parser.add_argument("--s3", default="", help="endpoint of an object store")
    judge_parser.add_argument("--kills", type=float, default=3.0, help="seconds between two kills")
    scale_parser = actions.add_parser("scale")
    scale_parser.add_argument("folder", type=Path)
    scale_parser.add_argument("--verb", action="append", default=[], help="default: info, lint and verify")
    scale_parser.add_argument("--work", type=Path, required=True, help="new folder for the tables")
    options = parser.parse_args()
    if options.action == "scale":
        scale(options.folder, options.verb or ["info", "lint", "verify"], options.work)
        return 0
    if options.action == "make":
        make(options.folder, options.count, options.stars, options.seed)
        return 0
    return judge(options)


def make(folder: Path, count: int, stars: int, seed: int) -> None:
    """Write ``count`` sessions."""
    folder.mkdir(parents=True)
    chance = random.Random(seed)
    small = [_read(FIXTURES / f"{name}.mcap") for name in SMALL]
    large = [_star(each) for each in range(1, min(SEEDS, stars) + 1)]
    for number in range(count):
        is_star = number < stars
        session, entries = large[number % len(large)] if is_star else small[number % len(small)]
        ends = [index for index, entry in enumerate(entries) if entry.kind.is_input]
        end = chance.choice(ends[-len(ends) // (20 if is_star else 2) :])
        path = folder / f"session-{number:05d}.mcap"
        writer = SessionWriter(path, session | {"custom_data": json.dumps({"number": str(number)})})
        kept = entries[:end]
        if number % 100 == 50:
            kept = _changed(kept)
        for entry in kept:
            writer.write(entry)
        writer.close({})
        if number % 100 == 99:
            os.truncate(path, path.stat().st_size * 2 // 3)


def _read(path: Path) -> Template:
    with SessionFile.open(path) as file:
        return dict(file.session), list(file.entries())


def _star(seed: int) -> Template:
    session, _ = _read(FIXTURES / "star.mcap")
    config = Config.from_dict(json.loads(session["config"]))
    length = STAR_S * NS_PER_S
    actors = (Sensors(length, seed), SutureRobot(length, seed), SuturePlanner(length))
    return session, list(play_offline(actors, config))


def _changed(entries: Sequence[Entry]) -> list[Entry]:
    """The entries with one byte of the last output to ROS changed."""
    number = max(index for index, entry in enumerate(entries) if entry.kind is Kind.ROS_OUT)
    data = bytearray(join(entries[number].payload))
    data[-1] ^= 1
    return [*entries[:number], replace(entries[number], payload=(bytes(data),)), *entries[number + 1 :]]


def judge(options: argparse.Namespace) -> int:
    """Run the verb in three ways and compare; print the figures."""
    options.work.mkdir(parents=True)
    source = str(options.folder)
    if options.s3:
        os.environ |= {"AWS_ENDPOINT_URL": options.s3, "AWS_ALLOW_HTTP": "true"}
        source = upload(options.folder)
    rows = {}
    for name, workers, kills in (("serial", 1, 0.0), ("two", 2, 0.0), ("killed", 2, options.kills)):
        out = options.work / name
        seconds, peak_mib, killed = run(options.verb, source, out, workers, kills)
        tasks = Results(out).read("tasks").to_pylist()
        ends: dict[str, int] = {}
        for task in tasks:
            ends[task["status"]] = ends.get(task["status"], 0) + 1
        asked, read = (sum(task[column] or 0 for task in tasks) for column in ("requests", "bytes_read"))
        print(
            f"{name}: {workers} workers, {seconds:.1f} s, {len(tasks) / seconds:.1f} files/s, {killed} kills, "
            f"largest worker {peak_mib:.0f} MiB, {ends}, {asked} requests, {read / 1e6:.1f} MB",
            flush=True,
        )
        if kills:  # a file whose program was killed three times has no result yet
            again_s, _, _ = run(options.verb, source, out, workers, 0.0)
            print(f"{name}, the rest without kills: {again_s:.1f} s", flush=True)
        rows[name] = tables(out)
    second_s, _, _ = run(options.verb, source, options.work / "serial", 1, 0.0)
    equal = rows["serial"] == rows["two"] == rows["killed"]
    print(f"second run: {second_s:.1f} s; tables equal: {equal}", flush=True)
    return int(not equal)


def scale(folder: Path, verbs: Sequence[str], work: Path) -> None:
    """Print time and CPU time of each verb, by the number of workers up to the cores of this machine."""
    work.mkdir(parents=True)
    cores = len(os.sched_getaffinity(0))
    floor_s = [_only_computing(workers) for workers in range(1, cores + 1)]
    for workers, seconds in enumerate(floor_s, 1):
        print(f"programs that only compute: {workers} at a time, {floor_s[0] / seconds:.2f} times as fast as one")
    for verb in verbs:
        first_s = 0.0
        for workers in range(1, cores + 1):
            command = [sys.executable, "-m", "igtl_gateway", "cohort", verb, str(folder), "--workers", str(workers)]
            start = time.monotonic()
            program = subprocess.Popen(
                [*command, "-o", str(work / f"{verb}-{workers}")],
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
            )
            _, _, used = os.wait4(program.pid, 0)
            seconds = time.monotonic() - start
            first_s = first_s or seconds
            print(
                f"{verb}: {workers} workers, {seconds:.1f} s, {first_s / seconds:.2f} times as fast as one, "
                f"{used.ru_utime + used.ru_stime:.1f} s of CPU; load {os.getloadavg()[0]:.1f}",
                flush=True,
            )


def _only_computing(workers: int) -> float:
    """Return the seconds of 12 programs that only compute, ``workers`` at a time: what the cores give."""
    command = [sys.executable, "-c", "for _ in range(20_000_000): pass"]
    start = time.monotonic()
    with ThreadPoolExecutor(workers) as pool:
        list(pool.map(lambda _: subprocess.run(command, check=True), range(12)))
    return time.monotonic() - start


def upload(folder: Path) -> str:
    """Put the sessions into the bucket.  Returns its URL."""
    import urllib.request

    import obstore
    from obstore.store import from_url

    request = urllib.request.Request(f"{os.environ['AWS_ENDPOINT_URL']}/{BUCKET}", method="PUT")
    urllib.request.urlopen(request).close()
    store = from_url(f"s3://{BUCKET}")
    for path in sorted(folder.glob("*.mcap")):
        obstore.put(store, f"2026/{path.name}", path.read_bytes())
    return f"s3://{BUCKET}/2026"


def run(verb: str, source: str, out: Path, workers: int, kills: float) -> tuple[float, float, int]:
    """Run `cohort`.  Returns its seconds, the largest resident memory of a worker (MiB), and the number of kills."""
    chance = random.Random(7)
    command = [sys.executable, "-m", "igtl_gateway", "cohort", verb, source, "-o", str(out)]
    start = last = time.monotonic()
    program = subprocess.Popen([*command, "--workers", str(workers)], stdout=subprocess.DEVNULL)
    peak_kib, killed, wait = 0, 0, kills
    while program.poll() is None:
        time.sleep(0.1)
        found = list(children(program.pid))
        peak_kib = max([peak_kib, *map(peak, found)])
        if kills and found and time.monotonic() - last > wait:
            os.kill(chance.choice(found), signal.SIGKILL)
            killed, last, wait = killed + 1, time.monotonic(), chance.uniform(0.5, 1.5) * kills
    return time.monotonic() - start, peak_kib / 1024, killed


def children(pid: int) -> Iterator[int]:
    """The programs that do the jobs."""
    for thread in Path(f"/proc/{pid}/task").glob("*/children"):
        try:
            yield from map(int, thread.read_text().split())
        except OSError:
            continue


def peak(pid: int) -> int:
    """Largest resident memory of a process so far, KiB."""
    try:
        lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    except OSError:
        return 0
    return next((int(line.split()[1]) for line in lines if line.startswith("VmHWM")), 0)


def tables(out: Path) -> dict[str, list[dict[str, Any]]]:
    """All rows, without the columns that differ from run to run."""
    results = Results(out)
    return {
        name: [
            {column: value for column, value in row.items() if column not in VOLATILE}
            for row in results.read(name).to_pylist()
        ]
        for name in TABLES
    }


if __name__ == "__main__":
    sys.exit(main())
