"""How evenly something comes, from counts that are read now and then: rate, last minute, pauses.  Pure.

A pause is judged by the stream itself: it is far longer than the usual interval of the last minute.  Where the guard
looks at the messages, their stamps of arrival show how long it was; else the times at which the counts were read.
"""

from __future__ import annotations

from collections import deque
from statistics import median

from igtl_gateway.addon import NS_PER_S
from igtl_gateway.addon.live import RHYTHM_HZ, SILENT_NS

#: Seconds of a sparkline, one value each: the last minute.
SPARK_S = 60
_MINUTE_NS = SPARK_S * NS_PER_S
#: Time over which a rate is averaged, ns.
_RATE_NS = 5 * NS_PER_S
#: A pause is longer than this and than this number of usual intervals; at the least rate that is the silence of
#: /diagnostics.
_PAUSE_NS, _INTERVALS = NS_PER_S, 5
#: Of this many seconds, this many with messages are a rhythm.
_SECONDS, _WITH = 5, 3
_LAST_SECONDS = (1 << _SECONDS) - 1
#: Seconds of a block whose rate is remembered if it is steady (this share of them is within this factor of the median),
#: blocks that are kept, and blocks from which on a rate is judged.
_BLOCK_S, _STEADY, _FACTOR, _BLOCKS, _ENOUGH = 10, 2 / 3, 1.5, 60, 3
#: A stream is slower than before below this share of the rate; the least rate that is judged, and the time after a
#: pause in which it is not, ns.
_SHARE, _LEAST_HZ, _AFTER_NS = 0.5, 2.0, 10 * NS_PER_S
#: Values below this keep a decimal in the text of a sparkline.
_EXACT = 1_000


