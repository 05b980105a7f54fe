from __future__ import annotations

import json
import socket
import ssl
from collections.abc import Iterator
from typing import Any
from urllib.parse import urlsplit
from urllib.request import urlopen

import pytest

from igtl_gateway.addons.page.server import PageServer
from igtl_gateway.edges.tcp.tls import TlsFiles
from tests.addons.page.hostile_browsers import BEGIN, CASES, END, PAGE, SPECTATOR, TOKEN, Case, table
from tests.places import PEMS
from tests.timing import WAIT_S, at_once


class Fake:
    """A page that only remembers what was pressed."""

    def __init__(self) -> None:
        self.pressed: list[str] = []

    def state(self) -> tuple[int, bytes]:
        return 7, b'{"a":1}'

    def sessions(self) -> list[dict[str, Any]]:
        return []

    def plot(self, name: str, key: str, field: str) -> dict[str, Any] | None:
        return {"name": name, "stream": key, "field": field}

    def places(self, name: str) -> dict[str, Any] | None:
        return None

    def curve(self, side: str, stream: str, field: str) -> dict[str, Any] | None:
        return None

    def lines(self, job: int) -> list[str]:
        return []

    def picture(self, side: str, stream: str) -> bytes:
        return b"not a message"

    def act(self, what: str, words: dict[str, Any]) -> tuple[bool, str]:
        self.pressed.append(what)
        return False, "no"


@pytest.fixture
def page() -> Iterator[tuple[PageServer, Fake]]:
    fake = Fake()
    server = PageServer("127.0.0.1", 0, fake)
    yield server, fake
    server.close()


def request(server: PageServer, case: Case) -> tuple[int, dict[str, str], bytes]:
    """Play a case; return code, headers and body of the answer."""
    place = urlsplit(server.link)
    tokens = {"token": place.query.partition("=")[2], "spectator": server.spectators.partition("=")[2]}
    tokens |= {"name": f"igtl_page_{place.port}"}
    headers: dict[str, str | None] = {"Host": place.netloc, "Cookie": f"{{name}}={TOKEN}"}
    method = "GET"
    if case.body is not None:
        method = "POST"
        headers |= {"Origin": f"http://{place.netloc}", "Content-Type": "application/json"}
        headers |= {"Content-Length": str(len(case.body))}
    headers |= case.headers
    method = headers.pop(":method", None) or method
    lines = [f"{method} {case.path} HTTP/1.1"]
    lines += [f"{name}: {value.format(**tokens)}" for name, value in headers.items() if value is not None]
    assert place.port
    with socket.create_connection((place.hostname, place.port), 10) as sock:
        sock.sendall("\r\n".join([*lines, "", ""]).encode() + (case.body or b""))
        data = b""
        while piece := sock.recv(1 << 16):
            data += piece
    head, _, body = data.partition(b"\r\n\r\n")
    first, *fields = head.decode().split("\r\n")
    found = {name.lower(): value for name, _, value in (each.partition(": ") for each in fields)}
    return int(first.split()[1]), found, body


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.what)
def test_hostile_browsers(page: tuple[PageServer, Fake], case: Case) -> None:
    server, fake = page
    assert request(server, case)[0] == case.answer
    assert fake.pressed in ([], ["job"])
    assert request(server, Case("a good one", 200, "/api/state", body=None))[2] == b'{"a":1}'


def test_the_link_sets_a_cookie_that_scripts_cannot_read(page: tuple[PageServer, Fake]) -> None:
    server, fake = page
    opened = Case("opens the link", 200, f"/?{urlsplit(server.link).query}", {"Cookie": None}, None)
    code, headers, body = request(server, opened)
    assert code == 200 and b"<!doctype html>" in body
    assert headers["set-cookie"].endswith("; Path=/; HttpOnly; SameSite=Strict")
    assert "default-src 'none'" in headers["content-security-policy"]
    assert headers["referrer-policy"] == "no-referrer" and headers["cache-control"] == "no-store"
    assert request(server, Case("presses", 200))[0] == 200
    assert fake.pressed == ["stop"]


def test_spectators_see_the_same(page: tuple[PageServer, Fake]) -> None:
    server, _ = page
    cookie: dict[str, str | None] = {"Cookie": f"{{name}}={SPECTATOR}"}
    code, headers, _ = request(server, Case("reads", 200, "/api/state", cookie, None))
    assert (code, headers["page-role"]) == (200, "spectator")
    code, _, body = request(server, Case("presses", 403, headers=cookie))
    assert json.loads(body) == {"done": False, "text": "this link is read-only"}


def test_a_known_state_is_not_sent_again(page: tuple[PageServer, Fake]) -> None:
    server, _ = page
    code, headers, body = request(server, Case("reads", 200, "/api/state?known=7", body=None))
    assert (code, headers["page-version"], body) == (200, "7", b"")


def test_what_is_no_picture_is_not_shown(page: tuple[PageServer, Fake]) -> None:
    server, _ = page
    assert request(server, Case("reads", 404, "/api/picture?side=igtl_in&stream=IMAGE/a", body=None))[0] == 404


def test_silent_browsers_do_not_keep_others_out(page: tuple[PageServer, Fake]) -> None:
    server, _ = page
    place = urlsplit(server.link)
    assert place.port
    silent = [socket.create_connection((place.hostname, place.port), 10) for _ in range(100)]
    with at_once():
        assert request(server, Case("a good one", 200, "/api/state", body=None))[0] == 200
    for each in silent:
        each.close()


def test_the_table_is_in_the_documents() -> None:
    assert PAGE.read_text("utf-8").partition(BEGIN)[2].partition(END)[0] == table()


def test_the_link_of_all_networks_has_the_name_of_this_machine() -> None:
    server = PageServer("0.0.0.0", 0, Fake(), allow=("10.0.0.0/8",))
    try:
        assert urlsplit(server.link).hostname == socket.gethostname().lower()
    finally:
        server.close()


def test_tls() -> None:
    server = PageServer("127.0.0.1", 0, Fake(), tls=TlsFiles(PEMS / "server.pem"))
    try:
        assert server.link.startswith("https://")
        context = ssl.create_default_context()
        context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
        with urlopen(server.link, context=context, timeout=WAIT_S) as answer:
            assert answer.headers["Set-Cookie"].endswith("; Secure")
        place = urlsplit(server.link)
        assert place.port
        with socket.create_connection((place.hostname, place.port), 10) as plain:
            plain.sendall(b"GET / HTTP/1.1\r\n\r\n")
            assert not plain.recv(100).startswith(b"HTTP")
    finally:
        server.close()
