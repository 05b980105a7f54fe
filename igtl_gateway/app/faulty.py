"""Fault injection for a replay: changed messages and closed connections.

The faults are applied in recorded time, before the playback paces the entries.  So every run, at every rate, sends the
same messages with the same faults in the same order.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from threading import Event

from igtl_gateway.app.replay_plan import Send, SendAll
from igtl_gateway.config.faults import DELAY, Fate, FaultLine, Faults
from igtl_gateway.edges.tcp import TcpEdge
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.stamps import moved

#: Marks an entry after which the connections are closed, in place of its links: no link has this number.
DISCONNECT = (0,)

#: Longest wait for peers to reconnect after a disconnect; gateways reconnect within 5 s.
RECONNECT_TIMEOUT_S = 10.0

_POLL_S = 0.2
_IGTL = frozenset({Kind.IGTL_IN, Kind.IGTL_OUT})
_LINE = "replay"


class FaultyFeed:
    """Applies faults to the OpenIGTLink messages of a replay; messages to ROS do not change.

    Attributes:
        counts: counts so far: ``messages``, ``delay`` (delayed messages), and each fault by its name.

    Args:
        faults: the faults.
        seed: seed of the fault injection; the same seed affects the same messages.
        on_fault: called with the fate of every message that has a reportable fault.
    """

    def __init__(self, faults: Faults, seed: int, on_fault: Callable[[Fate[Entry]], None] = lambda fate: None) -> None:
        self.counts: Counter[str] = Counter()
        self._faults = faults
        self._seed = seed
        self._on_fault = on_fault

    def __call__(self, entries: Iterable[Entry]) -> Iterator[Entry]:
        """Yield the entries that are delivered, with their new times.

        Each call begins with a new `FaultLine`, so all passes of a loop are equal.
        """
        line: FaultLine[Entry] = FaultLine(self._faults, self._seed, _LINE, moved)
        for entry in entries:
            if entry.kind in _IGTL:
                fates = line.take(entry.stamp_ns, entry, entry.data())
                yield from self._delivered(fates)
            else:
                yield from self._delivered(line.due(entry.stamp_ns))
                yield entry
        yield from self._delivered(line.drain())

    def _delivered(self, fates: list[Fate[Entry]]) -> Iterator[Entry]:
        for fate in fates:
            self.counts["messages"] += 1
            self.counts.update([name for name, _ in fate.done])
            self.counts[DELAY] += fate.late_ns > 0
            if fate.reportable:
                self._on_fault(fate)
            if not fate.lost:
                payload = fate.message.payload if fate.data is None else (fate.data,)
                links = DISCONNECT if fate.disconnect else fate.message.links
                yield replace(fate.message, stamp_ns=fate.at_ns, payload=payload, links=links)


def disconnector(edge: TcpEdge, stop: Event) -> Callable[[], None]:
    """Return a function that closes all connections and waits until the peers reconnect.

    It sends the queues first, and returns early if ``stop`` is set.
    """

    def disconnect() -> None:
        links = [link.number for link in edge.links() if link.connected]
        while links and not edge.disconnect(links, "fault: disconnect", _POLL_S) and not stop.is_set():
            pass
        for _ in range(round(RECONNECT_TIMEOUT_S / _POLL_S)):
            if stop.is_set() or edge.wait_links(len(links), _POLL_S):
                return

    return disconnect


def with_disconnects(send: Send, disconnect: Callable[[], None]) -> Send:
    """Return ``send`` extended by ``disconnect``, which is called after each entry with the links `DISCONNECT`."""

    def send_and_cut(entry: Entry) -> bool:
        delivered = send(entry)
        if entry.links == DISCONNECT:
            disconnect()
        return delivered

    return send_and_cut


def all_with_disconnects(send_all: SendAll, disconnect: Callable[[], None]) -> SendAll:
    """Return ``send_all`` extended by ``disconnect``, as `with_disconnects` does for single entries."""

    def send_and_cut(entries: Sequence[Entry]) -> bool:
        delivered, run = True, list[Entry]()
        for entry in entries:
            run.append(entry)
            if entry.links == DISCONNECT:
                delivered = send_all(run) and delivered
                disconnect()
                run = []
        return (not run or send_all(run)) and delivered

    return send_and_cut
