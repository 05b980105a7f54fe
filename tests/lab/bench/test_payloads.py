"""The measured messages: their numbers go through the gateway's own conversions unharmed, both ways."""

from __future__ import annotations

import numpy as np
import pytest

from igtl_gateway.config.configuration import Config, ToIgtlRow
from igtl_gateway.gateway.log.entry import Kind
from igtl_gateway.wire import decode
from igtl_gateway.wire.header import TICKS_AT
from igtl_gateway_lab.bench.cases import PAYLOADS, SLICER, BenchStream, Direction, payload
from tests.script import Script
from tests.tables import table

#: Those of tens of megabytes differ from their smaller kin in nothing but size.
KINDS = [kind for kind in PAYLOADS if kind not in ("image-4k", "image-hd", "image-xga")]


def script(kind: str) -> Script:
    stream, way = BenchStream(kind, 30.0), Direction.ROS_TO_IGTL
    row = ToIgtlRow(topic=stream.topic(way), device=stream.device(way), type=payload(kind).igtl_type)
    made = Script(Config(to_igtl=(row,)))
    made.up(1)
    return made


@table("kind", KINDS)
def test_the_number_goes_to_openigtlink(kind: str) -> None:
    made, gateway = payload(kind), script(kind)
    make, topic = made.ros_maker(), BenchStream(kind, 30.0).topic(Direction.ROS_TO_IGTL)
    for number in (0, 1, 4_321):
        gateway.feed(Kind.ROS_IN, (bytes(make(number)),), topic, made.ros_type)
        (frame,) = [entry.data() for entry in gateway.last if entry.kind is Kind.IGTL_OUT]
        assert made.forms[1].number(frame) == number
        assert decode(frame).device_name == BenchStream(kind, 30.0).device(Direction.ROS_TO_IGTL)


@table("kind", KINDS)
def test_the_number_goes_to_ros(kind: str) -> None:
    made, gateway = payload(kind), script(kind)
    stream = BenchStream(kind, 30.0)
    make, topic = made.igtl_maker(stream.device(Direction.IGTL_TO_ROS)), stream.topic(Direction.IGTL_TO_ROS)
    for number in (0, 1, 4_321):
        gateway.feed(Kind.IGTL_IN, (bytes(make(number)),), link=1)
        (entry,) = [entry for entry in gateway.last if entry.kind is Kind.ROS_OUT and entry.channel == topic]
        assert entry.type == made.ros_type
        assert made.forms[0].number(entry.data()) == number


@table("kind", [kind for kind in KINDS if kind.endswith("-n")])
def test_a_bridge_that_keeps_no_stamp_keeps_the_number(kind: str) -> None:
    made = payload(kind)
    for form, message, stamp in (
        (made.forms[0], made.ros_maker()(4_321), slice(4, 12)),
        (made.forms[1], made.igtl_maker("Tool")(4_321), slice(TICKS_AT, TICKS_AT + 8)),
    ):
        changed = bytearray(message)
        assert not any(changed[stamp])
        changed[stamp] = bytes(range(1, 9))
        assert form.number(changed) == 4_321


@table("kind", KINDS)
def test_both_sides_say_the_same(kind: str) -> None:
    # else the sizes of the floor would not be those of what goes through the gateway
    made, gateway = payload(kind), script(kind)
    device = BenchStream(kind, 30.0).device(Direction.ROS_TO_IGTL)
    topic = BenchStream(kind, 30.0).topic(Direction.ROS_TO_IGTL)
    gateway.feed(Kind.ROS_IN, (bytes(made.ros_maker()(7)),), topic, made.ros_type)
    (frame,) = [entry.data() for entry in gateway.last if entry.kind is Kind.IGTL_OUT]
    assert len(frame) == len(made.igtl_maker(device)(7))


@table("kind", [kind for kind in SLICER.values() if "fullhd" not in kind])
def test_what_slicer_sends_goes_to_ros_with_its_number(kind: str) -> None:
    made, stream = payload(kind), BenchStream(kind, 30.0)
    gateway = Script(Config().watched())
    gateway.up(1)
    make, topic = made.igtl_maker(stream.device(Direction.IGTL_TO_ROS)), stream.topic(Direction.IGTL_TO_ROS)
    for number in (0, 1, 4_321):
        message = decode(make(number))
        assert message.message_id == number and not message.ticks and len(message.metadata) == 4
        gateway.feed(Kind.IGTL_IN, (bytes(make(number)),), link=1)
        (entry,) = [entry for entry in gateway.last if entry.kind is Kind.ROS_OUT and entry.channel == topic]
        assert made.forms[0].number(entry.data()) == number == made.forms[1].number(make(number))
        beside = {entry.type.rpartition("/")[2] for entry in gateway.last if entry.kind is Kind.ROS_OUT}
        assert beside & {"Metadata", "Volume", "PointList"}, "what contains the metadata"


@pytest.mark.parametrize("kind", ["transform", "string-100", "points-10", "image-vga"])
def test_a_batch_is_messages_one_behind_the_other(kind: str) -> None:
    made = payload(kind)
    most, batch = made.igtl_batch("Device")
    count = min(most, 5)
    one = [bytes(made.igtl_maker("Device")(number)) for number in range(7, 7 + count)]
    assert bytes(batch(7, count)) == b"".join(one)
    _, form = made.forms
    rows = np.frombuffer(b"".join(message[form.at : form.at + form.size] for message in one), np.uint8)
    assert list(form.numbers(rows.reshape(count, form.size))) == list(range(7, 7 + count))
