"""The bridge without ROS: what it leaves behind when it cannot start, and what it records."""

from __future__ import annotations

import json
import socket
import threading
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from websockets.sync.client import connect
from websockets.typing import Origin

from igtl_gateway.app.bridge import Bridge
from igtl_gateway.app.bridge_options import BridgeOptions
from igtl_gateway.app.part import Parts
from igtl_gateway.app.recording import state_rule
from igtl_gateway.app.timer import Timer
from igtl_gateway.base.buffers import join
from igtl_gateway.base.clock import SystemClock
from igtl_gateway.base.errors import RecordingError, Unavailable
from igtl_gateway.config.configuration import Config, ToIgtlRow
from igtl_gateway.config.notations import listen_address
from igtl_gateway.convert.rosmsg import Header, Image
from igtl_gateway.edges.tcp import PeerLimits
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.note import Level, Note
from igtl_gateway.gateway.silences import STREAM_SILENT, Silences
from igtl_gateway.record.options import RecordOptions
from igtl_gateway.record.recorder import MOVES, STALLED, Recorder
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.replay.verify import DeclaredLosses, verify
from igtl_gateway.wire import Message, encode
from igtl_gateway.wire.image import Image as WireImage
from igtl_gateway.wire.text import String
from tests.integration.bridge import message
from tests.places import FIXTURES
from tests.record.notes import TimelessNotes

HELLO = join(encode(Message("STRING", "Greeting", String.of("hello"))))


def test_a_port_that_is_taken_does_not_cost_the_recording_of_yesterday(tmp_path: Path) -> None:
    recording = tmp_path / "out.mcap"
    recording.write_bytes(b"yesterday")
    with socket.create_server(("127.0.0.1", 0)) as taken:
        options = BridgeOptions(
            (taken.getsockname(),), ros=False, record=recording, recording=RecordOptions(overwrite=True)
        )
        with pytest.raises(Unavailable):
            Bridge(Config(), options, SystemClock()).start()
    assert recording.read_bytes() == b"yesterday"


def test_a_recording_that_exists_is_refused_and_the_port_is_free_again(tmp_path: Path) -> None:
    recording = tmp_path / "out.mcap"
    recording.write_bytes(b"yesterday")
    bridge = Bridge(Config(), BridgeOptions((("127.0.0.1", 0),), ros=False, record=recording), SystemClock())
    with pytest.raises(RecordingError):
        bridge.start()
    socket.create_server(bridge.addresses[0]).close()
    assert recording.read_bytes() == b"yesterday"


def test_a_websocket_peer_is_recorded_as_one_and_verifies(tmp_path: Path) -> None:
    options = BridgeOptions((listen_address("ws://127.0.0.1:0"),), ros=False, record=tmp_path / "out.mcap")
    bridge = Bridge(Config(), options, SystemClock())
    bridge.start()
    try:
        with connect("ws://{}:{}".format(*bridge.addresses[0]), origin=Origin("http://localhost")) as peer:
            peer.send(HELLO)
            peer.send(message("GET_STATUS", b"", device="Asked"))
            answer = peer.recv()
            assert isinstance(answer, bytes) and answer[2:8] == b"STATUS"
    finally:
        bridge.stop()
    with SessionFile.open(options.record or Path()) as recording:
        links = [Note.unpack(entry.data()) for entry in recording.entries() if entry.kind is Kind.LINK]
        assert [note.data.get("transport") for note in links] == ["websocket", None]
        assert links[0].data["origin"] == "http://localhost"
        losses = DeclaredLosses.of(recording.session, recording.ledger)
        assert verify(recording.entries(), Config(), losses).good


class _Noted:
    """A part that notes its start and its stop; the latter fails if it is asked to."""

    def __init__(self, name: str, events: list[str], fails: str = "") -> None:
        self._name, self._events, self._fails = name, events, fails

    def start(self) -> None:
        self._events.append(f"start {self._name}")
        if self._fails == "start":
            raise Unavailable(self._name)

    def stop(self) -> None:
        self._events.append(f"stop {self._name}")
        if self._fails == "stop":
            raise RuntimeError(self._name)


