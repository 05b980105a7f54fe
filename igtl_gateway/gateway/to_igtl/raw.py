"""Whole OpenIGTLink messages from ROS (igtl_msgs/RawMessage), sent unchanged."""

from __future__ import annotations

from igtl_gateway.base.buffers import Buffer
from igtl_gateway.base.errors import ConversionError, WireError
from igtl_gateway.base.stamp import ticks_to_ns
from igtl_gateway.convert.igtl_msgs import RawMessage
from igtl_gateway.convert.profiles import UNRECOGNISED
from igtl_gateway.convert.raw import message_of
from igtl_gateway.gateway.denials import Denials
from igtl_gateway.gateway.guard import STALE, Guard, check_stamp
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.fates import CONVERTED
from igtl_gateway.gateway.log.note import Level
from igtl_gateway.gateway.metadata import restore_metadata
from igtl_gateway.gateway.outcome import Finding, Item, Outcome, conversion_failure
from igtl_gateway.gateway.output import Output
from igtl_gateway.gateway.peers import Peer, Peers
from igtl_gateway.gateway.streams import Streams
from igtl_gateway.gateway.to_igtl.delivery import Delivery
from igtl_gateway.gateway.to_igtl.sender import OutboundMessage, held_back, waiting
from igtl_gateway.wire import Header, decode
from igtl_gateway.wire.fields import visible


class RawMessages:
    """Sends RawMessages."""

    def __init__(self, streams: Streams, peers: Peers, guard: Guard, denied: Denials, delivery: Delivery) -> None:
        self._streams = streams
        self._peers = peers
        self._guard = guard
        self._denied = denied
        self._delivery = delivery

    def takes(self, entry: Entry) -> bool:
        """Return whether an entry is a RawMessage on a bridged topic."""
        return entry.type == RawMessage.TYPE and self._streams.raw_max_age_s(entry.channel) is not None

    def take(self, entry: Entry) -> Outcome:
        """Send the contained message to the peer that it names, or to all peers that can read it."""
        topic = entry.channel
        try:
            raw = RawMessage.unpack(entry.payload[0])
            data = message_of(raw)
        except ConversionError as error:
            return Outcome([conversion_failure(error, "not sent", entry)], "conversion")
        header = Header.unpack(data)
        igtl_type = visible(header.type)
        if self._denied and self._is_denied(igtl_type, data):
            text = f"{topic} is not sent: {igtl_type} is denied (deny_out)"
            subject = f"{topic} {igtl_type}"
            return Outcome([Finding(Level.WARN, "denied", text, topic, entry.links, subject)], "denied")
        found: list[Item] = []
        max_age_s = self._streams.raw_max_age_s(topic)
        if max_age_s and (watched := self._guard.of(0, topic, max_age_s)):
            own_ns = ticks_to_ns(header.ticks)
            withheld, found = check_stamp(entry, watched, own_ns, own_ns or entry.stamp_ns, None)
            if withheld:
                return Outcome(found, STALE)
        wanted = {int(link) for link in raw.links}
        peers = [peer for peer in self._peers.all() if not wanted or peer.link in wanted]
        readers = [peer for peer in peers if peer.may_send(igtl_type) and not peer.must_wait(igtl_type)]
        links = [peer.link for peer in readers if header.version <= peer.version]
        others = [peer for peer in peers if peer not in readers]
        shown = [peer for peer in others if peer.instead_of(igtl_type)]
        channel = f"{igtl_type}/{visible(header.device_name)}"
        if shown:
            found += self._instead(entry, data, shown)
        for peer in others:
            if peer.may_send(igtl_type):
                found.append(waiting(entry, peer, channel))
            elif peer.profile is UNRECOGNISED:
                found.append(held_back(entry, peer, igtl_type, channel))
        if links:
            sent = Output(Kind.IGTL_OUT, channel, igtl_type, (data,), tuple(links), ticks_to_ns(header.ticks))
            found.insert(0, sent)
        elif not any(isinstance(item, Output) for item in found):
            return Outcome(found, "not_for_peer" if peers else "no_peer")
        return Outcome(found, CONVERTED)

    def _instead(self, entry: Entry, data: Buffer, peers: list[Peer]) -> list[Item]:
        """Send peers what their table has in place of a message."""
        try:
            message = decode(data, check_crc=False)
            metadata = restore_metadata(message)
            out = OutboundMessage(
                visible(message.type),
                message.device_name,
                message.content,
                ticks_to_ns(message.ticks) or entry.stamp_ns,
                metadata.device_name,
                metadata.stamp_ns,
                metadata.frame_id,
                metadata.child_frame_id,
                metadata.items,
            )
            return self._delivery.to(entry, peers, [out])
        except WireError as error:
            return [conversion_failure(error, "not shown to peers that do not read it", entry)]

    def _is_denied(self, igtl_type: str, data: Buffer) -> bool:
        """Return whether a valid message is denied, or a BIND because of a child."""
        if igtl_type != "BIND":
            return self._denied.type(igtl_type)
        return bool(self._denied.message(decode(data, check_crc=False)))
