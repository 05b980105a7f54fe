"""``doctor`` names the cause, in prepared situations with real sockets and a real ROS graph."""

from __future__ import annotations

import http.server
import json
import socket
import ssl
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from igtl_gateway.base.buffers import join
from igtl_gateway.base.clock import SystemClock
from igtl_gateway.base.stamp import ns_to_ticks
from igtl_gateway.cli import main
from igtl_gateway.gateway.log.entry import Kind
from igtl_gateway.gateway.log.ledger import gaps
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.wire import Message, encode
from igtl_gateway.wire.text import String
from igtl_gateway.wire.transform import Transform
from tests.integration.bridge import Bridge
from tests.places import PEMS

HERE = "127.0.0.1"
DEADLINE_S = 20.0
#: How long the doctor waits for a peer, or for a message of a silent peer.
LOOK = ("--seconds", "0.3")
#: Arguments with which it waits for messages until the deadline.
#: Discovery takes a second, and many where other tests share the processor.
DISCOVERY_S = 30.0
AWAIT = ("--seconds", str(DEADLINE_S), "--messages")

Act = Callable[[socket.socket], None]


def pose(name: str = "ProbeToTracker", x: float = 120.0, **other: Any) -> Message:
    matrix = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, x, 80.0 * x / 120.0, -40.0 * x / 120.0)
    ticks = ns_to_ticks(SystemClock().utc_ns())
    return Message("TRANSFORM", name, Transform(matrix), **{"ticks": ticks, "header_version": 1} | other)


def wire(*messages: Message) -> bytes:
    return b"".join(bytes(join(encode(message))) for message in messages)


def says(data: bytes) -> Act:
    """A peer that sends these bytes and stays connected until the doctor disconnects."""

    def act(sock: socket.socket) -> None:
        sock.sendall(data)
        while sock.recv(1 << 16):
            pass

    return act


def tracks(*x: float) -> Act:
    """A peer that sends poses of the moment at which it is connected: a doctor may take long to begin."""

    def act(sock: socket.socket) -> None:
        says(wire(*(pose(x=each) for each in x)))(sock)

    return act


def leaves_at(version: int) -> Act:
    """A peer that goes at the first message of a header version."""

    def act(sock: socket.socket) -> None:
        while head := sock.recv(1 << 16):
            if int.from_bytes(head[:2], "big") == version:
                return

    return act


@contextmanager
def serving(act: Act) -> Iterator[str]:
    """The place of a server that does this with its first connection."""
    with socket.create_server((HERE, 0)) as listener:

        def serve() -> None:
            with listener.accept()[0] as sock:
                sock.settimeout(DEADLINE_S)
                act(sock)

        listener.settimeout(DEADLINE_S)
        thread = threading.Thread(target=serve)
        thread.start()
        yield f"{HERE}:{listener.getsockname()[1]}"
        thread.join()


def free_place() -> str:
    with socket.create_server((HERE, 0)) as sock:
        return f"{HERE}:{sock.getsockname()[1]}"


@contextmanager
def calling(place: str, act: Act) -> Iterator[None]:
    """A client that connects as soon as a server listens, then runs ``act``."""
    stopped = threading.Event()
    host, _, port = place.rpartition(":")

    def call() -> None:
        while not stopped.wait(0.005):
            try:
                sock = socket.create_connection((host, int(port)), DEADLINE_S)
            except OSError:
                continue
            with sock:
                if sock.getsockname() != sock.getpeername():  # a free port can be connected to itself
                    act(sock)
                    return

    thread = threading.Thread(target=call)
    thread.start()
    try:
        yield
    finally:
        stopped.set()
        thread.join()


class Verdict:
    """The output of the doctor."""

    def __init__(self, code: int, told: dict[str, Any]) -> None:
        self.code = code
        self.told = told
        self.cause = told["cause"]["id"] if told["cause"] else ""
        self.text = told["cause"]["text"] if told["cause"] else ""
        self.ids = [finding["id"] for finding in told["findings"]]


@pytest.fixture
def doctor(capsys: pytest.CaptureFixture[str]) -> Callable[..., Verdict]:
    def ask(*arguments: str) -> Verdict:
        code = main(["doctor", *arguments, "--json", *(() if "--seconds" in arguments else LOOK)])
        return Verdict(code, json.loads(capsys.readouterr().out))

    return ask


Doctor = Callable[..., Verdict]


