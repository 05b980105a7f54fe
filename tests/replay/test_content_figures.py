"""``replay/content_figures.py``: the figures of a recorder give what a pass gives, however the file ended."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader

from igtl_gateway.base.clock import ManualClock, SystemClock
from igtl_gateway.cli import main
from igtl_gateway.config.configuration import Config
from igtl_gateway.config.triggers import trigger
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.marks import MarkNote
from igtl_gateway.record.host import in_process, in_thread
from igtl_gateway.record.options import RecordOptions
from igtl_gateway.record.recorder import Recorder
from igtl_gateway.record.sessionfile import figures, layout
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.record.sessionfile.writer import SessionWriter
from igtl_gateway.replay.content_figures import summary_of
from tests.files import BytesRead
from tests.places import FIXTURES, ROOT
from tests.record import samples
from tests.record.notes import TimelessNotes
from tests.record.test_parts import RULE, wait_until
from tests.record.test_parts import session as gateway_session
from tests.record.test_recorder import closed, workers
from tests.replay.test_content_columns import ROWS, facts, session

SESSION = {"config": json.dumps(Config().to_dict()), "host": "theatre-2"}


def info(capsys: pytest.CaptureFixture[str], path: Path, *options: str) -> dict[str, Any]:
    capsys.readouterr()
    main(["info", str(path), "--json", *options])
    found: dict[str, Any] = json.loads(capsys.readouterr().out)
    return found


def same(capsys: pytest.CaptureFixture[str], path: Path, *, counted: bool = True) -> None:
    """``info`` is that of a pass; ``counted``: without a pass."""
    stated, full = info(capsys, path), info(capsys, path, "--full")
    assert stated.pop("figures") == {"entries_read": not counted, "why": ""}
    assert full.pop("figures") == {"entries_read": True, "why": ""}
    assert stated == full


def recorder(path: Path, host: Any = in_thread, clock: Any = None, **options: Any) -> Recorder:
    return Recorder(
        path, SESSION, qos_of=lambda _topic, _type: None, on_note=TimelessNotes().append, host=host, rule=RULE,
        clock=clock or ManualClock(samples.START_NS), options=RecordOptions(**options),
    )  # fmt: skip


@given(rows=ROWS, chunk_bytes=st.sampled_from((300, 9_000)))
def test_a_random_session(tmp_path_factory: pytest.TempPathFactory, rows: list[Any], chunk_bytes: int) -> None:
    path = tmp_path_factory.mktemp("session") / "a.mcap"
    writer = SessionWriter(path, SESSION, chunk_bytes=chunk_bytes, counted=True)
    for entry in session(rows):
        writer.write(entry)
    writer.close({})
    with SessionFile.open(path) as file:
        stated, why = summary_of(file)
        full, no = summary_of(file, full=True)
    assert (why, no) == (None, "")
    for each in (stated, full):
        for stream in each.streams.values():
            ages = stream.age_ms
            stream.ages_ns, stream.stated_age_ns = [], None
            stream.unstamped = (stream.unstamped, ages)  # type: ignore[assignment]
    for link in stated.clocks:
        assert [(name, each.state()) for name, each in stated.clocks[link].items()] == [
            (name, each.state()) for name, each in full.clocks[link].items()
        ]
    stated.clocks, full_clocks = full.clocks, full.clocks
    assert full_clocks.keys() == stated.clocks.keys() and facts(stated) == facts(full)


@pytest.mark.parametrize("host", [in_thread, in_process], ids=["thread", "process"])
@pytest.mark.parametrize("compression", ["lz4", "none"])
def test_a_recording_that_is_closed(
    host: Any, compression: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "a.mcap"
    one = recorder(path, host, compression=compression)
    for entry in gateway_session(20, 50):
        one(entry)
    assert one.close({"streams": {}}).failure == ""
    same(capsys, path)
    assert main(["info", str(path)]) == 0
    assert "  figures   of the recorder; its entries are not read: --full reads them\n" in capsys.readouterr().out
    assert main(["verify", str(path)]) == 0


def test_parts_and_each_of_them(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    one = recorder(tmp_path / "a.mcap", split_s=1.0)
    for entry in gateway_session():
        one(entry)
    one.close({"streams": {}})
    parts = sorted((tmp_path / "a").glob("*.mcap"))
    assert len(parts) > 3
    for path in (tmp_path / "a", *parts):
        same(capsys, path)
    parts[1].unlink()
    found = info(capsys, tmp_path / "a")
    assert found["figures"]["entries_read"] and found["figures"]["why"].startswith("figures: found ")
    parts[0].unlink()
    assert info(capsys, tmp_path / "a")["figures"]["entries_read"]


def test_a_recording_that_was_stopped_and_started_again(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    one = recorder(tmp_path / "a.mcap", clock=SystemClock())
    entries = gateway_session(2)
    for entry in entries[:100]:
        one(entry)
    one.stop().result(30)
    one.start().result(30)
    for entry in entries[100:]:
        one(entry)
    one.close({"streams": {}})
    files = list(tmp_path.glob("*.mcap"))
    assert len(files) == 2
    for path in files:
        same(capsys, path)


def test_a_snapshot_and_the_black_box(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    entries = gateway_session()
    one = recorder(tmp_path / "a.mcap", snapshot_s=2.0)
    for entry in entries:
        one(entry)
    same(capsys, one.snapshot().result(30))
    one.close({})
    two = recorder(tmp_path / "b.mcap", snapshot_s=2.0, triggers=(trigger("mark=slip,after=0.1"),))
    mark = MarkNote("slip").note().pack()
    for entry in (*entries, Entry(entries[-1].seq + 1, entries[-1].stamp_ns + 1, Kind.EDGE_NOTE, payload=(mark,))):
        two(entry)
    two.close({})
    (box,) = tmp_path.glob("b*.mcap")
    same(capsys, box)


_CHILD = """
import sys, time
from pathlib import Path
from igtl_gateway.base.clock import SystemClock
from igtl_gateway.record.recorder import Recorder
from tests.record import samples
recorder = Recorder(Path(sys.argv[1]), {}, qos_of=lambda *_: None, on_note=print, clock=SystemClock())
for seq in range(1, 2000):
    recorder(samples.igtl(seq, source_ns=samples.START_NS))
