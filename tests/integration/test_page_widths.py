"""Every view at the widths of a telephone, a tablet and a desk, light and dark: nothing is cut at the right edge."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import pytest

from igtl_gateway.addons.page.server import PageServer
from tests.addons.page.browser import CHROMIUM, Browser

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="needs a Chromium: apt-get install chromium")
WIDTHS = (500, 800, 1280)
#: Where a person who looks at the pictures has them written.
_PICTURES = os.environ.get("IGTL_GATEWAY_PICTURES", "")
_LONG = "NeedleGuideCalibrationToReferenceArrayOfTheLeftHand"
_S = 10**9
_NOW_NS = 1_764_000_000 * _S


def _stream(name: str, state: str, kind: str = "TRANSFORM", side: str = "igtl_in", **more: Any) -> dict[str, Any]:
    usual = {"key": f"{side} {kind}/{name}", "state": state, "word": "", "name": name, "type": kind, "side": side}
    facts = {"rate_hz": 59.8, "spark": " ".join(["60", "58", "61"] * 20), "age_s": 0.02, "gap_s": 4.2, "text": ""}
    rest = {"gap_utc_ns": _NOW_NS, "latency_ms": 1234.5, "ahead_ms": None, "received": 9, "dropped": 1_234}
    way = f"from 192.168.100.200:54321 {'' if state == 'ok' else 'and 3 others'}"
    return {**usual, **facts, **rest, "stamps": "in the future", "advice": "", "way": way, **more}


def _link(peer: str, state: str, **more: Any) -> dict[str, Any]:
    usual = {"key": peer, "state": state, "link": 1, "name": f"plus: {_LONG}, Probe, 4 more", "called": peer}
    facts = {"peer": peer, "role": "client", "profile": "plus", "since_ns": _NOW_NS, "from_hz": 1234.0, "to_hz": 59.0}
    rest = {"spark": "1 2 3 4", "latency_ms": 0.4, "ahead_ms": None, "jitter_ms": 0.25, "queue": 123, "dropped": 99}
    return {**usual, **facts, **rest, "stuck_bytes": 0, "text": "", "advice": "", **more}


_ADVICE = (
    "Compare the clocks of the two machines, and synchronise them (NTP, PTP) with `chronyc tracking` or `timedatectl`"
)
_STREAMS = [
    _stream(_LONG, "error", text="1,234 messages dropped: wrong CRC, malformed body", advice=_ADVICE),
    _stream("ProbeToTracker", "silent", word="left", text="its peer has left", rate_hz=0.0),
    _stream("/camera/image_rect", "warning", "sensor_msgs/msg/Image", "ros_in", text="not there", word="missing"),
    _stream("Probe", "ok", "IMAGE"),
    _stream("GET_STATUS", "off", "without a device name,", word="quiet", rate_hz=0.0),
]
_NOTES = [{"number": 1, "time_ns": _NOW_NS, "level": "WARN", "code": "x", "text": f"{_LONG}: {_ADVICE}", "more": 7}]
_RECORDING = {
    "name": "session-2026-11-29-theatre-2-left.mcap",
    "folder": "~/recordings/2026/november/theatre-2",
    "bytes": 1_234_567_890,
    "files": 12,
    "per_s": 4_567_890.0,
    "free": 12_345_678_901,
    "lasts_s": 1234.0,
    "left_s": 1234.0,
    "last": "",
    "written": "session-2026-11-29-theatre-2-left.mcap",
    "paused": False,
    "rests": False,
    "lasted_s": 4_321.0,
    "failure": "",
    "taken_away": "",
    "losing": False,
    "entries": 12_345_678,
    "dropped": 12,
    "left_out": 34,
    "queued": 0,
    "stands": False,
    "snapshot_s": 0,
    "triggers": ["mark:slip before 30 s, after 10 s"],
    "split": True,
    "sealed": True,
    "phases": ["anastomosis-of-the-left-side", "closing"],
}
_BRIDGE = {
    "streams": _STREAMS,
    "links": [_link("192.168.100.200:54321", "warning", text="its clock is ahead by 2.0 s", advice=_ADVICE)],
    "more": 0,
    "unsent": 3,
    "inputs": 5,
    "arriving": 4,
    "version": "0.2.0",
    "uptime_s": 12_345.0,
    "relay": False,
    "ros": False,
    "refused": 1_234,
    "recording": _RECORDING,
    "notes": _NOTES,
    "done": _NOTES,
    "pictures": [["igtl_in", f"IMAGE/{_LONG}", 1]],
    "headline": f"{_LONG}: 1,234 messages dropped: wrong CRC, malformed body",
    "others": "also streams ProbeToTracker, /camera/image_rect and 3 more",
    "slowest": [],
}
_JOBS = [
    {"number": 1, "action": "verify", "name": "a.mcap", "state": "running", "seconds": 75.0, "last": "", "link": ""},
    {"number": 2, "action": "lint", "name": f"{_LONG}.mcap", "state": "failed", "seconds": 5.0, "last": _ADVICE},
]
_SENDS = {"names": [f"TRANSFORM/{_LONG}"], "number": 9, "why": "the recorded bytes", "stay": ["a/b"], "staying": 3}
_MARKS = [{"label": "incision", "text": "left port", "time_ns": _NOW_NS + _S, "end_ns": None}]


class _Facts:
    def state(self) -> tuple[int, bytes]:
        jobs = [{"link": "", "progress": "34 %"} | job for job in _JOBS]
        peer = {"peer": "192.168.100.200:54321", "profile": "slicer", "queued": 60, "rate_hz": 1234.5, "sent": 123_456}
        counts = {"sent": 123_456, "without_peer": 12, "peers": [peer]}
        state = {"duration_s": 754.0, "position_s": 211.0, "paused": False, "rate": 1.25, **counts}
        replay = {"name": f"{_LONG}.mcap", "to": "igtl", "place": "192.168.100.200:18944", "opening_s": 0}
        lines = [f"= 192.168.100.200:54321 connected to 0.0.0.0:18944 for {_LONG}"]
        facts = {"has_bridge": True, "answers": True, "wrong": 4, "folder": _RECORDING["folder"], "version": "0.2.0"}
        running = replay | {"running": True, "failed": False, "state": state, "lines": lines}
        return 1, json.dumps(facts | {"jobs": jobs, "replay": running, "bridge": _BRIDGE}).encode()

    def sessions(self) -> list[dict[str, Any]]:
        usual = {"modified_ns": _NOW_NS, "start_ns": _NOW_NS, "bytes": 233_000_000, "read": True, "closed": True}
        more = {"streams": 33, "marks": _MARKS, "marked": 1, "sealed": True, "duration_s": 754.0}
        read = usual | more | {"sends": {"igtl": _SENDS}, "results": {"verify": "done", "review": "nothing"}}
        names = (f"{_LONG}.mcap", "a.mcap", str(_RECORDING["name"]))
        return [read | {"name": name, "recording": name == _RECORDING["name"]} for name in names]

    def places(self, name: str) -> dict[str, Any] | None:
        slow = {"kind": "slow", "at_s": 100.0, "end_s": 300.0, "text": f"{_LONG} read too slowly: {_ADVICE}"}
        return {"places": [slow, {"kind": "finding", "at_s": 500.0, "text": _ADVICE}]}

    def plot(self, name: str, key: str, field: str) -> dict[str, Any] | None:
        streams = [f"TRANSFORM/{_LONG}", "/joints"]
        fields = ["x_mm", "position.elbow"] if key != "/joints" else ["position.elbow"]
        found = {"streams": streams, "stream": key or streams[0], "fields": fields, "field": field or fields[0]}
        values = [None if at == 5 else at * 1.5 - 20 for at in range(30)]
        return found | {"times": [25.0 * at for at in range(30)], "values": values, "every": 9, "messages": 268}

    def curve(self, side: str, stream: str, field: str) -> dict[str, Any] | None:
        found = {"side": side, "stream": stream, "span_s": 60, "fields": ["x_mm", _LONG], "field": field or "x_mm"}
        return found | {"times": [at - 30.0 for at in range(30)], "values": [at * 1.5 - 20 for at in range(30)]}

    def lines(self, job: int) -> list[str]:
        return [_ADVICE] * 3

    def picture(self, side: str, stream: str) -> bytes:
        return b""

    def act(self, what: str, words: dict[str, Any]) -> tuple[bool, str]:
        return True, "done"


@contextmanager
def shown() -> Iterator[Browser]:
    with closing(PageServer("127.0.0.1", 0, _Facts())) as server, Browser() as page:
        page.open(server.link)
        page.wait("document.querySelector('#now h1')")
        yield page


#: What reaches over the right edge, but in what a person can move; and the page itself.
_OVER = """(() => {
  const root = document.documentElement, width = root.clientWidth, found = [];
  if (root.scrollWidth > width) found.push(`the page: ${root.scrollWidth}`);
  for (const each of document.querySelectorAll("body *")) {
    const box = each.getBoundingClientRect();
    if (!box.width || !box.height || each.closest("svg") || box.right < 0) continue;
    const what = `${each.tagName}.${each.className} ${Math.round(box.right)}: ${each.textContent.slice(0, 40)}`;
    const hides = getComputedStyle(each).overflowX === "hidden" && !each.closest(".bar, [title], .last");
    if (box.right > width + 1 || box.left < -1) found.push(what);
    else if (each.scrollWidth > each.clientWidth + 1 && hides) found.push(`cut: ${what}`);
  }
  for (const each of document.querySelectorAll(".scroll"))
    if (each.scrollWidth > each.clientWidth + 1) found.push(`a table: ${each.scrollWidth} in ${each.clientWidth}`);
  return found.slice(0, 8);
})()"""


def test_no_view_is_cut_at_any_width() -> None:
    over: dict[str, list[str]] = {}
    with shown() as page:
        for width in WIDTHS:
            for dark in (False, True):
                page.look((width, 1_000), dark=dark)
                for number, view in enumerate(("now", "recording", "sessions", "replay"), start=1):
                    page.press(str(number))
                    page.wait(f"!document.querySelector('#{view}').hidden")
                    if view == "now":
                        if not page.run("Boolean(document.querySelector('#now .plot'))"):
                            page.click("#now button", "Plot a number as it comes")
                        page.wait("document.querySelector('#now .plot .curve').getAttribute('d').length > 100")
                    if view == "sessions":
                        page.wait("document.querySelectorAll('tr.pick').length === 3")
                        page.run("opened = 'a.mcap'; drawSessions()")
                    if view == "replay":
                        page.wait("document.querySelector('#replay .track .slow')")
                        if not page.run("Boolean(document.querySelector('#replay .plot'))"):
                            page.click("#replay button", "Plot a number over time")
                        page.wait("document.querySelector('#replay .plot .curve').getAttribute('d').length > 100")
                    if _PICTURES:
                        page.picture(Path(_PICTURES) / f"{view}-{width}{'-dark' * dark}.png")
                    if found := page.run(_OVER):
                        over[f"{view} at {width} pixels"] = found
        assert over == {}
        for view in ("now", "replay"):  # an address with the name of a view shows its top
            page.run(f"show('{view}'); scrollTo(0, 0); location.hash = ''; location.hash = '{view}'")
            assert page.run("document.documentElement.scrollHeight > innerHeight && scrollY === 0"), view
        # another number, by its name; the line is broken where one is missing
        choose = "(() => {{ const it = document.querySelector('[data-key=\"plot {}\"]'); it.value = '{}'; "
        page.run(choose.format("stream", "/joints") + "it.dispatchEvent(new Event('change')) })()")
        page.wait("document.querySelector('#replay .plot').ariaLabel.startsWith('position.elbow of /joints: -20')")
        assert page.run("document.querySelector('#replay .plot .curve').getAttribute('d').split('M').length") == 3
        page.look((500, 1_000))
        page.press("1")
        tabs = "[...document.querySelectorAll('nav button')].every((each) => each.getBoundingClientRect().right <= 500)"
        assert page.run(tabs) and page.run("document.querySelector('#pill').getBoundingClientRect().right <= 500")
        page.wait(
            "document.querySelector('#trouble').textContent.includes('The disk of the recording is full in 21 min')"
        )
        states = "[...document.querySelectorAll('[aria-label=Streams] .state')].map((each) => each.textContent)"
        assert page.run(states) == ["fault", "left", "missing", "good", "quiet"]
        assert "0.00 Hz" not in page.text() and "(no name)" not in page.text()
        label = "getComputedStyle(document.querySelector('[aria-label=Streams] td:nth-child(3)'), '::before').content"
        assert page.run(label) == '"Rate "'  # a row names its columns where no line of titles does
