"""The correction of the source stamps of one stream by its lag; pure: entries in, entries out."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass, replace

from igtl_gateway.session.entry import Entry, Kind
from igtl_gateway.session.note import Level, Note

#: Code of the note at the end of a session with corrected stamps.
CORRECTED = "stamps_corrected"

_INPUTS = (Kind.IGTL_IN, Kind.ROS_IN)


@dataclass(frozen=True, slots=True)
class StampCorrection:
    """What is subtracted from the source stamps of a stream: a lag, and a skew since the middle.

    Attributes:
        stream: channel of the entries.
        behind: the stream that it is late against.
        lag_ns: lag in the middle, ns.
        low_ns, high_ns: its 95 % confidence interval.
        skew_ppm: parts per million; 0: the lag is constant.
        middle_ns: the middle, UTC ns of the other stream.
    """

    stream: str
    behind: str
    lag_ns: int
    low_ns: int
    high_ns: int
    skew_ppm: float
    middle_ns: int

    def corrected_ns(self, source_ns: int) -> int:
        """Return the stamp without the lag; 0 (unset) stays."""
        if not source_ns:
            return 0
        since_ns = source_ns - self.lag_ns - self.middle_ns
        return source_ns - self.lag_ns - round(since_ns * self.skew_ppm * 1e-6)

    def note(self) -> Note:
        """Return the note on the size and the reason of the correction."""
        skew = f" and a skew of {self.skew_ppm:+.1f} ppm" if self.skew_ppm else ""
        text = (
            f"source stamps of {self.stream} are corrected by a lag of {self.lag_ns / 1e6:+.1f} ms "
            f"({self.low_ns / 1e6:+.1f} to {self.high_ns / 1e6:+.1f}){skew} behind {self.behind}"
        )
        return Note(Level.INFO, CORRECTED, text, self.stream, asdict(self))


def corrected(entries: Iterable[Entry], correction: StampCorrection) -> Iterator[Entry]:
    """Yield the entries of a session with corrected source stamps of one input stream, and at the end the note.

    Entry numbers, gateway times and bytes stay.
    """
    last: Entry | None = None
    for entry in entries:
        last = entry
        if last.channel == correction.stream and last.kind in _INPUTS:
            yield replace(last, source_ns=correction.corrected_ns(last.source_ns))
        else:
            yield last
    if last is not None:
        note = correction.note()
        yield Entry(last.seq + 1, last.stamp_ns + 1, Kind.EDGE_NOTE, payload=(note.pack(),))
