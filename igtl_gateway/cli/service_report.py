"""What systemd learns of a running ``bridge``: that it is ready, works, and ends; and one line on its state.

The watchdog is fed from the loop of the verb, and only if the hub has completed a tick since the last time: a session
whose lock is held for good, whose timer has ended, or whose verb hangs is started again.
"""

from __future__ import annotations

from igtl_gateway.base.clock import Clock
from igtl_gateway.base.stamp import NS_PER_S
from igtl_gateway.base.systems.service import ServiceManager
from igtl_gateway.cli.bridge_output import StatusLine
from igtl_gateway.cli.bridge_session import BridgeSession

_EVERY_NS = NS_PER_S
_WAITING = "unconfigured: another node configures and activates it"


class ServiceReport:
    """Reports sessions, which run one after the other, to the service manager.

    Args:
        manager: who receives the reports.
        clock: paces them.
    """

    def __init__(self, manager: ServiceManager, clock: Clock) -> None:
        self._manager = manager
        self._clock = clock
        self._start_ns = clock.monotonic_ns()
        self._next_ns = self._start_ns
        self._status_line = StatusLine()
        self._session: BridgeSession | None = None
        self._ticks = 0

    def ready(self) -> None:
        """Report that the start has succeeded."""
        self._manager.send("READY=1")

    def update(self, session: BridgeSession | None) -> None:
        """Report the session that runs now, at most once a second; None: there is none."""
        now_ns = self._clock.monotonic_ns()
        if not self._manager.is_present or now_ns < self._next_ns:
            return
        self._next_ns = now_ns + _EVERY_NS
        if session is not self._session:
            self._session, self._ticks, self._status_line = session, 0, StatusLine()
        if session is None:
            self._manager.send(f"STATUS={_WAITING}", "WATCHDOG=1")
            return
        ticks = session.bridge.hub.ticks
        if ticks == self._ticks:
            return
        self._ticks = ticks
        seconds = (now_ns - self._start_ns) / NS_PER_S
        self._manager.send(f"STATUS={self._status_line(session.bridge, session.watch, seconds)}", "WATCHDOG=1")

    def stopping(self) -> None:
        """Report that the bridge ends; the recording is closed now."""
        self._manager.send("STOPPING=1")
