"""The process that reads recordings for the list of the page: a bad file costs this process, not the page.

``python -m igtl_gateway.addons.page.listing``: each line of its input has the path of a recording as JSON, and what is
wanted of it; each line of its output has that of the next one as JSON.
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable, Set
from pathlib import Path
from typing import Any

from igtl_gateway.addon import NS_PER_S, BeingRecorded, GatewayError, failure_text
from igtl_gateway.addon.live import REPLAY_SIDES, ReplaySide, plan_replay
from igtl_gateway.addon.notes import LINK_DOWN, LINK_UP, LOSSES, PAUSED, RESUMED
from igtl_gateway.addon.processes import ignore_endings
from igtl_gateway.addon.reading import Kind, Level, Note, SessionFile, marks_of, only_of_kinds, stated_seals
from igtl_gateway.addon.terminal import count_text, natural

#: What is wanted of a recording: its row in the list, its time line, the numbers of a stream.
FACTS, PLACES, PLOT = "facts", "places", "plot"
#: Code of the note of messages that a slow peer did not get; those of an episode are no further apart than this, in
#: seconds; streams that are named.
_SLOW, _EPISODE_S, _SLOW_NAMED = "queue_drop", 5.0, 3
#: Most places on a time line, and marks in the list of recordings.
MAX_PLACES, MAX_MARKS = 500, 500
#: Sides of a replay → what a bridge computes their messages from, and the streams that are named of each.
_SIDES = {"igtl": {Kind.ROS_IN}, "ros": {Kind.IGTL_IN}, "both": {Kind.ROS_IN, Kind.IGTL_IN}}
_NAMED = 6
#: Code of a note → what it is on the time line.
_KINDS = dict.fromkeys(LOSSES, "loss") | {PAUSED: "pause", RESUMED: "resume", LINK_UP: "link", LINK_DOWN: "link"}


def facts_of(path: Path) -> dict[str, Any]:
    """Return what the list shows of a recording; ``problem`` is why the rest is missing."""
    try:
        with SessionFile.open(path) as file:
            marks = marks_of(file)
            found: dict[str, Any] = {
                "start_ns": file.start_ns,
                "duration_s": (file.end_ns - file.start_ns) / NS_PER_S,
                "streams": len(file.channels),
                "entries": file.entry_count,
                "foreign": file.foreign,
                "closed": True,
                "marks": [mark.to_dict(file.start_ns) for mark in marks[:MAX_MARKS]],
                "marked": len(marks),
                "sends": {f"{to} {side}".strip(): _sends(file, to, side) for to in _SIDES for side in REPLAY_SIDES},
            }
    except BeingRecorded:
        return {"closed": False, "recording": True, "problem": "is being recorded"}
    except (GatewayError, OSError) as error:
        return {"closed": False, "problem": failure_text(error)}
    try:
        files = sorted(path.glob("*.mcap")) if path.is_dir() else [path]
        stated = [stated_seals(each) for each in files]
        found["sealed"] = bool(stated) and all(stated)
    except (GatewayError, OSError) as error:
        found["problem"] = failure_text(error)
    return found


def _sends(file: SessionFile, to: str, side: ReplaySide) -> dict[str, Any]:
    """Return what a replay sends to a target: names and number of streams, and why; and of those that it does not."""
    how = plan_replay(file, to, recompute=False, side=side)
    kinds = how.kinds | (_SIDES[to] if how.recompute else set())
    sent = _names(file, kinds)
    stay = [name for name in _names(file, {Kind.IGTL_IN}) if name not in sent] if to == "igtl" and not side else []
    return {"names": sent[:_NAMED], "number": len(sent), "why": how.why, "stay": stay[:_NAMED], "staying": len(stay)}


def _names(file: SessionFile, kinds: Set[Kind]) -> list[str]:
    return sorted({one.stream or one.topic for one in file.channels if one.count and one.kind in kinds}, key=natural)


def places_of(path: Path) -> dict[str, Any]:
    """Return what lies on the time line of a recording: findings, losses, pauses and links; marks are in the list."""
    found: list[dict[str, Any]] = []
    try:
        with SessionFile.open(path) as file:
            slow: dict[str, _SlowPeer] = {}
            if not file.foreign:
                for entry in only_of_kinds(file, {Kind.EDGE_NOTE, Kind.NOTE, Kind.LINK}):
                    note = Note.of(entry.data())
                    at_s = (entry.stamp_ns - file.start_ns) / NS_PER_S
                    if len(slow) >= MAX_PLACES:  # a file that invents peers
                        slow.clear()
                    if note.code == _SLOW:
                        place = slow.setdefault(str(note.data.get("peer", "")), _SlowPeer()).take(at_s, note)
                    elif kind := _kind_of(note):
                        place = {"kind": kind, "at_s": at_s, "text": note.text}
                    else:
                        continue
                    if place and len(found) < MAX_PLACES:
                        found.append(place)
    except (GatewayError, OSError) as error:
        return {"places": found, "problem": failure_text(error)}
    return {"places": found}


class _SlowPeer:
    """The episodes in which a peer read too slowly: one place each, which grows with each further note."""

    def __init__(self) -> None:
        self._place: dict[str, Any] = {}
        self._dropped = self._before = 0  # so far, and before the episode

    def take(self, at_s: float, note: Note) -> dict[str, Any] | None:
        """Take a note; return the place of a new episode."""
        is_new = not self._place or at_s - self._place["end_s"] > _EPISODE_S
        by_stream = note.data.get("dropped")
        counts = {name: number for name, number in _items(by_stream) if isinstance(number, int)}
        dropped = sum(counts.values())
        if is_new:
            self._before = self._dropped if dropped >= self._dropped else 0
            self._place = {"kind": "slow", "at_s": at_s}
        self._dropped = dropped
        streams = sorted(counts)
        more = " …" if len(streams) > _SLOW_NAMED else ""
        of = f" of {', '.join(streams[:_SLOW_NAMED])}{more}" if streams else ""
        peer = str(note.data.get("peer", "a peer"))[:80]
        missing = f"{count_text(dropped - self._before, 'message')}{of} did not reach it"
        text = f"{peer} read too slowly: {missing}; the recording lost none by this"
        self._place |= {"end_s": at_s, "text": text}
        return self._place if is_new else None


def _items(found: object) -> list[tuple[str, object]]:
    return [(str(name), value) for name, value in found.items()] if isinstance(found, dict) else []


def _kind_of(note: Note) -> str:
    """Return what a note is on the time line; "" for what is not shown."""
    if note.code in _KINDS:
        return _KINDS[note.code]
    return "finding" if note.level >= Level.WARN else ""


def _plot(path: Path, key: str) -> dict[str, Any]:
    from igtl_gateway.addons.page.plots import plot_of  # here: the list does not wait for what tables need

    return plot_of(path, key)


_WANTED: dict[str, Callable[..., dict[str, Any]]] = {FACTS: facts_of, PLACES: places_of, PLOT: _plot}


def main() -> None:
    """The process."""
    ignore_endings()
    for line in sys.stdin:
        path, what, *more = json.loads(line)
        found = _WANTED[what](Path(path), *more)
        data = json.dumps(found).encode() + b"\n"
        while data:
            data = data[os.write(1, data) :]


if __name__ == "__main__":
    main()
