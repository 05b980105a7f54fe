"""Tracking data for peers that requested it, composed of single poses."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace

from igtl_gateway.gateway.log.entry import Entry
from igtl_gateway.gateway.peers import TRACKING, Peer, Peers
from igtl_gateway.gateway.to_igtl.latest import Latest
from igtl_gateway.gateway.to_igtl.pose_forms import as_type
from igtl_gateway.gateway.to_igtl.sender import OutboundMessage
from igtl_gateway.gateway.to_igtl.trackdata import TRACKING_DEVICE, TrackedMoment, trackers, tracking_moments

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
        made: dict[tuple[str, str], list[TrackedMoment]] = {}  # shared by all requested device names
        for (igtl_type, device), peers in trackers(self._peers.all()).items():
            name = device or TRACKING_DEVICE
            due = [peer for peer in peers if peer.is_due(igtl_type, name, entry.stamp_ns)]
            if not due:
                continue
            if not self._latest.moments:
                due = peers
            for unit in dict.fromkeys(peer.profile.arm_unit for peer in due):
                if (igtl_type, unit) not in made:
                    made[igtl_type, unit] = self._moments(entry, igtl_type, unit)
                members = [peer for peer in due if peer.profile.arm_unit == unit]
                yield from _news(made[igtl_type, unit], out, entry, name, members)

    def _moments(self, entry: Entry, igtl_type: str, unit: str) -> list[TrackedMoment]:
        """Return the tracking data with the poses of arms in ``unit``; "": that of each arm."""
        if self._latest.has_stream_of(igtl_type):
            return []
        return tracking_moments(
            igtl_type,
            "",
            lambda *key: [_in_unit(out, unit) for out in self._latest.of(entry, *key)],
            moments=self._latest.moments,
        )

    def _other_form(self, out: OutboundMessage) -> Iterator[tuple[Iterable[Peer], OutboundMessage]]:
        """Yield a message of tracking data as the other type, for the peers that requested that and have no other."""
        other = _OTHER[out.igtl_type]
        if self._latest.has_stream_of(other):
            return
        for (igtl_type, device), peers in trackers(self._peers.all()).items():
            if igtl_type == other and (form := as_type(out, other)):
                name = device or out.device
                yield [peer for peer in peers if peer.recent], replace(form, device=name)


def _in_unit(out: OutboundMessage, unit: str) -> OutboundMessage:
    return replace(out, content=out.in_unit(unit), in_unit=None) if unit and out.in_unit else out


def _news(
    moments: Sequence[TrackedMoment], cause: OutboundMessage, entry: Entry, name: str, peers: Sequence[Peer]
) -> Iterator[tuple[Iterable[Peer], OutboundMessage]]:
    """Yield the moments with the peers that have not had all of their poses, or get that of ``cause`` again."""
    if len(moments) == 1:
        for peer in peers:
            peer.take_news(moments[0].message.igtl_type, name, moments[0].stamps, entry.stamp_ns)
        yield peers, replace(moments[0].message, device=name)
        return
    tool = cause.full_name or cause.device
    for number, moment in enumerate(moments):
        is_caused = tool in moment.stamps if not cause.is_static else number == len(moments) - 1
        news = [peer for peer in peers if peer.take_news(moment.message.igtl_type, name, moment.stamps, entry.stamp_ns)]
        if is_caused or news:
            yield peers if is_caused else news, replace(moment.message, device=name)
