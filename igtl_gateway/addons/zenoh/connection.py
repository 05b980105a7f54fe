"""The session: it is opened as soon as a router answers, and Zenoh itself connects it again after that.

Everything that is declared in it (publishers, tokens …) is declared when it opens, or at once if it is open.
"""

from __future__ import annotations

import json
import threading
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from typing import Any

from igtl_gateway.addon import RosError
from igtl_gateway.addon.reading import Level
from igtl_gateway.addon.ros_side import Reports
from igtl_gateway.addons.zenoh.config import endpoints_of, session_config, value_of
from igtl_gateway.addons.zenoh.library import first_line, import_zenoh

#: Longest attempt to open the session, and the pause before the next.
ATTEMPT_MS = 2000
RETRY_NS = 1_000_000_000
#: The stop waits this long for the session to close; Zenoh itself would wait 10 s for a router that does not read.
CLOSE_S = 3.0
#: Changes of links that are not noted yet.
_CHANGES = 1000

Declare = Callable[[Any], None]


class Connection:
    """A Zenoh session.

    Args:
        endpoint: of the router; "": that of the configuration.
        reports: takes the notes.
        wake: called from any thread if there is something for `note_changes`.

    Attributes:
        lock: guards what is declared.
        session: of Zenoh; None while no router has answered, and after the stop.
        zenoh: the module; None before the start.
    """

    def __init__(self, endpoint: str, reports: Reports, wake: Callable[[], None]) -> None:
        self.lock = threading.RLock()
        self.session: Any = None
        self.zenoh: Any = None
        self._endpoint = endpoint
        self._reports = reports
        self._wake = wake
        self._config: Any = None
        self._listener: Any = None  # Zenoh undeclares what has no reference
        self._places = ""
        self._declared: list[Declare] = []
        self._changes: deque[tuple[bool, str]] = deque(maxlen=_CHANGES)
        self._links: set[str] = set()
        self._noted_failure = False
        self._stopped = False

    def prepare(self) -> None:
        """Read the configuration.  Raises RosError without Zenoh, ConfigError for a wrong configuration."""
        self.zenoh = import_zenoh()
        self._config = session_config(self._endpoint)
        self._config.insert_json5("connect/timeout_ms", json.dumps(ATTEMPT_MS))
        self._places = ", ".join(endpoints_of(self._config)) or str(value_of(self._config, "mode"))

    @property
    def is_open(self) -> bool:
        return self.session is not None

    def try_open(self) -> bool:
        """Open the session, and declare what waits for it; return False (and note it once) if that failed."""
        try:
            session = self.zenoh.open(self._config)
        except Exception as error:  # zenoh's class is one for all causes
            if not self._noted_failure:
                self._noted_failure = True
                why = f"{first_line(error)}{self._hint()}"
                text = f"no Zenoh router at {self._places} yet, trying until one answers: {why}"
                self._reports.note(Level.WARN, "zenoh_no_router", text)
            return False
        with self.lock:
            if self._stopped:
                session.close()
                return False
            self.session = session
            self._listener = session.info.declare_transport_events_listener(self._on_transport, history=True)
            for declare in self._declared:
                declare(session)
        return True

    def declare(self, declare: Declare) -> None:
        """Declare something in the session: now if it is open, else when it opens.  Raises RosError after the stop."""
        with self.lock:
            if self._stopped:
                raise RosError("the node is not running")
            if self.session is not None:
                declare(self.session)
            else:
                self._declared.append(declare)

    def note_changes(self) -> None:
        """Note the links that came and went since the last call; not from Zenoh's threads, which must not wait."""
        while self._changes:
            came, who = self._changes.popleft()
            (self._links.add if came else self._links.discard)(who)
            if came:
                self._reports.note(
                    Level.INFO, "zenoh_connected", f"connected to {who} ({self._places})", data=self._data()
                )
            elif not self._links:
                text = f"the connection to {who} is lost, Zenoh connects again to {self._places}"
                self._reports.note(Level.WARN, "zenoh_lost", text, data=self._data())
            else:
                self._reports.note(Level.INFO, "zenoh_left", f"{who} has left", data=self._data())

    def stop(self) -> None:
        """Close the session; nothing is declared after this."""
        with self.lock:
            self._stopped = True
            session, self.session = self.session, None
            self._declared.clear()
        if session is not None:
            closing = threading.Thread(target=_close, args=(session,), name="igtl-zenoh-close", daemon=True)
            closing.start()
            closing.join(CLOSE_S)
            if closing.is_alive():  # a line that carries nothing: the session ends with the process
                text = f"the session of Zenoh ({self._places}) did not close within {CLOSE_S:g} s"
                self._reports.note(Level.WARN, "zenoh_not_closed", text)

    def _data(self) -> dict[str, Any]:
        return {"links": len(self._links)}

    def _hint(self) -> str:
        secure = any(place.startswith(("tls/", "quic/")) for place in self._places.split(", "))
        return " (also if it refuses our certificate, or we refuse its)" if secure else ""

    def _on_transport(self, event: Any) -> None:
        transport = event.transport
        who = f"{transport.whatami} {transport.zid}"
        self._changes.append((event.kind == self.zenoh.SampleKind.PUT, who))
        self._wake()


def _close(session: Any) -> None:
    with suppress(Exception):  # zenoh's class is one for all causes; here: its own limit of time
        session.close()
