"""The laboratory's programs: processes whose JSON lines are events."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Sequence
from queue import Empty, SimpleQueue
from typing import Any, ClassVar

from igtl_gateway.base.child import Child
from igtl_gateway.base.errors import GatewayError

Event = dict[str, Any]

_END_S = 20.0


class ProgramError(GatewayError):
    """A program of the laboratory did not do its part."""


def ours(*words: str) -> list[str]:
    """The command line of one of our verbs."""
    return [sys.executable, "-m", "igtl_gateway", *words]


def parse_event(line: str) -> Event | None:
    """The event of a line; None for any other line, such as a library prints."""
    try:
        event = json.loads(line)
    except ValueError:
        return None
    return event if isinstance(event, dict) else None


class EventProgram(Child):
    """A program with events, which are waited for one after the other.

    Args:
        name: for errors.
        command: program and arguments.

    Attributes:
        error: the class of the errors.
    """

    error: ClassVar[type[GatewayError]] = ProgramError

    def __init__(self, name: str, command: Sequence[str]) -> None:
        self._name = name
        self._events: SimpleQueue[Event | None] = SimpleQueue()
        super().__init__(name, command, on_line=self._on_line, on_end=lambda: self._events.put(None))

    def wait_for(self, name: str, timeout_s: float, seen: Callable[[Event], None] | None = None) -> Event:
        """The next event of this name; ``seen`` gets those before it.  Raises the error if it does not come."""
        while True:
            try:
                event = self._events.get(timeout=timeout_s)
            except Empty:
                raise self.error(f"{self._name}: found no {name!r} within {timeout_s:g} s") from None
            if event is None:
                raise self.error(f"{self._name}: {self._reason(name)}")
            if event.get("event") == name:
                return event
            if seen:
                seen(event)

    def order(self, line: str) -> None:
        """Write a line to its input."""
        self.write(line + "\n")

    def end(self) -> None:
        """End its input, and wait until it has ended."""
        self.close_input()
        self.wait_ended()

    def interrupt_and_wait(self, timeout_s: float = _END_S) -> None:
        """End it as Ctrl-C would, and wait until it has ended."""
        self.interrupt()
        self.wait_ended(timeout_s)

    def wait_ended(self, timeout_s: float = _END_S) -> None:
        """Wait until it has ended.  Raises the error if it does not, or with an exit code other than 0."""
        code = self.wait(timeout_s)
        if code is None:
            raise self.error(f"{self._name}: did not end within {timeout_s:g} s")
        if code:
            raise self.error(f"{self._name}: {self._reason('end')}")

    def check(self) -> None:
        """Raises the error, with the last line of its standard error, if it has ended."""
        if not self.is_running:
            raise self.error(f"{self._name}: {self._reason('its part')}")

    def _reason(self, awaited: str) -> str:
        return self.exit_reason() or f"ended with exit code {self.wait()} before {awaited!r}"

    def _on_line(self, line: str) -> None:
        if (event := parse_event(line)) is not None:
            self._events.put(event)
