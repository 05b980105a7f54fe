"""Messages of peers that deviate from the protocol: what the gateway reports of them, and what their stamps mean.

Compiled streams know the protocol only: such messages take the full path.
"""

from __future__ import annotations

from dataclasses import replace

from igtl_gateway.base.stamp import of_milliseconds
from igtl_gateway.gateway.log.entry import Entry
from igtl_gateway.gateway.log.note import Level
from igtl_gateway.gateway.outcome import Finding
from igtl_gateway.gateway.peers import Peer
from igtl_gateway.wire import Message
from igtl_gateway.wire.deviations import READ


def deviation_finding(entry: Entry, peer: Peer | None, kind: str) -> Finding:
    """Return the finding about a message that is read although it deviates; reported once for each link and kind."""
    text = f"{(peer and peer.address) or 'the peer'}: {entry.channel} has {READ[kind]}"
    return Finding(Level.WARN, "deviation_read", text, entry.channel, entry.links, subject=kind, by=entry.links[0])


def as_meant(message: Message, peer: Peer | None) -> Message:
    """Return a message with the stamp that its sender means, by the profile of the peer."""
    if peer is None or not peer.profile.milliseconds:
        return message
    return replace(message, ticks=of_milliseconds(message.ticks))
