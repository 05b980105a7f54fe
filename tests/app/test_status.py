"""Samples of a bridge: rates over the last seconds, on manual time."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field

import pytest

from igtl_gateway.app.bridge import Bridge
from igtl_gateway.app.bridge_options import BridgeOptions
from igtl_gateway.app.status import BridgeStatus, clock_of
from igtl_gateway.base.clock import ManualClock
from igtl_gateway.base.stamp import NS_PER_MS, NS_PER_S, ns_to_ticks
from igtl_gateway.config.configuration import Config
from igtl_gateway.gateway.log.entry import Kind
from igtl_gateway.gateway.log.rates import RATES_OVER_S
from igtl_gateway.gateway.log.timing import StampTiming
from igtl_gateway.wire import Message
from igtl_gateway.wire.transform import Transform
from tests.gateway.dialogue.test_clocks import Asked


@dataclass
class Watch:
    counts: Counter[Kind] = field(default_factory=Counter)
    refused: int = 0


def test_rates_are_of_the_last_seconds() -> None:
    clock, watch = ManualClock(1_767_225_600 * NS_PER_S), Watch()
    bridge = Bridge(Config(), BridgeOptions(ros=False), clock)
    status = BridgeStatus(bridge, watch, clock)
    ledger = bridge.gateway.ledger
    rates = []
    for second in range(16):
        status.sample()
        rates.append(status.facts["rates"].get("igtl_in", {}).get("STRING/A", 0.0))
        busy = second < 8
        ledger.count("igtl_in", "STRING/A", "received", 100 if busy else 0)
        watch.counts[Kind.IGTL_IN] += 100 if busy else 0
        clock.advance(NS_PER_S)
    assert rates[:9] == [0.0, *[100.0] * 8]
    assert rates[8:14] == [100.0, 80.0, 60.0, 40.0, 20.0, 0.0]
    assert status.facts["rates"]["over_s"] == RATES_OVER_S
    assert status.facts["rates"]["entries"]["igtl_in"] == 0
    assert status.facts["entries"]["igtl_in"] == 800
    assert status.facts["uptime_s"] == 15
    assert status.facts["time"] == "2026-01-01T00:00:15.000000000Z"
    assert status.facts["recorder"] is None
    bridge.stop()


def test_a_defect_of_the_status_is_told_and_ends_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = ManualClock(NS_PER_S)
    bridge = Bridge(Config(), BridgeOptions(ros=False), clock)
    status = BridgeStatus(bridge, Watch(), clock)
    status.sample()
    whole = status.facts
    with monkeypatch.context() as broken:
        broken.delattr(bridge, "tcp")
        status.sample()
        assert status.failure.startswith("AttributeError")
        assert status.facts == {**whole, "failure": status.failure}
    status.sample()
    assert status.facts == whole
    assert status.failure == ""
    bridge.stop()


def test_the_clock_of_a_peer_is_known_by_its_answers_else_by_its_stamps_from_below() -> None:
    asked = Asked(3 * NS_PER_S)
    core, link = asked.gateway._gateway, asked.link
    assert clock_of(core, link, asked.gateway.now_ns) is None
    matrix = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
    for age_ms in (9, 4, 7):
        ticks = ns_to_ticks(asked.gateway.now_ns + asked.offset_ns - age_ms * NS_PER_MS)
        asked.gateway.from_peer(Message("TRANSFORM", "Probe", Transform(matrix), ticks), link)
        asked.gateway.advance(1)
    one_way = clock_of(core, link, asked.gateway.now_ns)
    assert one_way and (one_way["low_ns"], one_way["high_ns"]) == (3 * NS_PER_S - 4 * NS_PER_MS, None)
    assert one_way["text"] == "clock ahead by ≥ +2,996.000 ms, by its stamps"
    asked.exchange()
    two_way = clock_of(core, link, asked.gateway.now_ns)
    assert two_way and two_way.keys() == one_way.keys() and two_way["method"] == "two-way"
    assert two_way["low_ns"] <= 3 * NS_PER_S <= two_way["high_ns"]


def test_a_lower_bound_is_of_the_last_seconds() -> None:
    timing, found = StampTiming(), list[int | None]()
    found.append(timing.ahead_ns)
    for second in range(100):
        timing.add(10**18 + second * NS_PER_S, 10**18 + second * NS_PER_S + second * NS_PER_MS)
    found.append(timing.ahead_ns)
    timing.add(10**18 + 10_000 * NS_PER_S, 10**18 + 10_000 * NS_PER_S + 500 * NS_PER_MS)
    found.append(timing.ahead_ns)  # hours later
    timing.reset()
    assert [*found, timing.ahead_ns] == [None, -80 * NS_PER_MS, -500 * NS_PER_MS, None]
