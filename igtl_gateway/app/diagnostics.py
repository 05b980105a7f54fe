"""The state of a bridge on ``/diagnostics``, once a second; see ``gateway.diagnostics``."""

from __future__ import annotations

import platform
from collections.abc import Callable

from igtl_gateway.app.recording import BridgeRecording
from igtl_gateway.base.clock import Clock
from igtl_gateway.base.qos import Qos
from igtl_gateway.convert.common_msgs import DiagnosticArray
from igtl_gateway.edges.interface import RosSide
from igtl_gateway.edges.tcp import TcpEdge
from igtl_gateway.gateway import Core
from igtl_gateway.gateway.diagnostics import DIAGNOSTICS_TOPIC, Diagnostics, PeerFacts
from igtl_gateway.gateway.log.clock_offset import PeerClocks
from igtl_gateway.gateway.log.note import Level, Note

#: QoS of /diagnostics: that of the diagnostic updater.
_QOS = Qos(depth=10)


class DiagnosticsTopic:
    """The publisher, and what it reads.

    Args:
        side: publishes.
        gateway, tcp, recording: what is reported; None: there is no recording.
        clock: of the stamps.
        on_note: takes the note of a defect.
        has_budget: whether this site may send only so much.
    """

    def __init__(
        self,
        side: RosSide,
        gateway: Core,
        tcp: TcpEdge,
        recording: BridgeRecording | None,
        clock: Clock,
        on_note: Callable[[Note], None],
        *,
        has_budget: bool,
    ) -> None:
        self._side = side
        self._gateway = gateway
        self._tcp = tcp
        self._recording = recording
        self._clock = clock
        self._on_note = on_note
        self._has_budget = has_budget
        self._stopped = False
        self._built: Diagnostics | None = None  # once the node has its name

    def start(self) -> None:
        """Advertise the topic."""
        self._side.advertise(DIAGNOSTICS_TOPIC, DiagnosticArray.TYPE, _QOS)

    def stop(self) -> None:
        """Publish no more."""
        self._stopped = True

    @property
    def is_due(self) -> bool:
        """Whether the topic has a subscriber, and has not stopped."""
        return not self._stopped and self._side.has_subscriber(DIAGNOSTICS_TOPIC)

    def publish(self) -> None:
        """Publish the diagnostics, which are not part of the log.

        Runs in the timer's thread, without a lock that delays messages.
        """
        try:
            self._side.publish(DIAGNOSTICS_TOPIC, DiagnosticArray.TYPE, self._array().pack(), _QOS)
        except Exception as error:  # a defect here must not stop the ticks of this thread
            self._stopped = True
            text = f"{DIAGNOSTICS_TOPIC} stops: {type(error).__name__}: {error}"
            self._on_note(Note(Level.ERROR, "internal_error", text))

    def _array(self) -> DiagnosticArray:
        if self._built is None:
            self._built = Diagnostics(platform.node(), self._side.full_name.removeprefix("/"))
        recorder = self._recording.recorder if self._recording else None
        uploads = self._recording.uploads if self._recording else None
        over_budget = None
        if self._has_budget:
            over_budget = sum(counts["over_budget"] for counts in self._side.counters().values())
        return self._built.array(
            self._clock.utc_ns(),
            self._clock.monotonic_ns(),
            self._gateway.ledger.to_dict(),
            self._gateway.guard.items(),
            self._peers(),
            recorder.counters() if recorder else None,
            uploads.counters() if uploads else None,
            over_budget,
        )

    def _peers(self) -> list[PeerFacts]:
        counters = self._tcp.counters()
        now_ns = self._clock.utc_ns() + self._gateway.guard.ahead_ns
        clocks = self._gateway.questions.clocks if self._gateway.questions else PeerClocks()
        return [
            PeerFacts(
                link.number,
                link.peer,
                link.role,
                counts.sent_messages,
                counts.received_messages,
                counts.queued_messages,
                sum(counts.dropped.values()),
                str(clocks.offset(link.number, now_ns) or ""),
            )
            for link in self._tcp.links()
            if link.connected and (counts := counters.get(link.number))
        ]
