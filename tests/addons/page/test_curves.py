"""Numbers of a running bridge: what is kept of its messages, and what it costs when a browser looks, or none does."""

from __future__ import annotations

import base64
import math
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

import igtl_gateway
from igtl_gateway.addon.igtl import Image, Message, Transform, encode
from igtl_gateway.addons.page import curves, live, live_numbers
from igtl_gateway.addons.page.curves import Curves
from igtl_gateway.addons.page.live import BridgePage
from igtl_gateway.addons.page.live_numbers import LiveNumbers
from igtl_gateway.addons.page.source import BridgeSource
from igtl_gateway.app.bridge_options import BridgeOptions
from igtl_gateway.base.clock import SystemClock
from igtl_gateway.cli.bridge_session import BridgeSession
from igtl_gateway.config.configuration import Config
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.wire.text import String
from tests.addons.page.test_live import wait
from tests.integration.bridge import RawPeer

#: Streams of a bridge without ROS to which a peer sends poses, and a field of each that grows.
_STREAMS = ((("igtl_in", "TRANSFORM/Tool"), "x_mm"), (("ros_out", "/tf"), "Tool.transform.translation.x_m"))
_POSE = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)


def _pose(device: str, x_mm: float) -> bytes:
    return b"".join(encode(Message("TRANSFORM", device, Transform((*_POSE, x_mm, 20.0, 30.0)), 0, 1, 0, ())))


def _found(*messages: tuple[int, bytes], **more: Any) -> dict[str, Any]:
    rows = [(at_ns, base64.b64encode(data).decode()) for at_ns, data in messages]
    return {"messages": rows, "type": "TRANSFORM", "unit": "mm", "crc": True, "now_ns": 10**9, "problem": "", **more}


def test_a_curve_is_the_last_minute_of_a_field() -> None:
    takes: list[dict[str, Any]] = [
        _found((10**9, _pose("Tool", 1.0)), (2 * 10**9, _pose("Tool", 2.0)), now_ns=3 * 10**9),
        _found((4 * 10**9, b"no message"), now_ns=4 * 10**9),
        _found((62 * 10**9, _pose("Tool", math.nan)), unit="m", now_ns=62 * 10**9),
        {"messages": [], "problem": "the bridge does not answer"},
    ]
    found = Curves(lambda *_: takes.pop(0))
    first = found.read("igtl_in", "TRANSFORM/Tool", "")
    assert (first["field"], first["times"], first["values"]) == ("x_mm", [-2.0, -1.0], [1.0, 2.0])
    assert first["fields"][:4] == ["x_mm", "y_mm", "z_mm", "qx"] and "problem" not in first
    other = found.read("igtl_in", "TRANSFORM/Tool", "z_mm")
    assert other["values"] == [30.0, 30.0] and "expected" in other["problem"]
    last = found.read("igtl_in", "TRANSFORM/Tool", "x_mm")
    assert (last["times"], last["values"]) == ([-60.0, 0.0], [2.0, None])
    lost = found.read("igtl_in", "TRANSFORM/Tool", "x_mm")
    assert lost["problem"] == "the bridge does not answer" and lost["values"] == [2.0, None]


def test_memory_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(curves, "MAX_POINTS", 5)
    poses = [(10**9 + number, _pose("Tool", number)) for number in range(9)]
    found = Curves(lambda *_: _found(*poses))
    for number in range(9):
        read = found.read("igtl_in", f"TRANSFORM/{number}", "")
    assert read["values"] == [4.0, 5.0, 6.0, 7.0, 8.0] and len(found._curves) == live_numbers.MAX_STREAMS

    gateway = SimpleNamespace(
        config=SimpleNamespace(check_crc=True), ledger=SimpleNamespace(totals=dict[str, dict[str, int]])
    )
    bridge: Any = SimpleNamespace(hub=SimpleNamespace(now_ns=time.time_ns), gateway=gateway, show=lambda *_: None)
    numbers = LiveNumbers({})
    monkeypatch.setattr(live_numbers, "_EVERY_NS", 0)
    monkeypatch.setattr(LiveNumbers, "_run", lambda _: None)
    for number in range(9):
        numbers.take(bridge, "ros_in", f"/{number}")
    assert list(numbers._looks) == [("ros_in", f"/{number}") for number in range(5, 9)]
    for number in range(999):
        entry = Entry(number, number, Kind.ROS_IN, "/8", "std_msgs/msg/String", (b"x",), (), 0)
        if copy := numbers(entry):
            copy()
    assert numbers(Entry(1, 1, Kind.ROS_IN, "/7", "x", (bytes(live_numbers._MAX_BYTES + 1),), (), 0)) is None
    kept = numbers.take(bridge, "ros_in", "/8")["messages"]
    assert len(kept) == live_numbers._MAX_MESSAGES and kept[-1][0] == 998
    assert "8 MiB" in numbers.take(bridge, "ros_in", "/7")["problem"]
    assert "no numbers" in numbers.take(bridge, "note", "x")["problem"]


@contextmanager
def _session(path: Path, seen: list[str], *, native: bool) -> Iterator[tuple[Any, BridgePage, BridgeSource]]:
    """A bridge as the verb has it, with its page; ``seen``: channels of what Python passes."""
    page = BridgePage(("127.0.0.1", 0), (), None, None, lambda: None, lambda *_: None)
    sink = page.pictures

    class Seen:
        def pictures(self, entry: Entry) -> Any:
            seen.append(entry.channel)
            return sink(entry)

    options = BridgeOptions(listen=(("127.0.0.1", 0),), ros=False, record=path, native=native)
    session = BridgeSession(Config(), options, SystemClock(), page=Seen())  # type: ignore[arg-type]
    session.start()
    try:
        page.update(session)
        yield session.bridge, page, BridgeSource(f"http://{page._server.address}", page._token)
    finally:
        session.stop()
        page.close()


