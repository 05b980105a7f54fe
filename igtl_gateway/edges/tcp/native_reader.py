"""The threads in which `igtl_gateway.native.passage` reads links, and in which large messages pass.

A picture takes milliseconds: it is handled in a thread of its own, while the passage reads and passes what follows it.
There the links take turns, each with one message (``turns``), and a message waits until it is admitted.
"""

from __future__ import annotations

import threading
from collections.abc import Callable

from igtl_gateway.base.clock import thread_ns
from igtl_gateway.edges.tcp.link_parts import Admission
from igtl_gateway.edges.tcp.outbox import Part
from igtl_gateway.edges.tcp.turns import Turn, Turns
from igtl_gateway.native.passage import Link, Passage

#: Links whose turns are remembered; more are only as many as connect and leave.
_MOST_TURNS = 128

#: Until the next look whether a message is admitted; the longest wait for all that were read when the edge stops (s).
_LOOK_S, _SETTLE_S = 0.002, 5.0


class NativeReader:
    """Reads all links that are the passage's.

    Args:
        attend: called with the number of a link that needs Python.
        on_large: called with the number of a link and a large message, in the second thread.
        on_error: called with an exception of ``on_large``.
        admission: when large messages pass.
    """

    def __init__(
        self,
        passage: Passage,
        attend: Callable[[int], None],
        on_large: Callable[[int, Part], None],
        on_error: Callable[[Exception], None],
        admission: Admission,
    ) -> None:
        self._passage = passage
        self._attend = attend
        self._on_large = on_large
        self._on_error = on_error
        self._admission = admission
        self._awaited: Link | None = None  # its large messages pass at once, before those of others
        self._is_stopping = False
        self._handled = threading.Condition()  # notified of a large message that is handled
        self._turns = Turns()  # of the second thread alone, as what follows
        self._turn_of: dict[int, Turn] = {}
        self._threads = (
            threading.Thread(target=self._read, name="igtl-passage", daemon=True),
            threading.Thread(target=self._handle_large, name="igtl-large", daemon=True),
        )

    def start(self) -> None:
        for thread in self._threads:
            thread.start()

    def settle(self) -> None:
        """Wait a limited time until what was read has been admitted; for any thread but these and the I/O thread."""
        with self._handled:
            self._handled.wait_for(lambda: not self._passage.large_bytes, _SETTLE_S)

    def stop(self) -> None:
        """End the threads; for any thread but these."""
        with self._handled:
            self._is_stopping = True
            self._handled.notify_all()
        self._passage.wake()
        for thread in self._threads:
            if thread.ident is not None:
                thread.join()
        self._passage.fill()

    def wait_large(self, link: Link) -> None:
        """Wait until the large messages of a link are handled: what Python handles next came after them."""
        with self._handled:
            self._awaited = link
            self._handled.notify_all()
            self._handled.wait_for(lambda: not link.large_waiting or self._is_stopping)
            self._awaited = None

    def _read(self) -> None:
        while not self._is_stopping:
            for link in self._passage.wait_links():
                if link.pauses or not (link.is_native and link.clear):
                    self._attend(link.number)

    def _ask(self, link: Link) -> None:
        """Have a turn of this link."""
        turn = self._turn_of.get(link.number)
        if turn is None:
            if len(self._turn_of) >= _MOST_TURNS:
                self._turn_of = {number: one for number, one in self._turn_of.items() if one.waits}
            turn = self._turn_of[link.number] = Turn(lambda _: self._handle(link), self._on_error)
        self._turns.ask(turn)

    def _handle_large(self) -> None:
        while True:
            is_stopping = self._is_stopping
            for link in self._passage.wait_large(not (self._turns or is_stopping)):
                self._ask(link)
            turn = self._turns.next()
            if turn is None:
                if is_stopping:  # all is handled before the end
                    return
                continue
            begun_ns = thread_ns()
            try:
                turn.action(0)
            except Exception as error:
                turn.rescue(error)
            self._turns.used(turn, thread_ns() - begun_ns)

    def _handle(self, link: Link) -> None:
        """Handle one large message, unless it passes natively, and have another turn if there are more."""
        size = link.large_bytes
        if not size:
            return
        if first := self._wait_until_admitted(link, size):
            self._ask(link)
            self._handle(first)
            return
        message = link.take_large()
        try:
            if message is not None and not isinstance(message, bool):  # else it has passed natively
                self._on_large(link.number, message)
        finally:
            self._admission.leave(size)
            link.large_done()
            with self._handled:
                self._handled.notify_all()
            if link.large_waiting:
                self._ask(link)
            if not link.is_native:  # what Python handles next has waited for it
                self._attend(link.number)

    def _wait_until_admitted(self, link: Link, size: int) -> Link | None:
        """Wait until a message of this size passes; return another link if that one has to be handled first."""
        while not self._admission.admit(size):
            self._passage.fill()  # what passed before: the recorder waits for it
            with self._handled:
                if self._awaited is link or self._is_stopping:
                    self._admission.enter(size)
                    return None
                if self._awaited and self._awaited.large_bytes:
                    return self._awaited
                self._handled.wait(_LOOK_S)
        return None
