"""What the view *Now* shows, from the samples of a bridge: what is wrong first, each with advice.  Pure."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from types import MappingProxyType
from typing import Any

from igtl_gateway.addon import NS_PER_S
from igtl_gateway.addons.page.rhythm import Rhythm
from igtl_gateway.addons.page.sample import rows_of
from igtl_gateway.addons.page.trouble import (
    ERROR,
    OK,
    SILENT,
    WAITING,
    WARNING,
    Losses,
    Watched,
    ahead_ms,
    latency_ms,
    link_trouble,
    milliseconds,
    short,
    stream_trouble,
)
from igtl_gateway.gateway.diagnostics import HARMLESS

_ORDER = {state: number for number, state in enumerate((ERROR, SILENT, WARNING, WAITING, OK))}
#: Streams from which on one of them can be the slowest.
_SEVERAL = 2
#: Rows that a page shows; a peer that invents names must not fill it.
MAX_ROWS = 300
#: Direction in the ledger → in words.
_SIDES = {"igtl_in": "from OpenIGTLink", "ros_in": "from ROS", "igtl_out": "to OpenIGTLink", "ros_out": "to ROS"}
_INPUTS = ("igtl_in", "ros_in")
#: Role of this end of a link → the peer in words.
_ROLES = {"server": "client", "client": "server"}
#: Profiles that name no program.
_NO_PROGRAM = frozenset({"", "default", "unrecognised"})
#: Devices in the name of a peer, and letters of each.
_NAMED, _LETTERS = 2, 40
_STAMPS = {"stamp_backwards": "decrease", "stamp_still": "unchanged", "stamp_future": "in the future"}


class Now:
    """The rows of a session."""

    def __init__(self) -> None:
        self._streams: dict[tuple[str, str], tuple[Rhythm, Losses]] = {}
        self._watched: dict[tuple[int, str], Watched] = {}
        self._links: dict[str, tuple[Rhythm, Losses]] = {}

    def rows(
        self, facts: Mapping[str, Any], now_ns: int, utc_ns: int, types: Mapping[str, str] = MappingProxyType({})
    ) -> dict[str, Any]:
        """Return the rows for a `sample`.

        Args:
            facts: what `sample_of` returns.
            now_ns: when it was made, on the monotonic clock.
            utc_ns: the same in UTC.
            types: topic → type of ROS.
        """
        by_stream, by_link = self._take_watched(facts, now_ns, utc_ns)
        peers = {peer["link"]: peer["peer"] for peer in facts["peers"] if peer["link"]}
        ros = facts.get("ros", True)
        streams = []
        for side in _SIDES if ros else [side for side in _SIDES if side != "ros_out"]:
            totals, drops = facts["totals"].get(side, {}), facts["drops"].get(side, {})
            for stream in sorted({*totals, *drops}):
                counts, ones = (totals.get(stream, 0), drops.get(stream, {})), by_stream.get((side, stream), [])
                streams.append(self._stream_row((side, stream), counts, ones, now_ns, utc_ns) | _way(side, ones, peers))
                if not side.startswith("igtl"):
                    streams[-1] |= {"type": types.get(stream, ""), "name": stream}
        links = [self._link_row(peer, by_link.get(peer["link"], []), now_ns, utc_ns) for peer in facts["peers"]]
        return {
            "streams": _sorted(streams),
            "links": _sorted(links),
            "more": max(0, len(streams) - MAX_ROWS),
            "unsent": 0 if ros else len(facts["totals"].get("ros_out", {})),
            "inputs": sum(row["side"] in _INPUTS for row in streams),
        }

    def _take_watched(
        self, facts: Mapping[str, Any], now_ns: int, utc_ns: int
    ) -> tuple[dict[tuple[str, str], list[Watched]], dict[int, list[Watched]]]:
        """Take what the guard sees; return it by side and stream, and by link."""
        by_stream: dict[tuple[str, str], list[Watched]] = {}
        by_link: dict[int, list[Watched]] = {}
        before, self._watched = self._watched, {}
        for row in rows_of(facts):
            link, stream = key = row["link"], row["stream"]
            one = self._watched[key] = before.get(key) or Watched(row)
            one.take(now_ns, utc_ns, row)
            by_stream.setdefault(("igtl_in" if link else "ros_in", stream), []).append(one)
            if link:
                by_link.setdefault(link, []).append(one)
        return by_stream, by_link

    def _stream_row(
        self,
        key: tuple[str, str],
        counts: tuple[int, Mapping[str, int]],
        ones: Sequence[Watched],
        now_ns: int,
        utc_ns: int,
    ) -> dict[str, Any]:
        rhythm, losses = self._streams.setdefault(key, (Rhythm(), Losses(now_ns)))
        received, dropped = counts
        lost = sum(number for reason, number in dropped.items() if reason not in HARMLESS)
        rhythm.take(now_ns, received, utc_ns)
        losses.take(now_ns, lost)
        seen = [one.rhythm for one in ones if one.row["looks"]]
        rhythms = [*seen, rhythm] if key[0] in _INPUTS else []
        longest = max(seen, key=lambda one: one.gap_ns, default=rhythm)
        if rhythm.gap_ns > longest.gap_ns + NS_PER_S:  # while no peer sent it
            longest = rhythm
        rows = [one.row for one in ones]
        trouble = stream_trouble(rhythms, losses, dropped, ones, now_ns)
        kind, _, name = key[1].partition("/")
        return {
            "key": " ".join(key),
            "state": trouble.state,
            "name": name or "(no name)",
            "type": kind,
            "side": key[0],
            "rate_hz": rhythm.rate_hz,
            "spark": list(rhythm.spark),
            "age_s": (now_ns - max(one.moved_ns for one in seen or [rhythm])) / 1e9,
            "gap_s": longest.gap_ns / 1e9 if any(one.is_regular for one in rhythms) else None,
            "gap_utc_ns": longest.gap_utc_ns,
            "latency_ms": latency_ms(rows),
            "ahead_ms": ahead_ms(rows, 0),
            "received": received,
            "dropped": sum(dropped.values()) if lost else 0,
            "stamps": _stamps(rows),
            "text": trouble.text,
            "advice": trouble.advice,
        }

    def _link_row(self, peer: Mapping[str, Any], ones: Sequence[Watched], now_ns: int, utc_ns: int) -> dict[str, Any]:
        key = f"{peer['link']} {peer['peer']}"
        rhythm, losses = self._links.setdefault(f"{key} {peer['connected']}", (Rhythm(), Losses(utc_ns)))
        rhythm.take(now_ns, peer["messages"])
        losses.take(now_ns, peer["dropped"], peer["unconfirmed_bytes"])
        rows = [one.row for one in ones]
        trouble = link_trouble(peer, losses, ones, now_ns)
        return {
            "key": key,
            "state": trouble.state,
            "link": peer["link"],
            "name": _name_of(peer, rows),
            "peer": peer["peer"],
            "role": _ROLES[peer["role"]],
            "profile": peer["profile"],
            "since_ns": losses.since_ns if peer["connected"] else None,
            "rate_hz": rhythm.rate_hz,
            "spark": list(rhythm.spark),
            "latency_ms": latency_ms(rows),
            "ahead_ms": ahead_ms(rows, 0),
            "jitter_ms": milliseconds(row["jitter_ns"] for row in rows),
            "queue": peer["queued"],
            "stuck_bytes": losses.stuck_bytes,
            "dropped": peer["dropped"],
            "text": trouble.text,
            "advice": trouble.advice,
        }


def wrong_things(rows: Mapping[str, Any]) -> int:
    """Return how many links and streams are not good; what a stream has of its peer is one thing."""
    links = [(row["peer"], row["advice"]) for row in rows["links"] if row["state"] != OK]
    streams = [(row["way"].removeprefix("from "), row["advice"]) for row in rows["streams"] if row["state"] != OK]
    return len(links) + sum(each not in links for each in streams)


def headline(rows: Mapping[str, Any]) -> str:
    """Return who is worst and why, in words; "" if all is good."""
    worst = min([*rows["links"], *rows["streams"]], key=lambda row: _ORDER[row["state"]], default=None)
    return f"{worst['name'] or worst['peer']}: {worst['text']}" if worst and worst["state"] != OK else ""


def slowest(rows: Mapping[str, Any]) -> list[str]:
    """Return which of several inputs that come regularly is slowest, in words."""
    streams = [row for row in rows["streams"] if row["gap_s"] is not None and row["rate_hz"]]
    if len(streams) < _SEVERAL:
        return []
    least = min(streams, key=lambda row: float(row["rate_hz"]))
    found = [f"lowest rate: {least['name']}, {short(least['rate_hz'])} Hz"]
    if late := [row for row in streams if row["latency_ms"] is not None]:
        most = max(late, key=lambda row: float(row["latency_ms"]))
        found.append(f"highest latency: {most['name']}, {short(most['latency_ms'])} ms")
    return found


def _way(side: str, ones: Sequence[Watched], peers: Mapping[int, str]) -> dict[str, str]:
    froms = sorted({peers[one.row["link"]] for one in ones if one.row["link"] in peers})
    several = f"from {len(froms)} peers" if froms else _SIDES[side]
    return {"way": f"from {froms[0]}" if len(froms) == 1 else several}


def _name_of(peer: Mapping[str, Any], watched: Iterable[Mapping[str, Any]]) -> str:
    """Return what people call a peer: its program, and the devices that it sends; "" before either is known."""
    devices = list(dict.fromkeys(device for one in watched if (device := one["stream"].partition("/")[2])))
    words = [device[:_LETTERS] for device in devices[:_NAMED]]
    if (more := len(devices) - _NAMED) > 0:
        words.append(f"{more:,} more")
    program = "" if peer["profile"] in _NO_PROGRAM else peer["profile"]
    return ": ".join(filter(None, (program, ", ".join(words))))


def _stamps(watched: Iterable[Mapping[str, Any]]) -> str:
    ones = list(watched)
    for code, word in _STAMPS.items():
        if any(code in one["episodes"] for one in ones):
            return word
    if any(one["stamped"] for one in ones):
        return "good"
    return "none" if any(one["unset"] for one in ones) else ""


def _sorted(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    return sorted(rows, key=lambda row: (_ORDER[row["state"]], row.get("side", "") not in _INPUTS))[:MAX_ROWS]
