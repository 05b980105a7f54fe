"""The native passage: the same entries, counts and bytes as Python, and nothing lost at its borders."""

from __future__ import annotations

import hashlib
import math
import os
import random
import socket
import struct
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from igtl_gateway.app import ros_traffic as app
from igtl_gateway.app.bridge import Bridge
from igtl_gateway.app.bridge_options import BridgeOptions
from igtl_gateway.base.buffers import join
from igtl_gateway.base.clock import SystemClock
from igtl_gateway.base.stamp import NS_PER_MS, NS_PER_S, ns_to_ticks
from igtl_gateway.config.configuration import Config, ToIgtlRow, ToRosRow
from igtl_gateway.convert import rosmsg
from igtl_gateway.convert.arms import ArmsRow
from igtl_gateway.convert.common_msgs import JointState, PoseArray, PoseStamped
from igtl_gateway.convert.igtl_msgs import TrackedTool, TrackingData
from igtl_gateway.convert.rosmsg import Header, TransformStamped
from igtl_gateway.edges.ros.receiver import NativeReceiver
from igtl_gateway.edges.tcp import PeerLimits
from igtl_gateway.edges.tcp.native_reader import NativeReader
from igtl_gateway.edges.tcp.sender import Sender
from igtl_gateway.gateway import Session, guarded_stream, make_core
from igtl_gateway.gateway.fastpath import passage_streams
from igtl_gateway.gateway.fastpath.compiled_to_igtl import CompiledToIgtl
from igtl_gateway.gateway.live_settings import LiveSettings
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.note import Note
from igtl_gateway.native.passage import Subscription, is_compiled
from igtl_gateway.record.options import RecordOptions
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.replay.verify import DeclaredLosses, verify
from igtl_gateway.wire import Message, encode
from igtl_gateway.wire.framer import Framer
from igtl_gateway.wire.header import HEADER_SIZE, crc64
from igtl_gateway.wire.image import Image
from igtl_gateway.wire.point import Points
from igtl_gateway.wire.polydata import PolyData
from igtl_gateway.wire.query import EmptyQuery
from igtl_gateway.wire.text import Status
from igtl_gateway.wire.text import String as StringBody
from igtl_gateway.wire.tracking import QuaternionTrackingData as QuaternionTracked
from igtl_gateway.wire.tracking import TrackingData as Tracked
from igtl_gateway.wire.transform import Position, Transform
from tests.gateway.fastpath.test_cache import (
    MISSING,
    SLICER,
    fields,
    igtl_bulk,
    igtl_messages,
    igtl_tools,
    ros_bulk,
    ros_joints,
    ros_messages,
    ros_tools,
    tracked,
)
from tests.native.middleware import Middleware, RosEdge
from tests.timing import WAIT_S

pytestmark = pytest.mark.skipif(not is_compiled(), reason="the package was installed without its native passage")

EPISODE_NS = NS_PER_S
TOPIC, POSES = "/igtl/out/tool", "/igtl/out/pose"
HERE = ("127.0.0.1", 0)


class Peer:
    """An OpenIGTLink client that keeps all that it receives."""

    def __init__(self, address: tuple[str, int]) -> None:
        self.socket = socket.create_connection(address)
        self.received: list[bytes] = []
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()

    def send(self, data: bytes) -> None:
        self.socket.sendall(data)

    def close(self) -> None:
        with suppress(OSError):  # the bridge has closed it
            self.socket.shutdown(socket.SHUT_RDWR)
        self._thread.join(WAIT_S)
        self.socket.close()

    def _read(self) -> None:
        framer = Framer()
        while data := self._some():
            self.received += [bytes(message) for message in framer.feed(data)]

    def _some(self) -> bytes:
        try:
            return self.socket.recv(1 << 16)
        except OSError:
            return b""


class Scene:
    """A bridge on the ROS edge of ``middleware``, with one peer or more."""

    def __init__(self, bridge: Bridge, middleware: Middleware) -> None:
        self.bridge = bridge
        self.middleware = middleware
        self.peers: list[Peer] = []

    @property
    def ros(self) -> RosEdge:
        ros: Any = self.bridge.ros
        return ros

    @property
    def native(self) -> int:
        """Number of streams that pass natively."""
        assert self.bridge._passage
        return self.bridge._passage.streams.count

    def connect(self) -> Peer:
        peer = Peer(self.bridge.addresses[0])
        self.peers.append(peer)
        wait_for(lambda: len([one for one in self.bridge.tcp.links() if one.connected]) == len(self.peers))
        return peer

    def disconnect(self, peer: Peer) -> None:
        self.peers.remove(peer)
        peer.close()
        wait_for(lambda: len([one for one in self.bridge.tcp.links() if one.connected]) == len(self.peers))

    def send_ros(self, message: Any, topic: str = TOPIC, source_ns: int = 0, lost: int = 0) -> None:
        self.ros.deliver(topic, message.TYPE, message.pack(), source_ns, lost=lost)

    def received(self, kind: str) -> int:
        """Number of messages of a direction that the gateway has received."""
        return sum(fates["received"] for fates in self.bridge.ledger()["streams"].get(kind, {}).values())


def wait_for(condition: Any) -> None:
    until = time.monotonic() + WAIT_S
    while not condition():
        assert time.monotonic() < until, "it took too long"
        time.sleep(0.002)


@contextmanager
def scene(
    monkeypatch: pytest.MonkeyPatch,
    config: Config | None = None,
    path: Path | None = None,
    **options: Any,
) -> Iterator[Scene]:
    """A bridge whose ROS is in memory; in the end every message has to be accounted for."""
    middleware = Middleware()
    monkeypatch.setattr(app, "RosEdge", lambda **arguments: RosEdge(middleware, **arguments))
    how = BridgeOptions((HERE,), record=path, recording=RecordOptions(overwrite=True), **options)
    bridge = Bridge(config or Config().watched(), how, SystemClock())
    bridge.start()
    made = Scene(bridge, middleware)
    try:
        yield made
    finally:
        bridge.stop()
        for peer in made.peers:
            peer.close()
    assert not made.ros.errors
    assert bridge.losses["gaps"] == []


def test_what_a_closed_link_took_no_more_counts_without_a_further_message() -> None:
    """A large message is counted first, and given to the links then: what one ignores may be all that is new."""
    ignored: list[tuple[str, int]] = []
    streams = object.__new__(passage_streams.PassageStreams)
    streams._edges = SimpleNamespace(ignore=lambda stream, number: ignored.append((stream, number)))
    compiled = object.__new__(CompiledToIgtl)
    compiled.outputs = ((SimpleNamespace(channel="POLYDATA/cloud"), 1, {}),)  # type: ignore[assignment]
    native = SimpleNamespace(collect=lambda: (0, 0, 0, (0,), (1,), None))
    streams._collect(passage_streams._Copy(compiled, native, "/cloud", ""))  # type: ignore[arg-type]
    assert ignored == [("POLYDATA/cloud", 1)]


def test_a_removed_stream_is_collected_until_its_last_message_has_been_given_to_all_links() -> None:
    """However often that is: each message that passes in full collects."""
    ignored: list[tuple[str, int]] = []
    uses, counts = [True] * 40 + [False], [0] * 40 + [1]  # the last link ignores it just before the end

    class Native:
        is_in_use = property(lambda _: uses.pop(0))

        def collect(self) -> tuple[Any, ...]:
            return 0, 0, 0, (0,), (counts.pop(0),), None

    compiled = object.__new__(CompiledToIgtl)
    compiled.outputs = ((SimpleNamespace(channel="POLYDATA/cloud"), 1, {}),)  # type: ignore[assignment]
    streams = object.__new__(passage_streams.PassageStreams)
    streams._edges = SimpleNamespace(ignore=lambda stream, number: ignored.append((stream, number)))
    streams._removed = [passage_streams._Copy(compiled, Native(), "/cloud", "")]  # type: ignore[arg-type]
    for _ in range(50):
        streams.collect_removed()
    assert ignored[-1] == ("POLYDATA/cloud", 1)
    assert not streams._removed
    assert not counts


def transform(number: float, stamp_ns: int | None = None, device: str = "ToolToBase", version: int = 1) -> bytes:
    stamp_ns = time.time_ns() if stamp_ns is None else stamp_ns
    content = Transform((1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 10.0 + number, 2.0, 3.0))
    return join(encode(Message("TRANSFORM", device, content, ns_to_ticks(stamp_ns), version)))


def pose(number: float, stamp_ns: int | None = None, frame: str = "base") -> TransformStamped:
    stamp_ns = time.time_ns() if stamp_ns is None else stamp_ns
    return TransformStamped(Header(stamp_ns, frame), "tool", (0.01 + number * 1e-5, 0.2, 0.3), (0.0, 0.0, 0.0, 1.0))


