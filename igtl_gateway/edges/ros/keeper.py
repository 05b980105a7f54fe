"""The thread that looks after the topics: discovery, events of the middleware, held messages."""

from __future__ import annotations

import threading

from igtl_gateway.edges.ros.node import RosNode
from igtl_gateway.edges.ros.publishing import Publishing
from igtl_gateway.edges.ros.reports import Reports
from igtl_gateway.edges.ros.subscribing import Subscribing, Wants

_DISCOVER_NS = 250_000_000
_RELEASE_S = 0.02  # between two checks of held messages; a match also wakes the thread at once
_BURST_S = 0.002  # between two bursts of held messages, so that a subscription of the same depth can take them


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
        node, now_ns = self._node, self._node.clock.monotonic_ns
        discover_ns = 0
        while not node.stopping.is_set():
            if (begun_ns := now_ns()) >= discover_ns:
                discover_ns = begun_ns + _DISCOVER_NS
                self._maintain()
            bursting = self._publishing.send_held()
            node.notify()
            left_s = max(0, discover_ns - now_ns()) / 1e9
            holding = self._publishing.is_holding()
            node.wake.wait(_BURST_S if bursting else min(_RELEASE_S, left_s) if holding else left_s)
            node.wake.clear()

    def _maintain(self) -> None:
        """What is due four times a second."""
        try:
            self._subscribing.discover(self._wants)
        except Exception as error:  # of ``wants``, or of a graph that changes meanwhile: try again
            self._reports.callback_failed("looking at the graph", error, "graph")
        self._subscribing.poll_events()
        self._publishing.notify_first_subscribers()
        self._subscribing.note_losses()
