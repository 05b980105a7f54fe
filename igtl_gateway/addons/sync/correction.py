"""The correction of the source stamps of one stream by its lag; pure: entries in, entries out."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace

from igtl_gateway.addon.notes import StampCorrection
from igtl_gateway.addon.reading import Entry, Kind
from igtl_gateway.addons.sync.lag import Lag

#: What may remain of a lag: this, or this part of the half width of its interval.  Other samples are compared again.
_REMAINS_S, _REMAINS = 0.001, 0.25

_INPUTS = (Kind.IGTL_IN, Kind.ROS_IN)


def is_corrected(before: Lag, after: Lag) -> bool:
    """Return whether the lag that was measured again, after the correction, is gone."""
    if not after.verdict.has_lag:
        return False
    half_s = (before.high_s - before.low_s) / 2
    skew_is_gone = not (before.has_skew and after.has_skew) or abs(after.skew_ppm) <= abs(before.skew_ppm) / 2
    return abs(after.lag_s) <= max(_REMAINS_S, _REMAINS * half_s) and skew_is_gone


def corrected(entries: Iterable[Entry], corrections: Mapping[tuple[str, str], StampCorrection]) -> Iterator[Entry]:
    """Yield the entries of a session with corrected source stamps of some input streams, and at the end the notes.

    Entry numbers, gateway times and bytes stay.

    Args:
        entries: of the session.
        corrections: channel and type of the entries of a stream → what to subtract.
    """
    last: Entry | None = None
    for entry in entries:
        last = entry
        correction = corrections.get((entry.channel, entry.type)) if entry.kind in _INPUTS else None
        # of one frame, the stamps in the messages are corrected where they are read, and no others
        is_whole = correction is not None and not correction.frame
        yield replace(entry, source_ns=correction.source_of(entry)) if correction and is_whole else entry
    if last is not None:
        for number, correction in enumerate(corrections.values(), 1):
            yield Entry(last.seq + number, last.stamp_ns + number, Kind.EDGE_NOTE, payload=(correction.note().pack(),))
