"""A file of a real web server, read by ranges, and servers that send something else."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import pytest

from igtl_gateway.base.errors import DamagedRecording, UnsupportedRecording
from igtl_gateway.record.sessionfile.remote import RemoteFile, is_url
from tests.tables import table

DATA = bytes(range(256)) * 4


class _Handler(BaseHTTPRequestHandler):
    def do_GET(self) -> None:
        begin, end = (int(word) for word in self.headers["Range"].removeprefix("bytes=").split("-"))
        data, size = DATA[begin : end + 1], str(len(DATA))
        kind = self.path.strip("/")
        if kind in ("404", "416", "500"):
            return self.send_error(int(kind))
        if begin and kind == "short":
            data = data[:-1]
        if begin and kind == "grown":
            size = "2000"
        self.send_response(200 if kind == "whole" else 206)
        if kind != "bare":
            self.send_header("Content-Range", f"bytes {begin}-{end}/{'*' if kind == 'unknown' else size}")
        self.send_header("Content-Length", str(len(data)))
        self.end_headers()
        self.wfile.write(data)
        return None

    def log_message(self, *_: object) -> None:
        """Nothing."""


@contextmanager
def serving() -> Iterator[str]:
    with ThreadingHTTPServer(("127.0.0.1", 0), _Handler) as server:
        thread = threading.Thread(target=server.serve_forever, args=(0.01,))
        thread.start()
        try:
            yield f"http://127.0.0.1:{server.server_address[1]}"
        finally:
            server.shutdown()
            thread.join()


@table(
    "path, expected",
    [
        ("http://a/b.mcap", True),
        ("HTTPS://a/b.mcap", True),
        ("s3://a/b.mcap", False),
        ("http:/a", False),
        ("http", False),
        ("a.mcap", False),
    ],
)
def test_what_is_a_url(path: str, expected: bool) -> None:
    assert is_url(path) is expected


def test_the_bytes_of_a_file() -> None:
    with serving() as url, RemoteFile(f"{url}/a") as file:
        assert file.seek(0, 2) == len(DATA)
        file.seek(300)
        assert file.read(10) == DATA[300:310]
        assert file.fetch(5, 3) == DATA[5:8]


@table(
    "kind, words",
    [
        ("404", "404 Not Found"),
        ("500", "500 Internal Server Error"),
        ("whole", r"without ranges \(status 200\)"),
        ("bare", r"without ranges \(status 206\)"),
        ("unknown", r"without ranges \(status 206\)"),
    ],
)
def test_a_server_without_the_file_or_ranges_is_refused(kind: str, words: str) -> None:
    with serving() as url, pytest.raises(UnsupportedRecording, match=words):
        RemoteFile(f"{url}/{kind}")


def test_a_file_of_no_bytes() -> None:
    with serving() as url, RemoteFile(f"{url}/416") as file:
        assert file.seek(0, 2) == 0


@table(
    "kind, words",
    [("short", "found 9 bytes of 1024 at 100, expected 10 of 1024"), ("grown", "found 10 bytes of 2000 at 100")],
)
def test_other_bytes_than_asked_for_are_damage(kind: str, words: str) -> None:
    with serving() as url, RemoteFile(f"{url}/{kind}") as file, pytest.raises(DamagedRecording, match=words):
        file.fetch(100, 10)


def test_a_server_that_has_gone_is_damage() -> None:
    with serving() as url:
        file = RemoteFile(f"{url}/a")
    with file, pytest.raises(DamagedRecording, match="refused"):
        file.fetch(100, 10)
