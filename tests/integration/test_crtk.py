"""An arm with CRTK topics on a real ROS 2 graph: states go out, commands come in through the guard."""

from __future__ import annotations

import struct
import time
from pathlib import Path

import numpy as np
import pytest

from igtl_gateway.base.stamp import NS_PER_S, ns_to_ticks
from igtl_gateway.cli import main
from igtl_gateway.wire import Message, decode, encode
from igtl_gateway.wire.text import String
from igtl_gateway.wire.transform import Transform
from tests.integration.bridge import Bridge, RawPeer, RosClient

pytestmark = pytest.mark.ros

POSE_TYPE, JOINTS_TYPE, TEXT_TYPE = (
    "geometry_msgs/msg/PoseStamped",
    "sensor_msgs/msg/JointState",
    "crtk_msgs/msg/StringStamped",
)
LIMITS = """[[crtk]]
arms = "/PSM1"
frame_id = "ECM"
max_age_s = 60.0
workspace = [0.0, 0.0, 0.0, 0.2]
max_speed = 0.0
max_turn_speed = 0.0
"""
COMMANDS = {"/PSM1/servo_cp": POSE_TYPE, "/PSM1/state_command": TEXT_TYPE, "/PSM2/servo_cp": POSE_TYPE}
STATES = {"/PSM1/measured_cp": POSE_TYPE, "/PSM1/measured_js": JOINTS_TYPE}


@pytest.mark.slow
def test_one_arm_and_another_that_appears_later(tmp_path: Path) -> None:
    recording = tmp_path / "arm.mcap"
    limits = tmp_path / "limits.toml"  # none depends on how fast this machine is
    limits.write_text(LIMITS, "utf-8")
    allowed = ("--config", str(limits), "--allow-in", "PSM1/servo_cp", "--allow-in", "PSM1/state_command")
    with RosClient("arm", subscribe=COMMANDS, advertise=STATES) as arm:
        bridge = Bridge("--profile", "crtk:/PSM*", *allowed, "--record", str(recording))
        try:
            with RawPeer(bridge.port) as peer:
                bridge.wait_code("link_up", 1)
                arm.wait_readers(*STATES)
                _states(arm, peer)
                _commands(arm, peer, bridge)
                arm.advertise("/PSM3/measured_js", JOINTS_TYPE)
                arm.wait_readers("/PSM3/measured_js")
                arm.publish("/PSM3/measured_js", {"header": {"stamp": _now()}, "name": ["yaw"], "position": [0.5]})
                assert decode(peer.receive("PSM3/measured_js", "NDARRAY").data).device_name == "PSM3/measured_js"
        finally:
            told = bridge.end()
            bridge.close()
    assert (told.code, told.err) == (0, "")
    assert main(("verify", str(recording))) == 0


@pytest.mark.slow
@pytest.mark.parametrize("recorded", [True, False])
def test_an_arm_that_subscribes_late_gets_no_stream_that_has_walked_away(tmp_path: Path, *, recorded: bool) -> None:
    """Nor is anything held for another node, whose subscription never matches."""
    limits, recording = tmp_path / "limits.toml", tmp_path / "arm.mcap"
    limits.write_text('[[crtk]]\narms = "/PSM1"\nmax_age_s = 60.0\nmax_behind_s = 0.0\n', "utf-8")
    how = ("--config", str(limits), "--profile", "crtk:/PSM*", "--allow-in", "PSM1/servo_cp")
    topic = "/PSM1/servo_cp"
    with RosClient("late_arm", advertise={"/PSM1/measured_cp": POSE_TYPE}) as arm, RosClient("looker") as looker:
        looker.subscribe(topic, POSE_TYPE, latched=True)
        bridge = Bridge(*how, *(("--record", str(recording)) if recorded else ()))
        try:
            with RawPeer(bridge.port) as peer:
                bridge.wait_code("link_up", 1)
                arm.wait_readers("/PSM1/measured_cp")
                _measure(arm)
                peer.receive("PSM1/measured_cp", "TRANSFORM")
                for number in range(30):
                    _send(peer, "TRANSFORM", "PSM1/servo_cp", _at(0.002 * number))
                bridge.wait_code("command_unheard")
                arm.subscribe(topic, POSE_TYPE)
                begun = time.monotonic()
                while not arm.waiting(topic) and time.monotonic() < begun + 30:
                    _measure(arm)
                    for x in (0.06, 0.0):  # where the stream would be, and where the arm is
                        _send(peer, "TRANSFORM", "PSM1/servo_cp", _at(x))
                    time.sleep(0.05)
                got = arm.receive(topic)
                assert got["pose"]["position"]["x"] == 0.0
        finally:
            told = bridge.end()
            bridge.close()
        assert looker.waiting(topic) == 0
        xs = {each["pose"]["position"]["x"] for each in arm.received(topic)}
    assert xs <= {0.0}
    assert (told.code, told.err) == (0, "")
    if recorded:
        assert main(("verify", str(recording))) == 0


