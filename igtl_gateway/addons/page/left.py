"""Peers that have left: for a while each keeps its row, unless it is back.  Pure."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from igtl_gateway.addon import NS_PER_S
from igtl_gateway.addons.page.trouble import departed

#: A peer that has left keeps its row for this time, ns; rows that are kept, the last ones.
_KEPT_NS, _MAX_KEPT = 90 * NS_PER_S, 12


class Left:
    """The clients of a session that were there and are not."""

    def __init__(self) -> None:
        self._there: dict[str, dict[str, Any]] = {}
        self._left: dict[str, tuple[int, dict[str, Any]]] = {}

    def rows(self, links: Iterable[dict[str, Any]], now_ns: int, utc_ns: int) -> list[dict[str, Any]]:
        """Return the rows of those that have left.

        Args:
            links: rows of those that are there, each with its ``streams``.
            now_ns: time of the sample.
            utc_ns: the same in UTC.
        """
        there = {row["key"]: row for row in links if row["link"]}
        newest = max((row["number"] for row in self._there.values()), default=0)
        for key, row in self._there.items():
            if key not in there and row["role"] == "client" and row["passed"]:
                gone = {"link": 0, "spark": "", "left_ns": utc_ns, "queue": 0, "newest": newest}
                self._left[key] = now_ns, row | gone
        self._there = there
        self._left = {
            key: one
            for key, one in list(self._left.items())[-_MAX_KEPT:]
            if now_ns - one[0] < _KEPT_NS and not any(_is_back(one[1], row) for row in there.values())
        }
        return [_row(row, now_ns - since_ns) for since_ns, row in self._left.values()]


def _is_back(left: dict[str, Any], there: dict[str, Any]) -> bool:
    """Return whether a later link is of the same peer: it sends one of its streams, or has its name and its host."""
    if there["link"] <= left["newest"]:  # it was there at that time
        return False
    names = [(row["name"], row["peer"].rpartition(":")[0]) for row in (left, there)]
    return bool(left["streams"] & there["streams"]) or (not left["streams"] and names[0] == names[1])


def _row(row: dict[str, Any], since_ns: int) -> dict[str, Any]:
    trouble = departed(since_ns, was_regular=row["is_regular"])
    found = row | {"state": trouble.state, "text": trouble.text, "advice": trouble.advice}
    unknown = dict.fromkeys(("latency_ms", "ahead_ms", "jitter_ms"))
    return found | unknown | {"from_hz": 0.0, "to_hz": 0.0}
