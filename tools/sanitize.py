"""Run the tests of the parts in C, compiled with the sanitizers of the compiler and with checks of their states.

    .venv/bin/python tools/sanitize.py [ROUNDS [TEST …]]

ROUNDS: of foreign bytes for the kernel, 2,000,000 unless given.  TEST: instead of all tests of the modules.

The kernel runs by itself (``tests/native/kernel``).  The modules are compiled to a temporary folder, and every Python
below this process loads them from there; a read beyond a buffer, undefined arithmetic, or a transition that is not in
``STATES.md`` ends it.  Leaks are not looked for: the interpreter itself leaves memory to the system.
"""

from __future__ import annotations

import os
import shlex
import subprocess
import sys
import sysconfig
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
NATIVE = ROOT / "igtl_gateway" / "native"
PARTS = ("_express", "_queue", "_chunk", "_columns", "_passage")
CHECKS = (
    "-DIGTL_GATEWAY_CHECKED",
    "-fsanitize=address,undefined",
    "-fno-sanitize-recover=all",
    "-fno-omit-frame-pointer",
)
FLAGS = ("-g", "-O1", "-fPIC", "-shared", "-std=gnu11", "-ffp-contract=off", "-Wall", "-Wextra", "-Werror")
TESTS = (
    "tests/native/test_twins.py",
    "tests/native/test_turns.py",
    "tests/gateway/fastpath",
    "tests/record/test_shared_queue.py",
    "tests/convert/test_express.py",
    "tests/record/sessionfile/test_chunk_columns.py",
    "tests/record/sessionfile/test_columns.py",
)

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


def compiler() -> str:
    return shlex.split(sysconfig.get_config_var("CC") or "cc")[0]


def build(folder: Path) -> None:
    """Compile the parts into a folder, with what has a Python load them."""
    for part in PARTS:
        words = [compiler(), *FLAGS, *CHECKS, f"-I{sysconfig.get_path('include')}", "-o", str(folder / f"{part}.so")]
        subprocess.run([*words, str(NATIVE / f"{part}.c"), "-lm", "-pthread"], check=True)
    (folder / "sitecustomize.py").write_text(_SITE)


def environment(folder: Path) -> dict[str, str]:
    """Return the environment of a Python that loads the parts from a folder."""
    library = subprocess.run([compiler(), "-print-file-name=libasan.so"], capture_output=True, text=True, check=True)
    return os.environ | {
        "LD_PRELOAD": library.stdout.strip(),
        "ASAN_OPTIONS": "detect_leaks=0",
        "UBSAN_OPTIONS": "print_stacktrace=1",
        "PYTHONPATH": str(folder),
    }


def tested(folder: Path, there: Mapping[str, str], tests: Sequence[str]) -> int:
    """Return the exit code of pytest; tests that fail run again alone, because all is several times slower."""
    words = [sys.executable, "-m", "pytest", "-q", "-m", "not long", "-o", "faulthandler_timeout=0"]
    words += ["-o", f"cache_dir={folder / 'cache'}", *tests]
    code = subprocess.run(words, cwd=ROOT, env=there, check=False).returncode
    return subprocess.run([*words, "--last-failed"], cwd=ROOT, env=there, check=False).returncode if code == 1 else code


def main(rounds: str = "2000000", *tests: str) -> int:
    """Return the exit code of the first tests that fail, else 0."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        build(folder)
        runs = (
            ("kernel", ("tests/native/test_kernel.py",), os.environ | {"KERNEL_ROUNDS": rounds}),
            ("modules", tests or TESTS, environment(folder)),
        )
        for what, those, there in runs:
            begun = time.monotonic()
            code = tested(folder, there, those)
            print(f"{what}: exit code {code} after {time.monotonic() - begun:.0f} s", flush=True)
            if code:
                return code
    return 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
