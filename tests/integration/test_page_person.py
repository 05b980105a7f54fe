"""A person who has not seen the page: from its first screen to a replay from the second mark, and by keyboard alone."""

from __future__ import annotations

import struct
import time
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import pytest

from igtl_gateway.addon.igtl import Message, Transform, encode, ns_to_ticks
from tests.addons.page.browser import CHROMIUM, Browser
from tests.integration.bridge import Bridge, RawPeer, free_port, sending
from tests.places import FIXTURES

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="needs a Chromium: apt-get install chromium")
_LATE_NS = 3_000_000_000
#: Messages after which a peer is silent.
_REST = 120
#: Expressions of the page: name in the first row of the links and the line below it; the session, and its second mark.
_FIRST_LINK, _WHY = "document.querySelector('#now tbody .name').textContent", "document.querySelector('#now tr.why')"
_TODAY = "sessions.find((row) => row.name === 'today.mcap')"
_SUTURE = f"{_TODAY}.marks.find((mark) => mark.label === 'suture')"


class Peer:
    """A peer that sends its count as the x of a pose, at 20 Hz, and is silent now and then.

    Attributes:
        sent: the last count.
    """

    def __init__(self, port: int, device: str, age_ns: int = 0, silent_s: float = 0.0) -> None:
        self.sent, self._silent_s = 0, silent_s
        self._port, self._device, self._age_ns = port, device, age_ns

    def sending(self) -> AbstractContextManager[None]:
        return sending(self._port, self._next)

    def _next(self) -> bytes:
        self.sent += 1
        if self.sent % _REST == 0:
            time.sleep(self._silent_s)
        pose = Transform((1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, float(self.sent), 0.0, 0.0))
        ticks = ns_to_ticks(time.time_ns() - self._age_ns)
        return b"".join(encode(Message("TRANSFORM", self._device, pose, ticks, 1, 0, ())))


def test_from_the_first_screen_to_a_replay_from_the_second_mark(tmp_path: Path) -> None:
    bridge = Bridge("--no-ros", "--record", str(tmp_path / "today.mcap"), "--record-wait", "--page")
    try:
        link = bridge.wait_events(lambda event: event["event"] == "page", "page")[0]["link"]
        arm, camera = Peer(bridge.port, "Arm"), Peer(bridge.port, "Camera", _LATE_NS)
        with Browser() as page:
            with arm.sending(), camera.sending():
                page.open(link)
                # which peer is slow: the first line of the links, in words, without a click or scrolling
                page.wait(
                    "document.querySelector('#now h1').textContent.startsWith('Peer of Camera: its messages are ')"
                )
                page.wait(f"{_FIRST_LINK} === 'Camera' && {_WHY}.textContent.startsWith('Its messages are ')")
                assert page.run(f"{_WHY}.getBoundingClientRect().bottom < innerHeight")
                # record, two phases
                page.click("#pill")
                page.click("button", "Start recording")
                page.wait("document.querySelector('#recording h1').textContent === 'Recording'")
                _phase(page, arm, "approach")
                before = arm.sent
                after = _phase(page, arm, "suture")
                page.click("button", "Stop recording …")
                page.click("dialog button", "Stop")
                page.wait("document.querySelector('#recording h1').textContent === 'Not recording'")
            # the session that has the mark, and from there
            page.click("nav button", "Sessions")
            page.click("#filter")
            page.type("sutur")
            page.click("button.link", "today.mcap")
            page.click("#sessions .phases button", "suture")
            port = free_port()
            page.click("[data-key=place]")
            page.type(f"127.0.0.1:{port}")
            page.click("[data-key=speed]")
            for key in ("0", ".", "1", "Enter"):
                page.press(key)
            page.click("#replay button", "Start")
            page.click("#replay button", "Pause")
            page.wait("document.querySelector('#replay .transport').textContent.includes('Play')")
            with RawPeer(port) as client:
                page.wait("document.querySelector('#replay ul.list b')")  # the client
                page.run("window.drawn = known")
                page.click("#replay .list button", "suture", hold="known !== drawn")  # it is drawn again meanwhile
                page.wait(f"state.replay.state.position_s === markTime({_SUTURE}, {_TODAY})")
                assert before < _count(page, client) <= after + 1
            assert page.complaints == []
        assert bridge.end().code == 0
    finally:
        bridge.close()


