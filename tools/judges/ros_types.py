"""A foreign ROS 2 node at the gateway: every row of both tables of conversions, and the qualities of service.

Strategy: the messages, and what the other side must have received of each, are those of the test of the table
(``tests/integration/test_ros_types.py``); the node is the judge's program, which takes the commands of
``tests/integration/ros_client.py``.  It never shares a line of code with the gateway.
"""

from __future__ import annotations

import hashlib
import struct
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace

from igtl_gateway.convert.table import TO_ROS as CONVERSIONS
from igtl_gateway.wire import decode
from igtl_gateway.wire.registry import describe_content
from tests.integration.bridge import Bridge, RawPeer, RosClient
from tests.integration.test_ros_types import (
    ADVERTISED,
    CASES,
    IMAGE,
    IN,
    OUT,
    OUTGOING,
    PLACE,
    STRING_TYPE,
    SUBSCRIBED,
    TICKS,
    Case,
    Json,
    Sent,
    World,
    check,
    head,
    heard,
    hexed,
    image,
    packed,
    rows_of_the_command_line,
)
from tools.judges.results import DIFFERS, EXACT, FAILS, TO_IGTL, TO_ROS, Row

#: An RGB image of Full HD: 6.2 MB, which DDS cuts into a hundred datagrams.
WIDTH, HEIGHT = 1920, 1080
BEST, SURE = "best effort", "reliable"
#: Far longer than an image takes.
PATIENCE_S = 15.0
LOST_FIRST = (
    "the first one is lost, those after it are exact. Its reader, reliable and volatile, takes what the first heartbeat"
    " names as history that it need not have, also where it has half of the fragments: its behaviour, not ours"
)
#: Images that are sent once more where best effort has lost the first one.
AGAIN = 20
LOST_BEST = (
    f"the first one is lost, not all of the next {AGAIN} are. Fast DDS keeps 512 KiB of shared memory for a sender"
    " unless its profile asks for more, and best effort drops what does not fit: its default, not ours"
)
EARLY = "published before the bridge started"


@contextmanager
def world(node: RosClient, *words: str, readers: int = 1) -> Iterator[World]:
    """The bridge, the node with all topics of the tables, and two peers.

    Args:
        words: further arguments of the bridge.
        readers: of each topic of the node.
    """
    for topic, kind in (SUBSCRIBED | _large(f"{IN}%s/image")).items():
        node.subscribe(topic, kind, reliable="BestEffort" not in topic)
    for topic, kind in (ADVERTISED | _large(f"{OUT}%s")).items():
        node.advertise(topic, kind, reliable="BestEffort" not in topic)
    node.advertise(f"{OUT}Early", STRING_TYPE, latched=True)
    node.publish(f"{OUT}Early", {"data": EARLY})
    bridge = Bridge("--no-cautious", *rows_of_the_command_line(), *words)
    try:
        with RawPeer(bridge.port) as talker, RawPeer(bridge.port) as listener:
            bridge.wait_code("link_up", 2)
            node.wait_readers(*ADVERTISED.keys(), *_large(f"{OUT}%s"), f"{OUT}Early", count=readers)
            yield World(bridge, node, talker, listener, talker, None)
    finally:
        bridge.end()
        bridge.close()


#: A row for the case that all is exact, and what compares; it returns how it differs, or "".
Trial = tuple[Row, Callable[[World], str]]


def judge(
    node: RosClient, *words: str, readers: int = 1, more: Sequence[Trial] = (), lost_first: str = LOST_FIRST
) -> list[Row]:
    """Every type both ways, then images of 6 MB, late joiners, and what else is tried; arguments as for ``world``.

    Args:
        lost_first: why the first large image may be lost.
    """
    trials = (*map(_in, CASES), *map(_out, OUTGOING), *_images(lost_first), *_late(), *more)
    with node, world(node, *words, readers=readers) as there:
        return [_tried(row, there) for row in (*_early(), *trials)]


def _tried(trial: Trial, there: World) -> Row:
    row, run = trial
    try:
        text = run(there)
    except (AssertionError, TimeoutError) as error:
        failed = Row(row.what, row.direction, FAILS, 1, " ".join(f"{type(error).__name__} {error}".split())[:300])
        print(failed, flush=True)  # the others take their time
        return failed
    return replace(row, result=DIFFERS, text=text) if text else row


