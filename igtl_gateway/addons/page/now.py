"""What the view *Now* shows, from the samples of a bridge: what is wrong first, each with advice.  Pure."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

from igtl_gateway.addons.page.sample import rows_of
from igtl_gateway.doctor.rules import RULES
from igtl_gateway.gateway.diagnostics import HARMLESS, RHYTHM_HZ, SILENT_NS
from igtl_gateway.gateway.log.fates import DROPPED
from igtl_gateway.gateway.log.rates import Rates

#: States, the worst first: each has a word, a shape and a colour on the page.
ERROR, SILENT, WARNING, WAITING, OK = "error", "silent", "warning", "waiting", "ok"
_ORDER = {state: number for number, state in enumerate((ERROR, SILENT, WARNING, WAITING, OK))}
#: Seconds of a sparkline, one value each.
SPARK_S = 60
#: Losses are a problem for this time, ns.
_RECENT_NS = 10_000_000_000
#: Rows that a page shows; a peer that invents names must not fill it.
MAX_ROWS = 300
#: Direction in the ledger → in words.
_SIDES = {"igtl_in": "from OpenIGTLink", "ros_in": "from ROS", "igtl_out": "to OpenIGTLink", "ros_out": "to ROS"}
_INPUTS = ("igtl_in", "ros_in")
#: Messages are late above this age on arrival, as for rule W306 of `doctor`; above the second one they are of another
#: epoch, such as replayed ones.
OLD_NS, _EPOCH_NS = 1_000_000_000, 86_400_000_000_000
#: A clock is ahead by more than this, as for rule W303.
AHEAD_NS = 100_000_000
#: A send queue with more is of a peer that reads slowly.
_QUEUED, _QUEUED_BYTES = 50, 1 << 20

_ADVICE = {rule.id[5:]: rule.advice for rule in RULES}
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
    "lost": "W703",
    "not_connected": "E101",
}
_ODD = {
    "unit_jump": "the translation jumps by a factor of 1,000",
    "stamp_backwards": "stamps decrease",
    "stamp_still": "stamps do not change",
    "stamp_future": "stamps are in the future",
}
#: Role of this end of a link → the peer in words.
_ROLES = {"server": "client", "client": "server"}
#: Profiles that name no program.
_NO_PROGRAM = frozenset({"", "default", "unrecognised"})
#: Devices in the name of a peer, and letters of each.
_NAMED, _LETTERS = 2, 40
_STAMPS = {"stamp_backwards": "decrease", "stamp_still": "unchanged", "stamp_future": "in the future"}


@dataclass(slots=True)
class _Seen:
    """A stream or a link over the samples; times in ns."""

    since_ns: int
    received: int = 0
    moved_ns: int = 0
    gap_ns: int = 0
    gap_utc_ns: int = 0
    rhythm: bool = False
    lost: int = 0
    lost_ns: int = 0
    second: int = 0
    at_second: int = 0
    spark: deque[int] = field(default_factory=lambda: deque(maxlen=SPARK_S))

    def take(self, now_ns: int, received: int, lost: int, utc_ns: int = 0) -> None:
        """Take the counts of a sample."""
        if self.moved_ns and self.rhythm and now_ns - self.moved_ns > self.gap_ns:
            self.gap_ns, self.gap_utc_ns = now_ns - self.moved_ns, utc_ns
        if received != self.received or not self.moved_ns:
            self.moved_ns = now_ns
        if lost > self.lost:
            self.lost_ns = now_ns
        self.received, self.lost = received, lost
        second = now_ns // 1_000_000_000
        if second != self.second:
            if self.second:
                steps = min(second - self.second, SPARK_S)
                self.spark.extend([(received - self.at_second) // steps] * steps)
            self.second, self.at_second = second, received


class Now:
    """The rows of a session."""

    def __init__(self) -> None:
        self._streams: dict[tuple[str, str], _Seen] = {}
        self._links: dict[str, _Seen] = {}
        self._rates = Rates()

    def rows(
        self, facts: Mapping[str, Any], now_ns: int, utc_ns: int, types: Mapping[str, str] = MappingProxyType({})
    ) -> dict[str, Any]:
        """Return the rows for a `sample`.

        Args:
            facts: what `sample_of` returns.
            now_ns: when it was read, on the monotonic clock.
            utc_ns: the same in UTC.
            types: topic → type of ROS.
        """
        streams = self._stream_rows(facts, now_ns, utc_ns, types)
        links = self._link_rows(facts, now_ns, utc_ns)
        return {
            "streams": _sorted(streams),
            "links": _sorted(links),
            "more": max(0, len(streams) - MAX_ROWS),
            "inputs": sum(row["side"] in _INPUTS for row in streams),
        }

    def _stream_rows(
        self, facts: Mapping[str, Any], now_ns: int, utc_ns: int, types: Mapping[str, str]
    ) -> list[dict[str, Any]]:
        peers = {peer["link"]: peer["peer"] for peer in facts["peers"] if peer["link"]}
        watched: dict[tuple[str, str], list[Mapping[str, Any]]] = {}
        for one in rows_of(facts):
            watched.setdefault(("igtl_in" if one["link"] else "ros_in", one["stream"]), []).append(one)
        rows = []
        _, all_rates = self._rates.take(now_ns, facts["totals"])
        for side, title in (
            _SIDES if facts.get("ros", True) else _SIDES | {"ros_out": "for ROS, which is off"}
        ).items():
            rates, totals, drops = all_rates.get(side, {}), facts["totals"].get(side, {}), facts["drops"].get(side, {})
            for stream in sorted({*totals, *drops}):
                seen = self._streams.setdefault((side, stream), _Seen(now_ns))
                dropped = drops.get(stream, {})
                lost = sum(number for reason, number in dropped.items() if reason not in HARMLESS)
                seen.take(now_ns, totals.get(stream, 0), lost, utc_ns)
                rate_hz = rates.get(stream, 0.0)
                seen.rhythm = seen.rhythm or (rate_hz >= RHYTHM_HZ and side in _INPUTS)
                ones = watched.get((side, stream), [])
                state, text, advice = _judged(seen, now_ns, dropped, ones)
                is_igtl = side.startswith("igtl")
                kind, _, name = stream.partition("/") if is_igtl else (types.get(stream, ""), "", stream)
                froms = sorted({peers[one["link"]] for one in ones if one["link"] in peers})
                rows.append(
                    {
                        "key": f"{side} {stream}",
                        "state": state,
                        "name": name or "(no name)",
                        "type": kind,
                        "side": side,
                        "way": f"from {froms[0]}"
                        if len(froms) == 1
                        else f"from {len(froms)} peers"
                        if froms
                        else title,
                        "rate_hz": rate_hz,
                        "spark": list(seen.spark),
                        "age_s": (now_ns - seen.moved_ns) / 1e9,
                        "gap_s": seen.gap_ns / 1e9 if seen.rhythm else None,
                        "gap_utc_ns": seen.gap_utc_ns,
                        "latency_ms": _latency_ms(ones),
                        "ahead_ms": _ahead_ms(ones, 0),
                        "received": seen.received,
                        "dropped": sum(dropped.values()) if lost else 0,
                        "stamps": _stamps(ones),
                        "text": text,
                        "advice": advice,
                    }
                )
        return rows

    def _link_rows(self, facts: Mapping[str, Any], now_ns: int, utc_ns: int) -> list[dict[str, Any]]:
        rows, watched = [], rows_of(facts)
        for peer in facts["peers"]:
            number = str(peer["link"])
            seen = self._links.setdefault(f"{number} {peer['peer']} {peer['connected']}", _Seen(utc_ns))
            lost, queued = peer["dropped"], peer["queued"]
            seen.take(now_ns, peer["messages"], lost)
            ones = [one for one in watched if one["link"] == peer["link"] and peer["link"]]
            state, text, rule = OK, "", ""
            late_ms, ahead_ms = _milliseconds(one["age_ns"] for one in ones if _is_old(one)), _ahead_ms(ones)
            if not peer["connected"]:
                state, text, rule = WAITING, "not connected; the bridge tries again", "not_connected"
            elif seen.lost_ns and now_ns - seen.lost_ns < _RECENT_NS:
                state, text, rule = ERROR, f"reads too slowly: {lost:,} messages dropped", "queue"
            elif queued > _QUEUED or (queued > 1 and peer["queued_bytes"] > _QUEUED_BYTES):
                state, text, rule = WARNING, f"reads slowly: {queued:,} messages wait", "queue"
            elif late_ms:
                state, text, rule = WARNING, f"is late: its messages are {late_ms / 1e3:.1f} s old on arrival", "old"
            elif ahead_ms:
                state, text, rule = WARNING, f"its clock is ahead by {ahead_ms / 1e3:.1f} s", "stamp_future"
            rows.append(
                {
                    "key": f"{number} {peer['peer']}",
                    "state": state,
                    "link": peer["link"],
                    "name": _name_of(peer, ones),
                    "peer": peer["peer"],
                    "role": _ROLES[peer["role"]],
                    "profile": peer["profile"],
                    "since_ns": seen.since_ns if peer["connected"] else None,
                    "rate_hz": seen.spark[-1] if seen.spark else 0,
                    "spark": list(seen.spark),
                    "latency_ms": _latency_ms(ones),
                    "ahead_ms": _ahead_ms(ones, 0),
                    "jitter_ms": _milliseconds(one["jitter_ns"] for one in ones),
                    "queue": queued,
                    "dropped": lost,
                    "text": text,
                    "advice": _advice(rule),
                }
            )
        return rows


def wrong_things(rows: Mapping[str, Any]) -> int:
    """Return how many links and streams are not good; what a stream has of its peer is one thing."""
    links = [(row["peer"], row["advice"]) for row in rows["links"] if row["state"] != OK]
    streams = [(row["way"].removeprefix("from "), row["advice"]) for row in rows["streams"] if row["state"] != OK]
    return len(links) + sum(each not in links for each in streams)


def _judged(
    seen: _Seen, now_ns: int, dropped: Mapping[str, int], watched: Sequence[Mapping[str, Any]]
) -> tuple[str, str, str]:
    """Return state, sentence and advice, by the rules of ``/diagnostics``."""
    stale = sum(one["stale"] for one in watched)
    odd = sorted({code for one in watched for code in one["episodes"]})
    if stale:
        return ERROR, f"stale: {stale:,} messages withheld", _advice("stale")
    if seen.lost_ns and now_ns - seen.lost_ns < _RECENT_NS:
        reasons = [reason for reason in dropped if reason not in HARMLESS]
        words = ", ".join(DROPPED.get(reason, reason) for reason in reasons)
        rule = next((reason for reason in reasons if reason in _RULE_OF), "lost")
        return ERROR, f"{seen.lost:,} messages dropped: {words}", _advice(rule)
    if seen.rhythm and now_ns - seen.moved_ns >= SILENT_NS:
        return SILENT, f"no message for {(now_ns - seen.moved_ns) / 1e9:,.0f} s", _advice("silent")
    if late_ms := _milliseconds(one["age_ns"] for one in watched if _is_old(one)):
        return WARNING, f"messages are {late_ms / 1e3:.1f} s old on arrival", _advice("old")
    if odd:
        ahead_ms = _ahead_ms(watched)
        said = _ODD | ({"stamp_future": f"the sender's clock is ahead by {ahead_ms / 1e3:.1f} s"} if ahead_ms else {})
        return WARNING, "; ".join(said.get(code, code) for code in odd), _advice(odd[0])
    return OK, "", ""


def _name_of(peer: Mapping[str, Any], watched: Iterable[Mapping[str, Any]]) -> str:
    """Return what people call a peer: its program, and the devices that it sends; "" before either is known."""
    devices = list(dict.fromkeys(device for one in watched if (device := one["stream"].partition("/")[2])))
    words = [device[:_LETTERS] for device in devices[:_NAMED]]
    if (more := len(devices) - _NAMED) > 0:
        words.append(f"{more:,} more")
    program = "" if peer["profile"] in _NO_PROGRAM else peer["profile"]
    return ": ".join(filter(None, (program, ", ".join(words))))


def _is_old(one: Mapping[str, Any]) -> bool:
    return one["age_ns"] is not None and OLD_NS < one["age_ns"] < _EPOCH_NS


def _stamps(watched: Iterable[Mapping[str, Any]]) -> str:
    ones = list(watched)
    for code, word in _STAMPS.items():
        if any(code in one["episodes"] for one in ones):
            return word
    if any(one["stamped"] for one in ones):
        return "good"
    return "none" if any(one["unset"] for one in ones) else ""


def _advice(rule: str) -> str:
    advice = _ADVICE.get(_RULE_OF.get(rule, ""), "")
    return advice[:1].upper() + advice[1:]


def _latency_ms(watched: Iterable[Mapping[str, Any]]) -> float | None:
    """Return the least time from stamp to arrival; None if the stamps do not show it."""
    return _milliseconds(one["age_ns"] for one in watched if 0 <= (one["age_ns"] or 0) < _EPOCH_NS)


def _ahead_ms(watched: Iterable[Mapping[str, Any]], least_ns: int = AHEAD_NS) -> float | None:
    """Return how far the clock of a sender is ahead, at most; None if it is not by more than ``least_ns``."""
    ages = [-one["age_ns"] for one in watched if one["age_ns"] is not None]
    return _milliseconds([max(found)]) if (found := [age for age in ages if least_ns < age < _EPOCH_NS]) else None


def _milliseconds(values: Iterable[int | None]) -> float | None:
    """Return the least value."""
    return round(min(known) / 1e6, 3) if (known := [value for value in values if value is not None]) else None


def _sorted(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    return sorted(rows, key=lambda row: (_ORDER[row["state"]], row.get("side", "") not in _INPUTS))[:MAX_ROWS]