def test_a_peer_that_is_silent_now_and_then_is_named(tmp_path: Path) -> None:
    """It is named while it is silent, and that it has been, without a click."""
    bridge = Bridge("--no-ros", "--page")
    try:
        link = bridge.wait_events(lambda event: event["event"] == "page", "page")[0]["link"]
        arm, tracker = Peer(bridge.port, "Arm"), Peer(bridge.port, "Tracker", silent_s=3.0)
        with Browser() as page, arm.sending(), tracker.sending():
            page.open(link)
            for expected in ("silent for [0-9.]+ s$", "silent for [0-9.]+ s, once in the last minute$"):
                page.wait(f"/^Peer of Tracker: {expected}/.test(document.querySelector('#now h1').textContent)")
                page.wait(f"{_FIRST_LINK} === 'Tracker' && {_WHY}.textContent.startsWith('Silent for ')")
            assert page.complaints == []
    finally:
        bridge.close()


def _phase(page: Browser, arm: Peer, label: str) -> int:
    """A phase of one second of messages; return what was sent when its begin was on the page."""
    page.press("m")
    page.wait("document.activeElement.id === 'mark-label'")
    page.type(label)
    page.click("button", "Begin a phase")
    page.wait("document.getElementById('mark-label').value === ''")
    begun = arm.sent
    page.wait_for(lambda: arm.sent >= begun + 20, "messages")
    page.click("button", f"End “{label}”")
    page.wait(f"!document.querySelector('#phases').textContent.includes('{label}')")
    page.run("document.activeElement.blur()")
    return begun


def _count(page: Browser, client: RawPeer) -> float:
    """Step to the next message of Arm; return its count: x of the pose at the end of its body."""
    page.click("#replay button", "Step")
    while (message := client.receive()).device != "Arm":
        page.click("#replay button", "Step")
    count: float = struct.unpack(">12f", message.body[-48:])[9]
    return count


#: Program that lists what can be reached with the keyboard: what is seen, not disabled, and not skipped.
_CONTROLS = """[...document.querySelectorAll('a[href], button, input, select, [tabindex]')].filter((each) =>
    each.tabIndex >= 0 && !each.disabled && each.checkVisibility()).map((each) => each.outerHTML)"""


def test_every_control_is_reached_by_tab_with_a_name_and_a_visible_focus(tmp_path: Path) -> None:
    (tmp_path / "lego.mcap").write_bytes((FIXTURES / "lego.mcap").read_bytes())
    bridge = Bridge("--no-ros", "--record", str(tmp_path / "today.mcap"), "--page")
    try:
        link = bridge.wait_events(lambda event: event["event"] == "page", "page")[0]["link"]
        with Browser() as page:
            with Peer(bridge.port, "Arm").sending():
                page.open(link)
                page.wait("document.querySelector('#now h1').textContent === 'The stream arrives'")
            page.click("nav button", "Sessions")
            page.click("button.link", "lego.mcap")
            page.click("button", "Verify")
            page.wait("document.querySelector('#sessions .jobs').textContent.includes('good')", 120)
            page.click("button", "Replay …")
            page.wait("document.querySelector('#replay [role=slider]')")
            for view in "1234":
                _walk(page, view)
            assert page.complaints == []
        assert bridge.end().code == 0
    finally:
        bridge.close()


def _walk(page: Browser, view: str) -> None:
    page.run(f"document.activeElement.blur(); show(VIEWS[{view} - 1]); document.querySelector('.skip').focus()")
    wanted = set(page.run(_CONTROLS))
    reached = {page.run("document.activeElement.outerHTML")}
    for _ in range(len(wanted) + 20):
        page.press("Tab")
        found = page.run("document.activeElement.outerHTML")
        if found.startswith("<body"):
            break
        reached.add(found)
        assert _name_of_focus(page), f"no name in view {view}: {found[:200]}"
        assert page.run("getComputedStyle(document.activeElement).outlineStyle") != "none", f"not seen: {found[:200]}"
    assert page.run("[...document.querySelectorAll('[aria-expanded]')].every((each) => each.ariaExpanded)")
    missed = {_short(each) for each in wanted} - {_short(each) for each in reached}
    assert not missed, f"not reached in view {view}: {missed}"


def _short(html: str) -> str:
    """The tag of an element, which does not change with the time that it shows."""
    return html.partition(">")[0]


def _name_of_focus(page: Browser) -> str:
    found = page.call("Runtime.evaluate", expression="document.activeElement")["result"]
    tree: list[dict[str, Any]] = page.call(
        "Accessibility.getPartialAXTree", objectId=found["objectId"], fetchRelatives=False
    )["nodes"]
    return str(tree[0].get("name", {}).get("value", "")).strip()
