"""A real Chromium without a screen, driven over its debugging pipe: keys, clicks, pictures."""

from __future__ import annotations

import base64
import json
import os
import shutil
import subprocess
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from types import TracebackType
from typing import Any

from igtl_gateway.base.versions import Self

_OPTIONS = (
    "--headless=new",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-dev-shm-usage",
    "--disable-background-networking",
    "--no-first-run",
    "--hide-scrollbars",
    "--remote-debugging-pipe",
    "about:blank",
)
_KEYS = {"Enter": 13, "Escape": 27, "Tab": 9, "ArrowRight": 39, "ArrowLeft": 37, "Home": 36}
#: Far longer than anything takes here, also beside twenty busy programs: reaching it is a failure, not a measurement.
WAIT_S = 90.0
CHROMIUM = shutil.which("chromium") or shutil.which("google-chrome")


class Browser:
    """A browser with one page; a context manager.

    Args:
        size: width and height of the page, pixels.
        dark: whether the system has dark colours.
    """

    def __init__(self, size: tuple[int, int] = (1280, 800), *, dark: bool = False) -> None:
        assert CHROMIUM, "found no Chromium"
        self._folder = tempfile.TemporaryDirectory()
        to_read, self._write = os.pipe()
        self._read, to_write = os.pipe()
        self._process = subprocess.Popen(
            [
                *("bash", "-c", f'exec "$@" 3<&{to_read} 4>&{to_write}', "-"),
                *(CHROMIUM, f"--user-data-dir={self._folder.name}", *_OPTIONS),
            ],
            pass_fds=(to_read, to_write),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        os.close(to_read)
        os.close(to_write)
        self._number = 0
        self._rest = b""
        self._session = ""
        self.complaints: list[str] = []
        (page,) = (one for one in self.call("Target.getTargets")["targetInfos"] if one["type"] == "page")
        self._session = self.call("Target.attachToTarget", targetId=page["targetId"], flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Log"):
            self.call(f"{domain}.enable")
        self.look(size, dark=dark)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        os.close(self._write)
        try:
            self._process.wait(5)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        os.close(self._read)
        self._folder.cleanup()

    def call(self, method: str, **parameters: Any) -> Any:
        """Call a method of the protocol and return its result."""
        self._number += 1
        words = {"id": self._number, "method": method, "params": parameters}
        os.write(
            self._write, json.dumps(words | ({"sessionId": self._session} if self._session else {})).encode() + b"\0"
        )
        while True:
            found = self._message()
            if found.get("id") == self._number:
                assert "error" not in found, f"{method}: {found['error']}"
                return found["result"]

    def _message(self) -> Mapping[str, Any]:
        while b"\0" not in self._rest:
            data = os.read(self._read, 1 << 20)
            assert data, "the browser has ended"
            self._rest += data
        line, _, self._rest = self._rest.partition(b"\0")
        found: dict[str, Any] = json.loads(line)
        match found.get("method"):
            case "Runtime.exceptionThrown":
                details = found["params"]["exceptionDetails"]
                self.complaints.append(details.get("exception", {}).get("description", details["text"]))
            case "Log.entryAdded" if found["params"]["entry"]["level"] == "error":
                self.complaints.append(f"{found['params']['entry']['text']} {found['params']['entry'].get('url', '')}")
        return found

    def look(self, size: tuple[int, int], *, dark: bool = False, touch: bool = False) -> None:
        """Set the size of the page and its colours."""
        width, height = size
        self.call("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=touch)
        scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        self.call("Emulation.setEmulatedMedia", features=[scheme])

    def open(self, url: str) -> None:
        """Go to an address."""
        self.call("Page.navigate", url=url)

    def run(self, program: str) -> Any:
        """Run a program in the page; return its value."""
        found = self.call("Runtime.evaluate", expression=program, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in found, found["exceptionDetails"]
        return found["result"].get("value")

    def wait(self, program: str, timeout_s: float = WAIT_S) -> None:
        """Wait until an expression is true in the page."""
        until = time.monotonic() + timeout_s
        while not self.run(f"(() => {{ try {{ return Boolean({program}) }} catch {{ return false }} }})()"):
            assert time.monotonic() < until, f"not within {timeout_s} s: {program}\n{self.text()}\n{self.complaints}"
            time.sleep(0.05)

    def wait_for(self, condition: Callable[[], bool], what: str, timeout_s: float = WAIT_S) -> None:
        """Wait until something is so outside of the page."""
        until = time.monotonic() + timeout_s
        while not condition():
            assert time.monotonic() < until, f"not within {timeout_s} s: {what}\n{self.text()}"
            time.sleep(0.05)

    def text(self) -> str:
        """The text that a person sees."""
        return str(self.run("document.body?.innerText ?? ''"))

    def click(self, selector: str, text: str = "", hold: str = "true") -> None:
        """Click on the middle of an element: the first of a selector, with this text if there is one.

        The button of the mouse stays pressed until the expression ``hold`` is true.
        """
        find = (
            f"[...document.querySelectorAll({json.dumps(selector)})].find((each) => "
            f"each.offsetParent && each.innerText.includes({json.dumps(text)}) && !each.disabled)"
        )
        self.wait(f"Boolean({find})")
        x, y = self.run(
            f"(() => {{ const it = {find}; it.scrollIntoView({{block: 'center'}}); const box = "
            "it.getBoundingClientRect(); return [box.x + box.width / 2, box.y + box.height / 2] })()"
        )
        for kind in ("mousePressed", "mouseReleased"):
            self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=1)
            self.wait(hold if kind == "mousePressed" else "true")

    def type(self, text: str) -> None:
        """Type text into what has the focus."""
        self.call("Input.insertText", text=text)

    def press(self, key: str) -> None:
        """Press a key."""
        words: dict[str, Any] = {"key": key, "windowsVirtualKeyCode": _KEYS.get(key, ord(key[0].upper()))}
        if len(key) == 1:
            words["text"] = key
        if key == "Enter":
            words["text"] = "\r"
        for kind in ("keyDown", "keyUp"):
            self.call("Input.dispatchKeyEvent", type=kind, **(words if kind == "keyDown" else words | {"text": ""}))

    def picture(self, path: Path) -> None:
        """Write what the page shows as PNG."""
        path.write_bytes(base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"]))


@contextmanager
def site(files: Mapping[str, Path]) -> Iterator[int]:
    """Serve these files by their names, and the first one also without one, so that a page has fine clocks.

    Yields the port of 127.0.0.1.
    """
    first = next(iter(files.values()))

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            path = files.get(self.path.partition("?")[0].strip("/"), first)
            data = path.read_bytes()
            self.send_response(200)
            self.send_header("Content-Type", "text/javascript" if path.suffix == ".mjs" else "text/html")
            self.send_header("Content-Length", str(len(data)))
            self.send_header("Cross-Origin-Opener-Policy", "same-origin")
            self.send_header("Cross-Origin-Embedder-Policy", "require-corp")
            self.end_headers()
            self.wfile.write(data)

        def log_message(self, *_: Any) -> None:
            """Requests are not of interest."""

    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            yield server.server_port
        finally:
            server.shutdown()
            thread.join()
