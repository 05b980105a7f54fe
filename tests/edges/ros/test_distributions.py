"""The ROS edge on an imitation of Humble's rclpy (`humble`), with nodes of the installed ROS 2 in other processes."""

from __future__ import annotations

import struct
import subprocess
import sys
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from igtl_gateway.edges.ros import distributions
from igtl_gateway.edges.ros.distributions import EVENT_MODULES, CountedMatches, Matched, node_options
from tests.edges.ros import humble
from tests.integration.bridge import Bridge, RawPeer, RosClient, environment, gateway, message
from tests.tables import table

HUMBLE = (sys.executable, str(Path(humble.__file__)))
POSE, STAMPED = "geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/TransformStamped"
MESSAGES = 30
#: A rotation of 90° about z.
TURN = (0.0, 1.0, 0.0, -1.0, 0.0, 0.0, 0.0, 0.0, 1.0)


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    return tmp_path / "humble.mcap"


@pytest.fixture
def bridge(recording: Path) -> Iterator[Bridge]:
    bridge = Bridge("--record", str(recording), within=HUMBLE)
    yield bridge
    bridge.close()


def transform(number: int) -> bytes:
    return message("TRANSFORM", struct.pack(">12f", *TURN, number, 2.0, 3.0), device="Needle")


@pytest.mark.ros
def test_a_bridge_on_humble_passes_messages_both_ways(bridge: Bridge, recording: Path) -> None:
    """Its first messages, too; its services answer, and the recording verifies."""
    to_ros, to_igtl = "/igtl/in/Needle/transform", "/igtl/out/Robot"
    with (
        RosClient("other", subscribe={to_ros: STAMPED}, advertise={to_igtl: POSE}) as node,
        RawPeer(bridge.port) as peer,
    ):
        node.wait_readers(to_igtl)
        for number in range(MESSAGES):
            peer.send(transform(number))
            node.publish(to_igtl, {"pose": {"position": {"x": float(number)}, "orientation": {"w": 1.0}}})
        heard = [node.receive(to_ros)["transform"]["translation"] for _ in range(MESSAGES)]
        assert heard == [{"x": number / 1000, "y": 0.002, "z": 0.003} for number in range(MESSAGES)]
        sent = [struct.unpack_from(">12f", peer.receive("Robot").body)[9] for _ in range(MESSAGES)]
        assert sent == [1000.0 * number for number in range(MESSAGES)]
        node.call("/igtl_gateway/get_state", "lifecycle_msgs/srv/GetState", {})
        assert node.receive("/igtl_gateway/get_state")["current_state"]["label"] == "active"
        wanted = {"names": ["max_messages"]}
        node.call("/igtl_gateway/get_parameters", "rcl_interfaces/srv/GetParameters", wanted)
        (value,) = node.receive("/igtl_gateway/get_parameters")["values"]
        assert value["type"] != 0
    result = bridge.end()
    assert (result.code, result.err) == (0, "")
    verified = gateway("verify", str(recording)).end(None)
    assert (verified.code, verified.err) == (0, "")


@pytest.mark.ros
@pytest.mark.slow
def test_the_edge_on_humble() -> None:
    """Some tests of the edge: first messages, QoS, late subscribers, the executor, the end."""
    chosen = "first_message or bytes_arrive or latched or quality or executor or stop_is_final or callback"
    tests = str(Path(__file__).with_name("test_edge.py"))
    command = [*HUMBLE, sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", tests, "-k", chosen]
    run = subprocess.run(command, env=environment(), capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stdout[-6000:]


def test_matches_are_counted_where_no_event_reports_them() -> None:
    counts = iter((0, 2, 2, 1))
    heard: list[Any] = []
    matches = CountedMatches(lambda: next(counts), heard.append)
    with suppress(StopIteration):
        while True:
            matches.poll()
    assert heard == [Matched(2, 2), Matched(1, -1)]


def test_a_node_gets_no_argument_that_it_does_not_have() -> None:
    class Old:
        def __init__(self, node_name: str, *, enable_rosout: bool = True) -> None: ...

    class New:
        def __init__(self, node_name: str, *, enable_logger_service: bool = False) -> None: ...

    assert node_options(SimpleNamespace(node=SimpleNamespace(Node=Old))) == {}
    assert node_options(SimpleNamespace(node=SimpleNamespace(Node=New))) == {"enable_logger_service": True}


@table(
    ("modules", "used"),
    [(("qos_event",), "qos_event"), (EVENT_MODULES, "event_handler"), (("event_handler",), "event_handler")],
)
def test_events_are_those_of_the_module_that_is_there(modules: tuple[str, ...], used: str) -> None:
    """Humble has one name, Jazzy and Kilted have both, Lyrical has the newer one."""
    rclpy = SimpleNamespace(**{name: name for name in modules})
    assert distributions._event_module(rclpy) == used
