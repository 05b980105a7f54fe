"""The arms of the CRTK scenario: the URDF as an independent truth, and what the robot follows."""

from __future__ import annotations

import xml.etree.ElementTree as ET

import numpy as np
import pytest

from igtl_gateway.convert.common_msgs import JointState, PoseStamped, StringStamped
from igtl_gateway.convert.poses import rotation_matrix
from igtl_gateway.convert.rosmsg import Header, String
from igtl_gateway.gateway.log.entry import Kind
from igtl_gateway.gateway.log.note import Note
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.wire import decode
from igtl_gateway_lab.simulate.actor import RosReceived, RosSent
from igtl_gateway_lab.simulate.crtk_arm import ARMS, JOINTS, WORLD, urdf
from igtl_gateway_lab.simulate.crtk_robot import TICK_NS, CrtkRobot
from igtl_gateway_lab.simulate.star_numbers import Array
from tests.places import ROOT

FIXTURE = ROOT / "fixtures" / "crtk.mcap"
START_NS = 1_700_000_000_000_000_000


def place_by_urdf(text: str, link: str, values: dict[str, float]) -> Array:
    """(4, 4) of a link in the root: a general reader of URDF, which knows nothing of these arms."""
    joints = {j.find("child").get("link"): j for j in ET.fromstring(text).findall("joint")}  # type: ignore[union-attr]
    place = np.eye(4)
    while link in joints:
        joint = joints[link]
        origin, axis = joint.find("origin"), joint.find("axis")
        assert origin is not None
        step = np.eye(4)
        step[:3, 3] = np.array(origin.get("xyz", "0 0 0").split(), float)
        for axis_of_rpy, angle in zip(
            np.eye(3)[::-1], np.array(origin.get("rpy", "0 0 0").split(), float)[::-1], strict=True
        ):
            step[:3, :3] = step[:3, :3] @ rodrigues(axis_of_rpy, angle)
        value = values.get(joint.get("name", ""), 0.0)
        if axis is not None:
            along, moved = np.array(axis.get("xyz", "").split(), float), np.eye(4)
            if joint.get("type") == "prismatic":
                moved[:3, 3] = along * value
            else:
                moved[:3, :3] = rodrigues(along, value)
            step = step @ moved
        place = step @ place
        link = joint.find("parent").get("link")  # type: ignore[union-attr, assignment]
    return place


def rodrigues(axis: Array, angle: float) -> Array:
    x, y, z = axis
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.asarray(np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross)


@pytest.mark.parametrize("arm", ARMS, ids=lambda arm: arm.name)
def test_tip_and_inverse_agree_with_the_urdf(arm) -> None:  # type: ignore[no-untyped-def]
    random = np.random.default_rng(7)
    low, high = (np.array([getattr(joint, end) for joint in JOINTS]) for end in ("low", "high"))
    low[2], low[3], high[3] = 0.03, -3.0, 3.0  # not at the remote centre; one turn of the roll
    for joints in random.uniform(0.95 * low, 0.95 * high, (50, 6)):
        pose = arm.tip(joints)
        expected = place_by_urdf(urdf(), f"{arm.name}_tip", dict(zip(arm.joint_names(), joints, strict=True)))
        np.testing.assert_allclose(pose[:3], expected[:3, 3], atol=2e-9)
        np.testing.assert_allclose(np.reshape(rotation_matrix(pose[3:]), (3, 3)), expected[:3, :3], atol=5e-9)
        np.testing.assert_allclose(arm.joints_of(pose), joints, atol=1e-6)


def test_poses_out_of_reach_are_refused_by_name() -> None:
    arm = ARMS[0]
    with pytest.raises(ValueError, match=r"PSM1_insertion: found 1\.\d+, expected 0\.0000 to 0\.2400"):
        arm.joints_of((0.0, 0.0, -1.0, 0.0, 0.0, 0.0, 1.0))
    with pytest.raises(ValueError, match="remote centre of PSM1"):
        arm.joints_of((*arm.offset[:2], arm.offset[2] - 0.0102 * np.cos(0.0), *(0.0,) * 3, 1.0))


