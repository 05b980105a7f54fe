"""``keep --upload`` and the process of a bridge's upload, in this process: what they state, and when they give up."""

from __future__ import annotations

import io
import json
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from igtl_gateway.addons.upload import keeping, live, upload_process, uploading
from igtl_gateway.addons.upload.live import BridgeUploads
from igtl_gateway.addons.upload.place import UploadPlace
from igtl_gateway.addons.upload.settings import KEEPING as OPTIONS
from igtl_gateway.addons.upload.settings import SETTINGS
from igtl_gateway.base.clock import ManualClock
from igtl_gateway.gateway.log.note import Level, Note
from tests.addons.upload.store import Store, running_store
from tests.record import samples
from tests.record.test_parts import record
from tests.tables import table

PLACE = UploadPlace("bucket", "or1")


@pytest.fixture
def store(monkeypatch: pytest.MonkeyPatch) -> Iterator[Store]:
    with running_store() as found:
        monkeypatch.setenv("AWS_ENDPOINT_URL", found.url)
        monkeypatch.setenv("AWS_ACCESS_KEY_ID", "key")
        monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "secret")
        for name in ("_FIRST_WAIT_S", "_LAST_WAIT_S"):
            monkeypatch.setattr(uploading, name, 0.01)
        monkeypatch.setattr(keeping, "_LOOK_S", 0.01)
        yield found


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name in ("a", "b"):
        record(tmp_path / f"{name}.mcap", [samples.igtl(1)])
    return tmp_path


def values(*, patience: float = 60.0, is_json: bool = False) -> dict[str, Any]:
    return {"upload": str(PLACE), "upload_rate": 0.0, "patience": patience, "json": is_json}


def _answer(status: int) -> Any:
    return lambda method, path, _query: (status, {}, b"") if "b.mcap" in path and method == "PUT" else None


