"""Faults on manual time: the same for the same seed, as often as asked, and nothing invented."""

from __future__ import annotations

from collections import Counter
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from igtl_gateway.base.buffers import join
from igtl_gateway.base.errors import ChecksumMismatch, ConfigError
from igtl_gateway.base.stamp import NS_PER_MS, NS_PER_S, ticks_to_ns
from igtl_gateway.config.faults import (
    CLOCK_STEP,
    CORRUPT,
    DISCONNECT,
    EARLY,
    FAULTS,
    LOSS,
    OVERTAKEN_WITHIN_NS,
    REORDER,
    TRUNCATE,
    Fate,
    FaultLine,
    Faults,
    RelayFaults,
    Unit,
)
from igtl_gateway.gateway.stamps import moved
from igtl_gateway.wire import Message, decode, encode
from igtl_gateway.wire.message import Item
from igtl_gateway.wire.text import String
from tests.places import ROOT
from tests.tables import table

#: 2026-01-01T00:00:00Z, and a message every ten milliseconds.
T0_NS, STEP_NS = 1_767_225_600 * NS_PER_S, 10 * NS_PER_MS
MANY = 5000


def text(number: int) -> bytes:
    return join(encode(Message("STRING", "Probe", String.of(f"number {number}"), 7 << 32)))


def line(faults: str, seed: int = 1, name: str = "test", most_bytes: int = 1 << 30) -> FaultLine[int]:
    return FaultLine(Faults.parse(faults), seed, name, moved, most_bytes)


def course(
    faults: str, count: int = 100, seed: int = 1, name: str = "test", most_bytes: int = 1 << 30
) -> list[Fate[int]]:
    """The fates of messages number 0, 1 … at a steady rate."""
    one = line(faults, seed, name, most_bytes)
    fates = [fate for n in range(count) for fate in one.take(T0_NS + n * STEP_NS, n, text(n))]
    return fates + one.drain()


def sent(fates: list[Fate[int]]) -> list[int]:
    return [fate.message for fate in fates if not fate.lost]


def hits(fates: list[Fate[int]]) -> Counter[str]:
    return Counter(name for fate in fates for name, _ in fate.done)


SHARES = st.floats(0, 30).map(lambda share: f"{share:.3f}%")
TIMES = st.integers(0, 200).map(lambda ms: f"{ms}ms")
STEPS = st.integers(-5000, 5000).map(lambda s: f"{s}s@300ms")
_VALUES = {Unit.SHARE: SHARES, Unit.TIME: TIMES, Unit.STEP: STEPS}
ANY_FAULTS = st.fixed_dictionaries({}, optional={row.name: _VALUES[row.unit] for row in FAULTS}).map(
    lambda given: ",".join(f"{name}={value}" for name, value in given.items())
)


@given(ANY_FAULTS, st.integers(), st.lists(st.integers(-20, 120), max_size=30))
def test_every_message_has_one_fate_at_its_time_and_nothing_is_invented(
    faults: str, seed: int, pauses: list[int]
) -> None:
    wanted = Faults.parse(faults)
    one, again = line(faults, seed), line(faults, seed)
    now_ns, latest_ns, fates, repeated = T0_NS, 0, list[Fate[int]](), list[Fate[int]]()
    for number, pause in enumerate(pauses):
        now_ns += pause * NS_PER_MS  # a clock may step back
        due_ns = one.due_ns
        left = one.take(now_ns, number, text(number))
        latest_ns = max(now_ns, latest_ns)
        assert all(fate.at_ns <= latest_ns for fate in left)
        assert due_ns is None or due_ns > now_ns or left
        fates += left
        repeated += again.take(now_ns, number, text(number))
    fates += one.drain()
    repeated += again.drain()
    assert fates == repeated
    assert sorted(fate.message for fate in fates) == list(range(len(pauses)))
    assert one.due_ns is None
    going = [fate for fate in fates if not fate.lost]
    assert all(one.at_ns <= two.at_ns for one, two in pairwise(going))
    for fate in going:
        assert fate.late_ns >= wanted.delay_ns
        changed = {CORRUPT, TRUNCATE, CLOCK_STEP} & set(hits([fate]))
        data, original = fate.data, text(fate.message)
        assert (data is not None and data != original) == bool(changed)
        if data is not None:
            assert len(data) < len(original) if TRUNCATE in changed else len(data) == len(original)
        assert fate.disconnect == bool({TRUNCATE, DISCONNECT} & set(hits([fate])))


