"""The interval of a clock's offset: the truth is in it, whatever the delays are."""

from __future__ import annotations

import math
import random

import pytest

from igtl_gateway.base.stamp import NS_PER_MS, NS_PER_S
from igtl_gateway.gateway.log.clock_offset import DRIFT_PPM, ClockStep, NoClock, OffsetEstimate, PeerClocks
from tests.tables import table
from tools.evidence.clock_worlds import World, planted, run

T0 = 1_767_225_600_123_456_789
#: Of stamps that are not rounded.
SLACK_NS = 1_000


def ask(
    estimate: OffsetEstimate, second: float, offset_ns: int, there_ns: int = NS_PER_MS, back_ns: int = NS_PER_MS
) -> ClockStep | NoClock | None:
    """Ask at a second after T0, with these delays."""
    asked_ns = T0 + round(second * NS_PER_S)
    made_ns = asked_ns + there_ns
    return estimate.add(asked_ns, made_ns + offset_ns, made_ns + back_ns)


def test_one_answer_bounds_the_offset_by_its_delays() -> None:
    estimate = OffsetEstimate()
    assert estimate.offset(T0) is None
    assert ask(estimate, 0, 5 * NS_PER_S, 3 * NS_PER_MS, 1 * NS_PER_MS) is None
    found = estimate.offset(T0 + 4 * NS_PER_MS)
    assert found
    drift_ns = 4 * NS_PER_MS * DRIFT_PPM // 1_000_000
    assert found.low_ns == 5 * NS_PER_S - 1 * NS_PER_MS - SLACK_NS
    assert found.high_ns == 5 * NS_PER_S + 3 * NS_PER_MS + drift_ns + SLACK_NS
    assert (found.answers, found.age_ns, found.drift_ppm) == (1, 0, None)
    assert str(found) == "+5,001.002 ms ± 2 ms"
    later = estimate.offset(T0 + 4 * NS_PER_MS + NS_PER_S)
    assert (
        later
        and later.age_ns == NS_PER_S
        and later.low_ns == found.low_ns - NS_PER_MS
        and later.high_ns == found.high_ns + NS_PER_MS
    )


def test_further_answers_make_it_narrower_and_slow_ones_do_not_make_it_wider() -> None:
    estimate = OffsetEstimate()
    ask(estimate, 0, 0, 50 * NS_PER_MS, NS_PER_MS)
    ask(estimate, 1, 0, NS_PER_MS, 50 * NS_PER_MS)
    found = estimate.offset(T0 + NS_PER_S + 51 * NS_PER_MS)
    assert found and found.high_ns - found.low_ns < 5 * NS_PER_MS
    ask(estimate, 1.1, 0, 400 * NS_PER_MS, 400 * NS_PER_MS)
    found = estimate.offset(T0 + 2 * NS_PER_S)
    assert found and found.high_ns - found.low_ns < 7 * NS_PER_MS


def test_a_drift_is_known_after_a_minute_and_follows_the_last_ten() -> None:
    estimate = OffsetEstimate()
    for second in range(60):
        ask(estimate, second, 40_000 * second, 100_000, 100_000)
    found = estimate.offset(T0 + 59 * NS_PER_S)
    assert found and found.drift_ppm is None and not found.drift_text
    ask(estimate, 60, 40_000 * 60, 100_000, 100_000)
    found = estimate.offset(T0 + 60 * NS_PER_S)
    assert found and found.drift_ppm and found.drift_ppm[0] < 40 < found.drift_ppm[1]
    for second in range(60, 2_000):
        ask(estimate, second, 40_000 * 60 - 20_000 * (second - 60), 100_000, 100_000)
    found = estimate.offset(T0 + 1_999 * NS_PER_S)
    assert found and found.drift_ppm
    low, high = found.drift_ppm
    assert low <= -20 <= high and high - low < 2


