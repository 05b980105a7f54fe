"""A replay with faults: what the messages of a feed become on a bad line, and the end of connections.

The faults happen in recorded time, before the playback paces anything.  So the same messages go out with the same
faults in the same order at every rate, and at every run.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from threading import Event

from igtl_gateway.app.replay_plan import Send, SendAll
from igtl_gateway.edges.tcp import TcpEdge
from igtl_gateway.faults import DELAY, Fate, FaultLine, Faults
from igtl_gateway.gateway.stamps import moved
from igtl_gateway.session.entry import Entry, Kind

#: The links of an entry behind which the connections are closed: no link has this number.
DISCONNECT = (0,)

#: How long a replay waits for peers whose connection it has closed; gateways are back within five seconds.
RECONNECT_TIMEOUT_S = 10.0

_LOOK_S = 0.2
_IGTL = frozenset({Kind.IGTL_IN, Kind.IGTL_OUT})
_LINE = "replay"


class FaultyFeed:
    """Faults for the OpenIGTLink messages of a replay; what is for ROS stays as it is.

    Attributes:
        counts: what was done so far: ``messages``, ``delay`` (how many left later), and each fault by its name.

    Args:
        on_fault: told of every message of which there is something to tell.
    """

    def __init__(self, faults: Faults, seed: int, on_fault: Callable[[Fate[Entry]], None] = lambda fate: None) -> None:
        self.counts: Counter[str] = Counter()
        self._faults = faults
        self._seed = seed
        self._on_fault = on_fault

    def __call__(self, entries: Iterable[Entry]) -> Iterator[Entry]:
        """What leaves, at its moments; each call is a line of its own, so that each pass of a loop is the same."""
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
    """Closes all connections of a replay, once all that was sent has arrived, and waits for the peers to be back."""

    def disconnect() -> None:
        links = [link.number for link in edge.links() if link.connected]
        while links and not edge.disconnect(links, "fault: disconnect", _LOOK_S) and not stop.is_set():
            pass
        for _ in range(round(RECONNECT_TIMEOUT_S / _LOOK_S)):
            if stop.is_set() or edge.wait_links(len(links), _LOOK_S):
                return

    return disconnect


def with_disconnects(send: Send, disconnect: Callable[[], None]) -> Send:
    """``send``, and the end of the connections where an entry says so."""

    def send_and_cut(entry: Entry) -> bool:
        delivered = send(entry)
        if entry.links == DISCONNECT:
            disconnect()
        return delivered

    return send_and_cut


def all_with_disconnects(send_all: SendAll, disconnect: Callable[[], None]) -> SendAll:
    """The same of several."""

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
