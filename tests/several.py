"""Several calls of the command line in one process: most that end by themselves take less time than its start."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass

from tests.places import ROOT

_CALLS = """
import contextlib, io, json, sys
from igtl_gateway.cli import main
for words in json.loads(sys.argv[1]):
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            code = main(words)
        except SystemExit as end:  # of a value that an option cannot have
            code = end.code
    print(json.dumps([code, out.getvalue(), err.getvalue()]), flush=True)
"""


@dataclass(frozen=True)
class Outcome:
    """The exit code and the output of a call."""

    code: int
    out: str
    err: str


def outcomes(calls: Sequence[Sequence[str]], timeout_s: float = 60.0) -> list[Outcome]:
    """Of each call; a process of its own ends even those that were to be refused and were not."""
    ended = subprocess.run(
        [sys.executable, "-c", _CALLS, json.dumps(calls)],
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        check=False,
        timeout=timeout_s,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
    )
    assert (ended.returncode, ended.stderr) == (0, ""), ended.stderr
    found = [Outcome(*json.loads(line)) for line in ended.stdout.splitlines()]
    assert len(found) == len(calls), f"after {len(found)} of {len(calls)} calls it ended"
    return found
