"""What the work on recordings costs: each verb, beside the program of others that does the same."""

from __future__ import annotations

import importlib.util
import json
import shutil
import socket
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from threading import Thread

from igtl_gateway.base.clock import Clock
from igtl_gateway.base.stamp import NS_PER_S
from igtl_gateway_lab.bench import recordings, spent
from igtl_gateway_lab.bench.figures import Row, ratio
from igtl_gateway_lab.bench.payloads import transform
from igtl_gateway_lab.bench.processes import BenchError
from igtl_gateway_lab.programs import ours
from igtl_gateway_lab.simulate.stage import START_NS

#: Recording → what makes it, how many times as long as the others it is.
_MADE = {
    "A": (recordings.small, 1.0),
    "B": (recordings.pictures, 1.0),
    "C": (recordings.mixed, 6.0),
    "A/10": (recordings.small, 0.1),
}
#: What is merged with another one.
_SECOND = "C"
_RECEIVED_BYTES = 1 << 20
_ENDS_S = 30.0
_LIGHT_NODE = Path(__file__).parents[1] / "demo" / "light_node.py"
_PYMCAP, _RERUN = "pymcap-cli", "rerun"


@dataclass(frozen=True, slots=True)
class Job:
    """A verb on a recording, and the same by another program.

    ``{file}``, ``{out}``, ``{start}`` and ``{end}`` (seconds), ``{start_ns}`` and ``{end_ns}`` (UTC), ``{second}``
    (recording C), ``{key}`` (a file), ``{python}`` and ``{node}`` (a program of ROS) are replaced.

    Attributes:
        verb: as the table shows it.
        files: names of recordings.
        words: of ``igtl-gateway``.
        other: program and words; empty: no other program does it.
        before: words of ``igtl-gateway`` that are not measured.
        needs: a Python package, without which the row has no figures.
    """

    verb: str
    files: Sequence[str]
    words: str
    other: str = ""
    before: str = ""
    needs: str = ""


#: The row of the replay, which no other program has.
_REPLAY = "replay --to igtl, A"
_JOBS = (
    Job("info", "ABC", "info {file}", f"{_PYMCAP} info {{file}}"),
    Job("verify", "ABC", "verify {file}"),
    Job("recover", "ABC", "recover {file} -o {out}.mcap", f"{_PYMCAP} recover {{file}} -o {{out}}.mcap"),
    Job(
        "slice of a third",
        "ABC",
        "slice {file} -o {out}.mcap --start {start} --end {end}",
        f"{_PYMCAP} filter {{file}} -o {{out}}.mcap -S {{start_ns}} -E {{end_ns}}",
    ),
    Job("view -o", "AB", "view {file} -o {out}.rrd", f"{_RERUN} mcap convert {{file}} -o {{out}}.rrd"),
    Job("export --to csv", "A", "export {file} --to csv -o {out}", f"{_PYMCAP} export-csv {{file}} {{out}}"),
    Job("diff with itself", "A", "diff {file} {file}"),
    Job("verify --reference", ("A/10", "B"), "verify {file} --reference"),
    Job("export --to parquet", "A", "export {file} --to parquet -o {out}", needs="pyarrow"),
    Job(
        "merge with C",
        "A",
        "merge a={file} c={second} --offset c=0 -o {out}.mcap",
        f"{_PYMCAP} merge {{file}} {{second}} -o {{out}}.mcap",
    ),
    Job("deidentify", "AB", "deidentify {file} -o {out}.mcap"),
    Job("seal", "AB", "seal {file} --key {key} -o {out}.mcap", before="seal keys new {key}", needs="cryptography"),
    Job("resim of a light node", ("A/10",), "resim {file} --runs 1 -- {python} {node}", needs="rclpy"),
)


@dataclass(frozen=True, slots=True)
class _Spent:
    """What a program took: seconds of CPU and of waiting, with its children; MB of the largest of its processes."""

    cpu_s: float
    wall_s: float
    peak_mb: float

    def row(self, before: str = "") -> Row:
        return {
            f"{before}cpu_s": round(self.cpu_s, 2),
            f"{before}wall_s": round(self.wall_s, 2),
            f"{before}peak_mb": round(self.peak_mb, 1),
        }


def streams() -> list[str]:
    """The names of the rows: a verb and a recording."""
    return [*(f"{job.verb}, {name}" for job in _JOBS for name in job.files), _REPLAY]


def measure(folder: Path, duration_s: float, clock: Clock, print_status: Callable[[str], None]) -> list[Row]:
    """One round: a row for each verb and recording.  Raises BenchError for a verb that fails.

    The recordings are made in ``folder``, in the first round.
    """
    made = {name: _made(folder, name, duration_s, print_status) for name in _MADE}
    rows = []
    for job in _JOBS:
        for name in job.files:
            print_status(f"offline: {job.verb}, {name}")
            rows.append(_row(job, made[name], clock))
    print_status("offline: replay, A")
    return [*rows, _replayed(made["A"], clock)]