@pytest.mark.parametrize("fault", [LOSS, REORDER, TRUNCATE, CORRUPT, DISCONNECT])
def test_as_many_are_hit_as_asked(fault: str) -> None:
    fates = course(f"{fault}=2%", MANY, seed=3)
    assert hits(fates).keys() == {fault}
    assert 70 <= hits(fates)[fault] <= 130  # 100 ± three times the root of 98
    assert course(f"{fault}=0%", 50) == course("", 50)
    assert hits(course(f"{fault}=100%", 50))[fault] >= 25  # every second one can be overtaken


def test_another_seed_or_line_hits_others_and_another_fault_does_not() -> None:
    def lost(faults: str, seed: int = 1, name: str = "test") -> set[int]:
        return {fate.message for fate in course(faults, 500, seed, name) if fate.lost}

    assert lost("loss=5%") == lost("loss=5%,corrupt=50%,jitter=5ms")
    assert len({frozenset(lost("loss=5%", seed, name)) for seed, name in ((1, "a"), (1, "b"), (2, "a"))}) == 3


def test_the_hash_is_as_documented() -> None:
    """It is a promise: a seed that found a fault finds it with the next version, too."""
    assert [fate.message for fate in course("loss=10%", 50, seed=7, name="replay") if fate.lost] == [15, 35]


def test_delay_and_jitter_keep_the_order() -> None:
    fates = course("delay=50ms,jitter=40ms", MANY)
    assert sent(fates) == list(range(MANY))
    late_ms = [fate.late_ns / NS_PER_MS for fate in fates]
    assert 50 <= min(late_ms) < 55
    assert 85 < max(late_ms) <= 90
    assert len(set(late_ms)) > MANY / 2


def test_a_message_changes_places_with_the_next_one() -> None:
    order = sent(course("reorder=20%", 40))
    assert order != sorted(order)
    assert all(abs(place - number) <= 1 for place, number in enumerate(order))


def test_a_message_that_nobody_overtakes_goes_after_a_while() -> None:
    one = line("reorder=100%")
    assert one.take(T0_NS, 0, text(0)) == []
    assert one.due_ns == T0_NS + OVERTAKEN_WITHIN_NS
    assert one.due(T0_NS + OVERTAKEN_WITHIN_NS - 1) == []
    (fate,) = one.due(T0_NS + OVERTAKEN_WITHIN_NS)
    assert (fate.message, fate.late_ns, fate.done) == (0, OVERTAKEN_WITHIN_NS, ())
    assert one.due_ns is None


def test_a_corrupt_message_has_a_wrong_crc_and_keeps_its_size() -> None:
    for fate in course("corrupt=100%", 200):
        assert fate.data
        assert fate.data[:50] == text(fate.message)[:50]
        with pytest.raises(ChecksumMismatch):
            decode(fate.data)
        assert sum((a ^ b).bit_count() for a, b in zip(fate.data, text(fate.message), strict=True)) == 1


def test_a_message_without_a_body_is_left_its_header() -> None:
    (fate,) = line("corrupt=100%").take(T0_NS, 0, b"GET_" + bytes(46))
    assert fate.data is None
    assert fate.done == ()