def test_a_healthy_peer(doctor: Doctor, capsys: pytest.CaptureFixture[str]) -> None:
    with serving(tracks(120.0, 130.0)) as place:
        verdict = doctor(place, *AWAIT, "2")
    assert (verdict.code, verdict.ids, verdict.told["nothing_arrives"]) == (0, [], False)
    (stream,) = verdict.told["streams"]
    assert (stream["stream"], stream["messages"], stream["header_versions"]) == ("TRANSFORM/ProbeToTracker", 2, [1])
    (peer,) = verdict.told["peers"]
    assert (peer["peer"], peer["role"], peer["messages"]) == (place, "client", 2)
    with serving(tracks(120.0)) as place:
        assert main(["doctor", place, *AWAIT, "1"]) == 0
    out = capsys.readouterr().out
    assert "TRANSFORM/ProbeToTracker" in out and "no problems found" in out


def test_a_server_with_tls(doctor: Doctor) -> None:
    def shaken(sock: socket.socket) -> None:
        with suppress(OSError):  # who is not trusted is not spoken to
            tracks(120.0)(serves.wrap_socket(sock, server_side=True))

    serves = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    serves.load_cert_chain(PEMS / "server.pem")
    serves.load_verify_locations(PEMS / "ca.pem")
    serves.verify_mode = ssl.CERT_REQUIRED
    own = ("--tls-cert", str(PEMS / "viewer.pem"))
    with serving(shaken) as place:
        verdict = doctor(f"tls://{place}", *own, "--tls-ca", str(PEMS / "ca.pem"), *AWAIT, "1")
    assert (verdict.code, verdict.ids) == (0, [])
    with serving(shaken) as place:
        verdict = doctor(f"tls://{place}", *own, "--tls-ca", str(PEMS / "elsewhere.pem"), "--speak", "0")
    assert (verdict.code, verdict.cause) == (1, "IGTL-E115")
    assert place in verdict.text and "certificate" in verdict.text
    with serving(says(b"no TLS at all, but some text to be read")) as place:
        assert doctor(f"tls://{place}", "--tls-ca", str(PEMS / "ca.pem")).cause == "IGTL-E115"


def test_a_client_with_tls(doctor: Doctor) -> None:
    def shakes(sock: socket.socket) -> None:
        using = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
        using.load_verify_locations(PEMS / "ca.pem")
        tracks(120.0)(using.wrap_socket(sock, server_hostname=HERE))

    place = free_place()
    with calling(place, shakes):
        verdict = doctor("--listen", f"tls://{place}", "--tls-cert", str(PEMS / "server.pem"), *AWAIT, "1")
    assert (verdict.code, verdict.ids) == (0, [])
    with calling(place, tracks(120.0)):  # in the clear
        verdict = doctor("--listen", place, "--tls-cert", str(PEMS / "server.pem"))
    assert verdict.cause == "IGTL-E108" and "plain text" in verdict.text


def test_no_listener(doctor: Doctor) -> None:
    place = free_place()
    verdict = doctor(place)
    assert (verdict.code, verdict.cause, verdict.told["nothing_arrives"]) == (1, "IGTL-E101", True)
    assert place in verdict.text and "refused" in verdict.text


def test_both_are_clients(doctor: Doctor) -> None:
    place = free_place()
    with calling(place, says(b"")):
        assert doctor(place).cause == "IGTL-E102"


def test_both_are_servers(doctor: Doctor) -> None:
    """At another address, or at our own."""
    with serving(says(b"")) as place:
        verdict = doctor("--listen", free_place(), place)
        assert (verdict.cause, place in verdict.text) == ("IGTL-E103", True)
    with serving(tracks(120.0)) as place:
        verdict = doctor("--listen", place)
        assert (verdict.cause, "IGTL-E104" in verdict.ids) == ("IGTL-E103", False)
    with serving(says(b"")) as place:
        verdict = doctor("--listen", place)
        assert verdict.ids == ["IGTL-E104"], "silent: it may be our own gateway"


def test_nobody_connects(doctor: Doctor) -> None:
    place = free_place()
    assert doctor("--listen", place).cause == "IGTL-E105"
    assert doctor("--listen", place, free_place()).cause == "IGTL-E105"


def test_a_client_that_is_silent(doctor: Doctor) -> None:
    place = free_place()
    heard: list[bytes] = []

    def listen(sock: socket.socket) -> None:
        while data := sock.recv(1 << 16):
            heard.append(data)

    with calling(place, listen):
        verdict = doctor("--listen", place)
    assert (verdict.code, verdict.cause, verdict.ids) == (1, "IGTL-E106", ["IGTL-E106"])
    assert heard[0][:8] == b"\0\1STATUS", "it was spoken to"
    with calling(place, listen):
        heard.clear()
        doctor("--listen", place, "--speak", "0")
    assert heard == []


def test_header_versions_that_do_not_fit(doctor: Doctor) -> None:
    data = wire(pose())
    for sent, cause in (
        (b"\0\4" + data[2:], "IGTL-E201"),
        (b"\0\1" + wire(pose(header_version=2))[2:], "IGTL-E202"),
    ):
        with serving(says(sent)) as place:
            verdict = doctor(place, *AWAIT, "1")
        assert (verdict.code, verdict.cause, verdict.told["nothing_arrives"]) == (1, cause, True)


