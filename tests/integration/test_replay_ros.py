"""``replay --to ros``: a typed rclpy node receives the recorded messages."""

from __future__ import annotations

import hashlib
import json
import socket
from pathlib import Path
from typing import Any

import pytest
from mcap.writer import Writer

from igtl_gateway.convert.rosmsg import String
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.replay.source import first_form_only, select_entries
from tests.integration.bridge import TIMEOUT_S, RosClient, gateway
from tests.places import ROOT

pytestmark = pytest.mark.ros

TYPES = ROOT / "fixtures" / "paper-types.mcap"
HEARD = {
    "/igtl/in/ProbeToTracker/transform": "geometry_msgs/msg/TransformStamped",
    "/igtl/in/Greeting/string": "std_msgs/msg/String",
    "/igtl/in/Colour/image": "sensor_msgs/msg/Image",
    "/igtl/in/Surface/mesh": "shape_msgs/msg/Mesh",
    "/igtl/out/Greeting": "std_msgs/msg/String",
}


def test_a_ros_node_hears_what_was_published_that_day() -> None:
    with RosClient("listener", subscribe=HEARD) as node:
        streams = [word for topic in HEARD for word in ("--streams", topic)]
        options = ("--as-fast-as-possible", "--wait-peers", "1", *streams)
        program = gateway("replay", str(TYPES), "--to", "ros", "--json", *options)
        try:
            pose = node.receive("/igtl/in/ProbeToTracker/transform")
            assert (pose["header"]["frame_id"], pose["child_frame_id"]) == ("Tracker", "Probe")
            assert pose["transform"]["translation"] == {"x": 0.1, "y": -0.2, "z": 0.3005}
            assert node.receive("/igtl/in/Greeting/string")["data"] == "hello from OpenIGTLink"
            assert node.receive("/igtl/in/Greeting/string")["data"] == "Grüße, 你好"
            image = node.receive("/igtl/in/Colour/image")
            assert (image["encoding"], image["width"], image["height"]) == ("rgb8", 8, 6)
            assert image["data"]["hex"] == bytes(range(144)).hex()
            assert len(node.receive("/igtl/in/Surface/mesh")["triangles"]) == 4
            assert node.receive("/igtl/out/Greeting")["data"] == "hello from ROS 2"
            program.wait_until(lambda: '"complete"' in program.said(), "the outcome")
            told = json.loads(next(line for line in program.said().splitlines() if '"complete"' in line))
            assert told["complete"] and told["messages"] == sum(told["streams"].values())
        finally:
            program.close()


START_S = 1_767_225_600  # of the recording
NODE = "/igtl_gateway_replay"
STRING, MESH = "/igtl/in/Greeting/string", "/igtl/in/Surface/mesh"


