from __future__ import annotations

import os
import shutil
import signal
import time
from pathlib import Path
from typing import Any

import pytest

import igtl_gateway
from igtl_gateway.addon.reading import Level, Note
from igtl_gateway.addons.page.listing import MAX_MARKS, places_of
from igtl_gateway.addons.page.recordings import Recordings, _Reader
from igtl_gateway.cli import main
from tests.places import FIXTURES
from tests.timing import WAIT_S


@pytest.fixture(autouse=True)
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Beside four other tests a process that reads may need more than its half minute, and would be tried later."""
    monkeypatch.setattr("igtl_gateway.addons.page.recordings._PATIENCE_S", WAIT_S)


def rows(recordings: Recordings) -> dict[str, dict[str, Any]]:
    """The list, once all of it is read, by a process that may have to start first."""
    until = time.monotonic() + 2 * WAIT_S
    while True:
        found = recordings.rows()
        if all(row["read"] for row in found):
            return {row["name"]: row for row in found}
        assert time.monotonic() < until
        time.sleep(0.05)


def test_a_folder(tmp_path: Path) -> None:
    shutil.copy(FIXTURES / "lego.mcap", tmp_path / "lego.mcap")
    whole = (FIXTURES / "paper-types.mcap").read_bytes()
    (tmp_path / "cut.mcap").write_bytes(whole[: len(whole) // 2])
    (tmp_path / "noise.mcap").write_bytes(b"x" * 1_000)
    (tmp_path / "notes.txt").write_text("no recording")
    (tmp_path / ".hidden.mcap").write_bytes(b"")
    recordings = Recordings(tmp_path)
    found = rows(recordings)
    assert found.keys() == {"lego.mcap", "cut.mcap", "noise.mcap"}
    lego = found["lego.mcap"]
    assert (lego["closed"], lego["sealed"], lego["streams"], lego["marks"]) == (True, False, 33, [])
    assert lego["sends"]["igtl"]["number"] == 5
    assert not found["cut.mcap"]["closed"] and found["noise.mcap"]["problem"]
    assert recordings.path("lego.mcap") == tmp_path / "lego.mcap"
    for name in ("../lego.mcap", "notes.txt", "", "/etc/passwd", ".hidden.mcap"):
        assert recordings.path(name) is None
    # marks that are added later are not in the recording, which has been closed for long
    os.utime(tmp_path / "lego.mcap", (1, 1))
    mark = ["mark", str(tmp_path / "lego.mcap"), "--at", "1", "--label"]
    assert main([*mark, "slip"]) == 0
    assert [each["label"] for each in rows(recordings)["lego.mcap"]["marks"]] == ["slip"]
    assert main([*mark[:2], "--remove", "slip"]) == 0
    assert rows(recordings)["lego.mcap"]["marks"] == []


def test_each_bad_file_has_its_line_and_older_ones_are_counted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A FIFO and a broken link vanished, a split recording with a broken link too, and all after the first 500."""
    os.mkfifo(tmp_path / "fifo.mcap")
    (tmp_path / "loop.mcap").symlink_to("loop.mcap")
    (tmp_path / "device.mcap").symlink_to("/dev/zero")
    (tmp_path / "split").mkdir()
    (tmp_path / "split" / "split_0.mcap").symlink_to("nowhere")
    found = rows(Recordings(tmp_path))
    why = {"fifo.mcap": "found a FIFO", "loop.mcap": "symbolic links", "device.mcap": "found a device"}
    assert found.keys() == {*why, "split"} and found["split"]["problem"]
    assert all(text in found[name]["problem"] for name, text in why.items())
    monkeypatch.setattr("igtl_gateway.addons.page.recordings.MAX_LISTED", 1)
    (row,) = Recordings(tmp_path).rows()
    assert row["older"] == 3


