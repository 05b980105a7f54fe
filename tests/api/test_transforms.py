"""Look-ups of frames against an independent formula: rotation vectors, one pose at a time."""

from __future__ import annotations

import math
import random
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import igtl_gateway
from igtl_gateway.api.poses import between_poses
from igtl_gateway.api.transforms import Edge, TransformTree
from igtl_gateway.base.errors import ClockWarning, ConfigError
from igtl_gateway.convert.common_msgs import FrameTransform, TFMessage
from igtl_gateway.convert.rosmsg import Header
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.record.sessionfile.writer import SessionWriter
from tests.places import FIXTURES

Rows = list[list[float]]

MS = 1_000_000
START = 1_700_000_000 * 10**9


def turned(axis: tuple[float, float, float], angle: float, place: tuple[float, float, float]) -> Rows:
    """The matrix of a rotation around an axis (Rodrigues) and a translation."""
    size = math.sqrt(sum(value * value for value in axis))
    x, y, z = (value / size for value in axis)
    c, s = math.cos(angle), math.sin(angle)
    rows = [
        [c + x * x * (1 - c), x * y * (1 - c) - z * s, x * z * (1 - c) + y * s],
        [y * x * (1 - c) + z * s, c + y * y * (1 - c), y * z * (1 - c) - x * s],
        [z * x * (1 - c) - y * s, z * y * (1 - c) + x * s, c + z * z * (1 - c)],
    ]
    return [[*row, value] for row, value in zip(rows, place, strict=True)] + [[0.0, 0.0, 0.0, 1.0]]


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-4, 0.3, 1.5, 3.0, 3.14159])
def test_rotations_are_interpolated_along_the_great_circle(angle: float) -> None:
    turn = random.Random(5)
    for _ in range(20):
        axis = (turn.gauss(0, 1), turn.gauss(0, 1), turn.gauss(0, 1))
        start = np.array(turned((turn.gauss(0, 1), 1.0, 0.5), turn.uniform(-3, 3), (1.0, 2.0, 3.0)))
        share = turn.random()
        end = start @ np.array(turned(axis, angle, (0.0, 0.0, 0.0)))
        end[:3, 3] = (5.0, 0.0, -3.0)
        expected = start @ np.array(turned(axis, share * angle, (0.0, 0.0, 0.0)))
        expected[:3, 3] = (1 + 4 * share, 2 - 2 * share, 3 - 6 * share)
        (found,) = between_poses(start[None], end[None], np.array([share]))
        assert np.allclose(found, expected, atol=1e-9)
        for whole, sample in ((0.0, start), (1.0, end)):
            assert np.array_equal(between_poses(start[None], end[None], np.array([whole]))[0], sample)


def tree() -> TransformTree:
    def edge(parent: str, child: str, times: list[int], angles: list[float], static: bool = False) -> Edge:
        matrices = np.array([turned((0, 0, 1), angle, (angle, 1.0, 0.0)) for angle in angles])
        return Edge(parent, child, np.array(times, np.int64), matrices, static, "")

    return TransformTree(
        [
            edge("world", "robot", [0], [0.5], static=True),
            edge("robot", "tool", [100, 200, 400], [0.0, 0.2, 0.8]),
            edge("world", "camera", [50, 300], [1.0, 1.5]),
            edge("moon", "flag", [0], [0.0]),
        ]
    )


def test_chains_are_multiplied_up_and_down() -> None:
    times = np.array([100, 150, 250, 300])
    found = tree().lookup("camera", "tool", times)
    for time, matrix in zip(times.tolist(), found, strict=True):
        tool = 0.002 * (time - 100) if time <= 200 else 0.2 + 0.003 * (time - 200)
        camera = 1.0 + 0.002 * (time - 50)
        chain = [turned((0, 0, 1), angle, (angle, 1.0, 0.0)) for angle in (camera, 0.5, tool)]
        expected = np.linalg.inv(np.array(chain[0])) @ np.array(chain[1]) @ np.array(chain[2])
        assert np.allclose(matrix, expected, atol=1e-12)
    assert np.allclose(tree().lookup("tool", "camera", 150), np.linalg.inv(found[1]), atol=1e-12)
    assert np.array_equal(tree().lookup("tool", "tool", 0), np.eye(4))
    assert np.allclose(tree().lookup("world", "robot", 10**18, unit="mm")[:3, 3], [500, 1000, 0])


