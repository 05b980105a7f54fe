"""Fuzzing of everything that reads files: ``python -m tools.fuzz_files --seconds 600 --seed 1``.

Strategy: generators of structure-aware damage (``tools/mcap_mutations.py``, ``tools/import_mutations.py``,
``tools/image_mutations.py``, ``tools/slicer_mutations.py``) give small files without end; each is written to memory
(``/dev/shm``) and read in this process.  Nothing may leave a reader but a GatewayError; a case may take 5 s of
processor time and 300 MB; what a verb prints holds no control character.  The sequence of cases of a reader depends on
the seed only.

What breaks a rule is written to a folder, the run goes on, and the program ends with exit code 1.
"""

from __future__ import annotations

import argparse
import io
import re
import resource
import shutil
import signal
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, redirect_stderr, redirect_stdout
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from random import Random
from types import FrameType

from igtl_gateway.addons.exchange.formats import open_source
from igtl_gateway.addons.exchange.targets import TARGETS
from igtl_gateway.app.setting_values import of_file
from igtl_gateway.base.errors import GatewayError
from igtl_gateway.base.untrusted.text import printable
from igtl_gateway.cli import main as command_line
from igtl_gateway.config.configuration import Config
from igtl_gateway.gateway.log.ledger import gaps
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.record.sessionfile.salvage import Salvage
from igtl_gateway.replay.recorded_config import config_to_run
from tools import image_mutations, import_mutations, mcap_mutations, slicer_mutations
from tools.import_mutations import Case

#: Of one case: seconds of the processor, and megabytes beyond those of the process before it (300 with the libraries).
CPU_S, GROWTH_MB = 5.0, 200
#: Timeouts of a case, in seconds of CPU time and of elapsed time, which is much longer on a busy machine.
_HANG_S, _WAIT_S = 20, 600
#: Cases that are read between two looks at the memory.
_BATCH = 50
#: Items of a source and entries of a session that are looked at.
_MOST = 5_000
_CONTROL = re.compile("[\x00-\x09\x0b-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069\ud800-\udfff]")


class Broken(Exception):
    """A reader did what it must never do."""


# -- readers -----------------------------------------------------------------------------------------------------


def read_import(path: Path, _rng: Random) -> str:
    """Everything that an importer gives."""
    with closing(open_source(path, None)) as source:
        for item in islice(source.items(), _MOST):
            len(item.payload)
            source.definition_of(item.type)
            source.qos_of(item.channel, item.type)
        for row in source.rows:
            printable(f"{row.stream}{row.type}{row.declared:,}{row.taken:,}{row.why}")
        return f"read {type(source).__name__}"


def read_configuration(path: Path, _rng: Random) -> str:
    """A configuration, for the gateway and for the edges."""
    of_file(path)
    Config.from_toml(path)
    return "read"


#: How a recording is read: in this process without the command line, and by verbs.  ``F`` is the file.
MCAP_VERBS = (
    "info F",
    "info F --json",
    "verify F",
    "lint F",
    "diff F F",
    "recover F -o O.mcap",
    "slice F -o O.mcap --start 0 --end 1",
    *(f"export F --to {target} -o O" for target in TARGETS),
    "review F",
    "import F -o O.mcap",
    "sync F",
    "deidentify F -o O.mcap",
    "verify F --seal",
)


def read_mcap(path: Path, rng: Random) -> str:
    """A recording: all its entries, or its recovery, or the output of a verb."""
    chance = rng.random()
    if chance < 0.4:
        return read_session(path)
    if chance < 0.6:
        with Salvage.open(path) as salvage:
            for entry in islice(salvage.entries(), _MOST):
                entry.data()
        return "saved"
    return verb(path, rng.choice(MCAP_VERBS))


def read_session(path: Path) -> str:
    """All entries of a recording, its configuration and its ledger."""
    with SessionFile.open(path) as file:
        for entry in islice(file.entries(), _MOST):
            entry.data()
        config_to_run(file.session)
        gaps(file.ledger or {})
    return "read"