def entries_of(path: Path) -> list[Entry]:
    with SessionFile.open(path) as session:
        return list(session.entries())


def check_recording(path: Path, config: Config, ledger: dict[str, Any]) -> Counter[Kind]:
    """Check that the full path gives the recorded outputs and the ledger; returns the entries of each kind."""
    entries = entries_of(path)
    report = verify(entries, config, DeclaredLosses())
    assert report.good, report.firsts
    core = make_core(config, fast_path=False)
    session = Session(core)
    for entry in entries:
        if entry.kind.is_input:
            session.recorded(entry)
    assert core.ledger.to_dict() == ledger["streams"]
    return Counter(entry.kind for entry in entries)


# -- what passes ------------------------------------------------------------------------------------------------------


def test_a_stream_becomes_native_soon_after_its_publisher_can(monkeypatch: pytest.MonkeyPatch) -> None:
    """A publisher holds its first messages until discovery ends; the stream must not wait for as long again."""
    with scene(monkeypatch) as here:
        peer = here.connect()
        native_publisher = here.ros.native_publisher
        here.ros.native_publisher = lambda *_: None  # type: ignore[method-assign]
        for number in range(100):
            peer.send(transform(number))
            wait_for(lambda number=number: here.received("igtl_in") > number)
        assert here.native == 0
        here.ros.native_publisher = native_publisher  # type: ignore[method-assign]
        for number in range(100, 118):
            peer.send(transform(number))
            wait_for(lambda number=number: here.received("igtl_in") > number)
        assert here.native == 1


def test_a_slow_stream_becomes_native_without_its_next_message(monkeypatch: pytest.MonkeyPatch) -> None:
    """The publisher of /tf waits three seconds for subscribers: messages before that must not decide for later."""
    with scene(monkeypatch) as here:
        peer = here.connect()
        native_publisher = here.ros.native_publisher
        here.ros.native_publisher = lambda *_: None  # type: ignore[method-assign]
        for number in range(20):
            peer.send(transform(number))
            wait_for(lambda number=number: here.received("igtl_in") > number)
        assert here.native == 0
        here.ros.native_publisher = native_publisher  # type: ignore[method-assign]
        wait_for(lambda: here.native == 1)
        wait_for(lambda: here.bridge._reports)
        assert [event.note.text for event in here.bridge.take_reports()] == ["TRANSFORM/ToolToBase takes the fast way"]
        peer.send(transform(20))
        wait_for(lambda: here.received("igtl_in") == 21)
        link = here.bridge.tcp.native_link(1)
        assert link and link.is_native


@pytest.mark.parametrize(
    ("what", "why"),
    [
        ("publisher", "/igtl/in/ToolToBase/transform waits for subscribers, or is subscribed to as well"),
        ("link", "Python has the connection, as with TLS"),
        ("number", "the recorder has no more streams"),
    ],
)
def test_a_stream_in_python_has_its_cause(monkeypatch: pytest.MonkeyPatch, what: str, why: str) -> None:
    with scene(monkeypatch) as here:
        passage = here.bridge._passage
        assert passage
        owner, name = {
            "publisher": (here.ros, "native_publisher"),
            "link": (here.bridge.tcp, "native_link"),
            "number": (passage.streams, "_number_of"),
        }[what]
        monkeypatch.setattr(owner, name, lambda *_: None)
        peer = here.connect()
        for number in range(20):
            peer.send(transform(number))
            wait_for(lambda number=number: here.received("igtl_in") > number)
        with passage._passage:
            assert passage.streams.states() == {("igtl_in", "TRANSFORM/ToolToBase"): why}


