from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest

import igtl_gateway
from igtl_gateway.addons.page import plots
from igtl_gateway.addons.page.plot_field import usual_field
from igtl_gateway.addons.page.plots import plot_of, shown
from igtl_gateway.addons.page.recordings import Recordings
from tests.places import FIXTURES


def test_the_numbers_of_a_recording(monkeypatch: pytest.MonkeyPatch) -> None:
    path = FIXTURES / "crtk.mcap"
    with igtl_gateway.open(path) as recording:
        key = next(each for each, stream in recording.streams.items() if stream.type.endswith("JointState"))
        stream = recording[key]
        expected = [float(message.content.position[0]) for message in stream]
        name = next(iter(stream)).content.name[0]
        times = ((stream.times - recording.start_time) / 1e9).tolist()
    monkeypatch.setattr(plots, "MAX_POINTS", len(expected))
    found = plot_of(path, key)
    assert found["fields"][f"position.{name}"] == expected and found["every"] == 1
    assert found["times"] == pytest.approx(times, abs=1e-6) and key in found["streams"]
    monkeypatch.setattr(plots, "MAX_POINTS", len(expected) // 3)
    thin = plot_of(path, key)
    assert thin["fields"][f"position.{name}"] == expected[:: thin["every"]] and thin["every"] > 2


def test_what_cannot_be_plotted_has_a_reason(tmp_path: Path) -> None:
    assert "did you mean" in plot_of(FIXTURES / "lego.mcap", "TRANSFORM/Stylus")["problem"]
    assert plot_of(tmp_path / "none.mcap")["problem"] and shown([math.nan]) == [None]
    first: dict[str, Any] = plot_of(FIXTURES / "lego.mcap")
    assert first["stream"] == "/lego/joint_states" and usual_field(first["fields"]).startswith("position.")


def test_the_list_reads_a_plot_once_for_all_its_numbers(tmp_path: Path) -> None:
    (tmp_path / "lego.mcap").symlink_to(FIXTURES / "lego.mcap")
    recordings = Recordings(tmp_path)
    found = recordings.plot("lego.mcap", "", "")
    assert found and found["field"] in found["fields"] and len(found["values"]) == len(found["times"]) > 9
    other = recordings.plot("lego.mcap", "", "header.stamp_ns")
    assert other and other["values"] != found["values"] and recordings.plot("../lego.mcap", "", "") is None
