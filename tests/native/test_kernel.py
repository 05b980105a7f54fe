"""The kernel, tested in C without Python: ``kernel/kernel.c``, compiled with the sanitizers of the compiler."""

from __future__ import annotations

import os
import shlex
import subprocess
import sysconfig
from pathlib import Path

import pytest

from tests.places import PACKAGE

SOURCE = Path(__file__).parent / "kernel" / "kernel.c"
#: The flags of hatch_build.py that decide results, and every warning that the kernel is free of.
FLAGS = ("-g", "-O1", "-std=gnu11", "-ffp-contract=off", "-Wall", "-Wextra", "-Wconversion", "-Wshadow", "-Werror")
SANITIZERS = ("-fsanitize=address,undefined", "-fno-sanitize-recover=all", "-fno-omit-frame-pointer")
#: Rounds of foreign bytes; `make sanitize` has more.
ROUNDS = os.environ.get("KERNEL_ROUNDS", "20000")
SEED = os.environ.get("SEED", "1")


@pytest.fixture(scope="module")
def program(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The tests, compiled; skips without a compiler that has the sanitizers."""
    folder = tmp_path_factory.mktemp("kernel")
    compiler = shlex.split(sysconfig.get_config_var("CC") or "cc")[0]
    empty = folder / "empty.c"
    empty.write_text("int main(void) { return 0; }\n")
    target = folder / "kernel"
    try:
        subprocess.run([compiler, *SANITIZERS, "-o", target, empty], check=True, capture_output=True)
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("no C compiler with sanitizers here")
    # a test needs a part of a header only
    words = [compiler, *FLAGS, "-Wno-unused-function", *SANITIZERS, f"-I{PACKAGE / 'native' / 'kernel'}"]
    run = subprocess.run([*words, "-o", target, SOURCE, "-lm"], capture_output=True, text=True, check=False)
    assert (run.returncode, run.stderr) == (0, "")
    return target


def test_the_program_has_the_whole_kernel(program: Path) -> None:
    """What a header of the kernel includes is tested with it: here each is a part of the program."""
    words = [
        shlex.split(sysconfig.get_config_var("CC") or "cc")[0],
        "-MM",
        f"-I{PACKAGE / 'native' / 'kernel'}",
        str(SOURCE),
    ]
    included = subprocess.run(words, capture_output=True, text=True, check=True).stdout
    assert {path.name for path in (PACKAGE / "native" / "kernel").glob("*.h")} <= {
        Path(word).name for word in included.split()
    }


def test_the_kernel_by_itself(program: Path) -> None:
    run = subprocess.run([program, ROUNDS, SEED], capture_output=True, text=True, check=False)
    assert (run.returncode, run.stderr) == (0, ""), run.stdout
    assert run.stdout.endswith(" 0 failures\n")