def test_a_recording_with_many_marks_lists_the_first(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with igtl_gateway.Bridge(listen=["127.0.0.1:0"], ros=False, record=str(path)) as bridge:
        for number in range(MAX_MARKS + 7):
            bridge.mark(f"m{number}")
    row = rows(Recordings(tmp_path))["a.mcap"]
    assert (len(row["marks"]), row["marked"]) == (MAX_MARKS, MAX_MARKS + 7)


def test_the_time_line(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with igtl_gateway.Bridge(listen=["127.0.0.1:0"], ros=False, record=str(path)) as bridge:
        bridge.pause_recording()
        time.sleep(0.2)
        bridge.resume_recording()
        time.sleep(0.2)
    recordings = Recordings(tmp_path)
    line = recordings.places("a.mcap")
    assert line and line == recordings.places("a.mcap") and recordings.places("../a.mcap") is None
    found = line["places"]
    assert [place["kind"] for place in found] == ["pause", "resume"]
    assert 0 <= found[0]["at_s"] <= found[1]["at_s"]
    assert places_of(tmp_path / "absent.mcap")["places"] == []


def test_a_slow_peer_is_one_span_with_its_count(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with igtl_gateway.Bridge(listen=["127.0.0.1:0"], ros=False, record=str(path)) as bridge:
        for peer, dropped in (("a:1", 5), ("b:2", 1), ("a:1", 9), ("a:1", 1_400)):
            data = {"peer": peer, "dropped": {"IMAGE/Probe": dropped}}
            bridge._bridge.hub.note(Note(Level.WARN, "queue_drop", f"{peer} reads too slowly", data=data))
    line = places_of(path)
    first, second = (place for place in line["places"] if place["kind"] == "slow")
    assert (
        first["text"]
        == "a:1 read too slowly: 1,400 messages of IMAGE/Probe did not reach it; the recording lost none by this"
    )
    assert first["at_s"] <= second["at_s"] <= first["end_s"] and second["text"].startswith("b:2 ")
    assert not [place for place in line["places"] if place["kind"] == "loss"]


def test_a_time_line_that_was_not_read_in_time_is_read_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "a.mcap").touch()
    answers: list[dict[str, Any]] = [{"places": []}, {"unread": 1, "problem": "cannot be read within 30 s"}]
    monkeypatch.setattr(_Reader, "ask", lambda *_, **__: answers.pop())
    recordings = Recordings(tmp_path)
    assert "unread" in (recordings.places("a.mcap") or {})
    assert recordings.places("a.mcap") == recordings.places("a.mcap") == {"places": []}


def test_what_is_not_read_in_time_waits_behind_the_others_and_gets_more_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[tuple[str, float]] = []
    monkeypatch.setattr("igtl_gateway.addons.page.recordings._PATIENCE_S", 30.0)

    def ask(_reader: _Reader, path: Path, *, patience_s: float) -> dict[str, Any]:
        asked.append((path.name, patience_s))
        is_late = path.name == "b.mcap" and patience_s < 100
        return {"unread": time.time_ns(), "problem": "not read"} if is_late else {"closed": True}

    monkeypatch.setattr(_Reader, "ask", ask)
    for number, name in enumerate(("a.mcap", "b.mcap"), start=1):
        (tmp_path / name).touch()
        os.utime(tmp_path / name, ns=(number, number))
    found = rows(Recordings(tmp_path))
    assert asked == [("b.mcap", 30.0), ("a.mcap", 30.0), ("b.mcap", 60.0), ("b.mcap", 120.0)]
    assert found["a.mcap"]["closed"] and found["b.mcap"]["closed"] and "reading_s" not in found["b.mcap"]


def test_a_file_that_ends_the_process_costs_one_row(tmp_path: Path) -> None:
    pipe = tmp_path / "b.mcap"
    shutil.copy(FIXTURES / "lego.mcap", pipe)
    recordings = Recordings(tmp_path)
    recordings.rows()
    killed = 0
    until = time.monotonic() + WAIT_S
    while not killed and time.monotonic() < until:
        for process in Path(f"/proc/{os.getpid()}/task").glob("*/children"):
            for number in process.read_text().split():
                if b"page.listing" in Path(f"/proc/{number}/cmdline").read_bytes():
                    os.kill(int(number), signal.SIGKILL)
                    killed += 1
    assert killed
    found = rows(recordings)["b.mcap"]
    assert found["closed"] and found["streams"] == 33  # it was tried again
