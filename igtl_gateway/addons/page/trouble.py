"""What can be wrong with a stream or a peer, from the samples of a bridge: a state, a sentence, and advice.  Pure."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from statistics import median_low
from typing import Any

from igtl_gateway.addon import NS_PER_S
from igtl_gateway.addon.checking import RULES
from igtl_gateway.addon.notes import DROPPED, HARMLESS
from igtl_gateway.addon.terminal import by_count, count_text, duration_text, seconds_text, size_text
from igtl_gateway.addons.page.rhythm import Rhythm

#: States, the worst first: each has a word, a shape and a colour on the page.  OFF: nothing comes, and nothing has to.
ERROR, SILENT, WARNING, WAITING, OK, OFF = "error", "silent", "warning", "waiting", "ok", "off"
#: States of which nothing is to be done.
FINE = frozenset({OK, OFF})
#: Losses are a problem for this time, ns.
_RECENT_NS = 10_000_000_000
#: Messages are late if most of the last ones are older than this on arrival (rule W306 of `doctor`, which has the least
#: age of all, begins at a second); above the second one they are of another epoch, such as replayed ones.
LATE_NS, _EPOCH_NS, _AGES = 250_000_000, 86_400_000_000_000, 10
#: A clock is ahead by more than this, as for rule W303.
AHEAD_NS = 100_000_000
#: A send queue with more is of a peer that reads slowly; so are bytes for which its system has no room in all of the
#: last samples, which are of this time, ns: the kernel keeps minutes of small messages before the queue fills.
_QUEUED, _QUEUED_BYTES = 50, 1 << 20
_STUCK_NS, _STUCK_BYTES = 7 * NS_PER_S // 2, 16 << 10

_ADVICE = {rule.id[5:]: rule.advice for rule in RULES}
#: What no rule of `doctor` is about → its advice.
_OWN = {"left": "start its program again, or look at its network"}
#: Reason of a loss, or oddity that the guard reports → rule of `doctor` whose advice applies.
_RULE_OF = {
    "bad_crc": "E207",
    "malformed": "E210",
    "truncated": "E210",
    "wire_error": "E210",
    "too_large": "E110",
    "no_conversion": "W604",
    "not_finite": "E503",
    "too_many_streams": "W702",
    "queue": "W114",
    "stale": "W306",
    "old": "W306",
    "unit_jump": "W501",
    "stamp_backwards": "W304",
    "stamp_still": "W302",
    "stamp_future": "W303",
    "silent": "W507",
    "slower": "W507",
    "lost": "W703",
    "not_connected": "E101",
}
_ODD = {
    "unit_jump": "the translation jumps by a factor of 1,000",
    "stamp_backwards": "stamps decrease",
    "stamp_still": "stamps do not change",
    "stamp_future": "stamps are in the future",
}


@dataclass(frozen=True, slots=True)
class Trouble:
    """State and sentence of a row, and what decides its advice."""

    state: str
    text: str = ""
    rule: str = ""

    @property
    def advice(self) -> str:
        """That of `doctor`, or our own; "" if there is none."""
        advice = _OWN.get(self.rule) or _ADVICE.get(_RULE_OF.get(self.rule, ""), "")
        return advice[:1].upper() + advice[1:]


_GOOD = Trouble(OK)


@dataclass(slots=True)
class Losses:
    """What a stream or a link has lost, over the samples; times in ns.

    Attributes:
        stuck_bytes: what a peer has had no room for since some samples; 0 if it has some now and then.
    """

    since_ns: int
    lost: int = 0
    lost_ns: int = 0
    stuck_bytes: int = 0
    _unconfirmed: deque[tuple[int, int]] = field(default_factory=deque)

    def take(self, now_ns: int, lost: int, unconfirmed_bytes: int = 0) -> None:
        """Take the counts of a sample."""
        found = self._unconfirmed
        if not unconfirmed_bytes:
            found.clear()
        else:
            found.append((now_ns, unconfirmed_bytes))
            while len(found) > 1 and now_ns - found[1][0] >= _STUCK_NS:
                found.popleft()
        least = min(size for _, size in found) if found and now_ns - found[0][0] >= _STUCK_NS else 0
        self.stuck_bytes = least if least > _STUCK_BYTES else 0
        if lost > self.lost:
            self.lost_ns = now_ns
        self.lost = lost

    def is_recent(self, now_ns: int) -> bool:
        """Whether something was lost just now."""
        return bool(self.lost_ns) and now_ns - self.lost_ns < _RECENT_NS


@dataclass(slots=True)
class Watched:
    """A stream of a link over the samples: its row of ``watched``, its rhythm, the ages of its last messages.

    ``unseen_ns``: time of the last sample with messages that the guard did not see.
    """

    row: Mapping[str, Any]
    rhythm: Rhythm = field(default_factory=Rhythm)
    ages: deque[int] = field(default_factory=lambda: deque(maxlen=_AGES))
    unseen_ns: int = 0

    def take(self, now_ns: int, utc_ns: int, row: Mapping[str, Any], *, came: bool) -> None:
        """Take the row of a sample; ``came``: whether messages have come since the one before."""
        is_seen = row["looks"] != self.rhythm.received
        self.row = row
        if row["age_ns"] is not None and (is_seen or not self.ages):
            self.ages.append(row["age_ns"])
        arrived_ns = 0 if row["silent_ns"] is None else now_ns - row["silent_ns"]
        until_ns, pause_ns = row["pause"]
        if came and not is_seen:
            arrived_ns = self.unseen_ns = now_ns
        elif self.unseen_ns:
            pause_ns = min(pause_ns, now_ns - self.unseen_ns)
        self.rhythm.take(now_ns, row["looks"], utc_ns, arrived_ns, (until_ns, pause_ns))

    @property
    def late_ns(self) -> int:
        """How old messages are on arrival if that is too much; 0 if it is not, or they are of another epoch."""
        late_ns = median_low(self.ages) if self.ages else 0
        return late_ns if LATE_NS < late_ns < _EPOCH_NS else 0


def stream_trouble(
    rhythms: Sequence[Rhythm],
    losses: Losses,
    dropped: Mapping[str, int],
    ones: Sequence[Watched],
    now_ns: int,
) -> Trouble:
    """Return what is wrong with a stream.

    Args:
        rhythms: of the stream from each of its peers, and of all of it; none for an output.
        losses: of the stream.
        dropped: reason → messages.
        ones: what the guard sees of it, of each peer.
        now_ns: time of the sample.
    """
    rows = [one.row for one in ones]
    worst = max(rhythms, key=lambda one: _order(one, now_ns), default=None)
    return (
        _withheld(rows)
        or (_lost(losses.lost, dropped) if losses.is_recent(now_ns) else None)
        or _silent(worst, now_ns)
        or _late(ones, "messages are")
        or _paused(worst)
        or _odd(rows)
        or _slower(rhythms[:1], now_ns)
        or _GOOD
    )


def link_trouble(peer: Mapping[str, Any], losses: Losses, ones: Sequence[Watched], now_ns: int) -> Trouble:
    """Return what is wrong with a peer.  It is as good as the best of its streams: a person may stop one of them.

    Args:
        peer: its row in the sample.
        losses: of its link.
        ones: what the guard sees of it, of each stream.
        now_ns: time of the sample.
    """
    if not peer["connected"]:
        return Trouble(WAITING, "not connected; the bridge tries again", "not_connected")
    regular = [one.rhythm for one in ones if one.rhythm.is_regular]
    best = min(regular, key=lambda one: _order(one, now_ns), default=None)
    return (
        _reading(peer, losses, now_ns)
        or _silent(best, now_ns)
        or _late(ones, "its messages are")
        or _ahead([one.row for one in ones])
        or _paused(best)
        or _slower(regular, now_ns)
        or _GOOD
    )


def departed(since_ns: int, *, was_regular: bool) -> Trouble:
    """Return that a peer has left: as bad as silence if it sent regularly."""
    return Trouble(SILENT if was_regular else WAITING, f"left {seconds_text(since_ns // NS_PER_S)} ago", "left")


#: What is wrong with a stream whose peer has left: a regular one, and one that came now and then.
PEER_HAS_LEFT, LEFT = Trouble(SILENT, "its peer has left", "left"), Trouble(OFF)


def _order(rhythm: Rhythm, now_ns: int) -> tuple[int, int]:
    return rhythm.silent_ns(now_ns), len(rhythm.pauses)


def _withheld(rows: Sequence[Mapping[str, Any]]) -> Trouble | None:
    stale = sum(row["stale"] for row in rows)
    return Trouble(ERROR, f"stale: {count_text(stale, 'message')} withheld", "stale") if stale else None


def _lost(lost: int, dropped: Mapping[str, int]) -> Trouble:
    reasons = [reason for reason in dropped if reason not in HARMLESS]
    words = ", ".join(DROPPED.get(reason, reason) for reason in reasons)
    rule = next((reason for reason in reasons if reason in _RULE_OF), "lost")
    return Trouble(ERROR, f"{count_text(lost, 'message')} dropped: {words}", rule)


def _silent(rhythm: Rhythm | None, now_ns: int) -> Trouble | None:
    silent_ns = rhythm.silent_ns(now_ns) if rhythm else 0
    if not rhythm or not silent_ns:
        return None
    before = f", and {_times(rhythm)} before that in the last minute" if rhythm.pauses else ""
    return Trouble(SILENT, f"silent for {duration_text(silent_ns)}{before}", "silent")


def _paused(rhythm: Rhythm | None) -> Trouble | None:
    if not rhythm or not rhythm.pauses:
        return None
    longest_ns = max(length for _, length in rhythm.pauses)
    longest = f"{'' if len(rhythm.pauses) == 1 else 'up to '}{duration_text(longest_ns)}"
    return Trouble(WARNING, f"silent for {longest}, {_times(rhythm)} in the last minute", "silent")


def _slower(rhythms: Sequence[Rhythm], now_ns: int) -> Trouble | None:
    before = [rhythm.slower_than_hz(now_ns) for rhythm in rhythms]
    if not before or not all(before):
        return None
    return Trouble(WARNING, f"{short(rhythms[0].rate_hz)} messages a second, {short(before[0])} before", "slower")


def _late(ones: Iterable[Watched], begin: str) -> Trouble | None:
    ages = [one.late_ns for one in ones if one.late_ns]
    return Trouble(WARNING, f"{begin} {duration_text(min(ages))} old on arrival", "old") if ages else None


def _ahead(rows: Sequence[Mapping[str, Any]]) -> Trouble | None:
    ms = ahead_ms(rows)
    return Trouble(WARNING, f"its clock is ahead by {duration_text(ms * 1e6)}", "stamp_future") if ms else None


def _odd(rows: Sequence[Mapping[str, Any]]) -> Trouble | None:
    codes, ms = sorted({code for row in rows for code in row["episodes"]}), ahead_ms(rows)
    texts = _ODD | ({"stamp_future": f"the sender's clock is ahead by {duration_text(ms * 1e6)}"} if ms else {})
    return Trouble(WARNING, "; ".join(texts.get(code, code) for code in codes), codes[0]) if codes else None


def _reading(peer: Mapping[str, Any], losses: Losses, now_ns: int) -> Trouble | None:
    if losses.is_recent(now_ns):
        return Trouble(ERROR, f"reads too slowly: {count_text(peer['dropped'], 'message')} dropped", "queue")
    if peer["queued"] > _QUEUED or (peer["queued"] > 1 and peer["queued_bytes"] > _QUEUED_BYTES):
        return Trouble(
            WARNING,
            f"reads slowly: {count_text(peer['queued'], 'message')} {by_count(peer['queued'], 'waits', 'wait')}",
            "queue",
        )
    if kilobytes := losses.stuck_bytes // 1_000:
        return Trouble(WARNING, f"reads slowly: {size_text(kilobytes * 1_000)} wait", "queue")
    return None


def _times(rhythm: Rhythm) -> str:
    number = len(rhythm.pauses)
    return "once" if number == 1 else f"{number:,} times"


def latency_ms(watched: Iterable[Mapping[str, Any]]) -> float | None:
    """Return the least time from stamp to arrival; None if the stamps do not show it."""
    return milliseconds(one["age_ns"] for one in watched if 0 <= (one["age_ns"] or 0) < _EPOCH_NS)


def ahead_ms(watched: Iterable[Mapping[str, Any]], least_ns: int = AHEAD_NS) -> float | None:
    """Return how far the clock of a sender is ahead, at most; None if it is not by more than ``least_ns``."""
    ages = [-one["age_ns"] for one in watched if one["age_ns"] is not None]
    return milliseconds([max(found)]) if (found := [age for age in ages if least_ns < age < _EPOCH_NS]) else None


def milliseconds(values: Iterable[int | None]) -> float | None:
    """Return the least value."""
    return round(min(known) / 1e6, 3) if (known := [value for value in values if value is not None]) else None


def short(value: float) -> str:
    """Return a number with three digits, or those before its point."""
    return f"{value:.3g}" if abs(value) < 1_000 else f"{value:,.0f}"
