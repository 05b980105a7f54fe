"""The viewer as a process: on loopback, and gone when it is to be."""

from __future__ import annotations

import os
import sys
import urllib.request
from pathlib import Path

import pytest

pytest.importorskip("rerun", reason="rerun is not installed (extra 'view')")

from igtl_gateway.convert.rosmsg import String
from igtl_gateway.errors import ViewerError
from igtl_gateway.view import stream, viewer
from igtl_gateway.view.session import SessionView
from igtl_gateway.view.viewer import Viewer, check_screen

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
    with Viewer.page(path) as page:
        assert page.url.startswith("http://127.0.0.1:")
        assert "localhost" not in page.url
        with urllib.request.urlopen(page.url, timeout=20) as answer:
            assert b"<canvas" in answer.read()
        pid = page._process.pid
    assert page.ended
    with pytest.raises(ProcessLookupError):
        os.kill(pid, 0)


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
