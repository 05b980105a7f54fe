"""Questions to peers for their clock: GET_STATUS to the device ``igtl_clock``, whose answer is stamped when it is made.

A gateway answers them; so does the program of ``examples/peers/clock.py``.  An edge decides whom to ask and when: its
note ``ask_clock`` is an input, so a part of a session has the same questions as the whole.  Questions and answers reach
no ROS topic and no other peer; the recording has them, as every message.

Only such an answer is known to be stamped when it is made.  PLUS does not stamp what it answers, and other messages
have the stamp of a measurement, which may be of any time before.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from igtl_gateway.base.globs import matches
from igtl_gateway.base.quantities import clock_text
from igtl_gateway.gateway.log.clock_offset import (
    ANSWERS,
    DEVICE,
    PEER_CLOCK,
    PEER_CLOCK_STEP,
    PEER_NO_CLOCK,
    ClockStep,
    NoClock,
    PeerClocks,
)
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.note import Level, Note
from igtl_gateway.gateway.outcome import Finding, Item
from igtl_gateway.gateway.output import Output
from igtl_gateway.gateway.peers import Peer, Peers
from igtl_gateway.gateway.to_igtl.delivery import Delivery
from igtl_gateway.gateway.to_igtl.sender import OutboundMessage
from igtl_gateway.wire import Message
from igtl_gateway.wire.query import EmptyQuery
from igtl_gateway.wire.text import Status

#: Code of the note that has a peer asked, and its fact: whether a note reports what the answer shows.
ASK_CLOCK, REPORT = "ask_clock", "report"


def ask_note(*, report: bool) -> Note:
    """Return the note that has the peer of its link asked; ``report``: a note reports what the answer shows."""
    return Note(Level.INFO, ASK_CLOCK, "the peer is asked for its clock", data={REPORT: True} if report else {})


class ClockQuestions:
    """Asks peers, and takes their answers.

    Attributes:
        clocks: what is known of their clocks.
    """

    def __init__(self, peers: Peers, delivery: Delivery) -> None:
        self.clocks = PeerClocks()
        self._peers = peers
        self._delivery = delivery
        self._reported: set[int] = set()  # links of which the next answer has a note
        self._asking: set[int] = set()  # links whose peers have asked
        self._not_asked: set[int] = set()  # links whose peers do not get a question: type denied, or profile

    def ask(self, entry: Entry, note: Mapping[str, Any]) -> list[Item]:
        """Return the questions to the peers of the links of ``entry``, a note with this data."""
        items: list[Item] = []
        for peer in filter(None, map(self._peers.get, entry.links)):
            question = OutboundMessage("GET_STATUS", DEVICE, EmptyQuery(), entry.stamp_ns)
            found = self._delivery.to(entry, [peer], [question])
            if any(isinstance(item, Output) and item.kind is Kind.IGTL_OUT for item in found):
                self.clocks.asked(peer.link, entry.stamp_ns)
                if note.get(REPORT):
                    self._reported.add(peer.link)
            else:
                self._not_asked.add(peer.link)
            items += found
        return items

    def take(self, entry: Entry, peer: Peer, message: Message) -> list[Item] | None:
        """Take a question or an answer; return what it causes, None for any other message."""
        if message.device_name != DEVICE:
            return None
        if message.type == "GET_STATUS":
            self._asking.add(peer.link)
            return self._delivery.to(entry, [peer], [OutboundMessage("STATUS", DEVICE, Status(1), entry.stamp_ns)])
        if message.type != "STATUS":
            return None
        shown = self.clocks.answered(peer.link, entry.source_ns, entry.stamp_ns)
        items = [_finding(peer, shown)] if shown else []
        if entry.source_ns <= 0:
            text = f"{peer.address}: its answer to the question for its clock has no stamp"
            items.append(_no_clock(peer, text, subject=DEVICE))
        if peer.link in self._reported:
            self._reported.remove(peer.link)
            items += self._known(entry, peer)
        return list[Item](items)

    def on_link_down(self, link: int) -> None:
        """Forget the peer of a link."""
        self.clocks.down(link)
        for links in (self._reported, self._asking, self._not_asked):
            links.discard(link)

    def may_ask(self, link: int, globs: Iterable[str]) -> bool:
        """Return whether to ask the peer of a link now: it gets questions, and has answered the last one.

        Args:
            link: its number.
            globs: addresses of those that are asked; a peer that asks is asked, too: it knows the question.
        """
        peer = self._peers.get(link)
        # 3D Slicer shows itself by its first message, and crashes at a question
        if peer is None or peer.held_until_ns or link in self._not_asked or self.clocks.waits(link):
            return False
        return link in self._asking or any(matches(glob, place) for glob in globs for place in peer.places)

    def _known(self, entry: Entry, peer: Peer) -> list[Finding]:
        """Return what is known of a clock."""
        known = self.clocks.offset(peer.link, entry.stamp_ns)
        if known is None:
            return []
        text = f"{peer.address}: {known.text}"
        return [
            Finding(Level.INFO, PEER_CLOCK, text, ANSWERS, (peer.link,), data={"peer": peer.address, **known.to_dict()})
        ]


def no_answer_note(address: str, text: str) -> Note:
    """Return the note about a peer at an address that does not answer for a time."""
    text = f"{address}: no answer for {text} to the question for its clock: expected a STATUS of the device {DEVICE}"
    return Note(Level.WARN, PEER_NO_CLOCK, text, ANSWERS, {"peer": address})


def _no_clock(peer: Peer, text: str, subject: str | None = None) -> Finding:
    return Finding(
        Level.WARN, PEER_NO_CLOCK, text, ANSWERS, (peer.link,), subject, peer.link, data={"peer": peer.address}
    )


def _finding(peer: Peer, shown: ClockStep | NoClock) -> Finding:
    if isinstance(shown, ClockStep):
        low, high = clock_text(shown.low_ns), clock_text(shown.high_ns)
        text = (
            f"{peer.address}: a clock was set, that of the peer or of this host: its offset changed by {low} to {high}"
        )
        facts = {"peer": peer.address, "low_ns": shown.low_ns, "high_ns": shown.high_ns}
        return Finding(Level.WARN, PEER_CLOCK_STEP, text, ANSWERS, (peer.link,), data=facts)
    why = "do not change" if shown.stands else "contradict each other again and again"
    text = f"{peer.address}: the stamps of its answers {why}: the offset of its clock is not known"
    return _no_clock(peer, text)
