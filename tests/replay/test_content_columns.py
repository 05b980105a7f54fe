"""``replay/content_columns.py``: equal to the summary of the entries, to the last figure."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from igtl_gateway.gateway.log.clocksteps import ClockStep
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.timing import StampTiming
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.record.sessionfile.writer import SessionWriter
from igtl_gateway.replay.content_columns import content_of
from igtl_gateway.replay.content_summary import ContentSummary

FIXTURES = sorted((Path(__file__).parents[2] / "fixtures").glob("*.mcap"))
SECOND = 1_000_000_000


def facts(content: ContentSummary) -> dict[str, Any]:
    """All that it has, with the order of its streams of a clock."""
    timings = {
        link: [
            (name, {slot: getattr(timing, slot) for slot in StampTiming.__slots__}) for name, timing in found.items()
        ]
        for link, found in content.clocks.items()
    }
    streams = {key: asdict(stream) | {"ages_ns": stream.ages_ns} for key, stream in content.streams.items()}
    return {
        "entries": content.entries,
        "streams": streams,
        "order": [list(found) for found in content.clocks.values()],
        "timings": timings,
        "clocks": content.clock_summaries(),
        "notes": content.notes,
        "problems": content.problems,
        "steps": content.steps,
        "addresses": content.addresses,
    }


@pytest.mark.parametrize("path", FIXTURES, ids=lambda path: path.stem)
def test_a_fixture(path: Path) -> None:
    with SessionFile.open(path) as file:
        found = facts(content_of(file))
        assert found == facts(ContentSummary.of(file.entries()))
        assert found["entries"] == file.entry_count


#: What comes next: pause in ns, what it is, age of its stamp in ns (None: it has none), its links, its size.
ROWS = st.lists(
    st.tuples(
        st.sampled_from((1, 1_000_000, 37_000_000, 600_000_000, 11 * SECOND, 70 * SECOND)),
        st.sampled_from(("in", "in2", "out", "ros_in", "ros_out", "note", "forward", "back")),
        st.sampled_from((None, 0, 1, 5_000_000, -3_000_000, -200_000_000, 40 * SECOND, 10**18)),
        st.sampled_from(((1,), (2,), (1, 2), ())),
        st.integers(0, 40),
    ),
    max_size=60,
)


def session(rows: list[Any]) -> list[Entry]:
    """Entries of a random session."""
    stamp_ns, seq, ahead_ns, entries = 1_700_000_000 * SECOND, 0, 0, []
    for pause_ns, what, age_ns, links, size in rows:
        stamp_ns, seq = stamp_ns + pause_ns, seq + 1
        source_ns = 0 if age_ns is None else stamp_ns - age_ns
        payload = (bytes(size),)
        match what:
            case "forward" | "back":
                step = ClockStep.after(5 * SECOND if what == "forward" else -3 * SECOND, ahead_ns)
                ahead_ns = step.ahead_ns
                stamp_ns += step.jump_ns
                entries.append(Entry(seq, stamp_ns, Kind.EDGE_NOTE, payload=(step.note().pack(),)))
            case "note":
                entries.append(Entry(seq, stamp_ns, Kind.NOTE, payload=(b'{"code":"x","level":"WARN"}',)))
            case "ros_in" | "ros_out":
                entries.append(Entry(seq, stamp_ns, Kind(what), "/t", "std_msgs/msg/Empty", payload, (), source_ns))
            case _:
                kind, name = (Kind.IGTL_OUT if what == "out" else Kind.IGTL_IN), "B" if what == "in2" else "A"
                entries.append(Entry(seq, stamp_ns, kind, f"STRING/{name}", "STRING", payload, links, source_ns))
    return entries


@given(rows=ROWS, begin_s=st.sampled_from((0, 1_700_000_001, 1_700_000_050)), chunk_bytes=st.sampled_from((300, 9_000)))
def test_a_random_session(
    tmp_path_factory: pytest.TempPathFactory, rows: list[Any], begin_s: int, chunk_bytes: int
) -> None:
    path = tmp_path_factory.mktemp("session") / "a.mcap"
    writer = SessionWriter(path, {}, chunk_bytes=chunk_bytes)
    for entry in session(rows):
        writer.write(entry)
    writer.close({})
    with SessionFile.open(path) as file:
        assert facts(content_of(file, begin_s * SECOND)) == facts(ContentSummary.of(file.entries(), begin_s * SECOND))


@given(
    rows=st.lists(
        st.tuples(st.sampled_from((0, 1, 10**6, 10**9, 10**10, 3 * 10**10)), st.integers(-(10**10), 10**18)), min_size=1
    ),
    cuts=st.lists(st.integers(0, 50), max_size=4),
)
def test_stamps_in_any_pieces(rows: list[tuple[int, int]], cuts: list[int]) -> None:
    arrivals = np.cumsum([1_700_000_000 * SECOND, *(step for step, _ in rows)], dtype=np.int64)[1:]
    stamps = np.maximum(arrivals - np.array([age for _, age in rows], np.int64), 0)
    one, many = StampTiming(), StampTiming()
    for stamp, arrival in zip(stamps.tolist(), arrivals.tolist(), strict=True):
        one.add(stamp, arrival)
    for begin, end in zip([0, *sorted(cuts)], [*sorted(cuts), len(rows)], strict=True):
        if begin < min(end, len(rows)):
            many.add_columns(stamps[begin:end], arrivals[begin:end])
    assert [getattr(many, slot) for slot in StampTiming.__slots__] == [getattr(one, slot) for slot in one.__slots__]