def test_a_step_is_believed_when_a_second_answer_says_the_same() -> None:
    estimate = OffsetEstimate()
    for second in range(10):
        assert ask(estimate, second, 0) is None
    assert ask(estimate, 10, 20 * NS_PER_MS) is None
    both = estimate.offset(T0 + 10 * NS_PER_S + 2 * NS_PER_MS)
    assert both and both.low_ns < 0 and both.high_ns > 20 * NS_PER_MS  # it is not known yet which is right
    step = ask(estimate, 11, 20 * NS_PER_MS)
    assert isinstance(step, ClockStep) and step.low_ns < 20 * NS_PER_MS < step.high_ns
    found = estimate.offset(T0 + 11 * NS_PER_S)
    assert found and found.low_ns > 15 * NS_PER_MS and found.answers == 1
    assert [ask(estimate, second, 20 * NS_PER_MS) for second in range(12, 30)] == 18 * [None]


def test_an_answer_that_no_other_one_confirms_is_no_step() -> None:
    estimate = OffsetEstimate()
    for second in range(10):
        ask(estimate, second, 0)
    assert [ask(estimate, 10, NS_PER_S), ask(estimate, 11, 0), ask(estimate, 12, 0)] == [None, None, None]
    found = estimate.offset(T0 + 12 * NS_PER_S)
    assert found and found.high_ns < 5 * NS_PER_MS


def test_stamps_that_contradict_each_other_are_no_clock_until_they_have_not_for_a_minute() -> None:
    estimate, chance = OffsetEstimate(), random.Random(7)
    said = [ask(estimate, second, chance.randrange(60) * NS_PER_S) for second in range(300)]
    assert said.count(NoClock(stands=False)) == 1
    again = OffsetEstimate()
    jumps = [ask(again, second, (1, 5)[second % 2] * second * NS_PER_S) for second in range(9)]
    assert jumps == 7 * [None] + [
        NoClock(stands=False),
        None,
    ]  # the seventh contradiction counts
    assert estimate.offset(T0 + 300 * NS_PER_S) is None
    assert [ask(estimate, second, 0) for second in range(300, 361)] == 61 * [None]
    assert estimate.offset(T0 + 361 * NS_PER_S) is None
    ask(estimate, 364, 0)
    assert estimate.offset(T0 + 364 * NS_PER_S)


@table("stamp_ns", [T0, (1 << 32) * NS_PER_S - 1, 1])
def test_stamps_that_stand_still_are_no_clock(stamp_ns: int) -> None:
    estimate = OffsetEstimate()
    said = [estimate.add(T0 + second * NS_PER_S, stamp_ns, T0 + second * NS_PER_S + 1) for second in range(200)]
    assert said == 5 * [None] + [NoClock(stands=True)] + 194 * [None]  # five in a row as the first
    assert estimate.offset(T0 + 200 * NS_PER_S) is None


def test_stamps_of_2106_and_of_1970_are_an_offset_and_unset_ones_are_none() -> None:
    for offset_ns in ((1 << 32) * NS_PER_S - T0 - 1_000 * NS_PER_S, 5 * NS_PER_S - T0):
        estimate = OffsetEstimate()
        for second in range(10):
            ask(estimate, second, offset_ns)
        found = estimate.offset(T0 + 9 * NS_PER_S + 2 * NS_PER_MS)
        assert found and found.low_ns <= offset_ns <= found.high_ns
    estimate = OffsetEstimate()
    for stamp_ns in (*10 * (0,), -1):
        assert estimate.add(T0, stamp_ns, T0 + 1) is None
    assert estimate.add(T0 + 1, T0, T0) is None  # gateway time never decreases
    assert estimate.offset(T0 + 1) is None


