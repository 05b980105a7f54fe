"""Tracking data for peers that requested it, composed of single poses."""

from __future__ import annotations

from dataclasses import replace

from igtl_gateway.convert.units import LengthUnits
from igtl_gateway.gateway.log.entry import Entry
from igtl_gateway.gateway.outcome import Item
from igtl_gateway.gateway.peers import Peers
from igtl_gateway.gateway.to_igtl.delivery import Delivery
from igtl_gateway.gateway.to_igtl.latest import Latest
from igtl_gateway.gateway.to_igtl.pose_forms import as_type
from igtl_gateway.gateway.to_igtl.sender import OutboundMessage
from igtl_gateway.gateway.to_igtl.trackdata import TRACKING, TRACKING_DEVICE, trackers, tracking_content

_POSES = frozenset(TRACKING.values())
#: Type of tracking data → the other one.
_OTHER = {"TDATA": "QTDATA", "QTDATA": "TDATA"}


class Tracking:
    """Sends composed tracking data."""

    def __init__(self, peers: Peers, latest: Latest, delivery: Delivery) -> None:
        self._peers = peers
        self._latest = latest
        self._delivery = delivery

    def follow_pose(self, entry: Entry, out: OutboundMessage, lengths: LengthUnits) -> list[Item]:
        """Return the tracking data that is due after a pose, for each peer that requested it."""
        if out.igtl_type in _OTHER:
            return self._other_form(entry, out, lengths)
        if out.igtl_type not in _POSES:
            return []
        items: list[Item] = []
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
                items += self._delivery.deliver_stream(entry, peers, replace(found, device=name), lengths)
        return items

    def _other_form(self, entry: Entry, out: OutboundMessage, lengths: LengthUnits) -> list[Item]:
        """Return a message of tracking data as the other type, for the peers that requested that and have no other."""
        other = _OTHER[out.igtl_type]
        if self._latest.has_stream_of(other):
            return []
        items: list[Item] = []
        for (igtl_type, device), peers in trackers(self._peers.all()).items():
            if igtl_type == other and (form := as_type(out, other)):
                name = device or out.device
                recent = [peer for peer in peers if peer.recent]
                items += self._delivery.deliver_stream(entry, recent, replace(form, device=name), lengths)
        return items