def verb(path: Path, words: str) -> str:
    """The output of a verb for a file.  Raises Broken if it contains anything forbidden."""
    out, err = io.StringIO(), io.StringIO()
    given = [str(path) if word == "F" else word.replace("O", str(path.parent / "O"), 1) if word[0] == "O" else word
             for word in words.split()]  # fmt: skip
    with redirect_stdout(out), redirect_stderr(err):
        try:
            code = command_line(given)
        except SystemExit as ended:
            raise Broken(f"{words}: ended by {ended.code}: {err.getvalue()}") from None
    text = out.getvalue() + err.getvalue()
    if found := _CONTROL.search(text):
        raise Broken(f"{words}: printed {text[max(0, found.start() - 40) : found.end() + 40]!r}")
    if "found no memory" in text:
        raise MemoryError(words)
    return f"{words.split(maxsplit=1)[0]} {code}"


@dataclass(frozen=True, slots=True)
class Reader:
    """Something that reads files, and what gives it some."""

    cases: Callable[[int], Iterator[Case]]
    read: Callable[[Path, Random], str]


def _mcap_cases(seed: int) -> Iterator[Case]:
    return (Case(name, {"a.mcap": data}) for name, data in mcap_mutations.cases(seed))


READERS = {
    "mcap": Reader(_mcap_cases, read_mcap),
    "import": Reader(import_mutations.cases, read_import),
    "image": Reader(image_mutations.cases, read_import),
    "slicer": Reader(slicer_mutations.cases, read_import),
    "configuration": Reader(image_mutations.configurations, read_configuration),
}


# -- the run ---------------------------------------------------------------------------------------------------


@dataclass
class Report:
    """What came of the cases of one reader."""

    cases: int = 0
    seconds: float = 0.0
    outcomes: Counter[str] = field(default_factory=Counter)
    peak_mb: float = 0.0
    longest_s: float = 0.0
    longest: str = ""
    #: Name of the case, and what was wrong, each thing once.
    broken: dict[str, str] = field(default_factory=dict)

    def text(self) -> str:
        told = ", ".join(f"{outcome} {number:,}" for outcome, number in self.outcomes.most_common(12))
        rate = self.cases / self.seconds if self.seconds else 0.0
        return (
            f"{self.cases:,} cases in {self.seconds:.0f} s ({rate:.0f}/s), peak {self.peak_mb:.0f} MB, longest "
            f"{self.longest_s:.2f} s ({self.longest}), {len(self.broken)} broken: {told}"
        )


def _hangs(_number: int, _frame: FrameType | None) -> None:
    raise Broken(f"takes more than {_HANG_S} s of the processor, or {_WAIT_S} s")


class Fuzzer:
    """One reader and its endless cases, read batch by batch."""

    def __init__(self, reader: Reader, seed: int, out: Path | None) -> None:
        self.report = Report()
        self._reader, self._out = reader, out
        self._cases, self._rng = reader.cases(seed), Random(seed)

    def batch(self, folder: Path, size: int = _BATCH) -> None:
        """Read ``size`` cases."""
        began = time.monotonic()
        for case in islice(self._cases, size):
            self._one(case, folder)
            self.report.cases += 1
        self.report.seconds += time.monotonic() - began

    def _one(self, case: Case, folder: Path) -> None:
        place = folder / "case"
        place.mkdir()
        _reset_peak()  # of here: to make a case may take more than to read it
        resident_mb, began = _peak_mb(), time.process_time()
        signal.setitimer(signal.ITIMER_PROF, _HANG_S)
        signal.alarm(_WAIT_S)
        try:
            first = next(iter(case.files))
            path = case.write(place)
            # a header beside its pixels is opened itself, a recording in parts as a folder
            outcome = self._reader.read(place / first if first.endswith(("mhd", "nhdr")) else path, self._rng)
        except GatewayError as error:
            outcome = type(error).__name__
        except Exception as error:  # anything that escapes is what is looked for
            outcome = "broken"
            at = traceback.extract_tb(error.__traceback__)[-1]
            self._note(f"{type(error).__name__} {Path(at.filename).name}:{at.lineno}", traceback.format_exc(), case)
        finally:
            signal.alarm(0)
            signal.setitimer(signal.ITIMER_PROF, 0)
        spent = time.process_time() - began
        self.report.outcomes[outcome] += 1
        if spent > self.report.longest_s:
            self.report.longest_s, self.report.longest = spent, case.name[:60]
        if spent > CPU_S:
            self._note(f"slow {case.name[:40]}", f"{spent:.1f} s", case)
        peak = _peak_mb()
        self.report.peak_mb = max(self.report.peak_mb, peak)
        if peak > resident_mb + GROWTH_MB:
            self._note("memory", f"{resident_mb:.0f} -> {peak:.0f} MB", case)
        shutil.rmtree(place)

    def _note(self, key: str, why: str, case: Case | None) -> None:
        if key in self.report.broken:
            return
        self.report.broken[key] = why
        if self._out and case:
            place = self._out / re.sub(r"\W+", "-", f"{key}-{self.report.cases}")
            place.mkdir(parents=True, exist_ok=True)
            case.write(place)
            (place / "WHY.txt").write_text(f"{case.name}\n{why}", "utf-8", "backslashreplace")


