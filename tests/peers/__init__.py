"""Independent OpenIGTLink peers for the tests: nothing in here uses igtl_gateway's own codec.

``reference`` drives a C++ program on Debian's libopenigtlink (1.11), ``pyigtl_peer`` the Python package
pyigtl.  Both have the same small interface: ``client(host, port)`` or ``server()``, ``send(type, device,
content, sec, frac)``, ``receive(type, device, timeout_s)``, ``messages``, ``close()``; both are context
managers.  A message is a dict with the keys of the corpus' JSON files (``type``, ``device_name``,
``timestamp``, ``content`` …).
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

Message = dict[str, Any]


class PeerError(Exception):
    """The peer refused a command or ended before what was waited for came."""


def only(value: Any, wanted: Any) -> Any:
    """``value`` with those keys only that ``wanted`` has too, at every depth."""
    if isinstance(value, dict) and isinstance(wanted, dict):
        return {key: only(item, wanted[key]) for key, item in value.items() if key in wanted}
    if isinstance(value, list) and isinstance(wanted, list) and len(value) == len(wanted):
        return [only(*pair) for pair in zip(value, wanted, strict=True)]
    return value


class Inbox:
    """Messages in order of arrival, for one thread that puts and others that wait."""

    def __init__(self) -> None:
        self.messages: list[Message] = []
        self._pending: list[Message] = []
        self._end: str | None = None
        self._changed = threading.Condition()

    def put(self, message: Message) -> None:
        with self._changed:
            self.messages.append(message)
            self._pending.append(message)
            self._changed.notify_all()

    def end(self, reason: str) -> None:
        """Mark the end of the messages, with the reason: waiting receivers raise PeerError at once."""
        with self._changed:
            self._end = self._end or reason
            self._changed.notify_all()

    def receive(self, type_name: str | None, device: str | None, timeout_s: float) -> Message:
        """Take the first message that matches; others stay for later calls.

        Raises:
            TimeoutError: none within ``timeout_s`` seconds; the text lists what did arrive.
            PeerError: none, and none can come any more.
        """

        def matches(message: Message) -> bool:
            return type_name in (None, message["type"]) and device in (None, message["device_name"])

        def found() -> Message | None:
            return next((message for message in self._pending if matches(message)), None)

        with self._changed:
            self._changed.wait_for(lambda: found() is not None or self._end is not None, timeout_s)
            message = found()
            if message is not None:
                self._pending.remove(message)
                return message
            waited_for = f"{type_name or 'any type'} from {device or 'any device'}"
            arrived = [f"{other['type']} {other['device_name']}" for other in self.messages] or "nothing"
            if self._end is not None:
                raise PeerError(f"{waited_for} cannot come any more: {self._end}; arrived: {arrived}")
            raise TimeoutError(f"no {waited_for} within {timeout_s} s; arrived: {arrived}")

    def wait_until(self, predicate: Callable[[], bool], what: str, timeout_s: float) -> None:
        """Wait for something else that is announced by ``changed``; raises as ``receive`` does."""
        with self._changed:
            if not self._changed.wait_for(lambda: predicate() or self._end is not None, timeout_s):
                raise TimeoutError(f"not {what} within {timeout_s} s")
            if not predicate():
                raise PeerError(f"not {what}: {self._end}")

    def changed(self, action: Callable[[], None]) -> None:
        """Do something that ``wait_until`` may be waiting for."""
        with self._changed:
            action()
            self._changed.notify_all()
