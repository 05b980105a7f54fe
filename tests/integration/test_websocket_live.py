"""A WebSocket peer of a bridge with ROS: natively sent frames stay whole, however slowly it reads while it pings."""

from __future__ import annotations

import random
import struct
from typing import Any

import pytest
from fastcrc import crc64
from websockets.client import ClientProtocol
from websockets.frames import Opcode
from websockets.protocol import OPEN
from websockets.uri import parse_uri

from tests.edges.tcp.websocket.hostile_websockets import frame, request
from tests.integration.bridge import Bridge, RawPeer, RosClient

pytestmark = pytest.mark.ros
POSES, PICTURES = "/igtl/out/Tool", "/igtl/out/Camera"
ROUNDS, EACH, WIDTH, HEIGHT = 6, 20, 640, 480


def place_of(message: bytes) -> int | None:
    """The number of a pose, its first coordinate; None: it is a picture."""
    return round(struct.unpack(">f", message[94:98])[0]) if message[2:11] == b"TRANSFORM" else None


def test_frames_are_whole_behind_a_slow_reader() -> None:
    bridge = Bridge("--queue-mib", "512", "--listen", "ws://127.0.0.1:0")
    types = {POSES: "geometry_msgs/msg/TransformStamped", PICTURES: "sensor_msgs/msg/Image"}
    try:
        (started,) = bridge.wait_events(lambda event: event["event"] == "started", "start")
        port = started["listen"][1]["port"]
        with RosClient("beside", advertise=types) as node, RawPeer(port, 1 << 16) as peer:
            node.wait_readers(POSES, PICTURES)
            peer.send(request())
            answer = b""
            while not answer.endswith(b"\r\n\r\n"):
                answer += peer.socket.recv(1)
            protocol = ClientProtocol(parse_uri("ws://a/"), state=OPEN, max_size=None)
            got: list[bytes] = []
            pongs: list[int] = []
            numbers = iter(range(1_000_000))

            def publish() -> None:
                place = {"translation": {"x": next(numbers) / 1000}, "rotation": {"w": 1.0}}
                node.publish(POSES, {"transform": place})

            def read(least: int) -> None:
                while len(got) < least:
                    protocol.receive_data(peer.socket.recv(1 << 16))
                    events: Any = protocol.events_received()
                    assert protocol.parser_exc is None
                    got.extend(event.data for event in events if event.opcode is Opcode.BINARY)
                    pongs.extend(int(event.data) for event in events if event.opcode is Opcode.PONG)

            picture = {"header": {"frame_id": "camera"}, "width": WIDTH, "height": HEIGHT, "encoding": "mono8"}
            data = random.Random(1).randbytes(WIDTH * HEIGHT)
            node.publish(PICTURES, picture | {"step": WIDTH, "data": {"hex": data.hex()}})
            for _ in range(40):
                publish()
            read(40)
            bridge.wait_code("native_passage", stream=POSES, text=f"{POSES} takes the fast way")
            node.again(PICTURES, 0)
            bridge.wait_code("native_passage", stream=PICTURES, text=f"{PICTURES} takes the fast way")
            for number in range(ROUNDS * EACH):
                node.again(PICTURES, number)
                for _ in range(5):
                    publish()
                peer.send(frame(b"%d" % number, 9))
                if number % EACH == EACH - 1:
                    read(len(got) + 50)
            last = 40 + ROUNDS * EACH * 5 - 1
            while last not in map(place_of, got[-200:]):
                read(len(got) + 1)
        assert all(crc64.ecma_182(one[58:]) == int.from_bytes(one[50:58], "big") for one in got)
        assert [place for place in map(place_of, got) if place is not None] == list(range(last + 1))
        assert pongs == sorted(set(pongs)) and pongs
        assert not [event for event in bridge.events if event.get("code") in ("internal_error", "queue_drop")]
        assert bridge.end().code == 0
    finally:
        bridge.close()
