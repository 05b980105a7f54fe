"""The correction of the source stamps of one stream by its lag; pure: entries in, entries out.

The lag of a stream in which a message has no stamp is one of gateway times.  There the corrected gateway times become
the source stamps of all messages, because a lag of gateway times has no relation to the stamps that some have.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, replace

from igtl_gateway.addon import Entry, GatewayError, Kind, Level, Note
from igtl_gateway.addons.sync.lag import Lag

#: Code of the note at the end of a session with corrected stamps.
CORRECTED = "stamps_corrected"

#: What may remain of a lag: this, or this part of the half width of its interval.  Other samples are compared again.
_REMAINS_S, _REMAINS = 0.001, 0.25

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
        is_stamped: whether the lag is one of the source stamps; otherwise it is one of gateway times.
    """

    stream: str
    behind: str
    lag_ns: int
    low_ns: int
    high_ns: int
    skew_ppm: float
    middle_ns: int
    is_stamped: bool = True

    def corrected_ns(self, source_ns: int) -> int:
        """Return the stamp without the lag; 0 (unset) stays."""
        if not source_ns:
            return 0
        since_ns = source_ns - self.lag_ns - self.middle_ns
        return source_ns - self.lag_ns - round(since_ns * self.skew_ppm * 1e-6)

    def source_of(self, entry: Entry) -> int:
        """Return the corrected source stamp of an entry.

        Raises:
            GatewayError: it is before 1970.
        """
        recorded_ns = entry.source_ns if self.is_stamped else entry.stamp_ns
        source_ns = self.corrected_ns(recorded_ns)
        if recorded_ns and source_ns <= 0:
            raise GatewayError(
                f"{self.stream}, entry {entry.seq}: found the stamp {recorded_ns} ns, which the correction moves to "
                f"{source_ns} ns, expected a stamp after 1970"
            )
        # a source stamp that is equal to the gateway time is recorded as unset
        return source_ns - 1 if source_ns == entry.stamp_ns > 1 else source_ns

    def note(self) -> Note:
        """Return the note on the size and the reason of the correction."""
        skew = f" and a skew of {self.skew_ppm:+.1f} ppm" if self.skew_ppm else ""
        stamps = "source stamps" if self.is_stamped else "gateway times, now the source stamps,"
        text = (
            f"{stamps} of {self.stream} are corrected by a lag of {self.lag_ns / 1e6:+.1f} ms "
            f"({self.low_ns / 1e6:+.1f} to {self.high_ns / 1e6:+.1f}){skew} behind {self.behind}"
        )
        return Note(Level.INFO, CORRECTED, text, self.stream, asdict(self))


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
        yield replace(entry, source_ns=correction.source_of(entry)) if correction else entry
    if last is not None:
        for number, correction in enumerate(corrections.values(), 1):
            yield Entry(last.seq + number, last.stamp_ns + number, Kind.EDGE_NOTE, payload=(correction.note().pack(),))
