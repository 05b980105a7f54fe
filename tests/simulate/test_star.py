"""The synthetic STAR session: always the same bytes, the promised streams, the arm at its stitches."""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
from collections import defaultdict
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from igtl_gateway.convert.rosmsg import Image, Marker, PointCloud2, String, TransformStamped
from igtl_gateway.errors import ConfigError
from igtl_gateway.simulate import star
from igtl_gateway.simulate.star import SceneMessage
from igtl_gateway.simulate.star_arm import APPROACH_S, BASE_FROM_CAMERA, CYCLE_S, DRIVE_S, IDLE_S, to_base, to_camera
from igtl_gateway.simulate.star_camera import CloudFrame
from igtl_gateway.simulate.star_numbers import Array
from igtl_gateway.simulate.star_scene import Scene
from igtl_gateway.simulate.star_tissue import STITCHES, surface_distance
from tests.simulate.star_truth import SECONDS, length, matrix

RATES_HZ = {
    "/star/tool": 100,
    "/star/nir_markers": 5,
    "/star/cloud": 1,
    "/star/camera/image": 1,
    "/star/camera_pose": 1,
}
TYPES: dict[str, Any] = {
    "/star/cloud": PointCloud2,
    "/star/camera/image": Image,
    "/star/tool": TransformStamped,
    "/star/camera_pose": TransformStamped,
    "/star/nir_markers": PointCloud2,
    "/star/plan": Marker,
    "/star/plan_points": PointCloud2,
}
LATCHED = {"/star/plan", "/star/plan_points", "/star/camera_pose", "/star/status"}
#: What numpy may use beyond the oldest processor it runs on (its names before and since 2.4).
NEWER_PROCESSORS = "X86_V3 X86_V4 AVX512_ICL AVX512_SPR AVX2 FMA3 AVX512F AVX512CD AVX512_SKX"

Topics = dict[str, list[SceneMessage]]


def digest(messages: Iterable[SceneMessage]) -> str:
    sha = hashlib.sha256()
    for message in messages:
        sha.update(f"{message.time_ns} {message.topic} {message.type} {message.latched} {len(message.cdr)}".encode())
        sha.update(message.cdr)
    return sha.hexdigest()


def stamps_ns(messages: list[SceneMessage]) -> list[int]:
    return [TYPES[message.topic].unpack(message.cdr).header.stamp_ns for message in messages]