def test_no_pose_is_extrapolated() -> None:
    with pytest.raises(
        ConfigError, match="time: found 99, expected one within the samples of 'tool' in 'robot': 100 to"
    ):
        tree().lookup("robot", "tool", np.array([150, 99]))
    found = tree().lookup("robot", "tool", np.array([99, 100, 400, 401]), out_of_range="nan")
    assert np.isnan(found).all(axis=(1, 2)).tolist() == [True, False, False, True]
    wrong: list[tuple[str, str, Any, dict[str, Any]]] = [
        ("robot", "hand", 100, {}),
        ("robot", "flag", 100, {}),
        ("robot", "tool", 1.5, {}),
        ("robot", "tool", 100, {"unit": "inch"}),
        ("robot", "tool", 100, {"out_of_range": "clip"}),
    ]
    for target, source, time, more in wrong:
        with pytest.raises(ConfigError, match="found"):
            tree().lookup(target, source, time, **more)


def test_frames_of_a_recording_have_their_stamps(tmp_path: Path) -> None:
    def message(stamp_ns: int, *rows: tuple[str, str, float]) -> bytes:
        transforms = tuple(
            FrameTransform(Header(stamp_ns, parent), child, (x, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0))
            for parent, child, x in rows
        )
        return TFMessage(transforms).pack()

    writer = SessionWriter(tmp_path / "tf.mcap", {})
    rows = [
        ("/tf_static", message(0, ("world", "base", 1.0))),
        ("/tf", message(1000, ("/base", "arm", 1.0), ("arm", "tool", 0.5))),
        ("/tf", message(1000, ("base", "arm", 2.0))),
        ("/tf", message(2000, ("base", "arm", 4.0), ("arm", "tool", math.nan))),
    ]
    for number, (topic, data) in enumerate(rows, 1):
        writer.write(Entry(number, 10_000 + number, Kind.ROS_IN, topic, TFMessage.TYPE, (data,)))
    writer.close({})
    with igtl_gateway.open(tmp_path / "tf.mcap") as recording:
        assert recording.tf.frames == ("arm", "base", "tool", "world")
        # the second of two messages with one stamp is valid
        assert recording.tf.lookup("world", "arm", 1500)[0, 3] == 4.0
        assert recording.tf.lookup("world", "tool", 1000)[0, 3] == 3.5
        assert recording["/tf"].poses("arm").positions[:, 0].tolist() == [1.0, 2.0, 4.0]
        with pytest.raises(ConfigError, match="several poses"):
            recording["/tf"].poses()
        with pytest.raises(ConfigError, match="no pose of frame 'leg'"):
            recording["/tf"].poses("leg")


def test_the_tool_of_star_is_found_in_the_camera() -> None:
    with igtl_gateway.open(FIXTURES / "star.mcap") as recording:
        tool, camera = recording["/star/tool"].poses(), recording["/star/camera_pose"].poses()
        times = tool.stamps[(tool.stamps >= camera.stamps[0]) & (tool.stamps <= camera.stamps[-1])]
        found = recording.tf.lookup("star_camera_optical", "suture_tool", times)
        rows = np.searchsorted(tool.stamps, times)
        expected = np.linalg.inv(camera.matrices[0]) @ tool.matrices[rows]
        assert np.allclose(found, expected, atol=1e-9)  # the camera does not move
        assert {edge.stream for edge in recording.tf.edges} >= {"/star/tool", "TRANSFORM/ToolToBase"}


def written(path: Path, rows: list[tuple[int, list[tuple[str, str, float, int]]]]) -> Path:
    """Messages on /tf: gateway time in ms, and their transforms: parent, child, x in m, stamp in ms (-1: unset)."""
    writer = SessionWriter(path, {})
    for number, (at, each) in enumerate(sorted(rows), 1):
        transforms = tuple(
            FrameTransform(Header(START + stamp * MS if stamp >= 0 else 0, parent), child, (x, 0, 0, 0, 0, 0, 1))
            for parent, child, x, stamp in each
        )
        data = TFMessage(transforms).pack()
        writer.write(Entry(number, START + at * MS + number, Kind.ROS_IN, "/tf", TFMessage.TYPE, (data,)))
    writer.close({})
    return path


