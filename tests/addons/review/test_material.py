"""Selection of streams by content, in sessions with other streams."""

from __future__ import annotations

import contextlib
from dataclasses import replace

import numpy as np
import pytest

from igtl_gateway.addons.review.material import Material
from igtl_gateway.addons.review.model import Array
from igtl_gateway.base.errors import ConfigError, GatewayError
from igtl_gateway.convert.igtl_msgs import LabeledPoint, PointList
from igtl_gateway.convert.rosmsg import Header
from igtl_gateway.gateway.log.entry import Kind
from tests.addons.review.sessions import (
    SECOND,
    cloud_message,
    dome_clouds,
    entry,
    on_dome,
    plan_message,
    pose_message,
    xyz,
)
from tests.tables import table

_FIRST = np.stack([on_dome(x, -3) for x in (-3, 0, 3)])
_LAST = np.stack([on_dome(x, 3) for x in (-3, 0, 3)])


def _with_clouds(material: Material, number: int = 3, topic: str = "/cloud") -> Material:
    for cloud in dome_clouds(number):
        material.take(entry(topic, cloud_message(cloud.points, cloud.stamp_ns), cloud.stamp_ns))
    return material


def _moved(points: Array, number: int, off: float = 0.002) -> Array:
    moved = points.copy()
    moved[number, 2] += off
    return moved


