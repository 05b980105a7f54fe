"""Bad peers at the running bridge: each costs at most its own message or link, and a good one beside them goes on.

One bridge for all, with small limits; after every fault the good peer exchanges a message in both directions.
At the end the recording must name each fault.
"""

from __future__ import annotations

import random
import struct
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from igtl_gateway.replay.mcap_reader import SessionFile
from igtl_gateway.session.entry import Kind
from igtl_gateway.session.note import Note
from tests.integration.bridge import HEADER_SIZE, Bridge, Event, RawPeer, RosClient, header, message, string
from tests.peers import reference
from tests.peers.reference import ReferencePeer

pytestmark = [
    pytest.mark.ros,
    pytest.mark.skipif(reference.available() is not None, reason=str(reference.available())),
]

MAX_CLIENTS = 12
QUEUE_MIB = 4
IMAGES, IMAGE_BYTES = 80, 1 << 20

GOOD_IN, AFTER_IN = "/igtl/in/Good/string", "/igtl/in/After/string"
GOOD_OUT, CAMERA = "/igtl/out/Answer", "/igtl/out/Camera"


@dataclass
class Scene:
    """The bridge with one good peer on each side."""

    bridge: Bridge
    ros: RosClient
    good: ReferencePeer
    stalled: RawPeer
    recording: Path
    rounds: int = 0
    codes: set[str] = field(default_factory=set)

    def good_goes_on(self) -> None:
        """The good ones talk, in both directions."""
        self.rounds += 1
        self.good.send("STRING", "Good", {"string": f"in {self.rounds}"})
        assert self.ros.receive(GOOD_IN) == {"data": f"in {self.rounds}"}
        self.ros.publish(GOOD_OUT, {"data": f"out {self.rounds}"})
        assert self.good.receive("STRING", "Answer")["content"]["string"] == f"out {self.rounds}"

    def hears_after(self, text: str) -> None:
        """The text arrives in ROS; what a failed test left behind is passed over."""
        while self.ros.receive(AFTER_IN) != {"data": text}:
            pass

    def peer(self) -> RawPeer:
        return RawPeer(self.bridge.port)

    def link_of(self, peer: RawPeer) -> list[int]:
        """The number of a peer's link, as events have it."""
        return list(self.link_event("link_up", peer)["links"])

    def link_event(self, code: str, peer: RawPeer) -> Event:
        def wanted(event: Event) -> bool:
            return event.get("code") == code and event["data"].get("peer") == peer.name

        return self.bridge.wait_events(wanted, f"{code} of {peer.name}")[0]

    def fault(self, code: str, peer: RawPeer) -> Event:
        """The note of that code about that peer's link; the final test looks for it in the recording."""
        self.codes.add(code)
        return self.bridge.wait_code(code, links=self.link_of(peer))

    def refused_but_kept(self, data: bytes, code: str) -> None:
        """A message that costs only itself: the next one on the same link arrives."""
        with self.peer() as peer:
            peer.send(data + string(f"after {code}", device="After"))
            self.fault(code, peer)
            self.hears_after(f"after {code}")
        self.good_goes_on()

    def closed(self, data: bytes, code: str) -> None:
        """A stream that cannot be followed any more: its link is closed, no other."""
        with self.peer() as peer:
            peer.send(data)
            assert peer.closed_by_peer()
            self.fault(code, peer)
            self.link_event("link_down", peer)
        self.good_goes_on()


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Scene]:
    recording = tmp_path_factory.mktemp("hostile") / "hostile.mcap"
    strings = dict.fromkeys((GOOD_IN, AFTER_IN), "std_msgs/msg/String")
    with RosClient(
        "beside",
        subscribe=strings,
        advertise={GOOD_OUT: "std_msgs/msg/String", CAMERA: "sensor_msgs/msg/Image"},
    ) as ros:
        limits = ("--max-clients", str(MAX_CLIENTS), "--queue-mib", str(QUEUE_MIB))
        bridge = Bridge("--record", str(recording), *limits)
        try:
            with ReferencePeer.client("127.0.0.1", bridge.port) as good, RawPeer(bridge.port) as stalled:
                # half a header, then silence: it must hold up nobody, all through this module
                stalled.send(string("never whole")[: HEADER_SIZE // 2])
                ros.wait_readers(GOOD_OUT, CAMERA)
                yield Scene(bridge, ros, good, stalled, recording)
        finally:
            bridge.close()


def test_truncated_message(scene: Scene) -> None:
    with scene.peer() as peer:
        peer.send(string("cut off")[:-3])
    assert scene.fault("truncated", peer)["data"]["expected"] == HEADER_SIZE + 4 + len("cut off")
    scene.good_goes_on()


def test_corrupt_checksum(scene: Scene) -> None:
    data = bytearray(string("damaged on its way"))
    data[-1] ^= 1
    scene.refused_but_kept(bytes(data), "bad_crc")


def test_unknown_type(scene: Scene) -> None:
    scene.refused_but_kept(message("MYSTERY", b"\x01\x02\x03"), "no_conversion")


def test_header_version_of_the_future(scene: Scene) -> None:
    scene.refused_but_kept(message("STRING", b"\0\3\0\0", version=7), "malformed")


def test_size_beyond_any_memory(scene: Scene) -> None:
    scene.closed(header("IMAGE", 1 << 62, 0), "too_large")


def test_web_browser(scene: Scene) -> None:
    scene.closed(
        b"GET / HTTP/1.1\r\nHost: 127.0.0.1:18944\r\nUser-Agent: Mozilla/5.0\r\nAccept: */*\r\n\r\n", "too_large"
    )


def test_garbage(scene: Scene) -> None:
    scene.closed(random.Random(7).randbytes(100_000), "too_large")


def image_header(*size: int, scalar: int = 3) -> bytes:
    matrix = (1, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0)
    return struct.pack(">HBBBB3H12f3H3H", 1, 1, scalar, 2, 1, *size, *matrix, 0, 0, 0, *size)


def test_image_without_pixels(scene: Scene) -> None:
    """It may be published empty or be refused; it must cost nothing else."""
    with scene.peer() as peer:
        peer.send(message("IMAGE", image_header(0, 0, 0)) + string("after it", device="After"))
        scene.hears_after("after it")
    scene.good_goes_on()


def test_image_with_fewer_pixels_than_it_says(scene: Scene) -> None:
    scene.refused_but_kept(message("IMAGE", image_header(1000, 1000, 1) + bytes(10)), "malformed")


def polydata(points: int, polygons: tuple[int, int], data: bytes) -> bytes:
    """POLYDATA whose counts are as given, whatever the data is."""
    return struct.pack(">10I", points, 0, 0, 0, 0, *polygons, 0, 0, 0) + data


@pytest.mark.parametrize(
    ("body", "code"),
    [
        (polydata(0xFFFFFFFF, (0, 0), bytes(12)), "truncated"),
        (polydata(1, (0xFFFFFFFF, 0xFFFFFFFC), bytes(12)), "truncated"),
        (polydata(1, (1, 16), bytes(12) + struct.pack(">4I", 0xFFFFFFFF, 0, 0, 0)), "malformed"),
        (polydata(1, (1, 16), bytes(12) + struct.pack(">4I", 3, 0, 1, 2)), "malformed"),
    ],
    ids=["points", "bytes of cells", "points of a cell", "index of a point"],
)
def test_surface_with_lying_counts(scene: Scene, body: bytes, code: str) -> None:
    scene.refused_but_kept(message("POLYDATA", body), code)


def test_metadata_with_lying_sizes(scene: Scene) -> None:
    body = struct.pack(">HHII", 12, 0xFFFF, 0xFFFFFFF0, 1) + bytes(30)
    scene.refused_but_kept(message("STATUS", body, version=2), "malformed")


def test_crowd(scene: Scene) -> None:
    """Forty come: as many as may stay do, the others are sent away, and there is room when some have left."""
    with ExitStack() as stack:
        crowd = {peer.name: peer for peer in (stack.enter_context(scene.peer()) for _ in range(40))}
        scene.codes.add("refused")

        def admitted() -> set[str]:
            ups = (event["data"]["peer"] for event in scene.bridge.events if event.get("code") == "link_up")
            return set(ups) & crowd.keys()

        def refused() -> int:
            counts = [event["data"]["count"] for event in scene.bridge.events if event.get("code") == "refused"]
            return max(counts, default=0)

        scene.bridge.wait_until(lambda: len(admitted()) + refused() == 40, "word about each of the forty")
        assert 0 < len(admitted()) < MAX_CLIENTS
        assert all(peer.closed_by_peer() for name, peer in crowd.items() if name not in admitted())
        scene.good_goes_on()
    for name in admitted():
        scene.link_event("link_down", crowd[name])
    with scene.peer() as peer:
        peer.send(string("there is room again", device="After"))
        scene.hears_after("there is room again")


def test_peer_that_never_reads(scene: Scene) -> None:
    """Its images are dropped, its texts are kept, memory is bounded, and who reads gets everything."""
    fields = {
        "header": {"frame_id": "camera"},
        "width": 1024,
        "height": IMAGE_BYTES // 1024,
        "encoding": "mono8",
        "step": 1024,
        "data": {"hex": random.Random(1).randbytes(IMAGE_BYTES).hex()},
    }
    every = IMAGES // 20
    with RawPeer(scene.bridge.port, receive_buffer=1 << 16) as lazy, scene.peer() as eager:
        scene.link_of(lazy)
        scene.link_of(eager)
        scene.ros.publish(CAMERA, fields)
        picture = eager.receive("Camera")
        before = scene.bridge.resident_bytes()
        for number in range(1, IMAGES):
            scene.ros.again(CAMERA, number)
            assert eager.receive("Camera").body == picture.body
            if number % every == 0:
                scene.ros.publish(GOOD_OUT, {"data": f"text {number}"})
                assert eager.receive("Answer").body.endswith(f"text {number}".encode())
        growth = scene.bridge.resident_bytes() - before
        assert growth < IMAGES * IMAGE_BYTES // 2, growth
        scene.fault("queue_drop", lazy)
        # now it reads: fewer images, all texts
        pictures, texts = 0, []
        while f"text {IMAGES - every}" not in texts:
            wire = lazy.receive()
            assert wire.crc_ok
            if wire.device == "Camera":
                pictures += 1
            else:
                texts.append(wire.body[4:].decode())
        assert texts == [f"text {number}" for number in range(every, IMAGES, every)]
        assert pictures < IMAGES
    for _ in range(len(texts)):  # the good one got them all, too
        scene.good.receive("STRING", "Answer")
    scene.good_goes_on()


def test_half_a_header_is_given_up(scene: Scene) -> None:
    """It was sent before all other tests; the others were served meanwhile."""
    scene.fault("stalled", scene.stalled)
    assert scene.stalled.closed_by_peer()
    scene.good_goes_on()


def test_at_the_end_the_recording_names_every_fault(scene: Scene) -> None:
    told = scene.bridge.end()
    assert (told.code, told.err) == (0, "")
    assert scene.bridge.events[-1]["event"] == "stopped"
    assert scene.bridge.events[-1]["recording"]["dropped"] == 0
    codes = set()
    rounds = 0
    with SessionFile.open(scene.recording) as recording:
        for entry in recording.entries():
            if entry.kind in (Kind.NOTE, Kind.EDGE_NOTE, Kind.LINK):
                codes.add(Note.unpack(entry.data()).code)
            rounds += entry.kind is Kind.ROS_OUT and entry.channel == GOOD_IN
    assert scene.codes <= codes
    assert "internal_error" not in codes
    assert "callback_failed" not in codes
    assert rounds == scene.rounds
