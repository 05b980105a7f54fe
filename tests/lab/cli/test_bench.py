"""``igtl-gateway bench``: options, the table, and one small real run."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import pytest

from igtl_gateway.cli import main
from igtl_gateway_lab.bench.probe import lacks_probe
from igtl_gateway_lab.bench.runner import BenchPlan, Runner
from igtl_gateway_lab.bench.sweeps import SWEEPS
from igtl_gateway_lab.bench.works import WORKS
from tests.places import ROOT
from tests.tables import table

FIGURES = {"p50_ms": 0.5, "p99_ms": 1.0, "p999_ms": 1.5, "mean_ms": 0.6, "sd_ms": 0.1, "max_ms": 2.0}


@pytest.fixture
def plans(monkeypatch: pytest.MonkeyPatch) -> list[BenchPlan]:
    """What would be measured; rows that are made up come of it."""
    asked: list[BenchPlan] = []

    def measure(_runner: Runner, plan: BenchPlan) -> list[dict[str, Any]]:
        asked.append(plan)
        others: list[dict[str, Any]] = [{}, *({"bridge": command} for command in plan.against)]
        slower = {"p50_ms": 0.55, "p99_ms": 1.5} if plan.record else {}
        (stream, *_) = plan.case.streams
        return [
            {"case": plan.case.name, "direction": way.value, "rate_hz": stream.rate_hz or None}
            | {"recording": plan.record, "sent": 1000, "delivered": 999, "received_per_s": 30.0}
            | {**FIGURES, **slower, **other}
            for other in others
            for way in plan.directions
        ]

    monkeypatch.setattr(Runner, "measure", measure)
    return asked


@table(
    ("words", "fault"),
    [
        ([], "nothing to measure"),
        (["--case", "nonsense"], "found 'nonsense', expected one of transform"),
        (["--case", "transform", "--rate", "0"], "--rate: found 0"),
        (["--case", "transform", "--count", "-1"], "--count: found -1"),
        (["--case", "transform", "--duration", "inf"], "--duration: found inf"),
        (["--case", "mixed", "--flood"], "mixed has rates of its own"),
        (["--case", "transform", "--rounds", "0"], "--rounds: found 0"),
        (["--case", "stalled-client", "--direction", "igtl-to-ros"], "stalled-client goes ros-to-igtl only"),
        (["--sweep", "clients", "--direction", "igtl-to-ros"], "--sweep clients goes the other way only"),
        (["--case", "transform", "--against", "x 'y"], "expected a command (No closing quotation)"),
        (["--case", "transform", "--against", "bridge 18944"], "found 'bridge 18944', expected {port} in it"),
        (["--case", "transform", "--peer", "slicer"], "--peer slicer: found transform"),
        (["--case", "transform-n", "--peer", "slicer", "--direction", "ros-to-igtl"], "found transform-n ros-to-igtl"),
        (["--case", "transform", "--flame", "x.svg"], "--flame: found 2 measurements, expected one"),
    ],
)
def test_what_is_refused(words: list[str], fault: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", *words]) == 2
    assert fault in capsys.readouterr().err


def test_the_cases_are_listed(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", "--list"]) == 0
    told = capsys.readouterr().out
    assert "image-fullhd" in told and "mixed" in told
    assert all(name in told for name in (*WORKS, *SWEEPS))


@pytest.mark.ros
def test_the_papers_table(plans: list[BenchPlan]) -> None:
    assert main(["bench", "--table1", "--json"]) == 0
    assert len(plans) == 11
    assert {plan.extent.count for plan in plans} == {1000}
    assert {stream.rate_hz for plan in plans for stream in plan.case.streams} == {30.0}


@pytest.mark.ros
def test_the_table(plans: list[BenchPlan], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", "--case", "transform", "--direction", "igtl-to-ros", "--flood", "--record"]) == 0
    assert [(plan.record, plan.floor) for plan in plans] == [(False, True), (True, False)]
    head, first, second, cost, *_, load, versions = capsys.readouterr().out.splitlines()
    assert head.split()[:4] == ["case", "direction", "Hz", "sent"]
    assert first.split()[:6] == ["transform", "igtl-to-ros", "flood", "1,000", "999", "30"]
    assert first.endswith("not lost <= 0, received_per_s >= 30000")
    assert second.startswith("transform +rec")
    assert cost == "transform +rec, igtl-to-ros: p50 1.1 times and p99 1.5 times that without recording"
    assert load.startswith("load ") and "Python" in versions


@pytest.mark.ros
def test_what_is_compared_with_what(plans: list[BenchPlan], monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr("igtl_gateway_lab.bench.flame.tool", lambda: "py-spy")
    words = ["bench", "--programs", "native", "--against", "x {port}", "--direction", "ros-to-igtl", "--json", "--case"]
    assert main([*words, "transform", "--record"]) == 0
    assert main([*words, "stalled-client"]) == 0
    assert main([*words, "transform", "--flame", str(tmp_path / "x.svg")]) == 0
    assert main(["bench", "--case", "transform", "--programs", "python", "--json"]) == 0
    assert [(plan.floor, plan.hop, plan.against) for plan in plans] == [
        (True, True, ("x {port}",)),
        (False, False, ()),  # with recording
        (False, False, ()),  # two clients
        (True, False, ()),  # drawn
        (True, False, ()),  # in Python
    ]


@pytest.mark.ros
def test_without_a_compiler_python_measures(
    plans: list[BenchPlan], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("igtl_gateway_lab.cli.bench_run.lacks_probe", lambda: "no C compiler (cc)")
    assert main(["bench", "--case", "transform", "--json"]) == 0
    assert "the measuring programs are those in Python: no C compiler (cc)" in capsys.readouterr().err
    assert [(plan.programs, plan.hop) for plan in plans] == [("python", False)]


@pytest.mark.ros
def test_a_long_command_is_shortened_in_the_table(plans: list[BenchPlan], capsys: pytest.CaptureFixture[str]) -> None:
    other = "ros2 launch some_package some_bridge.launch.py port:={port}"
    words = ["--case", "transform", "--direction", "igtl-to-ros", "--against", other, "--against", "x {port}"]
    assert main(["bench", *words]) == 0
    _, ours, theirs, third, *_ = capsys.readouterr().out.splitlines()
    assert len(plans) == 1 and ours.startswith("transform  ")
    assert theirs.startswith("transform ros2 launch some_pac…unch.py port:={port}  igtl-to-ros")
    assert third.startswith("transform x {port}  ")


@pytest.mark.ros
def test_rounds_take_turns(plans: list[BenchPlan], capsys: pytest.CaptureFixture[str]) -> None:
    words = ["--case", "mixed", "--record", "--rounds", "3", "--direction", "ros-to-igtl", "--json"]
    assert main(["bench", *words]) == 0
    assert [plan.record for plan in plans] == [False, True] * 3
    plain, recorded = json.loads(capsys.readouterr().out)["rows"]
    assert len(plain["rounds"]) == len(recorded["rounds"]) == 3
    assert (recorded["recording_p50_ratio"], recorded["recording_p99_ratio"]) == (1.1, 1.5)
    assert (recorded["bounds"]["recording_p99_ratio <= 1.1"], recorded["bounds"]["lost <= 0"]) == (False, False)


@pytest.mark.ros
def test_a_sweep(plans: list[BenchPlan], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", "--sweep", "clients", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert [row["x"] for row in told["rows"]] == [plan.clients for plan in plans]
    (fit,) = told["fits"]
    assert (fit["figure"], fit["r2"]) == ("p50_ms", 1.0)
    assert fit["b"] == pytest.approx(0, abs=1e-12)


@pytest.mark.ros
def test_pictures(plans: list[BenchPlan], tmp_path: Path) -> None:
    assert main(["bench", "--case", "transform", "--plot", str(tmp_path / "out"), "--json"]) == 0
    assert plans
    names = sorted(path.name for path in (tmp_path / "out").iterdir())
    assert names == ["latency-igtl-to-ros.svg", "latency-ros-to-igtl.svg"]


@pytest.mark.ros
def test_a_real_run_both_ways(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", "--case", "transform", "--count", "50", "--rate", "200", "--no-floor", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    rows = {row["direction"]: row for row in told["rows"]}
    assert rows.keys() == {"ros-to-igtl", "igtl-to-ros"}
    for row in rows.values():
        assert (row["case"], row["sent"], row["delivered"]) == ("transform", 50, 50)
        assert 0 < row["p50_ms"] <= row["p99_ms"] <= row["max_ms"]
        assert row["received_per_s"] > 0 and row["gateway_rss_mb"] > 0
    assert told["ambient"]["cores"] >= 1 and "load_after" in told["ambient"]


@pytest.mark.ros
@pytest.mark.skipif(bool(lacks_probe()), reason=lacks_probe())
def test_a_real_run_against_another_bridge(capsys: pytest.CaptureFixture[str]) -> None:
    other = f"{sys.executable} -m igtl_gateway_lab.bench.hop --port {{port}} --case {{case}}"
    words = ["--case", "transform", "--count", "50", "--rate", "200", "--direction", "igtl-to-ros"]
    assert main(["bench", *words, "--against", other, "--json"]) == 0
    told, status = capsys.readouterr()
    ours, theirs, hop = json.loads(told)["rows"]
    assert [row.get("bridge") for row in (ours, theirs, hop)] == [None, other, "hop"]
    for row in (ours, theirs, hop):
        assert (row["sent"], row["delivered"], row["programs"]) == (50, 50, "native")
        assert row["floor_p50_ms"] > 0 and row["ratio"] > 0 and row["gateway_cpu_us_per_message"] > 0
    assert ours["ratio_hop"] > 0 and theirs["ratio_hop"] > 0 and ours["hop_cpu_us_per_message"] > 0
    assert "bounds" in ours and "bounds" not in theirs
    runs = [line.removeprefix("transform igtl-to-ros").strip() for line in status.splitlines() if "igtl-to-ros" in line]
    assert runs == ["", other, "hop"]


@pytest.mark.ros
@pytest.mark.skipif(bool(lacks_probe()), reason=lacks_probe())
def test_a_real_run_against_a_bridge_of_others_without_stamps(capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("pyigtl")
    other = f"{sys.executable} {ROOT / 'examples' / 'bench' / 'pyigtl_bridge.py'} {{port}}"
    words = ["--case", "transform-n", "--count", "50", "--rate", "30"]
    assert main(["bench", *words, "--against", other, "--json", "--no-floor"]) == 0
    rows = [row for row in json.loads(capsys.readouterr().out)["rows"] if row.get("bridge") == other]
    assert [(row["direction"], row["sent"]) for row in rows] == [("ros-to-igtl", 50), ("igtl-to-ros", 50)]
    assert all(row["delivered"] > 25 for row in rows)  # pyigtl keeps only the last message of a device


@pytest.mark.ros
def test_a_bridge_that_does_not_work_is_left_out(capsys: pytest.CaptureFixture[str]) -> None:
    words = ["--case", "transform", "--count", "5", "--direction", "ros-to-igtl", "--no-floor", "--json"]
    assert main(["bench", *words, "--against", "no-such-bridge {port}"]) == 0
    told, status = capsys.readouterr()
    (row,) = json.loads(told)["rows"]
    assert row["delivered"] == 5 and "bridge" not in row
    assert "left out: no-such-bridge {port}: " in status


@pytest.mark.ros
@pytest.mark.skipif(bool(lacks_probe()), reason=lacks_probe())
def test_the_mixed_load_has_a_floor(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", "--case", "mixed", "--count", "10", "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)["rows"]
    assert len(rows) == 2 * 2 * 4  # bridges, directions, kinds
    for row in rows:
        assert row["delivered"] == row["sent"] == (100 if row["stream"] == "transform" else 10)
        assert 0 < row["floor_p50_ms"] <= row["floor_p99_ms"] <= row["floor_p999_ms"]
        assert row["ratio_p50"] > 0 and row["ratio_p99"] > 0