def about(rows: Sequence[Row]) -> list[str]:
    """The rows as a table of Markdown."""
    lines = [
        "| verb, recording | CPU s | wall s | MB | beside | CPU s | wall s | MB | CPU ratio | other figures | goals |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        other = [row.get(f"other_{name}", "") for name in ("cpu_s", "wall_s", "peak_mb")]
        figures = [
            f"{row[name]:,} {unit}"
            for name, unit in (
                ("us_an_entry", "µs an entry"),
                ("us_an_input", "µs an input"),
                ("sent_per_s", "a second"),
            )
            if name in row
        ]
        goals = ", ".join(f"{'' if met else 'not '}{goal}" for goal, met in row.get("bounds", {}).items())
        own = [row.get(name, "") for name in ("cpu_s", "wall_s", "peak_mb")]
        cells = [f"{row['stream']}{f' ({absent} is absent)' if (absent := row.get('absent')) else ''}", *own]
        cells += [row.get("other", ""), *other]
        cells += [row.get("cpu_ratio", ""), ", ".join(figures), goals]
        lines.append(f"| {' | '.join(map(str, cells))} |")
    return lines


@dataclass(frozen=True, slots=True)
class _Recording:
    name: str
    path: Path
    entries: int
    duration_s: float

    def words(self, line: str, out: Path) -> list[str]:
        """The words of a command line, with the places of the recording and the second third of its time."""
        start_s, end_s = self.duration_s / 3, self.duration_s * 2 / 3
        return line.format(
            file=self.path,
            out=out,
            second=self.path.with_name(f"{_SECOND}.mcap"),
            key=out.with_name("key"),
            python=sys.executable,
            node=_LIGHT_NODE,
            start=f"{start_s:g}",
            end=f"{end_s:g}",
            start_ns=START_NS + round(start_s * NS_PER_S),
            end_ns=START_NS + round(end_s * NS_PER_S),
        ).split()


def _made(folder: Path, name: str, duration_s: float, print_status: Callable[[str], None]) -> _Recording:
    make, times = _MADE[name]
    plain = name.replace("/", "_")
    path, beside = folder / f"{plain}.mcap", folder / f"{plain}.entries"
    if not beside.exists():
        print_status(f"offline: making {name}, {duration_s * times:g} s")
        beside.write_text(str(make(path, duration_s * times)), "ascii")
    return _Recording(name, path, int(beside.read_text("ascii")), duration_s * times)


def _row(job: Job, recording: _Recording, clock: Clock) -> Row:
    folder = recording.path.with_suffix(".out")
    row: Row = {"case": "offline", "stream": f"{job.verb}, {recording.name}", "entries": recording.entries}
    if job.needs and importlib.util.find_spec(job.needs) is None:
        return row | {"absent": job.needs}
    with _emptied(folder):
        if job.before:
            _spent(ours(*recording.words(job.before, folder / "ours")), clock)
        taken = _spent(ours(*recording.words(job.words, folder / "ours")), clock)
    row |= taken.row() | {"us_an_entry": round(1e6 * taken.cpu_s / recording.entries, 2)}
    if job.verb.startswith("resim"):
        inputs = recording.duration_s * recordings.SMALL_HZ
        row["us_an_input"] = round(1e6 * taken.cpu_s / inputs, 1)
    if not job.other:
        return row
    program, *rest = recording.words(job.other, folder / "other")
    row["other"] = " ".join([program, *job.other.split()[1 : 3 if program == _RERUN else 2]])
    if found := _found(program):
        with _emptied(folder):
            other = _spent([found, *rest], clock)
        return row | other.row("other_") | {"cpu_ratio": ratio(taken.cpu_s, other.cpu_s)}
    row["other"] += ", absent"
    return row


@contextmanager
def _emptied(folder: Path) -> Iterator[None]:
    """A folder for what a program writes."""
    folder.mkdir()
    try:
        yield
    finally:
        shutil.rmtree(folder)


def _found(program: str) -> str | None:
    """Where a program is: beside this Python, or on the path."""
    return shutil.which(program, path=str(Path(sys.executable).parent)) or shutil.which(program)


def _spent(command: Sequence[str], clock: Clock) -> _Spent:
    """Run a program to its end.  Raises BenchError if it does not end well."""
    begun_ns = clock.monotonic_ns()
    with tempfile.TemporaryDirectory() as folder:
        figures_at = Path(folder, "figures")
        done = subprocess.run(
            [sys.executable, "-S", spent.__file__, figures_at, *command],
            stdin=subprocess.DEVNULL,
            capture_output=True,
            check=False,
        )
        wall_s = (clock.monotonic_ns() - begun_ns) / NS_PER_S
        figures = json.loads(figures_at.read_text("ascii")) if figures_at.exists() else {"code": done.returncode}
    if figures["code"]:
        last = done.stderr.decode("utf-8", "replace").strip()[-500:]
        raise BenchError(f"{' '.join(command)}: exit code {figures['code']}: {last}")
    return _Spent(figures["cpu_s"], wall_s, figures["peak_kib"] / 1000)


def _replayed(recording: _Recording, clock: Clock) -> Row:
    """Send a recording to one peer, which reads and does nothing else."""
    arrived = _Arrived(clock)
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(_ENDS_S)
        reader = Thread(target=arrived.read, args=(server,), daemon=True)
        reader.start()
        to = f"127.0.0.1:{server.getsockname()[1]}"
        words = ["--to", "igtl", "--connect", to, "--as-fast-as-possible", "--json"]
        taken = _spent(ours("replay", str(recording.path), *words), clock)
        reader.join(_ENDS_S)
    seconds = (arrived.last_ns - arrived.first_ns) / NS_PER_S
    messages = arrived.bytes // len(transform().igtl_maker("")(0))
    row: Row = {"case": "offline", "stream": _REPLAY, "entries": recording.entries}
    return row | taken.row() | {"sent_per_s": round(messages / seconds) if seconds else None}


class _Arrived:
    """What a peer has read: bytes, and the times of the first and the last of them (monotonic ns)."""

    def __init__(self, clock: Clock) -> None:
        self.bytes = self.first_ns = self.last_ns = 0
        self._clock = clock

    def read(self, server: socket.socket) -> None:
        peer, _ = server.accept()
        room = bytearray(_RECEIVED_BYTES)
        with peer:
            while size := peer.recv_into(room):
                self.last_ns = self._clock.monotonic_ns()
                self.first_ns = self.first_ns or self.last_ns
                self.bytes += size
