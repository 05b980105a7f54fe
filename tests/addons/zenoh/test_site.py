"""Two sites, each with a router, joined: priorities, budget, clocks and latencies."""

from __future__ import annotations

import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack
from typing import Any

import pytest

from igtl_gateway.addons.zenoh import site as sites_module
from igtl_gateway.addons.zenoh.edge import ZenohEdge
from igtl_gateway.addons.zenoh.traffic import CLASSES, Traffic
from igtl_gateway.base.clock import SystemClock
from igtl_gateway.base.qos import Qos
from igtl_gateway.base.stamp import NS_PER_S
from igtl_gateway.convert.rosmsg import Image, String
from tests.addons.zenoh.routers import free_port, router
from tests.addons.zenoh.test_edge import Side

PICTURE = b"\x00\x01\x00\x00" + bytes(50_000)


class Shifted(SystemClock):
    """A clock that is ahead."""

    def utc_ns(self) -> int:
        return super().utc_ns() + 5 * NS_PER_S


class SiteSide(Side):
    """A gateway of a site."""

    def __init__(self, port: int, name: str, topics: tuple[str, ...] = (), traffic: Traffic | None = None) -> None:
        super().__init__(port, topics, name=name)
        self.edge = ZenohEdge(
            node_name=name,
            on_message=lambda *message: self._add(self.messages, message),
            wants=lambda topic, _type: Qos(100) if topic in topics else None,
            on_note=lambda note: self._add(self.notes, note),
            endpoint=f"tcp/127.0.0.1:{port}",
            site=name,
            traffic=traffic or Traffic(),
        )

    def data(self, code: str) -> dict[str, Any]:
        return next(note.data for note in self.notes if note.code == code)


