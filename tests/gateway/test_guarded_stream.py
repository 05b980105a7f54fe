"""One guarded stream: when it is stale, which oddities are reported, and that the quick way reports the same."""

from __future__ import annotations

import struct

from hypothesis import given
from hypothesis import strategies as st

from igtl_gateway.base.stamp import NS_PER_MS, NS_PER_S
from igtl_gateway.gateway.guarded_stream import (
    AGE_UNKNOWN,
    BACKWARDS,
    CALM,
    CODES,
    EPISODE_NS,
    FRESH,
    FUTURE,
    JUMP,
    LOOK_NS,
    NEVER_NS,
    STALE,
    STILL,
    STILL_LOOKS,
    GuardedStream,
    Place,
    findings_of,
    is_unit_jump,
)
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.note import Level
from igtl_gateway.gateway.outcome import Finding
from tests.tables import table

T0 = 1_700_000_000 * NS_PER_S
S = NS_PER_S


def watched(max_age_s: float = 0.0) -> GuardedStream:
    return GuardedStream("TRANSFORM/Tool", int(max_age_s * S), watch=True)


def codes(stream: GuardedStream, now_ns: int, stamp_ns: int, place: Place | None = None) -> list[str]:
    return [code for _, code, _ in stream.observe(now_ns, stamp_ns, place)]


# -- age --------------------------------------------------------------------------------------------------------------


