"""How long messages need between ROS and a headset-like client: Chromium over WebSocket, beside an equal TCP client.

    python -m tools.evidence.websocket_latency --rounds 6 --seconds 10

Strategy: a node of rclpy in this process sends poses at 60 Hz and VP9 frames of a given size at 30 Hz to a bridge, and
receives the same from the client.  Each message has its stamp of sending, and each side measures its age at arrival;
both clocks are those of this machine.  Rounds with the one client and with the other alternate, in sessions of their
own.  ``websocket`` is the TCP client over WebSocket, so that what the browser costs is seen.  ``proxied`` is the same
page as ``browser`` at a proxy, which has a TCP connection for it: how a browser comes to a port of TCP otherwise.
Prints p50, p99 (ms), and the ratio of the medians to those of TCP, and to those of the proxy.
"""

from __future__ import annotations

import argparse
import json
import os
import socket
import statistics
import subprocess
import sys
import threading
import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from igtl_gateway.addon.igtl import Message, Transform, decode, encode, ns_to_ticks
from igtl_gateway.wire.framer import Framer
from igtl_gateway.wire.video import Video
from tests.addons.page.browser import Browser, site
from tests.edges.tcp.websocket.hostile_websockets import frame, request
from tests.integration.bridge import Bridge, RawPeer, environment

ROOT = Path(__file__).parents[2]
PAGE = Path(__file__).with_suffix(".html")
HZ, NS = 60, 10**9
CLIENTS = ("tcp", "websocket", "browser", "proxied")
#: The beginning of a key frame of VP9, 320 × 240.
_KEY = bytes.fromhex("824983420013f00ef6")
KINDS = ("pose to peer", "frame to peer", "pose to ROS", "frame to ROS")


def age_ms(ticks: int) -> float:
    return (time.time_ns() - (ticks >> 32) * NS - ((ticks & 0xFFFFFFFF) * NS >> 32)) / 1e6


class Node:
    """The ROS side: publishes at its pace, and measures what comes."""

    def __init__(self, size: int) -> None:
        import rclpy
        from geometry_msgs.msg import TransformStamped
        from rclpy.qos import QoSProfile
        from sensor_msgs.msg import CompressedImage

        os.environ |= environment()  # the graph of the bridge
        rclpy.init()
        self.ages: dict[str, list[float]] = defaultdict(list)
        self._node = node = rclpy.create_node("latency")
        qos = QoSProfile(depth=300)
        self._pose, self._frame = TransformStamped(), CompressedImage(format="vp9", data=_KEY + os.urandom(size))
        self._pose.transform.rotation.w = 1.0
        self._poses = node.create_publisher(TransformStamped, "/igtl/out/Tool", qos)
        self._frames = node.create_publisher(CompressedImage, "/igtl/out/Scene", qos)
        for kind, topic, type_ in (
            ("pose to ROS", "/igtl/in/Headset/transform", TransformStamped),
            ("frame to ROS", "/igtl/in/Eye/compressed_image", CompressedImage),
        ):
            node.create_subscription(type_, topic, lambda each, kind=kind: self._take(kind, each), qos)
        threading.Thread(target=rclpy.spin, args=(node,), daemon=True).start()

    def _take(self, kind: str, message: Any) -> None:
        stamp = message.header.stamp
        self.ages[kind].append((time.time_ns() - stamp.sec * NS - stamp.nanosec) / 1e6)

    def play(self, seconds: float) -> None:
        """Publish poses at 60 Hz, and a frame with each second one."""
        begun = time.monotonic()
        for number in range(round(seconds * HZ)):
            time.sleep(max(0.0, begun + number / HZ - time.monotonic()))
            for message, publisher in ((self._pose, self._poses), (self._frame, self._frames))[: 2 - number % 2]:
                message.header.stamp.sec, message.header.stamp.nanosec = divmod(time.time_ns(), NS)
                publisher.publish(message)


def client(port: int, seconds: float, size: int, *, websocket: bool) -> None:
    """Be the client; print its ages as JSON.  In a process of its own."""
    peer = RawPeer(port)
    peer.socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    if websocket:
        peer.send(request())
        while not peer.socket.recv(1 << 16).endswith(b"\r\n\r\n"):
            pass
    ages: dict[str, list[float]] = defaultdict(list)
    video = Video("VP90", (320, 240, 1), _KEY + os.urandom(size))
    body = Transform((1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 1.0, 2.0, 3.0))

    def send() -> None:
        begun = time.monotonic()
        for number in range(round(seconds * HZ)):
            time.sleep(max(0.0, begun + number / HZ - time.monotonic()))
            for device, content in (("Headset", body), ("Eye", video))[: 2 - number % 2]:
                kind = "TRANSFORM" if device == "Headset" else "VIDEO"
                parts = encode(Message(kind, device, content, ns_to_ticks(time.time_ns())))
                data = b"".join(map(bytes, parts))
                peer.send(frame(data) if websocket else data)

    thread = threading.Thread(target=send)
    thread.start()
    rest = b""
    peer.socket.settimeout(1.0)
    try:
        while data := peer.socket.recv(1 << 16):
            rest += data
            rest = take(rest, ages, websocket=websocket)
    except TimeoutError:
        pass
    thread.join()
    print(json.dumps(ages))