def test_the_services_of_ros2_bag_play() -> None:
    """Two strings at 0.1 s and 0.2 s, and a latched mesh at 1.0 s."""
    with RosClient("driver", subscribe={STRING: HEARD[STRING], MESH: HEARD[MESH]}) as node:
        node.subscribe("/clock", "rosgraph_msgs/msg/Clock", depth=1)

        def call(name: str, kind: str, **fields: Any) -> dict[str, Any]:
            node.call(f"{NODE}/{name}", f"rosbag2_interfaces/srv/{kind}", fields)
            answer: dict[str, Any] = node.receive(f"{NODE}/{name}")
            return answer

        def clock() -> float:
            now = node.receive("/clock")["clock"]
            return round(float(now["sec"] - START_S + now["nanosec"] / 1e9), 3)

        def wait_clock(second: float) -> None:
            while clock() != second:
                pass

        options = ("--start-paused", "--clock", "20", "--wait-peers", "1", "--streams", STRING, "--streams", MESH)
        program = gateway("replay", str(TYPES), "--to", "ros", "--json", *options)
        try:
            assert call("is_paused", "IsPaused") == {"paused": True}
            assert call("get_rate", "GetRate") == {"rate": 1.0}
            assert node.waiting(STRING) == 0
            assert call("play_next", "PlayNext") == {"success": True}
            assert node.receive(STRING)["data"] == "hello from OpenIGTLink"
            wait_clock(0.1)
            assert call("burst", "Burst", num_messages=1) == {"actually_burst": 1}
            assert node.receive(STRING)["data"] == "Grüße, 你好"
            assert node.waiting(MESH) == 0

            # after the mesh: it is latched, so it is received although the player is paused
            time = {"sec": START_S + 1, "nanosec": 50_000_000}
            assert call("seek", "Seek", time=time) == {"success": True}
            assert len(node.receive(MESH)["triangles"]) == 4
            wait_clock(1.05)
            assert call("seek", "Seek", time={"sec": START_S - 5}) == {"success": False}
            program.wait_until(lambda: '"jump"' in program.said(), "jump")

            assert call("seek", "Seek", time={"sec": START_S}) == {"success": True}
            assert call("set_rate", "SetRate", rate=-1.0) == {"success": False}
            assert call("set_rate", "SetRate", rate=0.001) == {"success": True}
            call("toggle_paused", "TogglePaused")
            assert call("is_paused", "IsPaused") == {"paused": False}
            assert call("play_next", "PlayNext") == {"success": False}
            call("pause", "Pause")
            assert call("is_paused", "IsPaused") == {"paused": True}
            assert call("set_rate", "SetRate", rate=100.0) == {"success": True}
            call("resume", "Resume")
            assert [node.receive(STRING)["data"] for _ in range(2)] == ["hello from OpenIGTLink", "Grüße, 你好"]
            assert len(node.receive(MESH)["triangles"]) == 4
            program.wait_until(lambda: '"complete"' in program.said(), "the outcome")
            jumps = [json.loads(line) for line in program.lines if '"jump"' in line]
            assert [(jump["why"], jump["to_ns"] - START_S * 10**9) for jump in jumps] == [
                ("seek", 1_050_000_000),
                ("seek", 0),
            ]
        finally:
            program.close()


def test_both_sides_at_once_in_the_order_of_the_log() -> None:
    with SessionFile.open(TYPES) as file:
        igtl = list(select_entries(first_form_only(file.entries()), frozenset({Kind.IGTL_OUT})))
        ros = list(select_entries(file.entries(), frozenset({Kind.ROS_IN, Kind.ROS_OUT})))

    def digest(entries: list[Entry]) -> str:
        return hashlib.sha256(b"".join(entry.data() for entry in entries)).hexdigest()

    with (
        socket.create_server(("127.0.0.1", 0)) as server,
        RosClient("listener", subscribe={STRING: HEARD[STRING]}) as node,
    ):
        server.settimeout(TIMEOUT_S)
        target = f"127.0.0.1:{server.getsockname()[1]}"
        program = gateway("replay", str(TYPES), "--to", "both", "--connect", target, "--speed-of-light", "--json")
        try:
            peer, _ = server.accept()
            received = bytearray()
            with peer:
                peer.settimeout(TIMEOUT_S)
                while part := peer.recv(1 << 20):
                    received += part
            assert received == b"".join(entry.data() for entry in igtl)
            assert node.receive(STRING)["data"] == "hello from OpenIGTLink"
            program.wait_until(lambda: '"complete"' in program.said(), "the outcome")
            told = json.loads(next(line for line in program.lines if '"complete"' in line))
            assert told["complete"]
            assert told["sides"]["igtl"]["sha256"] == digest(igtl)
            assert told["sides"]["ros"]["sha256"] == digest(ros)
            assert told["sha256"] == digest(sorted(igtl + ros, key=lambda entry: entry.seq))
        finally:
            program.close()


