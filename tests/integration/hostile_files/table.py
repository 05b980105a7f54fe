"""All hostile files, how they are given to the verbs, and what is judged."""

from __future__ import annotations

import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from types import MappingProxyType

from igtl_gateway.app.sealing import seal_recording, stamp_recording, verify_seal
from igtl_gateway.record.seal.keys import SigningKey
from tests.integration.hostile_files import (
    bags,
    cohorts,
    folders,
    foreign,
    images,
    keys,
    robots,
    scenes,
    sessions,
    slicer_files,
    stamps,
    streams,
)
from tests.integration.hostile_files.case import BESIDES, FORGED, GOOD, SMALL, VERBS, Hostile
from tests.places import ROOT
from tests.record.seal.authority import new_authority

CASES: tuple[Hostile, ...] = (
    *sessions.CASES,
    *foreign.CASES,
    *bags.CASES,
    *images.CASES,
    *scenes.CASES,
    *slicer_files.CASES,
    *streams.CASES,
    *robots.CASES,
    *keys.CASES,
    *stamps.CASES,
    *folders.CASES,
    *cohorts.CASES,
)

WORKER = Path(__file__).with_name("worker.py")
#: Seconds of the processor, and of the clock, after which a verb hangs; seconds of the processor, and megabytes, that
#: it may take.
PATIENCE_S, WAIT_S, CPU_S, PEAK_MB = 20.0, 60.0, 5.0, 300.0

_CONTROL = re.compile("[\x00-\x09\x0b-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069\ud800-\udfff]")
_TRACE = re.compile(r"Traceback \(most recent|Exception ignored|thread '.*' panicked|Fatal Python error|\w+Warning: ")
_FORGED = re.compile(f"^{re.escape(FORGED[:6])}", re.MULTILINE)

#: A store that is away, and keys for it.
_STORE = {"AWS_ENDPOINT_URL": "http://127.0.0.1:9", "AWS_ACCESS_KEY_ID": "key", "AWS_SECRET_ACCESS_KEY": "secret"}

#: What may be wrong with a verb's end.
FAULTS = ("traceback", "memory", "hang", "slow", "control characters", "forged lines", "exit code")


@dataclass(frozen=True, slots=True)
class Outcome:
    """What a verb made of a file."""

    name: str
    verb: str
    code: object
    seconds: float
    cpu: float
    peak_mb: float
    output: str
    errors: str
    faults: tuple[str, ...] = ()
    why: str = ""

    @property
    def answer(self) -> str:
        """The first line of the errors, or of the output, without the names of files."""
        lines = (self.errors or self.output).splitlines() or [""]
        verb = next(word for word in self.verb.split() if "=" not in word)
        return re.sub(r"/\S*/", "", lines[0].removeprefix(f"igtl-gateway {verb}: "))


def judged(name: str, verb: str, told: dict[str, object]) -> Outcome:
    """The output of a worker for one verb, and its faults."""
    output, errors, trace = str(told["output"]), str(told["errors"]), str(told["trace"])
    text = output + errors
    faults = []
    if "MemoryError" in trace + text or float(str(told["peak_mb"])) > PEAK_MB:
        faults.append("memory")
    if trace or _TRACE.search(text):
        faults.append("traceback")
    if float(str(told["cpu"])) > CPU_S:
        faults.append("slow")
    if _CONTROL.search(text):
        faults.append("control characters")
    if _FORGED.search(text):
        faults.append("forged lines")
    if told["code"] not in (0, 1, 2) or errors.startswith("usage: "):
        faults.append("exit code")
    why = trace.strip().rpartition("\n")[2] if trace else next((m.group() for m in [_TRACE.search(text)] if m), "")
    return Outcome(
        name,
        verb,
        told["code"],
        float(str(told["seconds"])),
        float(str(told["cpu"])),
        float(str(told["peak_mb"])),
        output,
        errors,
        tuple(faults),
        why or (errors.splitlines() or [""])[-1][:200],
    )


@dataclass
class Worker:
    """A process that runs verbs until it dies or hangs; then there is another one."""

    folder: Path
    tree: Path = ROOT
    _process: subprocess.Popen[str] | None = field(default=None, init=False)
    _lines: Iterator[str] = field(default=iter(()), init=False)
    _starts: int = field(default=0, init=False)

    def run(self, name: str, verb: str, arguments: Sequence[str]) -> Outcome:
        """Run one verb."""
        is_new = self._process is None or self._process.poll() is not None
        if is_new:
            self._start()
        process = self._process
        assert process and process.stdin
        process.stdin.write(json.dumps(list(arguments)) + "\n")
        process.stdin.flush()
        started = time.monotonic()
        pause, spent = 0.0005, _cpu_s(process.pid)
        while time.monotonic() - started < WAIT_S and _cpu_s(process.pid) - spent < PATIENCE_S:
            if told := self._told():
                outcome = judged(name, verb, told)
                if "memory" not in outcome.faults:
                    return outcome
                self.close()  # what it holds now would be counted against the next file
                return outcome if is_new else self.run(name, verb, arguments)  # without what earlier verbs left
            if process.poll() is not None:
                if told := self._told():
                    return judged(name, verb, told)
                code, self._process = process.returncode, None
                errors = Path(f"{self._results}.err").read_text("utf-8", "replace")[-2000:]
                return Outcome(
                    name,
                    verb,
                    code,
                    time.monotonic() - started,
                    0,
                    0,
                    "",
                    errors,
                    ("memory" if code == -9 or "memory" in errors.lower() else "traceback",),
                    f"the process died: {code}",
                )
            time.sleep(pause)
            pause = min(2 * pause, 0.05)
        self.close()
        return Outcome(name, verb, None, time.monotonic() - started, PATIENCE_S, 0, "", "", ("hang",), "hang")

    def _start(self) -> None:
        self._starts += 1
        self._results = self.folder / f"results-{self._starts}"
        self._results.touch()
        # few arenas: each thread would reserve 64 MB of the address space that is allowed
        environment = os.environ | {"MALLOC_ARENA_MAX": "2"} | {"PYTHONPATH": str(self.tree), "COLUMNS": "200"} | _STORE
        # its working directory is the folder: what is written beside a wrong path is found
        self._process = subprocess.Popen(
            [sys.executable, str(WORKER), str(self._results)],
            stdin=subprocess.PIPE,
            text=True,
            env=environment,
            cwd=self.folder,
        )
        self._reader = self._results.open(encoding="utf-8")

    def _told(self) -> dict[str, object] | None:
        place = self._reader.tell()
        line = self._reader.readline()
        if not line.endswith("\n"):
            self._reader.seek(place)
            return None
        told: dict[str, object] = json.loads(line)
        return told

    def close(self) -> None:
        """End the process."""
        if self._process:
            self._process.kill()
            self._process.wait()
            self._process = None


