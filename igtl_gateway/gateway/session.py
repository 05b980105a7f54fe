"""The sequencer: raw inputs in, numbered entries out.  Pure: time is an argument.

Live traffic, replay, verification, slices and the viewer use the gateway through a :class:`Session` only.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import lru_cache
from typing import Protocol

from igtl_gateway.base.buffers import Buffer
from igtl_gateway.base.qos import Qos
from igtl_gateway.base.stamp import of_milliseconds, ticks_to_ns
from igtl_gateway.config.configuration import Config
from igtl_gateway.gateway.command_guard import Write
from igtl_gateway.gateway.core import Gateway
from igtl_gateway.gateway.dialogue.clocks import ClockQuestions
from igtl_gateway.gateway.fastpath import FastHandler, Prepared, PrepareMessage
from igtl_gateway.gateway.guard import Guard
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.ledger import Ledger
from igtl_gateway.gateway.log.marks import MarkNote, OpenPhases
from igtl_gateway.gateway.log.note import Note
from igtl_gateway.gateway.relay import RelayGateway
from igtl_gateway.gateway.to_ros.subscribers import HasSubscriber
from igtl_gateway.gateway.verdicts import Verdicts
from igtl_gateway.wire.fields import visible
from igtl_gateway.wire.header import HEADER_SIZE, NAMES, TICKS_AT, U64, Header


class Core(Protocol):
    """What the session and the edges need of a core; see ``Gateway`` and ``RelayGateway``."""

    config: Config
    fast: FastHandler
    prepare: PrepareMessage
    has_subscriber: HasSubscriber | None
    deadline_set: Callable[[], None] | None
    phases: OpenPhases
    on_mark: Callable[[MarkNote], None] | None
    write: Write | None

    @property
    def questions(self) -> ClockQuestions | None: ...

    @property
    def ledger(self) -> Ledger: ...

    @property
    def guard(self) -> Guard: ...

    def profile_of(self, link: int) -> str: ...

    def reads_milliseconds(self, link: int) -> bool: ...

    @property
    def due_ns(self) -> int | None: ...

    def handle(self, entry: Entry) -> list[Entry]: ...

    def take_unwritten(self) -> Note | None: ...

    def collect(self) -> None: ...
    def receivers(self) -> dict[str, int]: ...

    def subscription(self, topic: str, ros_type: str) -> Qos | None: ...

    def lacks_conversion(self, topic: str, ros_type: str) -> bool: ...

    def qos(self, topic: str) -> Qos | None: ...

    def frames(self) -> set[str]: ...

    def frames_apart(self) -> dict[str, str]: ...

    def until_ns(self, entry: Entry) -> int: ...

    def must_keep(self, entry: Entry) -> bool: ...


def make_core(config: Config, *, fast_path: bool = True) -> Core:
    """Return the core for a configuration; for ``fast_path`` see ``Gateway``."""
    return RelayGateway(config) if config.relay else Gateway(config, fast_path=fast_path)


class Numbers(Protocol):
    """Number and gateway time (UTC ns) of the last entry."""

    seq: int
    stamp_ns: int


class _Numbers:
    def __init__(self) -> None:
        self.seq = self.stamp_ns = 0


class Session:
    """A core with the numbering of the entries.

    Args:
        numbers: where the last number is kept, if the native passage numbers entries, too.

    Attributes:
        prepare: converts a large message before its turn has come, from any thread; see ``FastPath``.
        collect: takes over what the native passage has counted; deadlines depend on it.
    """

    def __init__(self, gateway: Core, numbers: Numbers | None = None) -> None:
        self.gateway = gateway
        self._fast = gateway.fast
        self.prepare = gateway.prepare
        self.collect = gateway.collect
        self._numbers = numbers or _Numbers()

    def input(
        self,
        now_ns: int,
        kind: Kind,
        payload: Sequence[Buffer],
        *,
        channel: str = "",
        type_name: str = "",
        links: tuple[int, ...] = (),
        source_ns: int = 0,
        prepared: Prepared | None = None,
    ) -> list[Entry]:
        """Return the entry of an input that arrived at ``now_ns`` (UTC), followed by the entries that it causes.

        Channel, type and stamp of OpenIGTLink input are read from its header.  ``prepared``: result of ``prepare``.
        If the edge did not write a command in it, the note about that is an input of its own, and the first entry.
        """
        numbers = self._numbers
        seq = numbers.seq + 1
        # stamps increase in the order of the log, even if the host's clock steps back
        stamp_ns = max(now_ns, numbers.stamp_ns + 1)
        entries = self._fast(seq, stamp_ns, kind, payload, channel, type_name, links, source_ns, prepared)
        if not entries:
            if kind is Kind.IGTL_IN:
                channel, type_name, source_ns = header_names(payload[0])
                if self.gateway.reads_milliseconds(links[0]):
                    source_ns = ticks_to_ns(of_milliseconds(*U64.unpack_from(payload[0], TICKS_AT)))
                if self.gateway.write:
                    stamp_ns = max(stamp_ns, numbers.stamp_ns + 2)  # room for a note before it
            entry = Entry(seq, stamp_ns, kind, channel, type_name, payload, links, source_ns)
            entries = [entry, *self.gateway.handle(entry)]
            if note := self.gateway.take_unwritten():
                before = Entry(seq, stamp_ns - 1, Kind.EDGE_NOTE, payload=(note.pack(),), links=links)
                entries = [before, *(replace(one, seq=one.seq + 1) for one in entries)]
        numbers.seq, numbers.stamp_ns = entries[-1].seq, entries[-1].stamp_ns
        return entries

    def recorded(self, entry: Entry) -> list[Entry]:
        """Return the entries that a recorded input causes, numbered after it; always by the full path.

        So a verification checks the outputs that the fast path gave during the recording.
        """
        outputs = self.gateway.handle(entry)
        last = outputs[-1] if outputs else entry
        self._numbers.seq, self._numbers.stamp_ns = last.seq, last.stamp_ns
        return outputs

    def restored(self, entry: Entry, outputs: Iterable[Entry]) -> list[Entry]:
        """Return the entries that an input of a prologue causes, as :meth:`recorded`; ``outputs``: its own there."""
        with self.judged(outputs):
            return self.recorded(entry)

    @contextmanager
    def judged(self, outputs: Iterable[Entry]) -> Iterator[None]:
        """Give the commands to robots in an input of a prologue the results that its outputs there show."""
        self.gateway.guard.verdicts = Verdicts(outputs)
        try:
            yield
        finally:
            self.gateway.guard.verdicts = None


def header_names(message: Buffer) -> tuple[str, str, int]:
    """Return stream, type and stamp (UTC ns) from the header of an OpenIGTLink message.

    Raises TruncatedMessage below 58 bytes.
    """
    if len(message) < HEADER_SIZE:
        Header.unpack(message)  # raises the error
    stream, igtl_type = _named(bytes(message[NAMES]))
    (ticks,) = U64.unpack_from(message, TICKS_AT)
    return stream, igtl_type, ticks_to_ns(ticks)


@lru_cache(maxsize=4_096)
def _named(names: bytes) -> tuple[str, str]:
    """Return stream and type from the first bytes of a header; cached, because they repeat."""
    header = Header.unpack(names.ljust(HEADER_SIZE, b"\0"))
    return f"{visible(header.type)}/{visible(header.device_name)}", visible(header.type)
