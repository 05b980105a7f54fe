"""The synthetic STAR session: always the same bytes, the promised streams, geometry that holds against its truth."""

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
from igtl_gateway.simulate import star_scene as ss
from igtl_gateway.simulate.star import SceneMessage

SECONDS = 12
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


def length(vectors: ss.Array) -> ss.Array:
    return np.asarray(np.linalg.norm(vectors, axis=-1))


def stamps_ns(messages: list[SceneMessage]) -> list[int]:
    return [TYPES[message.topic].unpack(message.cdr).header.stamp_ns for message in messages]


def xyz(message: SceneMessage) -> ss.Array:
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


@pytest.fixture(scope="module")
def scene() -> ss.Scene:
    return ss.Scene()


@pytest.fixture(scope="module")
def frames(scene: ss.Scene) -> list[ss.CloudFrame]:
    return [scene.cloud(number, 0.1 + number) for number in range(SECONDS)]


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


def test_another_seed_gives_other_noise() -> None:
    assert not np.array_equal(ss.Scene(1).detected_markers(0), ss.Scene(2).detected_markers(0))


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
    duration_s = 2 * (ss.IDLE_S + ss.APPROACH_S - 0.010)
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


def test_cloud_message_is_organised_packed_as_pcl_does_and_has_gaps(
    topics: Topics, frames: list[ss.CloudFrame]
) -> None:
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


def test_plan_messages_hold_both_rows(topics: Topics, scene: ss.Scene) -> None:
    for number, plan in enumerate([scene.measured_plan, scene.corrected_plan]):
        marker = Marker.unpack(topics["/star/plan"][number].cdr)
        assert marker.type == Marker.LINE_LIST
        np.testing.assert_array_equal(marker.points[0::2], plan.entry)
        np.testing.assert_array_equal(marker.points[1::2], plan.exit)
        assert len(np.unique(marker.colors, axis=0)) == ss.STITCHES
        np.testing.assert_array_equal(marker.colors[0::2], marker.colors[1::2])
        rows = xyz(topics["/star/plan_points"][number])[0]
        np.testing.assert_array_equal(rows, np.concatenate([plan.entry, plan.exit]).astype(np.float32))


def test_marker_messages_are_near_the_glue_dots(topics: Topics, scene: ss.Scene) -> None:
    found = np.array([xyz(message)[0] for message in topics["/star/nir_markers"]])
    error = found - scene.markers
    assert error.shape == (60, 6, 3)
    assert length(error).max() < 0.001
    assert length(error.mean(axis=0)).max() < 0.00015  # unbiased
    assert error[..., 2].std() > 2 * error[..., 0].std()  # worst along the optical axis


# ---------------------------------------------------------------- geometry against the truth


@pytest.mark.parametrize("camera", ["cloud_view", "image_view"])
def test_views_lie_on_the_true_surface(scene: ss.Scene, camera: str) -> None:
    view: ss.View = getattr(scene, camera)
    assert np.abs(ss.surface_distance(view.rays * view.depth[..., None])).max() < 1e-6
    assert abs(view.depth.min() - ss.FOCUS_M) < 0.002
    width = view.rays[0, -1, 0] - view.rays[0, 0, 0]
    assert width * ss.FOCUS_M == pytest.approx(0.070, rel=0.01)


def test_stitches_have_their_spacing_and_bite_and_lie_on_the_tissue(scene: ss.Scene) -> None:
    plan = scene.plan
    assert plan.entry.shape == plan.exit.shape == (11, 3)
    for row in (plan.entry, plan.exit):
        assert np.abs(ss.surface_distance(row)).max() < 1e-9
        # 3 mm along the axis; the folds between two stitches make it a little more
        np.testing.assert_allclose(length(np.diff(row, axis=0)) * 1e3, 3.0, atol=0.25)
    # 3.5 mm of arc to either side; the chord is shorter, the folds change it by some tenths
    np.testing.assert_allclose(length(plan.entry - plan.exit) * 1e3, 7.0, atol=0.4)
    assert (plan.entry[:, 1] < plan.exit[:, 1]).all()


