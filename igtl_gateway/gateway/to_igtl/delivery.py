"""Delivers outbound messages to peers: deny list, pace, coordinate frame, findings."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace

from igtl_gateway.base.errors import ConversionError, WireError
from igtl_gateway.convert.frames import FrameTree
from igtl_gateway.convert.profiles import UNRECOGNISED
from igtl_gateway.convert.units import LengthUnits
from igtl_gateway.gateway.denials import Denials
from igtl_gateway.gateway.log.entry import Entry
from igtl_gateway.gateway.log.fates import NOT_FOR
from igtl_gateway.gateway.log.note import Level
from igtl_gateway.gateway.outcome import Finding, Item, warning_findings
from igtl_gateway.gateway.peers import Peer
from igtl_gateway.gateway.to_igtl.sender import OutboundMessage, SendResult, send
from igtl_gateway.gateway.to_igtl.trackdata import TRACKING, in_frame


class Delivery:
    """Delivers every OpenIGTLink message of the gateway.

    Args:
        denied: types that are not sent to peers (``deny_out``).
        frames: the tf tree, for tracking data in the frame that a peer requested.
    """

    def __init__(self, denied: Denials, frames: FrameTree) -> None:
        self._denied = denied
        self._frames = frames

    def to(
        self, entry: Entry, peers: Iterable[Peer], outs: Iterable[OutboundMessage], *, asked: bool = True
    ) -> list[Item]:
        """Return the outputs and findings for messages to peers.

        Args:
            entry: the input that causes them.
            peers: the addressees.
            outs: the messages.
            asked: whether they answer a query, so that the pace of streams does not apply.

        Raises:
            WireError: a content that cannot be encoded.
        """
        items: list[Item] = []
        for out in outs:
            if self._denied.type(out.igtl_type):  # checked here for all messages, whatever their origin
                text = f"{out.channel} is not sent: {out.igtl_type} is denied (deny_out)"
                loss = (out.channel, "denied")
                items.append(
                    Finding(Level.WARN, "denied", text, entry.channel, entry.links, subject=out.igtl_type, loss=loss)
                )
                continue
            sent = send(out, peers, entry.stamp_ns, asked=asked)
            items += sent.outputs
            if sent.warnings or sent.refused:
                items += _profile_findings(entry, sent)
        return items

    def deliver_each(
        self, entry: Entry, outs: Iterable[OutboundMessage], send: Callable[[OutboundMessage], list[Item]]
    ) -> list[Item]:
        """Deliver messages one by one, so that one that cannot be sent does not affect the others."""
        items: list[Item] = []
        for out in outs:
            try:
                items += send(out)
            except (ConversionError, WireError) as error:
                text = f"{out.channel} is not sent: {error}"
                loss = (out.channel, "conversion")
                items.append(Finding(Level.ERROR, "conversion", text, entry.channel, entry.links, loss=loss))
        return items

    def deliver_stream(
        self, entry: Entry, peers: Iterable[Peer], out: OutboundMessage, lengths: LengthUnits
    ) -> list[Item]:
        """Deliver a message of a stream at the pace of each peer; tracking data in the frame that each requested."""
        if out.igtl_type not in TRACKING:
            return self.to(entry, peers, (out,), asked=False)
        by_frame: dict[str, list[Peer]] = {}
        for peer in peers:
            request = peer.stream_request(out.igtl_type, out.device)
            frame = request.frame if request else ""
            by_frame.setdefault("" if frame == out.frame_id else frame, []).append(peer)
        items: list[Item] = []
        for frame, members in by_frame.items():
            moved = out
            if frame:
                place = self._frames.latest(out.frame_id, frame)
                if place is None:
                    text = f"{out.channel} is not sent: no transform from its frame {out.frame_id!r} to {frame!r}"
                    items.append(Finding(Level.WARN, "unknown_frame", text, entry.channel, entry.links, subject=frame))
                    continue
                content = in_frame(out.content, place[1], lengths)
                moved = replace(out, content=content, frame_id=frame)
            items += self.to(entry, members, (moved,), asked=False)
        return items


def _profile_findings(entry: Entry, sent: SendResult) -> list[Item]:
    """Return findings for peers that get an adapted message, or none."""
    items = warning_findings(sent.warnings, entry)
    return items + [held_back(entry, peer, igtl_type) for peer, igtl_type in sent.refused]


def held_back(entry: Entry, peer: Peer, igtl_type: str) -> Finding:
    """Return the finding about a message that a peer is not sent because of its profile."""
    address, profile = peer.address or "the peer", peer.profile.name
    unknown = peer.profile is UNRECOGNISED
    why = f"its profile {profile} cannot receive this type"
    if unknown:
        why = (
            "it is not recognised, and programs such as PLUS lose the stream at this type; a profile "
            f"(--peer {peer.address or 'ADDRESS'}=default: all types) or --no-cautious sends it"
        )
    return Finding(
        Level.WARN if unknown else Level.INFO,
        "not_for_peer",
        f"{igtl_type} is not sent to {address}: {why}",
        entry.channel,
        entry.links,
        subject=igtl_type,
        by=peer.link,
        loss=(igtl_type, f"{NOT_FOR}{profile}"),
    )
