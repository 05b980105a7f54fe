"""The synthetic STAR session: always the same bytes, the promised streams, the story, the arm at its stitches."""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
from collections import defaultdict
from collections.abc import Iterable
from typing import Any

import numpy as np
import pytest

from igtl_gateway.base.errors import ConfigError
from igtl_gateway.convert.common_msgs import CameraInfo
from igtl_gateway.convert.rosmsg import Image, Marker, PointCloud2, String, TransformStamped
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.wire import decode
from igtl_gateway.wire.point import Points
from igtl_gateway.wire.text import String as WireString
from igtl_gateway_lab.simulate import star
from igtl_gateway_lab.simulate import star_topics as topics
from igtl_gateway_lab.simulate.star_arm import APPROACH_S, BASE_FROM_CAMERA, CYCLE_S, DRIVE_S, to_base, to_camera
from igtl_gateway_lab.simulate.star_camera import IMAGE_CAMERA, CloudFrame
from igtl_gateway_lab.simulate.star_numbers import Array
from igtl_gateway_lab.simulate.star_scene import StarScene
from igtl_gateway_lab.simulate.star_tissue import GLINT_STITCH, PLANTED, STITCHES, surface_distance
from tests.lab.simulate.star_truth import SECONDS, length, matrix
from tests.places import ROOT

RATES_HZ = {
    topics.TOOL: 100,
    topics.MARKERS: 5,
    topics.CLOUD: 1,
    topics.IMAGE: 1,
    topics.CAMERA_INFO: 1,
    topics.CAMERA_POSE: 1,
}
CLASSES: dict[str, Any] = {
    topics.CLOUD: PointCloud2,
    topics.IMAGE: Image,
    topics.CAMERA_INFO: CameraInfo,
    topics.TOOL: TransformStamped,
    topics.CAMERA_POSE: TransformStamped,
    topics.MARKERS: PointCloud2,
    topics.PLAN: Marker,
    topics.PLAN_POINTS: PointCloud2,
    topics.STATUS: String,
}
#: What numpy may use beyond the oldest processor it runs on (its names before and since 2.4).
NEWER_PROCESSORS = "X86_V3 X86_V4 AVX512_ICL AVX512_SPR AVX2 FMA3 AVX512F AVX512CD AVX512_SKX"
AS_ON_AN_OLDER_ONE = """
import json, sys
from igtl_gateway_lab.simulate.catalogue import SCENARIOS
from tests.lab.simulate.test_star import digest
cast = SCENARIOS["star"].cast()
session = digest(SCENARIOS["star"].entries(cast=cast))
sys.stdout.write(json.dumps({"digest": session} | {actor.name: actor.report().facts for actor in cast}))
"""

Topics = dict[str, list[Entry]]


def digest(entries: Iterable[Entry]) -> str:
    sha = hashlib.sha256()
    for entry in entries:
        facts = (entry.seq, entry.kind.value, entry.stamp_ns, entry.source_ns, entry.channel, entry.type, entry.links)
        sha.update(repr(facts).encode() + entry.data())
    return sha.hexdigest()


def of(kind: Kind, entries: list[Entry]) -> Topics:
    grouped = defaultdict(list)
    for entry in entries:
        if entry.kind is kind:
            grouped[entry.channel].append(entry)
    return dict(grouped)


def stamps_ns(entries: list[Entry]) -> list[int]:
    return [CLASSES[entry.channel].unpack(entry.data()).header.stamp_ns for entry in entries]


def xyz(entry: Entry) -> Array:
    return topics.positions(entry.data()).astype(np.float64)


@pytest.fixture(scope="module")
def heard(star_session: list[Entry]) -> Topics:
    """The ROS messages that the gateway received."""
    return of(Kind.ROS_IN, star_session)


# ---------------------------------------------------------------- the session


def test_a_run_on_an_older_processor_gives_the_bytes_of_the_fixture(star_session: list[Entry]) -> None:
    # numpy's exp and arctan2 differ in the last bit between processors; the rounding to sensor steps must hide it
    env = {**os.environ, "NPY_DISABLE_CPU_FEATURES": NEWER_PROCESSORS, "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-c", AS_ON_AN_OLDER_ONE]
    done = subprocess.run(command, env=env, cwd=ROOT, capture_output=True, text=True, check=True)
    told = json.loads(done.stdout)
    assert told["digest"] == digest(star_session)
    # the reports of the actors
    robot, planner, sensors = (told[f"star_{name}"] for name in ("robot", "planner", "sensors"))
    assert [int(number) for number in robot["planted_mm"]] == list(PLANTED)
    assert list(robot["moved_mm"]) == [str(GLINT_STITCH + 1)] and planner["moved_mm"].keys() == {"entry 3"}
    assert set(robot["still_wrong_mm"]) == set(robot["planted_mm"]) - set(robot["moved_mm"]) != set()
    assert robot["approved"] and planner["approved"]
    assert robot["executed"] == 3 and robot["beside_plan_mm"] < 0.1
    assert sensors["clouds"] == SECONDS


