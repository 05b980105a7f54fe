"""The correction of source stamps: which entries it changes, and by how much."""

from __future__ import annotations

from dataclasses import replace

from igtl_gateway.session.entry import Entry, Kind
from igtl_gateway.session.note import Note
from igtl_gateway.stamp import NS_PER_S
from igtl_gateway.sync.correction import CORRECTED, StampCorrection, corrected

LATE = StampCorrection("TRANSFORM/Probe", "IMAGE/Video", 65_000_000, 50_000_000, 80_000_000, 0.0, 100 * NS_PER_S)


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
    *found, note = corrected(entries, LATE)
    assert found == [replace(entries[0], source_ns=10 * NS_PER_S - 65_000_000), *entries[1:]]
    assert (note.seq, note.stamp_ns, note.kind) == (6, 5 * NS_PER_S + 1, Kind.EDGE_NOTE)
    told = Note.unpack(note.data())
    assert (told.code, told.stream, told.data["lag_ns"]) == (CORRECTED, "TRANSFORM/Probe", 65_000_000)
    assert "+65.0 ms (+50.0 to +80.0) behind IMAGE/Video" in told.text
    assert list(corrected([], LATE)) == []


def test_a_skew_counts_from_the_middle() -> None:
    drifting = replace(LATE, skew_ppm=100.0)
    middle = 100 * NS_PER_S + 65_000_000
    assert drifting.corrected_ns(middle) == 100 * NS_PER_S
    assert drifting.corrected_ns(middle + 50 * NS_PER_S) == 150 * NS_PER_S - 5_000_000
    assert drifting.corrected_ns(0) == 0
    assert "skew of +100.0 ppm" in drifting.note().text