class Rhythm:
    """A stream or a link over the samples; times in ns of one monotonic clock.

    Attributes:
        received: messages so far.
        moved_ns: when the last message arrived, as far as it is known.
        gap_ns, gap_utc_ns: the longest time between two messages of a regular stream, and when it ended.
        is_regular: whether it has ever come with a rhythm.
        rate_hz: messages per second.
        spark: messages of each of the last seconds.
        pauses: end and length of each pause of the last minute.
    """

    def __init__(self) -> None:
        self.received = self.moved_ns = self.gap_ns = self.gap_utc_ns = 0
        self.is_regular = False
        self.rate_hz = 0.0
        self.spark: deque[float] = deque(maxlen=SPARK_S)
        self._texts: deque[str] = deque(maxlen=SPARK_S)
        self.pauses: deque[tuple[int, int]] = deque(maxlen=SPARK_S)
        self._samples: deque[tuple[int, int]] = deque()
        self._second, self._at_second = 0, 0.0
        self._paused_until_ns = 0  # of the last pause that the guard has seen
        self._blocks: deque[float] = deque(maxlen=_BLOCKS)
        self._before_hz = 0.0  # their median, if they are enough
        self._seconds = 0
        self._came = 0  # a bit for each of the last seconds: 1 for one with messages

    @property
    def spark_text(self) -> str:
        """``spark`` as the page gets it."""
        return " ".join(self._texts)

    def take(
        self, now_ns: int, received: int, utc_ns: int = 0, arrived_ns: int = 0, pause: tuple[int, int] = (0, 0)
    ) -> None:
        """Take the count of a sample.

        Args:
            now_ns: when it was read.
            utc_ns: the same in UTC.
            arrived_ns: when the last message arrived; 0: only the counts are known.
            pause: end, on any clock, and length of the last long time between two stamps of arrival.
        """
        is_first, then_ns = not self._samples, self._samples[-1][0] if self._samples else now_ns
        is_new, self._paused_until_ns = not is_first and pause[0] != self._paused_until_ns, pause[0]
        if is_new:
            self._pause(now_ns, utc_ns, pause[1], 0)
        elif not arrived_ns and received != self.received and not is_first:
            self._pause(now_ns, utc_ns, now_ns - self.moved_ns, now_ns - then_ns)
        if received != self.received or is_first:
            self.moved_ns = now_ns
        self.moved_ns = arrived_ns or self.moved_ns
        self.received = received
        self._count(now_ns)
        if self.is_regular and now_ns - self.moved_ns > self.gap_ns:
            self.gap_ns, self.gap_utc_ns = now_ns - self.moved_ns, utc_ns
        while self.pauses and now_ns - self.pauses[0][0] > _MINUTE_NS:
            self.pauses.popleft()

    def silent_ns(self, now_ns: int) -> int:
        """Return for how long a regular stream has been silent; 0 if that is usual."""
        since_ns = now_ns - self.moved_ns
        return since_ns if self.is_regular and self._is_pause(since_ns) else 0

    def slower_than_hz(self, now_ns: int) -> float:
        """Return the rate before, if it is now far below it; 0 if it is not."""
        before_hz = self._before_hz
        is_slow = before_hz >= _LEAST_HZ and self.rate_hz < _SHARE * before_hz
        has_paused = self.silent_ns(now_ns) or (self.pauses and now_ns - self.pauses[-1][0] < _AFTER_NS)
        return before_hz if is_slow and not has_paused else 0.0

    def _is_pause(self, length_ns: int) -> bool:
        """Return whether a time without a message is a pause; the usual interval is looked at for a long one only."""
        if length_ns < _PAUSE_NS:
            return False
        came = [value for value in self.spark if value > 0]
        intervals_ns = round(_INTERVALS / median(came) * NS_PER_S) if came else SILENT_NS
        return length_ns >= min(intervals_ns, SILENT_NS)

    def _pause(self, now_ns: int, utc_ns: int, length_ns: int, fuzzy_ns: int) -> None:
        """Take a time between two messages, which is known to within ``fuzzy_ns``."""
        if not self.is_regular:
            return
        if length_ns > self.gap_ns:
            self.gap_ns, self.gap_utc_ns = length_ns, utc_ns
        if self._is_pause(length_ns - fuzzy_ns):
            self.pauses.append((now_ns, length_ns))

    def _count(self, now_ns: int) -> None:
        """Take the messages of each second that is over: between two samples they have come evenly."""
        samples, received = self._samples, self.received
        then_ns, before = samples[-1] if samples else (now_ns, received)
        if not samples:
            self._second, self._at_second = now_ns // NS_PER_S, received
        seconds = range(max(self._second + 1, now_ns // NS_PER_S - SPARK_S), now_ns // NS_PER_S + 1)
        for second in seconds:
            share = (second * NS_PER_S - then_ns) / (now_ns - then_ns)
            at_second = before + (received - before) * min(max(share, 0.0), 1.0)
            self.spark.append(value := round(at_second - self._at_second, 1))
            self._texts.append(f"{value:g}" if value < _EXACT else f"{value:.0f}")
            self._second, self._at_second = second, at_second
            self._came = (self._came << 1 | (value > 0)) & _LAST_SECONDS
            self._seconds += 1
            if self._seconds % _BLOCK_S == 0:
                self._keep_block()
        samples.append((now_ns, received))
        while len(samples) > 2 and now_ns - samples[1][0] >= _RATE_NS:
            samples.popleft()
        since_ns, first = samples[0]
        self.rate_hz = round((received - first) / (now_ns - since_ns) * NS_PER_S, 3) if now_ns > since_ns else 0.0
        self.is_regular = self.is_regular or (self._came.bit_count() >= _WITH and self.rate_hz >= RHYTHM_HZ)

    def _keep_block(self) -> None:
        block = list(self.spark)[-_BLOCK_S:]
        usual_hz = median(block)
        if sum(usual_hz / _FACTOR <= value <= usual_hz * _FACTOR for value in block) >= _STEADY * len(block):
            self._blocks.append(usual_hz)
            self._before_hz = median(self._blocks) if len(self._blocks) >= _ENOUGH else 0.0
