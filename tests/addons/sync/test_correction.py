"""The correction of source stamps: which entries it changes, and by how much."""

from __future__ import annotations

from dataclasses import replace

import pytest

from igtl_gateway.addons.sync.correction import corrected, is_corrected
from igtl_gateway.addons.sync.lag import Lag, Verdict
from igtl_gateway.base.errors import GatewayError
from igtl_gateway.base.stamp import NS_PER_S
from igtl_gateway.gateway.log.corrections import CORRECTED, StampCorrection
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.note import Note

LATE = StampCorrection("TRANSFORM/Probe", "IMAGE/Video", 65_000_000, 50_000_000, 80_000_000, 0.0, 100 * NS_PER_S)

PROBE = ("TRANSFORM/Probe", "TRANSFORM")


def entry(seq: int, kind: Kind, channel: str, source_ns: int) -> Entry:
    return Entry(seq, seq * NS_PER_S, kind, channel, channel.partition("/")[0], (b"bytes",), (1,), source_ns)


def test_only_the_stamps_of_the_stream_change() -> None:
    entries = [
        entry(1, Kind.IGTL_IN, "TRANSFORM/Probe", 10 * NS_PER_S),
        entry(2, Kind.ROS_OUT, "/igtl/in/Probe/transform", 10 * NS_PER_S),
        entry(3, Kind.IGTL_IN, "IMAGE/Video", 11 * NS_PER_S),
        entry(4, Kind.IGTL_OUT, "TRANSFORM/Probe", 12 * NS_PER_S),
        entry(5, Kind.IGTL_IN, "TRANSFORM/Probe", 0),
    ]
    *found, note = corrected(entries, {PROBE: LATE})
    assert found == [replace(entries[0], source_ns=10 * NS_PER_S - 65_000_000), *entries[1:]]
    assert (note.seq, note.stamp_ns, note.kind) == (6, 5 * NS_PER_S + 1, Kind.EDGE_NOTE)
    told = Note.unpack(note.data())
    assert (told.code, told.stream, told.data["lag_ns"]) == (CORRECTED, "TRANSFORM/Probe", 65_000_000)
    assert "+65.0 ms (+50.0 to +80.0) behind IMAGE/Video" in told.text
    assert list(corrected([], {PROBE: LATE})) == []


def test_a_skew_counts_from_the_middle() -> None:
    drifting = replace(LATE, skew_ppm=100.0)
    middle = 100 * NS_PER_S + 65_000_000
    assert drifting.corrected_ns(middle) == 100 * NS_PER_S
    assert drifting.corrected_ns(middle + 50 * NS_PER_S) == 150 * NS_PER_S - 5_000_000
    assert drifting.corrected_ns(0) == 0
    assert "skew of +100.0 ppm" in drifting.note().text


def test_without_stamps_the_gateway_times_are_corrected() -> None:
    """A lag of gateway times has no relation to the stamps that some messages have."""
    entries = [entry(1, Kind.IGTL_IN, "TRANSFORM/Probe", 0), entry(2, Kind.IGTL_IN, "TRANSFORM/Probe", 7 * NS_PER_S)]
    *found, note = corrected(entries, {PROBE: replace(LATE, is_stamped=False)})
    assert [each.source_ns for each in found] == [NS_PER_S - 65_000_000, 2 * NS_PER_S - 65_000_000]
    assert Note.unpack(note.data()).text.startswith("gateway times, now the source stamps, of TRANSFORM/Probe are corr")


def test_a_corrected_stamp_is_never_that_of_an_unset_one() -> None:
    """The file has one value for "unset" and for a stamp that is equal to the gateway time."""
    late = entry(1, Kind.IGTL_IN, "TRANSFORM/Probe", NS_PER_S + 65_000_000)
    assert next(corrected([late], {PROBE: LATE})).source_ns == NS_PER_S - 1


def test_a_correction_to_before_1970() -> None:
    with pytest.raises(
        GatewayError, match=r"TRANSFORM/Probe, entry 1: found the stamp 64000000 ns, .* expected a stamp"
    ):
        list(corrected([entry(1, Kind.IGTL_IN, "TRANSFORM/Probe", 64_000_000)], {PROBE: LATE}))


@pytest.mark.parametrize(
    ("after", "gone"),
    [
        (Lag(Verdict.MEASURED, 0.0001, -0.001, 0.001), True),
        (Lag(Verdict.VARIES, -0.0008, -0.04, 0.04), True),
        (Lag(Verdict.MEASURED, 0.0473, 0.046, 0.048), False),
        (Lag(Verdict.MEASURED, 0.003, -0.1, 0.1), False),
        (Lag(Verdict.AMBIGUOUS, 0.0), False),
        (Lag(Verdict.MEASURED, 0.0, -0.001, 0.001, skew_ppm=200, skew_low_ppm=190, skew_high_ppm=210), False),
        (Lag(Verdict.MEASURED, 0.0, -0.001, 0.001, skew_ppm=5, skew_low_ppm=1, skew_high_ppm=9), True),
    ],
)
def test_what_is_measured_after_a_correction(after: Lag, gone: bool) -> None:
    before = Lag(Verdict.MEASURED, 0.0473, 0.046, 0.048, skew_ppm=100, skew_low_ppm=90, skew_high_ppm=110)
    assert is_corrected(before, after) is gone
