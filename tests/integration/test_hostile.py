"""Hostile peers at the running bridge: each costs at most its own message or link, and good ones beside them go on.

One bridge for all, with small limits.  ``hostile_cases`` has a row for each peer; a good OpenIGTLink peer and a good
ROS node exchange a message in both directions while it is there, and after it.  When all have been, the bridge is
ended, and what it noted and counted is read from its events, its ledger and its recording.
"""

from __future__ import annotations

import random
import socket
import struct
import threading
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

from igtl_gateway.cli import main
from igtl_gateway.gateway.log.entry import Kind
from igtl_gateway.gateway.log.note import Note
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.wire.registry import BODIES
from tests.integration.bridge import (
    HEADER_SIZE,
    Bridge,
    Event,
    RawPeer,
    RosClient,
    Wire,
    header,
    message,
    string,
)
from tests.integration.hostile_cases import CASES, MARK, OTHERS, PAGE, Case, Manner, page
from tests.peers import reference
from tests.peers.reference import ReferencePeer
from tests.tables import table

pytestmark = [
    pytest.mark.ros,
    pytest.mark.skipif(reference.available() is not None, reason=str(reference.available())),
]

MAX_CLIENTS = 12
QUEUE_MIB = 4
STALL_S = 4.0
LORIS_S = 0.4  # between two bytes of the slow loris: far below the silence that is allowed
IMAGES, IMAGE_BYTES = 40, 1 << 20
TINY = 2_000
CROWDED = f"{MAX_CLIENTS} clients are connected already"

GOOD_IN, AFTER_IN = "/igtl/in/Good/string", "/igtl/in/After/string"
GOOD_OUT, LONG_OUT, CAMERA = "/igtl/out/Answer", "/igtl/out/Long", "/igtl/out/Camera"

#: Notes about a link that every peer may cause: that it is there, what streams it has, what it may be.
EVERYDAY = frozenset({"link_up", "link_down", "stream", "peer_profile", "query_unanswered"})


