"""Tracking data for the peers that asked for it, where only single poses go out."""

from __future__ import annotations

from dataclasses import replace

from igtl_gateway.convert.units import Lengths
from igtl_gateway.gateway.outcome import Item
from igtl_gateway.gateway.peers import Peers
from igtl_gateway.gateway.to_igtl.delivery import Delivery
from igtl_gateway.gateway.to_igtl.latest import Latest
from igtl_gateway.gateway.to_igtl.sender import Outbound
from igtl_gateway.gateway.to_igtl.trackdata import TRACKING, TRACKING_DEVICE, trackers, tracking
from igtl_gateway.session.entry import Entry

_POSES = frozenset(TRACKING.values())


class Tracking:
    """See the module."""

    def __init__(self, peers: Peers, latest: Latest, delivery: Delivery) -> None:
        self._peers = peers
        self._latest = latest
        self._delivery = delivery

    def after(self, entry: Entry, out: Outbound, lengths: Lengths) -> list[Item]:
        """What follows a pose that has gone out: tracking data, for each peer whose stream is due."""
        if out.igtl_type not in _POSES:
            return []
        items: list[Item] = []
        made: dict[str, Outbound | None] = {}  # the same for every device name that it is asked for by
        for (igtl_type, device), peers in trackers(self._peers.all()).items():
            name = device or TRACKING_DEVICE
            if not any(peer.is_due(igtl_type, name, entry.stamp_ns) for peer in peers):
                continue
            if igtl_type not in made:
                made[igtl_type] = (
                    None
                    if self._latest.goes_out(igtl_type)
                    else tracking(igtl_type, "", entry.stamp_ns, lambda *key: self._latest.of(entry, *key))
                )
            if found := made[igtl_type]:
                items += self._delivery.streamed(entry, peers, replace(found, device=name), lengths)
        return items
