"""``igtl-gateway import``, and what the other verbs make of its files."""

from __future__ import annotations

import json
import sqlite3
import zlib
from collections.abc import Callable
from pathlib import Path

import pytest

from igtl_gateway.app.replay_plan import plan_replay
from igtl_gateway.base.buffers import join
from igtl_gateway.cli import FAILURE, USAGE, main
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.wire import Message, decode, encode
from igtl_gateway.wire.text import String
from tests.files import CAPTURES
from tests.foreign_bags import humanoid, talker, topics_and_services
from tests.plus_sequences import ultrasound
from tests.record.sessionfile import conformance


def message(text: str) -> bytes:
    return join(encode(Message("STRING", "Said", String.of(text))))


def sequence(path: Path) -> Path:
    lines = ["NDims = 3", "CompressedData = True", "DimSize = 2 2 2", "ElementType = MET_UCHAR"]
    for frame in range(2):
        lines += [
            f"Seq_Frame000{frame}_ProbeToTrackerTransform = 1 0 0 {frame} 0 1 0 2 0 0 1 3 0 0 0 1",
            f"Seq_Frame000{frame}_ProbeToTrackerTransformStatus = OK",
            f"Seq_Frame000{frame}_Timestamp = {frame}.5",
        ]
    path.write_bytes("\n".join([*lines, "ElementDataFile = LOCAL", ""]).encode() + zlib.compress(b"abcdefgh"))
    return path


def entries(path: Path) -> list[Entry]:
    with SessionFile.open(path) as file:
        return list(file.entries())


def test_a_sequence_replays_as_transforms_and_images_with_their_own_stamps(tmp_path: Path) -> None:
    out = tmp_path / "out.mcap"
    source = sequence(tmp_path / "some.igs.mha")
    assert main(["import", str(source), "-o", str(out), "--epoch", "2020-01-01T00:00:00Z"]) == 0
    start = 1_577_836_800 * 10**9
    with SessionFile.open(out) as file:
        how = plan_replay(file, "igtl", False)
        assert (how.recompute, set(how.kinds)) == (False, {Kind.IGTL_IN})
    sent = [entry for entry in entries(out) if entry.kind is Kind.IGTL_IN]
    assert [(entry.channel, entry.source_ns - start) for entry in sent] == [
        ("TRANSFORM/ProbeToTracker", 500_000_000),
        ("IMAGE/Image", 500_000_000),
        ("TRANSFORM/ProbeToTracker", 1_500_000_000),
        ("IMAGE/Image", 1_500_000_000),
    ]
    assert bytes(decode(sent[3].payload[0]).content.pixels) == b"efgh"  # type: ignore[attr-defined]


def test_equal_sources_give_equal_files(tmp_path: Path) -> None:
    source = sequence(tmp_path / "some.igs.mha")
    for name in ("a.mcap", "b.mcap"):
        assert main(["import", str(source), "-o", str(tmp_path / name)]) == 0
    assert (tmp_path / "a.mcap").read_bytes() == (tmp_path / "b.mcap").read_bytes()


