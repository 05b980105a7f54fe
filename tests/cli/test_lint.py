"""``lint``: the rules on recordings, whole and damaged."""

from __future__ import annotations

import fcntl
import json
from pathlib import Path
from typing import Any

import pytest

from igtl_gateway.cli import main
from tests.places import FIXTURES


def linted(capsys: pytest.CaptureFixture[str], path: Path) -> tuple[int, dict[str, Any]]:
    code = main(["lint", str(path), "--json"])
    return code, json.loads(capsys.readouterr().out)


def test_a_recording_without_fault(capsys: pytest.CaptureFixture[str]) -> None:
    code, told = linted(capsys, FIXTURES / "star.mcap")
    assert (code, told["findings"], told["cause"], told["nothing_arrives"]) == (0, [], None, False)
    assert {stream["stream"] for stream in told["streams"]} >= {"STRING/Navigation", "POINT/PlanPoints"}
    assert main(["lint", str(FIXTURES / "star.mcap")]) == 0
    out = capsys.readouterr().out
    assert "star.mcap: 3 OpenIGTLink streams\n" in out and out.endswith("no problems found\n")


def test_errors_are_found_and_told(capsys: pytest.CaptureFixture[str]) -> None:
    code, told = linted(capsys, FIXTURES / "every-type.mcap")
    ids = [finding["id"] for finding in told["findings"]]
    assert code == 1 and {"IGTL-E207", "IGTL-E210", "IGTL-W504", "IGTL-W505"} <= set(ids)
    assert told["cause"]["id"] == "IGTL-E207" and told["cause"]["where"] == "STRING/Greeting"
    assert main(["lint", str(FIXTURES / "every-type.mcap")]) == 1
    lines = capsys.readouterr().out.splitlines()
    assert any(line.startswith("ERROR   IGTL-E207  CRC wrong") for line in lines)
    assert any(line.endswith("more, see --json") for line in lines)


def test_a_damaged_recording_is_judged_as_far_as_it_can_be_read(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "cut.mcap"
    data = (FIXTURES / "paper-types.mcap").read_bytes()
    path.write_bytes(data[: len(data) * 3 // 4])
    code, told = linted(capsys, path)
    assert (code, told["cause"]["id"]) == (1, "IGTL-E701")
    assert told["streams"]


def test_a_recording_that_goes_on_is_not_recovered(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "growing.mcap"
    data = (FIXTURES / "paper-types.mcap").read_bytes()
    path.write_bytes(data[: len(data) * 3 // 4])
    with path.open("ab") as writer:
        fcntl.flock(writer, fcntl.LOCK_EX)
        _, found = linted(capsys, path)
    ids = [one["id"] for one in found["findings"]]
    assert "IGTL-I705" in ids and "IGTL-E701" not in ids
    assert "recover" not in json.dumps(found)


def test_what_is_no_recording_is_usage(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["lint", str(tmp_path / "absent.mcap")]) == 2
    assert "absent.mcap" in capsys.readouterr().err


def test_a_recording_without_a_configured_stream(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "bridge.toml"
    path.write_text('[[to_igtl]]\ntopic = "/igtl/out/Robot/strng"\n[[to_ros]]\ndevice = "Planer"\n', "utf-8")
    assert main(["doctor", str(FIXTURES / "acquisition.mcap"), "--config", str(path), "--json"]) == 0
    found = [one for one in json.loads(capsys.readouterr().out)["findings"] if one["id"] == "IGTL-W607"]
    assert [one["where"] for one in found] == ["/igtl/out/Robot/strng", "Planer"]
    assert "/igtl/out/Robot/string" in found[0]["text"] and "Planner" in found[1]["text"]


def test_a_missing_source_is_named_once(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "bridge.toml"
    path.write_text('[[to_igtl]]\ntopic = "/tol"\n', "utf-8")
    assert main(["doctor", str(FIXTURES / "acquisition.mcap"), "--config", str(path)]) == 0
    assert "        - topic /tol: no publisher" in capsys.readouterr().out
