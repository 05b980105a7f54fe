"""The hub: passes all inputs to the session in one order, and all entries to the sinks.

Any thread may submit an input.  One lock puts the inputs in order.  The thread that has the lock passes its input to
the session, and each entry to the sinks (recorder, edges) in the order of the log.  There is no queue and no thread
switch between the edges: the thread of a ROS callback writes to the peer's socket.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Sequence
from typing import Protocol

from igtl_gateway.base.buffers import Buffer
from igtl_gateway.base.clock import Clock
from igtl_gateway.base.errors import WireError
from igtl_gateway.base.once import Once
from igtl_gateway.base.versions import Self
from igtl_gateway.gateway import TICK, Session
from igtl_gateway.gateway.fastpath import Prepared
from igtl_gateway.gateway.log.clocksteps import LEAST_NS, ClockStep
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.note import Level, Note
from igtl_gateway.gateway.to_ros.beforehand import Results

#: What a sink leaves to be done without the lock, such as the copy of a picture.
DeferredSend = Callable[[], None]
Sink = Callable[[Entry], DeferredSend | None]

#: Longest time between two readings of the clocks that are compared: the thread might be interrupted in between.
_AT_ONCE_NS = LEAST_NS // 10

#: Kind, payload, channel, type, links and source stamp of an input.
_Input = tuple[Kind, Buffer, str, str, tuple[int, ...], int]


class InputSequence(Protocol):
    """The sequence lock as a context, and what it guards.

    Attributes:
        seq: number of the last entry.
        stamp_ns: gateway time of the last entry (UTC ns).
        last_ns: gateway time of the last input (UTC ns).
        ahead_ns: gateway time less the time of the host's clock (ns).
    """

    seq: int
    stamp_ns: int
    last_ns: int
    ahead_ns: int

    def __enter__(self) -> Self: ...

    def __exit__(self, *error: object) -> None: ...


class PythonSequence:
    """The sequence where there is no native passage."""

    def __init__(self) -> None:
        self.seq = self.stamp_ns = self.last_ns = self.ahead_ns = 0
        self._lock = threading.Lock()

    def __enter__(self) -> Self:
        self._lock.acquire()
        return self

    def __exit__(self, *error: object) -> None:
        self._lock.release()


class Hub:
    """Passes inputs to the session and entries to the sinks, under one lock.

    Sinks must not block.  The first exception of a sink is reported; the other sinks still receive the entry.

    Args:
        session: the sequencer with its gateway.
        clock: source of gateway time.
        sinks: called with every entry, in order.
        sequence: the lock and the numbers; those of the session, if it has any.

    Attributes:
        ticks: how many `tick` has completed: while it grows, inputs get the lock and are processed.
    """

    def __init__(
        self, session: Session, clock: Clock, sinks: Sequence[Sink], sequence: InputSequence | None = None
    ) -> None:
        self._session = session
        self._clock = clock
        self._utc_ns = clock.utc_ns
        self._offset_ns: int | None = None  # the host's clock less the monotonic clock
        self._sinks = tuple(sinks)
        self.sequence: InputSequence = sequence or PythonSequence()
        self.ticks = 0
        self._owner = 0
        self._noted = Once()  # sinks whose failure was reported
        # inputs that a sink submits while this thread has the lock: they are processed after the current entries
        self._waiting: deque[_Input] = deque()
        self._check_clock()

    def igtl(self, link: int, message: Buffer) -> bool:
        """Submit a frame from a link; return whether it was seen at once that it has no valid content."""
        return self._submit(Kind.IGTL_IN, message, "", "", (link,))

    def ros(self, topic: str, ros_type: str, cdr: bytes, source_ns: int) -> None:
        """Submit a message of a ROS topic."""
        self._submit(Kind.ROS_IN, cdr, topic, ros_type, (), source_ns)

    def link(self, link: int, note: Note) -> None:
        """Submit the note that a link connected or disconnected."""
        self._submit(Kind.LINK, note.pack(), "", "", (link,))

    def note(self, note: Note, link: int = 0) -> None:
        """Submit a note of an edge or the recorder."""
        self._submit(Kind.EDGE_NOTE, note.pack(), "", "", (link,) if link else ())

    def now_ns(self) -> int:
        """Return gateway time."""
        return self._utc_ns() + self.sequence.ahead_ns

    def tick(self) -> int | None:
        """Submit a tick if a deadline of the gateway has come, and a note if the host's clock was set.

        Returns the deadline (gateway time, UTC ns), None if there is none.
        """
        with self.sequence:  # the peers and commands of the gateway change only under this lock
            self._owner = threading.get_ident()
            try:
                self._check_clock()
                self._process_waiting()
            finally:
                self._owner = 0
            self._session.collect()
            due_ns = self._session.gateway.due_ns
        if due_ns is not None and due_ns <= self.now_ns():
            self.note(Note(Level.INFO, TICK, "a deadline has come"))
        self.ticks += 1
        return due_ns

    def _check_clock(self) -> None:
        """Submit a note if the host's clock was set, and adapt ``ahead_ns``; the caller has the lock.

        After a step backwards, gateway time would otherwise not advance until the host's clock reaches it again.
        """
        begun_ns = self._clock.monotonic_ns()
        utc_ns = self._utc_ns()
        ended_ns = self._clock.monotonic_ns()
        if ended_ns - begun_ns > _AT_ONCE_NS:
            return
        offset_ns = utc_ns - ended_ns
        step_ns = 0 if self._offset_ns is None else offset_ns - self._offset_ns
        if self._offset_ns is None or abs(step_ns) >= LEAST_NS:
            self._offset_ns = offset_ns
        if abs(step_ns) >= LEAST_NS:
            step = ClockStep.after(step_ns, self.sequence.ahead_ns)
            self.sequence.ahead_ns = step.ahead_ns
            self._finish(self._process(Kind.EDGE_NOTE, step.note().pack(), "", "", (), 0))

    def _submit(
        self,
        kind: Kind,
        payload: Buffer,
        channel: str,
        type_name: str,
        links: tuple[int, ...],
        source_ns: int = 0,
    ) -> bool:
        me = threading.get_ident()
        if self._owner == me:
            self._waiting.append((kind, payload, channel, type_name, links, source_ns))
            return False
        prepared = self._session.prepare(kind, payload, channel, type_name, links, source_ns)
        with self.sequence:
            self._owner = me
            try:
                deferred = self._process(kind, payload, channel, type_name, links, source_ns, prepared)
                self._process_waiting()
            finally:
                self._owner = 0
        self._finish(deferred)
        return isinstance(prepared, Results) and isinstance(prepared.decoded, WireError)

    def _process_waiting(self) -> None:
        while self._waiting:
            self._finish(self._process(*self._waiting.popleft()))

    def _process(
        self,
        kind: Kind,
        payload: Buffer,
        channel: str,
        type_name: str,
        links: tuple[int, ...],
        source_ns: int,
        prepared: Prepared | None = None,
    ) -> list[tuple[Sink, DeferredSend]]:
        """Process an input; return what its sinks have left to be done without the lock."""
        now_ns = self._utc_ns() + self.sequence.ahead_ns
        if now_ns < self.sequence.last_ns:
            self._check_clock()
            now_ns = self._utc_ns() + self.sequence.ahead_ns
        self.sequence.last_ns = now_ns
        entries = self._session.input(
            now_ns,
            kind,
            (payload,),
            channel=channel,
            type_name=type_name,
            links=links,
            source_ns=source_ns,
            prepared=prepared,
        )
        deferred: list[tuple[Sink, DeferredSend]] = []
        for sink in self._sinks:  # all entries to one sink, then the next: sending does not wait for recording
            for entry in entries:
                try:
                    if send := sink(entry):
                        deferred.append((sink, send))
                except Exception as error:  # a defect of a sink must not stop the other sinks or the session
                    self._note_sink_failure(sink, error)
        return deferred

    def _finish(self, deferred: list[tuple[Sink, DeferredSend]]) -> None:
        for sink, send in deferred:
            try:
                send()
            except Exception as error:
                self._note_sink_failure(sink, error)

    def _note_sink_failure(self, sink: Sink, error: Exception) -> None:
        """Submit a note about the first exception of a sink.  Only the first: the sink might also fail at this note."""
        if self._noted.first(sink):
            text = f"{getattr(sink, '__qualname__', sink)} failed: {type(error).__name__}: {error}"
            note = Note(Level.ERROR, "internal_error", text)
            self._waiting.append((Kind.EDGE_NOTE, note.pack(), "", "", (), 0))
