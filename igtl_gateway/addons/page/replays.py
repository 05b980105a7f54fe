"""The replay that the page steers: one at a time, in a process of its own (``replaying``)."""

from __future__ import annotations

import json
import threading
from collections import deque
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from igtl_gateway.addon import NS_PER_S, ConfigError, SystemClock, python_command
from igtl_gateway.addon.live import REPLAY_SIDES
from igtl_gateway.addon.processes import Child
from igtl_gateway.addon.settings import address
from igtl_gateway.addons.page.recordings import child_environment
from igtl_gateway.addons.page.starting import Start, directly

_COMMAND = python_command("igtl_gateway.addons.page.replaying")
_LINES = 50
_END_S = 5.0
#: Longest recording: 30 years.
MAX_S = 1e9
_TARGETS = ("igtl", "ros", "both")
#: What can be done to a replay → the least value and the bound of it; None: it has no value.
_STEERS: dict[str, tuple[float, float] | None] = dict.fromkeys(("play", "pause", "step", "stop")) | {
    "rate": (1e-3, 1e3),
    "seek": (0.0, MAX_S),
}


class Replay:
    """A replay.

    Args:
        start: starts its process.
    """

    def __init__(self, start: Start = directly) -> None:
        self._start = start
        self._lock = threading.Lock()
        self._child: Child | None = None
        self._name = self._to = ""
        self._state: dict[str, Any] = {}
        self._lines: deque[str] = deque(maxlen=_LINES)
        self._failed = False
        self._place = ""
        self._clock = SystemClock()
        self._begun_ns = 0

    def start(self, name: str, path: Path, how: Mapping[str, Any]) -> tuple[bool, str]:
        """Start a replay; return whether that was possible, and a sentence for people.

        Args:
            name, path: the recording.
            how: ``to`` (igtl, ros, both), ``side`` ("", peers, gateway, both), ``role`` (listen, connect),
                ``address``, ``rate``, ``loop``, ``from_s`` (seconds from its begin), ``paused``.
        """
        to, role, side = str(how.get("to", "igtl")), str(how.get("role", "listen")), str(how.get("side", ""))
        try:
            if to not in _TARGETS or role not in ("listen", "connect"):
                raise ConfigError(f"found {to[:20]!r} and {role[:20]!r}, expected a target and listen or connect")
            if side not in REPLAY_SIDES:
                raise ConfigError(f"side: found {side[:20]!r}, expected one of {', '.join(filter(None, REPLAY_SIDES))}")
            place = str(how.get("address") or "127.0.0.1:18944")
            address(place)
            rate, from_s = float(how.get("rate") or 1), float(how.get("from_s") or 0)
            _check("from_s", from_s, _STEERS["seek"])
            _check("rate", rate, _STEERS["rate"])
        except (ConfigError, ValueError, TypeError) as error:
            return False, f"replay: {error}"
        settings = {
            "file": str(path),
            "to": to,
            "side": side,
            "listen": [place] if to != "ros" and role == "listen" else [],
            "connect": [place] if to != "ros" and role == "connect" else [],
            "rate": rate,
            "loop": bool(how.get("loop")),
            "from_s": from_s,
            "paused": bool(how.get("paused")),
        }
        with self._lock:
            if self._child and self._child.is_running:
                return False, f"the replay of {self._name} runs; stop it first"
            self._name, self._to, self._state, self._failed = name, to, {}, False
            self._lines.clear()
            self._place = place if to != "ros" else ""
            self._begun_ns = self._clock.monotonic_ns()
            ready = threading.Event()
            threading.Thread(target=self._run, args=(settings, ready), name="igtl-page-replay", daemon=True).start()
            ready.wait(_END_S)
        return True, f"the replay of {name} begins"

    def steer(self, what: str, value: object) -> tuple[bool, str]:
        """Have the replay do something."""
        child = self._child
        if what not in _STEERS:
            return False, f"found {what[:20]!r}, expected one of {', '.join(_STEERS)}"
        try:
            _check(what, value, _STEERS[what])
        except ConfigError as error:
            return False, f"replay: {error}"
        if child is None or not child.is_running:
            return False, "no replay runs"
        child.write(json.dumps({"do": what, "value": value}) + "\n")
        return True, what

    def facts(self) -> dict[str, Any] | None:
        """Return what the page shows; None before the first replay."""
        if not self._name:
            return None
        running = self._child is not None and self._child.is_running
        state = dict(self._state)
        return {
            "name": self._name,
            "to": self._to,
            "place": self._place,
            "opening_s": 0 if state else (self._clock.monotonic_ns() - self._begun_ns) // NS_PER_S,
            "running": running,
            "failed": self._failed,
            "state": state,
            "lines": list(self._lines)[-8:],
        }

    def close(self) -> None:
        """End the replay."""
        if self._child:
            self._child.close_input()

    def _run(self, settings: Mapping[str, Any], ready: threading.Event) -> None:
        """Start the process and wait for it."""
        try:
            child = self._start(
                lambda: Child(
                    "page-replay", _COMMAND, on_line=self._take, on_error_line=self._say, env=child_environment()
                )
            )
        except OSError as error:
            self._say(f"! cannot be started: {error.strerror}")
            ready.set()
            return
        self._child = child
        child.write(json.dumps(settings) + "\n")
        ready.set()
        child.wait()
        child.kill()

    def _say(self, text: str) -> None:
        self._lines.append(text)

    def _take(self, line: str) -> None:
        try:
            found = json.loads(line)
        except ValueError:
            return
        if "state" in found:
            self._state = found["state"]
        if found.get("ended"):
            self._state = self._state | {"position_s": self._state.get("duration_s", 0.0)}
        if "line" in found:
            self._lines.append(str(found["line"]))
        self._failed = self._failed or bool(found.get("failed"))


def _check(what: str, value: object, bounds: tuple[float, float] | None) -> None:
    """Raise ConfigError for a value that is not within its bounds; NaN is within none."""
    if bounds is None:
        return
    least, most = bounds
    if isinstance(value, bool) or not isinstance(value, int | float) or not least <= value <= most:
        raise ConfigError(f"{what}: found {str(value)[:20]}, expected {least:g} to {most:g}")
