"""Messages with metadata, as 3D Slicer sends them, take the fast path and the native passage, and give the same."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from igtl_gateway.base.buffers import join
from igtl_gateway.base.stamp import ns_to_ticks
from igtl_gateway.config.configuration import Config
from igtl_gateway.convert import express
from igtl_gateway.convert.igtl_msgs import Metadata, PointList, Volume
from igtl_gateway.gateway import Session
from igtl_gateway.gateway.fastpath.metadata import LARGEST_BLOCK, MOST_BLOCKS, block_size, to_ros_key
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.native.passage import is_compiled
from igtl_gateway.wire import HEADER_SIZE, Item, Message, encode
from igtl_gateway.wire.header import NAMES
from igtl_gateway.wire.image import Image
from igtl_gateway.wire.point import Points
from igtl_gateway.wire.text import String as StringBody
from igtl_gateway.wire.transform import Transform
from tests.gateway.fastpath.test_cache import MISSING, POSE, SLICER, T0_NS, watched_session
from tests.gateway.fastpath.test_passage_streams import (
    check_recording,
    counted_by_python,
    entries_of,
    scene,
    wait_for,
)

native = pytest.mark.skipif(not is_compiled(), reason="the package was installed without its native passage")
compiled = pytest.mark.skipif(not express.COMPILED, reason="installed without the C part")
HUNDRED = 100


def sent(
    number: int, items: Sequence[Item] = SLICER, name: str = "TRANSFORM", content: Any = POSE, stamp_ns: int = T0_NS
) -> bytes:
    """A message with an id of its own."""
    ticks = ns_to_ticks(stamp_ns) if stamp_ns else 0
    return join(encode(Message(name, "Probe", content, ticks, 2, number, tuple(items))))


def given(session: Session, messages: Sequence[bytes]) -> list[Entry]:
    """All that a session gives for the messages of its first peer."""
    return [
        entry
        for number, message in enumerate(messages)
        for entry in session.input(T0_NS + 1_000 * number, Kind.IGTL_IN, (message,), links=(1,))
    ]


def ids(entries: Sequence[Entry]) -> list[int]:
    return [Metadata.unpack(entry.data()).message_id for entry in entries if entry.type == Metadata.TYPE]


CONTENTS = [
    ("TRANSFORM", POSE),
    pytest.param("STRING", StringBody(b"text"), marks=compiled),
    pytest.param("POINT", Points.of(np.ones((3, 3))), marks=compiled),
    pytest.param("IMAGE", Image((2, 2, 1), 3, bytes(12), 3), marks=compiled),
]
#: 3D Slicer states the centre of a picture, so that there is always a Volume beside the Image.
CENTRED = (*Image.IDENTITY[:9], 149.5, 149.5, 0.0)


@pytest.mark.parametrize(("name", "content"), CONTENTS)
@pytest.mark.parametrize("stamp_ns", [T0_NS, 0])
def test_constant_metadata_leave_a_stream_on_the_fast_path(name: str, content: Any, stamp_ns: int) -> None:
    session, general = watched_session()
    entries = given(session, [sent(number, SLICER, name, content, stamp_ns) for number in range(6)])
    assert general == [Kind.IGTL_IN, Kind.IGTL_IN]  # the first one shows that the peer is 3D Slicer
    assert ids(entries) == list(range(6))


def test_a_tool_that_comes_and_goes_stays_on_the_fast_path() -> None:
    session, general = watched_session(Config().watched())
    blocks = [SLICER, SLICER, MISSING, MISSING, *[SLICER, MISSING, MISSING, SLICER] * 20]
    entries = given(session, [sent(number, items) for number, items in enumerate(blocks)])
    assert len(general) == 2 + 2  # a block besides the first when it comes a second time running
    frames = [entry for entry in entries if entry.channel == "/tf"]
    assert len(frames) == blocks.count(SLICER), "a pose that is marked as not valid is left out of /tf"


@compiled
def test_landmarks_stay_on_the_fast_path_while_they_move_and_when_one_is_added() -> None:
    session, general = watched_session()
    messages = []
    for number in range(20 * 12):
        places = np.full((1 + number // 20, 3), number, ">f4")
        points = Points.of(places, diameters=number)
        points.elements["name"] = [b"F-%d" % index for index in range(len(places))]
        points.elements["owner"][-1] = b"CT"
        messages.append(sent(number, SLICER, "POINT", points))
    entries = given(session, messages)
    assert len(general) == 1 + 12
    lists = [PointList.unpack(entry.data()) for entry in entries if entry.channel.endswith("/landmarks")]
    assert [one.points[-1].diameter for one in lists] == [number / 1_000 for number in range(240)]
    assert [len(one.points) for one in lists] == [1 + number // 20 for number in range(240)]
    assert {item.value for one in lists for item in one.metadata} == {"Probe", "unknown", "OK"}


def numbered(number: int) -> tuple[Item, ...]:
    return (*SLICER, Item("Frame", str(number).encode()))


def test_metadata_that_change_with_each_message_are_not_compiled() -> None:
    session, general = watched_session()
    given(session, [sent(number, numbered(number)) for number in range(HUNDRED)])
    assert len(general) == HUNDRED
    assert session.gateway.fast_path.to_ros.keys() == {to_ros_key(1, sent(1, numbered(1)))}  # type: ignore[attr-defined]


def test_a_device_keeps_few_blocks_of_metadata() -> None:
    session, general = watched_session()
    given(session, [sent(number, numbered(number // 4)) for number in range(4 * HUNDRED)])
    assert len(general) == 2 * HUNDRED  # each block twice
    assert len(session.gateway.fast_path.to_ros) == MOST_BLOCKS  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    "items",
    [
        (Item("ros.stamp", b"1700000000123456789"),),
        (Item("long", b"x" * LARGEST_BLOCK),),
    ],
)
def test_metadata_that_a_stream_cannot_have_take_the_full_path(items: tuple[Item, ...]) -> None:
    session, general = watched_session()
    given(session, [sent(number, items) for number in range(5)])
    assert len(general) == 5


def test_the_key_of_a_message_has_its_metadata_if_their_sizes_fit() -> None:
    message = bytearray(sent(1))
    size = block_size(message)
    assert to_ros_key(1, message) == (1, bytes(message[NAMES]) + bytes(message[-size:]))
    for at in (2, 4, 5, 6):  # of the extended header: larger than the message
        odd = bytearray(message)
        odd[HEADER_SIZE + at] = 255
        assert to_ros_key(1, odd) == (1, bytes(message[NAMES]))
    assert to_ros_key(1, message[: HEADER_SIZE + 11]) == (1, bytes(message[NAMES]))


def moved(number: int) -> Transform:
    return Transform((*POSE.wire_matrix[:9], 10.0 + number / 100, 2.0, 3.0))


@native
@pytest.mark.parametrize("recorded", [False, True])
def test_poses_of_slicer_pass_natively(recorded: bool, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Of a tool that is seen, and sometimes not; one message is damaged, and a few have no stamp."""
    path, config = tmp_path / "session.mcap" if recorded else None, Config().watched()
    with scene(monkeypatch, config, path) as here:
        peer = here.connect()

        def send(number: int, items: Sequence[Item]) -> None:
            data = bytearray(sent(number, items, content=moved(number), stamp_ns=time.time_ns() * (number % 7 > 0)))
            data[-1] ^= number == 150
            peer.send(bytes(data))

        for number in range(300):
            send(number, MISSING if number // 10 % 4 == 3 else SLICER)
            if number < 100:
                wait_for(lambda number=number: here.received("igtl_in") > number)
        wait_for(lambda: here.received("igtl_in") == 300)
        assert here.native == 2
        with counted_by_python(here) as handled:
            for number, items in enumerate([SLICER, MISSING, MISSING, SLICER, SLICER]):
                send(300 + number, items)
            wait_for(lambda: here.received("igtl_in") == 305)
        assert handled == []
        published = list(here.middleware.published)
        metadata = [Metadata.unpack(cdr) for topic, cdr in published if topic.endswith("/metadata")]
        assert sorted(one.message_id for one in metadata) == [number for number in range(305) if number != 150]
        assert {item.value for one in metadata for item in one.items} == {"Probe", "unknown", "OK", "MISSING"}
    if path:
        check_recording(path, config, here.bridge.losses)
        recorded_ids = ids([entry for entry in entries_of(path) if entry.kind is Kind.ROS_OUT])
        assert recorded_ids == [number for number in range(305) if number != 150]


def landmarks(number: int) -> Points:
    """Three fiducials of Slicer that move, once without names."""
    points = Points.of(np.full((3, 3), number, ">f4"))
    if number != 8:
        points.elements["name"] = [b"F-1", b"F-2", b"F-3"]
    return points


@native
def test_texts_points_and_pictures_of_slicer_pass_natively(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    path, config = tmp_path / "session.mcap", Config().watched()
    side = 300
    contents: dict[str, Any] = {
        "STRING": lambda number: StringBody.of(f"text {number}"),
        "POINT": landmarks,
        "IMAGE": lambda number: Image((side, side, 1), 3, bytes([number]) * (3 * side * side), 3, wire_matrix=CENTRED),
    }
    with scene(monkeypatch, config, path) as here:
        peer, count = here.connect(), 0

        def send(number: int) -> None:
            nonlocal count
            for name, content in contents.items():
                peer.send(sent(number, MISSING if number % 3 == 0 else SLICER, name, content(number), time.time_ns()))
                count += 1
                wait_for(lambda count=count: here.received("igtl_in") == count)

        for number in (1, 2, 4, 5, 7, 8, 9, 9, 9, 9, 10, 11, 11, 12):
            send(number)
        assert here.native == 6
        with counted_by_python(here) as handled:
            for number in (13, 15, 16, 18):
                send(number)
        assert handled == []
    check_recording(path, config, here.bridge.losses)


@native
def test_a_subscriber_of_metadata_that_comes_later_gets_them(monkeypatch: pytest.MonkeyPatch) -> None:
    topic = "/igtl/in/Probe/metadata"
    with scene(monkeypatch) as here:
        peer = here.connect()
        here.middleware.subscribers[topic] = 0
        for number in range(20):
            peer.send(sent(number, content=moved(number)))
            wait_for(lambda number=number: here.received("igtl_in") > number)
        assert here.native == 1
        here.middleware.subscribers[topic] = 1
        with counted_by_python(here) as handled:
            peer.send(sent(20, content=moved(20)))
            wait_for(lambda: here.received("igtl_in") == 21)
        assert handled == []
        found = [Metadata.unpack(cdr).message_id for name, cdr in here.middleware.published if name == topic]
        assert found == [20]


@native
def test_a_picture_of_slicer_waits_for_the_first_subscriber_of_its_volume(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its Image passes natively meanwhile."""
    image, volume, side = "/igtl/in/Probe/image", "/igtl/in/Probe/volume", 301
    with scene(monkeypatch) as here:
        peer = here.connect()

        def send(number: int) -> None:
            picture = Image((side, side, 1), 3, bytes([number]) * (side * side), 1, wire_matrix=CENTRED)
            peer.send(sent(number, SLICER, "IMAGE", picture, time.time_ns()))
            wait_for(lambda: here.received("igtl_in") == number + 1)

        for number in range(3):
            send(number)
        here.middleware.subscribers[volume] = 0
        for number in range(3, 20):
            send(number)
        with counted_by_python(here) as handled:
            for number in range(20, 25):
                send(number)
        assert handled == []
        here.middleware.subscribers[volume] = 1
        traffic = here.bridge._traffic
        assert traffic
        traffic._on_first_subscriber(volume)
        wait_for(lambda: any(topic == volume for topic, _ in here.middleware.published))
        send(25)
        published = list(here.middleware.published)
        assert sum(topic == image for topic, _ in published) == 26
        volumes = [Volume.unpack(cdr) for topic, cdr in published if topic == volume]
        assert [bytes(one.data[:1])[0] for one in volumes] == [0, 1, 2, 24, 25]
        assert [one.value for one in volumes[0].metadata] == ["Probe", "unknown", "unknown", "OK"]