def _reset_peak() -> None:
    try:
        Path("/proc/self/clear_refs").write_text("5", "ascii")
    except OSError:  # not Linux: the peak is that of the whole run
        return


def _peak_mb() -> float:
    try:
        status = Path("/proc/self/status").read_text("ascii")
    except OSError:
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return next(int(line.split()[1]) for line in status.splitlines() if line.startswith("VmHWM")) / 1024


def run(
    seed: int,
    goes_on: Callable[[int], bool],
    readers: tuple[str, ...] = tuple(READERS),
    out: Path | None = None,
    known: Mapping[str, Reader] | None = None,
    size: int = _BATCH,
) -> dict[str, Report]:
    """Batches of each reader, round-robin, while ``goes_on`` (called with the number of cases so far) returns True.

    Args:
        seed, readers, out: as on the command line.
        known: the readers by name, if they are not those of this program.
        size: cases of a batch.
    """
    fuzzers = {name: Fuzzer((known or READERS)[name], seed, out) for name in readers}
    memory = Path("/dev/shm")
    before = [(number, signal.signal(number, _hangs)) for number in (signal.SIGALRM, signal.SIGPROF)]
    try:
        with (
            warnings.catch_warnings(),
            tempfile.TemporaryDirectory(prefix="fuzz-", dir=memory if memory.is_dir() else None) as folder,
        ):
            for category in (RuntimeWarning, UserWarning):  # of numpy and cryptography: they would reach the terminal
                warnings.simplefilter("error", category)
            while goes_on(sum(fuzzer.report.cases for fuzzer in fuzzers.values())):
                for fuzzer in fuzzers.values():
                    fuzzer.batch(Path(folder), size)
    except KeyboardInterrupt:
        pass  # the report is what was asked for
    finally:
        for number, handler in before:
            signal.signal(number, handler)
    return {name: fuzzer.report for name, fuzzer in fuzzers.items()}


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--seconds", type=float, default=60.0, help="how long (%(default)s)")
    parser.add_argument("--seed", type=int, default=1, help="another seed, other files (%(default)s)")
    parser.add_argument("--reader", action="append", choices=READERS, help="only this one; may be repeated")
    parser.add_argument("--out", type=Path, default=Path("fuzz-broken"), help="where culprits go (%(default)s)")
    options = parser.parse_args()
    signal.signal(signal.SIGTERM, lambda _number, _frame: signal.raise_signal(signal.SIGINT))
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a program in the background ignores it
    end = time.monotonic() + options.seconds
    reports = run(options.seed, lambda _: time.monotonic() < end, tuple(options.reader or READERS), options.out)
    for name, report in reports.items():
        print(f"seed {options.seed}, {name}: {report.text()}")
        for key, why in report.broken.items():
            print(f"  BROKEN {printable(key)}: {printable(why.strip().rpartition(chr(10))[2][:300])}")
    return int(any(report.broken for report in reports.values()))


if __name__ == "__main__":
    sys.exit(main())
