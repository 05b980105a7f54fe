"""The correction of the stamps of a stream by its lag, as ``sync --apply`` records it.

The bytes of the messages stay those of the record.  What reads stamps applies the correction, by means of
``replay.recorded_stamps``.  The lag of a stream in which a message has no stamp is one of gateway times.  There the
corrected gateway times become the stamps of all messages, because a lag of gateway times has no relation to the stamps
that some have.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from igtl_gateway.base.errors import GatewayError
from igtl_gateway.base.untrusted import shape
from igtl_gateway.gateway.log.entry import Entry
from igtl_gateway.gateway.log.note import Level, Note

Times = npt.NDArray[np.int64]

#: Code of the note at the end of a session with corrected stamps.
CORRECTED = "stamps_corrected"
#: Item of the session metadata: a JSON array with the corrections, as the data of these notes.
CORRECTIONS = "stamps_corrected"


@dataclass(frozen=True, slots=True)
class StampCorrection:
    """What is subtracted from the stamps of a stream: a lag, and a skew since the middle.

    Attributes:
        stream: key of the stream, for people.
        behind: key of the stream that it is late against.
        lag_ns: lag in the middle, ns.
        low_ns, high_ns: its 95 % confidence interval.
        skew_ppm: parts per million; 0: the lag is constant.
        middle_ns: the middle, UTC ns of the other stream.
        is_stamped: whether the lag is one of the stamps; otherwise it is one of gateway times.
        channel, type: of the entries of the stream.
        behind_channel, behind_type: likewise, of the other stream.
        frame: of a topic with poses of several frames the one that is corrected; ``""``: all.
    """

    stream: str
    behind: str
    lag_ns: int
    low_ns: int
    high_ns: int
    skew_ppm: float
    middle_ns: int
    is_stamped: bool = True
    channel: str = ""
    type: str = ""
    behind_channel: str = ""
    behind_type: str = ""
    frame: str = ""

    def corrected_ns(self, source_ns: int) -> int:
        """Return the stamp without the lag; 0 (unset) stays."""
        if not source_ns:
            return 0
        since_ns = source_ns - self.lag_ns - self.middle_ns
        return source_ns - self.lag_ns - round(since_ns * self.skew_ppm * 1e-6)

    def corrected(self, stamps: Times) -> Times:
        """Return stamps (N,), UTC ns, without the lag; 0 (unset) stays."""
        moved = stamps - self.lag_ns
        skew = np.rint((moved - self.middle_ns) * (self.skew_ppm * 1e-6)).astype(np.int64) if self.skew_ppm else 0
        return np.where(stamps == 0, 0, moved - skew)

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

    def text(self) -> str:
        """Return the size and the reason of the correction."""
        skew = f" and a skew of {self.skew_ppm:+.1f} ppm" if self.skew_ppm else ""
        stamps = "source stamps" if self.is_stamped else "gateway times, now the source stamps,"
        frame = f" (frame {self.frame})" if self.frame else ""
        return (
            f"{stamps} of {self.stream}{frame} are corrected by a lag of {self.lag_ns / 1e6:+.1f} ms "
            f"({self.low_ns / 1e6:+.1f} to {self.high_ns / 1e6:+.1f}){skew} behind {self.behind}"
        )

    def note(self) -> Note:
        """Return the note on the size and the reason of the correction."""
        return Note(Level.INFO, CORRECTED, self.text(), self.stream, self.facts())

    def facts(self) -> dict[str, Any]:
        """Return the correction as JSON values."""
        return {each.name: getattr(self, each.name) for each in fields(self)}

    @classmethod
    def of(cls, facts: Any, place: str) -> StampCorrection:
        """Return the correction of facts in a file; earlier ones lack the channels.  Raises DamagedRecording."""
        _FACTS(facts, place)
        found = cls(**facts)
        if not found.channel:
            found = replace(found, channel=_channel_of(found.stream), behind_channel=_channel_of(found.behind))
        return found


#: Of a lag in ns: 68 years.
_MOST_NS = 1 << 61


def _lag(value: Any, place: str) -> None:
    """A time in ns, of either sign."""
    if type(value) is not int or not -_MOST_NS < value < _MOST_NS:
        raise shape.wrong(place, value, "an integer of ns")


def _skew(value: Any, place: str) -> None:
    """Parts per million."""
    if type(value) not in (int, float) or not abs(value) <= 1e6:
        raise shape.wrong(place, value, "a number of parts per million")


_TEXTS = ("stream", "behind", "channel", "type", "behind_channel", "behind_type", "frame")
_LAGS = ("lag_ns", "low_ns", "high_ns")
_FACTS = shape.fields(
    {
        **dict.fromkeys(_TEXTS, shape.text),
        **dict.fromkeys(_LAGS, _lag),
        "skew_ppm": _skew,
        "middle_ns": shape.number,
        "is_stamped": shape.truth,
    },
    needed=("stream", "behind", *_LAGS, "skew_ppm", "middle_ns"),
    other=shape.unexpected,
)


def _channel_of(key: str) -> str:
    """The channel of the entries of a stream with this key."""
    return key.partition(":")[2] if key.startswith(("in:", "out:")) else key