def _in(case: Case) -> Trial:
    def run(there: World) -> str:
        there.talker.send(packed(case.type, case.device, case.content, case.metadata))
        for kind, (_, wanted) in case.heard.items():
            assert (got := heard(there, case.topic(kind), wanted)) == wanted, f"{kind}: {got}, expected {wanted}"
        return ""

    types = " ".join(sorted({kind for kind, _ in case.heard.values()}))
    return Row(f"{case.type} {types}", TO_ROS, EXACT), run


def _out(one: Sent) -> Trial:
    def run(there: World) -> str:
        there.ros.publish(one.topic, one.fields)
        got = there.listener.receive(one.device, one.type)
        message = decode(got.data)
        check(describe_content(message.content), one.content)
        assert got.crc_ok and (message.ticks == TICKS) is one.stamped, f"CRC {got.crc_ok}, ticks {message.ticks}"
        return ""

    return Row(f"{one.type} {one.ros_type}", TO_IGTL, EXACT), run


def _large(topic: str) -> dict[str, str]:
    """Topic → type of the streams of large images, one of each reliability."""
    return {topic % quality.title().replace(" ", ""): IMAGE for quality in (BEST, SURE)}


def _images(lost_first: str) -> Iterator[Trial]:
    pixels = hashlib.shake_256(b"pixels").digest(WIDTH * HEIGHT * 3)
    fields = {"header": head("Base"), "height": HEIGHT, "width": WIDTH, "encoding": "rgb8", "step": 3 * WIDTH}
    for quality in (SURE, BEST):
        device = quality.title().replace(" ", "")

        def to_ros(there: World, device: str = device) -> str:
            content = packed("IMAGE", device, image((WIDTH, HEIGHT, 1), 3, 3, pixels, PLACE))
            text = ""
            there.talker.send(content)
            try:
                there.ros.wait_until(lambda: there.ros.waiting(f"{IN}{device}/image") > 0, "image", PATIENCE_S)
            except AssertionError:
                text = lost_first
                there.talker.send(content)
            assert there.ros.receive(f"{IN}{device}/image")["data"] == hexed(pixels), "other pixels"
            return text

        def to_igtl(there: World, device: str = device, quality: str = quality) -> str:
            message, text = {**fields, "data": hexed(pixels)}, ""
            there.ros.publish(f"{OUT}{device}", message)
            try:
                got = there.listener.receive(device, "IMAGE")
            except TimeoutError:
                if quality == SURE:
                    raise
                text = LOST_BEST
                for _ in range(AGAIN):
                    there.ros.publish(f"{OUT}{device}", message)
                    time.sleep(0.1)
                got = there.listener.receive(device, "IMAGE")
            assert got.body.endswith(pixels), "other pixels"
            return text

        yield Row(f"6.2 MB IMAGE, {quality}", TO_ROS, EXACT), to_ros
        yield Row(f"6.2 MB IMAGE, {quality}", TO_IGTL, EXACT), to_igtl


def _early() -> Iterator[Trial]:
    def run(there: World) -> str:
        there.listener.send(packed("GET_STRING", "Early", b""))
        wire = there.listener.receive("Early", "STRING")
        assert wire.body == struct.pack(">HH", 3, len(EARLY)) + EARLY.encode(), wire
        return ""

    yield Row("transient local, to a late bridge", TO_IGTL, EXACT), run


def _late() -> Iterator[Trial]:
    """A reader that comes after the messages of topics that keep their last ones."""
    latched = {(name, row.kind) for row in CONVERSIONS if row.qos.latched for name in row.igtl_types}
    for case in CASES:
        for kind, (ros_type, wanted) in case.heard.items():
            if (case.type, kind) in latched:
                yield _to_late_node(case.topic(kind), ros_type, wanted)


def _to_late_node(topic: str, ros_type: str, wanted: Json) -> Trial:
    def run(there: World) -> str:
        there.ros.subscribe(topic, ros_type, latched=True)
        assert there.ros.receive(topic) == wanted
        return ""

    return Row("transient local, to a late node", TO_ROS, EXACT), run
