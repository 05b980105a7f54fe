"""Views in a real browser whose program is a table of facts: what a person sees of what is rare."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import closing, contextmanager
from typing import Any

import pytest

from igtl_gateway.addons.page.server import PageServer
from tests.addons.page.browser import CHROMIUM, Browser

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="needs a Chromium: apt-get install chromium")
_LINK = "http://127.0.0.1:9876/?url=rerun"
_OLD = {"name": "old.mcap", "bytes": 1_000, "modified_ns": 1, "read": True, "closed": True, "start_ns": 1, "streams": 3}


class Facts:
    """A page of a folder with a recording that was read, one that was not, and a viewer that runs."""

    def __init__(self) -> None:
        self._asked = 0

    def state(self) -> bytes:
        job = {"number": 1, "action": "view", "name": "old.mcap", "state": "running", "seconds": 1.0, "last": ""}
        facts = {"has_bridge": False, "answers": False, "bridge": None, "wrong": 0, "folder": "/data", "version": "0"}
        return json.dumps(facts | {"jobs": [job | {"link": _LINK}], "replay": None}).encode()

    def version(self) -> int:
        self._asked += 1
        return self._asked

    def sessions(self) -> list[dict[str, Any]]:
        late = {"name": "late.mcap", "bytes": 9, "modified_ns": 2, "read": True, "unread": 1, "results": {}}
        read = {"duration_s": 4.0, "marks": [], "sealed": False, "results": {}}
        return [_OLD | read, late | {"problem": "cannot be read within 30 s"}]

    def places(self, name: str) -> dict[str, Any] | None:
        return {"places": []}

    def lines(self, job: int) -> list[str]:
        return []

    def picture(self, side: str, stream: str) -> bytes:
        return b""

    def act(self, what: str, words: dict[str, Any]) -> tuple[bool, str]:
        return False, "no"


@contextmanager
def shown(host: str) -> Iterator[Browser]:
    with closing(PageServer(host, 0, Facts())) as server, Browser() as page:
        page.open(server.link)
        page.click("nav button", "Sessions")
        yield page
        assert page.complaints == []


def test_a_recording_that_was_not_read_stays_chosen() -> None:
    with shown("127.0.0.1") as page:
        page.wait("document.querySelector('#sessions table').textContent.includes('not read')")
        page.click("button.link", "late.mcap")
        page.click("button", "Replay …")
        page.run("window.versions = new Set()")
        page.wait("versions.add(known).size >= 4")  # it is drawn again and again
        assert page.run("document.querySelector('[data-key=choose]').value") == "late.mcap"
        assert "late.mcap (not read)" in page.run("document.querySelector('[data-key=choose]').innerText")
        assert "Late.mcap cannot be read within 30 s." in page.text()


@pytest.mark.parametrize(("host", "is_here"), [("127.0.0.1", True), ("127.0.0.2", False)])
def test_the_link_of_a_viewer_is_for_its_own_machine(host: str, is_here: bool) -> None:
    with shown(host) as page:
        page.wait("document.querySelector('#sessions .jobs')")
        found = page.run("[...document.querySelectorAll('.jobs a')].map((each) => each.href)")
        assert found == ([_LINK] if is_here else [])
        sentence = f"The viewer listens only on the machine that has the recordings: there, open {_LINK}"
        assert (sentence in page.text()) is not is_here
