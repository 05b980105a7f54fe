"""Recordings of the benchmark's own making, and what is measured with them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from igtl_gateway.base.clock import SystemClock
from igtl_gateway.cli import main
from igtl_gateway_lab.bench import works
from igtl_gateway_lab.bench.bridges import HOP
from igtl_gateway_lab.bench.cases import BenchStream
from igtl_gateway_lab.bench.probe import lacks_probe
from igtl_gateway_lab.bench.runner import NATIVE, PYTHON
from igtl_gateway_lab.bench.works import WORKS, WorkContext


@pytest.fixture
def shop(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> WorkContext:
    monkeypatch.setattr(works, "_REPLAYED", {"image-vga": 3})  # as against small messages, never in one piece
    monkeypatch.setattr(works, "_RECORDED_S", 1)
    return WorkContext(tmp_path, SystemClock(), lambda _line: None)


def test_what_is_recorded_verifies(tmp_path: Path) -> None:
    path = tmp_path / "r.mcap"
    works.record_passage(path, BenchStream("transform", 0.0), 50, SystemClock())
    assert main(["verify", str(path)]) == 0


def test_recording(shop: WorkContext) -> None:
    rows = WORKS["recording"].run(shop)
    assert [row["what"] for row in rows] == ["mixed", "mixed, noise"]
    for row in rows:
        assert row["dropped"] == 0
        assert row["entries"] > 2 * 2 * 1060  # in and out, both ways
        assert row["entries_per_s"] > 0 and row["times_mixed_load"] > 0 and row["floor_times_mixed_load"] > 0
        assert row["gateway_cpu_percent"] > 0 and row["recorder_cpu_percent"] > 0


@pytest.mark.ros
def test_idle(shop: WorkContext, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(works, "_IDLE_S", 0.5)
    rows = WORKS["idle"].run(replace(shop, programs=PYTHON if lacks_probe() else NATIVE))
    assert [row.get("bridge", "") for row in rows] == ([""] if lacks_probe() else ["", HOP])
    for row in rows:
        assert row["gateway_cpu_percent"] > 0 and row["wakeups_per_s"] > 0 and row["threads"] > 1


def test_replay(shop: WorkContext) -> None:
    (row,) = WORKS["replay"].run(shop)
    assert (row["what"], row["sent"], row["delivered"]) == ("image-vga", 3, 3)
    assert row["received_per_s"] > 0
