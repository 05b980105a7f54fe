"""Decodes TCP segments in captured packets: the fields of link, network and transport headers that are needed here.

dpkt was measured too: it needs five times as long, decodes every other protocol in a packet as well, and needs
quadratic time for a chain of IPv6 headers (0.4 s for a packet of 256 KiB).
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from igtl_gateway.addons.exchange.pcap_file import Packet

FIN, SYN, RST, ACK = 0x01, 0x02, 0x04, 0x10

#: Link type → bytes before the network layer, and offset of its EtherType (None: the IP version is used).
LINKS = {
    0: (4, None),  # BSD loopback
    1: (14, 12),  # Ethernet
    12: (0, None),  # raw IP, by its number in OpenBSD
    14: (0, None),
    101: (0, None),  # raw IP
    108: (4, None),  # OpenBSD loopback
    113: (16, 14),  # Linux "any"
    228: (0, None),  # raw IPv4
    229: (0, None),  # raw IPv6
    276: (20, 0),  # Linux "any", version 2
}
_ETHERTYPES = {0x0800: 4, 0x86DD: 6}
_VLAN = (0x8100, 0x88A8)
#: IPv6 extension headers that can precede TCP: hop by hop, routing, destination.
_EXTENSIONS = (0, 43, 60)
_TCP, _FRAGMENT = 6, 44

#: IP address, 4 or 16 bytes, and port.
Address = tuple[bytes, int]


@dataclass(frozen=True, slots=True)
class Segment:
    """A TCP segment; ``time_ns`` is the time of its packet, UTC."""

    time_ns: int
    source: Address
    target: Address
    seq: int
    flags: int
    data: bytes


class Segments:
    """Iterates over the TCP segments of packets.

    Attributes:
        last_ns: time of the last packet, with or without a segment.
        cut: packets that were captured in part.
        fragments: fragments of IP packets, which are skipped.
    """

    def __init__(self, packets: Iterable[Packet]) -> None:
        self._packets = packets
        self.last_ns = self.cut = self.fragments = 0

    def __iter__(self) -> Iterator[Segment]:
        for packet in self._packets:
            self.cut += packet.is_cut
            self.last_ns = packet.time_ns
            try:
                segment = self._segment(packet)
            except (struct.error, IndexError):
                continue  # shorter than its own headers: it contains no bytes of TCP
            if segment:
                yield segment

    def _segment(self, packet: Packet) -> Segment | None:
        """Return the TCP segment of a packet, or None."""
        data = packet.data
        at, type_at = LINKS[packet.link_type]
        version = data[at] >> 4
        if type_at is not None:
            (ethertype,) = struct.unpack_from(">H", data, type_at)
            while ethertype in _VLAN:
                (ethertype,) = struct.unpack_from(">H", data, at + 2)
                at += 4
            version = _ETHERTYPES.get(ethertype, 0)
        ip = data[at:]
        if version == 4:
            (total,) = struct.unpack_from(">H", ip, 2)
            fragment = struct.unpack_from(">H", ip, 6)[0] & 0x3FFF
            protocol, offset, source, target = ip[9], (ip[0] & 15) * 4, ip[12:16], ip[16:20]
            end = total or len(ip)  # 0: segmentation by the network card
        elif version == 6:
            (payload,) = struct.unpack_from(">H", ip, 4)
            protocol, offset, source, target, fragment = ip[6], 40, ip[8:24], ip[24:40], 0
            end = payload + 40 if payload else len(ip)
            while protocol in _EXTENSIONS:
                protocol, offset = ip[offset], offset + 8 + ip[offset + 1] * 8
            if protocol == _FRAGMENT:
                protocol, fragment = ip[offset], 1
        else:
            return None
        if protocol != _TCP:
            return None
        if fragment:
            self.fragments += 1
            return None
        tcp = ip[offset:end]
        source_port, target_port, seq, _, words, flags = struct.unpack_from(">HHIIBB", tcp)
        return Segment(
            packet.time_ns, (source, source_port), (target, target_port), seq, flags, tcp[(words >> 4) * 4 :]
        )