def test_a_peer_that_reads_another_header_version(doctor: Doctor) -> None:
    with serving(leaves_at(2)) as place:
        verdict = doctor(place, "--speak", "2", "--seconds", "0.6")
    assert (verdict.cause, "version 2" in verdict.text) == ("IGTL-E203", True)


@pytest.mark.parametrize(
    ("messages", "cause", "code"),
    [
        ([pose(ticks=0)], "IGTL-W301", 0),
        ([pose("ReferenceFrameToStereoCamera"[:20])], "IGTL-W401", 0),
        ([pose(x=0.12 + number / 100) for number in range(10)], "IGTL-W501", 0),
        ([pose(x=float("nan"))], "IGTL-E503", 1),
    ],
    ids=["stamps zero", "name over 20 bytes", "metres as millimetres", "not a number"],
)
def test_what_a_peer_sends(doctor: Doctor, messages: list[Message], cause: str, code: int) -> None:
    now_ns = SystemClock().utc_ns()
    ticks = [ns_to_ticks(now_ns + number) for number in range(len(messages))]
    fresh = [replace(message, ticks=message.ticks and tick) for message, tick in zip(messages, ticks, strict=True)]
    with serving(says(wire(*fresh))) as place:
        verdict = doctor(place, *AWAIT, str(len(messages)))
    assert (verdict.code, verdict.cause, verdict.ids) == (code, cause, [cause])


def test_crc_off(doctor: Doctor) -> None:
    data = bytearray(wire(pose()))
    for crc, cause in ((bytes(8), "IGTL-E206"), (b"\1" * 8, "IGTL-E207")):
        data[50:58] = crc
        with serving(says(bytes(data))) as place:
            verdict = doctor(place, *AWAIT, "1")
        assert (verdict.code, verdict.cause, verdict.ids) == (1, cause, [cause])
        assert verdict.told["nothing_arrives"]


def test_a_web_server(doctor: Doctor) -> None:
    class Quiet(http.server.BaseHTTPRequestHandler):
        def log_message(self, *_: Any) -> None:
            pass

    with http.server.HTTPServer((HERE, 0), Quiet) as server:
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        verdict = doctor(f"{HERE}:{server.server_port}")
        server.shutdown()
        thread.join()
    assert (verdict.code, verdict.cause, "HTTP" in verdict.text) == (1, "IGTL-E107", True)


@pytest.mark.parametrize(
    ("data", "name"),
    [
        (b"SSH-2.0-OpenSSH_9.2p1 Debian-2+deb12u3\r\n", "SSH"),
        (b"\xb0\0\0\0\x12\0\0\0callerid=/listener" + bytes(80), "ROS 1"),
        (b"GET /chat HTTP/1.1\r\nHost: 127.0.0.1:18944\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n\r\n", "HTTP"),
    ],
    ids=["ssh", "ros 1", "websocket"],
)
def test_another_protocol(doctor: Doctor, data: bytes, name: str) -> None:
    place = free_place()
    with calling(place, says(data)):
        verdict = doctor("--listen", place)
    assert (verdict.code, verdict.cause, verdict.ids) == (1, "IGTL-E107", ["IGTL-E107"])
    assert name in verdict.text


@pytest.mark.ros
def test_qos_that_does_not_fit(doctor: Doctor) -> None:
    from geometry_msgs.msg import TransformStamped
    from rclpy.context import Context
    from rclpy.node import Node
    from rclpy.qos import DurabilityPolicy, QoSProfile
    from std_msgs.msg import String as RosString

    context = Context()
    context.init(args=[])
    node = Node("display", context=context)
    try:
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        topics = {"Probe": (TransformStamped, latched), "Pointer": (RosString, 1), "Tool": (TransformStamped, 1)}
        for device, (kind, qos) in topics.items():
            node.create_subscription(kind, f"/igtl/in/{device}/transform", lambda _: None, qos)
        deadline = time.monotonic() + DISCOVERY_S
        while True:  # a node that DDS has not discovered yet has no QoS to compare
            with serving(says(wire(*map(pose, topics)))) as place:
                verdict = doctor(place, "--ros", *AWAIT, "3")
            if verdict.code or time.monotonic() > deadline:
                break
    finally:
        node.destroy_node()
        context.try_shutdown()
    errors = [finding for finding in verdict.told["findings"] if finding["severity"] == "error"]
    assert verdict.code == 1
    assert [finding["id"] for finding in errors] == ["IGTL-E601"] * 2, "Tool is as it should be"
    told = {finding["where"]: finding["text"] for finding in errors}
    assert "durability" in told["/igtl/in/Probe/transform"] and "/display" in told["/igtl/in/Probe/transform"]
    assert "std_msgs/msg/String expected" in told["/igtl/in/Pointer/transform"]
    assert not verdict.told["nothing_arrives"]


