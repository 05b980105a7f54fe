"""``igtl-gateway merge``, and what other verbs make of a merged session."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest

import igtl_gateway
from igtl_gateway.base.errors import ConfigError
from igtl_gateway.base.stamp import ns_to_ticks
from igtl_gateway.cli import main
from igtl_gateway.config.configuration import Config
from igtl_gateway.convert.common_msgs import PoseStamped
from igtl_gateway.convert.rosmsg import Header
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.record.sessionfile.writer import SessionWriter
from igtl_gateway.wire import Message
from igtl_gateway.wire.transform import Transform
from tests.script import Script
from tools.evidence.merge_worlds import START_NS, World, record
from tools.truth import wire


@pytest.fixture
def two(tmp_path: Path) -> list[str]:
    recordings = record(World(seconds=3), tmp_path, 1)
    return [str(source.path) for source in recordings.sources]


def test_the_verbs_read_a_merged_session_and_its_parts(
    two: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "both.mcap"
    assert main(["merge", two[0], f"planning={two[1]}", "-o", str(out)]) == 0
    text = capsys.readouterr().out
    assert "planning  r1.mcap" in text and "messages in both directions" in text
    found = re.search(r"\+1,([\d.]+) ms and \+1,([\d.]+) ms", text)  # with microseconds: the bounds differ
    assert found and float(found[1]) < 700 < float(found[2])
    assert main(["info", str(out), "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert [part["name"] for part in facts["merge"]["parts"]] == ["r0", "planning"]
    assert main(["info", str(out)]) == 0
    assert "merged session of 2 parts" in capsys.readouterr().out
    assert main(["info", f"{out}/planning"]) == 0
    assert "/remote/to1/pose" in capsys.readouterr().out
    assert main(["verify", str(out), "--json"]) == 1  # these recordings hold outputs of no gateway
    assert [part["file"] for part in json.loads(capsys.readouterr().out)["parts"]] == [f"{out}/r0", f"{out}/planning"]
    again = tmp_path / "again.mcap"
    assert main(["merge", str(out), "--extract", "planning", "-o", str(again)]) == 0
    assert main(["diff", str(again), two[1]]) == 0


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (["--offset", "r1"], "--offset: found 'r1', expected NAME=SECONDS"),
        (["--offset", "r1=nan"], "--offset: found 'r1=nan', expected NAME=SECONDS"),
        (["--offset", "r9=1"], "offset of 'r9': found no such part, expected one of r1"),
        (["--sync", "/a", "/b", "--offset", "r1=1"], "--sync: expected two recordings and no --offset"),
        (["--sync", "/a", "/b"], "found no stream '/a', expected a recorded stream"),
        (["--max-lag", "2"], "--max-lag: found no --sync STREAM STREAM, expected it: the option has no effect here"),
        (["--extract", "r1"], "--extract: expected one merged session"),
    ],
)
def test_wrong_options(
    words: list[str], text: str, two: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "both.mcap"
    assert main(["merge", *two, "-o", str(out), *words]) in (1, 2)
    assert text in capsys.readouterr().err
    assert not out.exists()


def test_the_output_is_required(two: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as end:
        main(["merge", *two])
    assert end.value.code == 2 and "-o" in capsys.readouterr().err


def test_wrong_files(two: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "b=c.mcap"
    shutil.copy(two[0], out)
    assert main(["merge", *two, "-o", str(out)]) == 2
    assert "exists already" in capsys.readouterr().err
    assert main(["merge", *two, "-o", two[0], "--overwrite"]) == 2
    assert "found a recording that is merged" in capsys.readouterr().err
    assert main(["merge", two[0], f"a b={two[1]}", "-o", str(tmp_path / "x.mcap")]) == 2
    assert "found the name 'a b', expected letters, digits and _" in capsys.readouterr().err
    assert main(["merge", two[0], str(out), "-o", str(tmp_path / "x.mcap")]) == 2  # the same, by another name
    assert "b=c.mcap: found the same recording" in capsys.readouterr().err
    assert main(["merge", two[0], "--extract", "r1", "-o", str(tmp_path / "x.mcap")]) == 2
    assert "which is not a merged session" in capsys.readouterr().err


def test_offset_from_what_moves(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    times = np.arange(0, 40, 0.02)
    places = 0.05 * np.sum([np.sin(rate * times + rate**2) for rate in (1.1, 1.73, 2.9, 4.19)], axis=0)
    files = []
    for name, ahead_ns in (("one", 0), ("two", 123_000_000)):
        path = tmp_path / f"{name}.mcap"
        writer = SessionWriter(path, {"format_version": "1", "config": "{}"})
        for number, (second, place) in enumerate(zip(times, places, strict=True), 1):
            stamp_ns = START_NS + round(second * 1e9) + ahead_ns
            pose = float(place), 0.0, 0.0, 0.0, 0.0, 0.0, 1.0
            payload = PoseStamped(Header(number, name), pose).pack()
            writer.write(Entry(number, stamp_ns, Kind.ROS_IN, f"/{name}/pose", PoseStamped.TYPE, (payload,)))
        writer.close({})
        files.append(str(path))
    out = tmp_path / "both.mcap"
    assert main(["merge", *files, "-o", str(out), "--sync", "/one/pose", "/two/pose", "--json"]) == 0
    clock = json.loads(capsys.readouterr().out)["parts"][1]["clock"]
    assert clock["method"] == "streams"
    assert clock["low_s"] <= 0.123 <= clock["high_s"]
    assert abs(clock["offset_s"] - 0.123) < 0.005


def test_a_clock_that_was_set_has_no_single_offset(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    sources = record(World(seconds=8, step_s=5.0), tmp_path, 1).sources
    out = tmp_path / "both.mcap"
    assert main(["merge", *(str(source.path) for source in sources), "-o", str(out)]) == 0
    remark = "the clock of r1 was set, or its rate changed, 1 time: the offset is that in the middle of the session"
    assert remark in " ".join(capsys.readouterr().out.split())
    assert main(["info", str(out)]) == 0
    assert remark in " ".join(capsys.readouterr().out.split())


def test_what_a_part_reported_is_stated_wherever_the_merged_session_is_read(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    script = Script()
    script.up(1)
    script.up(3)
    pose = Transform((1, 0, 0, 0, 1, 0, 0, 0, 1, 250.0, 0, 0))
    for link in (1, 3, 1, 3):
        script.igtl(Message("TRANSFORM", "ProbeToTracker", pose, ns_to_ticks(script.now_ns)), link)
    for _ in range(2):
        script.feed(
            Kind.IGTL_IN, (wire.message("TRANSFORM", "Newer", wire.transform(np.eye(4)), 0, version=4),), link=1
        )
    parts = [tmp_path / "a.mcap", tmp_path / "b.mcap"]
    for number, part in enumerate(parts):
        writer = SessionWriter(part, {"config": json.dumps(Config().to_dict())})
        for entry in script.log[: -number or None]:
            writer.write(entry)
        writer.close({})
    out = tmp_path / "both.mcap"
    assert main(["merge", *map(str, parts), "-o", str(out), "--offset", "b=0"]) == 0
    refused = "TRANSFORM/Newer, 2 times: message refused: header, version: found 4"
    shared = "share one topic and one frame, /a/igtl/in/ProbeToTracker/transform"
    assert f"reported by a: {refused}" in capsys.readouterr().out
    for words in (["info", str(out)], ["export", str(out), "--to", "parquet", "-o", str(tmp_path / "tables")]):
        main(words)
        text = capsys.readouterr().out
        assert f"reported by a: {refused}" in text and shared in text
    with igtl_gateway.open(out) as recording:
        assert any(refused in each for each in recording.warnings)
        with pytest.raises(ConfigError, match=r"open\('.*both.mcap/a'\)\['TRANSFORM/ProbeToTracker@LINK'\]"):
            recording["/a/igtl/in/ProbeToTracker/transform"].poses()
