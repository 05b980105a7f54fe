"""Streams that pause: a note when a periodic stream is silent, and one when it is back.

The streams are looked at once a second, from outside of the path of messages, and the notes are those of this host: a
verification, which has no time but that of the inputs, does not make them again.  The notes of one look are one for
each link, because a cable has many streams.  Pure: the time is an argument.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from igtl_gateway.base.stamp import NS_PER_S
from igtl_gateway.gateway.diagnostics import SILENT_NS
from igtl_gateway.gateway.guarded_stream import GuardedStream
from igtl_gateway.gateway.log.note import Level, Note

STREAM_SILENT, STREAM_BACK = "stream_silent", "stream_back"

#: Looks in a row with a message each, after which a stream is periodic.
_REGULAR = 5
#: A look that comes later than this after the one before judges nothing: this host has slept, not the streams.
_LATE_NS = 3 * NS_PER_S
#: Streams in the text of a note, and in its data.
_NAMED, _MOST = 3, 100


#: Link (0: of ROS) and name of a guarded stream.
Key = tuple[int, str]


class Arrivals:
    """Which guarded streams have got messages since the last look.

    The guard does not see a message that no peer takes, that is denied, or that comes while the gateway is not active.
    The ledger counts it: if no link has a message of its stream that the guard has seen, it may be of each of them.
    """

    def __init__(self) -> None:
        self._checked: Mapping[Key, int] = {}
        self._totals: Mapping[str, Mapping[str, int]] = {}

    def since_then(self, checked: Mapping[Key, int], totals: Mapping[str, Mapping[str, int]]) -> frozenset[Key]:
        """Return the streams with messages since the last call.

        Args:
            checked: the number of messages that the guard has seen so far.
            totals: those that have come, from ``Ledger.totals``.
        """
        before, self._checked = self._checked, checked
        then, self._totals = self._totals, totals
        seen = frozenset(key for key, number in checked.items() if number != before.get(key, number))
        unseen = {_row(key): _number(totals, key) != _number(then, key) for key in checked if key in before}
        unseen |= dict.fromkeys(map(_row, seen), False)
        return seen | frozenset(key for key in checked if unseen.get(_row(key)))


def _row(key: Key) -> tuple[str, str]:
    """Return direction and stream of the ledger."""
    return "igtl_in" if key[0] else "ros_in", key[1]


def _number(totals: Mapping[str, Mapping[str, int]], key: Key) -> int:
    direction, stream = _row(key)
    return totals.get(direction, {}).get(stream, 0)


@dataclass(slots=True)
class _Seen:
    """A stream at the last look; times in ns."""

    looks: int = 0
    arrived_ns: int = 0
    is_silent: bool = False


class Silences:
    """The silent streams of a session."""

    def __init__(self) -> None:
        self._seen: dict[Key, _Seen] = {}
        self._arrivals = Arrivals()
        self._looked_ns = 0

    def look(
        self, now_ns: int, watched: Iterable[tuple[Key, GuardedStream]], totals: Mapping[str, Mapping[str, int]]
    ) -> list[Note]:
        """Return the notes of now.

        Args:
            now_ns: gateway time.
            watched: (link, stream) and the guarded stream; those of closed links are not among them.
            totals: the messages that have come, from ``Ledger.totals``.
        """
        streams = dict(watched)
        came = self._arrivals.since_then({key: one.timing.messages for key, one in streams.items()}, totals)
        silent: dict[int, list[str]] = {}
        back: dict[int, list[tuple[str, int]]] = {}
        before, self._seen = self._seen, {}
        is_late, looked_ns = now_ns - self._looked_ns > _LATE_NS, self._looked_ns
        self._looked_ns = now_ns
        for key, stream in streams.items():
            seen = self._seen[key] = before.get(key) or _Seen()
            if moved := key in came:
                if seen.is_silent:  # it came back between the two looks
                    back.setdefault(key[0], []).append((key[1], (looked_ns + now_ns) // 2 - seen.arrived_ns))
                is_seen = stream.arrived_ns >= looked_ns
                seen.arrived_ns, seen.is_silent = stream.arrived_ns if is_seen else now_ns, False
            if seen.looks < _REGULAR:
                seen.looks = seen.looks + 1 if moved else 0
            elif not (moved or is_late or seen.is_silent) and now_ns - seen.arrived_ns >= SILENT_NS:
                seen.is_silent = True
                silent.setdefault(key[0], []).append(key[1])
        seconds = SILENT_NS // NS_PER_S
        notes = [
            _note(Level.WARN, STREAM_SILENT, names, f"no message for {seconds} s", seconds) for names in silent.values()
        ]
        for found in back.values():
            gap_s = round(max(gap_ns for _, gap_ns in found) / NS_PER_S)
            notes.append(
                _note(Level.INFO, STREAM_BACK, [name for name, _ in found], f"back after about {gap_s} s", gap_s)
            )
        return notes


def _note(level: Level, code: str, streams: list[str], what: str, seconds: int) -> Note:
    more = f" and {len(streams) - _NAMED:,} more" if len(streams) > _NAMED else ""
    text = f"{', '.join(streams[:_NAMED])}{more}: {what}"
    return Note(
        level, code, text, streams[0] if len(streams) == 1 else "", {"streams": streams[:_MOST], "seconds": seconds}
    )
