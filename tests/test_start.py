"""Ctrl-C at any moment of the start is no traceback: real processes, interrupted at chosen imports."""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path

import pytest

from tests.places import ROOT

#: Interrupts its own process at the import with a number, and runs the program as the console script does.
PROGRAM = """\
import atexit, os, signal, sys
class Interrupt:
    count = 0
    def find_spec(self, *_names):
        Interrupt.count += 1
        if Interrupt.count == {number}:
            os.kill(os.getpid(), signal.SIGINT)
sys.meta_path.insert(0, Interrupt())
atexit.register(lambda: Interrupt.count < {number} and open({late!r}, "w").close())
sys.argv = ["igtl-gateway", *{words!r}]
signal.signal(signal.SIGINT, signal.{handler})
from igtl_gateway.start import main
sys.exit(main())
"""
VERBS = {
    "info": ["info", "fixtures/star.mcap"],
    "help": ["--help"],
    "verify": ["verify", "fixtures/star.mcap"],
    "bridge": ["bridge", "--no-ros", "--listen", "127.0.0.1:0", "--duration", "0.1"],
    "export": ["export", "fixtures/star.mcap", "--to", "lerobot", "--write-recipe", "OUT.toml"],
    "review": ["review", "fixtures/star.mcap"],
}


def interrupted(verb: str, number: int, folder: Path, handler: str = "default_int_handler") -> tuple[int, str, str]:
    words = [each.replace("OUT", f"{folder}/{number}") for each in VERBS[verb]]
    code = PROGRAM.format(number=number, words=words, handler=handler, late=str(folder / "late"))
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, timeout=60, check=False
    )  # fmt: skip
    return done.returncode, done.stdout, done.stderr


@pytest.mark.parametrize(("verb", "number"), [("info", 20), ("info", 120), ("bridge", 60), ("export", 200)])
def test_an_interrupt_while_modules_are_imported_is_quiet(verb: str, number: int, tmp_path: Path) -> None:
    assert interrupted(verb, number, tmp_path) == (-signal.SIGINT, "", "")


@pytest.mark.parametrize("number", [6, 7])
def test_an_interrupt_at_the_first_imports_is_quiet(number: int, tmp_path: Path) -> None:
    """Those after the start itself: ``signal`` would be one of them, and imports others."""
    code = PROGRAM.format(number=number, words=["--help"], handler="default_int_handler", late=str(tmp_path / "late"))
    bare = code.replace("import atexit, os, signal, sys", "import atexit, _signal as signal, os, sys")
    done = subprocess.run(
        [sys.executable, "-S", "-E", "-c", bare], cwd=ROOT, capture_output=True, text=True, timeout=60, check=False
    )  # fmt: skip
    assert (done.returncode, done.stdout, done.stderr) == (-signal.SIGINT, "", "")


@pytest.mark.slow
@pytest.mark.parametrize("verb", VERBS)
def test_an_interrupt_at_any_import_is_no_traceback(verb: str, tmp_path: Path) -> None:
    """Also at those that come while the verb runs, and after the last one."""
    results = {}
    for number in (20, 50, 120, 300, 450, 600, 800, 1_200):
        results[number] = interrupted(verb, number, tmp_path)
        if (tmp_path / "late").exists():  # there are not that many: without an interrupt, the others are the same
            break
    for number, (code, _, error) in results.items():
        assert "Traceback" not in error and len(error.strip().splitlines()) <= 2, (number, error)
        assert code in (0, 1, -signal.SIGINT), (number, code, error)
    assert results[20][0] == -signal.SIGINT


def test_an_ignored_interrupt_stays_ignored(tmp_path: Path) -> None:
    """As of a program that a shell started in the background."""
    code, out, error = interrupted("help", 120, tmp_path, "SIG_IGN")
    assert code == 0 and "usage" in out and not error
