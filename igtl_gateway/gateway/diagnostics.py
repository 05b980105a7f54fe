"""Diagnostics for ``/diagnostics``: one status for each input stream, for each peer, and for the recorder.

They are built from the ledger and the guard once a second and are not part of the session log.  Counts of a whole
session differ in every slice, part or lossy recording, and a verification cannot distinguish that from a defect.  Pure:
time and counts are arguments.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from igtl_gateway.base.quantities import by_count, count_text, duration_text, rate_text, rough_text
from igtl_gateway.base.stamp import NS_PER_MS, NS_PER_S
from igtl_gateway.convert.common_msgs import DiagnosticArray
from igtl_gateway.convert.rosmsg import DiagnosticStatus, Header
from igtl_gateway.gateway.guarded_stream import FUTURE, GuardedStream
from igtl_gateway.gateway.log.timing import best

DIAGNOSTICS_TOPIC = "/diagnostics"

OK, WARN, ERROR, STALE = 0, 1, 2, 3  # levels of diagnostic_msgs/DiagnosticStatus

#: A periodic stream without a message for this time is stale.
SILENT_NS = 5 * NS_PER_S
#: Minimum rate of a periodic stream.
RHYTHM_HZ = 1.0
#: Maximum number of streams with a status: 256 streams are 60 kB and 10 ms of work every second.
MAX_STREAMS = 256
#: Reasons that are not a problem: no peer was connected, or no peer requested the message.
HARMLESS = frozenset({"no_peer", "not_chosen", "not_wanted", "not_for_peer", "part_of_volume", "empty", "denied"})

_SIDES = {"igtl_in": "OpenIGTLink", "ros_in": "ROS"}


#: A disk that lasts for a shorter time, s, is a warning: the first of ``record.space.LOW_S``.
DISK_LOW_S = 1800.0


@dataclass(frozen=True, slots=True)
class PeerFacts:
    """Facts about a peer: link, address, the sent, queued and dropped messages, the offset of its clock in words."""

    link: int
    address: str
    role: str
    sent: int = 0
    received: int = 0
    queued: int = 0
    dropped: int = 0
    clock_offset: str = ""


@dataclass(slots=True)
class _Baseline:
    """Counts of a stream at the previous call."""

    received: int = 0
    troubles: int = 0
    moved_ns: int = 0  # time at which the counts last grew
    rhythm: bool = False
    had_sender: bool = False  # a peer that the guard knows


class Diagnostics:
    """Builds the statuses of a session; each call covers the time since the previous one.

    Args:
        hardware_id: of all statuses: the host.
        node: begin of the name of each status: the node with its namespace, such as ``or1/igtl_gateway``.  Aggregators
            identify a status by its name alone, so two bridges must not share names.
    """

    def __init__(self, hardware_id: str, node: str = "igtl_gateway") -> None:
        self._hardware_id = hardware_id
        self._node = node
        self._seen: dict[tuple[str, str], _Baseline] = {}
        self._dropped: dict[str, int] = {}  # of peers and of the recorder, by name
        self._last_ns = 0

    def array(
        self,
        utc_ns: int,
        now_ns: int,
        streams: Mapping[str, Mapping[str, Any]],
        watched: Iterable[tuple[tuple[int, str], GuardedStream]],
        peers: Iterable[PeerFacts],
        recorder: Mapping[str, Any] | None,
        uploads: Mapping[str, Any] | None = None,
        over_budget: int | None = None,
    ) -> DiagnosticArray:
        """Build the message.

        Args:
            utc_ns: stamp of the message, UTC ns.
            now_ns: time on the monotonic clock.
            streams: the ledger, from ``Ledger.to_dict``.
            watched: (link, stream) and the guarded stream.
            peers: the connected peers.
            recorder: counters of the recorder; None without a recording.
            uploads: counters of the upload; None without one.
            over_budget: messages that exceed the budget of the site; None without a site.
        """
        seconds = (now_ns - self._last_ns) / NS_PER_S if self._last_ns else 0.0
        self._last_ns = now_ns
        by_stream: dict[tuple[str, str], list[GuardedStream]] = {}
        by_link: dict[int, list[GuardedStream]] = {}
        for (link, stream), one in watched:
            by_stream.setdefault(("igtl_in" if link else "ros_in", stream), []).append(one)
            by_link.setdefault(link, []).append(one)
        statuses = [self._recorder(recorder)]
        if uploads is not None:
            statuses.append(self._upload(uploads))
        if over_budget is not None:
            statuses.append(self._site(over_budget))
        statuses += [self._peer(peer, by_link.get(peer.link, [])) for peer in peers]
        rows = [(side, stream, fates) for side in _SIDES for stream, fates in streams.get(side, {}).items()]
        for side, stream, fates in rows[:MAX_STREAMS]:
            statuses.append(self._stream(now_ns, seconds, side, stream, fates, by_stream.get((side, stream), [])))
        rowless = [(key[1], ones) for key, ones in by_stream.items() if key[1] not in streams.get(key[0], {})]
        statuses += [self._frame(stream, ones) for stream, ones in rowless[:MAX_STREAMS]]
        if len(rows) > MAX_STREAMS:
            text = (
                f"{count_text(len(rows) - MAX_STREAMS, 'more stream')} "
                f"{by_count(len(rows) - MAX_STREAMS, 'is', 'are')} not shown"
            )
            statuses.append(DiagnosticStatus(WARN, f"{self._node}: further streams", text, self._hardware_id))
        return DiagnosticArray(Header(utc_ns, ""), tuple(statuses))

    def _frame(self, stream: str, watched: list[GuardedStream]) -> DiagnosticStatus:
        """Build the status of a guarded stream that the ledger does not have: a tf frame, a child of a BIND."""
        stale = sum(one.stale for one in watched)
        level, text = (
            (ERROR, f"stale: {count_text(stale, 'message')} withheld so far (max_age_s)") if stale else (OK, "fresh")
        )
        return DiagnosticStatus(level, f"{self._node}: {stream}", text, self._hardware_id)

    def _stream(
        self,
        now_ns: int,
        seconds: float,
        side: str,
        stream: str,
        fates: Mapping[str, Any],
        watched: list[GuardedStream],
    ) -> DiagnosticStatus:
        seen = self._seen.setdefault((side, stream), _Baseline(moved_ns=now_ns))
        received, dropped = fates.get("received", 0), fates.get("dropped", {})
        rate_hz = (received - seen.received) / seconds if seconds else 0.0
        troubles = sum(number for reason, number in dropped.items() if reason not in HARMLESS)
        fresh_troubles, seen.troubles = troubles - seen.troubles, troubles
        if received != seen.received:
            seen.moved_ns, seen.received = now_ns, received
        seen.rhythm = seen.rhythm or rate_hz >= RHYTHM_HZ
        silent_ns = now_ns - seen.moved_ns
        # the guard forgets the streams of a link that is closed
        seen.had_sender = seen.had_sender or bool(watched)
        has_left = side == "igtl_in" and seen.had_sender and not watched
        stale = [one for one in watched if one.stale]
        odd = sorted({code for one in watched for code in one.episodes})
        if stale:
            level, text = (
                ERROR,
                f"stale: {count_text(sum(one.stale for one in stale), 'message')} withheld so far (max_age_s)",
            )
        elif fresh_troubles > 0:
            reasons = ", ".join(reason for reason in dropped if reason not in HARMLESS)
            level, text = ERROR, f"{count_text(fresh_troubles, 'message')} lost since the last report: {reasons}"
        elif odd:
            level, text = WARN, ", ".join(odd)
        elif has_left:
            level, text = STALE if seen.rhythm else OK, "its peer has left"
        elif silent_ns >= SILENT_NS:
            level, text = STALE if seen.rhythm else OK, f"no message for {duration_text(silent_ns)}"
        else:
            level, text = OK, rate_text(rate_hz)
        values = [("frequency_hz", f"{rate_hz:.2f}"), ("silent_s", f"{silent_ns / NS_PER_S:.1f}")]
        newest = max(watched, key=lambda one: one.arrived_ns, default=None)
        if newest and (age_ns := newest.age_ns) is not None:
            values.append(("last_age_ms", f"{age_ns / NS_PER_MS:.3f}"))
        values += [(fate, f"{number}") for fate, number in fates.items() if fate != "dropped"]
        values += [(f"dropped.{reason}", f"{number}") for reason, number in dropped.items()]
        return DiagnosticStatus(level, f"{self._node}: {_SIDES[side]} {stream}", text, self._hardware_id, tuple(values))

    def _peer(self, peer: PeerFacts, watched: list[GuardedStream]) -> DiagnosticStatus:
        name = f"{self._node}: peer {peer.link} {peer.address}"
        lost = self._increase(name, peer.dropped)
        clock = best(one.timing for one in watched)
        level, text = (ERROR, f"reads too slowly: {count_text(lost, 'message')} dropped") if lost else (OK, "connected")
        if not lost and any(FUTURE in one.episodes for one in watched):
            level, text = WARN, "stamps are in the future"
        values = [(key, f"{getattr(peer, key)}") for key in ("role", "received", "sent", "queued", "dropped")]
        if clock:
            values.append(("clock", str(clock)))
        if peer.clock_offset:
            values.append(("clock_offset", peer.clock_offset))
        return DiagnosticStatus(level, name, text, peer.address, tuple(values))

    def _recorder(self, counters: Mapping[str, Any] | None) -> DiagnosticStatus:
        name = f"{self._node}: recorder"
        if counters is None:
            return DiagnosticStatus(OK, name, "not recording", self._hardware_id)
        lost = self._increase(name, counters["dropped_entries"])
        level, text = (ERROR, f"lost {count_text(lost, 'entry', 'entries')}") if lost else (OK, "recording")
        if counters["failure"]:
            level, text = ERROR, str(counters["failure"])
        elif counters.get("taken_away"):
            level, text = max(level, WARN), str(counters["taken_away"])
        elif level == OK:
            level, text = _disk(counters.get("disk_left_s"), counters.get("behind_s", 0.0))
        keys = ("written_entries", "queued_entries", "dropped_entries", "left_out_entries", "behind_s", "disk_left_s")
        values = tuple((key, f"{counters[key]}") for key in keys if counters.get(key) is not None)
        return DiagnosticStatus(level, name, text, self._hardware_id, values)

    def _upload(self, counters: Mapping[str, Any]) -> DiagnosticStatus:
        waiting, problem = counters["waiting"], counters["problem"]
        level, text = (
            (WARN, f"waits: {problem}")
            if problem
            else (OK, f"{count_text(waiting, 'file')} {by_count(waiting, 'waits', 'wait')}")
        )
        values = tuple((key, f"{counters[key]}") for key in counters if key != "problem")
        return DiagnosticStatus(level, f"{self._node}: upload", text, self._hardware_id, values)

    def _site(self, over_budget: int) -> DiagnosticStatus:
        name = f"{self._node}: site"
        dropped = self._increase(name, over_budget)
        level, text = (
            (WARN, f"budget exceeded: {count_text(dropped, 'message')} dropped")
            if dropped
            else (OK, "within the budget")
        )
        return DiagnosticStatus(level, name, text, self._hardware_id, (("over_budget", f"{over_budget}"),))

    def _increase(self, name: str, number: int) -> int:
        """Return the increase of a count since the previous call."""
        before, self._dropped[name] = self._dropped.get(name, 0), number
        return number - before


def _disk(left_s: float | None, behind_s: float) -> tuple[int, str]:
    """Level and text of a recorder that loses nothing: whether its disk becomes full, and its file is behind."""
    if behind_s:
        return WARN, f"the file is {duration_text(behind_s * NS_PER_S)} behind"
    if left_s is not None and left_s < DISK_LOW_S:
        return WARN, f"the disk is full in {rough_text(left_s)} at the present rate"
    return OK, "recording"
