"""The one place where the command line prints: no text of others reaches the terminal without its guard."""

from __future__ import annotations

import sys
from typing import Any

from igtl_gateway.untrusted.text import json_line, printable


def print_json(value: Any) -> None:
    """One JSON object on one line, at once."""
    print(json_line(value), flush=True)


def say(*lines: str, error: bool = False) -> None:
    """Print lines, each as one line whatever foreign text is in it: to stdout, or to stderr for an ``error``."""
    for line in lines or ("",):
        print(printable(line), file=sys.stderr if error else sys.stdout)