@table("step_ns", [NS_PER_MS, 10 * NS_PER_MS, 100 * NS_PER_MS, NS_PER_S])
def test_rounded_stamps_make_the_interval_wider(step_ns: int) -> None:
    estimate = OffsetEstimate()
    for number in range(50):
        asked_ns = T0 + number * 1_013_000_011
        estimate.add(asked_ns, (asked_ns + 100_000) // step_ns * step_ns, asked_ns + 200_000)
        found = estimate.offset(asked_ns + 200_000)
        assert found and found.low_ns <= 0 <= found.high_ns, number
        assert step_ns / 2 <= found.bound_ns < step_ns + 2 * NS_PER_MS, number


@pytest.mark.parametrize("ahead_ns", [NS_PER_S, -NS_PER_S])
def test_a_step_of_this_host_is_none_of_the_peer(ahead_ns: int) -> None:
    clocks = PeerClocks()
    clocks.up(1, "10.0.0.7:5")
    for second in range(10):
        clocks.asked(1, T0 + second * NS_PER_S)
        clocks.answered(1, T0 + second * NS_PER_S + 1, T0 + second * NS_PER_S + 2)
    clocks.asked(1, T0 + 10 * NS_PER_S)
    clocks.stepped(T0 + 10 * NS_PER_S + 1)
    assert clocks.offset(1, T0 + 10 * NS_PER_S + 1) is None
    later_ns = T0 + 11 * NS_PER_S
    assert clocks.answered(1, later_ns - ahead_ns, later_ns) is None  # of the question before it
    assert clocks.offset(1, later_ns) is None
    clocks.asked(1, later_ns)
    clocks.answered(1, later_ns - ahead_ns + 1, later_ns + 2)
    found = clocks.offset(1, later_ns + 2)
    assert found and found.low_ns <= -ahead_ns <= found.high_ns


def test_while_gateway_time_stands_no_answer_counts() -> None:
    clocks = PeerClocks()
    clocks.stepped(T0)
    for number in range(100):  # a hundred seconds of the peer, in which gateway time advances by nanoseconds
        clocks.asked(1, T0 + 10 * number)
        clocks.answered(1, T0 + number * NS_PER_S, T0 + 10 * number + 5)
    assert clocks.offset(1, T0 + 1_000) is None
    for at_ns, is_known in ((T0 + 99 * NS_PER_MS, False), (T0 + 100 * NS_PER_MS, True)):
        clocks.asked(1, at_ns)
        clocks.answered(1, at_ns + 1, at_ns + 2)
        assert (clocks.offset(1, at_ns + 2) is not None) is is_known


def test_answers_are_of_the_oldest_question_and_none_waits_for_ever() -> None:
    clocks = PeerClocks()
    assert clocks.answered(1, T0, T0) is None and not clocks.waits(1)
    for number in range(20):
        clocks.asked(1, T0 + number)
    for number in range(8):
        assert clocks.waits(1), number
        clocks.answered(1, T0 + NS_PER_S + number, T0 + NS_PER_S + number)
    assert not clocks.waits(1)
    clocks.asked(1, T0 + 2 * NS_PER_S)
    clocks.down(1)
    assert not clocks.waits(1) and clocks.offset(1, T0 + 2 * NS_PER_S) is None


def test_another_program_of_a_host_has_its_clock_but_not_at_the_end_of_a_tunnel() -> None:
    for host, is_known in (("10.0.0.7", True), ("[fd00::7]", True), ("127.0.0.1", False), ("nowhere", False)):
        clocks = PeerClocks()
        clocks.up(1, f"{host}:5")
        clocks.up(2, f"{host}:6")
        clocks.up(3, "10.0.0.8:5")
        clocks.asked(1, T0)
        clocks.answered(1, T0 + NS_PER_S, T0 + 1_000)
        assert clocks.offset(1, T0) and clocks.offset(3, T0) is None
        assert (clocks.offset(2, T0) is not None) is is_known, host
        assert clocks.text(3, T0) == "by the sender's clock"
        assert clocks.text(1, T0 + 1_000) == "by the sender's clock (offset +1,000.000 ms ± 1.50 µs)"


def test_planted_worlds_and_their_steps() -> None:
    results = planted(16, seconds=240)
    steps = [found.noticed_s for world, found in results if world.step_s < math.inf]
    assert len(steps) == 8 and max(steps) <= 10
    assert not any(found.outside or found.false or found.no_clock for _, found in results)
    assert sum(found.judged for _, found in results) > 7_000


@pytest.mark.long
def test_a_day_without_a_false_alarm_and_200_worlds() -> None:
    day = run(World(random.Random(7_000), 86_400))
    assert not day.outside and not day.false and not day.no_clock and day.judged > 150_000
    results = planted(200, seed=2)
    assert not any(found.outside or found.false or found.no_clock for _, found in results)
    assert max(found.noticed_s for world, found in results if world.step_s < math.inf) <= 10
