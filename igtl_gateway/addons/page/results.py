"""What work on recordings has found, kept beside them: whether each was verified, sealed as stated, reviewed.

A result is of the bytes that were there: it holds for a name, a size and a time of change.  The hidden file in the
folder outlives the page; where the folder cannot be written, the results last as long as the page.
"""

from __future__ import annotations

import json
import threading
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from igtl_gateway.addon import GatewayError
from igtl_gateway.addon.untrusted import open_file, parse_json
from igtl_gateway.addon.writing import write_text, written

NAME = ".igtl-gateway-page.json"
#: Bytes that are read, and recordings with results.
_MAX_BYTES, _MAX_KEPT = 1 << 20, 2_000
#: Size in bytes, and time of change in ns.
Mark = tuple[int, int]


def keep_newest(found: dict[Any, Any], most: int) -> None:
    """Forget what came first into a dictionary, beyond this number of keys."""
    while len(found) > most:
        del found[next(iter(found))]


class Results:
    """The results of a folder; any thread may use it.

    Args:
        folder: of the recordings; None: there is none.
    """

    def __init__(self, folder: Path | None) -> None:
        self._path = folder / NAME if folder else None
        self._lock = threading.Lock()
        self._of: dict[str, tuple[Mark, dict[str, str]]] = _read(self._path) if self._path else {}

    def of(self, name: str, mark: Mark) -> dict[str, str]:
        """Return action → result of a recording that is as it was then."""
        with self._lock:
            known, results = self._of.get(name, (mark, {}))
            return dict(results) if known == mark else {}

    def add(self, name: str, mark: Mark, action: str, result: str) -> None:
        """Keep a result."""
        with self._lock:
            known, results = self._of.pop(name, (mark, {}))
            self._of[name] = mark, (results if known == mark else {}) | {action: result}
            keep_newest(self._of, _MAX_KEPT)
            words = {each: {"mark": mark, "results": found} for each, (mark, found) in self._of.items()}
            if self._path:
                with suppress(GatewayError, OSError), written(self._path, overwrite=True) as path:
                    write_text(path, json.dumps(words))


def _read(path: Path) -> dict[str, tuple[Mark, dict[str, str]]]:
    """Return what a file has; nothing of one that is not ours."""
    try:
        with open_file(path) as file:
            found = parse_json(file.read(_MAX_BYTES).decode(), str(path))
    except (GatewayError, OSError, ValueError):
        return {}
    rows = found.items() if isinstance(found, Mapping) else ()
    return {name: one for name, row in rows if (one := _row(row))}


def _row(row: Any) -> tuple[Mark, dict[str, str]] | None:
    match row:
        case {"mark": [int(size), int(time_ns)], "results": dict(results)}:
            return (size, time_ns), {str(action): str(result) for action, result in results.items()}
    return None
