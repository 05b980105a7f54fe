"""Tracking data for peers that requested it, composed of single poses."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace

from igtl_gateway.gateway.log.entry import Entry
from igtl_gateway.gateway.peers import TRACKING, Peer, Peers
from igtl_gateway.gateway.to_igtl.latest import Latest
from igtl_gateway.gateway.to_igtl.pose_forms import as_type
from igtl_gateway.gateway.to_igtl.sender import OutboundMessage
from igtl_gateway.gateway.to_igtl.trackdata import TRACKING_DEVICE, trackers, tracking_content

_POSES = frozenset(TRACKING.values())
#: Type of tracking data → the other one.
_OTHER = {"TDATA": "QTDATA", "QTDATA": "TDATA"}


class Tracking:
    """Composes the tracking data that peers requested."""

    def __init__(self, peers: Peers, latest: Latest) -> None:
        self._peers = peers
        self._latest = latest

    def due_after(self, entry: Entry, out: OutboundMessage) -> Iterator[tuple[Iterable[Peer], OutboundMessage]]:
        """Yield the tracking data that is due after a pose has been sent, with the peers that requested it."""
        if out.igtl_type in _OTHER:
            yield from self._other_form(out)
        if out.igtl_type not in _POSES:
            return
        made: dict[str, OutboundMessage | None] = {}  # shared by all requested device names
        for (igtl_type, device), peers in trackers(self._peers.all()).items():
            name = device or TRACKING_DEVICE
            if not any(peer.is_due(igtl_type, name, entry.stamp_ns) for peer in peers):
                continue
            if igtl_type not in made:
                made[igtl_type] = (
                    None
                    if self._latest.has_stream_of(igtl_type)
                    else tracking_content(igtl_type, "", entry.stamp_ns, lambda *key: self._latest.of(entry, *key))
                )
            if found := made[igtl_type]:
                yield peers, replace(found, device=name)

    def _other_form(self, out: OutboundMessage) -> Iterator[tuple[Iterable[Peer], OutboundMessage]]:
        """Yield a message of tracking data as the other type, for the peers that requested that and have no other."""
        other = _OTHER[out.igtl_type]
        if self._latest.has_stream_of(other):
            return
        for (igtl_type, device), peers in trackers(self._peers.all()).items():
            if igtl_type == other and (form := as_type(out, other)):
                name = device or out.device
                yield [peer for peer in peers if peer.recent], replace(form, device=name)
