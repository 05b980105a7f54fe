"""Plots of numbers by name: which values they have, what names are taken, and what a wrong one is answered with."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rerun", reason="rerun is not installed (extra 'view')")
pytest.importorskip("pyarrow", reason="needs pyarrow")

import igtl_gateway
from igtl_gateway.addons.view.chosen import series_of
from igtl_gateway.base.errors import ConfigError
from igtl_gateway.cli import main
from tests.addons.view.conftest import read_back
from tests.places import FIXTURES
from tests.tables import table

_JOINTS = tuple(f"PSM1_{joint}" for joint in ("yaw", "pitch", "insertion", "roll", "wrist_pitch", "wrist_yaw"))


@table(
    ("name", "word", "curves"),
    [
        ("star", "TRANSFORM/ToolToBase.x_mm", ["x_mm"]),
        ("star", "/igtl/in/PlanPoints/landmarks.points[0].position.x_m", ["points.0.position.x_m"]),
        ("star", "/igtl/in/PlanPoints/landmarks.points.1.position.z_m", ["points.1.position.z_m"]),
        ("crtk", "/PSM1/measured_js.position", [f"position.{joint}" for joint in _JOINTS]),
        ("crtk", "/PSM1/measured_js.position[2]", ["position.2"]),
        ("crtk", "/PSM1/measured_cp.pose.position.x_m", ["pose.position.x_m"]),
    ],
)
def test_numbers_have_the_names_of_csv(name: str, word: str, curves: list[str]) -> None:
    with igtl_gateway.open(FIXTURES / f"{name}.mcap") as recording:
        found = series_of(recording, word)
        assert list(found.curves) == curves
        for values in found.curves.values():
            assert len(values) == len(found.times) and np.isfinite(values).any()
        assert (np.diff(found.times) >= 0).all()


def test_a_joint_has_its_name() -> None:
    with igtl_gateway.open(FIXTURES / "crtk.mcap") as recording:
        stream = recording["/PSM1/measured_js"]
        names = stream.to_arrow()["name"][0].as_py()
        (by_name,) = series_of(recording, f"/PSM1/measured_js.position.{names[3]}").curves.values()
        (by_place,) = series_of(recording, "/PSM1/measured_js.position.3").curves.values()
    assert np.array_equal(by_name, by_place, equal_nan=True)


@table(
    ("word", "message"),
    [
        ("TRANSFORM/ToolToBas.x_mm", "star.mcap lists them; did you mean 'TRANSFORM/ToolToBase'?"),
        ("TRANSFORM/ToolToBase.x_m", "found no number 'x_m' in TRANSFORM/ToolToBase, expected one of x_mm, "),
        ("TRANSFORM/ToolToBase", "found no field behind TRANSFORM/ToolToBase, expected one of x_mm, y_mm"),
        ("/igtl/in/PlanPoints/landmarks.points[99].position.x_m", "found no number 'points.99.position.x_m'"),
        ("/star/camera/image.data", "found no number 'data'"),
    ],
)
def test_a_wrong_name_is_answered_with_the_nearest(word: str, message: str) -> None:
    with igtl_gateway.open(FIXTURES / "star.mcap") as recording, pytest.raises(ConfigError) as error:
        series_of(recording, word)
    assert message in str(error.value)


def test_a_plot_is_in_the_recording_of_rerun(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out.rrd"
    words = ["view", str(FIXTURES / "crtk.mcap"), "-o", str(out)]
    assert main([*words, "--plot", "/PSM1/measured_cp.pose.position.x_m"]) == 0
    drawn = read_back(out)
    with igtl_gateway.open(FIXTURES / "crtk.mcap") as recording:
        frame = recording["/PSM1/measured_cp"].to_arrow()
    rows = [row for batch in drawn.batches["chosen/0/0"] for row in batch.to_pylist()]
    values = [row["Scalars:scalars"][0] for row in rows]
    assert values == frame["pose.position.x_m"].to_pylist()
    assert main([*words, "--overwrite", "--plot", "/PSM1/measured_cp.pose.positon.x_m"]) == 2
    assert "did you mean" in capsys.readouterr().err
