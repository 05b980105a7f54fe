"""``connect`` and ``serve`` with programs that share no code with them: pyigtl, the C++ library, and our bridge.

The scripts in ``examples/peers`` do what pyigtl's own examples do, with each of them.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import Any

import numpy as np
import pytest

import igtl_gateway
from igtl_gateway import Bridge as ScriptBridge
from igtl_gateway import Server
from igtl_gateway.api.peer import BlockingEndpoint
from igtl_gateway.base.errors import Refused
from igtl_gateway.wire.query import StartTracking
from tests.integration.bridge import Bridge, Program, RosClient, environment, free_port
from tests.peers import reference
from tests.peers.pyigtl_peer import PyigtlPeer
from tests.peers.reference import ReferencePeer
from tests.places import ROOT

POSE = np.array([[0.0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]])
PIXELS = np.arange(24, dtype=np.uint8).reshape(1, 4, 6)
POINTS = np.array([[1.0, 2, 3], [4, 5, 6]])

no_library = pytest.mark.skipif(reference.available() is not None, reason=str(reference.available()))
PROGRAMS = [pytest.param(PyigtlPeer, id="pyigtl"), pytest.param(ReferencePeer, id="C++", marks=no_library)]

Partner = PyigtlPeer | ReferencePeer


@contextmanager
def as_server(kind: type[Partner]) -> Iterator[tuple[BlockingEndpoint, Partner]]:
    """The other program is the server."""
    with kind.server() as partner, igtl_gateway.connect(port=partner.port) as peer:
        yield peer, partner


@contextmanager
def as_client(kind: type[Partner]) -> Iterator[tuple[BlockingEndpoint, Partner]]:
    """The other program is the client."""
    with igtl_gateway.serve(0) as server, kind.client("127.0.0.1", server.port) as partner:
        server.wait_connected()
        yield server, partner


Roles = Callable[[type[Partner]], AbstractContextManager[tuple[BlockingEndpoint, Partner]]]


@pytest.mark.parametrize("kind", PROGRAMS)
@pytest.mark.parametrize("roles", [as_server, as_client])
def test_messages_in_both_directions(roles: Roles, kind: type[Partner]) -> None:
    with roles(kind) as (peer, partner):
        peer.send("TRANSFORM", "Tool", POSE, time_ns=1_700_000_000 * 10**9)
        found = partner.receive("TRANSFORM", "Tool")
        assert found["content"]["matrix"] == POSE.tolist()
        assert found["timestamp"]["sec"] == 1_700_000_000
        peer.send("STRING", "Text", "hello")
        assert partner.receive("STRING", "Text")["content"]["string"] == "hello"
        placed = np.diag([2.0, 2.0, 1.0, 1.0])
        peer.send("IMAGE", "Camera", PIXELS, matrix=placed)
        content = partner.receive("IMAGE", "Camera")["content"]
        assert (content["dimensions"], content["scalar_type"]) == ([6, 4, 1], 3)
        assert content["wire_matrix"] == [2, 0, 0, 0, 2, 0, 0, 0, 1, 5, 3, 0]  # the centre of 6 × 4 pixels of 2 mm
        assert content["data_hex"] == PIXELS.tobytes().hex() if kind is PyigtlPeer else True
        peer.send("POINT", "Marks", POINTS)
        assert [row["position"] for row in partner.receive("POINT")["content"]["elements"]] == POINTS.tolist()

        partner.send("TRANSFORM", "Probe", {"matrix": POSE.tolist()}, sec=5)
        message = peer.receive("TRANSFORM", "Probe")
        assert (message.matrix.tolist(), message.source_ns) == (POSE.tolist(), 5 * 10**9)
        partner.send("STRING", "Answer", {"string": "yes"})
        assert peer.receive("STRING").text == "yes"
        image = {"dimensions": [6, 4, 1], "scalar_type": 3, "data": PIXELS.ravel().tolist()}
        partner.send("IMAGE", "Scan", image | {"wire_matrix": content["wire_matrix"]})
        picture = peer.receive("IMAGE", "Scan")
        np.testing.assert_array_equal(picture.array, PIXELS)
        np.testing.assert_allclose(picture.matrix, placed, atol=1e-6)
        point = {"name": "A", "group": "", "rgba": [255] * 4, "position": [1, 2, 3], "diameter": 1.0, "owner": ""}
        partner.send("POINT", "Marks", {"elements": [point]})
        marks = peer.receive("POINT")
        assert (marks.names, marks.positions.tolist()) == (["A"], [[1, 2, 3]])
        assert peer.counts.invalid == 0


@no_library
@pytest.mark.parametrize("roles", [as_server, as_client])
def test_queries_with_the_library(roles: Roles) -> None:
    with roles(ReferencePeer) as (peer, partner):
        assert isinstance(partner, ReferencePeer)
        peer.on_query("TRANSFORM")(lambda query: POSE)
        partner.send("GET_TRANS", "Tool", {})
        assert partner.receive("TRANSFORM", "Tool")["content"]["matrix"] == POSE.tolist()

        seen: list[Any] = []

        @peer.on_query("TDATA", "STT")
        def start(query: Any) -> bool:
            seen.append(query.content)
            return True

        partner.send("STT_TDATA", "", {"resolution": 50, "coordinate_name": "RAS"})
        assert partner.receive("RTS_TDATA")["content"]["status"] == 0
        assert seen == [StartTracking(50, "RAS")]
        peer.send("TDATA", "Tools", {"Probe": POSE})
        (tool,) = partner.receive("TDATA")["content"]["elements"]
        assert (tool["name"], tool["matrix"]) == ("Probe", POSE.tolist())

        # the program answers when its test has seen the query
        answers = {"GET_TRANS": ("TRANSFORM", {"matrix": POSE.tolist()}), "GET_STATUS": ("STATUS", {"code": 1})}
        for name, (type_name, content) in answers.items():
            wait = peer._talk.query(type_name, "Tool", 10, None)
            partner.receive(name, "Tool")
            partner.send(type_name, "Tool", content)
            assert peer._run(wait).type == type_name


def example(name: str, *arguments: str) -> Program:
    script = ROOT / "examples" / "peers" / f"{name}.py"
    return Program([sys.executable, str(script), *arguments], environment())


def lines_of(program: Program) -> list[str]:
    result = program.end(None)
    assert result.code == 0, result.err
    return result.out.splitlines()


@pytest.mark.parametrize("kind", PROGRAMS)
def test_wait_for_a_message(kind: type[Partner]) -> None:
    with kind.server() as partner:
        script = example("wait_for_message", "--port", str(partner.port))
        if isinstance(partner, ReferencePeer):
            partner.wait_connected()
        partner.send("TRANSFORM", "Other", {"matrix": np.eye(4).tolist()})
        partner.send("TRANSFORM", "ToolToReference", {"matrix": POSE.tolist()})
        lines = lines_of(script)
    assert lines[0] == "TRANSFORM ToolToReference"
    assert lines[1].split() == ["[[", "0.", "-1.", "0.", "1.]"]


@pytest.mark.parametrize("kind", PROGRAMS)
def test_a_server_of_tracked_images(kind: type[Partner]) -> None:
    port = free_port()
    script = example("tracked_image_server", "--port", str(port), "--count", "10", "--hz", "100")
    script.wait_until(lambda: bool(script.lines), "start")
    with kind.client("127.0.0.1", port) as partner:
        image = partner.receive("IMAGE", "Image")
        pose = partner.receive("TRANSFORM", "ImageToReference")
        assert partner.receive("STRING", "Text")["content"]["string"].startswith("frame ")
        assert image["timestamp"]["sec"] == pose["timestamp"]["sec"] > 0
        assert image["content"]["dimensions"] == [400, 200, 1]
        partner.send("STRING", "Viewer", {"string": "seen"})
        assert "STRING/Viewer" in lines_of(script)


@pytest.mark.parametrize("kind", PROGRAMS)
def test_points_that_are_changed(kind: type[Partner]) -> None:
    with kind.server() as partner:
        script = example("point_modifier", "--port", str(partner.port), "--count", "1")
        if isinstance(partner, ReferencePeer):
            partner.wait_connected()
        row = {"name": "A", "group": "G", "rgba": [1, 2, 3, 4], "position": [1, 2, 3], "diameter": 1.0, "owner": ""}
        partner.send("POINT", "F", {"elements": [row]})
        (found,) = partner.receive("POINT", "F-modified")["content"]["elements"]
        assert (found["name"], found["position"], found["rgba"]) == ("A", [1, 2, 0], [255, 0, 0, 255])
        lines_of(script)


def test_commands_and_queries_through_our_relay() -> None:
    port = free_port()
    server = example("command_server", "--port", str(port))
    try:
        server.wait_until(lambda: bool(server.lines), "start")
        with ScriptBridge(listen=["127.0.0.1:0"], connect=[f"127.0.0.1:{port}"], relay=True) as bridge:
            lines = lines_of(example("command_client", "--port", str(bridge.addresses[0][1])))
    finally:
        server.close()
    assert lines[:4] == [
        '<Tools><Tool name="Needle" /><Tool name="Probe" /></Tools>',
        "[1.0, -1.0, -1.0, 1.0]",
        "removed",
        "failed: there is no tool 'Probe'",
    ]
    assert lines[4].startswith("refused: ")


def test_images_with_asyncio_through_our_relay() -> None:
    port = free_port()
    server = example("tracked_image_server", "--port", str(port))
    try:
        server.wait_until(lambda: bool(server.lines), "start")
        with ScriptBridge(listen=["127.0.0.1:0"], connect=[f"127.0.0.1:{port}"], relay=True) as bridge:
            lines = lines_of(example("image_viewer_async", "--port", str(bridge.addresses[0][1]), "--count", "3"))
    finally:
        server.close()
    assert sum(line.startswith("Image (1, 200, 400) [0.0, 0.0, 0.0] ") for line in lines) == 3


@pytest.mark.ros
def test_ros_messages_through_our_bridge() -> None:
    """A ROS node publishes, a script queries and receives; the script sends, the node receives; a command fails."""
    string = "std_msgs/msg/String"
    bridge = Bridge()
    try:
        with (
            RosClient(
                "beside", subscribe={"/igtl/in/Words/string": string}, advertise={"/igtl/out/Robot": string}
            ) as ros,
            igtl_gateway.connect(port=bridge.port) as peer,
        ):
            ros.wait_readers("/igtl/out/Robot")
            ros.publish("/igtl/out/Robot", {"data": "ready"})
            assert peer.receive("STRING", "Robot").text == "ready"
            assert peer.query("STRING", "Robot").text == "ready"
            with pytest.raises(Refused):
                peer.query("TRANSFORM", "Robot")
            peer.send("STRING", "Words", "hello", metadata={"by": "script"})
            assert ros.receive("/igtl/in/Words/string")["data"] == "hello"
            reply = peer.command("Home", "", timeout_s=20, metadata={"by": "script"})
            assert (reply.succeeded, reply.reason) == (False, "no reply in time from ROS")
            assert peer.query("CAPABILITY").describe()["types"]
    finally:
        bridge.close()


def test_pyigtl_reads_what_a_server_of_ours_sends_at_a_high_rate() -> None:
    with igtl_gateway.serve(0) as server, PyigtlPeer.client("127.0.0.1", server.port) as partner:
        assert isinstance(server, Server)
        server.wait_connected()
        for number in range(500):
            pose = np.eye(4)
            pose[0, 3] = number
            server.send("TRANSFORM", "Tool", pose)
        found = [partner.receive("TRANSFORM")["content"]["matrix"][0][3] for _ in range(500)]
    assert found == list(range(500))
