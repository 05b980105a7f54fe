"""What a verb imports before it has something to do: help and completion wait for nothing that only a run needs."""

from __future__ import annotations

import subprocess
import sys

import pytest

from igtl_gateway.cli.verbs import LABORATORY, available, own_verb
from tests.places import FIXTURES

#: Libraries and parts of the program that take longer to import than the help to print.
HEAVY = (
    *("numpy", "mcap", "lz4", "zstandard", "rosbags", "rerun", "av", "cryptography", "pyarrow", "ruamel", "rclpy"),
    *("asyncio", "concurrent.futures", "http", "sqlite3", "ssl", "urllib.request", "xml"),
    *("igtl_gateway.api", "igtl_gateway.app.bridge", "igtl_gateway.convert.profiles", "igtl_gateway.convert.table"),
    *("igtl_gateway.gateway.core", "igtl_gateway.record.sessionfile.reader", "igtl_gateway.replay"),
)
_PROGRAM = """
import contextlib, io, sys
from igtl_gateway.cli import main
with contextlib.redirect_stdout(io.StringIO()), contextlib.suppress(SystemExit):
    main(sys.argv[1:])
print(*sys.modules, sep="\\n")
"""


def modules_after(*words: str) -> set[str]:
    """The modules of a process of its own that has run a command line."""
    run = subprocess.run([sys.executable, "-c", _PROGRAM, *words], capture_output=True, text=True, check=True)
    return set(run.stdout.split())


@pytest.mark.parametrize("verb", [name for name in available() if own_verb(name) and name not in LABORATORY])
def test_the_help_of_a_verb_imports_nothing_heavy(verb: str) -> None:
    found = modules_after(verb, "--help")
    assert "igtl_gateway.cli.options" in found
    assert sorted(found.intersection(HEAVY)) == []


#: Parts of the program without a use for `info` of a recording that is neither damaged nor sealed nor merged.
UNUSED_BY_INFO = (
    *("igtl_gateway.gateway.dialogue.links", "igtl_gateway.gateway.guard", "igtl_gateway.gateway.to_igtl.tracking"),
    *(f"igtl_gateway.record.sessionfile.{name}" for name in ("salvage", "sealing", "seals", "stream", "writer")),
)


def test_info_of_a_small_recording_imports_only_what_it_uses() -> None:
    found = modules_after("info", str(FIXTURES / "acquisition.mcap"))
    assert "igtl_gateway.record.sessionfile.reader" in found
    assert sorted(found.intersection(UNUSED_BY_INFO)) == []