def _measure(arm: RosClient) -> None:
    place = {"position": {"x": 0.0, "y": 0.0, "z": 0.05}, "orientation": {"w": 1.0}}
    arm.publish("/PSM1/measured_cp", {"header": {"stamp": _now(), "frame_id": "ECM"}, "pose": place})


def _states(arm: RosClient, peer: RawPeer) -> None:
    place = {"position": {"x": 0.1, "y": 0.0, "z": 0.05}, "orientation": {"w": 1.0}}
    arm.publish(
        "/PSM1/measured_js", {"header": {"stamp": _now()}, "name": ["yaw"], "position": [0.25], "effort": [2.0]}
    )
    got = peer.receive("PSM1/measured_js", "NDARRAY")
    np.testing.assert_array_equal(decode(got.data).content.array, [[1], [0.25], [0], [0], [1], [2]])  # type: ignore[attr-defined]
    arm.publish("/PSM1/measured_cp", {"header": {"stamp": {"sec": 0}, "frame_id": "ECM"}, "pose": place})
    arm.publish("/PSM1/measured_cp", {"header": {"stamp": _now(), "frame_id": "ECM"}, "pose": place})
    content = decode(peer.receive("PSM1/measured_cp", "TRANSFORM").data).content
    assert isinstance(content, Transform)
    assert content.wire_matrix[9:] == struct.unpack(">3f", struct.pack(">3f", 0.1, 0.0, 0.05)), "metres"


def _commands(arm: RosClient, peer: RawPeer, bridge: Bridge) -> None:
    _send(peer, "STRING", "PSM1/state_command", String.of("enable"))
    assert arm.receive("/PSM1/state_command")["string"] == "enable"
    _send(peer, "TRANSFORM", "PSM2/servo_cp", _at(0.1))  # not allowed
    bridge.wait_code("command_not_allowed")
    _send(peer, "TRANSFORM", "PSM1/servo_cp", _at(100.0))  # millimetres
    bridge.wait_code("command_workspace")
    _send(peer, "TRANSFORM", "PSM1/servo_cp", _at(0.101))
    got = arm.receive("/PSM1/servo_cp")
    assert got["header"]["frame_id"] == "ECM"
    assert got["pose"]["position"]["x"] == pytest.approx(0.101, abs=1e-8)
    assert arm.waiting("/PSM1/servo_cp") == arm.waiting("/PSM2/servo_cp") == 0


def _at(x: float) -> Transform:
    return Transform((1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, x, 0.0, 0.05))


def _send(peer: RawPeer, igtl_type: str, device: str, content: Transform | String) -> None:
    peer.send(b"".join(map(bytes, encode(Message(igtl_type, device, content, ns_to_ticks(time.time_ns()))))))


def _now() -> dict[str, int]:
    sec, nanosec = divmod(time.time_ns(), NS_PER_S)
    return {"sec": sec, "nanosec": nanosec}
