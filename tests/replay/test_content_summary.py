"""What is counted of a recording: rates, gaps, ages, what restores a slice, steps of the clock, notes and peers."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from igtl_gateway.gateway.log.clocksteps import ClockStep
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.note import Level, Note
from igtl_gateway.replay.content_summary import ContentSummary, StreamSummary
from tests.tables import table

S, MS = 1_000_000_000, 1_000_000
T0 = 1_700_000_000 * S


def message(
    at_ns: int, source_ns: int = 0, *, kind: Kind = Kind.IGTL_IN, size: int = 10, links: tuple[int, ...] = (1,)
) -> Entry:
    return Entry(1, T0 + at_ns, kind, "TRANSFORM/Tool", "TRANSFORM", (bytes(size),), links, source_ns)


def summary(*entries: Entry, begin_ns: int = 0) -> StreamSummary:
    (found,) = ContentSummary.of(entries, begin_ns).streams.values()
    return found


def every(count: int, step_ns: int, pause_ns: int = 0) -> list[Entry]:
    """Messages at an interval, with a pause in the middle."""
    return [message(number * step_ns + (pause_ns if 2 * number > count else 0)) for number in range(count)]


def test_a_stream_is_counted_with_its_bytes_and_links() -> None:
    found = summary(message(0, size=3, links=(2, 5)), message(S, size=4, links=()))
    assert (found.messages, found.bytes, found.links) == (2, 7, {2, 5})
    assert (found.first_ns, found.last_ns) == (T0, T0 + S)
    assert (found.kind, found.channel, found.type) == (Kind.IGTL_IN, "TRANSFORM/Tool", "TRANSFORM")


def test_a_name_in_both_directions_is_two_streams() -> None:
    content = ContentSummary.of([message(0), message(1, kind=Kind.IGTL_OUT), message(2)])
    assert [(each.kind, each.messages) for each in content.streams.values()] == [(Kind.IGTL_IN, 2), (Kind.IGTL_OUT, 1)]
    assert content.entries == 3


@table(
    ("stamps_ns", "rate"),
    [
        ([0], 0.0),
        ([0, 0, 0], 0.0),
        ([0, MS - 1], 0.0),  # of one moment
        ([0, MS], 1000.0),
        ([0, S // 2, S], 2.0),
        ([0, S, 3 * S], 2 / 3),
    ],
)
def test_rates(stamps_ns: list[int], rate: float) -> None:
    assert summary(*map(message, stamps_ns)).rate_hz == pytest.approx(rate)


@table(
    ("entries", "gap"),
    [
        (every(100, 10 * MS), False),
        (every(100, 10 * MS, S + 500 * MS), True),
        (every(100, 10 * MS, 900 * MS), False),  # not longer than a second
        (every(40, S, 9 * S), False),  # not longer than ten intervals
        (every(40, S, 14 * S), True),
        (every(19, 10 * MS, 5 * S), False),  # too few for a rhythm
        (every(20, 10 * MS, 5 * S), True),
    ],
)
def test_gaps(entries: list[Entry], gap: bool) -> None:
    assert summary(*entries).has_gap == gap


def test_what_restores_a_slice_is_counted_but_has_no_time() -> None:
    entries = [message(-9 * S, T0 - 10 * S), message(0, T0 - MS), message(2 * S, T0 + 2 * S - MS)]
    found = summary(*entries, begin_ns=T0)
    assert (found.messages, found.restores, found.bytes) == (3, 1, 30)
    assert (found.first_ns, found.last_ns, found.longest_pause_ns) == (T0, T0 + 2 * S, 2 * S)
    assert found.rate_hz == 0.5
    assert len(found.ages_ns) == 3


def test_ages_are_from_the_stamp_of_the_sender_to_the_arrival() -> None:
    found = summary(message(0, T0 - 5 * MS), message(S, T0 + S - 7 * MS), message(2 * S), message(3 * S, T0 + 3 * S))
    assert found.ages_ns == [5 * MS, 7 * MS, 0]
    assert found.unstamped == 1
    assert found.age_ms == (5.0, 7.0)
    assert found.stamps == "median age 5 ms, varies by 7 ms, 1 unstamped"
    assert summary(message(0, T0 - 1_234_560_000)).stamps == "median age 1.23 s"
    assert summary(message(0)).stamps == "unstamped" and summary(message(0)).age_ms is None


def test_what_the_gateway_sends_has_no_age() -> None:
    for kind in (Kind.IGTL_OUT, Kind.ROS_OUT):
        found = summary(message(0, T0 - 5 * MS, kind=kind))
        assert (found.ages_ns, found.unstamped, found.stamps) == ([], 0, "")


def test_facts_of_a_stream() -> None:
    assert summary(message(0, T0 - 5 * MS), message(S)).to_dict() == {
        "direction": "igtl_in",
        "stream": "TRANSFORM/Tool",
        "type": "TRANSFORM",
        "messages": 2,
        "restores": 0,
        "bytes": 20,
        "rate_hz": 1.0,
        "longest_pause_s": 1.0,
        "gap": False,
        "stamps": "median age 5 ms, 1 unstamped",
        "age_median_ms": 5.0,
        "age_max_minus_min_ms": 0.0,
    }


_times = st.lists(st.tuples(st.integers(0, 3 * S), st.integers(0, 5) | st.just(0), st.integers(0, 99)), min_size=1)


@given(
    st.lists(_times, min_size=1, max_size=3),
    st.sampled_from([Kind.IGTL_IN, Kind.IGTL_OUT, Kind.ROS_IN]),
    st.sampled_from([0, T0, T0 + 2 * S]),
    st.integers(-5, 5),
)
def test_columns_give_what_single_messages_give(
    batches: list[list[tuple[int, int, int]]], kind: Kind, begin_ns: int, ahead_ns: int
) -> None:
    single, columns = (StreamSummary(kind, "a", "b") for _ in range(2))
    at_ns = T0
    for batch in batches:
        rows = []
        for step_ns, age_ns, size in batch:
            at_ns += step_ns
            rows.append((at_ns, size, at_ns - age_ns if age_ns else 0))
        for stamp_ns, size, source_ns in rows:
            entry = Entry(1, stamp_ns, kind, "a", "b", (bytes(size),), (), source_ns)
            single.add(entry, ahead_ns, restores=stamp_ns < begin_ns)
        times, sizes, sources = (np.array(column, np.int64) for column in zip(*rows, strict=True))
        columns.add_columns(times, sizes, sources, ahead_ns, begin_ns)
    assert columns == single


def note(code: str, level: Level = Level.WARN, kind: Kind = Kind.NOTE, **data: object) -> Entry:
    return Entry(1, T0, kind, payload=(Note(level, code, "text", "", dict(data)).pack(),), links=(1,))


def test_notes_are_kept_and_warnings_counted() -> None:
    content = ContentSummary.of([note("a"), note("b", Level.INFO), note("a", Level.ERROR), note("c", kind=Kind.LINK)])
    assert content.problems == {"a": 2, "c": 1}
    assert [(stamp_ns, kind, each.code) for stamp_ns, kind, each in content.notes] == [
        (T0, Kind.NOTE, "a"), (T0, Kind.NOTE, "b"), (T0, Kind.NOTE, "a"), (T0, Kind.LINK, "c"),
    ]  # fmt: skip


def heard(link: int, lag_ns: int, count: int = 30) -> Sequence[Entry]:
    stamps = [T0 + number * 100 * MS for number in range(count)]
    return [message(stamp - T0, stamp - lag_ns, links=(link,) if link else ()) for stamp in stamps]


def test_the_clock_of_each_peer_with_its_address() -> None:
    up = note("link_up", Level.INFO, Kind.LINK, peer="10.0.0.5:18944")
    ros = [
        Entry(1, each.stamp_ns, Kind.ROS_IN, "/a", "t", each.payload, (), each.source_ns) for each in heard(0, 3 * MS)
    ]
    content = ContentSummary.of([up, *heard(1, 20 * MS), *heard(2, 40 * MS), *ros])
    rows = content.clock_summaries()
    assert [(row["link"], row["peer"], row["stream"]) for row in rows] == [
        (0, "ROS", "/a"), (1, "10.0.0.5:18944", "TRANSFORM/Tool"), (2, "", "TRANSFORM/Tool"),
    ]  # fmt: skip
    assert all(row["text"] for row in rows)


def clock_step(step: ClockStep, at_ns: int) -> Entry:
    return Entry(1, T0 + at_ns, Kind.EDGE_NOTE, payload=(step.note().pack(),))


def test_ages_are_by_the_host_also_where_its_clock_was_set_back() -> None:
    """Gateway time goes on, an hour ahead of the clock from then on."""
    hour_ns = 3600 * S
    step = ClockStep.after(-hour_ns, 0)
    content = ContentSummary.of(
        [message(0, T0 - 5 * MS), clock_step(step, 1), message(S, T0 + S - hour_ns - 7 * MS)],
    )
    (stream,) = content.streams.values()
    assert content.ahead_ns == hour_ns and stream.ages_ns == [5 * MS, 7 * MS]
    assert content.steps[0].ahead_ns == hour_ns and content.problems == {"clock_step": 1}


def test_a_clock_that_is_set_forward_makes_no_gap() -> None:
    hour_ns = 3600 * S
    before, after = every(30, 100 * MS), every(30, 100 * MS)
    step = ClockStep.after(hour_ns, 0)
    later = [message(each.stamp_ns - T0 + hour_ns + 3 * S) for each in after]
    found = ContentSummary.of([*before, later[0], clock_step(step, hour_ns + 3 * S + 1), *later[1:]])
    (stream,) = found.streams.values()
    assert stream.longest_pause_ns < S and not stream.has_gap
    assert stream.rate_hz == pytest.approx(10, rel=0.02)


def test_the_estimates_of_other_clocks_begin_again_after_a_step() -> None:
    """The host's clock was set forward by an hour, and the other one does not drift."""
    hour_ns = 3600 * S
    after = [message(each.stamp_ns - T0 + hour_ns + 5 * S, each.source_ns + 5 * S) for each in heard(1, 20 * MS)]
    step = clock_step(ClockStep.after(hour_ns, 0), 4 * S)
    (row,) = ContentSummary.of([*heard(1, 20 * MS), step, *after]).clock_summaries()
    assert row["offset_plus_least_latency_ms"] == hour_ns // MS + 20
    assert row["drift_ppm"] is None and row["messages"] == 60