def test_measured_plan_misses_at_the_wet_spot_and_the_corrected_one_does_not(scene: ss.Scene) -> None:
    miss = length(scene.measured_plan.exit - scene.plan.exit)
    assert 0.0015 < miss[ss.WET_STITCH] < 0.0025
    assert np.delete(miss, ss.WET_STITCH).max() < 0.0005
    assert length(scene.measured_plan.entry - scene.plan.entry).max() < 0.0005
    assert length(scene.corrected_plan.exit - scene.plan.exit).max() < 0.0005
    # drawn in the picture: the miss is along the ray, where the picture cannot show it
    np.testing.assert_allclose(
        ss.IMAGE_CAMERA.project(scene.measured_plan.exit), ss.IMAGE_CAMERA.project(scene.plan.exit), atol=0.05
    )


def dry(scene: ss.Scene, frame: ss.CloudFrame) -> ss.Mask:
    """All but the wet spot, which reads too deep on purpose."""
    return np.asarray(length(frame.truth - scene.plan.exit[ss.WET_STITCH]) > ss.WET_RADIUS_M)


@pytest.fixture(scope="module")
def depth_errors(scene: ss.Scene, frames: list[ss.CloudFrame]) -> tuple[ss.Array, ss.Array, ss.Array]:
    """Depth error, true depth and facing of every measured tissue point, without outliers and the wet spot."""
    error, depth, facing = [], [], []
    for frame in frames:
        use = np.isfinite(frame.points[..., 2]) & ~frame.outlier & ~frame.tool & dry(scene, frame)
        error.append((frame.points[..., 2] - frame.truth[..., 2])[use])
        depth.append(frame.truth[..., 2][use])
        facing.append(scene.cloud_view.facing[use])
    return np.concatenate(error), np.concatenate(depth), np.concatenate(facing)


def test_depth_noise_follows_its_model(depth_errors: tuple[ss.Array, ss.Array, ss.Array]) -> None:
    error, depth, facing = depth_errors
    scaled = error / ss.noise_sigma(depth, facing)
    assert abs(scaled.mean()) < 0.02
    assert scaled.std() == pytest.approx(1, abs=0.02)
    at_focus = (np.abs(depth - ss.FOCUS_M) < 0.002) & (facing > 0.97)
    assert error[at_focus].std() == pytest.approx(0.00018, rel=0.05)


def test_depth_noise_grows_with_depth_and_towards_grazing(depth_errors: tuple[ss.Array, ss.Array, ss.Array]) -> None:
    error, depth, facing = depth_errors
    towards = facing > 0.95
    near, far = error[towards & (depth < 0.252)].std(), error[towards & (depth > 0.285)].std()
    assert far / near == pytest.approx((0.29 / 0.251) ** 2, rel=0.1)
    level = np.abs(depth - 0.262) < 0.003  # flanks of the main tube, tops of the loops behind it
    steep, flat = error[level & (facing < 0.5)].std(), error[level & (facing > 0.9)].std()
    assert steep > 1.4 * flat


def test_depth_noise_is_alike_between_neighbours(scene: ss.Scene, frames: list[ss.CloudFrame]) -> None:
    def likeness(pixels: int) -> float:
        products = []
        for frame in frames:
            sigma = ss.noise_sigma(scene.cloud_view.depth, scene.cloud_view.facing)
            error = (frame.points[..., 2] - frame.truth[..., 2]) / sigma
            error[frame.outlier | frame.tool | ~dry(scene, frame)] = np.nan
            products.append(error[:, :-pixels] * error[:, pixels:])
        return float(np.nanmean(products))

    assert 0.2 < likeness(1) < 0.5
    assert abs(likeness(40)) < 0.05


def test_what_the_camera_loses(scene: ss.Scene, frames: list[ss.CloudFrame]) -> None:
    view = scene.cloud_view
    lost = np.mean([np.isnan(frame.points[..., 0]) & ~frame.tool for frame in frames], axis=0)
    clear = (view.facing > 0.5) & (view.gloss < 0.5) & (view.depth < 0.268)
    assert 0.005 < lost[clear].mean() < 0.04
    for frame in frames:
        assert np.isnan(frame.points[(view.facing < 0.25) & ~frame.tool]).all()
        assert np.isnan(frame.points[(view.gloss > 0.7) & ~frame.tool]).all()
    assert lost[view.depth > 0.285].mean() > 0.3  # blurred
    assert 0.001 < np.mean([frame.outlier for frame in frames]) < 0.003