print("given", flush=True)
time.sleep(60)
"""


def test_a_bridge_that_is_killed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "a.mcap"
    with subprocess.Popen([sys.executable, "-c", _CHILD, str(path)], cwd=ROOT, stdout=subprocess.PIPE) as child:
        assert child.stdout and child.stdout.readline() == b"given\n"
        child.kill()
    closed(path).close()
    same(capsys, path)


def test_a_recorder_that_is_killed_and_what_recover_makes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path, copy = tmp_path / "a.mcap", tmp_path / "b.mcap"
    one = recorder(path, in_process, SystemClock(), flush_s=0.2)
    for entry in gateway_session(2):
        one(entry)
    wait_until(lambda: path.stat().st_size > 10_000)
    (worker,) = workers(os.getpid())
    os.kill(worker, signal.SIGKILL)
    wait_until(lambda: bool(one.counters()["failure"]))
    one.close({})
    assert "damaged" in info(capsys, path)
    assert main(["recover", str(path), "-o", str(copy)]) in (0, 1)
    same(capsys, copy, counted=False)


def recorded(path: Path, entries: list[Entry] | None = None) -> Path:
    """A recording with figures."""
    writer = SessionWriter(path, SESSION, counted=True)
    for entry in entries or gateway_session(3):
        writer.write(entry)
    writer.close({"streams": {}})
    return path


def stale(path: Path) -> bool:
    """Whether a file has figures that another reader finds."""
    with path.open("rb") as stream:
        return any(each.name == layout.FIGURES_METADATA for each in make_reader(stream).iter_metadata())


VERBS: dict[str, Callable[[Path, Path], list[str]]] = {
    "slice": lambda path, out: ["slice", str(path), "-o", str(out), "--start", "1", "--end", "2"],
    "slice of all": lambda path, out: ["slice", str(path), "-o", str(out), "--start", "0", "--end", "99"],
    "recover": lambda path, out: ["recover", str(path), "-o", str(out)],
    "merge": lambda path, out: ["merge", f"a={path}", f"b={FIXTURES / 'star.mcap'}", "--offset", "b=0", "-o", str(out)],
    "deidentify": lambda path, out: ["deidentify", str(path), "-o", str(out)],
}


@pytest.mark.parametrize("verb", VERBS)
def test_a_verb_copies_no_figures(verb: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path, out = recorded(tmp_path / "a.mcap"), tmp_path / "b.mcap"
    assert stale(path)
    assert main(VERBS[verb](path, out)) == 0, capsys.readouterr().err
    assert not stale(out)
    same(capsys, out, counted=False)


def test_de_identified_files_have_no_name_of_a_stream_in_figures(tmp_path: Path) -> None:
    secret = samples.igtl(1, device="JaneDoe")
    path, out = recorded(tmp_path / "a.mcap", [secret]), tmp_path / "b.mcap"
    assert b"JaneDoe" in path.read_bytes()
    main(["deidentify", str(path), "-o", str(out)])
    with SessionFile.open(out) as file:
        assert file.figures() is None


def test_only_the_end_and_the_notes_are_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    entries = [samples.note(1)]
    entries += [samples.igtl(seq, message_type="IMAGE", body=os.urandom(300_000)) for seq in range(2, 40)]
    path = recorded(tmp_path / "a.mcap", entries)
    read = BytesRead(monkeypatch)
    assert main(["info", str(path)]) == 0
    assert read.count < path.stat().st_size / 10
    read = BytesRead(monkeypatch)
    assert main(["info", str(path), "--full"]) == 0
    assert read.count > path.stat().st_size * 0.9


def test_damage_that_only_a_full_read_finds(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    entries = [samples.igtl(seq, message_type="IMAGE", body=os.urandom(300_000)) for seq in range(1, 5)]
    path = recorded(tmp_path / "a.mcap", entries)
    data = bytearray(path.read_bytes())
    data[data.index(entries[1].data())] ^= 1
    path.write_bytes(data)
    assert main(["info", str(path)]) == 0
    assert "--full reads them" in capsys.readouterr().out
    assert main(["info", str(path), "--full"]) == 1
    assert "DAMAGED" in capsys.readouterr().out


def with_items(path: Path, change: Callable[[dict[str, str]], dict[str, str]]) -> Path:
    """A recording whose figures have other items."""
    writer = SessionWriter(path, SESSION, counted=True)
    for entry in gateway_session(3):
        writer.write(entry)
    with pytest.MonkeyPatch.context() as patch:
        right = figures.record_of
        patch.setattr(figures, "record_of", lambda found: change(right(found)))
        writer.close({"streams": {}})
    return path


def _sealed(**items: str) -> Callable[[dict[str, str]], dict[str, str]]:
    return lambda right: layout.seal({**layout.unseal(right), **items})


def _with(name: str, column: str, value: Any, row: int = 0) -> Callable[[dict[str, str]], dict[str, str]]:
    def change(right: dict[str, str]) -> dict[str, str]:
        found = json.loads(right[figures.FILE])
        found[name]["rows"][row][found[name]["columns"].index(column)] = value
        return layout.seal({**layout.unseal(right), figures.FILE: json.dumps(found)})

    return change


@pytest.mark.parametrize(
    "change",
    [
        pytest.param(lambda right: {**right, figures.FILE: right[figures.FILE].replace("0", "1", 1)}, id="a checksum"),
        pytest.param(lambda right: {**right, "crc32": "00000000"}, id="another checksum"),
        pytest.param(lambda right: {"version": "1"}, id="no checksum"),
        pytest.param(_sealed(version="2"), id="a later version"),
        pytest.param(_sealed(file="{"), id="not JSON"),
        pytest.param(_sealed(file="[" * 50_000), id="deep JSON"),
        pytest.param(_sealed(file="null"), id="null"),
        pytest.param(_sealed(file=" " * (9 << 20)), id="too long"),
        pytest.param(_with("streams", "first_ns", 1), id="a time before the recording"),
        pytest.param(_with("streams", "last_ns", 1 << 62), id="a time after it"),
        pytest.param(_with("streams", "longest_pause_ns", 10**15), id="too long a pause"),
        pytest.param(_with("streams", "longest_pause_ns", 0, 1), id="too short a pause"),
        pytest.param(_with("streams", "bytes", 1 << 40), id="more bytes than there are"),
        pytest.param(_with("streams", "channel", "TRANSFORM/Another"), id="another stream"),
        pytest.param(_with("streams", "kind", "ros_in"), id="another kind"),
        pytest.param(_with("streams", "messages", 7), id="other counts"),
        pytest.param(_with("clocks", "messages", 7), id="other counts of clocks"),
    ],
)
def test_figures_that_are_not_right_are_not_used(
    change: Callable[[dict[str, str]], dict[str, str]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = with_items(tmp_path / "a.mcap", change)
    found, full = info(capsys, path), info(capsys, path, "--full")
    told = found.pop("figures")
    assert told["entries_read"] and told["why"] and "a.mcap" not in told["why"]
    assert full.pop("figures") == {"entries_read": True, "why": ""}
    assert found == full
    assert main(["info", str(path)]) == 0
    assert "  figures   of all entries, not of the recorder: " in capsys.readouterr().out
    assert main(["verify", str(path)]) == 0


def test_figures_of_another_file_are_not_used(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    items: list[dict[str, str]] = []
    with_items(tmp_path / "a.mcap", lambda right: items.append(right) or right)  # type: ignore[func-returns-value]
    writer = SessionWriter(tmp_path / "b.mcap", SESSION)
    for entry in gateway_session(3)[:-1]:
        writer.write(entry)
    writer._mcap.flush()
    writer._mcap.add_metadata(layout.FIGURES_METADATA, items[0])
    writer.close({"streams": {}})
    found = info(capsys, tmp_path / "b.mcap")
    assert found["figures"]["entries_read"] and "messages of" in found["figures"]["why"]


def test_equal_entries_give_equal_bytes(tmp_path: Path) -> None:
    one, two = (recorded(tmp_path / f"{name}.mcap").read_bytes() for name in "ab")
    assert one == two


def test_files_without_figures_are_as_before(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = samples.write(tmp_path / "a.mcap", samples.every_kind(3))
    same(capsys, path, counted=False)
    assert main(["info", str(path)]) == 0
    assert "  figures " not in capsys.readouterr().out