def test_a_clock_steps_from_a_moment_on_in_header_and_metadata() -> None:
    metadata = (Item.of("ros.stamp", "7000000000"), Item.of("name", "value"))
    message = Message("STRING", "Probe", String.of("hi"), 7 << 32, header_version=2, metadata=metadata)
    one = line("clock-step=-2s@1s")
    told = []
    for seconds in (0.0, 0.9, 1.0, 1.1):
        (fate,) = one.take(T0_NS + round(seconds * NS_PER_S), 0, join(encode(message)))
        new = decode(fate.data or join(encode(message)))  # the CRC is right
        assert new.metadata[1:] == metadata[1:]
        told.append((ticks_to_ns(new.ticks), int(new.metadata[0].text), bool(fate.reportable)))
    seven, five = 7 * NS_PER_S, 5 * NS_PER_S
    assert told == [(seven, seven, False), (seven, seven, False), (five, five, True), (five, five, False)]
    unset = join(encode(Message("STRING", "Probe", String.of("hi"))))
    assert one.take(T0_NS + 2 * NS_PER_S, 0, unset)[0].data is None, "unset stays unset"


def test_what_is_held_back_is_bounded_and_the_oldest_goes_early() -> None:
    size = len(text(0))
    one = line("delay=10s", most_bytes=3 * size)
    assert [one.take(T0_NS + n, n, text(n)) for n in range(3)] == [[], [], []]
    (early,) = one.take(T0_NS + 3, 3, text(3))
    assert (early.message, early.late_ns, hits([early])) == (0, 3, {EARLY: 1})
    assert [fate.message for fate in one.drain()] == [1, 2, 3]


def test_all_values_are_read() -> None:
    told = "delay=50ms, jitter=10us,loss=1%,reorder=2%,truncate=0.1%,corrupt=0.5%,disconnect=100%,clock-step=-1h@10s"
    assert Faults.parse(told) == Faults(
        50 * NS_PER_MS, 10_000, 0.01, 0.02, 0.001, 0.005, 1.0, -3600 * NS_PER_S, 10 * NS_PER_S
    )
    assert not Faults.parse("")
    assert not Faults.parse("loss=0%")


def test_faults_of_one_way_only() -> None:
    both = RelayFaults.parse("delay=5ms, in:loss=1%,out: clock-step=-1h@10s")
    assert both == RelayFaults(Faults.parse("delay=5ms,loss=1%"), Faults.parse("delay=5ms,clock-step=-1h@10s"))
    assert (
        both and RelayFaults.parse("out:loss=1%") and not RelayFaults.parse("") and not RelayFaults.parse("in:loss=0%")
    )
    for told, wrong in (
        ("in:los=1%", "--fault: found 'los', expected NAME=VALUE"),
        ("inn:loss=1%", "--fault: found 'inn:loss', expected NAME=VALUE"),
        ("loss=1%,out:loss=2%", "--fault: found loss twice"),
        ("in:", "--fault: found 'in:', expected NAME=VALUE"),
    ):
        with pytest.raises(ConfigError) as caught:
            RelayFaults.parse(told)
        assert str(caught.value).startswith(wrong)


def test_the_document_has_every_fault() -> None:
    page = (ROOT / "docs" / "how-to" / "faults.md").read_text("utf-8")
    for row in FAULTS:
        assert f"| `{row.name}` | {row.unit.value} | {row.meaning} |" in page


@table(
    ("told", "wrong"),
    [
        ("dely=5ms", "--fault: found 'dely', expected NAME=VALUE, one of delay, jitter, loss"),
        ("loss=1%,", "--fault: found '', expected"),
        ("loss", "--fault: loss: found no value, expected loss=SHARE%"),
        ("loss=1%,loss=2%", "--fault: found loss twice"),
        ("loss=0.01", "--fault: loss: found '0.01', expected a share from 0% to 100%"),
        ("loss=101%", "--fault: loss: found '101%'"),
        ("delay=50", "--fault: delay: found '50', expected a time such as 50ms"),
        ("delay=-5ms", "--fault: delay: found '-5ms'"),
        ("delay=1h", "--fault: delay: found '1h', expected at most 60 s"),
        ("clock-step=1", "--fault: clock-step: found '1', expected a time such as -1h"),
        ("clock-step=1h@", "--fault: clock-step: @: found ''"),
        ("clock-step=-999999h", "--fault: clock-step: found '-999999h', expected at most"),
    ],
)
def test_what_is_wrong_is_named(told: str, wrong: str) -> None:
    with pytest.raises(ConfigError) as caught:
        Faults.parse(told)
    assert str(caught.value).startswith(wrong)
