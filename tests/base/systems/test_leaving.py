"""The end of the program beside threads of a library."""

from __future__ import annotations

import subprocess
import sys

import pytest

PROGRAM = """
import atexit, sys
from igtl_gateway.base.systems import leaving
atexit.register(print, "an exit function", flush=True)
{before}
print("all is done", flush=True)
leaving.leave_beside_threads(3)
sys.exit(4)
"""


@pytest.mark.parametrize(("before", "code"), [("leaving.expect_threads_of('rust')", 3), ("", 4)])
def test_the_interpreter_ends_only_where_no_thread_outlives_it(before: str, code: int) -> None:
    command = [sys.executable, "-c", PROGRAM.format(before=before)]
    ended = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (ended.returncode, ended.stderr) == (code, "")
    assert ended.stdout == "all is done\nan exit function\n"
