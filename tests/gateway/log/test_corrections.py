"""The correction of stamps: one at a time and in arrays, and what facts in a file may be."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from igtl_gateway.base.errors import DamagedRecording, GatewayError
from igtl_gateway.gateway.log.corrections import CORRECTED, StampCorrection
from igtl_gateway.gateway.log.entry import Entry, Kind
from tests.tables import table

MS = 1_000_000
NOON = 1_700_000_000_000_000_000
ONE = StampCorrection("/tool", "/arm", 120 * MS, 118 * MS, 122 * MS, 50.0, NOON)


@table(
    "source_ns, skew_ppm, expected",
    [
        (0, 50.0, 0),  # unset stays
        (NOON, 0.0, NOON - 120 * MS),
        (NOON + 120 * MS, 50.0, NOON),  # the middle
        (NOON + 120 * MS + 10**12, 50.0, NOON + 10**12 - 50 * MS),  # 1,000 s behind it
        (NOON + 120 * MS - 10**12, 50.0, NOON - 10**12 + 50 * MS),
        (NOON + 120 * MS + 10**12, -50.0, NOON + 10**12 + 50 * MS),
    ],
)
def test_the_lag_is_subtracted_and_grows_with_the_skew(source_ns: int, skew_ppm: float, expected: int) -> None:
    assert replace(ONE, skew_ppm=skew_ppm).corrected_ns(source_ns) == expected


@given(
    st.lists(st.integers(NOON - 10**15, NOON + 10**15) | st.just(0), max_size=8),
    st.integers(-(10**12), 10**12),
    st.floats(-1000, 1000),
)
def test_an_array_is_corrected_as_its_stamps(stamps: list[int], lag_ns: int, skew_ppm: float) -> None:
    one = replace(ONE, lag_ns=lag_ns, skew_ppm=skew_ppm)
    assert one.corrected(np.array(stamps, np.int64)).tolist() == [one.corrected_ns(each) for each in stamps]


def entry(stamp_ns: int, source_ns: int) -> Entry:
    return Entry(7, stamp_ns, Kind.ROS_IN, "/tool", "a/msg/B", (b"",), source_ns=source_ns)


@table(
    "is_stamped, stamp_ns, source_ns, expected",
    [
        (True, NOON + 5, NOON, NOON - 120 * MS),
        (True, NOON + 5, 0, 0),
        (False, NOON + 5, NOON, NOON + 5 - 120 * MS),
        (True, NOON - 120 * MS, NOON, NOON - 120 * MS - 1),  # equal to the gateway time would mean unset
    ],
)
def test_the_source_of_an_entry(is_stamped: bool, stamp_ns: int, source_ns: int, expected: int) -> None:
    one = replace(ONE, is_stamped=is_stamped, skew_ppm=0.0)
    assert one.source_of(entry(stamp_ns, source_ns)) == expected


@pytest.mark.parametrize("source_ns", [1, 120 * MS])
def test_a_stamp_before_1970_is_refused(source_ns: int) -> None:
    with pytest.raises(GatewayError, match=rf"/tool, entry 7: found the stamp {source_ns} ns, .* after 1970"):
        replace(ONE, skew_ppm=0.0).source_of(entry(NOON, source_ns))


def test_the_note_states_all_of_it() -> None:
    note = replace(ONE, frame="tip").note()
    assert (note.code, note.stream) == (CORRECTED, "/tool")
    words = "source stamps of /tool (frame tip) are corrected by a lag of +120.0 ms (+118.0 to +122.0)"
    assert note.text == f"{words} and a skew of +50.0 ppm behind /arm"
    assert replace(ONE, is_stamped=False, skew_ppm=0.0).text() == (
        "gateway times, now the source stamps, of /tool are corrected by a lag of +120.0 ms (+118.0 to +122.0) "
        "behind /arm"
    )
    assert StampCorrection.of(note.data, "a.mcap") == replace(ONE, frame="tip", channel="/tool", behind_channel="/arm")


def test_facts_of_earlier_files_get_their_channels() -> None:
    names = ("stream", "behind", "lag_ns", "low_ns", "high_ns", "skew_ppm", "middle_ns")
    facts = {name: getattr(ONE, name) for name in names} | {"stream": "in:TRANSFORM/Tool", "behind": "out:/x:y"}
    found = StampCorrection.of(facts, "a.mcap")
    assert (found.channel, found.behind_channel, found.is_stamped) == ("TRANSFORM/Tool", "/x:y", True)


@table(
    "name, value, words",
    [
        ("lag_ns", 1 << 61, "an integer of ns"),
        ("lag_ns", -(1 << 61), "an integer of ns"),
        ("low_ns", 1.0, "an integer of ns"),
        ("high_ns", True, "an integer of ns"),
        ("skew_ppm", float("nan"), "a number of parts per million"),
        ("skew_ppm", 1_000_001, "a number of parts per million"),
        ("skew_ppm", "1", "a number of parts per million"),
        ("middle_ns", -1, "middle_ns"),
        ("is_stamped", 1, "is_stamped"),
        ("stream", 1, "stream"),
        ("more", 1, "more"),
    ],
)
def test_other_facts_are_refused_by_place(name: str, value: Any, words: str) -> None:
    with pytest.raises(DamagedRecording, match=f"^a.mcap.*{name}.*") as found:
        StampCorrection.of(ONE.facts() | {name: value}, "a.mcap")
    assert words in str(found.value)


@table(
    "name, value", [("lag_ns", (1 << 61) - 1), ("lag_ns", 1 - (1 << 61)), ("skew_ppm", 1e6), ("skew_ppm", -1_000_000)]
)
def test_facts_at_their_bounds_are_taken(name: str, value: Any) -> None:
    assert getattr(StampCorrection.of(ONE.facts() | {name: value}, "a.mcap"), name) == value