@table(
    ("age_ns", "withheld"),
    [(0, False), (S // 2, False), (S // 2 + 1, True), (10**18, True), (-S, False), (1, False)],
)
def test_what_is_older_than_the_maximum_is_withheld(age_ns: int, withheld: bool) -> None:
    stream = watched(0.5)
    found, remarks = stream.judge(T0, T0 - age_ns)
    assert found == withheld and [code for _, code, _ in remarks] == ([STALE] if withheld else [])


def test_a_stale_stream_is_reported_at_its_begin_and_its_end() -> None:
    stream = watched(0.5)
    _, (remark,) = stream.judge(T0, T0 - 2 * S)
    assert remark == (
        Level.ERROR,
        STALE,
        "TRANSFORM/Tool is stale: messages are 2 s old by the sender's clock, expected at most 500 ms",
    )
    assert stream.judge(T0 + 1, T0 - 2 * S) == (True, [])
    assert stream.judge(T0 + 1500 * NS_PER_MS, T0 + 1500 * NS_PER_MS) == (
        False,
        [(Level.INFO, FRESH, "TRANSFORM/Tool is recent again, after 1.50 s: 2 messages dropped as too old")],
    )
    assert stream.judge(T0 + 2 * S, T0 + 2 * S) == (False, [])
    assert stream.stale == 0


def test_a_stream_without_stamps_passes_and_is_reported_once() -> None:
    stream = watched(0.5)
    withheld, (remark,) = stream.judge(T0, 0)
    assert not withheld
    assert remark == (Level.WARN, AGE_UNKNOWN, "TRANSFORM/Tool: messages without stamps, age unknown (max_age_s)")
    assert stream.judge(T0 + S, 0) == stream.judge(T0 + S, -5) == (False, [])
    assert stream.judge(T0 + 9 * S, T0)[0], "with a stamp, its age is known"


def test_without_a_maximum_age_nothing_is_stale_and_what_was_is_fresh() -> None:
    stream = watched()
    assert stream.judge(T0, T0 - 10**18) == (False, []) == stream.judge(T0, 0)
    stale = watched(0.5)
    stale.judge(T0, T0 - S)
    stale.max_age_ns = 0
    assert [code for _, code, _ in stale.judge(T0, T0 - S)[1]] == [FRESH]


def test_ages_are_by_the_clock_of_the_host_also_where_it_was_set_back() -> None:
    stream = watched(0.5)
    stream.ahead_ns = 3600 * S
    assert stream.judge(T0 + 3600 * S, T0 - S // 2) == (False, [])
    _, (remark,) = stream.judge(T0 + 3600 * S, T0 - S)
    assert "messages are 1 s old" in remark[2]


# -- oddities ---------------------------------------------------------------------------------------------------------


def test_a_usual_stream_gives_no_remark() -> None:
    stream = watched()
    assert not any(codes(stream, T0 + n * S // 50, T0 + n * S // 50 - 7, (1.0, 2.0, 3.0 + n)) for n in range(1000))
    assert (stream.last_ns, stream.episodes) == (T0 + 999 * S // 50 - 7, {})
    assert stream.age_ns == 7


def test_what_is_not_watched_is_not_looked_at() -> None:
    stream = GuardedStream("a", 0, watch=False)
    assert [code for now in (9, 5, 1) for code in codes(stream, T0 + now, T0 + now)] == []
    assert stream.last_ns == 0 and stream.age_ns is None


def test_decreasing_stamps_are_found_in_each_message() -> None:
    stream = watched()
    assert codes(stream, T0, T0 - 100) == []
    _, code, text = stream.observe(T0 + 1, T0 - S)[0]
    assert (code, text) == (BACKWARDS, "TRANSFORM/Tool: stamps decrease by 1 s")
    assert codes(stream, T0 + 2, T0 - 2 * S) == [] and stream.episodes[BACKWARDS][2] == 2
    assert codes(stream, T0 + 3, T0 - 2 * S) == [], "an equal stamp does not decrease"


def test_an_episode_ends_after_a_time_without_the_oddity() -> None:
    stream = watched()
    stream.observe(T0, T0)
    stream.observe(T0 + S, T0 - S)
    for step in range(2, 12):
        assert codes(stream, T0 + step * S, T0 + step * S) == []
    assert EPISODE_NS == 10 * S and BACKWARDS in stream.episodes
    ((level, code, text),) = stream.observe(T0 + 11 * S + 1 + LOOK_NS, T0 + 11 * S + 2)
    assert (level, code) == (Level.INFO, CALM)
    assert text == "TRANSFORM/Tool: decreasing stamps have ended after 1 time in 0 s"
    assert codes(stream, T0 + 13 * S, T0) == [BACKWARDS], "then it is reported again"


@table(("ahead_ms", "odd"), [(100, False), (101, True), (0, False)])
def test_stamps_in_the_future(ahead_ms: int, odd: bool) -> None:
    stream = watched()
    found = stream.observe(T0, T0 + ahead_ms * NS_PER_MS)
    assert [code for _, code, _ in found] == ([FUTURE] if odd else [])
    if odd:
        assert "stamps are 101 ms in the future by the sender's clock; synchronise the clocks (NTP, PTP)" in found[0][2]
    behind = watched()
    behind.ahead_ns = S  # gateway time is ahead of the clock that stamps are compared with
    assert codes(behind, T0 + S, T0 + ahead_ms * NS_PER_MS) == ([FUTURE] if odd else [])


def test_stamps_that_do_not_change_over_twenty_looks() -> None:
    stream = watched()
    found = [codes(stream, T0 + number * LOOK_NS, T0 - S) for number in range(STILL_LOOKS + 2)]
    assert found == [*[[]] * STILL_LOOKS, [STILL], []]
    slow = watched()  # in whole seconds: ten looks
    assert not any(codes(slow, T0 + number * LOOK_NS, T0 + number // 10 * S - S) for number in range(200))


def test_between_two_looks_only_decreasing_stamps_are_looked_for() -> None:
    stream = watched()
    stream.observe(T0, T0, (0.1, 0.2, 0.3))
    assert codes(stream, T0 + LOOK_NS - 1, T0 + 9 * S, (100.0, 200.0, 300.0)) == []
    assert set(codes(stream, T0 + LOOK_NS, T0 + 9 * S, (100.0, 200.0, 300.0))) == {FUTURE, JUMP}


def test_a_jump_of_the_unit_is_named_with_its_factor() -> None:
    stream = watched()
    stream.observe(T0, T0, (0.1, 0.2, 0.2))
    ((_, code, text),) = stream.observe(T0 + LOOK_NS, T0 + LOOK_NS, (100.0, 200.0, 200.0))
    assert code == JUMP
    assert text == (
        "TRANSFORM/Tool: translation jumped from 0.3 to 300 in the same direction, a factor of 1000: "
        "metres instead of millimetres?"
    )
    assert codes(stream, T0 + 2 * LOOK_NS, T0 + 2 * LOOK_NS) == [], "not a pose"
    assert codes(stream, T0 + 3 * LOOK_NS, T0 + 3 * LOOK_NS, (0.1, 0.2, 0.2)) == [], "nothing to compare it with"


@table(
    ("before", "after", "jump"),
    [
        ((0.1, 0.0, 0.0), (100.0, 0.0, 0.0), True),
        ((100.0, 0.0, 0.0), (0.1, 0.0, 0.0), True),
        ((1.0, 0.0, 0.0), (500.0, 0.0, 0.0), True),
        ((1.0, 0.0, 0.0), (499.0, 0.0, 0.0), False),
        ((1.0, 0.0, 0.0), (2000.0, 0.0, 0.0), True),
        ((1.0, 0.0, 0.0), (2001.0, 0.0, 0.0), False),
        ((0.1, 0.0, 0.0), (-100.0, 0.0, 0.0), False),
        ((0.1, 0.0, 0.0), (99.0, 14.0, 0.0), True),  # a cosine of 0.990
        ((0.1, 0.0, 0.0), (99.0, 15.0, 0.0), False),
        ((0.0, 0.0, 0.0), (100.0, 0.0, 0.0), False),
        ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), False),
        ((float("nan"), 0.0, 0.0), (100.0, 0.0, 0.0), False),
        ((1e200, 1e200, 0.0), (1e203, 1e203, 0.0), True),  # their product is beyond a float
        ((float("inf"), 0.0, 0.0), (100.0, 0.0, 0.0), False),
    ],
)
def test_unit_jumps(before: Place, after: Place, jump: bool) -> None:
    assert is_unit_jump(before, after) == jump == is_unit_jump(after, before)


def test_remarks_become_findings_about_the_stream_of_the_entry() -> None:
    entry = Entry(1, T0, Kind.IGTL_IN, "TRANSFORM/Tool", "TRANSFORM", (), (3,))
    assert findings_of(entry, [(Level.WARN, JUMP, "text")]) == [Finding(Level.WARN, JUMP, "text", entry.channel, (3,))]
    assert {STALE, FRESH, AGE_UNKNOWN, JUMP, BACKWARDS, STILL, FUTURE, CALM} == CODES


# -- the quick way ----------------------------------------------------------------------------------------------------

POSE = struct.Struct(">3d")
_places = st.sampled_from([(0.1, 0.2, 0.3), (0.11, 0.2, 0.3), (100.0, 200.0, 300.0), (0.0, 0.0, 0.0)])
_steps = st.lists(
    st.tuples(
        st.sampled_from([0, 1, NS_PER_MS, LOOK_NS, S, 11 * S]),  # until the next message
        st.sampled_from([0, 1, -S, 2 * S, -2 * S, 300 * NS_PER_MS, None]),  # age; None: the stamp of before
        _places,
    ),
    max_size=40,
)


@given(_steps, st.sampled_from([0.0, 1.0]), st.booleans())
def test_what_passes_quickly_would_have_given_no_remark(
    steps: list[tuple[int, int | None, Place]], max_age_s: float, watch: bool
) -> None:
    """And leaves the same state: the rest of the session does not depend on the way."""
    full, quick = (GuardedStream("a", int(max_age_s * S), watch=watch) for _ in range(2))
    now_ns = stamp_ns = T0
    for step_ns, age_ns, place in steps:
        now_ns += step_ns
        stamp_ns = stamp_ns if age_ns is None else now_ns - age_ns
        own_ns = 0 if stamp_ns == now_ns else stamp_ns
        withheld, remarks = full.judge(now_ns, own_ns)
        if not withheld:
            remarks += full.observe(now_ns, stamp_ns, place)
        if quick.passes_quickly(now_ns, stamp_ns, b"x" + POSE.pack(*place), POSE, 1):
            assert not withheld and not remarks
        else:
            again, found = quick.judge(now_ns, own_ns)
            if not again:
                found += quick.observe(now_ns, stamp_ns, place)
            assert (again, found) == (withheld, remarks)
        if watch:
            assert quick.native_state()[:7] == full.native_state()[:7]
            assert quick.episodes == full.episodes and quick.age_ns == full.age_ns


def test_the_state_for_the_passage_has_the_end_of_the_first_episode() -> None:
    stream = watched(0.5)
    assert stream.native_state()[8] == NEVER_NS
    stream.observe(T0, T0)
    stream.observe(T0 + 5, T0 - S)
    assert stream.native_state()[8] == T0 + 5 + EPISODE_NS
    stream.after_native((T0 + 9, 1, 2, T0 + 7, T0 + 8, 4, (1.0, 2.0, 3.0)), [(T0 - 5, T0), (0, T0 + 1)])
    assert stream.native_state()[5:8] == (T0 + 9, 1, 2)
    assert stream.native_state()[9:] == (T0 + 7, T0 + 8, 4, (1.0, 2.0, 3.0))
    assert stream.age_ns == 1 and stream.timing.messages == 3 and stream.timing.unset == 2
