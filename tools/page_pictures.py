"""The pictures of the page in the documentation, made in a real browser without a screen.

    .venv/bin/python -m tools.page_pictures            into docs/pictures
    .venv/bin/python -m tools.page_pictures FOLDER     elsewhere

A bridge receives the fixtures STAR and ultrasound, and a peer with faults that the page has to show: stamps in the
future, wrong CRCs, a stream that ends.  What the browser complains about is an error.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from contextlib import ExitStack, suppress
from pathlib import Path

from igtl_gateway.addon.igtl import Message, Transform, encode, ns_to_ticks
from igtl_gateway.cli import main as main_of_cli
from tests.addons.page.browser import Browser
from tests.integration.bridge import Bridge, RawPeer, environment, free_port
from tests.places import FIXTURES, ROOT

PICTURES = ROOT / "docs" / "pictures"
LIMIT = 400_000  #: bytes of a picture
_DESK, _TABLET = (1280, 860), (820, 1100)
#: Time in which the sparklines get their lines, seconds.
_WARM_S = 40.0
_POSE = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 10.0, 20.0, 30.0)


def main(words: list[str]) -> int:
    """Make all pictures; 1 if one is not as it should be."""
    out = Path(words[0]) if words else PICTURES
    out.mkdir(exist_ok=True)
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(ignore_cleanup_errors=True))) / "theatre-2"
        folder.mkdir()
        os.environ["HOME"] = str(folder.parent)  # the page shows it as ~
        for name in ("ultrasound", "lego", "brain"):
            shutil.copy(FIXTURES / f"{name}.mcap", folder / f"{name}.mcap")
        # a part, whose review takes seconds
        assert main_of_cli(["slice", str(FIXTURES / "star.mcap"), "-o", str(folder / "star.mcap"), "--end", "4"]) == 0
        _old(folder / "kidney-07.mcap")
        what = ["--no-ros", "--page", "--record", str(folder / "today.mcap"), "--split-size", "500"]
        bridge = Bridge(*what, "--connect", "127.0.0.1:9")
        stack.callback(bridge.close)
        link = bridge.wait_events(lambda event: event["event"] == "page", "page")[0]["link"]
        over = threading.Event()
        peer = threading.Thread(target=_faulty, args=(bridge.port, over))
        peer.start()
        stack.callback(peer.join)
        stack.callback(over.set)
        for name in ("star", "ultrasound"):
            stack.callback(_ended, _replay(name, bridge.port))
        page = stack.enter_context(Browser(_DESK))
        page.open(link)
        time.sleep(_WARM_S)
        page.wait("document.querySelectorAll('#now img').length > 0")
        _shoot(page, out)
        print(*page.complaints, sep="\n")
        large = [path.name for path in out.glob("page-*.png") if path.stat().st_size > LIMIT]
        print(*(f"{name} is larger than {LIMIT / 1000:.0f} kB" for name in large), sep="\n")
        return 1 if page.complaints or large else 0


def _shoot(page: Browser, out: Path) -> None:
    def shot(name: str) -> None:
        time.sleep(1.0)
        page.picture(out / f"page-{name}.png")

    def begin_mark() -> None:
        page.press("m")
        page.wait("document.activeElement.id === 'mark-label'")

    shot("now")
    page.look(_DESK, dark=True)
    shot("now-dark")
    page.look(_TABLET)
    shot("now-tablet")
    page.look(_DESK)
    for label, text in (("incision", "left port"), ("suture-1", ""), ("slip", "the needle slipped")):
        begin_mark()
        page.type(label)
        page.run("document.getElementById('mark-text').focus()")
        page.type(text)
        page.press("Enter")
        page.wait("document.getElementById('mark-label').value === ''")
    begin_mark()
    page.type("anastomosis")
    page.click("button", "Begin a phase")
    page.wait("document.querySelector('.phases')")
    page.run("document.activeElement.blur()")
    time.sleep(4)
    shot("recording")
    page.click("nav button", "Sessions")
    page.wait(
        "document.querySelectorAll('tr.pick').length > 4 && !/reading|not read/.test($('sessions').textContent)", 400
    )
    page.click("button.link", "star.mcap")
    page.click("button", "Review")
    page.wait("/good|failed/.test(document.querySelector('.jobs')?.textContent)", 100)
    page.click("button", "Verify")
    time.sleep(2)
    shot("sessions")
    page.click("button.link", "kidney-07.mcap")
    page.click("button", "Replay …")
    port = free_port()
    page.run(f"place = '127.0.0.1:{port}'; draw()")
    page.click("#replay button", "Start")
    page.wait("document.querySelector('#replay .transport')?.textContent.includes('Pause')", 200)
    page.wait("document.querySelector('#replay .pause')", 100)
    with RawPeer(port) as client:
        reader = threading.Thread(target=_read, args=(client,), daemon=True)
        reader.start()
        page.run("jump(7.5)")
        page.wait("/[1-9][0-9]+ messages sent/.test(document.querySelector('#replay').textContent)", 60)
        time.sleep(3)
        shot("replay")
        page.look(_DESK, dark=True)
        shot("replay-dark")


def _read(client: RawPeer) -> None:
    """Receive what a replay sends, until the connection is closed."""
    with suppress(Exception):
        while True:
            client.receive(type_name="TRANSFORM")


def _old(path: Path) -> None:
    """A recording with marks, a pause, a phase and a finding, of 20 s."""
    from igtl_gateway import Bridge as OwnBridge

    with OwnBridge(listen=["127.0.0.1:0"], ros=False, record=str(path)) as bridge:
        over = threading.Event()
        peer = threading.Thread(target=_faulty, args=(bridge.addresses[0][1], over))
        peer.start()
        for number, label in enumerate(("incision", "suture-1", "suture-2"), start=1):
            time.sleep(3)
            bridge.mark(label, who="Kim")
            if number == 2:
                with bridge.phase("anastomosis", who="Kim"):
                    time.sleep(4)
        bridge.pause_recording()
        time.sleep(2)
        bridge.resume_recording()
        time.sleep(3)
        over.set()
        peer.join()


def _faulty(port: int, over: threading.Event) -> None:
    """A peer with four streams, of which three have a fault."""
    with RawPeer(port) as peer, suppress(OSError):
        count = 0
        while not over.wait(0.02):
            count += 1
            peer.send(_pose("ArmToBase", 0.0))
            if count % 2:
                peer.send(_pose("ProbeToTracker", 2.0))
            if count % 50 == 0:
                broken = bytearray(_pose("NeedleToArm", 0.0))
                broken[-1] ^= 1
                peer.send(bytes(broken))
            elif count % 5 == 0:
                peer.send(_pose("NeedleToArm", 0.0))
            if count < 1_000:
                peer.send(_pose("StylusToTracker", 0.0))


def _pose(device: str, ahead_s: float) -> bytes:
    ticks = ns_to_ticks(time.time_ns() + int(ahead_s * 1e9))
    return b"".join(encode(Message("TRANSFORM", device, Transform(_POSE), ticks, 1, 0, ())))


def _replay(name: str, port: int) -> subprocess.Popen[bytes]:
    """A program that sends a fixture to the bridge again and again."""
    what = [
        str(FIXTURES / f"{name}.mcap"),
        "--to",
        "igtl",
        "--connect",
        f"127.0.0.1:{port}",
        "--loop",
        "--restamp",
        "now",
    ]
    command = [sys.executable, "-m", "igtl_gateway", "replay", *what]
    return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, env=environment())


def _ended(process: subprocess.Popen[bytes]) -> None:
    process.kill()
    process.wait()


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
