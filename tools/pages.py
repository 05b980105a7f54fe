"""Tables that a tool measures and writes into a page itself, below a heading of that page."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
_AUTOGROUP, _FIRST = Path("/proc/self/autogroup"), -18


def write(page: str, heading: str, tool: str, note: str, lines: Sequence[str]) -> None:
    """Replace the table of a tool below a heading of a page; ``note``: how it was measured.  Raises ValueError."""
    path = ROOT / page
    text = path.read_text()
    begin = text.find(f"\n{heading}\n")
    found = re.compile(rf"<!-- measured by {re.escape(tool)}.*?<!-- end of {re.escape(tool)} -->", re.DOTALL).search(
        text, max(begin, 0)
    )
    if begin < 0 or found is None:
        raise ValueError(f"{page}: found no table of {tool} below {heading!r}, expected one to replace")
    table = "\n".join((f"<!-- measured by {tool}: {note} -->", "", *lines, "", f"<!-- end of {tool} -->"))
    path.write_text(text[: found.start()] + table + text[found.end() :])
    print(f"written to {page}, {heading.lstrip('# ')}")


def go_first() -> bool:
    """Have this session's programs run before those of other sessions, where Linux allows it; whether it does."""
    with suppress(OSError):
        _AUTOGROUP.write_text(str(_FIRST))
        return True
    return False


class Load:
    """The load of the machine while something is measured: least and most of the last minute."""

    def __init__(self) -> None:
        self._seen: list[float] = []
        self.look()

    def look(self) -> None:
        self._seen.append(os.getloadavg()[0])

    def __str__(self) -> str:
        return f"load {min(self._seen):.0f} to {max(self._seen):.0f} on {os.cpu_count()} cores"
