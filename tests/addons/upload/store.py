"""An object store for tests: the requests of an upload, checked, with faults on demand."""

from __future__ import annotations

import base64
import hashlib
import re
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any
from urllib.parse import parse_qs, unquote, urlsplit

#: (method, path, query) → an answer in place of the right one: status, headers, body; None: the right one.
Fault = Callable[[str, str, dict[str, str]], "tuple[int, dict[str, str], bytes] | None"]


class Store:
    """A bucket.

    Attributes:
        objects: key → content and headers.
        uploads: identifier → number → part.
        requests: method, path and query of each request.
        fault: see ``Fault``.
        url: address.
    """

    def __init__(self) -> None:
        self.objects: dict[str, tuple[bytes, dict[str, str]]] = {}
        self.uploads: dict[str, dict[int, bytes]] = {}
        self.meta: dict[str, str] = {}
        self.requests: list[tuple[str, str, dict[str, str]]] = []
        self.received = 0
        self.fault: Fault = lambda _method, _path, _query: None
        self.url = ""

    def answer(
        self, method: str, target: str, headers: dict[str, str], body: bytes
    ) -> tuple[int, dict[str, str], bytes]:
        parts = urlsplit(target)
        path = unquote(parts.path)
        query = {key: value[0] for key, value in parse_qs(parts.query, keep_blank_values=True).items()}
        self.requests.append((method, path, query))
        self.received += len(body)
        assert "AWS4-HMAC-SHA256 Credential=key/" in headers["authorization"]
        assert headers["x-amz-content-sha256"] == hashlib.sha256(body).hexdigest()
        if given := headers.get("x-amz-checksum-sha256"):
            assert given == base64.b64encode(hashlib.sha256(body).digest()).decode()
        if found := self.fault(method, path, query):
            return found
        key = path.removeprefix("/bucket/")
        return self._right(method, key, query, headers, body)

    def _right(
        self, method: str, key: str, query: dict[str, str], headers: dict[str, str], body: bytes
    ) -> tuple[int, dict[str, str], bytes]:
        upload = query.get("uploadId", "")
        if upload and upload not in self.uploads:
            return 404, {}, b"<Error><Code>NoSuchUpload</Code></Error>"
        meta = {"x-amz-meta-sha256": headers.get("x-amz-meta-sha256", "")}
        match method, sorted(query):
            case "HEAD", []:
                if key not in self.objects:
                    return 404, {}, b""
                data, more = self.objects[key]
                return 200, more | {"content-length": str(len(data))}, b""
            case "PUT", []:
                if key in self.objects:
                    return 412, {}, b"<Error><Code>PreconditionFailed</Code></Error>"
                self.objects[key] = body, meta | {"etag": f'"{_md5(body).hex()}"'}
            case "POST", ["uploads"]:
                name = f"upload-{len(self.uploads) + 1}"
                self.uploads[name], self.meta[name] = {}, meta["x-amz-meta-sha256"]
                return 200, {}, f"<X><UploadId>{name}</UploadId></X>".encode()
            case "PUT", ["partNumber", "uploadId"]:
                self.uploads[upload][int(query["partNumber"])] = body
                return 200, {"etag": f'"{_md5(body).hex()}"'}, b""
            case "GET", ["part-number-marker", "uploadId"]:
                after = int(query["part-number-marker"])
                rows = sorted(row for row in self.uploads[upload].items() if row[0] > after)
                text = "".join(
                    f"<Part><PartNumber>{number}</PartNumber><ETag>&quot;{_md5(data).hex()}&quot;</ETag>"
                    f"<Size>{len(data)}</Size></Part>"
                    for number, data in rows[:2]
                )
                more_rows = f"<IsTruncated>{'true' if rows[2:] else 'false'}</IsTruncated>"
                marker = f"<NextPartNumberMarker>{rows[:2][-1][0]}</NextPartNumberMarker>" if rows else ""
                return 200, {}, f"<X>{more_rows}{marker}{text}</X>".encode()
            case "POST", ["uploadId"]:
                if key in self.objects:
                    return 412, {}, b"<Error><Code>PreconditionFailed</Code></Error>"
                numbers = [int(number) for number in re.findall(rb"<PartNumber>(\d+)<", body)]
                parts = [self.uploads[upload][number] for number in numbers]
                tag = f'"{_md5(b"".join(map(_md5, parts))).hex()}-{len(parts)}"'
                self.objects[key] = b"".join(parts), {"etag": tag, "x-amz-meta-sha256": self.meta[upload]}
                del self.uploads[upload]
            case "DELETE", ["uploadId"]:
                del self.uploads[upload]
                return 204, {}, b""
            case _:
                return 400, {}, b""
        return 200, {}, b""


def _md5(data: bytes) -> bytes:
    return hashlib.md5(data, usedforsecurity=False).digest()


@contextmanager
def running_store() -> Iterator[Store]:
    """Context manager: a store that listens."""
    store = Store()

    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def _handle(self) -> None:
            body = self.rfile.read(int(self.headers.get("content-length", "0")))
            headers = {name.lower(): value for name, value in self.headers.items()}
            assert len(headers) == len(self.headers.items()) and "accept-encoding" not in headers
            status, more, data = store.answer(self.command, self.path, headers, body)
            self.send_response(status)
            for name, value in ({"content-length": str(len(data))} | more).items():
                self.send_header(name, value)
            self.end_headers()
            if self.command != "HEAD":
                self.wfile.write(data)

        do_GET = do_HEAD = do_PUT = do_POST = do_DELETE = _handle  # noqa: N815  # names of the library

        def log_message(self, format: str, *args: Any) -> None:
            """Nothing."""

    class Server(ThreadingHTTPServer):
        daemon_threads = True

        def handle_error(self, request: Any, client_address: Any) -> None:
            """Nothing: clients are killed."""

    server = Server(("127.0.0.1", 0), Handler)
    store.url = f"http://127.0.0.1:{server.server_address[1]}"
    thread = threading.Thread(target=server.serve_forever, args=(0.02,), daemon=True)
    thread.start()
    try:
        yield store
    finally:
        server.shutdown()
        thread.join()
        server.server_close()
