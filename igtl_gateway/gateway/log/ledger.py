"""The loss ledger: the fate of every message, by stream and by peer.

* Each stream that comes in: ``received = the sum of the fates in fates.KEPT + the sum of dropped``.
* Each peer that has disconnected: ``sent = delivered to its socket + the sum of dropped``.
* All peers together: what the gateway sent is what their links delivered, dropped, ignored and still have queued, and
  what the links received is what the gateway received.

A message that is missing in these sums is a defect of the gateway; ``gaps`` finds it.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from igtl_gateway.gateway.log.fates import KEPT

#: What a link must have counted for the sums over all of them.
_LINK_COUNTS = frozenset({"sent_messages", "received_messages", "dropped", "ignored"})

#: Section of the ledger with one row for each peer that has disconnected: ``"link address"``.
PEERS = "peers"

#: Streams counted one by one in each direction; a peer that invents names adds to ``OTHERS`` beyond that.
MAX_STREAMS = 2_000
OTHERS = "(others)"


#: (direction, stream) → fate → number.
_Book = dict[tuple[str, str], dict[str, int]]


class Ledger:
    """Counts by direction, stream and fate."""

    def __init__(self) -> None:
        self._counts: _Book = {}
        self._dropped: _Book = {}
        self._streams: dict[str, set[str]] = {}  # of each direction: a stream is the same in both books

    def count(self, direction: str, stream: str, fate: str, number: int = 1) -> None:
        """Add to ``received``, ``decoded``, ``sent``, ``published`` or a fate of ``fates.KEPT``."""
        self._add(self._counts, direction, stream, fate, number)

    def drop(self, direction: str, stream: str, reason: str, number: int = 1) -> None:
        """Add to ``dropped`` with its reason."""
        self._add(self._dropped, direction, stream, reason, number)

    def counter(self, direction: str, stream: str) -> dict[str, int]:
        """Return the counts of a stream, for callers that increase them often: fate → number."""
        words = self._counts.get((direction, stream))
        return self._open(self._counts, direction, stream) if words is None else words

    def streams(self, direction: str) -> frozenset[str]:
        """Return the streams of a direction that are counted."""
        return frozenset(self._streams.get(direction, ()))

    def _add(self, book: _Book, direction: str, stream: str, word: str, number: int) -> None:
        words = book.get((direction, stream))
        if words is None:
            words = self._open(book, direction, stream)
        words[word] = words.get(word, 0) + number

    def _open(self, book: _Book, direction: str, stream: str) -> dict[str, int]:
        known = self._streams.setdefault(direction, set())
        if stream not in known:
            if len(known) >= MAX_STREAMS:
                stream = OTHERS
            else:
                known.add(stream)
        return book.setdefault((direction, stream), {})

    def totals(self) -> dict[str, dict[str, int]]:
        """Return direction → stream → messages with any fate, of the streams that have some."""
        found: dict[str, dict[str, int]] = {}
        for (direction, stream), fates in self._counts.copy().items():
            if total := fates.get("received") or fates.get("sent") or fates.get("published"):
                found.setdefault(direction, {})[stream] = total
        return found

    def drops(self) -> dict[str, dict[str, dict[str, int]]]:
        """Return direction → stream → reason → dropped messages, of the streams that have some."""
        found: dict[str, dict[str, dict[str, int]]] = {}
        for (direction, stream), reasons in self._dropped.copy().items():
            found.setdefault(direction, {})[stream] = reasons.copy()
        return found

    def to_dict(self) -> dict[str, Any]:
        """``{direction: {stream: {fate: n, "dropped": {reason: n}}}}``, sorted."""
        recorded: dict[str, Any] = {}
        for direction, stream in sorted({*self._counts, *self._dropped}):
            fates: dict[str, Any] = dict(sorted(self._counts.get((direction, stream), {}).items()))
            if dropped := self._dropped.get((direction, stream)):
                fates["dropped"] = dict(sorted(dropped.items()))
            if fates:
                recorded.setdefault(direction, {})[stream] = fates
        return recorded


def gaps(recorded: Mapping[str, Any]) -> list[str]:
    """Return the sums that do not close in the ledger of a finished session, one sentence each.

    Args:
        recorded: the ledger of a recording: ``{"streams": Ledger.to_dict(), "links": {number: counts}, …}``; counts
            that an old recording does not have are not required.
    """
    streams = recorded.get("streams", {})
    found = []
    for direction in ("igtl_in", "ros_in"):
        for stream, fates in streams.get(direction, {}).items():
            received = fates.get("received", 0)
            known = sum(fates.get(fate, 0) for fate in KEPT) + _dropped(fates)
            if received != known:
                found.append(f"{direction} {stream}: received {received:,}, accounted for {known:,}")
    for peer, fates in streams.get(PEERS, {}).items():
        sent, known = fates.get("sent", 0), fates.get("delivered", 0) + _dropped(fates)
        if sent != known:
            found.append(f"to peer {peer}: sent {sent:,}, accounted for {known:,}")
    links = recorded.get("links", {}).values()
    if not links or not all(link.keys() >= _LINK_COUNTS for link in links):
        return found
    sent = sum(fates.get("sent", 0) for fates in streams.get("igtl_out", {}).values())
    known = sum(link["sent_messages"] + link.get("queued_messages", 0) for link in links)
    known += sum(sum(link[lost].values()) for link in links for lost in ("dropped", "ignored"))
    if sent != known:
        found.append(f"to all peers: sent {sent:,}, accounted for {known:,}")
    received = sum(fates.get("received", 0) for fates in streams.get("igtl_in", {}).values())
    known = sum(link["received_messages"] for link in links)
    if received != known:
        found.append(f"from all peers: the links received {known:,}, the gateway {received:,}")
    return found


def _dropped(fates: Mapping[str, Any]) -> int:
    return sum(fates.get("dropped", {}).values())
