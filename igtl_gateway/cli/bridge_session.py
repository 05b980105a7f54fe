"""One session of ``igtl-gateway bridge``: the bridge with what the verb has beside it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

from igtl_gateway.app.bridge import Bridge
from igtl_gateway.app.bridge_options import BridgeOptions
from igtl_gateway.app.entry_watch import EntryWatch
from igtl_gateway.app.note_rate import Event, NoteRate
from igtl_gateway.app.status import BridgeStatus
from igtl_gateway.base.clock import Clock
from igtl_gateway.config.configuration import Config
from igtl_gateway.edges.ros.host import NodeHost
from igtl_gateway.gateway.log.entry import Entry

if TYPE_CHECKING:
    from igtl_gateway.app.metrics import MetricsServer


class LiveWindow(Protocol):
    """The window of ``--view``, of the add-on ``view``."""

    def __call__(self, entry: Entry) -> None:
        """Show an entry; never blocks."""
        ...

    def close(self) -> str:
        """Show what is left and return why showing has stopped; "" if it has not."""
        ...


class Page(Protocol):
    """The page of ``--page``, of the add-on ``page``."""

    @property
    def pictures(self) -> Callable[[Entry], Callable[[], None] | None]:
        """A sink for entries."""
        ...

    def update(self, session: BridgeSession | None, events: Sequence[Event] = ()) -> None:
        """Show the session that runs now, and its notes."""
        ...

    def close(self) -> None:
        """End the page."""
        ...


class BridgeSession:
    """A bridge, the counts of its entries, and the server of ``--metrics``.

    Args:
        config, options: of the bridge.
        clock: source of gateway time.
        window: of ``--view``; None: there is none.
        page: of ``--page``; None: there is none.
        metrics_at: address of ``--metrics``; None: there is none.
        host: where the ROS node is; None: there is none, or it is of this bridge only.

    Attributes:
        bridge, watch: the bridge, and what its entries are counted with.
        metrics: the server; None before the start, and without ``--metrics``.
    """

    def __init__(
        self,
        config: Config,
        options: BridgeOptions,
        clock: Clock,
        *,
        window: LiveWindow | None = None,
        page: Page | None = None,
        metrics_at: tuple[str, int] | None = None,
        host: NodeHost | None = None,
    ) -> None:
        self.watch = EntryWatch(NoteRate())
        self._pictures = page.pictures if page else None
        on_entry = self._on_entry if page else self.watch
        self.bridge = Bridge(config, options, clock, on_entry, window, self.watch.add, host)
        self.metrics: MetricsServer | None = None
        self._metrics_at = metrics_at
        self._status = BridgeStatus(self.bridge, self.watch, clock)

    def start(self, *, active: bool = True) -> None:
        """Start the server of ``--metrics`` and the bridge; see ``Bridge.start``.  After an error all is closed."""
        try:
            if self._metrics_at:  # before the recording: a port in use must not cost an existing recording
                from igtl_gateway.app.metrics import MetricsServer

                self._status.sample()
                self.metrics = MetricsServer(
                    *self._metrics_at, self._status, self.bridge.mark, self.bridge.options.allow
                )
            self.bridge.start(active=active)
        except Exception:
            self._close_metrics()
            raise
        self.sample()

    def change(self, changes: Mapping[str, object]) -> None:
        """Change settings; see ``Bridge.change``."""
        self.bridge.change(changes)

    def sample(self) -> None:
        """Take the sample that the server of ``--metrics`` returns."""
        if self.metrics:
            self._status.sample()

    def stop(self) -> None:
        """Close all; a second call has no effect."""
        self._close_metrics()
        self.bridge.stop()

    def _on_entry(self, entry: Entry) -> Callable[[], None] | None:
        """Count an entry; return what is left to be done without the lock."""
        self.watch(entry)
        return self._pictures(entry) if self._pictures else None

    def _close_metrics(self) -> None:
        if self.metrics:
            self.metrics.close()


class PlainRunner:
    """Runs one session without ROS, as ``ManagedBridge`` runs sessions on a node."""

    def __init__(self, session: BridgeSession) -> None:
        self.bridge: BridgeSession | None = session

    def start(self) -> None:
        """Start the session; see ``BridgeSession.start``."""
        if self.bridge:
            self.bridge.start()

    def stop(self) -> None:
        """Close the session."""
        if self.bridge:
            self.bridge.stop()


def options_of_session(options: BridgeOptions, number: int) -> BridgeOptions:
    """Return the options of a session, from 1: each has a recording of its own (``out.mcap``, ``out-2.mcap`` …)."""
    if options.record is None or number == 1:
        return options
    return replace(options, record=_numbered(options.record, number))


def _numbered(path: Path, number: int) -> Path:
    return path.with_name(f"{path.stem}-{number}{path.suffix}")
