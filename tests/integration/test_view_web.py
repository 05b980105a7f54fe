"""``view --web`` in a real browser.  Opt-in, since it needs one: IGTL_GATEWAY_BROWSER=chromium."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path
from threading import Timer
from urllib.error import HTTPError
from urllib.parse import parse_qs, urlsplit
from urllib.request import urlopen

import pytest

from tests.places import FIXTURES

BROWSER = os.environ.get("IGTL_GATEWAY_BROWSER")
PATIENCE_S = 100  #: WebGL by software on a busy machine

#: The page logs the first when its canvas is in the document and is drawn on, and the others when it gives up.
GOOD, BAD = "App started.", ("Failed to start", "Rerun has crashed")

#: Without a graphics card the browser draws by software; as root it has no sandbox.
OPTIONS = ["--headless=new", "--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]


@pytest.mark.skipif(BROWSER is None, reason="opt-in: set IGTL_GATEWAY_BROWSER to a Chromium")
def test_the_page_shows_its_canvas(tmp_path: Path) -> None:
    assert BROWSER is not None
    command = [sys.executable, "-m", "igtl_gateway", "view", str(FIXTURES / "paper-types.mcap"), "--web"]
    served = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        assert served.stdout is not None
        url = next(line.strip() for line in served.stdout if line.startswith("http"))
        assert url.startswith("http://127.0.0.1:")
        (session,) = parse_qs(urlsplit(url).query)["url"]
        with urlopen(session, timeout=20) as answer:
            assert answer.read(4) == b"RRF2"
        without = session.replace(urlsplit(session).path.split("/")[1], "0" * 48)
        with pytest.raises(HTTPError, match="403"):
            urlopen(without, timeout=20)
        said = what_the_page_says([BROWSER, *OPTIONS, f"--user-data-dir={tmp_path}", url])
    finally:
        served.send_signal(signal.SIGINT)
        served.wait(20)
    assert said == GOOD


def what_the_page_says(command: list[str]) -> str:
    """The first of ``GOOD`` and ``BAD`` on the page's console; "" if neither came in time."""
    logged = ["--enable-logging=stderr", "--remote-debugging-port=0"]  # the latter keeps the page open
    page = subprocess.Popen([*command[:-1], *logged, command[-1]], stderr=subprocess.PIPE, text=True, errors="replace")
    patience = Timer(PATIENCE_S, page.kill)
    patience.start()
    try:
        assert page.stderr is not None
        return next((word for line in page.stderr for word in (GOOD, *BAD) if f'"{word}' in line), "")
    finally:
        patience.cancel()
        page.terminate()
        page.wait(20)
