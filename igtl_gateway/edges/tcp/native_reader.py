"""The thread in which the native passage reads links; see `igtl_gateway.passage`."""

from __future__ import annotations

import threading
from collections.abc import Callable

from igtl_gateway.passage import Passage


class NativeReader:
    """Reads all links that are the passage's.

    Args:
        attend: called with the number of a link that needs Python.
    """

    def __init__(self, passage: Passage, attend: Callable[[int], None]) -> None:
        self._passage = passage
        self._attend = attend
        self._is_stopping = False
        self._thread = threading.Thread(target=self._run, name="igtl-passage", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def stop(self) -> None:
        """End the thread; for any thread but this one."""
        self._is_stopping = True
        self._passage.wake()
        if self._thread.ident is not None:
            self._thread.join()

    def _run(self) -> None:
        while not self._is_stopping:
            for link in self._passage.wait_links():
                self._attend(link.number)