@pytest.mark.parametrize("native", [True, False])
def test_a_running_bridge_has_the_numbers_of_what_arrives(native: bool, tmp_path: Path) -> None:
    """What is looked at passes through Python now and then; without a browser, all of it passes natively again."""
    seen: list[str] = []
    with (
        _session(tmp_path / "a.mcap", seen, native=native) as (bridge, page, source),
        RawPeer(bridge.addresses[0][1]) as peer,
    ):
        if native and bridge.native_off:
            pytest.skip(bridge.native_off)
        count, numbers, read = 0, page.pictures.numbers, dict[str, Any]()

        def received() -> int:
            bridge.collect()
            return int(bridge.gateway.ledger.totals().get("igtl_in", {}).get("TRANSFORM/Tool", 0))

        def send(messages: int) -> int:
            """Send messages; return how many entries Python saw of them."""
            nonlocal count
            before = len(seen)
            for _ in range(messages):
                count += 1
                peer.send(_pose("Tool", float(count)))
            wait(lambda: received() >= count)
            return len(seen) - before

        def is_shown(key: tuple[str, str], field: str) -> bool:
            nonlocal read
            send(1)
            time.sleep(0.01)
            read = found.read(*key, field)
            return sum(value is not None for value in read["values"]) >= 4

        found = Curves(source.numbers)
        send(300)
        assert (send(200) < 20) is native
        for key, field in _STREAMS:
            wait(partial(is_shown, key, field))
            assert read["values"] == sorted(read["values"]), key
            assert read["values"][-1] <= count * 1.0 and "problem" not in read
            assert all(-60 <= each <= 0 for each in read["times"])
        looked = send(200)
        assert numbers._looks and numbers._runs
        numbers._looks = {}  # as some seconds after the last browser
        wait(lambda: not numbers._runs)
        send(20)
        assert (send(200) < 20) is native, f"{looked} while a browser looked"
    assert igtl_gateway.verify(tmp_path / "a.mcap").good


@pytest.mark.parametrize("native", [True, False])
def test_the_pictures_of_a_running_bridge_follow_while_a_browser_takes_them(
    native: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The next picture passes through Python once a browser has the last one; without a browser, all pass natively."""
    monkeypatch.setattr(live, "_PICTURE_NS", 10**6)
    seen: list[str] = []
    with (
        _session(tmp_path / "a.mcap", seen, native=native) as (bridge, page, source),
        RawPeer(bridge.addresses[0][1]) as peer,
    ):
        if native and bridge.native_off:
            pytest.skip(bridge.native_off)
        count = 0

        def received() -> int:
            bridge.collect()
            return int(bridge.gateway.ledger.totals().get("igtl_in", {}).get("IMAGE/Cam", 0))

        def send(messages: int) -> int:
            """Send pictures while the page asks for facts; return how many entries Python saw of them."""
            nonlocal count
            before = len(seen)
            for _ in range(messages):
                count += 1
                image = Image((80, 60, 1), 3, bytes([count % 256]) * 4_800, 1)
                peer.send(b"".join(encode(Message("IMAGE", "Cam", image, 0, 1, 0, ()))))
                page.facts()
            wait(lambda: received() >= count)
            return len(seen) - before

        def is_new(old: bytes) -> bool:
            send(1)
            return source.picture("igtl_in", "IMAGE/Cam") != old

        wait(partial(is_new, b""))
        send(100)
        for _ in range(3):
            old = source.picture("igtl_in", "IMAGE/Cam")
            assert old[58 + 72 :] == bytes([old[-1]]) * 4_800
            wait(partial(is_new, old))
        send(5)
        assert (send(100) < 20) is native  # no browser takes a picture
    assert igtl_gateway.verify(tmp_path / "a.mcap").good


def test_pictures_without_a_small_one_are_not_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live, "_MAX_PICTURE", 100)
    pictures, totals = live.Pictures(), {"igtl_in": ["IMAGE/Large", "IMAGE/Small", "STRING/Log"], "igtl_out": []}
    assert pictures.names() == []
    assert pictures.wanted(totals) == [(Kind.IGTL_IN, "IMAGE/Large"), (Kind.IGTL_IN, "IMAGE/Small")]
    assert pictures(Entry(1, 1, Kind.IGTL_IN, "IMAGE/Large", "IMAGE", (bytes(101),), (), 0)) is None
    assert pictures.wanted(totals) == [(Kind.IGTL_IN, "IMAGE/Small")]
    copy = pictures(Entry(2, 2, Kind.IGTL_IN, "IMAGE/Small", "IMAGE", (b"x",), (), 0))
    assert copy
    copy()
    assert pictures.wanted(totals) == []  # nothing has taken it


def test_a_text_has_no_numbers() -> None:
    text = b"".join(encode(Message("STRING", "Log", String(b"x"), 0, 1, 0, ())))
    found = Curves(lambda *_: _found((10**9, text), type="STRING")).read("igtl_in", "STRING/Log", "")
    assert found["field"] in ("", "encoding") and len(found["times"]) == 1
