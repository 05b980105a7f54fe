"""The threads in which the native passage reads links, and Python handles large messages; see `igtl_gateway.passage`.

A picture takes milliseconds: it is handled in a thread of its own, while the passage reads and passes what follows it.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from queue import SimpleQueue

from igtl_gateway.edges.tcp.outbox import Part
from igtl_gateway.passage import Link, Passage


class NativeReader:
    """Reads all links that are the passage's.

    Args:
        attend: called with the number of a link that needs Python.
        on_large: called with the number of a link and a large message, in the second thread.
    """

    def __init__(self, passage: Passage, attend: Callable[[int], None], on_large: Callable[[int, Part], None]) -> None:
        self._passage = passage
        self._attend = attend
        self._on_large = on_large
        self._is_stopping = False
        self._large: SimpleQueue[tuple[Link, Part] | None] = SimpleQueue()
        self._handled = threading.Condition()
        self._threads = (
            threading.Thread(target=self._read, name="igtl-passage", daemon=True),
            threading.Thread(target=self._handle_large, name="igtl-large", daemon=True),
        )

    def start(self) -> None:
        for thread in self._threads:
            thread.start()

    def stop(self) -> None:
        """End the threads; for any thread but these."""
        self._is_stopping = True
        self._passage.wake()
        self._large.put(None)
        for thread in self._threads:
            if thread.ident is not None:
                thread.join()

    def wait_large(self, link: Link) -> None:
        """Wait until the large messages of a link are handled: what Python handles next came after them."""
        with self._handled:
            self._handled.wait_for(lambda: not link.large_waiting or self._is_stopping)

    def _read(self) -> None:
        while not self._is_stopping:
            for link in self._passage.wait_links():
                while (message := link.take_large()) is not None:
                    self._large.put((link, message))
                if not (link.is_native and link.clear):
                    self._attend(link.number)

    def _handle_large(self) -> None:
        while (one := self._large.get()) is not None:
            link, message = one
            try:
                self._on_large(link.number, message)
            finally:
                link.large_done()
                with self._handled:
                    self._handled.notify_all()