def test_what_ros_refuses_is_not_counted_as_sent(tmp_path: Path) -> None:
    """Ten messages each of a type that is here, of one that is not, and of a topic that cannot be a name."""
    path = tmp_path / "foreign.mcap"
    data = [f"message {number}" for number in range(10)]
    text = {"std_msgs/msg/String": "string data\n", "lab_msgs/msg/Thing": "string data\n"}
    topics = {"/known": "std_msgs/msg/String", "/unknown": "lab_msgs/msg/Thing", "/not a name": "std_msgs/msg/String"}
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start("ros2")
        channels = {
            topic: writer.register_channel(topic, "cdr", writer.register_schema(kind, "ros2msg", text[kind].encode()))
            for topic, kind in topics.items()
        }
        for second, said in enumerate(data):
            for channel in channels.values():
                writer.add_message(channel, START_S * 10**9 + second, String(said).pack(), second)
        writer.finish()  # type: ignore[no-untyped-call]
    with RosClient("listener", subscribe={"/known": "std_msgs/msg/String"}) as node:
        program = gateway("replay", str(path), "--to", "ros", "--json", "--as-fast-as-possible")
        try:
            assert [node.receive("/known")["data"] for _ in data] == data
            program.wait_until(lambda: '"complete"' in program.said(), "the outcome")
            told = json.loads(next(line for line in program.said().splitlines() if '"complete"' in line))
        finally:
            program.close()
    assert (told["messages"], told["streams"]) == (10, {"/known": 10})
    assert told["sha256"] == hashlib.sha256(b"".join(String(said).pack() for said in data)).hexdigest()
    assert told["account"] == {"recorded": 30, "made": 0, "sent": 10, "not_sent": {"refused": 20}}
    assert [(each["stream"], each["messages"]) for each in told["refused"]] == [("/not a name", 10), ("/unknown", 10)]
    assert "lab_msgs/msg/Thing: unknown type" in told["refused"][1]["reason"]


def test_node_and_topics_are_where_ros_args_put_them() -> None:
    """Relative and absolute names on the left of a rule, the namespace, the services below the name of the node."""
    pose = "/igtl/in/ProbeToTracker/transform"
    heard = {"/said": HEARD[STRING], "/room" + MESH: HEARD[MESH], "/poses": HEARD[pose]}
    clock = "/or1/clock"
    rules = (
        "__node:=player",
        "__ns:=/room",
        "igtl/in/Greeting/string:=/said",
        f"/room{pose}:=/poses",
        f"/clock:={clock}",
    )
    with RosClient("listener", subscribe=heard) as node:
        for name in (STRING, MESH, "/room" + STRING):
            node.subscribe(name, HEARD[MESH if name == MESH else STRING])  # where nothing must be
        node.subscribe(clock, "rosgraph_msgs/msg/Clock", depth=1)
        streams = [word for topic in (STRING, MESH, pose) for word in ("--streams", topic)]
        options = ("--to", "ros", "--json", "--start-paused", "--clock", *streams)
        program = gateway(
            "replay", str(TYPES), *options, "--ros-args", *(word for rule in rules for word in ("-r", rule))
        )
        try:
            service = "/room/player/resume"
            node.call(service, "rosbag2_interfaces/srv/Resume", {})
            node.receive(service)
            assert node.receive("/said")["data"] == "hello from OpenIGTLink"
            assert node.receive("/poses")["child_frame_id"] == "Probe"
            assert len(node.receive("/room" + MESH)["triangles"]) == 4
            assert node.receive(clock)["clock"]["sec"] == START_S
            program.wait_until(lambda: '"complete"' in program.said(), "the outcome")
            told = json.loads(next(line for line in program.lines if '"complete"' in line))
            assert told["streams"].keys() == {STRING, MESH, pose}  # names of the recording
            assert program.end(None).code == 0
            assert [node.waiting(name) for name in (STRING, MESH, "/room" + STRING)] == [0, 0, 0]
        finally:
            program.close()


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["--no-such-flag"], "--ros-args: found --no-such-flag, expected arguments of ROS 2 such as -p, -r"),
        (["-r", "__node:=not a name"], "--ros-args: "),
    ],
)
def test_wrong_arguments_of_ros_are_one_line(arguments: list[str], text: str) -> None:
    program = gateway("replay", str(TYPES), "--to", "ros", "--ros-args", *arguments)
    try:
        result = program.end(None)
    finally:
        program.close()
    assert result.code == 2
    assert text in result.err.splitlines()[-1]
