"""What the page knows of a bridge: samples that its interface (``live``) sends, in the process of the page."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable, Iterator
from http.client import HTTPException
from typing import Any
from urllib.error import URLError
from urllib.parse import urlencode
from urllib.request import ProxyHandler, Request, build_opener

#: Longest time between two samples, and the time until the next try, seconds.
_PATIENCE_S, _AGAIN_S = 5.0, 0.1
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

    def samples(self) -> Iterator[dict[str, Any]]:
        """Yield what the bridge reports, until it closes the connection.

        Raises OSError, HTTPException or ValueError if it does not answer.
        """
        with self._open(Request(self._url + "/facts", headers=self._headers), timeout=_PATIENCE_S) as answer:
            sample: dict[str, Any] = {}
            for line in answer:
                sample |= json.loads(line)  # a line leaves out what is as it was
                yield dict(sample)

    def picture(self, side: str, stream: str) -> bytes:
        """Return the last picture of a stream as its message; empty if there is none."""
        try:
            return self._read(f"/picture?{urlencode({'side': side, 'stream': stream})}", None, _PATIENCE_S)
        except (OSError, URLError):
            return b""

    def numbers(self, side: str, stream: str) -> dict[str, Any]:
        """Return the messages of a stream since the last call, as ``LiveNumbers.take``; ``problem`` without them."""
        try:
            found = json.loads(self._read(f"/numbers?{urlencode({'side': side, 'stream': stream})}", None, _PATIENCE_S))
        except (OSError, URLError, HTTPException, ValueError):
            return {"messages": [], "problem": "the bridge does not answer"}
        return dict(found)

    def press(self, what: str, line: str, since_ns: int = 0) -> tuple[bool, str]:
        """Have the bridge do something; return whether it did, and a sentence for people.

        Args:
            since_ns: the moment that is marked, on the monotonic clock of this host; 0: now.
        """
        try:
            found = json.loads(self._read("/", _json({"do": what, "line": line, "since_ns": since_ns}), _PRESS_S))
            return bool(found["done"]), str(found["text"])
        except (OSError, URLError, ValueError, KeyError):
            return False, "the bridge does not answer"

    def _read(self, path: str, body: bytes | None, patience_s: float) -> bytes:
        request = Request(self._url + path, data=body, headers=self._headers)
        with self._open(request, timeout=patience_s) as answer:
            data: bytes = answer.read()
        return data


def _json(words: dict[str, str | int]) -> bytes:
    """Return JSON as short as the browser's: other letters must not take more than a request may have."""
    return json.dumps(words, ensure_ascii=False).encode("utf-8", "surrogatepass")


class Poller:
    """A thread that reads a bridge and passes on what it finds, None if the bridge does not answer."""

    def __init__(self, source: BridgeSource, take: Callable[[dict[str, Any] | None], None]) -> None:
        self._source = source
        self._take = take
        self._stopping = threading.Event()
        threading.Thread(target=self._run, name="igtl-page-source", daemon=True).start()

    def close(self) -> None:
        """Read no more."""
        self._stopping.set()

    def _run(self) -> None:
        while not self._stopping.wait(_AGAIN_S):
            try:
                for found in self._source.samples():
                    self._take(found)
                    if self._stopping.is_set():
                        return
            except (OSError, HTTPException, ValueError):
                self._take(None)
