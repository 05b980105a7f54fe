"""The outcome of an input, and the bookkeeper that settles it.

A stage of the gateway changes no count and writes no note.  It returns an :class:`Outcome`: outputs and findings in the
order of the log, and the fate of the message.  :class:`Bookkeeper` settles each outcome once: it counts the outputs,
turns findings into notes, and adds the fate to the loss ledger.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

from igtl_gateway.base.once import Once
from igtl_gateway.base.values import value
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.fates import KEPT
from igtl_gateway.gateway.log.ledger import Ledger
from igtl_gateway.gateway.log.note import Level
from igtl_gateway.gateway.output import Output, note_output
from igtl_gateway.gateway.peers import Peers

#: Maximum number of once-only findings of each link: a peer that invents names must fill neither memory nor log, and
#: must not suppress the findings of others.
MAX_NOTED = 2_000

_MESSAGES = frozenset({Kind.IGTL_IN, Kind.ROS_IN})
_IGTL_OUT = Kind.IGTL_OUT.value
_ROS_OUT = Kind.ROS_OUT.value


@value(frozen=True, slots=True)
class Finding:
    """A fact about a message that a note reports.

    Attributes:
        level, code, text, stream, links: fields of the note.
        subject: None: every finding is reported; else only the first with this code and subject from ``by``.
        by: link to which the subject belongs; 0: the whole session.
        loss: stream and reason of an output that is not sent; always counted.
        data: further facts for the note.
    """

    level: Level
    code: str
    text: str
    stream: str = ""
    links: tuple[int, ...] = ()
    subject: str | None = None
    by: int = 0
    loss: tuple[str, str] | None = None
    data: Mapping[str, Any] | None = None


Item = Output | Finding


@value(frozen=True, slots=True)
class Tally:
    """A count for the ledger that does not belong to the message; ``dropped``: ``fate`` is the reason of a loss."""

    section: str
    row: str
    fate: str
    number: int = 1
    dropped: bool = False


@dataclass(slots=True)
class Outcome:
    """The result of one input.

    Attributes:
        items: outputs and findings, in the order of the log.
        fate: fate of the message for the ledger: the reason if it was dropped; "" for inputs without a message.
        decoded: whether an OpenIGTLink message could be decoded.
        tallies: further counts.
        origin: what the fast path needs to compile the stream; None if it cannot be compiled.
    """

    items: list[Item] = field(default_factory=list)
    fate: str = ""
    decoded: bool = False
    tallies: list[Tally] = field(default_factory=list)
    origin: Any = None

    @property
    def is_good(self) -> bool:
        """Whether the message was not dropped."""
        return self.fate in KEPT


class Bookkeeper:
    """The loss ledger and the notes of a session."""

    def __init__(self, peers: Peers) -> None:
        self.ledger = Ledger()
        self._peers = peers
        self._noted: dict[int, Once] = {}  # link → codes and subjects

    def settle(self, entry: Entry, outcome: Outcome) -> list[Output]:
        """Count everything; return the outputs and the notes in their order."""
        ledger, channel = self.ledger, entry.channel
        if entry.kind in _MESSAGES:
            direction = entry.kind.value
            ledger.count(direction, channel, "received")
            if outcome.decoded:
                ledger.count(direction, channel, "decoded")
            if outcome.is_good:
                ledger.count(direction, channel, outcome.fate)
            else:
                ledger.drop(direction, channel, outcome.fate)
        for tally in outcome.tallies:
            (ledger.drop if tally.dropped else ledger.count)(tally.section, tally.row, tally.fate, tally.number)
        outputs = self._settled(outcome.items)
        if entry.kind is Kind.LINK:
            for link in entry.links:
                if self._peers.get(link) is None:  # disconnected: its subjects are dropped
                    self._noted.pop(link, None)
        return outputs

    def fail(self, entry: Entry, error: Exception) -> list[Output]:
        """Count a message that an internal error lost; return the note about it."""
        if entry.kind in _MESSAGES:
            self.ledger.count(entry.kind.value, entry.channel, "received")
        self.ledger.drop(entry.kind.value, entry.channel, "internal_error")
        text = f"message dropped by a defect of the gateway: {type(error).__name__}: {error}"
        return [note_output(Level.ERROR, "internal_error", text, entry.channel, entry.links)]

    def _settled(self, items: Iterable[Item]) -> list[Output]:
        outputs: list[Output] = []
        for item in items:
            if isinstance(item, Output):
                if item.kind is Kind.IGTL_OUT:
                    self._count_sent(item)
                elif item.kind is Kind.ROS_OUT:
                    self.ledger.count(_ROS_OUT, item.channel, "published")
                outputs.append(item)
                continue
            if item.loss:
                self.ledger.drop(_IGTL_OUT, *item.loss)
            if item.subject is None or self._is_new(item.by, item.code, item.subject):
                outputs.append(note_output(item.level, item.code, item.text, item.stream, item.links, item.data))
        return outputs

    def _count_sent(self, output: Output) -> None:
        self.ledger.count(_IGTL_OUT, output.channel, "sent", len(output.links))
        for link in output.links:
            self._peers[link].sent += 1

    def _is_new(self, link: int, code: str, subject: str) -> bool:
        noted = self._noted.get(link)
        if noted is None:
            noted = self._noted[link] = Once(MAX_NOTED)
        return noted.first(code, subject)


def warning_findings(warnings: Iterable[tuple[str, str]], entry: Entry) -> list[Item]:
    """Return findings for the warnings of a conversion, reported once per stream and cause."""
    return [Finding(Level.WARN, code, text, entry.channel, entry.links, entry.channel) for code, text in warnings]


def conversion_failure(error: Exception, text: str, entry: Entry, code: str = "conversion") -> Finding:
    """Return the finding for a message, or a part of it, that cannot be converted."""
    return Finding(Level.ERROR, code, f"{text}: {error}", entry.channel, entry.links)
