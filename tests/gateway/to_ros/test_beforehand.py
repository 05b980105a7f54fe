"""What is done before a message has its number: the same outputs, and others do not wait for it."""

from __future__ import annotations

import math
import threading
from collections.abc import Iterator
from dataclasses import replace
from itertools import count

import numpy as np
import pytest

from igtl_gateway.app.hub import Hub
from igtl_gateway.base.buffers import join
from igtl_gateway.base.clock import SystemClock
from igtl_gateway.base.stamp import NS_PER_S
from igtl_gateway.config.configuration import Config
from igtl_gateway.convert import surfaces
from igtl_gateway.gateway import Session
from igtl_gateway.gateway.fastpath import cache
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.note import Level, Note
from igtl_gateway.gateway.session import make_core
from igtl_gateway.gateway.to_ros import beforehand
from igtl_gateway.gateway.to_ros.beforehand import LONG
from igtl_gateway.wire import Message, encode
from igtl_gateway.wire.bind import Bind, BindChild
from igtl_gateway.wire.cost import AT_ONCE_NS, cost_ns
from igtl_gateway.wire.image import Image
from igtl_gateway.wire.message import Item
from igtl_gateway.wire.polydata import PolyData
from igtl_gateway_lab.simulate.every_igtl import contents
from tests.costly import TABLE, Costly
from tests.tables import table
from tests.timing import WAIT_S

T0_NS = 1_800_000_000 * NS_PER_S


def message(igtl_type: str, device: str, content: object, number: int = 0) -> bytes:
    """A message; odd ones are of header version 2, with metadata."""
    version, items = (2, (Item("note", b"n%d" % (number % 3)),)) if number % 2 else (1, ())
    ticks = (1_700_000_000 << 32) * (number % 4 > 1)
    return join(encode(Message(igtl_type, device, content, ticks, version, number, items)))  # type: ignore[arg-type]


def link_up(session: Session, link: int) -> None:
    note = Note(Level.INFO, "link_up", "up", data={"peer": f"127.0.0.1:{link}"})
    session.input(T0_NS, Kind.LINK, (note.pack(),), links=(link,))


