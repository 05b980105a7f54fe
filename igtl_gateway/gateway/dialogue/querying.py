"""Queries of peers: GET_ is answered from the latest messages, STT_ and STP_ start and stop streams."""

from __future__ import annotations

from collections.abc import Callable

from igtl_gateway.convert.names import short_device_name
from igtl_gateway.gateway.denials import Denials
from igtl_gateway.gateway.dialogue import answers, probing
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.note import Level
from igtl_gateway.gateway.outcome import Finding, Item
from igtl_gateway.gateway.output import Output
from igtl_gateway.gateway.peers import Peer, Peers
from igtl_gateway.gateway.to_igtl.delivery import Delivery
from igtl_gateway.gateway.to_igtl.latest import Latest
from igtl_gateway.gateway.to_igtl.sender import OutboundMessage
from igtl_gateway.wire import Message
from igtl_gateway.wire.fields import visible
from igtl_gateway.wire.query import split_query

_NONE_YET = "no such message received yet"
#: Entry, peer, message, requested type, short device name.
_Answer = Callable[["Queries", Entry, Peer, Message, str, str], list[Item]]


class Queries:
    """Answers queries.

    Args:
        denied: types that are not sent to peers (``deny_out``).
        knows_frame: returns whether poses can be expressed in a coordinate frame.
    """

    def __init__(
        self, peers: Peers, denied: Denials, latest: Latest, delivery: Delivery, knows_frame: Callable[[str], bool]
    ) -> None:
        self._peers = peers
        self._denied = denied
        self._latest = latest
        self._delivery = delivery
        self._knows_frame = knows_frame

    def respond(self, entry: Entry, peer: Peer, message: Message) -> list[Item]:
        """Return the reply to a query; nothing for other messages."""
        query = split_query(message.type)
        if query is None:
            return []
        paced = peer.paced_types
        items = self._respond(entry, peer, message, *query)
        if peer.paced_types != paced:  # not with each query: all streams would be compiled again
            self._peers.changed(peer.link)
        return items

    def _respond(self, entry: Entry, peer: Peer, message: Message, prefix: str, igtl_type: str) -> list[Item]:
        if prefix in ("GET", "STT") and self._denied.type(igtl_type):
            text = f"{message.type} rejected: {igtl_type} is not sent to any peer (deny_out)"
            finding = _noted_once(entry, Level.WARN, "denied", text, visible(message.type), peer)
            return [finding, *self.deny(entry, peer, message, prefix, igtl_type, "denied")]
        answer = _ANSWERS.get(prefix)
        # escaped bytes make a name longer: the reply must fit the header
        device = short_device_name(visible(message.device_name))
        return answer(self, entry, peer, message, igtl_type, device) if answer else []

    def identify(self, entry: Entry, peer: Peer) -> list[Item]:
        """Return the reply to the probe of ``doctor``."""
        return self._delivery.to(entry, [peer], [probing.reply(entry.stamp_ns)])

    def deny(self, entry: Entry, peer: Peer, message: Message, prefix: str, igtl_type: str, why: str) -> list[Item]:
        """Reject a query that is refused: with its RTS_ if it has one, else with a STATUS."""
        if prefix == "RTS":
            return []
        device = short_device_name(visible(message.device_name))
        outs = answers.denial_reply(prefix, igtl_type, device, entry.stamp_ns, why)
        return self._delivery.to(entry, [peer], outs)

    def _get(self, entry: Entry, peer: Peer, message: Message, igtl_type: str, device: str) -> list[Item]:
        outs = self._answer(entry, igtl_type, device)
        if (
            not outs and device and peer.recent
        ):  # programs on the C++ library, such as its examples, send their own name
            every = self._answer(entry, igtl_type, "")
            outs = every if len(every) == 1 else []
        items = self._delivery.deliver_each(entry, outs, lambda out: self._delivery.to(entry, [peer], [out]))
        sent = any(isinstance(item, Output) and item.kind is Kind.IGTL_OUT for item in items)
        if outs and (sent or not peer.may_send(igtl_type)):
            return items
        setting = self._latest.forgotten(igtl_type, device)
        why = f"the last one is not kept: messages of all topics exceed {setting}" if setting else _NONE_YET
        text = f"{message.type} of {device or 'any device'} not answered: {why}"
        refusal = answers.empty_reply(igtl_type, device, entry.stamp_ns, peer)
        return [
            *items,
            *self._delivery.to(entry, [peer], [refusal]),
            _noted_once(entry, Level.INFO, "query_unanswered", text, entry.channel, peer),
        ]

    def _answer(self, entry: Entry, igtl_type: str, device: str) -> list[OutboundMessage]:
        return answers.answer(
            igtl_type,
            device,
            entry.stamp_ns,
            lambda *key: self._latest.of(entry, *key),
            moments=self._latest.moments,
        )

    def _start(self, entry: Entry, peer: Peer, message: Message, igtl_type: str, device: str) -> list[Item]:
        status, reason = answers.start_stream(message, igtl_type, peer, self._knows_frame)
        items = self._acknowledge(entry, peer, igtl_type, device, status)
        if status == answers.OK:
            text = f"{message.type} of {device or 'any device'}: stream started" + (f"; {reason}" if reason else "")
            level = Level.WARN if reason else Level.INFO
            return [*items, Finding(level, "stream_started", text, entry.channel, (peer.link,))]
        why = reason if peer.recent else "unknown frame or type, or too many streams"
        text = f"{message.type} of {device or 'any device'} rejected: {why}"
        return [*items, Finding(Level.WARN, "stream_refused", text, entry.channel, (peer.link,))]

    def _stop(self, entry: Entry, peer: Peer, message: Message, igtl_type: str, device: str) -> list[Item]:
        peer.stop_stream(igtl_type, visible(message.device_name))
        return self._acknowledge(entry, peer, igtl_type, device, answers.OK)

    def _acknowledge(self, entry: Entry, peer: Peer, igtl_type: str, device: str, status: int) -> list[Item]:
        outs = answers.acknowledgement(igtl_type, device, entry.stamp_ns, status)
        return self._delivery.to(entry, [peer], outs)


_ANSWERS: dict[str, _Answer] = {"GET": Queries._get, "STT": Queries._start, "STP": Queries._stop}


def _noted_once(entry: Entry, level: Level, code: str, text: str, subject: str, peer: Peer) -> Finding:
    return Finding(level, code, text, entry.channel, entry.links, subject=subject, by=peer.link)
