"""``simulate`` on the command line: recordings, and what it refuses.  Live: tests/integration/test_simulate.py."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import NoReturn

import pytest

from igtl_gateway.base.extras import missing
from igtl_gateway.cli import main
from igtl_gateway.config.configuration import Config
from igtl_gateway.record.sessionfile.writer import SessionWriter
from igtl_gateway_lab.cli import stage
from igtl_gateway_lab.simulate.catalogue import SCENARIOS
from igtl_gateway_lab.simulate.star_topics import CAMERA_INFO
from igtl_gateway_lab.stage.live import StageEnd, StageOutcome, StagePlan
from tests.tables import table


def test_a_recording_verifies_and_is_always_the_same(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    first, second = tmp_path / "first.mcap", tmp_path / "second.mcap"
    for path in (first, second):
        assert main(["simulate", "acquisition", "-o", str(path), "--duration", "1.2"]) == 0
    assert first.read_bytes() == second.read_bytes()
    assert main(["verify", str(first)]) == 0
    told = capsys.readouterr().out
    assert "planner      done" in told and "3. at the target after" in told


def test_the_outcome_as_json(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "t.mcap"
    assert main(["simulate", "test-server", "--type", "POINT", "--count", "3", "-o", str(out), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["good"] and told["bytes"] == out.stat().st_size
    assert told["actors"]["test_node"]["facts"]["received"] == 3


def test_scenarios_without_actors_are_written_as_ever(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "t.mcap"
    assert main(["simulate", "paper-types", "-o", str(out), "--json"]) == 0
    assert set(json.loads(capsys.readouterr().out)) == {"file", "entries", "bytes", "sha256", "good"}


@table("name", SCENARIOS)
def test_the_configuration_can_be_given_to_a_bridge(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["simulate", name, "--print-config"]) == 0
    path = tmp_path / "its.toml"
    path.write_text(capsys.readouterr().out, "utf-8")
    assert Config.from_toml(path) == SCENARIOS[name].config


def test_an_existing_file_is_kept(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "t.mcap"
    out.write_bytes(b"precious")
    assert main(["simulate", "acquisition", "-o", str(out)]) == 2
    assert "exists already" in capsys.readouterr().err
    assert out.read_bytes() == b"precious"


def test_half_a_story_leaves_no_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*_: object) -> NoReturn:
        raise KeyboardInterrupt

    out = tmp_path / "t.mcap"
    monkeypatch.setattr(SessionWriter, "write", interrupted)
    assert main(["simulate", "acquisition", "-o", str(out)]) == 1
    assert [*tmp_path.iterdir()] == []


def test_a_duration_that_is_refused_costs_no_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "t.mcap"
    out.write_bytes(b"precious")
    assert main(["simulate", "lego", "--duration", "1", "-o", str(out), "--overwrite"]) == 2
    assert "duration of lego: found 1 s" in capsys.readouterr().err
    assert out.read_bytes() == b"precious"


@table(
    ("words", "told"),
    [
        ("acquisition -o x --duration 0", "--duration: found 0.0, expected more than 0"),
        ("acquisition --timeout 4000", "--timeout: found 4000.0"),
        ("acquisition -o x --record y", "--record is for a live scenario"),
        ("acquisition -o x --view", "--view is for a live scenario"),
        ("acquisition --side igtl --view", "--view: with --side the bridge is yours"),
        ("acquisition -o x --side ros", "--side is for a live scenario"),
        ("acquisition --rate 5", "--rate: acquisition has no load"),
        ("paper-types", "paper-types has no actors to play live"),
        ("acquisition --connect :1", "--connect is for --side igtl"),
        ("acquisition --side igtl --record y", "--record: with --side the bridge is yours"),
        ("test-server --type STRING --size 3", "--size: found 3, expected 30 to 60,000 bytes for STRING"),
        ("acquisition --actor pilot", "--actor: found 'pilot', expected one of planner, robot"),
    ],
)
def test_what_does_not_fit_together_is_refused(words: str, told: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["simulate", *words.split()]) == 2
    assert told in capsys.readouterr().err


def test_the_live_bridge_records_what_is_for_the_recording_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    bridges: list[Sequence[str] | None] = []

    class Nobody:
        """In place of the programs: only how the bridge was to be started is of interest."""

        def __init__(self, plan: StagePlan, *_: object) -> None:
            bridges.append(plan.bridge)

        def run(self) -> StageOutcome:
            return StageOutcome(StageEnd.INTERRUPTED, {}, {}, 0.0, (), None)

    monkeypatch.setattr(stage, "Stage", Nobody)
    for name in ("star", "acquisition"):
        assert main(["simulate", name]) == 1
    star, acquisition = (list(words or ()) for words in bridges)
    assert star[star.index("--record-topics") + 1 : star.index("--custom-data")] == [CAMERA_INFO]
    assert acquisition and "--record-topics" not in acquisition


def test_without_ros_it_says_what_to_do(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda _name: None)
    assert main(["simulate", "acquisition"]) == 1
    assert capsys.readouterr().err.startswith(f"igtl-gateway simulate: {missing('rclpy')}; -o FILE")