def _cpu_s(process: int) -> float:
    """Seconds of the processor that a process has taken."""
    try:
        told = Path(f"/proc/{process}/stat").read_text("ascii").rpartition(")")[2].split()
    except OSError:
        return 0.0
    return (int(told[11]) + int(told[12])) / os.sysconf("SC_CLK_TCK")


def besides(folder: Path) -> dict[str, str]:
    """Write the sound files that ``VERBS`` names; return their paths by these names."""
    for name, content in BESIDES.items():
        (folder / name).write_text(content, "utf-8")
    key, sealed = SigningKey.generate(), folder / "SEALED"
    for path, data in ((folder / "KEY", key.private_pem()), (folder / "KEY.pub", key.public_pem())):
        path.write_bytes(data)
        path.chmod(0o600)
    seal_recording(SMALL, folder / "KEY", sealed)
    stamped = sealed
    if shutil.which("openssl") and find_spec("rfc3161_client"):
        authority, stamped = new_authority(folder / "authority", "Clock"), folder / "STAMPED"
        stamp_recording(sealed, authority.reply(verify_seal(sealed).parts[-1].last_seal), stamped)
    (folder / "COHORT").mkdir()
    cohorts.write_cohort(folder / "COHORT")
    (folder / "GOODS").mkdir()
    shutil.copyfile(SMALL, folder / "GOODS" / "small.mcap")
    names = (*BESIDES, "KEY", "KEY.pub", "SEALED", "COHORT", "GOODS")
    return {name: str(folder / name) for name in names} | {"STAMPED": str(stamped)}


def words(verb: str, path: Path, out: Path, more: Mapping[str, str] = MappingProxyType({})) -> list[str]:
    """The arguments of a verb of ``VERBS`` for a file; ``more`` is of :func:`besides`."""
    told = {"F": str(path), "FOLDER": str(path.parent), "GOOD": str(GOOD), "SMALL": str(SMALL), **more}
    if "CONTENT" in verb:
        told["CONTENT"] = path.read_text("utf-8")
    found = []
    for word in shlex.split(verb):
        name, equals, value = word.rpartition("=")
        value = value.replace("OUT", str(out)) if value.startswith("OUT") else told.get(value, value)
        found.append(name + equals + value)
    return found


def chosen(sort: str, turn: int, more: int | None) -> Sequence[str]:
    """The verbs that a file of this sort is given to: all, or the first and ``more`` others, round-robin."""
    first, *others = VERBS[sort]
    if more is None or more >= len(others):
        return (first, *others)
    return (first, *(others[(turn * more + number) % len(others)] for number in range(more)))


def outcomes(
    cases: Iterable[Hostile], tree: Path = ROOT, *, patient: bool = True, verbs: int | None = None
) -> Iterator[Outcome]:
    """Every verb on every file, in one warm process.

    Args:
        cases: the files.
        tree: the checkout whose command line runs.
        patient: whether the other verbs are tried on a file that made one hang or took all the memory.
        verbs: the first verb and this number of others, round-robin; None: all.
    """
    memory = Path("/dev/shm")  # where no verb waits for a disk
    with TemporaryDirectory(prefix="hostile-", dir=memory if memory.is_dir() else None) as name:
        folder = Path(name)
        more = besides(folder)
        worker = Worker(folder, tree)
        try:
            for turn, case in enumerate(cases):
                place = folder / case.name
                place.mkdir()
                path = case.build(place)
                for number, verb in enumerate(chosen(case.sort, turn, verbs)):
                    outcome = worker.run(case.name, verb, words(verb, path, place / f"out-{number}", more))
                    yield outcome
                    if not patient and {"hang", "memory"} & set(outcome.faults):
                        break
                shutil.rmtree(place, ignore_errors=True)
        finally:
            worker.close()


def summary(found: Iterable[Outcome]) -> dict[str, int]:
    """Runs and files that had each fault."""
    runs: Counter[str] = Counter()
    files: dict[str, set[str]] = {}
    total = 0
    names = set()
    for outcome in found:
        total += 1
        names.add(outcome.name)
        for fault in outcome.faults:
            runs[fault] += 1
            files.setdefault(fault, set()).add(outcome.name)
            files.setdefault("any", set()).add(outcome.name)
    told = {"files": len(names), "runs": total, "files with a fault": len(files.get("any", ()))}
    for fault in FAULTS:
        told[f"{fault}, files"] = len(files.get(fault, ()))
        told[f"{fault}, runs"] = runs[fault]
    return told