class Robot:
    """The robot on manual time."""

    def __init__(self) -> None:
        self.robot, self.now_ns = CrtkRobot(3_000_000_000), START_NS
        self.robot.begin(self.now_ns)

    def tick(self, count: int = 1) -> list[RosSent]:
        sent: list[RosSent] = []
        for _ in range(count):
            sent = list(self.robot.act(self.now_ns))
            self.now_ns += TICK_NS
        return sent

    def send(self, topic: str, message: StringStamped | PoseStamped) -> None:
        list(self.robot.receive(self.now_ns, RosReceived(topic, message.TYPE, message.pack())))


def only(sent: list[RosSent], topic: str, kind: type) -> object:
    (message,) = [one.message for one in sent if one.topic == topic]
    assert isinstance(message, kind)
    return message


def test_an_arm_follows_only_when_it_is_enabled_and_homed() -> None:
    robot = Robot()
    target = PoseStamped(Header(START_NS, WORLD), ARMS[0].tip(np.array([0.1, 0.05, 0.15, 0.2, 0.1, 0.1])))
    robot.send("/PSM1/servo_cp", target)
    sent = robot.tick()
    assert only(sent, "/PSM1/error", String) == String("servo_cp: the arm is DISABLED, homed: False")
    assert only(sent, "/PSM1/setpoint_cp", PoseStamped).header.stamp_ns == 0  # type: ignore[attr-defined]
    for word in ("enable", "home"):
        robot.send("/PSM1/state_command", StringStamped(Header(START_NS), word))
    robot.tick(8)
    robot.send("/PSM1/move_cp", target)
    sent = robot.tick(40)
    assert only(sent, "/PSM1/setpoint_cp", PoseStamped).header.stamp_ns > START_NS  # type: ignore[attr-defined]
    reached = only(sent, "/PSM1/measured_cp", PoseStamped)
    np.testing.assert_allclose(np.array(reached.pose), np.array(target.pose), atol=1e-6)  # type: ignore[attr-defined]
    names = only(sent, "/PSM1/measured_js", JointState).name  # type: ignore[attr-defined]
    assert set(names) <= {joint.get("name") for joint in ET.fromstring(urdf()).findall("joint")}


def test_bridged_poses_agree_with_the_urdf_and_the_bridged_joints() -> None:
    """Nothing but the messages of peers: NDARRAY of joints, TRANSFORM of the tip, and the URDF of the recording."""
    with SessionFile.open(FIXTURE) as file:
        entries = list(file.entries())
    (text,) = [String.unpack(entry.data()).data for entry in entries if entry.channel == "/robot_description"]
    sent = [decode(entry.data()) for entry in entries if entry.kind is Kind.IGTL_OUT]
    for arm in ARMS:
        joints = [one for one in sent if one.device_name == f"{arm.name}/measured_js"]
        tips = {one.ticks: one.content for one in sent if one.device_name == f"{arm.name}/measured_cp"}
        far = 0.0
        for state in joints:
            values = dict(zip(arm.joint_names(), state.content.array[1], strict=True))  # type: ignore[attr-defined]
            expected = place_by_urdf(text, f"{arm.name}_tip", values)
            numbers = np.array(tips[state.ticks].wire_matrix).reshape(4, 3).T  # type: ignore[attr-defined]
            far = max(far, float(np.abs(numbers[:, 3] - expected[:3, 3]).max()))
            np.testing.assert_allclose(numbers[:, :3], expected[:3, :3], atol=5e-7)
        assert len(joints) > 60 and far < 1e-6, far
    published = [entry for entry in entries if entry.kind is Kind.ROS_OUT and entry.channel.startswith("/PSM")]
    assert {entry.channel for entry in published} == {"/PSM1/servo_cp", "/PSM1/state_command"}
    codes = [Note.unpack(entry.data()).code for entry in entries if entry.kind is Kind.NOTE]
    refused = sorted(code for code in codes if code.startswith("command_"))
    assert refused == ["command_not_allowed", "command_old", "command_workspace", "command_workspace"]