def test_the_account_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source = tmp_path / "some.c2s.igtl"
    source.write_bytes(message("a") + message("b"))
    assert main(["import", str(source), "-o", str(tmp_path / "out.mcap"), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert (told["format"], told["good"], told["entries"]) == ("igtl", True, 4)
    assert [(row["unit"], row["imported"]) for row in told["rows"]] == [
        ("bytes", source.stat().st_size),
        ("messages", 2),
    ]
    assert main(["info", str(tmp_path / "out.mcap")]) == 0
    assert "STRING/Said" in capsys.readouterr().out


def test_what_is_missing_is_a_failure_and_the_rest_is_there(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source = tmp_path / "some.c2s.igtl"
    source.write_bytes(message("a") + message("b")[:-1])
    out = tmp_path / "out.mcap"
    assert main(["import", str(source), "-o", str(out)]) == FAILURE
    assert "DIFFERENT" in capsys.readouterr().out
    assert [bytes(entry.data()) for entry in entries(out) if entry.kind is Kind.IGTL_IN] == [message("a")]
    broken = bytearray(message("b"))
    broken[42] = 0xFF
    source.write_bytes(message("a") + broken)
    before = out.read_bytes()
    assert main(["import", str(source), "-o", str(out), "--overwrite"]) == FAILURE
    assert "out.mcap: not written; --partial writes the 1 message before the damage" in capsys.readouterr().out
    assert out.read_bytes() == before
    out.unlink()
    assert main(["import", str(source), "-o", str(out)]) == FAILURE
    assert sorted(tmp_path.iterdir()) == [source]
    assert main(["import", str(source), "-o", str(out), "--partial"]) == FAILURE
    assert "FAILED" in capsys.readouterr().out
    assert [bytes(entry.data()) for entry in entries(out) if entry.kind is Kind.IGTL_IN] == [message("a")]


def test_times_that_no_session_holds_are_a_failure(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    base = sqlite3.connect(tmp_path / "some.db3")
    base.execute("CREATE TABLE topics(id INTEGER PRIMARY KEY, name, type, serialization_format)")
    base.execute("CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id, timestamp, data)")
    base.execute("INSERT INTO topics VALUES(1, '/topic', 'std_msgs/msg/Empty', 'cdr')")
    base.executemany("INSERT INTO messages VALUES(?, 1, ?, x'0001000000')", [(1, 7), (2, 2**63 - 1)])
    base.executemany("INSERT INTO messages VALUES(?, 1, ?, x'0001000000')", [(3, 2.0**70)])
    base.commit()
    base.close()
    assert main(["import", str(tmp_path / "some.db3"), "-o", str(tmp_path / "out.mcap")]) == FAILURE
    assert "DIFFERENT" in capsys.readouterr().out
    assert len(entries(tmp_path / "out.mcap")) == 1


def test_wrong_use(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source = tmp_path / "some.igtl"
    source.write_bytes(message("a"))
    assert main(["import", str(tmp_path / "absent"), "-o", str(tmp_path / "out.mcap")]) == USAGE
    with pytest.raises(SystemExit, match="2"):
        main(["import", str(source), "-o", str(source), "--overwrite"])
    assert source.read_bytes() == message("a")
    assert main(["import", str(source), "-o", str(tmp_path / "out.mcap")]) == 0
    assert main(["import", str(source), "-o", str(tmp_path / "out.mcap")]) == USAGE
    capsys.readouterr()
    with pytest.raises(SystemExit, match="2"):
        main(["import", str(source), "-o", "x", "--epoch", "yesterday"])
    assert "found 'yesterday'" in capsys.readouterr().err


def test_a_session_is_not_imported_again(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source = tmp_path / "some.igtl"
    source.write_bytes(message("a"))
    assert main(["import", str(source), "-o", str(tmp_path / "out.mcap")]) == 0
    assert main(["import", str(tmp_path / "out.mcap"), "-o", str(tmp_path / "again.mcap")]) == USAGE
    assert "found a session of igtl-gateway, which needs no import" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("write", "name", "count"),
    [
        (humanoid, "some.bag", 321),
        (talker, "talker", 20),
        (topics_and_services, "some.mcap", 13),
        (ultrasound, "some.igs.mha", 84),
        (lambda _: CAPTURES / "reference_mixed.pcap", "", 64),
    ],
)
def test_files_of_others(tmp_path: Path, write: Callable[[Path], Path], name: str, count: int) -> None:
    out = tmp_path / "out.mcap"
    assert main(["import", str(write(tmp_path / name)), "-o", str(out)]) == 0
    assert sum(entry.kind in (Kind.IGTL_IN, Kind.ROS_IN) for entry in entries(out)) == count


def test_there_is_nothing_to_verify(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out.mcap"
    assert main(["import", str(sequence(tmp_path / "some.igs.mha")), "-o", str(out)]) == 0
    capsys.readouterr()
    assert main(["verify", str(out)]) == USAGE
    assert "found an import (sequence)" in capsys.readouterr().err


def test_a_truncated_mcap_file_ends_in_a_sentence(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    whole = next(file for file in conformance.files() if file.messages)
    path = tmp_path / "cut.mcap"
    path.write_bytes(whole.data[: len(whole.data) // 2])
    assert main(["import", str(path), "-o", str(tmp_path / "out.mcap")]) == FAILURE
    error = capsys.readouterr().err
    assert f"was cut off after {len(whole.data) // 2} bytes" in error and "recover" in error