def test_poses_to_ros_pass_natively(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    path = tmp_path / "session.mcap"
    sent = [transform(number) for number in range(300)]
    with scene(monkeypatch, path=path) as here:
        peer = here.connect()
        for message in sent:
            peer.send(message)
            time.sleep(0.0005)
        wait_for(lambda: here.received("igtl_in") == len(sent))
        assert here.native == 1
        link = here.bridge.tcp.native_link(1)
        assert link and link.is_native and link.received_messages > len(sent) / 2
        published = [cdr for topic, cdr in here.middleware.published if topic.endswith("/transform")]
    kinds = check_recording(path, here.bridge.gateway.config, here.bridge.losses)
    assert kinds[Kind.IGTL_IN] == len(sent) == len(published)
    recorded = [entry.data() for entry in entries_of(path) if entry.kind is Kind.ROS_OUT]
    assert Counter(cdr for _, cdr in here.middleware.published) == Counter(recorded)


def test_poses_with_milliseconds_in_their_stamps_pass_in_python(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    path, seconds = tmp_path / "session.mcap", time.time_ns() // NS_PER_S
    config = Config(profile="openigtlink4j").watched()
    with scene(monkeypatch, config, path) as here:
        peer = here.connect()
        for number in range(100):
            data = bytearray(transform(number))
            data[34:42] = (seconds << 32 | number * 9).to_bytes(8, "big")
            peer.send(bytes(data))
        wait_for(lambda: here.received("igtl_in") == 100)
        link = here.bridge.tcp.native_link(1)
        assert not (link and link.received_messages)
        published = [cdr for topic, cdr in here.middleware.published if topic.endswith("/transform")]
    stamps = [TransformStamped.unpack(cdr).header.stamp_ns - seconds * NS_PER_S for cdr in published]
    assert stamps == [number * 9 * NS_PER_MS for number in range(100)]
    check_recording(path, config, here.bridge.losses)


def test_poses_to_igtl_pass_natively_to_all_peers(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    path = tmp_path / "session.mcap"
    with scene(monkeypatch, path=path) as here:
        peers = [here.connect(), here.connect()]
        for number in range(300):
            here.send_ros(pose(number))
        wait_for(lambda: all(len(peer.received) >= 300 for peer in peers))
        assert here.native == 1
        here.ros.sync()
        assert here.ros.counters()[TOPIC]["received"] == 300
    kinds = check_recording(path, here.bridge.gateway.config, here.bridge.losses)
    assert kinds[Kind.IGTL_OUT] == 300
    recorded = [entry.data() for entry in entries_of(path) if entry.kind is Kind.IGTL_OUT]
    for peer in peers:
        assert [message for message in peer.received if b"TRANSFORM" in message[:14]] == recorded


def test_without_the_passage_it_is_the_same(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    path = tmp_path / "session.mcap"
    with scene(monkeypatch, path=path, native=False) as here:
        peer = here.connect()
        for number in range(20):
            here.send_ros(pose(number))
            peer.send(transform(number))
        wait_for(lambda: here.received("igtl_in") == 20 and len(peer.received) >= 20)
        assert here.bridge._passage is None
    check_recording(path, here.bridge.gateway.config, here.bridge.losses)


CONFIG = Config(
    to_igtl=(ToIgtlRow(topic=TOPIC), ToIgtlRow(topic=POSES, max_age_s=30.0), ToIgtlRow(topic="/igtl/out/text")),
    to_ros=(ToRosRow(device="Aged", max_age_s=30.0),),
)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(6))
def test_random_sessions_are_what_the_full_path_gives(
    seed: int, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    rng, path, config = random.Random(seed), tmp_path / "session.mcap", CONFIG.watched()
    native = 0
    with scene(monkeypatch, config, path, diagnostics=False) as here:
        peers = [here.connect()]
        for step in range(500):
            kind = rng.random()
            if kind < 0.45:
                _send_odd_pose(here, rng, step)
            elif kind < 0.93:
                rng.choice(peers).send(_odd_message(rng, step))
            elif kind < 0.96:
                here.send_ros(rosmsg.String(f"text {step}"), "/igtl/out/text")
            elif kind < 0.97 and len(peers) < 3:
                peers.append(here.connect())
            elif kind < 0.975 and len(peers) > 1:
                here.disconnect(peers.pop(rng.randrange(len(peers))))
            elif kind < 0.985:
                here.bridge.change(rng.choice(CHANGES))
            if rng.random() < 0.05:
                time.sleep(rng.choice([0.001, 0.02, 0.12]))
            native = max(native, here.native)
            if not rng.randrange(100):
                here.bridge.ledger()
        wait_for(lambda: not here.middleware.waiting())
        time.sleep(0.2)
    assert native >= 2
    check_recording(path, config, here.bridge.losses)


#: Two of three give back what most messages need to pass.
CHANGES: tuple[dict[str, object], ...] = (
    {"active": False},
    {"active": True, "deny_in": (), "deny_out": ()},
    {"deny_in": ("TRANSFORM",)},
    {"deny_out": ("POSITION",)},
    {"active": True, "deny_in": (), "deny_out": (), "max_age_s": 0.0, "kinds": ()},
    {"active": True, "max_age_s": 0.5},
    {"active": True, "kinds": ("transform",)},
)


def _stamp(rng: random.Random) -> int:
    now_ns = time.time_ns()
    return rng.choice([now_ns] * 30 + [0, 1, now_ns - NS_PER_S, now_ns + NS_PER_S, now_ns - 40 * NS_PER_S])


def _numbers(rng: random.Random, step: int) -> tuple[float, float, float]:
    if rng.random() < 0.02:
        return rng.choice([(math.nan, 0.0, 0.0), (3e38, 0.0, 0.0), (math.inf, 1.0, 2.0), (300.0, 200.0, 100.0)])
    return 0.3 + step * 1e-6, 0.2, 0.1


def _rotation(rng: random.Random) -> tuple[float, float, float, float]:
    if rng.random() < 0.02:
        return rng.choice([(0.0, 0.0, 0.0, 0.0), (math.nan, 0.0, 0.0, 1.0), (0.0, 0.0, 0.0, -3.0)])
    x, y, z, w = (rng.uniform(-1, 1) for _ in range(4))
    return x, y, z, w


def _send_odd_pose(here: Scene, rng: random.Random, step: int) -> None:
    header = Header(_stamp(rng), rng.choice(["base"] * 40 + ["camera"]))
    if rng.random() < 0.5:
        message: Any = TransformStamped(header, "tool", _numbers(rng, step), _rotation(rng))
        here.send_ros(message, TOPIC, time.time_ns(), rng.choice([0] * 20 + [2]))
    else:
        here.send_ros(
            PoseStamped(header, (*_numbers(rng, step), *_rotation(rng))), POSES, rng.choice([0, time.time_ns()])
        )


def _odd_message(rng: random.Random, step: int) -> bytes:
    kind, ticks, version = rng.random(), ns_to_ticks(_stamp(rng)), rng.choice([1, 2])
    device = rng.choice(["ToolToBase", "Aged", "Third"])
    items = rng.choice([SLICER, SLICER, MISSING, ()]) if version == 2 else ()
    if kind < 0.9:
        content: Any = Transform((1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, *_numbers(rng, step)))
        message = Message("TRANSFORM", device, content, ticks, version, step, items)
    elif kind < 0.95:
        content = Position(_numbers(rng, step), _rotation(rng), "all")
        message = Message("POSITION", device, content, ticks, version, step, items)
    elif kind < 0.98:
        message = Message("STRING", device, StringBody.of("text"), ticks, version, step, items)
    else:
        message = Message("STATUS", device, Status(1, 0, "", "ok"), ticks, version)
    odd = rng.choice(["bare", "version 3", *[""] * 40])
    if odd == "bare":
        message = replace(message, header_version=1, message_id=0, metadata=())
    data = bytearray(join(encode(message)))
    if odd:
        data[1] = rng.choice([2, 3]) if odd == "bare" else 3
    if rng.random() < 0.02:
        data[rng.choice([50, 60, len(data) - 1])] ^= 1
    return bytes(data)


XYZ = tuple(rosmsg.PointField(name, 4 * place, 7, 1) for place, name in enumerate("xyz"))


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["text", "point", "cloud"])
def test_texts_points_and_small_clouds_pass_natively(
    kind: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    path, topic = tmp_path / "session.mcap", "/igtl/out/bulk"
    rows = (ToIgtlRow(topic=topic, type="POINT"),) if kind == "point" else ()
    config = Config(to_igtl=rows).watched()
    with scene(monkeypatch, config, path) as here:
        peer = here.connect()
        for number in range(100):
            content: Any
            places = np.full((1 + number % 7, 3), number, np.float32)
            if number == 90:
                places[0, 0] = math.nan
            if kind == "text":
                here.send_ros(rosmsg.String("für" if number == 90 else f"text {number}"), topic)
                name, content = "STRING", StringBody.of(f"text {number}")
            else:
                data, count = places.tobytes(), len(places)
                header = Header(time.time_ns(), "base")
                here.send_ros(rosmsg.PointCloud2(header, 1, count, XYZ, False, 12, 12 * count, data, True), topic)
                swapped: Any = places.astype(">f4")
                point = kind == "point"
                name, content = ("POINT", Points.of(swapped)) if point else ("POLYDATA", PolyData(swapped))
            peer.send(join(encode(Message(name, "Bulk", content, ns_to_ticks(time.time_ns())))))
            time.sleep(0.001)
        wait_for(lambda: here.received("ros_in") == 100 and here.received("igtl_in") == 100)
        assert here.native >= 1
    check_recording(path, config, here.bridge.losses)


@pytest.mark.parametrize(("name", "kind"), [("TDATA", Tracked), ("QTDATA", QuaternionTracked)])
def test_tracking_data_passes_natively(
    name: str, kind: type[Any], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    path, topic, array = tmp_path / "session.mcap", "/igtl/out/tools", "/igtl/out/array"
    config = Config(to_igtl=(ToIgtlRow(topic=topic, type=name),)).watched()
    with scene(monkeypatch, config, path) as here:
        peer = here.connect()
        for number in range(60):
            header, content = Header(time.time_ns(), "base"), tracked(kind, number)
            pose = (0.1, number, math.nan if number == 40 else 0.3, 0.0, 0.6, 0.0, 0.8)
            tools = (TrackedTool("Probe" if number != 20 else "Needle", 2, pose), TrackedTool("", 3, pose))
            here.send_ros(TrackingData(header, tools), topic)
            here.send_ros(PoseArray(header, np.tile(pose, (3, 1))), array)
            if number == 30:
                content.elements["matrix" if name == "TDATA" else "quaternion"][1] = 0.0
            peer.send(join(encode(Message(name, "Tools", content, ns_to_ticks(time.time_ns())))))
            wait_for(lambda number=number: here.received("igtl_in") == number + 1)
        wait_for(lambda: here.received("ros_in") == 120)
        assert here.native == 3
        with counted_by_python(here) as handled:
            here.send_ros(TrackingData(header, tools), topic)
            here.send_ros(PoseArray(header, np.tile(pose, (3, 1))), array)
            peer.send(join(encode(Message(name, "Tools", tracked(kind, 9), ns_to_ticks(time.time_ns())))))
            wait_for(lambda: here.received("ros_in") == 122 and here.received("igtl_in") == 61)
        assert handled == []
    check_recording(path, config, here.bridge.losses)


def test_joints_pass_natively(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Except the measured ones of an arm, whose names count."""
    path, topics = tmp_path / "session.mcap", ("/joints", "/array", "/arm/measured_js")
    rows = (ToIgtlRow(topic=topic, type="NDARRAY" if topic == "/array" else "SENSOR") for topic in topics)
    config = Config(to_igtl=tuple(rows)).watched()
    with scene(monkeypatch, config, path) as here:
        here.connect().send(join(encode(Message("STATUS", "Robot", Status(1), header_version=2))))
        wait_for(lambda: here.received("igtl_in") == 1)
        for number in range(20):
            header, names = Header(time.time_ns(), "base"), ("q1", "q2" if number != 9 else "other")
            for topic in topics:
                here.send_ros(JointState(header, names, np.array([number, math.nan]), np.ones(2)), topic)
        wait_for(lambda: here.received("ros_in") == 60)
        assert here.native == 2
        with counted_by_python(here) as handled:
            for topic in topics[:2]:
                here.send_ros(JointState(header, names, np.array([1.0, -0.0]), np.ones(2)), topic)
            wait_for(lambda: here.received("ros_in") == 62)
        assert handled == []
    kinds = check_recording(path, config, here.bridge.losses)
    assert kinds[Kind.IGTL_OUT] >= 62


def test_clouds_of_thousands_of_points_pass_natively(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    path, point, cloud = tmp_path / "session.mcap", "/igtl/out/point", "/igtl/out/cloud"
    config = Config(to_igtl=(ToIgtlRow(topic=point, type="POINT"),)).watched()
    with scene(monkeypatch, config, path) as here:
        peer = here.connect()
        for number in range(30):
            places = np.full((1_000 if number % 3 else 1_500, 3), number, np.float32)
            if number == 20:
                places[999, 1] = math.inf
            header, size = Header(time.time_ns(), "base"), places.nbytes
            cdr = rosmsg.PointCloud2(header, 1, len(places), XYZ, False, 12, size, places.tobytes(), True)
            here.send_ros(cdr, point)
            here.send_ros(cdr, cloud)
            swapped: Any = np.repeat(places, 5, axis=0).astype(">f4")
            message = Message("POLYDATA", "Cloud", PolyData(swapped), ns_to_ticks(time.time_ns()))
            data = bytearray(join(encode(message)))
            if number == 25:
                data[-1] ^= 1
            peer.send(bytes(data))
            marks: Any = Points.of(places[: 1 if number == 28 else None].astype(">f4"))
            if number == 22:
                marks.elements["name"][-1] = b"label"
            landmarks = join(encode(Message("POINT", "Marks", marks, ns_to_ticks(time.time_ns()))))
            peer.send(landmarks)
            wait_for(lambda number=number: here.received("igtl_in") == 2 * (number + 1))
        wait_for(lambda: here.received("ros_in") == 60)
        with counted_by_python(here) as handled:
            here.send_ros(cdr, point)
            here.send_ros(cdr, cloud)
            peer.send(join(encode(message)) + landmarks)
            wait_for(lambda: here.received("ros_in") == 62 and here.received("igtl_in") == 62)
        assert handled == []
        marks = "/igtl/in/Marks/points"
        sizes = Counter(len(cdr) for topic, cdr in here.middleware.published if topic == marks)
        taken = Counter(here.ros._native[marks].take_sizes())  # without those that Python has published
        assert 10 < taken.total() < sizes.total() and taken <= sizes, "latched: the edge knows how much is kept"
        assert here.ros._native[marks].take_sizes() == []
    check_recording(path, config, here.bridge.losses)


@pytest.mark.parametrize("recorded", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_pictures_and_large_clouds_pass_natively(
    recorded: bool, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """A part of a picture, which Python passes, is one of the last whole picture."""
    path = tmp_path / "session.mcap" if recorded else None
    rgb, bgr, cloud = "/igtl/out/rgb", "/igtl/out/bgr", "/igtl/out/cloud"
    config = Config(to_igtl=(ToIgtlRow(topic=cloud, type="POINT"),)).watched()
    side, rng = 300, random.Random(34)
    with scene(monkeypatch, config, path) as here:
        peer = here.connect()
        places = np.full((9_000, 3), 0.5, np.float32)

        def send(number: int) -> None:
            header, pixels = Header(time.time_ns(), "base"), rng.randbytes(3 * side) * side
            places[0] = math.nan if number == 8 else number
            here.send_ros(rosmsg.Image(header, side, side, "rgb8", 0, 3 * side, pixels), rgb)
            here.send_ros(rosmsg.Image(header, side, side, "bgr8", 0, 3 * side, pixels), bgr)
            here.send_ros(rosmsg.PointCloud2(header, 1, 9_000, XYZ, False, 12, 108_000, places.tobytes(), True), cloud)
            ticks, whole = ns_to_ticks(time.time_ns()), (side, side, 1)
            part: dict[str, Any] = (
                {"subvol_offset": (0, 1, 0), "subvol_size": (side, 2, 1)} if number in (10, 14) else {}
            )
            image = Image(whole, 3, pixels[: 6 * side] if part else pixels, 3, **part)
            data = bytearray(join(encode(Message("IMAGE", "Camera", image, ticks, 2 if part else 1))))
            if number == 16:
                data[-1] ^= 1
            small = join(encode(Message("IMAGE", "Small", Image((40, 40, 1), 3, pixels[:4_800], 3), ticks)))
            marks: Any = Points.of(places.astype(">f4"))
            peer.send(bytes(data) + small + join(encode(Message("POINT", "Marks", marks, ticks))))
            wait_for(lambda: here.received("igtl_in") == 3 * (number + 1) == here.received("ros_in"))

        for number in range(26):
            send(number)
        assert here.native == 6
        with counted_by_python(here) as handled:
            send(26)
        assert handled == []
        wait_for(lambda: len(peer.received) >= 3 * 27 - 1)
    if path:
        check_recording(path, config, here.bridge.losses)


@pytest.mark.parametrize("stamped", [False, True])
def test_what_slicer_gets_with_its_stamp_as_metadata_passes_natively(
    stamped: bool, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """A peer of header version 2 that shows no stamp of the header, beside one of version 1."""
    path, config, side = tmp_path / "session.mcap", Config(profile="slicer").watched(), 300
    topics = {"/igtl/out/rgb", "/igtl/out/bgr", "/igtl/out/small", "/igtl/out/text", TOPIC}
    with scene(monkeypatch, config, path) as here:
        peers = [here.connect(), here.connect()]
        peers[0].send(join(encode(Message("STATUS", "Peer", Status(1), header_version=2))))
        wait_for(lambda: here.received("igtl_in") == 1)

        def send(number: int) -> None:
            now_ns = time.time_ns()
            header, pixels = Header(now_ns if stamped else 0, "base"), bytes([number]) * (3 * side * side)
            for message, topic in (
                (rosmsg.Image(header, side, side, "rgb8", 0, 3 * side, pixels), "/igtl/out/rgb"),
                (rosmsg.Image(header, side, side, "bgr8", 0, 3 * side, pixels), "/igtl/out/bgr"),
                (rosmsg.Image(header, 20, 20, "mono8", 0, 20, pixels[:400]), "/igtl/out/small"),
                (rosmsg.String(f"text {number}"), "/igtl/out/text"),
                (TransformStamped(header, "tool", (0.001 * number, 0.2, 0.3), (0.0, 0.0, 0.6, 0.8)), TOPIC),
            ):
                here.send_ros(message, topic, now_ns)
            wait_for(lambda: here.received("ros_in") == 5 * (number + 1))

        for number in range(26):
            send(number)
        assert here.native == len(topics)
        with counted_by_python(here) as handled:
            send(26)
        assert handled == []
        wait_for(lambda: all(len(peer.received) >= 5 * 27 for peer in peers))
        assert all(b"ros.stamp" in message for message in peers[0].received[-5:])
        assert not any(b"ros.stamp" in message for message in peers[1].received)
    check_recording(path, config, here.bridge.losses)


def test_what_the_recorder_needs_leaves_recorded_messages_native(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Each 8 MB that waited, and each 16 MB of the queue, sent one to Python; of transforms, with their link."""
    path, pixels = tmp_path / "session.mcap", bytes(640 * 480 * 3)
    with scene(monkeypatch, path=path) as here:
        peer = here.connect()

        def send(number: int) -> None:
            header = Header(time.time_ns(), "base")
            here.send_ros(rosmsg.Image(header, 480, 640, "rgb8", 0, 1920, pixels), "/igtl/out/camera")
            picture = Message("IMAGE", "Camera", Image((640, 480, 1), 3, pixels, 3), ns_to_ticks(time.time_ns()))
            peer.send(join(encode(picture)))
            peer.send(transform(number))
            wait_for(lambda: here.received("igtl_in") == 2 * number + 2 and here.received("ros_in") == number + 1)

        for number in range(20):
            send(number)
        with counted_by_python(here) as handled:
            for number in range(20, 60):
                send(number)
        assert len(handled) <= 3, handled  # a thread of Python might be late
    check_recording(path, here.bridge.gateway.config, here.bridge.losses)


def test_points_pass_in_the_thread_that_reads_as_in_python(monkeypatch: pytest.MonkeyPatch) -> None:
    """Also where their stream is dropped meanwhile, which the settings of TRANSFORM do."""
    messages = []
    for number in range(120):
        places = np.full((2_000 + number, 3), number, ">f4")
        places[number, 1] = math.nan if number % 40 == 39 else 0.5
        marks: Any = Points.of(places)
        data = bytearray(join(encode(Message("POINT", "Marks", marks, ns_to_ticks((1 + number) * NS_PER_S)))))
        data[-1] ^= number % 40 == 20  # a wrong CRC
        messages.append(bytes(data))

    asked: list[Any] = []
    ask = NativeReader._ask

    def count(*arguments: Any) -> None:
        asked.append(arguments)
        ask(*arguments)

    monkeypatch.setattr(NativeReader, "_ask", count)

    def published(native: bool) -> list[tuple[str, bytes]]:
        with scene(monkeypatch, native=native) as here:
            peer = here.connect()
            for number, data in enumerate(messages):
                if number == 20:
                    wait_for(lambda: not native or here.native == 1)
                    asked.clear()
                if 20 <= number <= 60:  # each has passed before the next one
                    wait_for(lambda number=number: here.received("igtl_in") == number)
                if number == 60:
                    assert len(asked) < 20, (
                        "only the odd ones, and what comes at once behind them, take the other thread"
                    )
                if number > 60 and not number % 5:
                    wait_for(lambda number=number: here.received("igtl_in") >= number - 3)
                    here.bridge.change({"deny_out": ("TRANSFORM",) if number % 2 else ()})
                peer.send(data)
            wait_for(lambda: here.received("igtl_in") == len(messages))
            return [one for one in here.middleware.published if "Marks" in one[0]]

    assert published(native=True) == published(native=False)


def test_large_messages_of_ros_need_no_python(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nor do small ones behind them; also where their stream is dropped meanwhile."""
    clouds = []
    for number in range(120):
        places = np.full((4_000 if number % 3 else 40, 4), number, "<f4")
        places[7, 1] = math.nan if number % 40 == 39 else 0.5
        cloud = rosmsg.PointCloud2(
            Header((1 + number) * NS_PER_S, "m"),
            1,
            len(places),
            fields(*"xyz"),
            False,
            16,
            places.nbytes,
            places.tobytes(),
            True,
        )
        clouds.append(cloud)

    by_python: list[Any] = []
    take = NativeReceiver._take

    def count(*arguments: Any) -> None:
        by_python.append(arguments)
        take(*arguments)

    monkeypatch.setattr(NativeReceiver, "_take", count)

    def sent(native: bool) -> list[str]:
        with scene(monkeypatch, native=native) as here:
            peer = here.connect()
            for number, cloud in enumerate(clouds):
                if number == 20:
                    assert not native or here.native == 1
                    by_python.clear()
                if number <= 60:  # each has passed before the next one
                    wait_for(lambda number=number: here.received("ros_in") == number)
                if number == 60:
                    assert len(by_python) < 8, "only the odd one, and what comes behind it, are Python's"
                if number > 60 and not number % 5:
                    wait_for(lambda number=number: here.received("ros_in") >= number - 3)
                    here.bridge.change({"deny_out": ("TRANSFORM",) if number % 2 else ()})
                here.send_ros(cloud, "/igtl/out/C")
            wait_for(lambda: here.received("ros_in") == len(clouds))
            wait_for(lambda: len(surfaces(peer)) == len(clouds))
            return [hashlib.sha256(message[58:]).hexdigest() for message in surfaces(peer)]

    def surfaces(peer: Peer) -> list[bytes]:
        return [message for message in peer.received if b"POLYDATA" in message[:14]]

    assert sent(native=True) == sent(native=False)


def test_the_end_of_a_bridge_loses_no_picture_that_was_still_to_be_copied(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Pictures are copied for the recorder after their receivers have read them."""
    path, pixels, count = tmp_path / "session.mcap", bytes(640 * 480 * 3), 12
    with scene(monkeypatch, path=path) as here:
        peer = here.connect()
        for number in range(count):
            header = Header(time.time_ns(), "base")
            here.send_ros(rosmsg.Image(header, 480, 640, "rgb8", 0, 1920, pixels), "/igtl/out/camera")
            picture = Message("IMAGE", "Camera", Image((640, 480, 1), 3, pixels, 3), ns_to_ticks(time.time_ns()))
            peer.send(join(encode(picture)))
            if number < count - 2:
                wait_for(lambda number=number: here.received("igtl_in") == here.received("ros_in") == number + 1)
        wait_for(lambda: here.received("igtl_in") == here.received("ros_in") == count)
    kinds = check_recording(path, here.bridge.gateway.config, here.bridge.losses)
    assert [kinds[kind] for kind in (Kind.IGTL_IN, Kind.ROS_IN, Kind.IGTL_OUT)] == [count] * 3


def test_the_rest_of_a_picture_is_sent_to_a_peer_that_reads(monkeypatch: pytest.MonkeyPatch) -> None:
    """Also what the kernel has no room for: Python would copy it, and others behind it."""
    pixels, count = bytes(1920 * 1080 * 3), 10
    queued: list[Any] = []
    queue = Sender._queue

    def count_queued(self: Sender, *arguments: Any) -> bool:
        queued.append(arguments)
        return queue(self, *arguments)

    with scene(monkeypatch) as here, socket.create_connection(here.bridge.addresses[0]) as peer:
        read = [0]
        reader = threading.Thread(target=_read_all, args=(peer, read), daemon=True)
        reader.start()
        wait_for(here.bridge.tcp.links)
        for number in range(2 * count):
            if number == count:
                monkeypatch.setattr(Sender, "_queue", count_queued)
            header = Header(time.time_ns(), "base")
            here.send_ros(rosmsg.Image(header, 1080, 1920, "rgb8", 0, 5760, pixels), "/igtl/out/hd")
            wait_for(lambda number=number: read[0] > (number + 1) * len(pixels))
        assert here.native == 1
        assert len(queued) <= count // 2  # a busy host might be late; before, all of them
    reader.join(WAIT_S)


def _read_all(peer: socket.socket, read: list[int]) -> None:
    memory = bytearray(4 << 20)
    with suppress(OSError):
        while size := peer.recv_into(memory):
            read[0] += size


@pytest.mark.slow
def test_a_peer_that_stops_reading_gets_whole_pictures(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """What the kernel does not take of three parts is queued as one message."""
    path, config = tmp_path / "session.mcap", Config().watched()
    with scene(monkeypatch, config, path) as here:
        with socket.create_connection(here.bridge.addresses[0]) as slow:
            wait_for(here.bridge.tcp.links)
            for number in range(20):
                pixels = bytes([number]) * (3 * 640 * 480)
                image = rosmsg.Image(Header(time.time_ns(), "base"), 480, 640, "rgb8", 0, 1920, pixels)
                here.send_ros(image, "/igtl/out/rgb")
                wait_for(lambda number=number: here.received("ros_in") > number)
            assert here.native == 1  # before it leaves: a peer fewer is another compilation
            framer, messages = Framer(), []
            slow.settimeout(1.0)
            with suppress(TimeoutError):
                while data := slow.recv(1 << 20):
                    messages += [bytes(message) for message in framer.feed(data)]
        assert len(messages) >= 3
        for message in messages:
            assert crc64(message[HEADER_SIZE:]) == int.from_bytes(message[50:58], "big")
            assert len(set(message[-640:])) == 1
    check_recording(path, config, here.bridge.losses)


@pytest.mark.parametrize("name", ["POINT", "POLYDATA", "IMAGE"])
def test_large_messages_with_hostile_counts_are_what_the_full_path_gives(
    name: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Their CRC is right: only the numbers in them are not."""
    path, config, rng = tmp_path / "session.mcap", Config().watched(), random.Random(34)
    places: Any = np.full((800 if name == "POINT" else 6_000, 3), 1.5, ">f4")
    pixels = Image((320, 240, 1), 3, bytes(230_400), 3)
    content: Any = Points.of(places) if name == "POINT" else PolyData(places) if name == "POLYDATA" else pixels
    passed = 0
    with scene(monkeypatch, config, path) as here:
        peer = here.connect()
        for number in range(120):
            device, step = divmod(number, 12)
            data = bytearray(join(encode(Message(name, f"Cloud{device}", content, ns_to_ticks(time.time_ns())))))
            passed += here.native > 0
            if step > 4 and step % 2:
                at = HEADER_SIZE + 4 * rng.choice([*range(18), rng.randrange(len(data) // 4 - 20)])
                data[at : at + 4] = rng.choice([0, 1, 799, 6_001, 1 << 30, (1 << 32) - 1]).to_bytes(4, "big")
                if rng.random() < 0.5:
                    data = data[: len(data) - rng.choice([1, 12, 136, 4_000])]
                    data[42:50] = (len(data) - HEADER_SIZE).to_bytes(8, "big")
                data[50:58] = crc64(bytes(data[HEADER_SIZE:])).to_bytes(8, "big")
            peer.send(bytes(data))
            wait_for(lambda number=number: here.received("igtl_in") > number)
        assert passed > 30
    check_recording(path, config, here.bridge.losses)


def test_a_latched_topic_keeps_its_last_message_for_the_first_subscriber(monkeypatch: pytest.MonkeyPatch) -> None:
    topic = "/igtl/in/Marks/points"
    with scene(monkeypatch) as here:
        peer, sent = here.connect(), 0

        def send(count: int) -> list[bytes]:
            nonlocal sent
            before = len(here.middleware.published)
            for _ in range(count):
                sent += 1
                marks: Any = Points.of(np.full((1_000, 3), sent, ">f4"))
                peer.send(join(encode(Message("POINT", "Marks", marks, ns_to_ticks(time.time_ns())))))
                wait_for(lambda number=sent: here.received("igtl_in") == number)
            return [cdr for name, cdr in here.middleware.published[before:] if name == topic]

        assert len(send(20)) == 20
        assert here.native == 1
        here.middleware.subscribers[topic] = 0
        assert send(3) == []
        here.middleware.subscribers[topic] = 1
        assert here.native == 0, "an older message would follow the next"
        assert len(send(1)) == 1, "the older one is superseded"
        wait_for(lambda: here.native == 1)
        with counted_by_python(here) as handled:
            assert len(send(1)) == 1
        assert handled == []


def _is_possible(step: Any) -> bool:
    """Return whether a step does not break the stream of bytes, and has a stamp that a recording can hold."""
    if step[0] == "igtl":
        return int.from_bytes(step[1][42:50], "big") == len(step[1]) - 58
    return bool(step[-1] >= 0)


steps = st.lists(
    st.one_of(igtl_messages(), ros_messages(), igtl_bulk(), ros_bulk(), igtl_tools(), ros_tools(), ros_joints()).filter(
        _is_possible
    ),
    min_size=10,
    max_size=40,
)


@pytest.mark.slow
@settings(
    max_examples=int(os.environ.get("PASSAGE_SESSIONS", "4")), deadline=None, derandomize=True, phases=[Phase.generate]
)
@given(steps)
def test_sessions_of_the_fast_path_are_what_the_full_path_gives(steps: list[Any]) -> None:
    with pytest.MonkeyPatch.context() as monkeypatch, tempfile.TemporaryDirectory() as folder:
        path, config = Path(folder) / "session.mcap", Config().watched()
        with scene(monkeypatch, config, path) as here:
            peers = [here.connect(), here.connect()]
            for _ in range(3):  # a stream passes natively from its third message on
                for kind, *step in steps:
                    if kind == "igtl":
                        data, link = step
                        peers[link - 1].send(data)
                    else:
                        topic, ros_type, cdr, source_ns = step
                        here.ros.deliver(topic, ros_type, cdr, source_ns)
            expected = 3 * sum(kind == "igtl" for kind, *_ in steps)
            wait_for(lambda: here.received("igtl_in") == expected and not here.middleware.waiting())
        check_recording(path, config, here.bridge.losses)


def test_nothing_passes_natively_under_the_settings_before_a_change(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    path, config = tmp_path / "session.mcap", Config().watched()
    sent = Counter[str]()
    with scene(monkeypatch, config, path) as here:
        peer = here.connect()
        stop = threading.Event()

        def flood() -> None:
            while not stop.is_set():
                peer.send(transform(sent["igtl_in"] % 100) * 5)
                sent["igtl_in"] += 5
                here.send_ros(pose(sent["ros_in"] % 100))
                sent["ros_in"] += 1
                time.sleep(0.0002)

        thread = threading.Thread(target=flood)
        thread.start()
        try:
            for change in ({"active": False}, {"deny_in": ("TRANSFORM",)}, {"deny_out": ("TRANSFORM",)}) * 4:
                wait_for(lambda: here.native == 2)
                here.bridge.change(change)
                assert here.native < 2
                time.sleep(0.01)
                here.bridge.change({"active": True, "deny_in": (), "deny_out": ()})
        finally:
            stop.set()
            thread.join()
        wait_for(lambda: here.received("igtl_in") == sent["igtl_in"] and here.received("ros_in") == sent["ros_in"])
    check_recording(path, config, here.bridge.losses)
    active, refused = True, 0
    for entry in entries_of(path):
        if entry.kind is Kind.EDGE_NOTE and (settings := LiveSettings.from_note(Note.unpack(entry.data()))):
            active = settings.active
        assert active or entry.kind not in (Kind.IGTL_OUT, Kind.ROS_OUT)
        refused += not active and entry.kind in (Kind.IGTL_IN, Kind.ROS_IN)
    rows = [*here.bridge.losses["streams"]["igtl_in"].values(), *here.bridge.losses["streams"]["ros_in"].values()]
    assert refused == sum(row["dropped"]["inactive"] for row in rows) > 0


# -- its borders -------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_peer_that_does_not_read_loses_what_python_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    with scene(monkeypatch) as here:
        peer = socket.socket()
        peer.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 16)  # soon full
        peer.connect(here.bridge.addresses[0])
        wait_for(here.bridge.tcp.links)
        number = 0
        while here.bridge.tcp.counters()[1].queued_messages == 0 and number < 100_000:
            here.send_ros(pose(number))
            number += 1
        here.send_ros(pose(number))
        total = number + 1
        wait_for(lambda: here.received("ros_in") == total)
        counts = here.bridge.tcp.counters()[1]
        assert counts.sent_messages + counts.queued_messages + sum(counts.dropped.values()) == total
        framer = Framer()
        messages: list[bytes | memoryview] = []
        peer.settimeout(WAIT_S)
        while len(messages) < total - sum(here.bridge.tcp.counters()[1].dropped.values()):
            messages += framer.feed(peer.recv(1 << 20))
        places = [struct.unpack_from(">f", message, len(message) - 12)[0] for message in messages]
        assert places == sorted(places), "the order of the messages has changed"
        here.send_ros(pose(number + 1))  # the way is clear again
        wait_for(lambda: here.bridge.tcp.counters()[1].queued_messages == 0)
        link = here.bridge.tcp.native_link(1)
        assert link and link.clear
        peer.close()


@contextmanager
def counted_by_python(here: Scene) -> Iterator[list[str]]:
    """Yield a list of the inputs that Python handles: their topics, and IGTL for messages of links."""
    handled: list[str] = []
    hub = here.bridge.hub
    ros, igtl = hub.ros, hub.igtl

    def from_ros(topic: str, *arguments: Any) -> None:
        handled.append(topic)
        ros(topic, *arguments)

    def from_link(*arguments: Any) -> None:
        handled.append("IGTL")
        igtl(*arguments)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(hub, "ros", from_ros)
        patch.setattr(hub, "igtl", from_link)
        yield handled


def test_poses_of_ros_stay_native_while_peers_come_and_go(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """In Python, all of them would wait for it each time that a peer connects, sends its first message, or leaves."""
    path = tmp_path / "session.mcap"
    with scene(monkeypatch, path=path) as here:
        first = here.connect()
        for number in range(20):
            here.send_ros(pose(number))
        wait_for(lambda: here.native == 1)
        with counted_by_python(here) as handled:
            for number in range(100, 400, 100):
                other = here.connect()
                for step in range(20):
                    here.send_ros(pose(number + step))
                other.send(join(encode(Message("GET_STATUS", "Other", EmptyQuery()))))
                wait_for(lambda: any(b"STATUS" in one[:14] for one in other.received))  # noqa: B023 (it ends here)
                here.send_ros(pose(number + 20))
                here.disconnect(other)
                here.send_ros(pose(number + 21))
            wait_for(lambda: here.received("ros_in") == 20 + 3 * 22)
        wait_for(lambda: sum(b"TRANSFORM" in one[:14] for one in first.received) == 20 + 3 * 22)
        assert TOPIC not in handled
    check_recording(path, here.bridge.gateway.config, here.bridge.losses)


def test_streams_of_a_peer_stay_native_while_others_come_and_go(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    path = tmp_path / "session.mcap"
    with scene(monkeypatch, path=path) as here:
        first = here.connect()
        for number in range(100):
            first.send(transform(number))
            time.sleep(0.001)
        wait_for(lambda: here.received("igtl_in") == 100)
        assert here.native == 1
        with counted_by_python(here) as handled:
            for number in range(3):
                other = here.connect()
                here.disconnect(other)
                first.send(transform(100 + number))
            wait_for(lambda: here.received("igtl_in") == 103)
        assert handled == []
        assert here.native == 1
    check_recording(path, here.bridge.gateway.config, here.bridge.losses)


def test_a_link_that_takes_nothing_any_more_leaves_the_others_native(monkeypatch: pytest.MonkeyPatch) -> None:
    """Such as that of a peer that has left, and whose last messages wait for their turn."""
    with scene(monkeypatch) as here:
        peer, gone = here.connect(), here.connect()
        for number in range(20):
            here.send_ros(pose(number))
        wait_for(lambda: here.native == 1 and len(gone.received) == 20)
        here.bridge.tcp._links[2].sender.mute("it has left")
        with counted_by_python(here) as handled:
            for number in range(20, 50):
                here.send_ros(pose(number))
            wait_for(lambda: len(peer.received) == 50)
        assert handled == []
        assert here.received("ros_in") == 50
        assert here.bridge.ledger()["links"]["0"]["ignored"] == {"TRANSFORM/tool": 30}
        assert len(gone.received) == 20


def test_poses_that_waited_for_a_lock_pass_natively(monkeypatch: pytest.MonkeyPatch) -> None:
    """Python's thread takes none of them: it would wait for the GIL, and they with it."""
    taken: list[object] = []
    take = NativeReceiver._take

    def counted(self: NativeReceiver, native: Subscription) -> None:
        taken.append(native)
        take(self, native)

    monkeypatch.setattr(NativeReceiver, "_take", counted)
    with scene(monkeypatch) as here:
        peer = here.connect()
        for number in range(20):
            here.send_ros(pose(number))
        wait_for(lambda: here.native == 1)

        def send_rest() -> None:
            for number in range(20, 50):
                here.send_ros(pose(number))

        before = len(taken)
        with counted_by_python(here) as handled:
            with here.bridge.hub.sequence:
                sending = threading.Thread(target=send_rest)
                sending.start()
                time.sleep(0.1)  # more than a thread of the middleware waits
            sending.join(WAIT_S)
            wait_for(lambda: len(peer.received) == 50)
        assert handled == []
        assert len(taken) == before
        places = [struct.unpack_from(">f", message, len(message) - 12)[0] for message in peer.received]
        assert places == sorted(places), "the order of the messages has changed"


def test_a_thread_of_the_middleware_receives_on_while_python_has_the_lock(monkeypatch: pytest.MonkeyPatch) -> None:
    """Commands have the lock for most of the time: a thread that waits for it each time receives too little."""
    with scene(monkeypatch) as here:
        peer = here.connect()
        for number in range(20):
            here.send_ros(pose(number))
        wait_for(lambda: here.native == 1)
        for number in range(20, 40):
            sending = threading.Thread(target=here.send_ros, args=(pose(number),))
            with here.bridge.hub.sequence:
                sending.start()
                sending.join(WAIT_S)
                assert not sending.is_alive()
            wait_for(lambda: len(peer.received) == number + 1)  # noqa: B023 (called before the next number)


def test_messages_in_pieces_and_in_blocks_arrive_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    with scene(monkeypatch) as here:
        peer = here.connect()
        for number in range(10):
            peer.send(transform(number))
        wait_for(lambda: here.native == 1)
        block = b"".join(transform(number) for number in range(2_000))
        text = join(encode(Message("STRING", "Text", StringBody.of("x" * 60_000))))
        rng, stream = random.Random(1), block + text + block + text + block
        while stream:
            size = rng.choice([1, 57, 58, 200, 5_000, 70_000])
            peer.send(stream[:size])
            stream = stream[size:]
        wait_for(lambda: here.received("igtl_in") == 10 + 6_000 + 2)


def picture(number: int, side: int = 160) -> bytes:
    pixels = bytes([number % 256]) * (side * side * 3)
    content = Image((side, side, 1), 3, pixels, 3)
    return join(encode(Message("IMAGE", "Camera", content, ns_to_ticks(time.time_ns()))))


@pytest.mark.slow
@pytest.mark.parametrize("size", [1_000, 70_000, 1 << 20])
def test_poses_pass_beside_pictures(size: int, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    path = tmp_path / "session.mcap"
    with scene(monkeypatch, path=path) as here:
        peer = here.connect()
        stream = b"".join(transform(number) + (picture(number) if number % 10 == 0 else b"") for number in range(400))
        stream += join(encode(Message("STATUS", "Robot", Status(1, 0, "", "ok"))))
        while stream:
            peer.send(stream[:size])
            stream = stream[size:]
        wait_for(lambda: here.received("igtl_in") == 441)
        assert here.native == 2
        link = here.bridge.tcp.native_link(1)
        assert link and link.received_messages > 200 and not link.large_waiting
    check_recording(path, here.bridge.gateway.config, here.bridge.losses)
    inputs = [entry for entry in entries_of(path) if entry.kind is Kind.IGTL_IN]
    assert inputs[-1].type == "STATUS", "a message of the full path has overtaken others"
    pictures = [entry.data()[-1] for entry in inputs if entry.type == "IMAGE"]
    assert pictures == [number % 256 for number in range(0, 400, 10)]


def test_a_picture_above_the_limit_ends_the_link(monkeypatch: pytest.MonkeyPatch) -> None:
    with scene(monkeypatch, limits=PeerLimits(max_body=100_000)) as here:
        peer = here.connect()
        for number in range(10):
            peer.send(picture(number) + transform(number))
            time.sleep(0.005)
        wait_for(lambda: here.received("igtl_in") == 20)
        peer.send(picture(11, 300)[:80_000])
        wait_for(lambda: not here.bridge.tcp.links())
        assert here.bridge.tcp.link_faults() == {"too_large": 1}


@pytest.mark.parametrize("size", [2**64 - 1, 2**64 - 58, 2**64 - 57, 2**64 - 50, 2**63 - 58, 2**63])
def test_a_size_of_a_picture_that_wraps_around_ends_the_link(size: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Header and body together are a small number of 64 bits, or a negative one: no memory is taken for that."""
    with scene(monkeypatch) as here:
        peer = here.connect()
        for number in range(10):
            peer.send(picture(number) + transform(number))
            time.sleep(0.005)
        wait_for(lambda: (link := here.bridge.tcp.native_link(1)) is not None and link.is_native and here.native == 2)
        with suppress(OSError):  # the bridge closes it while this sends
            peer.send(picture(1)[:42] + struct.pack(">QQ", size, 0) + bytes(100_000))
        wait_for(lambda: not here.bridge.tcp.links())
        assert here.bridge.tcp.link_faults() == {"too_large": 1}


def test_a_peer_that_leaves_inside_a_picture_is_noted(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    path = tmp_path / "session.mcap"
    with scene(monkeypatch, path=path) as here:
        peer = here.connect()
        for number in range(6):
            peer.send(picture(number) + transform(number))
            time.sleep(0.01)
        wait_for(lambda: here.received("igtl_in") == 12)
        peer.send(picture(7) + picture(8)[:70_000])
        wait_for(lambda: here.received("igtl_in") == 13)
        here.disconnect(peer)
    notes = [Note.unpack(entry.data()) for entry in entries_of(path) if entry.kind is Kind.EDGE_NOTE]
    (truncated,) = [note for note in notes if note.code == "truncated"]
    assert truncated.data["received"] == 70_000
    check_recording(path, here.bridge.gateway.config, here.bridge.losses)


def test_other_types_and_bad_messages_go_to_python_and_the_link_comes_back(monkeypatch: pytest.MonkeyPatch) -> None:
    with scene(monkeypatch) as here:
        peer = here.connect()
        for number in range(10):
            peer.send(transform(number))
        wait_for(lambda: here.native == 1)
        for number in range(5):
            bad = bytearray(transform(number))
            bad[70] ^= 255
            peer.send(join(encode(Message("STATUS", "Robot", Status(1, 0, "", "ok")))) + bytes(bad) + transform(number))
            time.sleep(0.002)
        wait_for(lambda: here.received("igtl_in") == 25)
        dropped = here.bridge.ledger()["streams"]["igtl_in"]["TRANSFORM/ToolToBase"]["dropped"]
        assert sum(dropped.values()) == 5
        for number in range(20):
            peer.send(transform(number))
            time.sleep(0.002)
        wait_for(lambda: here.received("igtl_in") == 45)
        link = here.bridge.tcp.native_link(1)
        assert link and link.is_native


def test_a_message_that_is_too_large_ends_the_link_as_in_python(monkeypatch: pytest.MonkeyPatch) -> None:
    with scene(monkeypatch) as here:
        peer = here.connect()
        for number in range(10):
            peer.send(transform(number))
            time.sleep(0.002)
        wait_for(lambda: here.native == 1)
        peer.send(transform(1)[:42] + struct.pack(">QQ", 2**60, 0))
        wait_for(lambda: not here.bridge.tcp.links())
        assert here.bridge.tcp.link_faults() == {"too_large": 1}
        assert here.native == 0


def test_the_rate_limit_holds(monkeypatch: pytest.MonkeyPatch) -> None:
    with scene(monkeypatch, limits=PeerLimits(messages_per_s=200)) as here:
        peer = here.connect()
        begun = time.monotonic()
        for number in range(1_200):
            peer.send(transform(number))
        wait_for(lambda: here.received("igtl_in") == 1_200)
        assert time.monotonic() - begun > 1.5  # 200 at once, then what one reading takes (620), then 200 in a second


def test_a_peer_that_leaves_inside_a_message_is_noted(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    path = tmp_path / "session.mcap"
    with scene(monkeypatch, path=path) as here:
        peer = here.connect()
        for number in range(20):
            peer.send(transform(number))
            time.sleep(0.001)
        wait_for(lambda: here.native == 1)
        peer.send(transform(1)[:70])
        time.sleep(0.05)
        here.disconnect(peer)
    notes = [Note.unpack(entry.data()) for entry in entries_of(path) if entry.kind is Kind.EDGE_NOTE]
    (truncated,) = [note for note in notes if note.code == "truncated"]
    assert truncated.data["received"] == 70
    check_recording(path, here.bridge.gateway.config, here.bridge.losses)


def test_outputs_without_a_subscriber_are_not_built(monkeypatch: pytest.MonkeyPatch) -> None:
    with scene(monkeypatch) as here:
        here.middleware.subscribers = {"/tf": 0}
        peer = here.connect()
        for number in range(100):
            peer.send(transform(number))
        wait_for(lambda: here.received("igtl_in") == 100)
        assert here.native == 1
        assert not [topic for topic, _ in here.middleware.published if topic == "/tf"]
        here.middleware.subscribers = {"/tf": 0, "/igtl/in/ToolToBase/transform": 0}
        for number in range(100):
            peer.send(transform(number))
        wait_for(lambda: here.received("igtl_in") == 200)
        assert here.bridge.ledger()["streams"]["igtl_in"]["TRANSFORM/ToolToBase"]["unheard"] >= 99


def test_losses_of_the_middleware_are_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    with scene(monkeypatch) as here:
        here.connect()
        for number in range(50):
            here.send_ros(pose(number), lost=1 if number in (10, 20) else 0)
        wait_for(lambda: here.received("ros_in") == 50)
        here.ros.sync()
        assert here.ros.counters()[TOPIC]["lost"] == 2


def test_a_failing_middleware_is_counted_and_hangs_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    with scene(monkeypatch) as here:
        peer = here.connect()
        sent = 0
        while here.native < 2:
            peer.send(transform(sent))
            here.send_ros(pose(sent))
            sent += 1
            time.sleep(0.005)
        link = here.bridge.tcp.native_link(1)
        wait_for(lambda: link and link.is_native and here.received("igtl_in") == sent)
        here.middleware.failing = 1
        peer.send(transform(sent))
        here.send_ros(pose(sent))
        wait_for(lambda: here.received("igtl_in") == sent + 1 and here.ros.errors)
        here.middleware.failing = 0
        here.send_ros(pose(sent + 1))
        wait_for(lambda: here.received("ros_in") == sent + 2)
        here.ros.sync()
        assert here.ros.counters()["/igtl/in/ToolToBase/transform"]["failed"] == 1
        here.ros.errors.clear()


def test_many_threads_of_the_middleware_keep_the_order_of_a_topic(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    path, topics = tmp_path / "session.mcap", [f"/igtl/out/tool{number}" for number in range(4)]
    with scene(monkeypatch, path=path) as here:
        peer = here.connect()

        def deliver(topic: str) -> None:
            for number in range(300):
                here.send_ros(pose(number), topic)

        for topic in topics:
            here.ros.subscribe(topic, TransformStamped.TYPE)
        threads = [threading.Thread(target=deliver, args=(topic,)) for topic in topics]
        sender = threading.Thread(target=peer.send, args=(b"".join(map(transform, range(600))),))
        for thread in (*threads, sender):
            thread.start()
        for thread in (*threads, sender):
            thread.join()
        wait_for(lambda: here.received("ros_in") == 1_200 and here.received("igtl_in") == 600)
    check_recording(path, here.bridge.gateway.config, here.bridge.losses)
    for topic in topics:
        stamps = [entry.data() for entry in entries_of(path) if entry.channel == topic]
        assert stamps == sorted(stamps, key=lambda cdr: struct.unpack_from("<iI", cdr, 4))


def test_a_latched_or_guarded_topic_is_judged_by_python(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    path = tmp_path / "session.mcap"
    with scene(monkeypatch, path=path) as here:
        here.connect()
        for number in range(30):
            here.send_ros(pose(number))
            time.sleep(0.02)
        for _ in range(3):  # metres instead of millimetres
            time.sleep(0.11)
            jump = TransformStamped(Header(time.time_ns(), "base"), "tool", (10.0, 200.0, 300.0), (0.0, 0.0, 0.0, 1.0))
            here.send_ros(jump)
    notes = [Note.unpack(entry.data()) for entry in entries_of(path) if entry.kind is Kind.NOTE]
    assert [note.code for note in notes if note.code == "unit_jump"] == ["unit_jump"]
    check_recording(path, here.bridge.gateway.config, here.bridge.losses)


def test_messages_pass_natively_while_an_oddity_of_their_stream_is_recent(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(guarded_stream, "EPISODE_NS", EPISODE_NS)
    path = tmp_path / "session.mcap"
    with scene(monkeypatch, path=path) as here:
        peer = here.connect()
        link = here.bridge.tcp.native_link(1)
        assert link

        def send(number: int, stamp_ns: int) -> int:
            """Return how many of the messages passed natively."""
            wait_for(lambda: not here.native or link.is_native)
            before, received = link.received_messages, here.received("igtl_in")
            peer.send(transform(number, stamp_ns))
            wait_for(lambda: here.received("igtl_in") == received + 1)
            return int(link.received_messages - before)

        begin_ns = time.time_ns()
        while not here.native:
            send(0, begin_ns)
        send(1, begin_ns)
        odd_ns = time.monotonic_ns()
        assert not send(2, begin_ns - NS_PER_S)  # Python begins the episode
        until = time.monotonic() + WAIT_S
        passed: list[int] = []
        while (native := send(3 + len(passed), time.time_ns())) or time.monotonic_ns() - odd_ns < EPISODE_NS:
            assert time.monotonic() < until, "the episode does not end"
            passed.append(native)
            time.sleep(0.02)
        # Python ends it.  Before, it has a message now and then: one that comes while it has the turn of the link.
        assert sum(passed) > 0.8 * len(passed), passed
        assert any(send(3 + len(passed) + more, time.time_ns()) for more in range(3))
    notes = [Note.unpack(entry.data()) for entry in entries_of(path) if entry.kind is Kind.NOTE]
    odd = [note.code for note in notes if note.code in guarded_stream.CODES]
    assert odd == [guarded_stream.BACKWARDS, guarded_stream.CALM]
    check_recording(path, here.bridge.gateway.config, here.bridge.losses)


# -- robots -----------------------------------------------------------------------------------------------------------


def _servo(x: float, stamp_ns: int) -> bytes:
    content = Transform((1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, x, 0.0, 0.0))
    return join(encode(Message("TRANSFORM", "PSM1/servo_cp", content, ns_to_ticks(stamp_ns))))


@pytest.mark.slow
@pytest.mark.parametrize("native", [True, False])
def test_a_burst_of_commands_beside_native_streams_moves_the_robot_at_its_limit(
    native: bool, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    path = tmp_path / "session.mcap"
    arms = (ArmsRow("/PSM*", max_age_s=60.0),)
    config = Config(crtk=arms, allow_in=("PSM1/servo_cp",)).watched()
    sent = 0
    with scene(monkeypatch, config, path, native=native, diagnostics=False) as here:
        peer = here.connect()
        begin_ns = time.time_ns()
        for burst in range(12):
            if burst % 4 == 0:
                here.send_ros(PoseStamped(Header(time.time_ns()), (0.0,) * 6 + (1.0,)), "/PSM1/measured_cp")
            stamps = [begin_ns + (10 * burst + number) * 10 * NS_PER_MS for number in range(10)]
            xs = [0.002 * (10 * burst + number) if burst % 3 else 1e-5 * number for number in range(10)]
            mixed = [data for at, ns in zip(xs, stamps, strict=True) for data in (_servo(at, ns), transform(at))]
            peer.send(b"".join(mixed))
            sent += len(mixed)
            wait_for(lambda sent=sent: here.received("igtl_in") == sent)
            time.sleep(0.03)
        assert (here.native > 0) is native if native else here.bridge._passage is None
    check_recording(path, here.bridge.gateway.config, here.bridge.losses)
    written = [cdr for topic, cdr in here.middleware.published if topic == "/PSM1/servo_cp"]
    assert written == [entry.data() for entry in entries_of(path) if entry.channel == "/PSM1/servo_cp"], "once each"
    points: list[tuple[int, float]] = []
    cause_ns = 0
    for entry in entries_of(path):
        if entry.kind.is_input:
            cause_ns = entry.stamp_ns
        elif entry.kind is Kind.ROS_OUT and entry.channel == "/PSM1/servo_cp":
            points.append((cause_ns, PoseStamped.unpack(entry.data()).pose[0]))
    assert len(points) > 3
    for number, (at_ns, x) in enumerate(points):
        for before_ns, before in points[:number]:
            assert abs(x - before) <= 0.25 * (at_ns - before_ns) / NS_PER_S * (1 + 1e-9) + 1e-12


def test_a_copy_whose_guard_fails_passes_no_message(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing may pass that is not checked and counted, and the reading thread knows no stream that is gone."""

    def fail(*_: object) -> None:
        raise ValueError("planted")

    with scene(monkeypatch) as here:
        peer = here.connect()
        monkeypatch.setattr(passage_streams._Guards, "set", fail)
        for number in range(40):
            peer.send(transform(float(number)))
        wait_for(lambda: here.received("igtl_in") == 40)
        link = here.bridge.tcp.native_link(1)
        assert here.native == 0 and link is not None and link.stream_count == 0


def test_a_stream_that_python_has_lost_lives_as_long_as_its_link(monkeypatch: pytest.MonkeyPatch) -> None:
    """The reading thread may be at it: without a reference of the link, that is the end of the process."""
    with scene(monkeypatch) as here:
        peer = here.connect()
        for number in range(40):
            peer.send(transform(float(number)))
        wait_for(lambda: here.native == 1)
        assert here.bridge._passage
        with here.bridge.hub.sequence:
            (copy,) = here.bridge._passage.streams._copies.values()
            references = [sys.getrefcount(copy.native)]
            for _ in range(2):  # the second as the drop of the copy will
                copy.native.remove()
                references.append(sys.getrefcount(copy.native))
        assert [number - references[0] for number in references] == [0, -1, -1]
