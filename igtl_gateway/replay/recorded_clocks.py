"""The clocks of peers in a recording: the offsets that they had, from the questions and answers in it."""

from __future__ import annotations

from collections.abc import Iterator

from igtl_gateway.gateway.log.clock_offset import ANSWERS, QUESTIONS, Offset, PeerClocks
from igtl_gateway.gateway.log.clocksteps import ClockStep
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.note import LINK_UP, Note
from igtl_gateway.record.sessionfile import layout
from igtl_gateway.record.sessionfile.columns import Stream, Unfit
from igtl_gateway.record.sessionfile.reader import SessionFile


class RecordedClocks:
    """What questions and answers show; takes entries in their order, as the gateway did.

    Attributes:
        offsets: link → the offset of its peer's clock, as of its last answer.
        exchanges: gateway time of a question, stamp of its answer, gateway time of the answer; UTC ns.
    """

    def __init__(self) -> None:
        self.offsets: dict[int, Offset] = {}
        self.exchanges: list[tuple[int, int, int]] = []
        self._clocks = PeerClocks()
        self._caused_ns = 0  # time of the last note of an edge: it has peers asked

    @classmethod
    def of(cls, file: SessionFile) -> RecordedClocks:
        """Of a recording, of which only these messages are read.  Raises as ``SessionFile.columns``."""
        found = cls()
        if any(channel.stream == ANSWERS for channel in file.channels):
            for entry in _entries(file):
                found.take(entry)
        return found

    def take(self, entry: Entry) -> None:
        """Take the next entry."""
        if entry.kind is Kind.EDGE_NOTE:
            self._caused_ns = entry.stamp_ns
        match entry.kind:
            case Kind.IGTL_OUT if entry.channel == QUESTIONS:
                for link in entry.links:
                    self._clocks.take_question(link)  # a peer is asked when it has answered: that answer was lost
                    self._clocks.asked(link, self._caused_ns or entry.stamp_ns)
            case Kind.IGTL_IN if entry.channel == ANSWERS:
                self._answered(entry, entry.links[0])
            case Kind.LINK:
                note = Note.of(entry.data())
                for link in entry.links:
                    if note.code == LINK_UP:
                        self._clocks.up(link, str(note.data.get("peer", "")))
                    else:
                        self._clocks.down(link)
            case Kind.EDGE_NOTE if ClockStep.of(entry):
                self._clocks.stepped(entry.stamp_ns)

    def _answered(self, entry: Entry, link: int) -> None:
        if asked_ns := self._clocks.take_question(link):
            self._clocks.add(link, asked_ns, entry.source_ns, entry.stamp_ns)
            if entry.source_ns > 0:
                self.exchanges.append((asked_ns, entry.source_ns, entry.stamp_ns))
            if known := self._clocks.offset(link, entry.stamp_ns):
                self.offsets[link] = known
            else:
                self.offsets.pop(link, None)


def _entries(file: SessionFile) -> Iterator[Entry]:
    try:
        for columns in file.columns(wanted=_is_wanted):
            yield from columns.entries()
    except Unfit:
        yield from file.entries()


def _is_wanted(stream: Stream) -> bool:
    return stream.kind in layout.NOTE_KINDS or stream.channel in (QUESTIONS, ANSWERS)
