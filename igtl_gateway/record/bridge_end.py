"""The worker's end of the pipe to the bridge: reports, questions, signals, and whether the bridge has ended."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

from igtl_gateway.base.versions import Self
from igtl_gateway.gateway.log.note import Note
from igtl_gateway.record.reports import WorkerState

#: Between two looks whether the bridge that is asked is still there.
_LOOK_S = 0.05


class WorkerPipe(Protocol):
    """One end of the pipe between bridge and worker: of file descriptors, or of handles on Windows."""

    def send(self, words: Any, /) -> None: ...
    def recv(self) -> Any: ...
    def poll(self, timeout: float | None = ..., /) -> bool: ...
    def close(self) -> None: ...
    def __enter__(self) -> Self: ...
    def __exit__(self, kind: Any, error: Any, place: Any, /) -> None: ...


class BridgeGone(Exception):
    """The bridge is no longer there to be asked."""


class BridgeEnd:
    """Speaks with the bridge.

    Args:
        pipe: to it.
        orphaned: whether the bridge has ended though the pipe is open: its forked processes have the pipe, too.

    Attributes:
        gone: whether the bridge has ended: nothing is sent any more.
    """

    def __init__(self, pipe: WorkerPipe, orphaned: Callable[[], bool]) -> None:
        self.gone = False
        self._pipe = pipe
        self._orphaned = orphaned
        self._sent_state = WorkerState()

    def wait(self, pause_s: float) -> bool:
        """Wait until the bridge signals or ends; False: the time has passed without."""
        try:
            if self._pipe.poll(pause_s):
                self._pipe.recv()
                return True
            self.gone = self.gone or self._orphaned()
        except (EOFError, OSError):
            self.gone = True
            return True
        return False

    def send(self, *words: Any) -> None:
        """Report something."""
        if self.gone:
            return
        try:
            self._pipe.send(words)
        except OSError:
            self.gone = True

    def ask(self, *words: Any) -> Any:
        """Ask something and wait for the answer.  Raises BridgeGone."""
        self.send(*words)
        try:
            while not self.gone:
                if not self._pipe.poll(_LOOK_S):
                    self.gone = self._orphaned()
                elif (answer := self._pipe.recv()) != "wake":
                    return answer
        except (EOFError, OSError):
            self.gone = True
        raise BridgeGone

    def send_state(self, state: WorkerState) -> None:
        """Report the state if it is another one than before."""
        if state != self._sent_state:
            self._sent_state = state
            self.send("state", state)

    def send_note(self, note: Note, state: WorkerState) -> None:
        """Report a note; who gets it knows the state that it belongs to."""
        self.send_state(state)
        self.send("note", note)
