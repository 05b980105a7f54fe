"""When a large message of a peer may pass, so that the recorder's queue has room for it.

Strategy: a burst of pictures is larger than the queue, and its sender can wait: until there is room, nothing more is
read from its connection, TCP makes it wait, and nothing is lost.  The live side comes first all the same.  A recorder
that does not come on is not waited for, nor one that has not caught up after `HOLD_NS`: then large messages pass, and
those that find no room are dropped and counted, until it has caught up.

How large the outputs of a message are shows when it has passed.  So two that pass at one time, in the I/O thread and in
that of large messages, would each take the room of the other's outputs: they may do so only while little waits.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import TYPE_CHECKING

from igtl_gateway.base.clock import Clock
from igtl_gateway.base.quantities import size_text
from igtl_gateway.base.stamp import NS_PER_S
from igtl_gateway.gateway.log.note import Level, Note

if TYPE_CHECKING:
    from igtl_gateway.record.recorder import Recorder

#: Code of the note about messages that wait.
WAITS = "record_waits"
#: The longest time for which large messages wait, from the first that does until the recorder has caught up; and the
#: time after which a note reports it.
HOLD_NS, _NOTED_NS = 60 * NS_PER_S, NS_PER_S
#: It has caught up when no more than this part of the bound waits; up to there messages pass beside each other.
_CALM_PART = 4


class Admission:
    """Lets large messages pass, one after the other.

    Args:
        clock: monotonic time.
        on_note: takes the notes, in the thread that calls ``admit``.

    Attributes:
        recorder: None before its start: then everything passes.
    """

    def __init__(self, clock: Clock, on_note: Callable[[Note], None]) -> None:
        self.recorder: Recorder | None = None
        self._clock = clock
        self._on_note = on_note
        self._lock = threading.Lock()  # guards what follows
        self._passing = 0  # bytes of messages that pass now and might not be in the queue yet
        self._since: tuple[int, int] | None = None  # when one had to wait first, and what the recorder had taken
        self._is_noted = self._is_over = False  # that they wait; they wait no longer

    def admit(self, size: int) -> bool:
        """Whether a message of this size passes now; if so, ``leave`` must follow."""
        with self._lock:
            passes, note = self._passes(size), self._note()
            if passes:
                self._passing += size
        if note:
            self._on_note(note)
        if self.recorder and not passes:
            self.recorder.wake()
        return passes

    def enter(self, size: int) -> None:
        """Let a message pass in any case; ``leave`` must follow."""
        with self._lock:
            self._passing += size

    def leave(self, size: int) -> None:
        """A message has passed."""
        with self._lock:
            self._passing -= size

    def _passes(self, size: int) -> bool:
        recorder = self.recorder
        if recorder is None or not recorder.is_taking:
            return True
        waiting, most = recorder.queue.waiting[1] + self._passing, recorder.queue.max_large_bytes
        if waiting <= most // _CALM_PART:
            self._since, self._is_noted, self._is_over = None, False, False
        room = most // _CALM_PART if self._passing else most
        if not waiting or waiting + size <= room or self._is_over:
            return True
        now_ns = self._clock.monotonic_ns()
        self._since = self._since or (now_ns, recorder.queue.done_bytes)
        self._is_over = now_ns - self._since[0] >= HOLD_NS
        return self._is_over

    def _note(self) -> Note | None:
        """The note that is due, once until the recorder has caught up."""
        if self._is_noted or not (self._since and self.recorder):
            return None
        since_ns, taken = self._since
        waited_ns = self._clock.monotonic_ns() - since_ns
        if waited_ns < _NOTED_NS:
            return None
        self._is_noted = True
        rate = (self.recorder.queue.done_bytes - taken) / waited_ns * NS_PER_S
        text = (
            f"large messages come faster than they are recorded ({size_text(rate)}/s): they wait in the "
            f"connections of their peers, for {HOLD_NS // NS_PER_S} s at most"
        )
        return Note(Level.WARN, WAITS, text, data={"mb_per_s": round(rate / 1e6, 1)})
