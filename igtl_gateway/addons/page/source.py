"""What the page knows of a bridge: read twice a second by its interface (``live``), in the process of the page."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable
from typing import Any
from urllib.error import URLError
from urllib.parse import urlencode
from urllib.request import ProxyHandler, Request, build_opener

#: Interval of the reading, and the longest time of one, seconds.
EVERY_S, _PATIENCE_S = 0.5, 5.0
_PRESS_S = 90.0


class BridgeSource:
    """The interface of a bridge.

    Args:
        url: of the interface.
        token: that the interface expects.
    """

    def __init__(self, url: str, token: str) -> None:
        self._url = url
        self._headers = {"Authorization": f"Bearer {token}", "Content-Type": "application/json"}
        self._open = build_opener(ProxyHandler({})).open  # the bridge is here, whatever the environment has

    def facts(self) -> dict[str, Any] | None:
        """Return what the bridge reports; None if it does not answer."""
        try:
            found = json.loads(self._read("/facts", None, _PATIENCE_S))
        except (OSError, URLError, ValueError):
            return None
        return found if isinstance(found, dict) else None

    def picture(self, side: str, stream: str) -> bytes:
        """Return the last picture of a stream as its message; empty if there is none."""
        try:
            return self._read(f"/picture?{urlencode({'side': side, 'stream': stream})}", None, _PATIENCE_S)
        except (OSError, URLError):
            return b""

    def press(self, what: str, line: str) -> tuple[bool, str]:
        """Have the bridge do something; return whether it did, and a sentence for people."""
        try:
            found = json.loads(self._read("/", _json({"do": what, "line": line}), _PRESS_S))
            return bool(found["done"]), str(found["text"])
        except (OSError, URLError, ValueError, KeyError):
            return False, "the bridge does not answer"

    def _read(self, path: str, body: bytes | None, patience_s: float) -> bytes:
        request = Request(self._url + path, data=body, headers=self._headers)
        with self._open(request, timeout=patience_s) as answer:
            data: bytes = answer.read()
        return data


def _json(words: dict[str, str]) -> bytes:
    """Return JSON as short as the browser's: other letters must not take more than a request may have."""
    return json.dumps(words, ensure_ascii=False).encode("utf-8", "surrogatepass")


class Poller:
    """A thread that reads a bridge and passes on what it finds, None if the bridge does not answer."""

    def __init__(self, source: BridgeSource, take: Callable[[dict[str, Any] | None], None]) -> None:
        self._source = source
        self._take = take
        self._woken, self._stopping = threading.Event(), False
        threading.Thread(target=self._run, name="igtl-page-source", daemon=True).start()

    def close(self) -> None:
        """Read no more."""
        self._stopping = True
        self._woken.set()

    def wake(self) -> None:
        """Read at once."""
        self._woken.set()

    def _run(self) -> None:
        while not self._stopping:
            self._take(self._source.facts())
            self._woken.wait(EVERY_S)
            self._woken.clear()