@pytest.fixture
def routers(monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[int, int]]:
    monkeypatch.setenv("ROS_DOMAIN_ID", "11")
    monkeypatch.setattr(sites_module, "ASK_NS", NS_PER_S // 4)
    monkeypatch.setattr(sites_module, "NOTE_NS", NS_PER_S)
    one, two = free_port(), free_port()
    with router(one), router(two, connect__endpoints=[f"tcp/127.0.0.1:{one}"]):
        yield one, two


def test_two_sites(routers: tuple[int, int], monkeypatch: pytest.MonkeyPatch) -> None:
    traffic = Traffic(bytes_per_s=200_000)
    with ExitStack() as stack:
        or1 = SiteSide(routers[0], "or1", traffic=traffic)
        monkeypatch.setattr("igtl_gateway.addons.zenoh.edge.SystemClock", Shifted)
        planning = SiteSide(routers[1], "planning", ("/said", "/picture"))
        for side in (or1, planning):
            stack.callback(side.edge.stop)
            side.edge.start()
        for topic, kind in (("/said", String.TYPE), ("/picture", Image.TYPE)):
            or1.edge.advertise(topic, kind, Qos(10))
        or1.wait(lambda: all(or1.edge.subscriber_count(topic) for topic in ("/said", "/picture")))
        for number in range(40):
            or1.edge.publish("/picture", Image.TYPE, PICTURE, Qos(10))
            or1.edge.publish("/said", String.TYPE, String(str(number)).pack(), Qos(10))
        planning.wait(lambda: sum(topic == "/said" for topic, *_ in planning.messages) == 40)
        counts = or1.edge.counters()
        assert counts["/said"]["published"] == 40
        assert 0 < counts["/picture"]["published"] < 5
        assert counts["/picture"]["published"] + counts["/picture"]["over_budget"] == 40
        or1.wait_code("site_over_budget")
        for _ in range(3):
            or1.edge.publish("/latched", Image.TYPE, PICTURE, Qos(1, latched=True))
        assert or1.edge.counters()["/latched"]["published"] == 3
        for side, ahead_s in ((or1, 5), (planning, -5)):
            side.wait_code("site_clock")
            found = side.data("site_clock")
            assert abs(found["offset_s"] - ahead_s) <= found["error_s"] < 1
        planning.wait_code("site_latency")
        found = planning.data("site_latency")
        assert found["site"] == "or1"
        assert -found["error_ms"] <= found["min_ms"] <= found["p50_ms"] < 2000
        or1.edge.stop()
        planning.wait_code("site_lost")


@pytest.mark.slow
def test_a_dead_line_keeps_neither_the_caller_nor_the_stop(monkeypatch: pytest.MonkeyPatch) -> None:
    """The router is stopped (SIGSTOP): it reads no more, and no connection ends."""
    monkeypatch.setenv("ROS_DOMAIN_ID", "11")
    monkeypatch.setattr("igtl_gateway.addons.zenoh.waiting.LATE_NS", NS_PER_S // 10)
    monkeypatch.setattr("igtl_gateway.addons.zenoh.waiting.MOST", 8)
    monkeypatch.setattr("igtl_gateway.addons.zenoh.waiting._STOP_S", 0.2)
    monkeypatch.setattr("igtl_gateway.addons.zenoh.connection.CLOSE_S", 0.5)
    port, now_ns = free_port(), SystemClock().monotonic_ns
    command = [sys.executable, "-m", "igtl_gateway", "zenoh-router", "--listen", f"tcp/127.0.0.1:{port}"]
    topics = {"/said": (String.TYPE, String("x").pack()), "/picture": (Image.TYPE, PICTURE * 20)}
    with subprocess.Popen(command, stdout=subprocess.PIPE) as program, ExitStack() as stack:
        stack.callback(program.kill)
        assert program.stdout is not None
        program.stdout.readline()
        or1, planning = SiteSide(port, "or1"), SiteSide(port, "planning", tuple(topics))
        for side in (or1, planning):
            stack.callback(side.edge.stop)
            side.edge.start()
        for topic, (kind, _) in topics.items():
            or1.edge.advertise(topic, kind, Qos(10))
        or1.wait(lambda: all(or1.edge.subscriber_count(topic) for topic in topics))
        program.send_signal(signal.SIGSTOP)
        begun_ns, sent = now_ns(), 0
        while or1.edge.counters()["/said"]["failed"] == 0:
            for topic, (kind, cdr) in topics.items():
                called_ns = now_ns()
                or1.edge.publish(topic, kind, cdr, Qos(10))
                assert now_ns() - called_ns < NS_PER_S  # in Zenoh it would be 5 s
            sent += 1
            assert now_ns() - begun_ns < 20 * NS_PER_S
        begun_ns = now_ns()
        or1.edge.stop()
        assert now_ns() - begun_ns < 4 * NS_PER_S
        program.kill()
    found = or1.edge.counters()["/said"]
    assert found["held"] == 0
    assert found["published"] + found["failed"] + found["unheard"] in (sent, sent - 1)  # one may still be in Zenoh
    assert {"site_command_late", "zenoh_not_closed"} <= set(or1.codes())


def test_classes_and_budget() -> None:
    traffic = Traffic(["/video/**=poses", "/said=pictures"], bytes_per_s=1000)
    assert traffic.class_of("/video/left", Image.TYPE) is CLASSES["poses"]
    assert traffic.class_of("/said", String.TYPE) is CLASSES["pictures"]
    assert traffic.class_of("/x", "unknown/msg/Type") is CLASSES["data"]
    pictures, data, poses = (CLASSES[name] for name in ("pictures", "data", "poses"))
    now_ns = 10 * NS_PER_S
    assert traffic.admits(pictures, 400, now_ns)  # more than is saved up: once
    assert not traffic.admits(pictures, 1, now_ns)
    assert traffic.admits(data, 400, now_ns)
    assert not traffic.admits(data, 1, now_ns)
    assert all(traffic.admits(poses, 1000, now_ns) for _ in range(3))
    assert not traffic.admits(pictures, 1, now_ns + NS_PER_S)
    assert traffic.admits(pictures, 1, now_ns + 4 * NS_PER_S)