def xyz(message: SceneMessage) -> Array:
    cloud = PointCloud2.unpack(message.cdr)
    packed = np.frombuffer(cloud.data, "<f4").reshape(cloud.height, cloud.width, cloud.point_step // 4)
    return packed[..., :3].astype(np.float64)


@pytest.fixture(scope="module")
def session() -> list[SceneMessage]:
    return list(star.messages(SECONDS))


@pytest.fixture(scope="module")
def topics(session: list[SceneMessage]) -> Topics:
    grouped = defaultdict(list)
    for message in session:
        grouped[message.topic].append(message)
    return dict(grouped)


# ---------------------------------------------------------------- the session


def test_another_run_on_an_older_processor_gives_the_same_bytes(session: list[SceneMessage]) -> None:
    code = (
        "from igtl_gateway.simulate.star import messages; from tests.simulate.test_star import digest;"
        f"import sys; sys.stdout.write(digest(messages({SECONDS})))"
    )
    # numpy's exp and arctan2 differ in the last bit between processors; the rounding to sensor steps must hide it
    env = {**os.environ, "NPY_DISABLE_CPU_FEATURES": NEWER_PROCESSORS}
    root = Path(__file__).parents[2]
    done = subprocess.run([sys.executable, "-c", code], env=env, cwd=root, capture_output=True, text=True, check=True)
    assert done.stdout == digest(session)


def test_start_moves_every_time_and_nothing_else() -> None:
    first, later = (list(star.messages(0.1, start_ns=start_ns)) for start_ns in (10**18, 10**18 + 5 * 10**9))
    assert [m.time_ns + 5 * 10**9 for m in first] == [m.time_ns for m in later]
    a, b = (TransformStamped.unpack(next(m.cdr for m in run if m.topic == "/star/tool")) for run in (first, later))
    assert b.header.stamp_ns - a.header.stamp_ns == 5 * 10**9
    assert (a.translation, a.rotation) == (b.translation, b.rotation)


@pytest.mark.parametrize("duration_s", [0, -1, float("nan"), float("inf")])
def test_a_duration_that_is_none_is_refused(duration_s: float) -> None:
    with pytest.raises(ConfigError, match="expected more than 0"):
        star.messages(duration_s)


def test_streams_have_their_types_rates_and_counts(topics: Topics) -> None:
    assert set(topics) == {*TYPES, "/star/status"}
    for topic, messages in topics.items():
        assert {m.type for m in messages} == {TYPES.get(topic, String).TYPE}
        assert {m.latched for m in messages} == {topic in LATCHED}
    for topic, hertz in RATES_HZ.items():
        assert len(topics[topic]) == SECONDS * hertz
        assert set(np.diff(stamps_ns(topics[topic]))) == {10**9 // hertz}
    assert len(topics["/star/plan"]) == len(topics["/star/plan_points"]) == 2


def test_messages_come_in_order_and_a_little_after_their_stamp(session: list[SceneMessage], topics: Topics) -> None:
    times = [message.time_ns for message in session]
    assert times == sorted(times)
    for topic, messages in topics.items():
        assert all(np.diff([message.time_ns for message in messages]) > 0)
        if topic in TYPES:
            stamps = stamps_ns(messages)
            assert all(np.diff(stamps) > 0)
            delays = np.array([m.time_ns for m in messages]) - stamps
            assert delays.min() > 0
            assert delays.max() < 100e6


def test_close_messages_of_a_topic_stay_in_order() -> None:
    # here the note on the mended plan falls on the very moment at which a phase begins
    duration_s = 2 * (IDLE_S + APPROACH_S - 0.010)
    status = [m for m in star.messages(duration_s) if m.topic == "/star/status"]
    assert len({m.time_ns for m in status}) == len(status) == 6


def test_status_says_synthetic_first_and_then_the_phases(topics: Topics) -> None:
    lines = [String.unpack(message.cdr).data for message in topics["/star/status"]]
    assert "SYNTHETIC" in lines[0]
    assert [line for line in lines if line.startswith("stitch 2/11")] == [
        "stitch 2/11: approach",
        "stitch 2/11: drive",
        "stitch 2/11: pull",
    ]
    assert sum(line.startswith("plan:") for line in lines) == 2


def test_cloud_message_is_organised_packed_as_pcl_does_and_has_gaps(topics: Topics, frames: list[CloudFrame]) -> None:
    cloud = PointCloud2.unpack(topics["/star/cloud"][4].cdr)
    assert (cloud.width, cloud.height, cloud.point_step, cloud.row_step) == (200, 150, 16, 3200)
    assert cloud.header.frame_id == star.CAMERA_FRAME
    assert [(f.name, f.offset, f.datatype) for f in cloud.fields] == [
        ("x", 0, 7),
        ("y", 4, 7),
        ("z", 8, 7),
        ("rgb", 12, 7),
    ]
    assert not cloud.is_dense
    words = np.frombuffer(cloud.data, "<u4").reshape(150, 200, 4)
    np.testing.assert_array_equal(xyz(topics["/star/cloud"][4]), frames[4].points.astype(np.float64))
    np.testing.assert_array_equal(words[..., 3] >> 16, frames[4].rgb[..., 0])
    np.testing.assert_array_equal(words[..., 3] & 0xFF, frames[4].rgb[..., 2])
    assert 0.02 < np.isnan(xyz(topics["/star/cloud"][4])[..., 2]).mean() < 0.25


def test_image_message_shows_red_tissue(topics: Topics) -> None:
    image = Image.unpack(topics["/star/camera/image"][0].cdr)
    assert (image.width, image.height, image.step, image.encoding) == (320, 240, 960, "rgb8")
    red, green, blue = np.frombuffer(image.data, np.uint8).reshape(-1, 3).mean(axis=0)
    assert red > 1.3 * green
    assert red > 1.3 * blue


def test_plan_messages_hold_both_rows(topics: Topics, scene: Scene) -> None:
    for number, plan in enumerate([scene.measured_plan, scene.corrected_plan]):
        marker = Marker.unpack(topics["/star/plan"][number].cdr)
        assert marker.type == Marker.LINE_LIST
        np.testing.assert_array_equal(marker.points[0::2], plan.entry)
        np.testing.assert_array_equal(marker.points[1::2], plan.exit)
        assert len(np.unique(marker.colors, axis=0)) == STITCHES
        np.testing.assert_array_equal(marker.colors[0::2], marker.colors[1::2])
        rows = xyz(topics["/star/plan_points"][number])[0]
        np.testing.assert_array_equal(rows, np.concatenate([plan.entry, plan.exit]).astype(np.float32))


def test_marker_messages_are_near_the_glue_dots(topics: Topics, scene: Scene) -> None:
    found = np.array([xyz(message)[0] for message in topics["/star/nir_markers"]])
    error = found - scene.markers
    assert error.shape == (60, 6, 3)
    assert length(error).max() < 0.001
    assert length(error.mean(axis=0)).max() < 0.00015  # unbiased
    assert error[..., 2].std() > 2 * error[..., 0].std()  # worst along the optical axis


# ---------------------------------------------------------------- the arm


def tool_poses(topics: Topics) -> tuple[Array, Array]:
    poses = [TransformStamped.unpack(message.cdr) for message in topics["/star/tool"]]
    assert {(pose.header.frame_id, pose.child_frame_id) for pose in poses} == {("lwr_base", "suture_tool")}
    return np.array([pose.translation for pose in poses]), np.array([pose.rotation for pose in poses])


def test_camera_pose_is_static_and_the_hand_eye_transform(topics: Topics) -> None:
    poses = [TransformStamped.unpack(message.cdr) for message in topics["/star/camera_pose"]]
    assert len({(pose.child_frame_id, pose.translation, pose.rotation) for pose in poses}) == 1
    rotation = BASE_FROM_CAMERA[:3, :3]
    np.testing.assert_allclose(matrix(poses[0].rotation), rotation, atol=1e-12)
    np.testing.assert_array_equal(poses[0].translation, BASE_FROM_CAMERA[:3, 3])
    np.testing.assert_allclose(rotation.T @ rotation, np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1)
    points = np.array([[0.01, -0.02, 0.25], [0.0, 0.0, 0.0]])
    np.testing.assert_allclose(to_base(points), points @ rotation.T + BASE_FROM_CAMERA[:3, 3], atol=1e-12)
    np.testing.assert_allclose(to_camera(to_base(points)), points, atol=1e-12)


def test_tool_quaternions_are_unit_and_never_change_sign(topics: Topics) -> None:
    _, rotation = tool_poses(topics)
    np.testing.assert_allclose(length(rotation), 1, atol=1e-8)
    assert (rotation[1:] * rotation[:-1]).sum(axis=1).min() > 0.9999
    turned = 2 * np.arccos(np.clip(np.abs((rotation * rotation[0]).sum(axis=1)), 0, 1))
    assert 0.25 < turned.max() < 0.5  # the wrist helps the needle


def test_tool_moves_smoothly_and_trembles(topics: Topics) -> None:
    position, _ = tool_poses(topics)
    speed = length(np.diff(position, axis=0)) * 100
    assert 0.05 < speed.max() < 0.25  # m/s: an arm among people
    jerk = length(np.diff(position, n=2, axis=0)) * 1e4
    assert jerk.max() < 2.0  # m/s²: no jump anywhere
    at_rest = position[: round(IDLE_S * 100)]
    assert 1e-6 < length(at_rest - at_rest.mean(axis=0)).max() < 1e-4


def test_tool_reaches_the_stitches_of_the_session(topics: Topics, scene: Scene) -> None:
    """Within 0.1 mm of the corrected plan, within 0.5 mm of the truth, and under the tissue in between."""
    tip = to_camera(tool_poses(topics)[0])
    plan, done = scene.corrected_plan, int((SECONDS - IDLE_S) // CYCLE_S)
    assert done == 3
    for stitch in range(done):
        begin = IDLE_S + stitch * CYCLE_S + APPROACH_S
        drive = tip[round(begin * 100) : round((begin + DRIVE_S) * 100) + 1]
        assert length(drive[0] - plan.entry[stitch]) < 1e-4
        assert length(drive[-1] - plan.exit[stitch]) < 1e-4
        assert length(drive[0] - scene.plan.entry[stitch]) < 5e-4
        assert surface_distance(drive).min() < -0.001
