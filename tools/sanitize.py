"""Run the parts in C under the sanitizers of the compiler, with checks of their states, and on foreign bytes.

    .venv/bin/python tools/sanitize.py [--minutes 10] [--rounds 2000000] [PART …]

Parts: ``kernel`` is tests/native/kernel by itself, on foreign bytes, rounds as given.  ``memory`` is the modules in
their tests under the sanitizers of addresses and of undefined behaviour, with the checks of STATES.md.  ``threads`` is
the same under the sanitizer of threads.  ``fuzz`` is kernel and passage on foreign bytes, with other seeds until the
minutes are over.

The modules are compiled to a temporary folder, with every warning an error, and every Python below this process loads
them from there.  Leaks are not looked for: the interpreter itself leaves memory to the system.  The interpreter has no
checks of threads: what it reads by itself, such as counts that are members of an object, and the order that the process
of the recorder gives, are not seen.
"""

from __future__ import annotations

import argparse
import os
import shlex
import shutil
import subprocess
import sys
import sysconfig
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
NATIVE = ROOT / "igtl_gateway" / "native"
FLAGS = ("-g", "-O1", "-fPIC", "-shared", "-std=gnu11", "-ffp-contract=off", "-fno-omit-frame-pointer")
WARNINGS = ("-Wall", "-Wextra", "-Wconversion", "-Wshadow", "-Werror")
#: The flags of each kind of check, and the library of it that a Python without it needs before all others.
CHECKS = {
    "memory": (("-fsanitize=address,undefined", "-fno-sanitize-recover=all"), "libasan.so"),
    # a fence is not understood, and only between processes
    "threads": (("-fsanitize=thread", "-Wno-error=tsan"), "libtsan.so"),
}
#: Tests of the modules: of each door, ``_NAME.c``.
TESTS = {
    "_chunk": ("tests/record/sessionfile/test_chunk_rows.py", "tests/addons/merge/test_writer.py"),
    "_columns": ("tests/record/sessionfile/test_columns.py", "tests/record/sessionfile/test_chunk_columns.py"),
    "_express": ("tests/convert/test_express.py", "tests/native/test_twins.py"),
    "_figures": ("tests/record/sessionfile/test_figures.py",),
    "_lines": ("tests/api/test_csv_lines.py",),
    "_passage": (
        *(f"tests/native/test_{name}.py" for name in ("foreign", "subscriptions", "turns", "types")),
        "tests/gateway/fastpath",
        "tests/replay/test_recheck.py",
    ),
    "_queue": ("tests/record/test_shared_queue.py",),
}
#: The sanitizers leave out what this test asks the system for.
UNTESTABLE = "tests/record/test_shared_queue.py::test_memory_that_is_locked_stays"
KERNEL, PASSAGE = "tests/native/test_kernel.py", "tests/native/test_foreign.py"
#: What the checks of threads cannot know: a place in the recorder's queue is written again after the process of the
#: recorder has released it, and a test closes a socket that it reads.
SUPPRESSED = ("race:^copy_parts$", "race:^s_pack_internal$", "race:^queue_begin$", "race:^sock_recv_impl$")
#: Rounds of one run of a fuzzer, about half a minute.
FUZZ_ROUNDS = {"KERNEL_ROUNDS": "1000000", "PASSAGE_ROUNDS": "1500"}

#: Loads the parts from the folder that it lies in.
_SITE = """import importlib.abc, importlib.util, pathlib, sys
class Parts(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        package, _, part = name.rpartition(".")
        made = pathlib.Path(__file__).with_name(part + ".so")
        if package == "igtl_gateway.native" and made.exists():
            return importlib.util.spec_from_file_location(name, made)
sys.meta_path.insert(0, Parts())
"""

Environment = Mapping[str, str]


def doors() -> list[str]:
    """The modules in C of the core, by their folder."""
    return sorted(path.stem for path in NATIVE.glob("_*.c"))


def compiler() -> str:
    return shlex.split(sysconfig.get_config_var("CC") or "cc")[0]


def build(folder: Path, check: str) -> Environment:
    """Compile the modules into a folder; return the environment of a Python that loads them from there."""
    folder.mkdir()
    flags, library = CHECKS[check]
    for door in doors():
        words = [compiler(), *FLAGS, *WARNINGS, *flags, "-DIGTL_GATEWAY_CHECKED"]
        words += ["-isystem", sysconfig.get_path("include"), "-o", str(folder / f"{door}.so")]
        subprocess.run([*words, str(NATIVE / f"{door}.c"), "-lm", "-pthread"], check=True)
    (folder / "sitecustomize.py").write_text(_SITE)
    (folder / "suppressed").write_text("\n".join(SUPPRESSED) + "\n")
    found = subprocess.run([compiler(), f"-print-file-name={library}"], capture_output=True, text=True, check=True)
    return os.environ | {
        "LD_PRELOAD": found.stdout.strip(),
        "ASAN_OPTIONS": "detect_leaks=0",
        "UBSAN_OPTIONS": "print_stacktrace=1",
        "TSAN_OPTIONS": f"exitcode=0 log_path={folder / 'races'} suppressions={folder / 'suppressed'}",
        "PYTHONPATH": str(folder),
    }