@dataclass
class Scene:
    """The bridge with one good peer on each side.

    Attributes:
        silent, loris: peers that are inside a header from the beginning on.
        played: cases by name → the number of their peer's link.
        numbers: of the links of peers; an address may come again, when the peer that had it has left.
        rounds: messages that the good ones exchanged.
    """

    bridge: Bridge
    ros: RosClient
    good: ReferencePeer
    silent: RawPeer
    loris: RawPeer
    recording: Path
    rounds: int = 0
    played: dict[str, int] = field(default_factory=dict)
    numbers: dict[RawPeer, int] = field(default_factory=dict)
    answers: dict[str, tuple[str, ...]] = field(default_factory=dict)

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

    def peer(self, receive_buffer: int | None = None) -> RawPeer:
        """A peer that is connected, and has a link."""
        peer = RawPeer(self.bridge.port, receive_buffer)
        self.link_of(peer)
        return peer

    def link_of(self, peer: RawPeer) -> list[int]:
        """The number of a peer's link, as events have it; for the first time while the link is up."""
        if peer not in self.numbers:
            self.bridge.wait_until(lambda: len(self.links_up(peer.name)) == 1, f"link_up of {peer.name}")
            (self.numbers[peer],) = self.links_up(peer.name)
        return [self.numbers[peer]]

    def links_up(self, name: str) -> set[int]:
        """The numbers of the links to an address that have not ended."""
        events = list(self.bridge.events)
        ups = [event for event in events if event.get("code") == "link_up" and event["data"].get("peer") == name]
        down = {event["links"][0] for event in events if event.get("code") == "link_down"}
        return {event["links"][0] for event in ups} - down

    def wait_down(self, number: int) -> None:
        self.bridge.wait_code("link_down", links=[number])

    def play(self, case: Case) -> None:
        """A hostile peer comes, and the good ones go on; what it is answered is looked at here, the rest at the end."""
        with self.peer() as peer:
            (self.played[case.name],) = self.link_of(peer)
            self._send(peer, case)
            if case.manner is not Manner.RESETS:
                self.good_goes_on()
                self.answers[case.name] = tuple(wire.type for wire in self._answers(peer, case))
        self.good_goes_on()

    def _send(self, peer: RawPeer, case: Case) -> None:
        data = case.data + (string(case.name, "After") if case.kept else b"")
        if case.manner is Manner.BYTEWISE:
            peer.socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            for byte in data:
                peer.send(bytes([byte]))
        else:
            with suppress(ConnectionError):  # it may be closed before it has sent all
                peer.send(data)
        if case.manner is Manner.RESETS:
            peer.socket.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
            peer.close()
        if case.kept:
            self.hears_after(case.name)

    def _answers(self, peer: RawPeer, case: Case) -> list[Wire]:
        """All that it gets until it is closed, beside what everybody gets; who may stay has to go first."""
        if case.kept or case.manner is Manner.LEAVES:
            peer.socket.shutdown(socket.SHUT_WR)
        got = []
        with suppress(ConnectionError):
            while True:
                got.append(peer.receive())
        return [wire for wire in got if wire.device != "Answer"]


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Scene]:
    recording = tmp_path_factory.mktemp("hostile") / "hostile.mcap"
    strings = dict.fromkeys((GOOD_IN, AFTER_IN), "std_msgs/msg/String")
    with RosClient(
        "beside",
        subscribe=strings,
        advertise=dict.fromkeys((GOOD_OUT, LONG_OUT), "std_msgs/msg/String") | {CAMERA: "sensor_msgs/msg/Image"},
    ) as ros:
        limits = ("--max-clients", str(MAX_CLIENTS), "--queue-mib", str(QUEUE_MIB), "--stall-s", str(STALL_S))
        bridge = Bridge("--record", str(recording), *limits)
        over = threading.Event()
        try:
            with (
                ReferencePeer.client("127.0.0.1", bridge.port) as good,
                RawPeer(bridge.port) as silent,
                RawPeer(bridge.port) as loris,
            ):
                # inside a header throughout this module: they must not delay any other peer
                silent.send(string("never whole")[: HEADER_SIZE // 2])
                dribble = threading.Thread(target=dribbles, args=(loris, over))
                dribble.start()
                ros.wait_readers(GOOD_OUT, LONG_OUT, CAMERA)
                scene = Scene(bridge, ros, good, silent, loris, recording)
                for slow in (silent, loris):
                    scene.link_of(slow)
                yield scene
                over.set()
                dribble.join()
        finally:
            over.set()
            bridge.close()


def dribbles(peer: RawPeer, over: threading.Event) -> None:
    """Send a byte now and then, until the bridge closes the link."""
    with suppress(OSError):
        for byte in header("IMAGE", 1000, 0):
            peer.send(bytes([byte]))
            if over.wait(LORIS_S):
                return


@table("case", CASES, ids=lambda case: case.name)
def test_what_is_answered_while_the_good_ones_go_on(scene: Scene, case: Case) -> None:
    scene.play(case)
    if case.manner is not Manner.RESETS:
        assert scene.answers[case.name] == case.answer


def test_no_body_for_every_type(scene: Scene) -> None:
    with scene.peer() as peer:
        peer.send(b"".join(message(kind, b"", device="no-body") for kind in BODIES) + string("no body", "After"))
        (scene.played["no-body"],) = scene.link_of(peer)
        scene.hears_after("no body")
    scene.good_goes_on()


def test_tiny_messages(scene: Scene) -> None:
    """The good ones are served in between, not behind them."""
    with scene.peer() as peer:
        (scene.played["tiny"],) = scene.link_of(peer)
        flood = threading.Thread(target=peer.send, args=(message("TINY", b"", device="tiny") * TINY,))
        flood.start()
        scene.good_goes_on()
        flood.join()
        peer.send(string("behind them", "After"))
        scene.hears_after("behind them")
    scene.good_goes_on()


def test_a_peer_that_asks_and_never_listens(scene: Scene) -> None:
    """A query of 58 bytes has an answer of 60,000.  Strings are not dropped: the link ends."""
    scene.ros.publish(LONG_OUT, {"data": "x" * 60_000})
    scene.good.receive("STRING", "Long")
    with scene.peer(receive_buffer=1 << 14) as peer:
        (scene.played["asks"],) = scene.link_of(peer)
        with suppress(ConnectionError):
            peer.send(message("GET_STRING", b"", device="Long") * 1000)
        scene.good_goes_on()
        scene.bridge.wait_code("queue_full", links=scene.link_of(peer))
    scene.good_goes_on()


def test_200_at_once(scene: Scene) -> None:
    """As many as may stay do, the others are sent away, and there is room when some have left."""
    number = 200
    with ExitStack() as stack:
        before = len(scene.bridge.events)
        crowd = {peer.name: peer for peer in (stack.enter_context(RawPeer(scene.bridge.port)) for _ in range(number))}

        def ups() -> dict[str, int]:
            """Address → link, of the crowd."""
            events = (event for event in scene.bridge.events[before:] if event.get("code") == "link_up")
            return {event["data"]["peer"]: event["links"][0] for event in events if event["data"]["peer"] in crowd}

        def admitted() -> set[str]:
            return set(ups())

        def refused() -> int:
            told = [event["data"] for event in scene.bridge.events if event.get("code") == "refused"]
            return max((data["count"] for data in told if data.get("reason") == CROWDED), default=0)

        scene.good_goes_on()
        what = f"word about each of the {number}"
        scene.bridge.wait_until(lambda: len(admitted()) + refused() == number, what)
        assert 0 < len(admitted()) < MAX_CLIENTS
        assert all(peer.closed_by_peer() for name, peer in crowd.items() if name not in admitted())
        scene.good_goes_on()
    for link in ups().values():
        scene.wait_down(link)
    with scene.peer() as peer:
        peer.send(string("there is room again", device="After"))
        scene.hears_after("there is room again")


def test_a_peer_that_never_reads(scene: Scene) -> None:
    """Its images are dropped, its strings are kept, memory is bounded, and a peer that reads gets everything."""
    fields = {
        "header": {"frame_id": "camera"},
        "width": 1024,
        "height": IMAGE_BYTES // 1024,
        "encoding": "mono8",
        "step": 1024,
        "data": {"hex": random.Random(1).randbytes(IMAGE_BYTES).hex()},
    }
    every = IMAGES // 20
    with scene.peer(receive_buffer=1 << 16) as lazy, scene.peer() as eager:
        (scene.played["lazy"],) = scene.link_of(lazy)
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
        scene.bridge.wait_code("queue_drop", links=scene.link_of(lazy))
        # now it reads: fewer images, all strings
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


def test_promises_reserve_nothing(scene: Scene) -> None:
    """Volumes of 250 MiB each, of which the beginning comes."""
    size, some = 250 << 20, 100_000
    before = scene.bridge.resident_bytes()
    with ExitStack() as stack:
        peers = [stack.enter_context(scene.peer()) for _ in range(8)]
        for peer in peers:
            peer.send(header("IMAGE", size, 0, device="promise") + bytes(some))
        scene.good_goes_on()
        growth = scene.bridge.resident_bytes() - before
        assert growth < 16 << 20, growth
    for peer in peers:
        note = scene.bridge.wait_code("truncated", links=scene.link_of(peer))
        assert note["data"]["expected"] == HEADER_SIZE + size
    scene.good_goes_on()


def test_a_text_of_70000_bytes_from_ros(scene: Scene) -> None:
    scene.ros.publish(GOOD_OUT, {"data": "x" * 70_000})
    scene.bridge.wait_code("conversion", stream=GOOD_OUT)
    scene.good_goes_on()


@pytest.mark.parametrize("who", ["header", "loris"])
def test_slow_peers_are_given_up(scene: Scene, who: str) -> None:
    """They came before all other tests; the others were served meanwhile."""
    peer, words = (scene.silent, "and stopped") if who == "header" else (scene.loris, "too slow")
    note = scene.bridge.wait_code("stalled", links=scene.link_of(peer))
    assert note["text"].endswith(words)
    assert peer.closed_by_peer()
    scene.good_goes_on()


@dataclass(frozen=True)
class Told:
    """The facts at the end: all events in order, the last event, and the recording."""

    events: list[Event]
    ledger: dict[str, Any]
    notes: list[tuple[Kind, str, tuple[int, ...]]]
    rounds: int
    links: dict[str, int]

    def noted(self, name: str) -> Counter[str]:
        """Codes of the notes in the recording about the link of a case's peer."""
        number = self.links[name]
        return Counter(code for _, code, links in self.notes if number in links and code not in EVERYDAY)


@pytest.fixture(scope="module")
def told(scene: Scene) -> Told:
    """The bridge is ended when every case has been."""
    for case in CASES:
        if case.name not in scene.played:
            scene.play(case)
    for number in scene.played.values():
        scene.wait_down(number)
    links = dict(scene.played)
    result = scene.bridge.end()
    assert (result.code, result.err) == (0, "")
    last = scene.bridge.events[-1]
    assert last["event"] == "stopped" and last["recording"]["dropped"] == 0
    notes: list[tuple[Kind, str, tuple[int, ...]]] = []
    rounds = 0
    with SessionFile.open(scene.recording) as recording:
        assert recording.ledger and recording.ledger["streams"] == last["ledger"]["streams"]
        for entry in recording.entries():
            if entry.kind in (Kind.NOTE, Kind.EDGE_NOTE, Kind.LINK):
                notes.append((entry.kind, Note.unpack(entry.data()).code, tuple(entry.links)))
            rounds += entry.kind is Kind.ROS_OUT and entry.channel == GOOD_IN
    return Told(scene.bridge.events, last["ledger"], notes, rounds, links)


@table("case", CASES, ids=lambda case: case.name)
def test_what_is_noted_and_counted(told: Told, case: Case) -> None:
    number = told.links[case.name]
    assert set(told.noted(case.name)) == set(case.noted)
    for code in case.noted:
        assert any(event.get("code") == code and event["links"] == [number] for event in told.events), "the event"
    row = told.ledger["streams"]["igtl_in"].get(case.ledger_stream, {})
    fates = {word: count for word, count in row.items() if word in ("converted", "unheard", "recorded_only")}
    assert fates | row.get("dropped", {}) == case.counted
    assert row.get("received", 0) == sum(case.counted.values())


def test_the_ledger_closes_and_counts_the_faults_of_links(scene: Scene, told: Told) -> None:
    assert told.ledger["gaps"] == []
    assert told.rounds == scene.rounds
    faults = told.ledger["link_faults"]
    of_links = Counter(code for kind, code, links in told.notes if kind is Kind.EDGE_NOTE and links)
    assert faults == {code: of_links[code] for code in faults}, "each was noted"
    expected = Counter(code for case in CASES if not case.kept for code in case.noted)
    assert expected <= Counter(faults)
    codes = {code for _, code, _ in told.notes}
    assert not codes & {"internal_error", "callback_failed"}


@pytest.mark.usefixtures("told")
def test_the_recording_verifies(scene: Scene) -> None:
    """What was made of all this follows from what came, byte for byte."""
    assert main(["verify", str(scene.recording)]) == 0


@pytest.mark.usefixtures("told")
def test_what_people_are_shown_has_no_control_characters(scene: Scene, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["info", str(scene.recording)]) == 0
    shown = capsys.readouterr().out
    assert r"\x1b[2J" in shown
    assert [line for line in shown.split("\n") if not line.isprintable()] == []


def test_what_the_others_left_behind(told: Told) -> None:
    if not told.links.keys() >= {"asks", "tiny", "lazy", "no-body"}:
        pytest.skip("not all tests of this module were run")
    found = told.ledger["link_faults"]
    assert (found["stalled"], found["queue_full"]) == (2, 1)
    assert set(told.noted("asks")) == {"queue_full"}
    assert set(told.noted("tiny")) == {"no_conversion"}
    assert set(told.noted("lazy")) == {"queue_drop"}
    streams = told.ledger["streams"]["igtl_in"]
    assert (streams["TINY/tiny"]["received"], streams["TINY/tiny"]["converted"]) == (TINY, TINY)
    assert {f"{kind}/no-body" for kind in BODIES} <= streams.keys()
    assert told.ledger["refused"][CROWDED] > 200 - MAX_CLIENTS


def test_the_page_says_the_same() -> None:
    assert PAGE.read_text("utf-8").partition(MARK)[2] == page()
    tests = {name.partition("[")[0] for name, *_ in OTHERS}
    assert tests <= globals().keys()