def test_nothing_is_interpolated_across_a_change_of_the_parent(tmp_path: Path) -> None:
    """The tool hangs on the base, is on the arm from 1 s to 2 s, and hangs on the base again; it moves 100 mm/s."""
    rows = []
    for at in range(0, 3001, 20):
        parent, x = ("arm", 0.1 * at / 1000 - 0.5) if 1000 <= at < 2000 else ("base", 0.1 * at / 1000)
        rows.append((at, [("base", "arm", 0.5, at), (parent, "tool", x, at)]))
    with igtl_gateway.open(written(tmp_path / "a.mcap", rows)) as recording:
        times = START + np.arange(0, 3001, 7) * MS
        found = recording.tf.lookup("base", "tool", times, out_of_range="nan", clock="source")[:, 0, 3]
        good = np.isfinite(found)
        assert np.allclose(found[good], 0.1 * (times[good] - START) / 1e9, atol=1e-9)
        # on the arm the way leads over the arm; between its last pose there and the next one nothing is known
        missing = (times[~good] - START) // MS
        assert len(missing) < 8 and all(980 < at < 1000 or 1980 < at < 2000 for at in missing.tolist())
        with pytest.raises(ConfigError, match="nor with another parent"):
            recording.tf.lookup("base", "tool", START + 990 * MS, clock="source", max_gap=None)


def test_a_gap_has_no_poses_unless_they_are_equal(tmp_path: Path) -> None:
    rows = [(at, [("base", "tool", 0.001 * at, at), ("base", "table", 4.0, at)]) for at in (0, 100, 200, 700, 800)]
    with igtl_gateway.open(written(tmp_path / "a.mcap", rows)) as recording:
        times = START + np.array([50, 300, 650, 750]) * MS
        found = recording.tf.lookup("base", "tool", times, out_of_range="nan", clock="source")[:, 0, 3]
        assert np.allclose(found[[0, 3]], [0.05, 0.75]) and np.isnan(found[[1, 2]]).all()
        found = recording.tf.lookup("base", "tool", times, clock="source", max_gap=0.5)[:, 0, 3]
        assert np.allclose(found, 0.001 * (times - START) / MS)
        assert (recording.tf.lookup("base", "table", times, clock="source")[:, 0, 3] == 4.0).all()
        with pytest.raises(ConfigError, match=r"in no gap above 0\.15 s"):
            recording.tf.lookup("base", "tool", int(times[1]), clock="source")


@pytest.mark.parametrize("ahead_ms", [3000, -3000])
def test_stamps_of_another_clock_are_corrected_and_it_is_reported(tmp_path: Path, ahead_ms: int) -> None:
    rows = [(5000 + at, [("base", "tool", 0.0001 * at, 4999 + at + ahead_ms)]) for at in range(0, 3000, 20)]
    with igtl_gateway.open(written(tmp_path / "a.mcap", rows)) as recording:
        stream = recording["/tf"]
        with pytest.warns(ClockWarning, match="corrected by"):
            found = recording.tf.lookup("base", "tool", stream.times, out_of_range="nan")[:, 0, 3]
        assert np.allclose(found[:-1], 0.0001 * np.arange(0, 2980, 20), atol=1e-6)
        # the stream itself has that clock, and so have its stamps
        for found in (
            recording.tf.lookup("base", "tool", stream),
            recording.tf.lookup("base", "tool", stream.stamps, clock="source"),
        ):
            assert np.array_equal(found[:, 0, 3], 0.0001 * np.arange(0, 3000, 20))


def test_frames_of_two_clocks_have_no_source_clock(tmp_path: Path) -> None:
    rows = [(at, [("base", "arm", 0.0, at), ("arm", "tool", 0.0, at + 5000)]) for at in range(0, 1000, 20)]
    with igtl_gateway.open(written(tmp_path / "a.mcap", rows)) as recording:
        with pytest.raises(ConfigError, match="expected one clock"):
            recording.tf.lookup("base", "tool", START + 500 * MS, clock="source")


def test_frames_without_a_stamp_have_gateway_times(tmp_path: Path) -> None:
    rows = [(at, [("base", "tool", 0.001 * at, -1 if at == 100 else at + 9000)]) for at in range(0, 500, 20)]
    with igtl_gateway.open(written(tmp_path / "a.mcap", rows)) as recording:
        found = recording.tf.lookup("base", "tool", START + 250 * MS)[0, 3]
        assert found == pytest.approx(0.25, abs=1e-6)
        with pytest.raises(ConfigError, match="without a stamp"):
            recording.tf.lookup("base", "tool", START + 250 * MS, clock="source")
