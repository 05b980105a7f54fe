"""From decoded messages to ROS: what is published without a conversion, and what waits for a first subscriber."""

from __future__ import annotations

import numpy as np
import pytest

from igtl_gateway.base.buffers import join
from igtl_gateway.config.configuration import Config
from igtl_gateway.convert import express
from igtl_gateway.convert.igtl_msgs import Metadata, RawMessage
from igtl_gateway.convert.rosmsg import Mesh
from igtl_gateway.gateway import LISTENED
from igtl_gateway.gateway.log.entry import Kind
from igtl_gateway.gateway.log.note import Level, Note
from igtl_gateway.gateway.to_ros import convert
from igtl_gateway.wire import HEADER_SIZE, Item, Message, Raw, encode
from igtl_gateway.wire.cost import AT_ONCE_NS, cost_ns
from igtl_gateway.wire.polydata import Cells, PolyData
from igtl_gateway.wire.transform import Transform
from tests.costly import TABLE
from tests.script import Script

POSE = Transform((1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 1.0, 2.0, 3.0))


def surface(number: int) -> bytes:
    places = np.arange(9, dtype=">f4").reshape(3, 3) + number
    return join(encode(Message("POLYDATA", "B", PolyData(places, polygons=Cells.of([[0, 1, 2]])))))


def listened(script: Script, topic: str) -> list[str]:
    return script.feed(Kind.EDGE_NOTE, (Note(Level.INFO, LISTENED, "", topic).pack(),))


def test_a_hundred_messages_of_any_type_and_of_metadata_wait_for_a_slow_subscriber() -> None:
    """They come from many devices on one topic, so the ten of one stream would be too few."""
    script = Script()
    script.up(1)
    script.igtl(Message("OWN_TYPE", "A", Raw(b"abc")))
    script.igtl(Message("TRANSFORM", "A", POSE, 0, 2, 0, (Item("key", b"value"),)))
    found = {
        (entry.type, qos.depth)
        for entry in script.log
        if entry.kind is Kind.ROS_OUT and entry.type in (RawMessage.TYPE, Metadata.TYPE)
        for qos in [script.gateway.qos(entry.channel)]
        if qos
    }
    assert found == {(RawMessage.TYPE, 100), (Metadata.TYPE, 100)}


@pytest.mark.skipif(not express.COMPILED, reason="installed without the C part")
@pytest.mark.parametrize("check_crc", [True, False])
def test_the_last_surface_reaches_a_first_subscriber_with_the_crc_that_it_came_with(check_crc: bool) -> None:
    """Without the check a message with another CRC passed, and it passes when it is built later."""
    script = Script(Config(check_crc=check_crc))
    script.gateway.has_subscriber = lambda topic, _type: topic.endswith("/marker")
    script.up(1)
    for number in range(5):
        data = bytearray(surface(number))
        if number == 4:
            data[HEADER_SIZE - 1] ^= 1
        script.igtl(bytes(data))
    assert listened(script, "/igtl/in/B/mesh") == ["ros /igtl/in/B/mesh"]
    mesh = Mesh.unpack(script.published("/igtl/in/B/mesh"))
    last = 3 if check_crc else 4
    np.testing.assert_allclose(mesh.vertices.ravel(), (np.arange(9.0) + last) / 1000, rtol=1e-6)


@pytest.mark.parametrize("row", TABLE, ids=lambda row: row.name)
def test_what_was_converted_before_the_lock_is_not_converted_under_it(
    row: object, monkeypatch: pytest.MonkeyPatch
) -> None:
    data = row.data(min(row.most, 4_000))  # type: ignore[attr-defined]
    counts: list[int] = []
    converted = convert._converted
    for early in (False, True):
        script, calls = Script(), list[object]()

        def counted(one: object, content: object, to: object, calls: list[object] = calls) -> object:
            calls.append(one)
            return converted(one, content, to)  # type: ignore[arg-type]

        monkeypatch.setattr(convert, "_converted", counted)
        script.up(1)
        prepared = script.session.prepare(Kind.IGTL_IN, data, "", "", (1,), 0) if early else None
        entries = script.session.input(script.now_ns + 1, Kind.IGTL_IN, (data,), links=(1,), prepared=prepared)
        assert any(entry.kind is Kind.ROS_OUT for entry in entries)
        counts.append(len(calls))
    takes_long = cost_ns(data) >= AT_ONCE_NS
    assert counts[1] < counts[0] if takes_long and counts[0] else counts[1] <= counts[0]
