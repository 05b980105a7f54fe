"""Delivers outbound messages to peers: deny list, pace, coordinate frame, findings."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace

from igtl_gateway.base.errors import ConversionError, WireError
from igtl_gateway.base.stamp import NS_PER_MS
from igtl_gateway.convert.frames import FrameTree, in_frame
from igtl_gateway.convert.units import LengthUnits
from igtl_gateway.gateway.denials import Denials
from igtl_gateway.gateway.log.entry import Entry
from igtl_gateway.gateway.log.note import Level
from igtl_gateway.gateway.log.timing import GAP_NS
from igtl_gateway.gateway.naming import ShownNames
from igtl_gateway.gateway.outcome import Finding, Item
from igtl_gateway.gateway.peers import TRACKING, Peer
from igtl_gateway.gateway.to_igtl.sender import OutboundMessage, send


class Delivery:
    """Delivers every OpenIGTLink message of the gateway.

    Args:
        denied: types that are not sent to peers (``deny_out``).
        frames: the tf tree, for tracking data in the frame that a peer requested.
        names: the names of what is sent in place of other messages.
        by_stamp: whether that frame is the one of the stamp of the message; otherwise it is the latest.
    """

    def __init__(self, denied: Denials, frames: FrameTree, names: ShownNames | None = None, *, by_stamp: bool) -> None:
        self._denied = denied
        self._frames = frames
        self.names = names
        self._by_stamp = by_stamp

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
            sent = send(entry, out, peers, asked=asked, names=self.names)
            items += sent.outputs
            items += sent.findings
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

    def deliver_streams(
        self, entry: Entry, sends: Iterable[tuple[Iterable[Peer], OutboundMessage]], lengths: LengthUnits
    ) -> list[Item]:
        """Deliver messages of streams, each to its peers at the pace of each.

        Tracking data goes to each peer in the frame that it requested.
        """
        items: list[Item] = []
        for peers, out in sends:
            for group in self._by_frame(entry, peers, out, lengths) if out.igtl_type in TRACKING else ((peers, out),):
                if isinstance(group, Finding):
                    items.append(group)
                else:
                    members, moved = group
                    items += self.to(entry, members, (moved,), asked=False)
        return items

    def _by_frame(
        self, entry: Entry, peers: Iterable[Peer], out: OutboundMessage, lengths: LengthUnits
    ) -> Iterator[tuple[list[Peer], OutboundMessage] | Finding]:
        """Yield tracking data in each requested frame with its peers; a finding for a frame that is not known."""
        by_frame: dict[str, list[Peer]] = {}
        for peer in peers:
            request = peer.stream_request(out.igtl_type, out.device)
            frame = request.frame if request else ""
            by_frame.setdefault("" if frame == out.frame_id else frame, []).append(peer)
        for frame, members in by_frame.items():
            latest = self._frames.latest(out.frame_id, frame) if frame else None
            place = latest and latest[1]
            if place and out.ros_stamp_ns and self._by_stamp:
                place = self._frames.at(out.frame_id, frame, out.ros_stamp_ns, GAP_NS)
            if place:
                yield members, replace(out, content=in_frame(out.content, place, lengths), frame_id=frame)
            elif frame:
                text = f"{out.channel} is not sent: no transform from its frame {out.frame_id!r} to {frame!r}"
                if latest:
                    away_ms = (out.ros_stamp_ns - latest[0]) / NS_PER_MS
                    text += f" at its stamp, which is {away_ms:,.0f} ms after the last one"
                yield Finding(Level.WARN, "unknown_frame", text, entry.channel, entry.links, subject=frame)
            else:
                yield members, out
