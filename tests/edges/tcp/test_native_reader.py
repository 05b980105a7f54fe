"""The thread of large messages: those of a link that is waited for pass at once, and no others do."""

from __future__ import annotations

import threading
from types import SimpleNamespace
from typing import Any

from igtl_gateway.edges.tcp.native_reader import NativeReader


class _Link:
    """A link with large messages that were read."""

    def __init__(self, number: int, handled: list[int]) -> None:
        self.number, self._handled = number, handled
        self.large_waiting, self.large_bytes, self.is_native = 1, 100, True

    def take_large(self) -> bool:
        self._handled.append(self.number)
        return True

    def large_done(self) -> None:
        self.large_waiting = self.large_bytes = 0


class _Full:
    """An admission without room, until the test makes some."""

    def __init__(self) -> None:
        self.has_room = False
        self.entered = 0
        self.asked = threading.Event()

    def admit(self, size: int) -> bool:
        self.asked.set()
        return self.has_room

    def enter(self, size: int) -> None:
        self.entered += 1

    def leave(self, size: int) -> None:
        """Nothing to do."""


def test_a_link_that_closes_does_not_have_the_messages_of_others_pass_without_room() -> None:
    handled: list[int] = []
    closing, other = _Link(1, handled), _Link(2, handled)
    admission, links = _Full(), iter([[other, closing]])
    passage: Any = SimpleNamespace(
        wait_large=lambda waits: next(links, []), fill=lambda: None, wake=lambda: None, wait_links=list
    )
    reader = NativeReader(passage, lambda _: None, lambda *_: None, lambda _: None, admission)
    thread: Any = threading.Thread(target=reader._handle_large, daemon=True)
    thread.start()
    assert admission.asked.wait(30)
    first: Any = closing
    reader.wait_large(first)
    assert (handled, admission.entered) == ([1], 1), "what closes does not wait for room, the other one does"
    admission.has_room = True
    second: Any = other
    with reader._handled:
        assert reader._handled.wait_for(lambda: not second.large_waiting, 30)
    assert (handled, admission.entered) == ([1, 2], 1)
    reader.stop()
    thread.join()
