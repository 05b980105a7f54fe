"""The review of a suture plan in the picture."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rerun", reason="rerun is not installed (extra 'view')")

from igtl_gateway.addons.review import CloudReview, EndReview, Level, PlanReview, Review, StitchReview
from igtl_gateway.addons.view import stream
from igtl_gateway.addons.view.session import SessionView

from .conftest import START_NS, Drawn, read_back

CLOUD = CloudReview(
    topic="/cloud",
    frame_id="camera",
    clouds=3,
    stamps_ns=(START_NS, START_NS + 1),
    source_stamps_ns=(0, 0),
    height=1,
    width=4,
    positions=np.array([[0, 0, 1], [0, 1, 1], [1, 0, 1], [1, 1, 1]], np.float32),
    noise_mm=np.array([0.0, 0.4, 5.0, np.nan], np.float32),
    temporal=True,
)


def stitch(number: int, level: Level, entry_mm: float, exit_mm: float, *reasons: str) -> StitchReview:
    place = number / 100
    entry = EndReview((place, 0.0, 0.2), distance_mm=entry_mm, noise_mm=0.2, spacing_mm=3.0)
    end = EndReview((place, 0.007, 0.2), distance_mm=exit_mm, noise_mm=0.3)
    return StitchReview(number, str(number), entry, end, 7.0, None, None, level, reasons)


def plan(stamp_ns: int, *stitches: StitchReview) -> PlanReview:
    return PlanReview("/plan", "t", "camera", stamp_ns, 0, stitches)


@pytest.fixture
def drawn(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Drawn:
    monkeypatch.setenv("RERUN_STRICT", "1")
    first = plan(START_NS, stitch(1, Level.OK, 0.0, 0.1), stitch(2, Level.WRONG, 0.1, -2.4, "exit 2.4 mm under tissue"))
    last = plan(START_NS + 5, stitch(1, Level.OK, 0.0, 0.1), stitch(2, Level.LOOK, 0.6, 0.1, "near a limit"))
    path = tmp_path / "judged.rrd"
    recording = stream.to_file(path, "test")
    view = SessionView(recording)
    view.review(Review(CLOUD, (first, last), notes=("the tool is not known",)))
    view.finish()
    stream.close(recording)
    return read_back(path, view)


def test_the_cloud_is_coloured_by_its_noise(drawn: Drawn) -> None:
    cloud = drawn.static("review/cloud")
    low, middle, high, unknown = cloud["Points3D:colors"]
    assert len({low, middle, high, unknown}) == 4
    assert high >> 24 > low >> 24  # redder
    assert cloud["CoordinateFrame:frame"] == ["camera"]


def test_the_cloud_is_coloured_by_its_distance_from_the_plan(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RERUN_STRICT", "1")
    middle, end, aside, far = (0.01, 0.0035, 0.2), (0.01, 0.007, 0.2), (0.01, 0.012, 0.2), (0.01, 0.107, 0.2)
    cloud = replace(CLOUD, positions=np.array([middle, end, aside, far], np.float32), noise_mm=np.zeros(4, np.float32))
    path = tmp_path / "judged.rrd"
    recording = stream.to_file(path, "test")
    view = SessionView(recording)
    view.review(Review(cloud, (plan(START_NS, stitch(1, Level.OK, 0.0, 0.1)),)))
    view.finish()
    stream.close(recording)
    (row,) = read_back(path, view).rows("review/distance")
    colours = list(row["Points3D:colors"])
    assert colours[0] == colours[1]
    assert len(set(colours)) == 3
    assert colours[3] >> 24 > colours[0] >> 24  # redder


def test_each_version_of_the_plan_has_its_stitches_at_its_time(drawn: Drawn) -> None:
    first, last = drawn.rows("review/stitches")
    assert (first["gateway_time"], last["gateway_time"]) == (START_NS, START_NS + 5)
    assert first["LineStrips3D:colors"][0] == last["LineStrips3D:colors"][0]
    assert first["LineStrips3D:colors"][1] != last["LineStrips3D:colors"][1]
    assert first["LineStrips3D:labels"] == ["1", "2: wrong -2.4 mm"]
    np.testing.assert_allclose(first["LineStrips3D:strips"][1], [(0.02, 0.0, 0.2), (0.02, 0.007, 0.2)], atol=1e-7)


def test_the_table_is_in_millimetres_and_begins_with_the_worst(drawn: Drawn) -> None:
    first, last = (row["TextDocument:text"][0] for row in drawn.rows("review/table"))
    titles, *rows = [line for line in first.splitlines() if line.startswith("| ")]
    assert titles.count("(mm)") == 5
    assert rows[0] == "| 2 | **wrong** | +0.10 | -2.40 | 0.30 | 3.00 | 7.00 |"
    assert "- **2** wrong: exit 2.4 mm under tissue" in first.splitlines()  # a line of its own, which wraps
    assert rows[1].startswith("| 1 | ok |")
    assert "1 of 2 stitches are wrong" in first
    assert "0 of 2 stitches are wrong" in last
    assert "the tool is not known" in first


def test_the_colours_of_both_clouds_have_a_legend_in_millimetres(drawn: Drawn) -> None:
    for name, ends in (
        ("noise", ["Depth noise 0 mm", "0.4 mm", "0.8 mm"]),
        ("distance", ["Distance to plan 0 mm", "10 mm", "20 mm"]),
    ):
        assert drawn.static(f"review/legends/{name}/numbers")["LineStrips3D:labels"] == ends
        assert len(drawn.static(f"review/legends/{name}")["LineStrips3D:strips"]) == 32
    assert set(drawn.view.seen.scales.values()) == {"Depth noise 0 … 0.8 mm", "Distance to plan 0 … 20 mm"}


def test_it_is_said_that_there_is_a_review(drawn: Drawn) -> None:
    assert drawn.view.seen.reviewed
