"""``info`` on recordings that are a part of something, or made of parts."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from igtl_gateway.cli import main
from igtl_gateway.config.configuration import Config
from igtl_gateway.gateway.live_settings import LiveSettings
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.record.sessionfile.writer import SessionWriter
from tests.files import BytesRead
from tests.places import FIXTURES
from tests.record import samples

SESSION = {**samples.SESSION, "config": json.dumps(Config().to_dict())}


def write(path: Path, entries: list[Entry], **facts: str) -> int:
    """A session file; its size."""
    writer = SessionWriter(path, {**SESSION, **facts})
    for entry in entries:
        writer.write(entry)
    writer.close({"streams": {}})
    return path.stat().st_size


def said(capsys: pytest.CaptureFixture[str], path: Path, *options: str) -> str:
    assert main(["info", str(path), *options]) == 0
    return capsys.readouterr().out


def test_a_split_recording_is_told_as_one_and_by_its_parts(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "long"
    folder.mkdir()
    entries = samples.every_kind(20)
    sizes = [
        write(folder / "long_0.mcap", entries[:70], part="0"),
        write(folder / "long_1.mcap", entries[70:105], part="1", previous_part="long_0.mcap"),
        write(folder / "long_2.mcap", [], part="2", previous_part="long_1.mcap"),
    ]
    told = json.loads(said(capsys, folder, "--json"))
    assert (told["bytes"], told["entries"]) == (sum(sizes), 105)
    assert [(part["file"], part["bytes"], part["entries"]) for part in told["parts"]] == [
        ("long_0.mcap", sizes[0], 70),
        ("long_1.mcap", sizes[1], 35),
        ("long_2.mcap", sizes[2], 0),
    ]
    assert told["parts"][0]["start"] == told["start"]
    assert told["parts"][1]["duration_s"] == (entries[104].stamp_ns - entries[70].stamp_ns) / 1e9
    text = said(capsys, folder)
    assert text.startswith(f"{folder}: session log version 1, 3 parts, {sum(sizes) / 1000:.1f} kB\n")
    rows = [line.split() for line in text.partition("  parts\n")[2].splitlines()[1:4]]
    assert [(row[0], row[1]) for row in rows] == [("long_0.mcap", "70"), ("long_1.mcap", "35"), ("long_2.mcap", "0")]
    assert len(rows[2]) == 4, "an empty part has no start and no duration"
    assert "part      1 of a split recording, after long_0.mcap\n" in said(capsys, folder / "long_1.mcap")
    assert "parts" not in json.loads(said(capsys, folder / "long_1.mcap", "--json"))


@pytest.mark.parametrize(
    ("kept", "line", "code"),
    [
        (
            (1, 2, 3),
            "part 0 of the recording: its entries are not here; the prologue of part 1 has the state before it",
            0,
        ),
        (
            (2, 3),
            "parts 0 to 1 of the recording: their entries are not here; the prologue of part 2 has the state before it",
            0,
        ),
        ((0, 2, 3), "part 1 of the recording: its entries are not here", 1),
        ((1, 3), "parts 0 and 2 of the recording: their entries are not here", 1),
    ],
)
def test_missing_parts_are_named_and_the_rest_is_shown(
    kept: tuple[int, ...], line: str, code: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "long"
    folder.mkdir()
    entries = samples.every_kind(20)
    for number in kept:
        before = {"previous_part": f"long_{number - 1}.mcap"} if number else {}
        write(folder / f"long_{number}.mcap", entries[number * 20 : number * 20 + 20], part=str(number), **before)
    (folder / "metadata.yaml").write_text("rosbag2_bagfile_information:\n  version: 9\n")
    assert main(["info", str(folder)]) == code
    text = capsys.readouterr().out
    assert f"  MISSING   {line}" in text
    assert all(f"long_{number}.mcap  " in text for number in kept)
    assert main(["info", str(folder), "--json"]) == code
    told = json.loads(capsys.readouterr().out)
    assert told["entries"] == 20 * len(kept)
    assert [number for first, last in told["missing_parts"] for number in range(first, last + 1)] == [
        number for number in range(max(kept)) if number not in kept
    ]


def test_what_a_file_is_a_part_of_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "snap.mcap"
    write(path, [], snapshot_seconds="30", record_include='["TRANSFORM/*", "/tf"]', record_exclude='["IMAGE/*"]')
    text = said(capsys, path)
    assert "snapshot  of the last 30 s before the request\n" in text
    assert "recorded  only TRANSFORM/* /tf\n" in text
    assert "recorded  without IMAGE/*\n" in text

    part = tmp_path / "part.mcap"
    whole = FIXTURES / "star.mcap"
    assert main(["slice", str(whole), "-o", str(part), "--start", "1", "--end", "2", "--streams", "TRANSFORM/*"]) == 0
    capsys.readouterr()
    facts = json.loads(said(capsys, part, "--json"))["session"]
    line = next(line for line in said(capsys, part).splitlines() if line.startswith("  slice "))
    assert line.split()[1:3] == ["of", "star.mcap,"] and line.endswith("streams TRANSFORM/*")
    assert f".{int(facts['slice_start_ns']) % 10**9 // 10**6:03}Z to " in line
    assert not any(word in said(capsys, whole) for word in ("slice ", "snapshot ", "recorded  ", "parts\n"))


def test_a_recording_in_progress_is_told_as_such(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "now.mcap"
    writer = SessionWriter(path, SESSION)
    for entry in samples.every_kind(3):
        writer.write(entry)
    writer.flush()
    text = said(capsys, path)
    assert "  BEING RECORDED: content up to the last flush" in text
    assert "21 entries" in text
    assert not any(word in text for word in ("DAMAGED", "LOST", "recover"))
    told = json.loads(said(capsys, path, "--json"))
    assert (told["being_recorded"], told["entries"], "damaged" in told) == (True, 21, False)
    assert main(["verify", str(path)]) == 1
    assert f"igtl-gateway verify: {path}: is being recorded (" in capsys.readouterr().err
    writer.close({})
    assert "being_recorded" not in json.loads(said(capsys, path, "--json"))


def test_a_file_that_was_cut_off_is_not_being_recorded(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "cut.mcap"
    write(path, samples.every_kind(3))
    path.write_bytes(path.read_bytes()[:-300])
    assert main(["info", str(path)]) == 1
    assert "igtl-gateway recover" in capsys.readouterr().err


def test_the_age_of_stamps_is_a_median_and_its_range_is_max_minus_min(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "ages.mcap"
    ages_ms = (5, 1, 101, 2, 4)
    entries = [
        samples.igtl(seq, source_ns=samples.START_NS + seq - age_ms * 1_000_000)
        for seq, age_ms in enumerate(ages_ms, 1)
    ]
    write(path, entries)
    (stream,) = json.loads(said(capsys, path, "--json"))["streams"]
    assert stream["age_median_ms"] == pytest.approx(4, abs=1e-3)
    assert stream["age_max_minus_min_ms"] == pytest.approx(100, abs=1e-3)
    assert stream["stamps"] == "median age 4 ms, varies by 100 ms"
    assert "median age 4 ms, varies by 100 ms" in said(capsys, path)


def test_a_recording_is_read_once(monkeypatch: pytest.MonkeyPatch) -> None:
    path = FIXTURES / "star.mcap"
    read = BytesRead(monkeypatch)
    assert main(["info", str(path)]) == 0
    assert read.count < 1.05 * path.stat().st_size


def test_changes_of_settings_are_shown(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "session.mcap"
    before = LiveSettings()
    changes = [before.changed({"deny_in": ["COMMAND"]}), before.changed({"active": False})]
    notes = [changes[0].note(before), changes[1].note(changes[0])]
    entries = enumerate(notes, start=1)
    write(path, [Entry(seq, samples.START_NS + seq, Kind.EDGE_NOTE, payload=(note.pack(),)) for seq, note in entries])
    text = said(capsys, path).partition("  settings\n")[2]
    assert 'changed: deny_in from [] to ["COMMAND"]\n' in text
    assert 'changed: deny_in from ["COMMAND"] to [], active from true to false\n' in text
    told = json.loads(said(capsys, path, "--json"))["changes"]
    assert [change["settings"]["active"] for change in told] == [True, False]


def test_what_restores_the_state_of_a_slice_is_in_no_rate_and_no_gap(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    part = tmp_path / "part.mcap"
    assert main(["slice", str(FIXTURES / "crtk.mcap"), "-o", str(part), "--start", "2", "--end", "3"]) == 0
    capsys.readouterr()
    assert main(["info", str(part)]) == 0
    assert "messages of before the slice: counted here" in capsys.readouterr().out
    assert main(["info", str(part), "--json"]) == 0
    rows = {row["stream"]: row for row in json.loads(capsys.readouterr().out)["streams"]}
    early, mixed = rows["STRING/PSM1/state_command"], rows["TRANSFORM/PSM1/servo_cp"]
    assert (early["messages"], early["restores"], early["rate_hz"]) == (2, 2, 0)
    assert (mixed["messages"], mixed["restores"]) == (42, 21) and not mixed["gap"]
    assert main(["info", str(FIXTURES / "crtk.mcap")]) == 0 and "before the slice" not in capsys.readouterr().out
