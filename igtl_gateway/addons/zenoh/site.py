"""Other sites: their clocks, measured as NTP does, and the latency of what they send.

Each gateway with a site answers ``igtl_gateway/site/DOMAIN/NAME/clock`` with the time when the question came and that
of the answer.  So its clock is ahead by at most (came - asked) and at least (answered - arrived).
"""

from __future__ import annotations

import struct
import threading
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any

from igtl_gateway.addon import NS_PER_S, Clock
from igtl_gateway.addon.reading import Level
from igtl_gateway.addon.ros_side import Reports
from igtl_gateway.addon.terminal import clock_text, counted, duration_text

#: Between questions.
ASK_NS = 2 * NS_PER_S
#: Between notes on a site that is known.
NOTE_NS = 60 * NS_PER_S
#: A site that has not answered this number of questions is away.
_AWAY_QUESTIONS = 4
_TIMEOUT_S = 1.5
_EXCHANGES = 16
#: Before the first note: the first questions wait for connections.
_LEAST_EXCHANGES = 4
#: Clocks of computers drift apart by no more than this, usually.
_DRIFT = 5e-5
_SITES = 64
_LATENCIES = 4096
_ANSWER = struct.Struct("<qq")
_ZID_BYTES = 32

#: Identifiers of publishers → age of the message on arrival, ns, by our clock and their stamp.
Ages = deque[tuple[bytes, int]]


@dataclass(slots=True)
class _Site:
    """A site: its last exchanges (asked, came, answered, arrived; UTC ns), and what was noted."""

    zid: str = ""
    exchanges: deque[tuple[int, int, int, int]] = field(default_factory=lambda: deque(maxlen=_EXCHANGES))
    answered_ns: int = 0
    noted_ns: int = 0
    away: bool = False

    def offset_ns(self, now_ns: int) -> tuple[float, float]:
        """How far its clock is ahead, and the error: of the exchange with the smallest."""
        best = (0.0, float("inf"))
        for asked, came, answered, arrived in self.exchanges:
            high, low = came - asked, answered - arrived
            error = (high - low) / 2 + _DRIFT * abs(now_ns - arrived)
            if error < best[1]:
                best = (high + low) / 2, error
        return best


class Sites:
    """Asks and answers; the keeper of the edge calls `keep`.

    Args:
        name: of this site.
        domain: of ROS.
        reports: takes the notes.
        clock: source of the times.
        gids: identifiers of the publishers of a session of Zenoh.
        ages: topic → ages of its messages since the last call.
    """

    def __init__(
        self,
        name: str,
        domain: int,
        reports: Reports,
        clock: Clock,
        gids: Callable[[str], set[bytes]],
        ages: Callable[[], Iterable[tuple[str, list[tuple[bytes, int]]]]],
    ) -> None:
        self._name = name
        self._space = f"igtl_gateway/site/{domain}"
        self._reports = reports
        self._clock = clock
        self._gids = gids
        self._ages = ages
        self._lock = threading.Lock()
        self._sites: dict[str, _Site] = {}
        self._session: Any = None
        self._zenoh: Any = None
        self._queryable: Any = None
        self._asked_ns = 0
        self._latencies: dict[str, deque[tuple[bytes, int]]] = {}

    def declare(self, zenoh: Any, session: Any) -> None:
        """Answer the questions of others."""
        self._zenoh, self._session = zenoh, session
        key = f"{self._space}/{self._name}/clock"
        zid = str(session.info.zid()).encode()

        def on_query(query: Any) -> None:
            came = self._clock.utc_ns()
            query.reply(key, _ANSWER.pack(came, self._clock.utc_ns()) + zid)

        self._queryable = session.declare_queryable(key, on_query, complete=True)

    def keep(self) -> None:
        """Ask all sites if that is due, and note what is known of them."""
        now_ns = self._clock.monotonic_ns()
        if self._session is None or now_ns < self._asked_ns + ASK_NS:
            return
        self._asked_ns = now_ns
        self._ask()
        for topic, some in self._ages():
            self._latencies.setdefault(topic, deque(maxlen=_LATENCIES)).extend(some)
        with self._lock:
            sites = dict(self._sites)
        for name, site in sites.items():
            away = now_ns - site.answered_ns > _AWAY_QUESTIONS * ASK_NS
            if away and not site.away:
                self._reports.note(Level.WARN, "site_lost", f"site {name} does not answer", data={"site": name})
            known = len(site.exchanges) >= _LEAST_EXCHANGES
            if known and not away and (site.away or not site.noted_ns or now_ns - site.noted_ns >= NOTE_NS):
                site.noted_ns = now_ns
                self._note(name, site)
            site.away = away

    def _ask(self) -> None:
        asked = self._clock.utc_ns()

        def on_reply(reply: Any) -> None:
            arrived, now_ns = self._clock.utc_ns(), self._clock.monotonic_ns()
            sample = reply.ok
            data = sample.payload.to_bytes() if sample is not None else b""
            if not _ANSWER.size <= len(data) <= _ANSWER.size + _ZID_BYTES:
                return
            name = str(sample.key_expr).split("/")[-2]
            came, answered = _ANSWER.unpack_from(data)
            with self._lock:
                if name == self._name or (name not in self._sites and len(self._sites) >= _SITES):
                    return
                site = self._sites.setdefault(name, _Site())
                site.zid = data[_ANSWER.size :].decode("ascii", "replace")
                site.exchanges.append((asked, came, answered, arrived))
                site.answered_ns = now_ns

        self._session.get(
            f"{self._space}/*/clock",
            on_reply,
            timeout=_TIMEOUT_S,
            priority=self._zenoh.Priority.REAL_TIME,
            congestion_control=self._zenoh.CongestionControl.DROP,  # the keeper must not wait for a dead line
            express=True,
            allowed_destination=self._zenoh.Locality.REMOTE,
        )

    def _note(self, name: str, site: _Site) -> None:
        offset_ns, error_ns = site.offset_ns(self._clock.utc_ns())
        error_ms = error_ns / 1e6
        self._reports.note(
            Level.INFO,
            "site_clock",
            f"site {name}: its clock is {clock_text(offset_ns)} ahead of our clock, ±{duration_text(error_ms * 1e6)}",
            data={"site": name, "offset_s": offset_ns / NS_PER_S, "error_s": error_ns / NS_PER_S},
        )
        gids = self._gids(site.zid)
        for topic, ages in self._latencies.items():
            found = sorted(age for of_gid, age in ages if of_gid in gids)
            if not found:
                continue
            kept = [each for each in ages if each[0] not in gids]
            ages.clear()
            ages.extend(kept)
            low, middle, high = ((found[round(part * (len(found) - 1))] + offset_ns) / 1e6 for part in (0, 0.5, 0.99))
            shown = [duration_text(each * 1e6) for each in (low, middle, high, error_ms)]
            self._reports.note(
                Level.INFO,
                "site_latency",
                f"{topic} from site {name}: {counted(len(found), 'message')}, latency {shown[0]}, median {shown[1]}, "
                f"99 % {shown[2]}, each ±{shown[3]}",
                topic,
                {
                    "site": name,
                    "messages": len(found),
                    "min_ms": low,
                    "p50_ms": middle,
                    "p99_ms": high,
                    "error_ms": error_ms,
                },
            )
