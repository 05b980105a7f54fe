"""One guarded stream: its maximum age, and the oddities of its stamps and its translation.

Each oddity is reported once per *episode*: at its begin, and at its end with a count.

The fast path (`igtl_gateway.gateway.fastpath`) must give the same result as the full path, and a verification uses the
full path only.  So the checks depend on the stamps of the entries only: decreasing stamps are checked in every message,
everything else in one message per ``LOOK_NS``.  ``judge`` and ``observe`` are the rule.  ``passes_quickly`` and, in C,
``passes_guard`` of ``passage/_guard.h`` only pass what it has nothing to report about ("Twins" in ARCHITECTURE.md).
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Iterable, Sequence

from igtl_gateway.base.buffers import Buffer
from igtl_gateway.base.quantities import count_text, duration_text
from igtl_gateway.base.stamp import NS_PER_MS, NS_PER_S
from igtl_gateway.gateway.log.entry import Entry
from igtl_gateway.gateway.log.note import Level
from igtl_gateway.gateway.log.timing import FUTURE_NS, StampTiming
from igtl_gateway.gateway.outcome import Finding, Item

#: Interval of the checks: cheap for a stream at 1 kHz, and complete for slow streams.
LOOK_NS = 100 * NS_PER_MS
#: An episode ends after this time without the oddity.
EPISODE_NS = 10 * NS_PER_S
#: Number of checks with the same stamp until it counts as frozen: at least 2 s, so that stamps in whole seconds do not.
STILL_LOOKS = 20
#: Metres instead of millimetres are a factor of 1000 in the same direction; a tool may move between two checks.
_LEAST_FACTOR, _MOST_FACTOR = 500.0, 2_000.0
_SAME_DIRECTION = 0.99

#: A time that does not come; the largest number of 64 bits.
NEVER_NS = (1 << 63) - 1

STALE, FRESH, AGE_UNKNOWN = "stale", "fresh", "age_unknown"
JUMP, BACKWARDS, STILL, FUTURE = "unit_jump", "stamp_backwards", "stamp_still", "stamp_future"
#: Code of the note for the end of an episode of one of the last four.
CALM = "calm"
#: All codes of the guard's notes.
CODES = frozenset({STALE, FRESH, AGE_UNKNOWN, JUMP, BACKWARDS, STILL, FUTURE, CALM})

_WORDS = {
    JUMP: "jumps of the translation",
    BACKWARDS: "decreasing stamps",
    STILL: "stamps that do not change",
    FUTURE: "stamps in the future",
}

Place = tuple[float, float, float]
#: Watched, judged by Python only, reported as without a stamp, maximum age, ``ahead_ns``, stamp of the last message,
#: ``look_ns``, time of the next check, time after which the next episode ends (``NEVER_NS``: there is none), stamp and
#: time of the last check, checks with that stamp, translation then.
NativeState = tuple[bool, bool, bool, int, int, int, int, int, int, int, int, int, Place | None]
#: Level, code and text of a note.
Remark = tuple[Level, str, str]


class GuardedStream:
    """One guarded stream.

    Attributes:
        stream: name of the stream.
        last_ns: stamp of the last message (its gateway time if it had none).
        max_age_ns: maximum age; 0: none.
        look_ns: gateway time from which ``passes_quickly`` must call ``is_unremarkable``.
        arrived_ns: gateway time of the last check.
        ahead_ns: how far gateway time is ahead of the host's clock, with which source stamps are compared.
        clock_text: returns by which clock its stamps show an age at a gateway time, for notes.
        timing: timing of the checked stamps.
        stale: number of messages withheld since the stream became stale; 0: it is fresh.
        episodes: code of each current oddity → first time, last time (gateway time), count.
    """

    __slots__ = (
        "_due_ns",
        "_place",
        "_seen_ns",
        "_stale_since_ns",
        "_still",
        "_unknown_reported",
        "_watch",
        "ahead_ns",
        "arrived_ns",
        "clock_text",
        "episodes",
        "last_ns",
        "look_ns",
        "max_age_ns",
        "stale",
        "stream",
        "timing",
    )

    def __init__(self, stream: str, max_age_ns: int, *, watch: bool) -> None:
        self.stream = stream
        self.last_ns = self.look_ns = self.arrived_ns = self.ahead_ns = 0
        self.timing = StampTiming()
        self.stale = 0
        self.episodes: dict[str, list[int]] = {}
        self.max_age_ns = max_age_ns
        self.clock_text: Callable[[int], str] = _of_sender
        self._watch = watch
        self._due_ns = 0
        self._seen_ns = 0  # stamp at the last check
        self._still = 0  # number of checks since the stamp changed
        self._place: Place | None = None
        self._stale_since_ns = 0
        self._unknown_reported = False

    @property
    def age_ns(self) -> int | None:
        """Age of the last checked message; None if it had no stamp, and before the first check."""
        known = self._seen_ns not in (0, self.arrived_ns)
        return self.arrived_ns - self.ahead_ns - self._seen_ns if known else None

    # -- the native passage -------------------------------------------------------------------------------------

    def native_state(self) -> NativeState:
        """Return what the native passage needs to judge messages that give no reason for a remark."""
        return (
            self._watch,
            bool(self.stale),
            self._unknown_reported,
            self.max_age_ns,
            self.ahead_ns,
            self.last_ns,
            self.look_ns,
            self._due_ns,
            min((last_ns + EPISODE_NS for _, last_ns, _ in self.episodes.values()), default=NEVER_NS),
            self._seen_ns,
            self.arrived_ns,
            self._still,
            self._place,
        )

    def after_native(
        self,
        state: tuple[int, int, int, int, int, int, Place | None],
        looks: Sequence[tuple[int, int]],
    ) -> None:
        """Take over the state after messages that the native passage has judged.

        Args:
            state: stamp of the last message, ``look_ns``, time of the next check, stamp and time of the last check,
                number of checks with that stamp, translation at the last check.
            looks: stamp (0: unset) and time of arrival by the host's clock of each check; UTC ns.
        """
        self.last_ns, self.look_ns, self._due_ns, self._seen_ns, self.arrived_ns, self._still, self._place = state
        for stamp_ns, arrival_ns in looks:
            self.timing.add(stamp_ns, arrival_ns)

    # -- maximum age --------------------------------------------------------------------------------------------

    def judge(self, now_ns: int, own_ns: int) -> tuple[bool, list[Remark]]:
        """Return whether to withhold a message with the stamp ``own_ns`` (0: none) at ``now_ns``, and the remarks."""
        code = self._age_code(now_ns, own_ns)
        if code == AGE_UNKNOWN:
            self._unknown_reported = True
            text = f"{self.stream}: messages without stamps, age unknown (max_age_s)"
            return False, [(Level.WARN, AGE_UNKNOWN, text)]
        if code == STALE:
            self.stale += 1
            if self.stale > 1:
                return True, []
            self._stale_since_ns = now_ns
            age, most = duration_text(now_ns - self.ahead_ns - own_ns), duration_text(self.max_age_ns)
            clock = self.clock_text(now_ns)
            text = f"{self.stream} is stale: messages are {age} old {clock}, expected at most {most}"
            return True, [(Level.ERROR, STALE, text)]
        return False, self._fresh(now_ns) if code == FRESH else []

    def _age_code(self, now_ns: int, own_ns: int) -> str:
        """Return what the age of a message changes or withholds: the code of a remark, or ""."""
        if self.max_age_ns:
            if own_ns <= 0:
                return "" if self._unknown_reported else AGE_UNKNOWN
            if now_ns - self.ahead_ns - own_ns > self.max_age_ns:
                return STALE
        return FRESH if self.stale else ""  # also if the maximum age was changed to none

    def _fresh(self, now_ns: int) -> list[Remark]:
        """Return the remark that a stream which was stale is no longer so."""
        number, self.stale = self.stale, 0
        lasted = duration_text(now_ns - self._stale_since_ns)
        dropped = f"{count_text(number, 'message')} dropped as too old"
        return [(Level.INFO, FRESH, f"{self.stream} is recent again, after {lasted}: {dropped}")]

    # -- watchers -----------------------------------------------------------------------------------------------

    def observe(self, now_ns: int, stamp_ns: int, place: Place | None = None) -> list[Remark]:
        """Check a message; return the new remarks about its stream.

        Args:
            now_ns: gateway time.
            stamp_ns: stamp of the message; ``now_ns`` if it has none or if source stamps are not forwarded.
            place: translation of a pose; None for other messages.
        """
        if not self._watch:
            return []
        odd = self._find_oddities(now_ns, stamp_ns, place)
        findings: list[Remark] = []
        for code in odd:
            if code in self.episodes:
                self.episodes[code][1] = now_ns
                self.episodes[code][2] += 1
            else:
                self.episodes[code] = [now_ns, now_ns, 1]
                findings.append((Level.WARN, code, f"{self.stream}: {self._describe(code, now_ns, stamp_ns, place)}"))
        self.last_ns = stamp_ns
        if now_ns >= self._due_ns:
            for code in self._end_episodes(now_ns):
                since_ns, last_ns, number = self.episodes.pop(code)
                lasted = duration_text(last_ns - since_ns)
                seen = f"{_WORDS[code]} have ended after {count_text(number, 'time')} in {lasted}"
                findings.append((Level.INFO, CALM, f"{self.stream}: {seen}"))
            self.timing.add(stamp_ns if stamp_ns != now_ns else 0, now_ns - self.ahead_ns)
            self._still = self._still + 1 if stamp_ns == self._seen_ns else 0
            self._seen_ns = stamp_ns
            self._place = place
            self.arrived_ns = now_ns
            self._due_ns = now_ns + LOOK_NS
            self.look_ns = 0 if self.max_age_ns else self._due_ns
        return findings

    def passes_quickly(self, now_ns: int, stamp_ns: int, data: Buffer, numbers: struct.Struct | None, at: int) -> bool:
        """``is_unremarkable`` for the fast path: most messages pass after two comparisons."""
        if (stamp_ns < self.last_ns or now_ns >= self.look_ns) and not self.is_unremarkable(
            now_ns, stamp_ns, data, numbers, at
        ):
            return False
        self.last_ns = stamp_ns
        return True

    def is_unremarkable(self, now_ns: int, stamp_ns: int, data: Buffer, numbers: struct.Struct | None, at: int) -> bool:
        """Return whether a message may pass without a remark: then it is checked, else nothing changes.

        Args:
            now_ns, stamp_ns: as for ``observe``.
            data, numbers, at: the message, and format (None: not a pose) and offset of its translation.
        """
        # a stamp of now may be that of a message without one
        if self.stale or self._age_code(now_ns, 0 if stamp_ns == now_ns else stamp_ns):
            return False
        if not self._watch:
            return True
        place: Place | None = None
        if now_ns >= self._due_ns:
            if numbers:
                x, y, z = numbers.unpack_from(data, at)
                place = x, y, z
            if self._end_episodes(now_ns):
                return False
        if any(code not in self.episodes for code in self._find_oddities(now_ns, stamp_ns, place)):
            return False
        self.observe(now_ns, stamp_ns, place)
        return True

    def _find_oddities(self, now_ns: int, stamp_ns: int, place: Place | None) -> list[str]:
        """Return the codes of the oddities of a message."""
        odd = [BACKWARDS] if stamp_ns < self.last_ns else []
        if now_ns < self._due_ns:
            return odd
        if stamp_ns != now_ns and stamp_ns - now_ns + self.ahead_ns > FUTURE_NS:
            odd.append(FUTURE)
        if stamp_ns == self._seen_ns and self._still + 1 >= STILL_LOOKS:
            odd.append(STILL)
        if self._place and place and is_unit_jump(self._place, place):
            odd.append(JUMP)
        return odd

    def _end_episodes(self, now_ns: int) -> list[str]:
        return [code for code, (_, last_ns, _) in self.episodes.items() if now_ns - last_ns > EPISODE_NS]

    def _describe(self, code: str, now_ns: int, stamp_ns: int, place: Place | None) -> str:
        if code == BACKWARDS:
            return f"stamps decrease by {duration_text(self.last_ns - stamp_ns)}"
        if code == FUTURE:
            ahead = duration_text(stamp_ns - now_ns + self.ahead_ns)
            clock = self.clock_text(now_ns)
            return f"stamps are {ahead} in the future {clock}; synchronise the clocks (NTP, PTP)"
        if code == STILL:
            return (
                f"stamps do not change while messages arrive ({STILL_LOOKS} checks); check whether the source is frozen"
            )
        before, after = (math.hypot(*one) if one else 0.0 for one in (self._place, place))
        return (
            f"translation jumped from {before:.6g} to {after:.6g} in the same direction, a factor of "
            f"{max(before, after) / min(before, after):.4g}: metres instead of millimetres?"
        )


def _of_sender(_now_ns: int) -> str:
    return "by the sender's clock"


def is_unit_jump(before: Sequence[float], after: Sequence[float]) -> bool:
    """Return whether one translation is about a thousand times the other, in the same direction."""
    one, other = math.hypot(*before), math.hypot(*after)
    least, most = min(one, other), max(one, other)
    if not (least > 0.0 and _LEAST_FACTOR * least <= most <= _MOST_FACTOR * least):  # also false for NaN
        return False
    cosine = sum((x / one) * (y / other) for x, y in zip(before, after, strict=True))
    return cosine >= _SAME_DIRECTION


def findings_of(entry: Entry, remarks: Iterable[Remark]) -> list[Item]:
    """Return the findings for the remarks about a stream."""
    return [Finding(level, code, text, entry.channel, entry.links) for level, code, text in remarks]
