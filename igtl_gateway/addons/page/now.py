"""What the view *Now* shows, from the samples of a bridge: what is wrong first, each with advice.  Pure."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from types import MappingProxyType
from typing import Any

from igtl_gateway.addon import NS_PER_S
from igtl_gateway.addon.live import SILENT_NS, Arrivals
from igtl_gateway.addon.notes import HARMLESS
from igtl_gateway.addon.terminal import counted, natural
from igtl_gateway.addons.page.left import Left
from igtl_gateway.addons.page.rhythm import Rhythm
from igtl_gateway.addons.page.sample import rows_of
from igtl_gateway.addons.page.trouble import (
    ERROR,
    FINE,
    LEFT,
    OFF,
    OK,
    PEER_HAS_LEFT,
    SILENT,
    WAITING,
    WARNING,
    Losses,
    Trouble,
    Watched,
    ahead_ms,
    latency_ms,
    link_trouble,
    milliseconds,
    short,
    stream_trouble,
)

_ORDER = {state: number for number, state in enumerate((ERROR, SILENT, WARNING, WAITING, OK, OFF))}
#: Streams from which on one of them can be the slowest, and peers from which on their counts are a sum.
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
#: Two peers get the same if their rates differ by less than this share.
_SAME = 0.1
#: Others that the line below the headline names.
_OTHERS = 3
#: What a row of a link has for the time after it.
_INNER = frozenset({"number", "passed", "is_regular", "streams", "newest"})
#: An address of a peer in a sentence.
_ADDRESS = re.compile(r"[\w.\-%\[\]:]{1,120}:[0-9]{1,5}(?![0-9])")
_GONE = ", which has left"
#: Words of a state that is not what its colour means: of what has left, pauses, has not come.
_LEFT_WORD, _QUIET_WORD, _MISSING_WORD = "left", "quiet", "missing"
_STAMPS = {"stamp_backwards": "decrease", "stamp_still": "unchanged", "stamp_future": "in the future"}


def _missing_row(source: Mapping[str, str]) -> dict[str, Any]:
    """Return the row of a configured source that is not there, as `MissingSource.to_dict` describes it."""
    name, kind = source["name"], source["kind"]
    return {
        "key": f"missing {kind} {name}",
        "state": WARNING,
        "word": _MISSING_WORD,
        "name": name,
        "type": kind,
        "side": "igtl_in" if kind in ("device", "peer") else "ros_in",
        "rate_hz": 0.0,
        "spark": "",
        "age_s": None,
        "gap_s": None,
        "gap_utc_ns": 0,
        "latency_ms": None,
        "ahead_ms": None,
        "received": 0,
        "dropped": 0,
        "stamps": "",
        "text": source["text"],
        "advice": "correct the name, or start its program",
        "way": "configured, but not there",
    }


class Now:
    """The rows of a session."""

    def __init__(self) -> None:
        self._streams: dict[tuple[str, str], tuple[Rhythm, Losses]] = {}
        self._watched: dict[tuple[int, str], Watched] = {}
        self._arrivals = Arrivals()
        self._links: dict[str, tuple[Rhythm, Rhythm, Losses]] = {}  # from the peer, to it
        self._left = Left()
        self._senders: dict[tuple[str, str], list[str]] = {}  # the last peers of each stream

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
        known, self._links = self._links, {}
        links = [self._link_row(peer, known, by_link.get(peer["link"], []), now_ns, utc_ns) for peer in facts["peers"]]
        to_peers = _to_peers(links, is_relay=facts.get("relay", False))
        streams = []
        for side in _SIDES if ros else [side for side in _SIDES if side != "ros_out"]:
            totals, drops = facts["totals"].get(side, {}), facts["drops"].get(side, {})
            for stream in sorted({*totals, *drops}, key=natural):
                key, ones = (side, stream), by_stream.get((side, stream), [])
                way, is_gone = self._way(key, ones, peers)
                counts = totals.get(stream, 0), drops.get(stream, {})
                row = self._stream_row(key, counts, ones, now_ns, utc_ns, is_gone=is_gone, has_peers=bool(peers)) | {
                    "way": way
                }
                if side == "igtl_out":
                    row |= _to_each(facts.get("receivers", {}).get(stream, 0), links) or to_peers
                    row["rate_hz"] /= row.pop("receivers", 1)
                streams.append(row)
                if not side.startswith("igtl"):
                    streams[-1] |= {"type": types.get(stream, ""), "name": stream}
        inputs = [row for row in streams if row["side"] in _INPUTS]
        streams += map(_missing_row, facts.get("missing", []))
        links += self._left.rows(links, now_ns, utc_ns)
        shown = [{name: value for name, value in row.items() if name not in _INNER} for row in links]
        return {
            "streams": _sorted(streams),
            "links": _sorted(shown),
            "more": max(0, len(streams) - MAX_ROWS),
            "unsent": 0 if ros else len(facts["totals"].get("ros_out", {})),
            "inputs": len(inputs),
            "arriving": sum(not row["word"] for row in inputs),
        }

    def _take_watched(
        self, facts: Mapping[str, Any], now_ns: int, utc_ns: int
    ) -> tuple[dict[tuple[str, str], list[Watched]], dict[int, list[Watched]]]:
        """Take what the guard sees; return it by side and stream, and by link."""
        by_stream: dict[tuple[str, str], list[Watched]] = {}
        by_link: dict[int, list[Watched]] = {}
        before, self._watched = self._watched, {}
        rows = {(row["link"], row["stream"]): row for row in rows_of(facts)}
        came = self._arrivals.since_then({key: row["looks"] for key, row in rows.items()}, facts["totals"])
        for key, row in rows.items():
            link, stream = key
            one = self._watched[key] = before.get(key) or Watched(row)
            one.take(now_ns, utc_ns, row, came=key in came)
            by_stream.setdefault(("igtl_in" if link else "ros_in", stream), []).append(one)
            if link:
                by_link.setdefault(link, []).append(one)
        return by_stream, by_link

    def _way(self, key: tuple[str, str], ones: Sequence[Watched], peers: Mapping[int, str]) -> tuple[str, bool]:
        """Return where a stream comes from or goes to, in words, and whether all that sent it have left."""
        froms = sorted({peers[one.row["link"]] for one in ones if one.row["link"] in peers})
        is_gone = not froms and key in self._senders
        if froms:
            self._senders[key] = froms
        froms = froms or self._senders.get(key, [])
        one = f"from {froms[0]}{_GONE * is_gone}" if len(froms) == 1 else f"from {counted(len(froms), 'peer')}"
        return (one if froms else _SIDES[key[0]]), is_gone

    def _stream_row(
        self,
        key: tuple[str, str],
        counts: tuple[int, Mapping[str, int]],
        ones: Sequence[Watched],
        now_ns: int,
        utc_ns: int,
        *,
        is_gone: bool,
        has_peers: bool,
    ) -> dict[str, Any]:
        rhythm, losses = self._streams[key] = self._streams.get(key) or (Rhythm(), Losses(now_ns))
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
        word, age_ns = "", now_ns - max(one.moved_ns for one in seen or [rhythm])
        # the guard does not see all messages, such as queries: those of the last peer have left with it
        unseen = key[0] == "igtl_in" and not has_peers and not rhythm.is_regular
        is_gone = is_gone or (unseen and age_ns > NS_PER_S)
        if is_gone and trouble.state in (OK, SILENT, WARNING):
            trouble, word = PEER_HAS_LEFT if rhythm.is_regular else LEFT, _LEFT_WORD
        elif trouble.state == OK and not rhythm.rate_hz and age_ns > SILENT_NS:
            trouble, word = Trouble(OFF), _QUIET_WORD
        kind, _, name = key[1].partition("/")
        return {
            "key": " ".join(key),
            "state": trouble.state,
            "word": word,
            "name": name or kind,
            "type": kind if name else "without a device name,",
            "side": key[0],
            "rate_hz": 0.0 if word else rhythm.rate_hz,
            "spark": rhythm.spark_text,
            "age_s": age_ns / 1e9,
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

    def _link_row(
        self,
        peer: Mapping[str, Any],
        known: Mapping[str, tuple[Rhythm, Rhythm, Losses]],
        ones: Sequence[Watched],
        now_ns: int,
        utc_ns: int,
    ) -> dict[str, Any]:
        key = f"{peer['link']} {peer['peer']}"
        state = f"{key} {peer['connected']}"
        taken, given, losses = self._links[state] = known.get(state) or (Rhythm(), Rhythm(), Losses(utc_ns))
        taken.take(now_ns, peer["received"])
        given.take(now_ns, peer["sent"])
        losses.take(now_ns, peer["dropped"], peer["unconfirmed_bytes"])
        rows = [one.row for one in ones]
        trouble = link_trouble(peer, losses, ones, now_ns)
        return {
            "key": key,
            "state": trouble.state,
            "link": peer["link"],
            "name": _name_of(peer, rows),
            "called": _called(peer, rows),
            "peer": peer["peer"],
            "role": _ROLES[peer["role"]],
            "profile": peer["profile"],
            "clock": peer.get("clock", ""),
            "since_ns": losses.since_ns if peer["connected"] else None,
            "from_hz": taken.rate_hz,
            "to_hz": given.rate_hz,
            "spark": (taken if taken.is_regular or peer["received"] >= peer["sent"] else given).spark_text,
            "latency_ms": latency_ms(rows),
            "ahead_ms": ahead_ms(rows, 0),
            "jitter_ms": milliseconds(row["jitter_ns"] for row in rows),
            "queue": peer["queued"],
            "stuck_bytes": losses.stuck_bytes,
            "dropped": peer["dropped"],
            "text": trouble.text,
            "advice": trouble.advice,
            "number": peer["link"],
            "passed": peer["received"] + peer["sent"],
            "is_regular": any(one.rhythm.is_regular for one in ones),
            "streams": {row["stream"] for row in rows},
        }


def with_names(notes: Iterable[Mapping[str, Any]], names: Mapping[str, str]) -> list[dict[str, Any]]:
    """Return notes whose sentences have the name of a peer before its address.

    Args:
        names: address → name, of peers that are there or were.
    """

    def named(found: re.Match[str]) -> str:
        return f"{names[found[0]]} ({found[0]})" if names.get(found[0]) else found[0]

    return [{**note, "text": _ADDRESS.sub(named, note["text"])} for note in notes]


def wrong_things(rows: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """Return the links and streams that are not good, the worst first; what a stream has of its peer is one thing."""
    found = [row for row in rows["links"] if row["state"] not in FINE]
    known = {(row["peer"], row["advice"]) for row in found}
    for row in rows["streams"]:
        sender = row["way"].removeprefix("from ").removesuffix(_GONE), row["advice"]
        if row["state"] not in FINE and sender not in known:
            found.append(row)
            if row["way"].endswith(_GONE):
                known.add(sender)
    return sorted(found, key=lambda row: _ORDER[row["state"]])


def headline(rows: Mapping[str, Any]) -> str:
    """Return who is worst and why, in words; "" if all is good."""
    worst = next(iter(wrong_things(rows)), None)
    return f"{worst['name'] if 'way' in worst else worst['called']}: {worst['text']}" if worst else ""


def others(rows: Mapping[str, Any]) -> str:
    """Return who else is not good, in words; "" if all others are."""
    rest = wrong_things(rows)[1:]
    peers = _listed("", [row["called"] for row in rest if "way" not in row])
    streams = _listed("stream", [row["name"] for row in rest if "way" in row])
    found = "; ".join(filter(None, (peers, streams)))
    return f"also {found}" if found else ""


def _listed(noun: str, names: Iterable[str]) -> str:
    """Return the first of several names in words, such as ``streams a, b and 3 more``."""
    each = list(dict.fromkeys(names))
    first = f"{noun}{'s' * (len(each) > 1)} " if noun else ""
    more = f" and {len(each) - _OTHERS:,} more" if len(each) > _OTHERS else ""
    return f"{first}{', '.join(each[:_OTHERS])}{more}" if each else ""


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


def _to_peers(links: Sequence[Mapping[str, Any]], *, is_relay: bool) -> dict[str, Any]:
    """Return where outputs go, in words, and by how many peers their counts are to be divided, ``receivers``.

    The ledger counts a message once for each peer; where all peers get as much, each gets all.
    """
    rates = [row["to_hz"] for row in links if row["link"]]
    if len(rates) < _SEVERAL or is_relay:
        return {}
    is_same = min(rates) > (1 - _SAME) * max(rates)
    words = f"to {counted(len(rates), 'peer')}"
    return {"way": words, "receivers": len(rates)} if is_same else {"way": f"{words}, all together"}


def _to_each(receivers: int, links: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the same for a stream of which the gateway knows how many peers get each message; 0: it does not."""
    there = sum(bool(row["link"]) for row in links)
    if not receivers or there < _SEVERAL:
        return {}
    words = f"to {receivers} peers" if receivers == there else f"to {receivers} of {there} peers"
    return {"way": words, "receivers": receivers}


def _name_of(peer: Mapping[str, Any], watched: Iterable[Mapping[str, Any]]) -> str:
    """Return what people call a peer: its program, and the devices that it sends; "" before either is known."""
    devices = _devices(watched)
    words = [device[:_LETTERS] for device in devices[:_NAMED]]
    if (more := len(devices) - _NAMED) > 0:
        words.append(f"{more:,} more")
    return ": ".join(filter(None, (_program(peer), ", ".join(words))))


def _called(peer: Mapping[str, Any], watched: Iterable[Mapping[str, Any]]) -> str:
    """Return what a sentence calls a peer, in which its list of devices would run into other lists."""
    first = next(iter(_devices(watched)), "")
    return f"peer of {first[:_LETTERS]}" if first else f"peer {_program(peer) or peer['peer']}"


def _program(peer: Mapping[str, Any]) -> str:
    return "" if peer["profile"] in _NO_PROGRAM else str(peer["profile"])


def _devices(watched: Iterable[Mapping[str, Any]]) -> list[str]:
    return list(dict.fromkeys(device for one in watched if (device := one["stream"].partition("/")[2])))


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