def test_tool_covers_part_of_the_later_clouds_only(frames: list[ss.CloudFrame]) -> None:
    assert not frames[0].tool.any()  # at rest outside the picture
    assert frames[2].tool.sum() > 500
    shown = frames[2].tool & np.isfinite(frames[2].points[..., 2]) & ~frames[2].outlier
    np.testing.assert_allclose(frames[2].points[shown][:, 2], frames[2].truth[shown][:, 2], atol=0.002)


# ---------------------------------------------------------------- the arm


def tool_poses(topics: Topics) -> tuple[ss.Array, ss.Array]:
    poses = [TransformStamped.unpack(message.cdr) for message in topics["/star/tool"]]
    assert {(pose.header.frame_id, pose.child_frame_id) for pose in poses} == {("lwr_base", "suture_tool")}
    return np.array([pose.translation for pose in poses]), np.array([pose.rotation for pose in poses])


def matrix(rotation: Iterable[float]) -> ss.Array:
    """Rotation matrix of x, y, z, w by the textbook formula, independent of the code under test."""
    x, y, z, w = rotation
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def test_camera_pose_is_static_and_the_hand_eye_transform(topics: Topics) -> None:
    poses = [TransformStamped.unpack(message.cdr) for message in topics["/star/camera_pose"]]
    assert len({(pose.child_frame_id, pose.translation, pose.rotation) for pose in poses}) == 1
    rotation = ss.BASE_FROM_CAMERA[:3, :3]
    np.testing.assert_allclose(matrix(poses[0].rotation), rotation, atol=1e-12)
    np.testing.assert_array_equal(poses[0].translation, ss.BASE_FROM_CAMERA[:3, 3])
    np.testing.assert_allclose(rotation.T @ rotation, np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1)
    points = np.array([[0.01, -0.02, 0.25], [0.0, 0.0, 0.0]])
    np.testing.assert_allclose(ss.to_base(points), points @ rotation.T + ss.BASE_FROM_CAMERA[:3, 3], atol=1e-12)
    np.testing.assert_allclose(ss.to_camera(ss.to_base(points)), points, atol=1e-12)


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
    at_rest = position[: round(ss.IDLE_S * 100)]
    assert 1e-6 < length(at_rest - at_rest.mean(axis=0)).max() < 1e-4


def test_tool_reaches_the_stitches_of_the_session(topics: Topics, scene: ss.Scene) -> None:
    """Within 0.1 mm of the corrected plan, within 0.5 mm of the truth, and under the tissue in between."""
    tip = ss.to_camera(tool_poses(topics)[0])
    plan, done = scene.corrected_plan, int((SECONDS - ss.IDLE_S) // ss.CYCLE_S)
    assert done == 3
    for stitch in range(done):
        begin = ss.IDLE_S + stitch * ss.CYCLE_S + ss.APPROACH_S
        drive = tip[round(begin * 100) : round((begin + ss.DRIVE_S) * 100) + 1]
        assert length(drive[0] - plan.entry[stitch]) < 1e-4
        assert length(drive[-1] - plan.exit[stitch]) < 1e-4
        assert length(drive[0] - scene.plan.entry[stitch]) < 5e-4
        assert ss.surface_distance(drive).min() < -0.001


def test_pulled_needle_leaves_the_tissue(scene: ss.Scene) -> None:
    ends = np.array([ss.IDLE_S + ss.CYCLE_S * (stitch + 1) for stitch in range(ss.STITCHES)])
    tips = ss.to_camera(scene.tool(ends).position)
    np.testing.assert_allclose(length(tips - scene.corrected_plan.exit), ss.RETRACT_M, atol=1e-4)
    assert ss.surface_distance(tips).min() > 0.005


@pytest.mark.parametrize("axis", range(4))
def test_quaternion_of_every_branch(axis: int) -> None:
    """Turns by 170° about x, y, z (each another largest element) and a small one: back to the same matrix."""
    half = np.deg2rad(85 if axis < 3 else 10)
    q = np.zeros(4)
    q[axis % 3], q[3] = np.sin(half), np.cos(half)
    found = ss.quaternion(matrix(q))
    np.testing.assert_allclose(found * np.sign(found[3]), q, atol=1e-12)