def inputs() -> Iterator[tuple[int, bytes]]:
    """Every type of content four times from two links, with a wrong CRC and other contents in between."""
    numbers = count()
    for turn in range(4):
        for igtl_type, device, content in contents():
            number = next(numbers)
            data = message(igtl_type, device if number % 5 else "Shared", content, number // 3)
            yield 1 + turn % 2, data
            if number % 7 == 0:
                yield 1, data[:-1] + bytes([data[-1] ^ 1])


@pytest.mark.parametrize("takes_long", [False, True])
@pytest.mark.parametrize("with_subscribers", [False, True], ids=["recorded", "live"])
def test_outputs_are_those_of_the_full_path(
    with_subscribers: bool, takes_long: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also where the context has changed since the last message: other metadata, id, link, stamp."""
    if takes_long:
        monkeypatch.setattr(beforehand, "AT_ONCE_NS", 0)
    used = 0
    logs: list[list[Entry]] = []
    for early in (False, True):
        core = make_core(Config())
        if with_subscribers:
            core.has_subscriber = lambda topic, _type: "marker" not in topic
        session, log = Session(core), []
        for link in (1, 2):
            link_up(session, link)
        for step, (link, data) in enumerate(inputs()):
            prepared = session.prepare(Kind.IGTL_IN, data, "", "", (link,), 0) if early else None
            used += getattr(prepared, "made", 0)
            log += session.input(T0_NS + step * 1_000_000, Kind.IGTL_IN, (data,), links=(link,), prepared=prepared)
        logs.append(log)
    assert logs[0] == logs[1]
    assert used > len(LONG)  # not nothing


@table("row", TABLE, ids=lambda row: row.name)
@pytest.mark.parametrize("with_subscribers", [False, True], ids=["recorded", "live"])
def test_messages_unlike_the_compiled_stream_before_them(row: Costly, with_subscribers: bool) -> None:
    """A stream of small messages is compiled; a large one that follows is prepared for the way that it takes."""
    few, many = row.data(2), row.data(min(row.most, 4_000))
    logs: list[list[Entry]] = []
    for early in (False, True):
        core = make_core(Config())
        if with_subscribers:
            core.has_subscriber = lambda topic, _type: "marker" not in topic
        session, log = Session(core), []
        link_up(session, 1)
        for step, data in enumerate((few, few, many, many, few, many)):
            prepared = session.prepare(Kind.IGTL_IN, data, "", "", (1,), 0) if early else None
            if early and data is many and cost_ns(data) >= AT_ONCE_NS:
                assert prepared is not None
            log += session.input(T0_NS + step * 1_000_000, Kind.IGTL_IN, (data,), links=(1,), prepared=prepared)
        logs.append(log)
    assert len(logs[0]) == len(logs[1])
    for one, other in zip(*logs, strict=True):  # the bytes may come in two buffers
        assert replace(one, payload=(join(one.payload),)) == replace(other, payload=(join(other.payload),))


def parts_of_volumes() -> Iterator[bytes]:
    """Whole images and parts of them: in both byte orders, of several sizes, alone and two in a BIND."""
    size = (4, 3, 2)

    def image(first: tuple[int, int, int], of: tuple[int, int, int], number: int, endian: int = 1) -> Image:
        pixels = (np.arange(math.prod(of)) + 100 * number).astype(">u2" if endian == 1 else "<u2")
        return Image(size, 5, pixels.tobytes(), 1, endian, subvol_offset=first, subvol_size=of)

    row = (4, 1, 1)
    yield message("IMAGE", "Scan", image((0, 0, 0), row, 1))  # a part before the whole
    for number in range(2, 8):
        yield message("IMAGE", "Scan", image((0, 0, 0), size, number) if number % 3 else Image((2, 2, 1), 3, b"abcd"))
        for endian in (1, 2):
            yield message("IMAGE", "Scan", image((0, endian, number % 2), row, 10 * number, endian))
        two = [image((0, 0, 1), row, number), image((0, 2, 0), row, number)]
        children = [BindChild("IMAGE", "Scan", join(one.pack())) for one in two]
        yield message("BIND", "Both", Bind(tuple(children)))
    for number, rows in enumerate(([(0, 1), (1, 2)], [(0, 2), (0, 2), (2, 1)], [(0, 3), (1, 2), (0, 1)]), 20):
        for layer in range(2):  # complete with its last part, which may overlap others
            for endian, (first, many) in enumerate(rows):
                yield message("IMAGE", f"Built{number}", image((0, first, layer), (4, many, 1), number, 1 + endian % 2))


def test_a_part_of_a_volume_makes_the_whole_before_its_turn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Also where the volume has changed since, and the whole is made again."""
    for module in (beforehand, cache):
        monkeypatch.setattr(module, "AT_ONCE_NS", 0)
    logs, used = [], 0
    for ahead in (None, 0, 1):  # not prepared; at its turn; while the message before it is not handled yet
        session, log = Session(make_core(Config())), []
        link_up(session, 1)
        data = list(parts_of_volumes())
        made = {}
        for step, one in enumerate(data):
            if ahead is not None:
                for early in range(step, min(step + ahead + 1, len(data))):
                    if early not in made:
                        made[early] = session.prepare(Kind.IGTL_IN, data[early], "", "", (1,), 0)
            prepared = made.get(step)
            used += sum(bool(piece.volume) for piece in getattr(prepared, "pieces", {}).values())
            log += session.input(T0_NS + step * 1_000_000, Kind.IGTL_IN, (one,), links=(1,), prepared=prepared)
        logs.append([replace(entry, payload=(join(entry.payload),)) for entry in log])
    assert logs[0] == logs[1] == logs[2]
    assert used > 10


def test_results_for_another_message_are_not_used() -> None:
    one, other, *_ = (
        message("POLYDATA", device, content) for igtl_type, device, content in contents() if igtl_type == "POLYDATA"
    )
    logs = []
    for early in (False, True):
        session = Session(make_core(Config()))
        link_up(session, 1)
        prepared = session.prepare(Kind.IGTL_IN, one, "", "", (1,), 0) if early else None
        logs.append(session.input(T0_NS, Kind.IGTL_IN, (other,), links=(1,), prepared=prepared))
    assert logs[0] == logs[1]


def test_a_pose_does_not_wait_for_the_surface_of_another_peer(monkeypatch: pytest.MonkeyPatch) -> None:
    """Before, a surface had the sequence lock until it was converted."""
    log: list[Entry] = []
    hub = Hub(Session(make_core(Config())), SystemClock(), [log.append])
    for link in (1, 2):
        hub.link(link, Note(Level.INFO, "link_up", "up", data={"peer": f"127.0.0.1:{link}"}))
    kinds = {igtl_type: (device, content) for igtl_type, device, content in reversed(list(contents()))}
    surface, pose = (message(name, *kinds[name]) for name in ("POLYDATA", "TRANSFORM"))
    hub.igtl(1, surface)  # the first one opens its streams
    begun, go_on, triangles = threading.Event(), threading.Event(), surfaces._triangles

    def waits(content: PolyData) -> object:
        begun.set()
        assert go_on.wait(WAIT_S)
        return triangles(content)

    monkeypatch.setattr(surfaces, "_triangles", waits)
    sending = threading.Thread(target=hub.igtl, args=(1, surface))
    sending.start()
    assert begun.wait(WAIT_S)
    passing = threading.Thread(target=hub.igtl, args=(2, pose))
    passing.start()
    passing.join(WAIT_S / 4)
    has_passed = not passing.is_alive()
    go_on.set()
    for thread in (sending, passing):
        thread.join(WAIT_S)
    assert has_passed
    types = [entry.type for entry in log if entry.kind is Kind.IGTL_IN]
    assert types == ["POLYDATA", "TRANSFORM", "POLYDATA"]