def test_all_is_uploaded(store: Store, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert keeping.upload(folder, values()) == 0
    lines = capsys.readouterr()
    sizes = sum(path.stat().st_size for path in folder.glob("*.mcap"))
    assert "the store has a.mcap" in lines.out and "the store has b.mcap" in lines.out and not lines.err
    assert lines.out.splitlines()[-1].startswith("2 files uploaded (") and "0 files left" in lines.out
    assert sorted(store.objects) == ["or1/a.mcap", "or1/b.mcap"] and store.received == sizes


def test_it_gives_up_when_the_store_has_a_problem(
    store: Store, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    store.fault = _answer(500)
    assert keeping.upload(folder, values(patience=0.1)) == 1
    lines = capsys.readouterr()
    assert "1 file uploaded" in lines.out and "1 file left" in lines.out
    assert "upload waits: 127.0.0.1: status 500; the files stay here" in lines.err


def test_it_waits_for_a_store_that_answers_again(store: Store, folder: Path) -> None:
    tries: list[str] = []

    def fault(method: str, path: str, _query: dict[str, str]) -> tuple[int, dict[str, str], bytes] | None:
        tries.append(path)
        return (503, {}, b"") if method == "PUT" and len(tries) < 12 else None

    store.fault = fault
    assert keeping.upload(folder, values()) == 0 and len(store.objects) == 2


@pytest.mark.parametrize(
    ("steps", "taken"),
    [
        ([(1, "slow"), (2, "slow"), (3, "slow"), (4, "slow")], 5),
        ([(1, "slow"), (1, "slow"), (2, "slow"), (2, "slow")], 5),
        ([(1, "slow"), (1, "slow"), (1, "slow"), (2, "slow")], 3),
        ([(0, "slow"), (0, "slow"), (0, "slow"), (0, "slow")], 2),
        ([(1, "slow"), (1, ""), (2, "slow"), (2, "slow")], 2),
    ],
)
def test_patience_begins_again_with_each_confirmed_file(
    steps: list[tuple[int, str]], taken: int, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """40 s a step, and 60 s of patience: a store that is slow is not one that does not work."""
    clock, done = ManualClock(), list[int]()

    class Slow:
        def __init__(self, *_: object) -> None:
            self.counts = SimpleNamespace(confirmed=0, problem="", sent_bytes=0)

        def step(self) -> bool:
            clock.advance(40 * 10**9)
            done.append(1)
            if len(done) > len(steps):
                return True
            self.counts.confirmed, self.counts.problem = steps[len(done) - 1]
            return False

        def waiting(self) -> list[object]:
            return []

        def close(self) -> None:
            """Nothing."""

    monkeypatch.setattr(keeping, "Uploader", Slow)
    monkeypatch.setattr(keeping, "SystemClock", lambda: clock)
    assert keeping.upload(folder, values()) == 0
    assert len(done) == taken


def test_what_cannot_be_uploaded_is_not_waited_for(
    store: Store, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    store.objects["or1/a.mcap"] = b"of another program", {"etag": '"0"'}
    assert keeping.upload(folder, values(is_json=True)) == 1
    found = json.loads(capsys.readouterr().out)
    assert found == {
        "to": "s3://bucket/or1", "confirmed": 1, "left": ["a.mcap"], "problem": "",
        "sent_bytes": (folder / "b.mcap").stat().st_size,
    }  # fmt: skip


def test_settings_and_options_have_their_names() -> None:
    assert [(each.name, each.default) for each in SETTINGS] == [("upload", ""), ("upload_rate", 0.0)]
    assert [(each.name, each.default, each.old) for each in OPTIONS] == [
        ("upload", "", ("--to",)), ("upload_rate", 0.0, ("--rate",)), ("patience", 60.0, ()),
    ]  # fmt: skip
    rate = SETTINGS[1]
    assert (rate.least, rate.most, rate.needs) == (0, 100_000, ("upload",))


# --- the process


def process(monkeypatch: pytest.MonkeyPatch, folder: Path, lines: str = "end\n", **more: Any) -> list[dict[str, Any]]:
    """Run it with some lines of input; return what it writes."""
    settings = {"folder": str(folder), "base": "a", "to": str(PLACE), "rate": 0.0, "begin": True} | more
    written: list[dict[str, Any]] = []
    monkeypatch.setattr(sys, "stdin", io.StringIO(json.dumps(settings) + "\n" + lines))
    monkeypatch.setattr(upload_process, "report_facts", lambda facts: written.append(json.loads(json.dumps(facts))))
    monkeypatch.setattr(upload_process, "_REPORT_S", 3_600.0)  # its thread reports once, and ends with this process
    monkeypatch.setattr(upload_process, "ignore_endings", lambda: None)
    monkeypatch.setattr(upload_process, "stand_back", lambda _nice: None)
    upload_process.main()
    return written


def test_the_process_uploads_what_is_left_and_ends(store: Store, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    written = process(monkeypatch, folder)
    assert list(store.objects) == ["or1/a.mcap"], "the recording of the bridge, and no other one"
    notes = [each["note"] for each in written if "note" in each]
    assert [(note["code"], note["level"], note["data"]["file"]) for note in notes] == [
        ("upload_confirmed", Level.INFO.value, "a.mcap")
    ]
    counts = written[-1]["counts"]
    assert (counts["confirmed"], counts["waiting"], counts["problem"]) == (1, 0, "") and counts["last_confirmed_ns"] > 0
    assert (folder / "a.uploads.jsonl").exists()


def test_without_its_bridge_the_process_ends_at_once(
    store: Store, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store.fault = _answer(500)
    process(monkeypatch, folder, lines="", base="b")
    assert not store.objects


def test_a_place_that_is_none_is_a_note(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (row,) = process(monkeypatch, folder, to="ftp://x")
    assert row["note"]["code"] == "upload_waits" and row["note"]["text"].startswith("no upload: found 'ftp://x'")
    assert row["note"]["level"] == Level.ERROR.value
    monkeypatch.setattr(sys, "stdin", io.StringIO(""))
    upload_process.main()  # no settings: nothing to do


# --- the side of the bridge


COUNTS = {
    "waiting": 1,
    "waiting_bytes": 9,
    "sent_bytes": 5,
    "confirmed": 2,
    "last_confirmed_ns": 3 * 10**9,
    "problem": "",
}
#: What a process writes and waits for.
PROGRAM = """
import json, sys
settings = json.loads(sys.stdin.readline())
print(json.dumps({"counts": %s}), flush=True)
print("a line that was cut off {", flush=True)
note = {"level": 30, "code": "upload_waits", "text": str(settings["begin"]), "data": {}}
print(json.dumps({"note": note}), flush=True)
%s
"""


def uploads(monkeypatch: pytest.MonkeyPatch, folder: Path, counts: dict[str, Any], end: str) -> tuple[Any, list[Note]]:
    notes: list[Note] = []
    monkeypatch.setattr(live, "_COMMAND", [sys.executable, "-c", PROGRAM % (json.dumps(counts), end)])
    monkeypatch.setattr(live, "_AGAIN_S", 0.01)
    monkeypatch.setattr(live, "_MOST_STARTS", 3)
    return BridgeUploads(folder / "a.mcap", PLACE, 0.0, notes.append), notes


def test_the_counts_of_a_process_that_ends_with_its_bridge(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found, notes = uploads(monkeypatch, folder, COUNTS, "assert sys.stdin.readline() == 'end\\n'")
    found.stop()
    assert not found._thread.is_alive()
    assert found.counters() == {
        "waiting": 1, "waiting_bytes": 9, "sent_bytes": 5, "confirmed": 2, "problem": "", "last_confirmed_s": 3.0
    }  # fmt: skip
    assert [note.text for note in notes] == ["True"]
    assert found.left_text() == (
        f"upload: 2 files confirmed, 1 LEFT: igtl-gateway keep {folder} --upload s3://bucket/or1 finishes it"
    )


@table(
    ("waiting", "problem", "text"),
    [
        (0, "x", "upload: 6 files confirmed"),
        (1, "full", "upload: 6 files confirmed, 1 LEFT (full): igtl-gateway keep "),
    ],
)
def test_a_process_that_ends_too_early_is_started_again(
    waiting: int, problem: str, text: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    counts = COUNTS | {"waiting": waiting, "problem": problem}
    found, notes = uploads(monkeypatch, tmp_path, counts, "")
    found._thread.join()  # three times, and no more
    assert found.left_text().startswith(text)
    assert (found.counters()["sent_bytes"], found.counters()["last_confirmed_s"]) == (15, 3.0)
    begun = [note.text for note in notes if note.text in ("True", "False")]
    assert begun == ["True", "False", "False"], "only the first one begins"
    assert [note.text for note in notes].count("upload: its process ended, and is started again") == 3
    found.stop()


class Waits(threading.Event):
    """Notes for how long was waited, and does not wait."""

    def __init__(self) -> None:
        super().__init__()
        self.waited: list[float | None] = []

    def wait(self, timeout: float | None = None) -> bool:
        self.waited.append(timeout)
        return self.is_set()


def test_before_each_further_start_is_a_pause(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A process that ends at once would otherwise be started as fast as the machine can."""
    found, _ = uploads(monkeypatch, tmp_path, COUNTS, "")
    found._thread.join()
    monkeypatch.setattr(live, "_AGAIN_S", 7.0)
    found._stop = Waits()
    found._supervise()
    assert found._stop.waited == [7.0, 7.0, 7.0]
    found.stop()
    found._stop.waited.clear()
    found._supervise()
    assert found._stop.waited == [], "the end of the bridge is not waited for"


def test_a_process_that_cannot_be_started_is_a_note(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    notes: list[Note] = []
    monkeypatch.setattr(live, "_COMMAND", [str(folder / "no such program")])
    found = BridgeUploads(folder / "a.mcap", PLACE, 0.0, notes.append)
    found._thread.join()
    (note,) = notes
    assert note.level is Level.ERROR and note.text.startswith("no upload: no process can be started: No such file")
    assert found.left_text() == "upload: 0 files confirmed"
