"""The verbs of ``igtl-gateway`` as executables: ``ros2 run igtl_gateway bridge`` is ``igtl-gateway bridge``."""

from __future__ import annotations

import sys
from pathlib import Path

MISSING = (
    "igtl_gateway: found no Python distribution igtl-gateway for {python}, expected it in this environment; "
    "install it: {python} -m pip install igtl-gateway"
)


def main() -> int:
    """Run the verb that has the name of this executable; returns its exit code."""
    try:
        from igtl_gateway.cli import main as run
    except ModuleNotFoundError as error:
        if (error.name or "").partition(".")[0] != "igtl_gateway":
            raise
        print(MISSING.format(python=sys.executable), file=sys.stderr)  # noqa: T201
        return 1
    return run([Path(sys.argv[0]).name, *sys.argv[1:]])