def take(data: bytes, ages: dict[str, list[float]], *, websocket: bool) -> bytes:
    """Measure whole messages; return what is left."""
    while len(data) >= 10:
        at = 0
        if websocket:
            at = 2 if data[1] < 126 else 4 if data[1] == 126 else 10
            size = data[1] if data[1] < 126 else int.from_bytes(data[2:at], "big")
        else:
            if len(data) < 58:
                break
            size = 58 + int.from_bytes(data[42:50], "big")
        if len(data) < at + size:
            break
        message = decode(data[at : at + size])
        if message.device_name in ("Tool", "Scene"):
            ages["pose to peer" if message.device_name == "Tool" else "frame to peer"].append(age_ms(message.ticks))
        data = data[at + size :]
    return data


def proxy(port: int) -> None:
    """Serve WebSocket, with a TCP connection to a port for each client; print our port.  In a process of its own."""
    from websockets.sync.server import ServerConnection, serve

    def handle(page: ServerConnection) -> None:
        peer = socket.create_connection(("127.0.0.1", port))
        peer.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

        def pass_on() -> None:
            framer = Framer()
            while count := peer.recv_into(framer.buffer()):
                for each in framer.received(count):
                    page.send(each)

        threading.Thread(target=pass_on, daemon=True).start()
        for each in page:
            assert isinstance(each, bytes)
            peer.sendall(each)

    with serve(handle, "127.0.0.1", 0, compression=None, max_size=None) as server:
        print(server.socket.getsockname()[1], flush=True)
        server.serve_forever()


@contextmanager
def bridge() -> Iterator[dict[str, int]]:
    """A bridge; the port for each client."""
    made = Bridge("--listen", "ws://127.0.0.1:0")
    try:
        (started,) = made.wait_events(lambda event: event["event"] == "started", "start")
        tcp, websocket = (each["port"] for each in started["listen"])
        yield {"tcp": tcp, "browser": websocket, "websocket": websocket, "proxied": tcp}
    finally:
        made.close()


def play(node: Node, name: str, seconds: float, size: int) -> dict[str, list[float]]:
    """One round with a client; the ages by kind."""
    node.ages.clear()
    with ExitStack() as stack:
        port = stack.enter_context(bridge())[name]
        time.sleep(2)  # until DDS has found all
        if name == "proxied":
            words = [sys.executable, "-m", "tools.evidence.websocket_latency", "--client", name, "--port", str(port)]
            proxy = stack.enter_context(subprocess.Popen(words, stdout=subprocess.PIPE, text=True, cwd=ROOT))
            stack.callback(proxy.kill)
            assert proxy.stdout
            port = int(proxy.stdout.readline())
        if name in ("browser", "proxied"):
            files = {PAGE.name: PAGE, "openigtlink.mjs": ROOT / "examples" / "peers" / "openigtlink.mjs"}
            place = stack.enter_context(site(files))
            browser = stack.enter_context(Browser())
            browser.open(f"http://localhost:{place}/?port={port}&seconds={seconds}&size={size}")
            browser.wait("state.connected")
            node.play(seconds)
            browser.wait("state.done")
            assert browser.run("crossOriginIsolated") and not browser.complaints, browser.complaints
            theirs = browser.run("state.ages")
        else:
            words = [sys.executable, "-m", "tools.evidence.websocket_latency", "--client", name]
            words += ["--port", str(port), "--seconds", str(seconds), "--size", str(size)]
            process = subprocess.Popen(words, stdout=subprocess.PIPE, text=True, cwd=ROOT)
            time.sleep(1)
            node.play(seconds)
            theirs = json.loads(process.communicate()[0])
        return {**node.ages, **theirs}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=6)
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--size", type=int, default=30_000, help="bytes of a frame")
    parser.add_argument("--client", choices=CLIENTS)
    parser.add_argument("--port", type=int)
    options = parser.parse_args()
    if options.client == "proxied":
        proxy(options.port)
    elif options.client:
        client(options.port, options.seconds, options.size, websocket=options.client == "websocket")
    if options.client:
        return 0
    node = Node(options.size)
    found: dict[str, dict[str, list[float]]] = {name: defaultdict(list) for name in CLIENTS}
    for number in range(options.rounds):
        for name in CLIENTS[:: 1 - 2 * (number % 2)]:
            for kind, ages in play(node, name, options.seconds, options.size).items():
                found[name][kind] += ages[HZ:]  # the first second compiles the streams
    for kind in KINDS:
        cells = [kind]
        middle = {name: statistics.median(found[name][kind]) for name in CLIENTS}
        for name in CLIENTS:
            ages = sorted(found[name][kind])
            cells.append(f"{middle[name]:.2f}, {ages[len(ages) * 99 // 100]:.2f} ({len(ages)})")
        cells += [f"{middle[name] / middle['tcp']:.2f}" for name in CLIENTS[1:3]]
        cells.append(f"{middle['browser'] / middle['proxied']:.2f}")
        print(" | ".join(cells), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