@pytest.mark.parametrize("duration_s", [0, -1, float("nan"), float("inf")])
def test_a_duration_that_is_none_is_refused(duration_s: float) -> None:
    with pytest.raises(ConfigError, match="expected more than 0"):
        star.actors(duration_s)


def test_streams_have_their_types_rates_and_counts(heard: Topics) -> None:
    assert set(heard) == set(CLASSES)
    for topic, messages in heard.items():
        assert {m.type for m in messages} == {CLASSES[topic].TYPE} == {topics.TYPES[topic]}
    for topic, hertz in RATES_HZ.items():
        assert len(heard[topic]) == SECONDS * hertz
        assert set(np.diff(stamps_ns(heard[topic]))) == {10**9 // hertz}
    assert len(heard[topics.PLAN]) == len(heard[topics.PLAN_POINTS]) == 2


def test_messages_come_a_little_after_their_stamp(heard: Topics) -> None:
    for topic, messages in heard.items():
        if topic != topics.STATUS:
            delays = np.array([m.stamp_ns for m in messages]) - stamps_ns(messages)
            assert delays.min() > 0
            assert delays.max() < 100e6


def test_status_says_synthetic_first_and_then_the_phases(heard: Topics) -> None:
    lines = [String.unpack(message.data()).data for message in heard[topics.STATUS]]
    assert "SYNTHETIC" in lines[0]
    assert [line for line in lines if line.startswith("plan:")] == [
        "plan: 11 stitches from the first cloud",
        "plan: corrected by the planner: entry of stitch 3 by 2.0 mm",
        "plan: approved, the arm begins",
    ]
    assert [line for line in lines if line.startswith("stitch 2/11")] == [
        "stitch 2/11: approach",
        "stitch 2/11: drive",
        "stitch 2/11: pull",
    ]


# ---------------------------------------------------------------- the plan, there and back


def test_the_planner_puts_one_planted_stitch_onto_the_tissue_and_the_other_stays_wrong(
    heard: Topics, scene: StarScene
) -> None:
    wrong = []
    for message in heard[topics.PLAN_POINTS]:
        off = length(xyz(message)[0] - np.concatenate([scene.plan.entry, scene.plan.exit]))
        wrong.append(sorted({int(index) % STITCHES + 1 for index in np.flatnonzero(off > 0.001)}))
        assert off[off <= 0.001].max() < 0.0005
    assert wrong == [list(PLANTED), [PLANTED[1]]]


def test_the_planner_says_what_it_moved_and_sends_the_plan_back_under_its_name(star_session: list[Entry]) -> None:
    messages = [decode(entry.data()) for entry in star_session if entry.kind is Kind.IGTL_IN]
    assert [(m.type, m.device_name) for m in messages] == [
        ("STATUS", "Navigation"),
        ("STRING", "Navigation"),
        ("POINT", "PlanPoints"),
        ("STRING", "Navigation"),
    ]
    texts = [m.content.text for m in messages if isinstance(m.content, WireString)]
    assert texts == ["moved: entry 3, 2.0 mm off the cloud", "plan approved"]
    assert isinstance(messages[2].content, Points)
    names = [bytes(name).decode() for name in messages[2].content.elements["name"]]
    assert (names[0], names[10], names[11], names[21]) == ("entry 1", "entry 11", "exit 1", "exit 11")


def test_the_robot_repeats_the_plan_as_it_came_back(star_session: list[Entry], heard: Topics) -> None:
    back = next(entry for entry in star_session if entry.channel == topics.CORRECTED)
    assert PointCloud2.unpack(back.data()).header.frame_id == topics.CAMERA_FRAME
    first, second = (xyz(entry)[0] for entry in heard[topics.PLAN_POINTS])
    moved = length(second - first) > 1e-6
    assert np.flatnonzero(moved).tolist() == [GLINT_STITCH]
    np.testing.assert_allclose(xyz(back)[0][moved], second[moved], atol=1e-8)
    # along the ray: the picture of the plan has not changed
    np.testing.assert_allclose(IMAGE_CAMERA.project(first), IMAGE_CAMERA.project(second), atol=0.01)


def test_plan_messages_hold_both_rows(heard: Topics, scene: StarScene) -> None:
    for plan, points in zip(heard[topics.PLAN], heard[topics.PLAN_POINTS], strict=True):
        marker, rows = Marker.unpack(plan.data()), xyz(points)[0]
        assert marker.type == Marker.LINE_LIST
        np.testing.assert_array_equal(marker.points[0::2].astype(np.float32), rows[:STITCHES])
        np.testing.assert_array_equal(marker.points[1::2].astype(np.float32), rows[STITCHES:])
        assert len(np.unique(marker.colors, axis=0)) == STITCHES
        np.testing.assert_array_equal(marker.colors[0::2], marker.colors[1::2])
    np.testing.assert_array_equal(Marker.unpack(heard[topics.PLAN][0].data()).points[0::2], scene.measured_plan.entry)


# ---------------------------------------------------------------- the sensors


def test_cloud_message_is_organised_packed_as_pcl_does_and_has_gaps(heard: Topics, frames: list[CloudFrame]) -> None:
    message = heard[topics.CLOUD][0]
    cloud = PointCloud2.unpack(message.data())
    assert (cloud.width, cloud.height, cloud.point_step, cloud.row_step) == (200, 150, 16, 3200)
    assert cloud.header.frame_id == topics.CAMERA_FRAME
    assert [(f.name, f.offset, f.datatype) for f in cloud.fields] == [
        ("x", 0, 7),
        ("y", 4, 7),
        ("z", 8, 7),
        ("rgb", 12, 7),
    ]
    assert not cloud.is_dense
    words = np.frombuffer(cloud.data, "<u4").reshape(150, 200, 4)
    np.testing.assert_array_equal(xyz(message), frames[0].points.astype(np.float64))
    np.testing.assert_array_equal(words[..., 3] >> 16, frames[0].rgb[..., 0])
    np.testing.assert_array_equal(words[..., 3] & 0xFF, frames[0].rgb[..., 2])
    assert 0.02 < np.isnan(xyz(message)[..., 2]).mean() < 0.25


def test_image_message_shows_red_tissue(heard: Topics) -> None:
    image = Image.unpack(heard[topics.IMAGE][0].data())
    assert (image.width, image.height, image.step, image.encoding) == (320, 240, 960, "rgb8")
    red, green, blue = np.frombuffer(image.data, np.uint8).reshape(-1, 3).mean(axis=0)
    assert red > 1.3 * green
    assert red > 1.3 * blue


def test_the_tool_is_in_the_picture_where_its_pose_says(heard: Topics) -> None:
    """The camera received the pose: the shaft is grey where the tissue was red."""
    message = heard[topics.IMAGE][4]
    image, before = (Image.unpack(m.data()) for m in (message, heard[topics.IMAGE][1]))
    stamp_ns = image.header.stamp_ns
    poses = [TransformStamped.unpack(m.data()) for m in heard[topics.TOOL]]
    pose = next(pose for pose in poses if pose.header.stamp_ns == stamp_ns)
    up_the_shaft = to_camera(np.array(pose.translation)) - 0.02 * camera_axes(pose.rotation)[:, 2]
    column, row = np.rint(IMAGE_CAMERA.project(up_the_shaft)).astype(int)
    there, once = (np.frombuffer(one.data, np.uint8).reshape(240, 320, 3)[row, column] for one in (image, before))
    assert int(there.max()) - int(there.min()) < 10
    assert int(once.max()) - int(once.min()) > 30


def camera_axes(rotation: tuple[float, ...]) -> Array:
    return np.asarray(BASE_FROM_CAMERA[:3, :3].T @ matrix(rotation))


def test_camera_info_is_the_pinhole_of_the_picture(heard: Topics, scene: StarScene) -> None:
    for message, picture in zip(heard[topics.CAMERA_INFO], heard[topics.IMAGE], strict=True):
        info, image = CameraInfo.unpack(message.data()), Image.unpack(picture.data())
        assert info.header == image.header
        assert (info.width, info.height) == (image.width, image.height)
    assert (info.distortion_model, info.d.tolist()) == ("plumb_bob", [0.0] * 5)
    homogeneous = scene.plan.exit @ np.reshape(info.k, (3, 3)).T
    np.testing.assert_allclose(homogeneous[:, :2] / homogeneous[:, 2:], IMAGE_CAMERA.project(scene.plan.exit))
    np.testing.assert_array_equal(np.reshape(info.p, (3, 4))[:, :3], np.reshape(info.k, (3, 3)))
    np.testing.assert_array_equal(np.reshape(info.r, (3, 3)), np.eye(3))


def test_marker_messages_are_near_the_glue_dots(heard: Topics, scene: StarScene) -> None:
    found = np.array([xyz(message)[0] for message in heard[topics.MARKERS]])
    error = found - scene.markers
    assert error.shape == (60, 6, 3)
    assert length(error).max() < 0.001
    assert length(error.mean(axis=0)).max() < 0.00015  # unbiased
    assert error[..., 2].std() > 2 * error[..., 0].std()  # worst along the optical axis


# ---------------------------------------------------------------- the arm


def tool_poses(heard: Topics) -> tuple[Array, Array]:
    poses = [TransformStamped.unpack(message.data()) for message in heard[topics.TOOL]]
    assert {(pose.header.frame_id, pose.child_frame_id) for pose in poses} == {("lwr_base", "suture_tool")}
    return np.array([pose.translation for pose in poses]), np.array([pose.rotation for pose in poses])


def begin_s(heard: Topics) -> float:
    """When the arm set off, in seconds of the tool's stamps."""
    first_ns = stamps_ns(heard[topics.TOOL])[0]
    said = next(m for m in heard[topics.STATUS] if String.unpack(m.data()).data == "stitch 1/11: approach")
    return round((said.stamp_ns - first_ns) / 1e9, 2)


def test_camera_pose_is_static_and_the_hand_eye_transform(heard: Topics) -> None:
    poses = [TransformStamped.unpack(message.data()) for message in heard[topics.CAMERA_POSE]]
    assert len({(pose.child_frame_id, pose.translation, pose.rotation) for pose in poses}) == 1
    rotation = BASE_FROM_CAMERA[:3, :3]
    np.testing.assert_allclose(matrix(poses[0].rotation), rotation, atol=1e-12)
    np.testing.assert_array_equal(poses[0].translation, BASE_FROM_CAMERA[:3, 3])
    np.testing.assert_allclose(rotation.T @ rotation, np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1)
    points = np.array([[0.01, -0.02, 0.25], [0.0, 0.0, 0.0]])
    np.testing.assert_allclose(to_base(points), points @ rotation.T + BASE_FROM_CAMERA[:3, 3], atol=1e-12)
    np.testing.assert_allclose(to_camera(to_base(points)), points, atol=1e-12)


def test_tool_quaternions_are_unit_and_never_change_sign(heard: Topics) -> None:
    _, rotation = tool_poses(heard)
    np.testing.assert_allclose(length(rotation), 1, atol=1e-8)
    assert (rotation[1:] * rotation[:-1]).sum(axis=1).min() > 0.9999
    turned = 2 * np.arccos(np.clip(np.abs((rotation * rotation[0]).sum(axis=1)), 0, 1))
    assert 0.25 < turned.max() < 0.5  # the wrist helps the needle


def test_tool_waits_for_the_approval_then_moves_smoothly_and_trembles(heard: Topics) -> None:
    position, _ = tool_poses(heard)
    speed = length(np.diff(position, axis=0)) * 100
    assert 0.05 < speed.max() < 0.25  # m/s: an arm among people
    jerk = length(np.diff(position, n=2, axis=0)) * 1e4
    assert jerk.max() < 2.0  # m/s²: no jump anywhere
    assert 1.5 < begin_s(heard) < 2.5
    at_rest = position[: round(begin_s(heard) * 100)]
    assert 1e-6 < length(at_rest - at_rest.mean(axis=0)).max() < 1e-4


def test_tool_reaches_the_stitches_of_the_corrected_plan(heard: Topics, scene: StarScene) -> None:
    """Within 0.1 mm of the plan in force, within 0.5 mm of the truth, and under the tissue in between."""
    tip = to_camera(tool_poses(heard)[0])
    plan, done = xyz(heard[topics.PLAN_POINTS][-1])[0], int((SECONDS - begin_s(heard)) // CYCLE_S)
    assert done == 3 > GLINT_STITCH
    for stitch in range(done):
        begin = begin_s(heard) + stitch * CYCLE_S + APPROACH_S
        drive = tip[round(begin * 100) : round((begin + DRIVE_S) * 100) + 1]
        assert length(drive[0] - plan[stitch]) < 1e-4
        assert length(drive[-1] - plan[STITCHES + stitch]) < 1e-4
        assert length(drive[0] - scene.plan.entry[stitch]) < 5e-4
        assert surface_distance(drive).min() < -0.001