def test_parts_stop_in_the_reverse_order_of_their_start_and_once() -> None:
    events: list[str] = []
    parts = Parts(_Noted("a", events), None, _Noted("b", events))
    parts.start()
    parts.stop()
    parts.stop()
    assert events == ["start a", "start b", "stop b", "stop a"]


def test_an_error_at_the_start_leaves_what_has_started_to_be_stopped() -> None:
    events: list[str] = []
    parts = Parts(_Noted("a", events), _Noted("b", events, "start"), _Noted("c", events))
    with pytest.raises(Unavailable):
        parts.start()
    parts.stop()
    assert events == ["start a", "start b", "stop b", "stop a"]


def test_a_part_that_cannot_stop_does_not_keep_the_others() -> None:
    events: list[str] = []
    parts = Parts(_Noted("a", events), _Noted("b", events, "stop"))
    parts.start()
    with pytest.raises(RuntimeError):
        parts.stop()
    assert events[2:] == ["stop b", "stop a"]


def test_a_defect_of_one_part_does_not_cost_the_recording(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "out.mcap"
    bridge = Bridge(Config(), BridgeOptions((("127.0.0.1", 0),), ros=False, record=path), SystemClock())
    stop = Timer.stop

    def stop_badly(timer: Timer) -> None:
        stop(timer)
        raise RuntimeError("a defect")

    monkeypatch.setattr(Timer, "stop", stop_badly)
    bridge.start()
    with pytest.raises(RuntimeError, match="a defect"):
        bridge.stop()
    with SessionFile.open(path) as file:
        assert file.ledger


def test_a_burst_of_pictures_larger_than_the_queue_is_recorded_whole(tmp_path: Path) -> None:
    path = tmp_path / "out.mcap"
    recording = RecordOptions(queue_bytes=4 << 20)
    options = BridgeOptions((("127.0.0.1", 0),), ros=False, record=path, recording=recording)
    bridge = Bridge(Config(), options, SystemClock())
    bridge.start()
    image = WireImage((1500, 1024, 1), 3, bytes(1500 * 1024))
    pictures = [join(encode(Message("IMAGE", f"Camera{peer}", image))) for peer in range(3)]

    def send(data: bytes) -> None:
        with socket.create_connection(bridge.addresses[0]) as peer:
            for _ in range(12):
                peer.sendall(data)

    with ThreadPoolExecutor() as peers:
        list(peers.map(send, pictures))
    received: dict[str, dict[str, int]] = {}
    while sum(fates.get("received", 0) for fates in received.values()) < 36:
        threading.Event().wait(0.05)  # a stop would end the wait for the recorder after some seconds
        received = bridge.ledger()["streams"].get("igtl_in", {})
    bridge.stop()
    assert bridge.summary and not bridge.summary.dropped
    with SessionFile.open(path) as file:
        kinds = Counter(entry.kind for entry in file.entries() if entry.size > 1 << 20)
    assert kinds[Kind.IGTL_IN] == 36 and kinds[Kind.ROS_OUT] >= 36


def test_a_topic_that_was_asked_for_but_cannot_be_converted_is_said_once() -> None:
    seen: list[Entry] = []
    config = Config(to_igtl=(ToIgtlRow(topic="/scan", device="Scan"), ToIgtlRow(topic="/text", type="IMAGE")))
    bridge = Bridge(config, BridgeOptions(ros=False), SystemClock(), seen.append)
    for topic, ros_type in (
        ("/scan", "sensor_msgs/msg/LaserScan"),
        ("/scan", "sensor_msgs/msg/LaserScan"),
        ("/text", "std_msgs/msg/String"),
        ("/elsewhere", "sensor_msgs/msg/LaserScan"),
        ("/igtl/out/a", "std_msgs/msg/String"),
    ):
        wanted = bridge.subscriptions.wanted(topic, ros_type)
        assert (wanted is not None) == (topic == "/igtl/out/a")
    notes = [Note.unpack(entry.data()) for entry in seen]
    assert [(note.code, note.stream) for note in notes] == [("no_conversion", "/scan"), ("no_conversion", "/text")]


def test_what_a_peer_says_is_in_the_recording(tmp_path: Path) -> None:
    recording = tmp_path / "out.mcap"
    seen: list[Entry] = []
    options = BridgeOptions((("127.0.0.1", 0),), ros=False, record=recording)
    bridge = Bridge(Config(), options, SystemClock(), seen.append)
    bridge.start()
    with socket.create_connection(bridge.addresses[0]) as peer:
        peer.sendall(HELLO)
        peer.shutdown(socket.SHUT_WR)
        assert peer.recv(1) == b"", "the bridge closes when it has read all"
    bridge.stop()
    bridge.stop()
    with SessionFile.open(recording) as file:
        recorded = list(file.entries())
        assert file.ledger and file.ledger["streams"]["igtl_in"]["STRING/Greeting"]["converted"] == 1
    assert [(e.seq, e.kind, e.channel, e.data()) for e in recorded] == [
        (e.seq, e.kind, e.channel, e.data()) for e in seen
    ]
    assert HELLO in [entry.data() for entry in recorded if entry.kind is Kind.IGTL_IN]


@pytest.mark.slow
@pytest.mark.parametrize(("name", "split_s"), [("every-type", 2.0), ("crtk", 0.5)])
def test_every_part_of_a_session_verifies_alone(name: str, split_s: float, tmp_path: Path) -> None:
    """Nothing but a part and its prologue: queries, frames, commands, robots and all."""
    with SessionFile.open(FIXTURES / f"{name}.mcap") as file:
        config, entries = Config.from_dict(json.loads(file.session["config"])), list(file.entries())
        facts = {key: value for key, value in file.session.items() if key != "format_version"}
    notes = TimelessNotes()
    recorder = Recorder(
        tmp_path / "all.mcap",
        facts,
        qos_of=lambda _topic, _type: None,
        on_note=notes.append,
        clock=SystemClock(),
        options=RecordOptions(split_s=split_s),
        rule=state_rule(config),
    )
    for entry in entries:
        recorder(entry)
    *parts, _ = recorder.close({}).files
    assert [note for note in notes if note.code not in (MOVES, STALLED)] == []  # they come with the load
    assert len(parts) >= 4
    compared = 0
    for part in parts:
        with SessionFile.open(part) as file:
            report = verify(
                file.entries(), config, DeclaredLosses.of(file.session, file.ledger), before=file.prologue()
            )
        assert report.good, (part.name, report.differences[:1])
        compared += report.equal
    assert compared == sum(not entry.kind.is_input for entry in entries)


def test_the_ledger_closes_over_a_peer_that_does_not_read_and_one_that_has_gone() -> None:
    bridge = Bridge(
        Config(),
        BridgeOptions((("127.0.0.1", 0),), ros=False, limits=PeerLimits(queue_messages=20)),
        SystemClock(),
    )
    bridge.start()
    side = 512
    picture = Image(Header(1, "base"), side, side, "mono8", 0, side, bytes(side * side)).pack()
    with socket.create_connection(bridge.addresses[0]) as gone, socket.create_connection(bridge.addresses[0]) as sender:
        assert bridge.tcp.wait_links(2, 5.0)
        for number in range(120):
            bridge.hub.ros("/igtl/out/Camera", Image.TYPE, picture, 0)
            if number == 60:
                gone.close()
        sender.sendall(HELLO)
        sender.shutdown(socket.SHUT_WR)
        bridge.stop()
    assert bridge.losses["gaps"] == []
    peers = bridge.losses["streams"]["peers"].values()
    assert sum(fates["sent"] for fates in peers) == bridge.losses["streams"]["igtl_out"]["IMAGE/Camera"]["sent"]
    assert all(fates["dropped"]["queue"] > 0 for fates in peers)


def test_what_is_said_of_silent_streams_is_in_the_session(monkeypatch: pytest.MonkeyPatch) -> None:
    seen = threading.Event()
    monkeypatch.setattr(Silences, "look", lambda *_: [Note(Level.WARN, STREAM_SILENT, "TRANSFORM/Arm: no message")])

    def take(entry: Entry) -> None:
        if entry.kind is Kind.EDGE_NOTE and Note.unpack(entry.data()).code == STREAM_SILENT:
            seen.set()

    bridge = Bridge(Config(watch=True), BridgeOptions((("127.0.0.1", 0),), ros=False), SystemClock(), take)
    bridge.start()
    try:
        assert seen.wait(30)
    finally:
        bridge.stop()
