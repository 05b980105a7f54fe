"""``bridge … --ros-args``: parameters, namespace, remapping and log level as for every node, and what is recorded."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from igtl_gateway.cli import main
from igtl_gateway.gateway.log.entry import Kind
from igtl_gateway.native.passage import is_compiled
from igtl_gateway.record.sessionfile.reader import SessionFile
from tests.integration.bridge import Bridge, RawPeer, RosClient, string

pytestmark = pytest.mark.ros

POSE, TEXT, LOG = "geometry_msgs/msg/TransformStamped", "std_msgs/msg/String", "rcl_interfaces/msg/Log"
SET = "/or1/gw/set_parameters"
FILE = """
/**:
  ros__parameters:
    to_igtl: ["/camera/pose=Camera"]
    custom_data: ["operator=Kim"]
"""
RULES = ("/camera/pose:=/microscope/pose", "igtl/in/Raw/string:=/said", "__ns:=/or1", "__node:=gw")
NUMBER = 40


@pytest.mark.slow
def test_a_bridge_is_a_node_like_any_other(tmp_path: Path) -> None:
    path, file = tmp_path / "out.mcap", tmp_path / "gw.yaml"
    file.write_text(FILE)
    rules = [word for rule in RULES for word in ("-r", rule)]
    poses = ("/microscope/pose", "/or1/igtl/out/Tool", "/igtl/out/Stray")
    bridge = Bridge(
        *("--record", str(path), "--ros-args", "--params-file", str(file), "--log-level", "warn", *rules),
    )
    try:
        with (
            RosClient("room", subscribe={"/said": TEXT}, advertise=dict.fromkeys(poses, POSE)) as room,
            RawPeer(bridge.port) as peer,
        ):
            room.subscribe("/rosout", LOG, latched=True)
            room.wait_readers(*poses[:2])
            bridge.wait_code("link_up")
            peer.send(string("hello"))
            assert room.receive("/said")["data"] == "hello"
            for number in range(NUMBER):  # in Python at first, natively then
                for topic in poses:
                    pose = {"transform": {"translation": {"x": number}, "rotation": {"w": 1.0}}}
                    room.publish(topic, {"header": {"frame_id": "room"}, **pose})
                assert {peer.receive(type_name="TRANSFORM").device for _ in poses[:2]} == {"Tool", "Camera"}
            value = {"type": 9, "string_array_value": ["STRING"]}
            room.call(SET, "rcl_interfaces/srv/SetParameters", {"parameters": [{"name": "deny_in", "value": value}]})
            assert room.receive(SET)["results"] == [{"successful": True, "reason": ""}]
            peer.send(string("refused"))
            denied = bridge.wait_code("denied")

            def is_denied(line: dict[str, Any]) -> bool:
                return bool(line["msg"].startswith(denied["text"]))

            room.wait_until(lambda: any(map(is_denied, room.received("/rosout"))), "line of the log")
            lines = room.received("/rosout")
            # the log level hides messages below WARN
            assert {(line["level"], line["name"]) for line in lines} == {(30, "or1.gw")}
        assert bridge.end().code == 0
        assert bool(bridge.events[-1].get("native_times")) is is_compiled()
    finally:
        bridge.close()
    with SessionFile.open(path) as session:
        entries = [(entry.kind, entry.channel) for entry in session.entries()]
        assert session.session["custom_data"] == '{"operator": "Kim"}'
    received = [channel for kind, channel in entries if kind is Kind.ROS_IN]
    assert sorted(received) == ["/camera/pose"] * NUMBER + ["/igtl/out/Tool"] * NUMBER
    assert (Kind.ROS_OUT, "/igtl/in/Raw/string") in entries  # the names of the configuration, so that it verifies
    assert main(["verify", str(path)]) == 0
