"""The thread that looks after the topics: discovery, events of the middleware, held messages."""

from __future__ import annotations

import threading

from igtl_gateway.edges.interface import Reports, Wants
from igtl_gateway.edges.ros.node import RosNode
from igtl_gateway.edges.ros.publishing import Publishing
from igtl_gateway.edges.ros.subscribing import Subscribing

#: From a change of the graph to the look at it: what changes together comes within this time.
_GATHER_NS = 10_000_000
#: From one look at the graph to the next, however often it changes; and as a multiple of the time that it takes.
_PAUSE_NS, _PAUSE = 50_000_000, 19
#: From a change to one more look: the matches that it brings come a little later.
_SETTLE_NS = 250_000_000
#: Without a change: in case that one was missed.
_SAFETY_NS = 5_000_000_000
#: The same where changes are not noticed.
_BLIND_NS = 250_000_000
#: Between two notes of lost messages, which no event reports.
_LOSSES_NS = 1_000_000_000
_RELEASE_NS = 10_000_000  # between two checks of held messages; a match also wakes the thread at once


class Keeper:
    """Runs from the start of the node until it stops."""

    def __init__(
        self, node: RosNode, publishing: Publishing, subscribing: Subscribing, reports: Reports, wants: Wants
    ) -> None:
        self._node = node
        self._publishing = publishing
        self._subscribing = subscribing
        self._reports = reports
        self._wants = wants
        self._thread = threading.Thread(target=self._run, name="igtl-ros-keeper", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def join(self) -> None:
        """Wait for the end, which the stop of the node brings."""
        self._thread.join()

    def _run(self) -> None:
        node, watch, now_ns = self._node, self._node.graph, self._node.clock.monotonic_ns
        times = LookTimes(now_ns(), sees_changes=watch.sees_changes)
        try:
            while not node.stopping.is_set():
                begun_ns = now_ns()
                if begun_ns >= times.look_ns:
                    times.looked(begun_ns)
                    self._look()
                    times.took(now_ns() - begun_ns)
                if begun_ns >= times.losses_ns:
                    times.losses_ns = begun_ns + _LOSSES_NS
                    self._subscribing.poll_events()
                    self._publishing.poll_events()
                    self._subscribing.note_losses()
                self._publishing.notify_first_subscribers()
                self._publishing.send_held()
                self._publishing.bound_latched()
                node.notify()
                left_ns = max(0, min(times.look_ns, times.losses_ns) - now_ns())
                if self._publishing.is_holding():
                    left_ns = min(left_ns, _RELEASE_NS)
                if watch.wait(left_ns):
                    times.changed(now_ns())
        finally:
            watch.close()

    def _look(self) -> None:
        """Look at the graph, and take the events that a change brings."""
        try:
            self._subscribing.discover(self._wants)
        except Exception as error:  # of ``wants``, or of a graph that changes meanwhile: try again
            self._reports.callback_failed("looking at the graph", error, "graph")
        self._subscribing.poll_events()
        self._publishing.poll_matches()


class LookTimes:
    """When the keeper is to look at the graph, and to note losses, in monotonic ns.

    Args:
        now_ns: the time of the start, at which both are due.
        sees_changes: whether `changed` is called for each change of the graph.
    """

    def __init__(self, now_ns: int, *, sees_changes: bool) -> None:
        self.look_ns = self.losses_ns = now_ns
        self._unchanged_ns = _SAFETY_NS if sees_changes else _BLIND_NS
        self._looked_ns = 0
        self._pause_ns = _PAUSE_NS
        self._settled_ns = now_ns + _SETTLE_NS

    def changed(self, now_ns: int) -> None:
        """The graph has changed."""
        self._settled_ns = now_ns + _SETTLE_NS
        self.look_ns = min(self.look_ns, max(now_ns + _GATHER_NS, self._looked_ns + self._pause_ns))

    def looked(self, now_ns: int) -> None:
        """A look begins."""
        self._looked_ns = now_ns
        self.look_ns = now_ns + self._unchanged_ns
        if now_ns < self._settled_ns:
            self.look_ns = min(self.look_ns, self._settled_ns)

    def took(self, duration_ns: int) -> None:
        """The look has ended: where peers invent topics, looks take a twentieth of the time at most."""
        self._pause_ns = max(_PAUSE_NS, _PAUSE * duration_ns)
