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

_SENDS = {"names": ["TRANSFORM/b"], "number": 1, "why": "the recorded bytes", "stay": ["TRANSFORM/a"], "staying": 1}
_NOTHING = {"names": [], "number": 0, "why": "", "stay": [], "staying": 0}


class Facts:
    """A page of a folder with a recording that was read, one that was not, and a viewer that runs."""

    def __init__(self, more: dict[str, Any]) -> None:
        self._asked = 0
        self.more = more

    def state(self) -> tuple[int, bytes]:
        self._asked += 1
        job = {"number": 1, "action": "view", "name": "old.mcap", "state": "running", "seconds": 1.0, "last": ""}
        facts = {"has_bridge": False, "answers": False, "bridge": None, "wrong": 0, "folder": "/data", "version": "0"}
        return self._asked, json.dumps(facts | {"jobs": [job | {"link": _LINK}], "replay": None} | self.more).encode()

    def sessions(self) -> list[dict[str, Any]]:
        late = {"name": "late.mcap", "bytes": 9, "modified_ns": 2, "read": True, "unread": 1, "results": {}}
        read = {
            "duration_s": 4.0,
            "marks": [],
            "sealed": False,
            "results": {},
            "sends": {"igtl": _SENDS, "igtl both": _SENDS | {"staying": 0}, "ros": _NOTHING},
        }
        busy = {"name": "busy.mcap", "bytes": 9, "modified_ns": 2, "read": False, "reading_s": 12, "results": {}}
        return [_OLD | read, late | {"problem": "not read within 30 s: this machine is busy"}, busy]

    def places(self, name: str) -> dict[str, Any] | None:
        slow = {"kind": "slow", "at_s": 1.0, "end_s": 3.0, "text": "a:1 read too slowly: 9 messages did not reach it"}
        return {"places": [slow]}

    def plot(self, name: str, key: str, field: str) -> dict[str, Any] | None:
        return None

    def curve(self, side: str, stream: str, field: str) -> dict[str, Any] | None:
        return None

    def lines(self, job: int) -> list[str]:
        return []

    def picture(self, side: str, stream: str) -> bytes:
        return b""

    def act(self, what: str, words: dict[str, Any]) -> tuple[bool, str]:
        return False, "no"


@contextmanager
def shown(host: str, **more: Any) -> Iterator[Browser]:
    with closing(PageServer(host, 0, Facts(more))) as server, Browser() as page:
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
        assert (
            "The recording was not read within 30 s: this machine is busy. It is tried again by itself" in page.text()
        )
        page.click("#replay button", "Start")  # all the same


def test_what_is_being_read_shows_for_how_long() -> None:
    with shown("127.0.0.1") as page:
        page.wait("document.querySelector('#sessions table').textContent.includes('reading, 12 s')")
        page.press("4")
        page.wait("document.querySelector('[data-key=choose]')")
        page.run("choose('busy.mcap'); draw()")
        page.wait("document.querySelector('#replay .bar')")
        assert "The recording is being read (12 s so far)." in page.text()


def test_a_replay_that_opens_its_file_shows_it_and_one_that_runs_is_on_every_view() -> None:
    replay: dict[str, Any] = {
        "name": "old.mcap",
        "to": "igtl",
        "place": "127.0.0.1:9",
        "running": True,
        "failed": False,
    }
    with shown("127.0.0.1", replay=replay | {"lines": [], "state": {}, "opening_s": 7}) as page:
        page.wait("document.querySelector('#playing').textContent === 'Replay opens'")
        page.click("#playing")
        page.wait("document.querySelector('#replay .bar')")
        assert "The recording is opened for the replay (7 s so far)." in page.text()
        page.wait("document.querySelector('#replay .transport .danger').textContent === 'Stop'")
    peers = [{"peer": "127.0.0.1:7", "profile": "slicer", "queued": 60, "rate_hz": 12.25, "sent": 1_200}]
    state = {"duration_s": 4.0, "position_s": 2.0, "paused": False, "rate": 1.0, "sent": 1_200, "peers": peers}
    with shown("127.0.0.1", replay=replay | {"lines": [], "state": state, "opening_s": 0}) as page:
        page.wait("document.querySelector('#playing').textContent === '▶Replay0:02'")
        page.press("4")
        page.wait(
            "document.querySelector('#replay').textContent.includes('slicer · 12.3 messages a second · 1,200 sent')"
        )
        assert "60 wait: it reads slowly" in page.text()
        buttons = "[...document.querySelectorAll('#replay .transport .btn')].map((each) => each.textContent)"
        assert page.run(buttons) == ["❚❚ Pause", "Stop", "Step", "Slower", "Faster"]


def test_a_replay_has_one_button_to_start_and_shows_what_it_needs_before() -> None:
    with shown("127.0.0.1") as page:
        page.click("button.link", "old.mcap")
        page.click("button", "Replay …")
        page.wait("document.querySelector('#replay .track')")
        page.wait("document.querySelectorAll('#replay .track rect.slow').length === 1")
        assert "9 messages did not reach it" in page.text()
        assert "Sent: 1 stream: TRANSFORM/b (the recorded bytes)." in page.text()
        assert "Not sent: 1 stream that peers sent to the bridge: TRANSFORM/a." in page.text()
        page.click("button", "Send it, too")
        page.wait("document.querySelector('#replay select[data-key=side]').value === 'both'")
        assert "Not sent" not in page.text()
        page.run("side = ''; target = 'ros'; draw()")  # nothing is recorded for that target
        page.click("button", "Send the usual ones to OpenIGTLink clients")
        page.wait("document.querySelector('[data-key=target]').value === 'igtl listen'")
        starts = (
            "[...document.querySelectorAll('#replay button')].filter((each) => /Start|Play/.test(each.textContent))"
        )
        assert page.run(f"{starts}.length") == 1
        assert page.run("document.querySelector('[data-key=place]').value") == "127.0.0.1:18944"
        hint = "document.querySelector('#hint').textContent"
        assert "at 127.0.0.1:18944" in page.run(hint) and "reaches no client" in page.run(hint)
        page.click("[data-key=place]")
        page.type("127.0.0.1:19000")
        page.wait(f"{hint}.includes('at 127.0.0.1:19000')")


@pytest.mark.parametrize(("host", "is_here"), [("127.0.0.1", True), ("127.0.0.2", False)])
def test_the_link_of_a_viewer_is_for_its_own_machine(host: str, is_here: bool) -> None:
    with shown(host) as page:
        page.wait("document.querySelector('#sessions .jobs')")
        found = page.run("[...document.querySelectorAll('.jobs a')].map((each) => each.href)")
        assert found == ([_LINK] if is_here else [])
        sentence = f"The viewer listens only on the machine that has the recordings: there, open {_LINK}"
        assert (sentence in page.text()) is not is_here
