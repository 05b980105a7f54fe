"""A tiny S3 on this machine, with the faults of a real one."""

from __future__ import annotations

import hashlib
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from urllib.parse import unquote, urlsplit
from xml.sax.saxutils import escape


class Bucket(ThreadingHTTPServer):
    """A server of one bucket.

    Attributes:
        objects: name → content.
        sent: bytes of bodies.
        fault: called with the handler before each answer; True if it has answered.
    """

    daemon_threads = True

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), _Handler)
        self.objects: dict[str, bytes] = {}
        self.sent = self.reads = 0
        self.fault: Callable[[_Handler], bool] = lambda handler: False


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    server: Bucket

    def log_message(self, *_: object) -> None:
        pass

    def do_HEAD(self) -> None:
        self.do_GET()

    def do_GET(self) -> None:
        url = urlsplit(self.path)
        name = unquote(url.path).removeprefix("/bucket").lstrip("/")
        if "list-type=2" in url.query:
            self.answer(200, _listing(self.server.objects))
        elif name not in self.server.objects:
            self.answer(404, b"")
        else:
            self._object(self.server.objects[name])

    def _object(self, data: bytes) -> None:
        if self.command == "GET":
            self.server.reads += 1
            if self.server.fault(self):
                return
        tag = tag_of(data)
        wanted = self.headers.get("If-Match")
        if wanted not in (None, tag):
            self.answer(412, b"")
            return
        span = self.headers.get("Range", "")
        if not span:
            self.answer(200, data, tag)
            return
        first, last = (int(each) for each in span.removeprefix("bytes=").split("-"))
        part = data[first : last + 1]
        self.answer(206, part, tag, f"bytes {first}-{first + len(part) - 1}/{len(data)}")

    def answer(self, status: int, body: bytes, tag: str = "", span: str = "", cut: int = 0) -> None:
        """Send an answer, of which the last ``cut`` bytes are missing."""
        self.send_response(status)
        self.send_header("Content-Length", str(len(body)))
        self.send_header("Last-Modified", "Thu, 01 Jan 2026 00:00:00 GMT")
        if tag:
            self.send_header("ETag", tag)
        if span:
            self.send_header("Content-Range", span)
        self.end_headers()
        if self.command == "GET":
            self.server.sent += len(body)
            self.wfile.write(body[: len(body) - cut])
        if cut:
            self.close_connection = True


def tag_of(data: bytes) -> str:
    """The entity tag of a content."""
    return f'"{hashlib.md5(data, usedforsecurity=False).hexdigest()}"'


def wait(seconds: float) -> Callable[[_Handler], bool]:
    """A fault: the answer comes late."""

    def fault(handler: _Handler) -> bool:
        time.sleep(seconds)
        return False

    return fault


def refuse(handler: _Handler) -> bool:
    """A fault: 500."""
    handler.answer(500, b"<Error><Message>down</Message></Error>")
    return True


def cut(handler: _Handler) -> bool:
    """A fault: the connection ends before the body does."""
    data = next(iter(handler.server.objects.values()))
    first, last = (int(each) for each in handler.headers["Range"].removeprefix("bytes=").split("-"))
    part = data[first : last + 1]
    handler.answer(206, part, tag_of(data), f"bytes {first}-{first + len(part) - 1}/{len(data)}", cut=len(part) // 2)
    return True


def _listing(objects: dict[str, bytes]) -> bytes:
    rows = "".join(
        f"<Contents><Key>{escape(name)}</Key><LastModified>2026-01-01T00:00:00.000Z</LastModified>"
        f"<ETag>{escape(tag_of(data))}</ETag><Size>{len(data)}</Size></Contents>"
        for name, data in sorted(objects.items())
    )
    text = f"<ListBucketResult><Name>bucket</Name><IsTruncated>false</IsTruncated>{rows}</ListBucketResult>"
    return text.encode()


@contextmanager
def bucket() -> Iterator[Bucket]:
    """Context manager: a running server."""
    with Bucket() as server:
        thread = threading.Thread(target=server.serve_forever, args=(0.05,), daemon=True)
        thread.start()
        try:
            yield server
        finally:
            server.shutdown()
            thread.join()
