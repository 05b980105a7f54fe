"""Time triage on synthetic clocks: what is put in is found again."""

from __future__ import annotations

from igtl_gateway.base.stamp import NS_PER_MS, NS_PER_S
from igtl_gateway.gateway.log.timing import StampTiming, age_text, best
from tests.tables import table

T0_NS = 1_767_225_600_000_000_000


def heard(
    messages: int, *, offset_ns: int = 0, ppm: int = 0, step_ns: int = 1, every_ns: int = 10_370_007
) -> StampTiming:
    """A sender whose clock is behind by so much; latency of 2 ms and up to 4.9 ms more, in a pattern."""
    timing = StampTiming()
    for index in range(messages):
        sent_ns = T0_NS + index * every_ns
        stamp_ns = sent_ns - offset_ns - index * every_ns * ppm // 1_000_000
        latency_ns = 2 * NS_PER_MS + (index * 37 % 50) * NS_PER_MS // 10
        timing.add(stamp_ns // step_ns * step_ns, sent_ns + latency_ns)
    return timing


def test_offset_and_least_latency_are_one_number_and_jitter_is_what_is_above() -> None:
    for offset_ns in (0, 300 * NS_PER_MS, -5 * NS_PER_S):
        timing = heard(2_000, offset_ns=offset_ns)
        assert timing.least_ns == offset_ns + 2 * NS_PER_MS
        assert abs(timing.jitter_ns - 2_450_000) < 100_000
        assert timing.most_ns - timing.least_ns == 4_900_000
    assert (
        str(timing).startswith("stamped 5 s ahead of this clock")
        and timing.to_dict()["offset_plus_least_latency_ms"] == -4998.0
    )
    assert timing.future == 2_000 and heard(100).future == 0


def test_a_drift_is_told_after_a_minute_and_does_not_count_as_jitter() -> None:
    assert heard(100).drift_ppm is None
    timing = heard(12_000, ppm=200)
    assert timing.drift_ppm is not None and abs(timing.drift_ppm - 200) < 5
    assert timing.jitter_ns < 4 * NS_PER_MS < 24 * NS_PER_MS < timing.most_ns - timing.least_ns


def test_rounded_stamps_are_seen_by_their_step() -> None:
    assert heard(500).step_ns == 0
    assert heard(500, step_ns=NS_PER_MS).step_ns == NS_PER_MS
    assert heard(5_000, step_ns=NS_PER_S).step_ns == NS_PER_S
    assert heard(5, step_ns=NS_PER_S).step_ns == 0  # too few for a decision
    assert heard(5_000, step_ns=NS_PER_S).repeated > 4_900


def test_unset_repeated_and_backward_stamps_are_counted() -> None:
    timing = StampTiming()
    for stamp_ns in (0, T0_NS, T0_NS, T0_NS - 5, -1, T0_NS + 1):
        timing.add(stamp_ns, T0_NS + 10)
    assert (timing.unset, timing.repeated, timing.backwards, timing.stamped) == (2, 1, 1, 4)
    silent = StampTiming()
    silent.add(0, T0_NS)
    assert str(silent) == "no stamps" and silent.to_dict() == {"messages": 1, "unset": 1}


def test_the_best_stream_of_a_peer_is_the_one_that_waited_least() -> None:
    slow, fast, unstamped = heard(50, offset_ns=NS_PER_MS), heard(50), StampTiming()
    unstamped.add(0, T0_NS)
    assert best([slow, unstamped, fast]) is fast
    assert best([unstamped]) is unstamped and best([]) is None


def test_the_last_pause_between_two_arrivals() -> None:
    timing = StampTiming()
    assert timing.pause == (0, 0)
    for arrival_ns in (1_000 * NS_PER_MS, 1_100 * NS_PER_MS, 5_200 * NS_PER_MS, 5_300 * NS_PER_MS):
        timing.add(0, arrival_ns)
    assert timing.pause == (5_200 * NS_PER_MS, 4_100 * NS_PER_MS)
    timing.reset()  # our clock was set
    timing.add(0, 9_000 * NS_PER_MS)
    assert timing.pause == (5_200 * NS_PER_MS, 4_100 * NS_PER_MS)


@table(
    ("age_ns", "words"),
    [
        (3_100_000, "age 3.10 ms"),
        (2, "received at the stamp"),
        (-999, "received at the stamp"),
        (-250_000_000, "stamped 250 ms ahead of this clock"),
        (28_659_063_224_700_000, "recorded in another session: offset 332 days"),
        (1_790_000_000 * NS_PER_S, "stamped by a clock that does not count from 1970: offset 57 years"),
    ],
)
def test_an_age_in_words(age_ns: int, words: str) -> None:
    assert age_text(age_ns, "age {}") == words
