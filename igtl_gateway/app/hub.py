"""The hub: the one door through which everything reaches the gateway, and the order in which it did.

Any thread may bring an input.  One lock makes them a sequence; whoever holds it feeds the gateway and hands
each entry to the sinks (recorder, edges) in the order of the log.  There is no queue and no hop between an
edge and the other one: a ROS callback ends in the peer's socket.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Sequence

from igtl_gateway.buffers import Buffer
from igtl_gateway.clock import Clock
from igtl_gateway.gateway import TICK, Session
from igtl_gateway.once import Once
from igtl_gateway.session.clocksteps import LEAST_NS, ClockStep
from igtl_gateway.session.entry import Entry, Kind
from igtl_gateway.session.note import Level, Note

Sink = Callable[[Entry], None]

#: Two clocks are compared if both could be read within this time: a thread may be interrupted in between.
_AT_ONCE_NS = LEAST_NS // 10

#: Kind, payload, channel, type, links and source stamp of what came in.
_Input = tuple[Kind, Buffer, str, str, tuple[int, ...], int]


class Hub:
    """See the module.  Sinks must not block; one that raises is told of once, and the others get their entry.

    Args:
        session: the gateway with its numbering.
        clock: gives each input its time.
        sinks: called with every entry, in order.
    """

    def __init__(self, session: Session, clock: Clock, sinks: Sequence[Sink]) -> None:
        self._session = session
        self._clock = clock
        self._utc_ns = clock.utc_ns
        self._last_ns = 0  # when the last input came
        self._ahead_ns = 0  # of gateway time to the host's clock
        self._offset_ns: int | None = None  # of the host's clock to one that nobody sets
        self._sinks = tuple(sinks)
        self._lock = threading.Lock()
        self._owner = 0
        self._noted = Once()  # sinks that have failed
        # inputs that a sink brought while the lock was ours: they follow the entries being handed on
        self._waiting: deque[_Input] = deque()
        self._check_clock()

    def igtl(self, link: int, message: Buffer) -> None:
        """One whole OpenIGTLink message from a link."""
        self._submit(Kind.IGTL_IN, message, "", "", (link,))

    def ros(self, topic: str, ros_type: str, cdr: bytes, source_ns: int) -> None:
        """One message of a ROS topic."""
        self._submit(Kind.ROS_IN, cdr, topic, ros_type, (), source_ns)

    def link(self, link: int, note: Note) -> None:
        """A link came up or went down."""
        self._submit(Kind.LINK, note.pack(), "", "", (link,))

    def note(self, note: Note, link: int = 0) -> None:
        """A fact that an edge or the recorder reports."""
        self._submit(Kind.EDGE_NOTE, note.pack(), "", "", (link,) if link else ())

    def tick(self) -> None:
        """Tell the gateway when a time has come that it waits for, and when the host's clock was set."""
        with self._lock:  # its peers and commands come and go under this lock
            self._owner = threading.get_ident()
            try:
                self._check_clock()
                self._process_waiting()
            finally:
                self._owner = 0
            due_ns = self._session.gateway.due_ns
        if due_ns is not None and due_ns <= self._utc_ns() + self._ahead_ns:
            self.note(Note(Level.INFO, TICK, "a deadline has come"))

    def _check_clock(self) -> None:
        """Note it when the host's clock was set, and keep gateway time from standing long; the caller has the lock."""
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
            step = ClockStep.after(step_ns, self._ahead_ns)
            self._ahead_ns = step.ahead_ns
            self._process(Kind.EDGE_NOTE, step.note().pack(), "", "", (), 0)

    def _submit(
        self,
        kind: Kind,
        payload: Buffer,
        channel: str,
        type_name: str,
        links: tuple[int, ...],
        source_ns: int = 0,
    ) -> None:
        me = threading.get_ident()
        if self._owner == me:
            self._waiting.append((kind, payload, channel, type_name, links, source_ns))
            return
        with self._lock:
            self._owner = me
            try:
                self._process(kind, payload, channel, type_name, links, source_ns)
                self._process_waiting()
            finally:
                self._owner = 0

    def _process_waiting(self) -> None:
        while self._waiting:
            self._process(*self._waiting.popleft())

    def _process(
        self, kind: Kind, payload: Buffer, channel: str, type_name: str, links: tuple[int, ...], source_ns: int
    ) -> None:
        now_ns = self._utc_ns() + self._ahead_ns
        if now_ns < self._last_ns:
            self._check_clock()
            now_ns = self._utc_ns() + self._ahead_ns
        self._last_ns = now_ns
        entries = self._session.input(
            now_ns,
            kind,
            (payload,),
            channel=channel,
            type_name=type_name,
            links=links,
            source_ns=source_ns,
        )
        for sink in self._sinks:  # one after the other: what goes out does not wait for the record of what came in
            for entry in entries:
                try:
                    sink(entry)
                except Exception as error:  # a defect of ours: the other sinks, and the session, go on
                    self._note_sink_failure(sink, error)

    def _note_sink_failure(self, sink: Sink, error: Exception) -> None:
        """Note that a sink raised; once, for it will again, and be it over this note."""
        if self._noted.first(sink):
            text = f"{getattr(sink, '__qualname__', sink)} failed: {type(error).__name__}: {error}"
            note = Note(Level.ERROR, "internal_error", text)
            self._waiting.append((Kind.EDGE_NOTE, note.pack(), "", "", (), 0))
