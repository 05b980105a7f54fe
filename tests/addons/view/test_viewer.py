"""The viewer as a process: on loopback, and gone when it is to be."""

from __future__ import annotations

import os
import subprocess
import sys
import urllib.request
from contextlib import closing
from http.client import HTTPConnection
from pathlib import Path
from shutil import which
from urllib.parse import parse_qs, urlsplit

import pytest

pytest.importorskip("rerun", reason="rerun is not installed (extra 'view')")

from igtl_gateway.addons.view import stream, viewer
from igtl_gateway.addons.view.session import SessionView
from igtl_gateway.addons.view.viewer import Viewer, check_screen
from igtl_gateway.base.errors import ViewerError
from igtl_gateway.convert.rosmsg import String

from .conftest import messages


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere there is always a screen")
def test_a_machine_without_a_screen_is_told_so() -> None:
    with pytest.raises(ViewerError, match="found no screen"):
        check_screen({})
    with pytest.raises(ViewerError, match="found no screen"):
        check_screen({"DISPLAY": ""})


@pytest.mark.parametrize("name", ["DISPLAY", "WAYLAND_DISPLAY"])
def test_a_screen_of_either_kind_will_do(name: str) -> None:
    check_screen({name: ":0"})


def test_the_page_is_served_on_loopback_until_closed(tmp_path: Path) -> None:
    path = tmp_path / "page.rrd"
    recording = stream.to_file(path, "page")
    view = SessionView(recording)
    for entry in messages(String("hello")):
        view.take(entry)
    view.finish()
    stream.close(recording)
    with Viewer.page([path]) as page:
        assert page.url.startswith("http://127.0.0.1:")
        assert "localhost" not in page.url
        with urllib.request.urlopen(page.url, timeout=20) as answer:
            assert b"<canvas" in answer.read()
        pid = page._process.pid
    assert page.ended
    with pytest.raises(ProcessLookupError):
        os.kill(pid, 0)


def test_only_who_has_the_token_reads_the_session_of_a_page(tmp_path: Path) -> None:
    path = tmp_path / "page.rrd"
    path.write_bytes(os.urandom(3 << 20))
    with Viewer.page([path]) as page:
        query = parse_qs(urlsplit(page.url).query)
        (address,) = query["url"]
        session = urlsplit(address)
        secret = session.path.split("/")[1]
        assert len(secret) == 48 and session.hostname == "127.0.0.1"

        def read(target: str, host: str = session.netloc) -> tuple[int, bytes]:
            with closing(HTTPConnection("127.0.0.1", session.port or 0, timeout=20)) as connection:
                connection.request("GET", target, headers={"Host": host})
                answer = connection.getresponse()
                return answer.status, answer.read()

        assert read(session.path) == (200, path.read_bytes())
        others = ("/", "/session.rrd", f"/{secret[:-1]}0/session.rrd", f"/{secret}/", f"/{secret}", f"/x{session.path}")
        for target in (*(each for each in others if each != session.path), "/%00/session.rrd", "/../page.rrd"):
            assert read(target)[0] == 403, target
        assert read(session.path, "rebind.example")[0] == 403
        command = Path(f"/proc/{page._process.pid}/cmdline")
        if command.exists():
            assert secret.encode() not in command.read_bytes(), "other users read command lines"
        if command.exists() and which("ss"):
            sockets = subprocess.run(["ss", "-ltnHp"], capture_output=True, text=True, check=True).stdout
            own = [line for line in sockets.splitlines() if f"pid={page._process.pid}," in line]
            assert len(own) == 1, "its page only, and no server of streams"
    with pytest.raises(OSError):
        read(session.path)
    with Viewer.page([path]) as again:
        assert secret not in again.url


def test_each_of_two_sessions_has_an_address_of_its_own(tmp_path: Path) -> None:
    paths = [tmp_path / "one.rrd", tmp_path / "other.rrd"]
    for path in paths:
        path.write_bytes(path.stem.encode())
    with Viewer.page(paths) as page:
        addresses = parse_qs(urlsplit(page.url).query)["url"]
        assert [urllib.request.urlopen(address, timeout=20).read() for address in addresses] == [b"one", b"other"]


def test_a_viewer_that_does_not_start_says_why(tmp_path: Path) -> None:
    with pytest.raises(ViewerError, match=r"did not start; .*--no-such-option"):
        Viewer(["--no-such-option"], [viewer._LISTENS])


def test_a_stream_reaches_a_server_and_nobody_is_an_error() -> None:
    with Viewer(["--serve-grpc", "--bind", "127.0.0.1", "--port", "auto"], [viewer._LISTENS]) as server:
        recording = stream.to_viewer(f"rerun+http://127.0.0.1:{server._found[0]}/proxy")
        view = SessionView(recording)
        for entry in messages(String("hello")):
            view.take(entry)
        view.finish()
        recording.flush(timeout_sec=20)
        stream.close(recording)
    with pytest.raises(ViewerError, match="nonsense"):
        stream.to_viewer("nonsense")