@pytest.mark.ros
def test_the_sources_of_a_configuration_on_a_ros_graph(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Without a peer: topics by name, type and pattern, frames, and a server that does not answer."""
    from rclpy.context import Context
    from rclpy.node import Node
    from rclpy.qos import DurabilityPolicy, QoSProfile
    from sensor_msgs.msg import Image
    from std_msgs.msg import String as RosString
    from tf2_msgs.msg import TFMessage

    path, place = tmp_path / "bridge.toml", free_place()
    path.write_text(
        f'''
        [igtl]
        connect = ["{place}"]
        [[to_igtl]]
        topic = "/camera/imge"
        [[to_igtl]]
        topic = "/words"
        type = "IMAGE"
        [[to_igtl]]
        topic = "/lidar/**"
        [[tf_out]]
        frames = ["tol0"]
        base = "base_link"
        ''',
        "utf-8",
    )
    context = Context()
    context.init(args=[])
    node = Node("robot", context=context)
    try:
        for kind, topic in ((Image, "/camera/image"), (RosString, "/words")):
            node.create_publisher(kind, topic, 1)
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        tree = TFMessage()
        tree.transforms.append(geometry("base_link", "tool0"))
        node.create_publisher(TFMessage, "/tf_static", latched).publish(tree)
        deadline = time.monotonic() + DISCOVERY_S
        while True:  # until DDS has discovered the node
            assert main(["doctor", "--ros", "--config", str(path), "--seconds", "1", "--json"]) == 1
            told = json.loads(capsys.readouterr().out)
            found = {one["where"]: one["text"] for one in told["findings"] if one["id"] == "IGTL-W607"}
            if "'tool0'" in found.get("tol0", "") or time.monotonic() > deadline:
                break
    finally:
        node.destroy_node()
        context.try_shutdown()
    assert found == {
        "/camera/imge": "topic /camera/imge: no publisher; did you mean '/camera/image'? (to_igtl[0])",
        "/words": "topic /words: std_msgs/msg/String has no conversion to IMAGE (to_igtl[1])",
        "/lidar/**": "topic /lidar/**: no publisher (to_igtl[2])",
        "tol0": "frame tol0: not on /tf or /tf_static; did you mean 'tool0'? (tf_out[0])",
        place: f"link {place}: no answer (connect)",
    }


def geometry(parent: str, child: str) -> Any:
    from geometry_msgs.msg import TransformStamped

    made = TransformStamped(child_frame_id=child)
    made.header.frame_id = parent
    return made


def test_usage(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["doctor"]) == 2
    assert "HOST:PORT" in capsys.readouterr().err
    with pytest.raises(SystemExit, match="2"):
        main(["doctor", "127.0.0.1:1", "--seconds", "0"])
    assert main(["doctor", "--listen", "0.0.0.0:0"]) == 2, "open to other hosts, and no peer is allowed"
    assert main(["doctor", "tcp://127.0.0.1:1", "--tls-ca", "ca.pem"]) == 2, "files for no address"


def test_a_text_for_people(capsys: pytest.CaptureFixture[str]) -> None:
    message = Message("STRING", "x" * 20, String.of("a"))
    with serving(says(wire(message))) as place:
        assert main(["doctor", place, *AWAIT, "1"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith(f"  {place}: server; 1 message, header version 1")
    assert any(line.startswith("WARNING IGTL-W401") for line in lines)
    assert lines[-1].startswith("most important finding: ")


def test_a_bridge_is_recognised_and_not_disturbed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with closing(Bridge("--no-ros", "--record", str(tmp_path / "session.mcap"))) as bridge:
        assert main(["doctor", f"{HERE}:{bridge.port}", "--seconds", "2", "--json"]) == 0
        assert bridge.end().code == 0
    told = json.loads(capsys.readouterr().out)
    assert [finding["id"] for finding in told["findings"]] == ["IGTL-I117"]
    with SessionFile.open(tmp_path / "session.mcap") as file:
        kinds = [(entry.kind, entry.channel) for entry in file.entries() if entry.channel]
        ledger = file.ledger
    assert ledger and ledger["streams"]["igtl_in"]["STATUS/igtl_doctor"]["probed"] > 0 and gaps(ledger) == []
    assert (Kind.IGTL_IN, "STATUS/igtl_doctor") in kinds  # recorded, as every message
    assert not any(kind is Kind.ROS_OUT and "doctor" in channel for kind, channel in kinds)
    assert main(["verify", str(tmp_path / "session.mcap")]) == 0
    capsys.readouterr()
    assert main(["doctor", str(tmp_path / "session.mcap"), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)["findings"]
    assert not any("doctor" in finding["where"] for finding in found)