def tested(folder: Path, there: Environment, tests: Sequence[str], before: Sequence[str] = ()) -> int:
    """Return the exit code of pytest; tests that fail run again alone, because all is several times slower."""
    words = [*before, sys.executable, "-m", "pytest", "-q", "-m", "not long", "-o", "faulthandler_timeout=0"]
    words += ["-o", f"cache_dir={folder / 'cache'}", "--deselect", UNTESTABLE, *tests]
    code = subprocess.run(words, cwd=ROOT, env=there, check=False).returncode
    return subprocess.run([*words, "--last-failed"], cwd=ROOT, env=there, check=False).returncode if code == 1 else code


def of_modules() -> list[str]:
    return sorted({test for door in doors() for test in TESTS[door]})


def kernel(folder: Path, options: argparse.Namespace) -> str:
    folder.mkdir()
    code = tested(folder, os.environ | {"KERNEL_ROUNDS": str(options.rounds)}, [KERNEL])
    return f"exit code {code}" if code else ""


def memory(folder: Path, _options: argparse.Namespace) -> str:
    code = tested(folder, build(folder, "memory"), of_modules())
    return f"exit code {code}" if code else ""


def threads(folder: Path, _options: argparse.Namespace) -> str:
    there = build(folder, "threads")
    # the places of memory that the system chooses at random are not all known to the sanitizer
    before = [found, "-R"] if (found := shutil.which("setarch")) else []
    code = tested(folder, there, of_modules(), before)
    races = [path.read_text("utf-8", "replace") for path in sorted(folder.glob("races.*"))]
    print(*races, sep="\n")
    return f"exit code {code}" if code else f"races in {len(races)} processes" if races else ""


def seeds(minutes: float) -> Iterator[int]:
    until = time.monotonic() + 60 * minutes
    seed = 1
    while time.monotonic() < until:
        seed += 1
        yield seed


def fuzz(folder: Path, options: argparse.Namespace) -> str:
    """Each seed is printed where it fails, and runs again by ``SEED=… pytest``."""
    there = build(folder, "memory")

    def one(test: str, environment: Environment) -> str:
        runs = 0
        for seed in seeds(options.minutes):
            words = [
                sys.executable,
                "-m",
                "pytest",
                "-q",
                "-x",
                "-p",
                "no:cacheprovider",
                "-o",
                "faulthandler_timeout=0",
                test,
            ]
            run = subprocess.run(
                words,
                cwd=ROOT,
                env={**environment, **FUZZ_ROUNDS, "SEED": str(seed)},
                check=False,
                capture_output=True,
                text=True,
            )
            if run.returncode:
                print(run.stdout, run.stderr)
                return f"{test} with SEED={seed}: exit code {run.returncode}"
            runs += 1
        print(f"{test}: {runs} seeds", flush=True)
        return ""

    with ThreadPoolExecutor() as pool:
        found = pool.map(one, (KERNEL, PASSAGE), (os.environ, there))
        return "; ".join(filter(None, found))


PARTS: dict[str, Callable[[Path, argparse.Namespace], str]] = {
    "kernel": kernel,
    "memory": memory,
    "threads": threads,
    "fuzz": fuzz,
}


def main() -> int:
    """Return 1 if a part has found something; each part has a line at the end."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=10.0, help="of the part fuzz (10)")
    parser.add_argument("--rounds", type=int, default=2_000_000, help="of the part kernel (2,000,000)")
    parser.add_argument("parts", metavar="PART", nargs="*", help=f"{', '.join(PARTS)}; all unless given")
    options = parser.parse_args()
    if unknown := set(options.parts) - PARTS.keys():
        parser.error(f"found {', '.join(sorted(unknown))}, expected parts: {', '.join(PARTS)}")
    lines, failed = [], False
    with tempfile.TemporaryDirectory() as name:
        for part in options.parts or PARTS:
            begun = time.monotonic()
            found = PARTS[part](Path(name) / part, options)
            failed |= bool(found)
            lines.append(f"{part}: {found or 'nothing found'}, {time.monotonic() - begun:.0f} s")
            print(lines[-1], flush=True)
    print("", *lines, sep="\n")
    return failed


if __name__ == "__main__":
    sys.exit(main())