def test_clouds_are_decimated_evenly_with_a_note() -> None:
    material = _with_clouds(Material(clouds=4), 11)
    scene, topic = material.scene()
    assert topic == "/cloud"
    stamps = [cloud.stamp_ns // SECOND for cloud in scene.clouds]
    assert len(stamps) == 4
    steps = np.diff(stamps)
    assert steps.max() <= 2 * steps.min()
    assert stamps[0] == 1
    assert stamps[-1] >= 9
    assert material.notes == ["4 of 11 clouds of /cloud are used, evenly distributed"]


def test_the_largest_organised_cloud_is_selected() -> None:
    material = _with_clouds(Material(), 2, "/small")
    large = np.repeat(dome_clouds(1)[0].points, 2, axis=0)
    material.take(entry("/large", cloud_message(large, 1), 1))
    material.take(entry("/list", cloud_message(large.repeat(3, axis=0).reshape(1, -1, 3), 1), 1))
    assert material.scene()[1] == "/large"
    assert _with_clouds(Material(cloud="/small"), 2, "/small").scene()[1] == "/small"
    with pytest.raises(ConfigError, match="--cloud /none"):
        _with_clouds(Material(cloud="/none")).scene()
    with pytest.raises(GatewayError, match="found no point cloud"):
        Material().scene()


def test_a_reconfigured_camera_discards_earlier_clouds() -> None:
    material = _with_clouds(Material(), 3)
    other = dome_clouds(1)[0].points[:50]
    material.take(entry("/cloud", cloud_message(other, 9 * SECOND), 9 * SECOND))
    assert [cloud.points.shape for cloud in material.scene()[0].clouds] == [(50, 80, 3)]


def test_versions_of_a_plan_are_collected_from_all_streams() -> None:
    """Drawn in ROS, sent to a planner and back with a change, drawn again; in between another plan."""
    material = _with_clouds(Material())
    lines = plan_message(_FIRST, _LAST, SECOND)
    material.take(entry("/plan", lines, SECOND))
    material.take(entry("/plan", lines, 2 * SECOND))  # latched, published twice
    corrected = plan_message(_FIRST.astype(np.float32), _moved(_LAST, 1), 3 * SECOND)
    material.take(entry("/igtl/in/Plan/lines", corrected, 3 * SECOND, Kind.ROS_OUT))
    material.take(entry("/plan", corrected, 4 * SECOND))
    material.take(entry("/plan_points", cloud_message(np.concatenate([_FIRST, _LAST])[None], SECOND), SECOND))
    for number in range(4):
        trail = plan_message(_FIRST + 0.0005 * number, _LAST + 0.001 * number, SECOND + number)
        material.take(entry("/trail", trail, SECOND + number))
    far = plan_message(_FIRST + 1, _LAST + 1, SECOND)
    material.take(entry("/robot/bones", far, SECOND))
    versions = material.versions(material.scene()[0])
    assert [(plan.topic, plan.stamp_ns // SECOND) for plan in versions] == [("/plan", 1), ("/igtl/in/Plan/lines", 3)]


def test_points_are_a_plan_and_a_stream_that_always_changes_is_not() -> None:
    material = _with_clouds(Material())
    for number in range(5):
        noisy = np.concatenate([_FIRST, _LAST])[None] + 0.0001 * (number + 1)
        material.take(entry("/markers", cloud_message(noisy, number + 1), number + 1))
    points = tuple(
        LabeledPoint(f"{kind} {i}", "", (0, 0, 0, 0), xyz(at[i]), 0.0, "")
        for kind, at in (("entry", _FIRST), ("exit", _LAST))
        for i in range(3)
    )
    material.take(entry("/landmarks", PointList(Header(9, "camera"), points), 9))
    versions = material.versions(material.scene()[0])
    assert [plan.topic for plan in versions] == ["/landmarks"]
    assert versions[0].labels == ("0", "1", "2")


def test_a_plan_in_another_frame_is_transformed() -> None:
    material = _with_clouds(Material())
    material.take(entry("/camera_pose", pose_message("base", "camera", (1, 2, 3), SECOND), SECOND))
    shift = np.array([1.0, 2.0, 3.0])
    material.take(entry("/plan", plan_message(_FIRST + shift, _LAST + shift, SECOND, "base"), SECOND))
    (version,) = material.versions(material.scene()[0])
    np.testing.assert_allclose(version.entry, _FIRST, atol=1e-12)
    assert version.frame_id == "base"


def test_a_plan_in_an_unconnected_frame_is_used_unchanged_with_a_note() -> None:
    material = _with_clouds(Material())
    material.take(entry("/plan", plan_message(_FIRST, _LAST, SECOND, "Slicer"), SECOND))
    assert len(material.versions(material.scene()[0])) == 1
    assert any("as if in the frame of the cloud" in note for note in material.notes)


def test_sessions_in_millimetres_are_converted_to_metres() -> None:
    material = Material(unit_m=0.001)
    cloud = dome_clouds(1)[0]
    material.take(entry("/cloud", cloud_message(cloud.points * 1000, 1), 1))
    material.take(entry("/plan", plan_message(_FIRST * 1000, _LAST * 1000, 1), 1))
    material.take(entry("/tool", pose_message("camera", "tool", (0, 0, 100), 1), 1))
    material.take(entry("/tool", pose_message("camera", "tool", (0, 0, 200), 2), 2))
    scene, _ = material.scene()
    np.testing.assert_allclose(material.versions(scene)[0].entry, _FIRST, atol=1e-9)
    np.testing.assert_allclose(material.frames.path("tool", "camera").positions[:, 2], [0.1, 0.2])


def test_the_tool_moves_and_is_not_an_ancestor_of_the_camera() -> None:
    def material(tool: str = "") -> Material:
        found = _with_clouds(Material(tool=tool))
        for number in range(3):
            for child, parent in (("arm", "base"), ("camera", "arm"), ("needle", "base"), ("probe", "elsewhere")):
                found.take(entry(f"/{child}", pose_message(parent, child, (number, 0, 0), number + 1), number + 1))
        found.take(entry("/table", pose_message("base", "table", (1, 1, 1), 1), 1))
        return found

    assert material().tools("camera") == ["needle"]
    assert material("/needle").tools("camera") == material("needle").tools("camera") == ["needle"]
    with pytest.raises(ConfigError, match=r"--tool probe: .* expected /needle \(needle\)"):
        material("probe").tools("camera")


def test_an_invalid_message_is_left_out_and_noted_once() -> None:
    material = _with_clouds(Material())
    good = entry("/cloud", cloud_message(dome_clouds(1)[0].points, 9), 9)
    for _ in range(2):
        material.take(replace(good, payload=(good.data()[:100],)))
    assert len(material.scene()[0].clouds) == 3
    assert len([note for note in material.notes if note.startswith("/cloud: invalid messages are left out")]) == 1


def test_a_session_without_a_plan_is_an_error() -> None:
    material = _with_clouds(Material())
    with pytest.raises(GatewayError, match="found no suture plan, expected pairs of points on the tissue"):
        material.versions(material.scene()[0])
    named = _with_clouds(Material(plan="/none"))
    with pytest.raises(ConfigError, match="--plan /none"):
        named.versions(named.scene()[0])


@table("arrival_ns", [(1 << 62) - 1, (1 << 63) - 1, 1 << 63, (1 << 64) - 1])
@table("first_ns", [-(1 << 31) * SECOND, 1, SECOND])
def test_times_may_be_centuries_apart(first_ns: int, arrival_ns: int) -> None:
    """No difference exceeds 64 bits, whatever the times of poses and plans are."""
    material = _with_clouds(Material())
    last_ns = ((1 << 31) - 1) * SECOND
    for x, stamp_ns in ((0, first_ns), (4, last_ns), (8, last_ns)):
        pose = pose_message("camera", "tool", (x, 0, 0), stamp_ns)
        material.take(replace(entry("/tool", pose, 5), stamp_ns=arrival_ns - 8 + x))
    assert len(material.frames.path("tool", "camera").stamps_ns) in (1, 2, 3)
    for at_ns in (first_ns, last_ns):
        plan = plan_message(_FIRST, _LAST, max(at_ns, 0), "tool")
        material.take(replace(entry("/plan", plan, 6), stamp_ns=arrival_ns))
        material.take(replace(entry("/plan", plan, 6), stamp_ns=0))
    with contextlib.suppress(GatewayError):  # its place may be unknown
        material.versions(material.scene()[0])


def test_a_plan_whose_place_is_unknown_is_left_out_and_named() -> None:
    """The camera moves; a plan in the base is drawn 2 s before its first known pose, and again within them."""
    material = _with_clouds(Material())
    shift = np.array([1.0, 2.0, 3.0])
    for number in range(21):
        at_ns = 4 * SECOND + number * SECOND // 10
        camera = (1.0 + (number - 10) / 100, 2.0, 3.0)
        material.take(entry("/camera_pose", pose_message("base", "camera", camera, at_ns), at_ns))
    early = entry("/plan", plan_message(_FIRST + shift, _LAST + shift, 2 * SECOND, "base"), 2 * SECOND)
    material.take(early)
    with pytest.raises(GatewayError, match=r"place is known: .*'camera' in 'base'.* unknown at 6 of 6 moments"):
        material.versions(material.scene()[0])
    material.take(entry("/plan", plan_message(_FIRST + shift, _LAST + shift + 0.001, 5 * SECOND, "base"), 5 * SECOND))
    (version,) = material.versions(material.scene()[0])
    np.testing.assert_allclose(version.entry, _FIRST, atol=1e-12)
    assert "/plan: left out where the pose of its frame 'base' is not known" in material.notes
