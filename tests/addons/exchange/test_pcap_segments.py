"""Segments in captured packets: each link type, tags, extension headers, fragments, and packets that are cut."""

from __future__ import annotations

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from igtl_gateway.addons.exchange.pcap_file import Packet
from igtl_gateway.addons.exchange.pcap_segments import ACK, LINKS, SYN, Segment, Segments
from tests.tables import table

A4, B4 = bytes([10, 0, 0, 1]), bytes([10, 0, 0, 2])
A6, B6 = bytes(15) + b"\1", bytes(15) + b"\2"
DATA = b"hello"


def tcp(data: bytes = DATA, seq: int = 7, flags: int = ACK, words: int = 5) -> bytes:
    head = struct.pack(">HHIIBBHHH", 1234, 18944, seq, 9, words << 4, flags, 65535, 0, 0)
    return head + bytes((words - 5) * 4) + data


def ip4(payload: bytes, *, options: int = 0, fragment: int = 0, protocol: int = 6, total: int | None = None) -> bytes:
    size = 20 + options + len(payload) if total is None else total
    head = struct.pack(">BBHHHBBH4s4s", 0x45 + options // 4, 0, size, 1, fragment, 64, protocol, 0, A4, B4)
    return head + bytes(options) + payload


def ip6(payload: bytes, *, following: int = 6, size: int | None = None) -> bytes:
    return (
        struct.pack(">IHBB16s16s", 0x60000000, len(payload) if size is None else size, following, 64, A6, B6) + payload
    )


def ethernet(payload: bytes, ethertype: int = 0x0800, *tags: int) -> bytes:
    vlan = b"".join(struct.pack(">HH", tag, 5) for tag in tags)
    return bytes(12) + vlan + struct.pack(">H", ethertype) + payload


def read(*packets: bytes, link: int = 1, cut: bool = False) -> tuple[list[Segment], Segments]:
    segments = Segments([Packet(100 + number, link, data, cut) for number, data in enumerate(packets)])
    return list(segments), segments


EXPECTED4 = Segment(100, (A4, 1234), (B4, 18944), 7, ACK, DATA)
EXPECTED6 = Segment(100, (A6, 1234), (B6, 18944), 7, ACK, DATA)


@table(
    ("link", "before"),
    [
        (0, b"\2\0\0\0"), (1, bytes(12) + b"\x08\0"), (12, b""), (14, b""), (101, b""), (108, b"\0\0\0\2"),
        (113, bytes(14) + b"\x08\0"), (228, b""), (276, b"\x08\0" + bytes(18)),
    ],
)  # fmt: skip
def test_each_link_type(link: int, before: bytes) -> None:
    """https://www.tcpdump.org/linktypes.html"""
    assert read(before + ip4(tcp()), link=link)[0] == [EXPECTED4]


def test_these_are_all_link_types() -> None:
    assert LINKS.keys() == {0, 1, 12, 14, 101, 108, 113, 228, 229, 276}
    assert read(ip6(tcp()), link=229)[0] == read(ip6(tcp()), link=101)[0] == [EXPECTED6]


@table(
    "packet",
    [
        ethernet(ip4(tcp()), 0x0800, 0x8100),
        ethernet(ip4(tcp()), 0x0800, 0x88A8, 0x8100),
        ethernet(ip4(tcp()) + bytes(6)),  # padded to the least size of a frame
        ethernet(ip4(tcp(), options=8)),
        ethernet(ip4(tcp(words=8))),
        ethernet(ip4(tcp(), total=0)),  # segmentation by the network card
        ethernet(ip4(tcp(), fragment=0x4000)),  # "do not fragment"
    ],
)
def test_what_may_stand_around_a_segment(packet: bytes) -> None:
    assert read(packet)[0] == [EXPECTED4]


@table(
    "packet",
    [
        ethernet(ip6(tcp()), 0x86DD),
        ethernet(ip6(tcp()) + bytes(6), 0x86DD),
        ethernet(ip6(tcp(), size=0), 0x86DD),
        ethernet(ip6(b"\6\0" + bytes(6) + tcp(), following=0), 0x86DD),
        ethernet(ip6(b"\x3c\1" + bytes(14) + b"\6\0" + bytes(6) + tcp(), following=43), 0x86DD),
    ],
)
def test_extension_headers(packet: bytes) -> None:
    assert read(packet)[0] == [EXPECTED6]


def test_flags_and_numbers() -> None:
    (segment,), _ = read(ethernet(ip4(tcp(b"", 2**32 - 1, SYN | ACK))))
    assert (segment.seq, segment.flags, segment.data) == (2**32 - 1, SYN | ACK, b"")


@table(
    "packet",
    [
        ethernet(ip4(tcp(), fragment=0x2000)),  # more follow
        ethernet(ip4(tcp(), fragment=0x0001)),  # not the first
        ethernet(ip6(b"\6\0\0\1" + bytes(4) + tcp(), following=44), 0x86DD),
    ],
)
def test_fragments_are_counted_and_left_out(packet: bytes) -> None:
    found, segments = read(packet, packet)
    assert found == [] and segments.fragments == 2


@table(
    "packet",
    [
        ethernet(ip4(tcp(), protocol=17)),  # UDP
        ethernet(ip4(tcp(), protocol=17, fragment=1)),
        ethernet(ip6(tcp(), following=58), 0x86DD),
        ethernet(ip6(b"\x11\0\0\1" + bytes(4) + tcp(), following=44), 0x86DD),
        ethernet(bytes(28), 0x0806),  # ARP
        ethernet(b"\x95" + ip4(tcp())[1:], 0x1234),
        b"",
        bytes(13),
    ],
)
def test_other_packets_are_passed_over(packet: bytes) -> None:
    found, segments = read(packet)
    assert found == [] and segments.fragments == 0 and segments.last_ns == 100


@given(st.integers(0, 80), st.booleans())
def test_a_packet_that_is_cut_has_less_data_or_no_segment(size: int, version6: bool) -> None:
    packet = ethernet(ip6(tcp()), 0x86DD) if version6 else ethernet(ip4(tcp()))
    found, segments = read(packet[:size], cut=size < len(packet))
    head = len(packet) - len(DATA)
    assert [each.data for each in found] == ([DATA[: max(0, size - head)]] if size >= head - 6 else [])
    assert segments.cut == (size < len(packet))


def test_the_time_is_that_of_the_packet() -> None:
    found, segments = read(ethernet(ip4(tcp())), b"", ethernet(ip4(tcp(seq=9))), b"")
    assert [(each.time_ns, each.seq) for each in found] == [(100, 7), (102, 9)]
    assert segments.last_ns == 103


@given(st.sampled_from(sorted(LINKS)), st.binary(max_size=100))
def test_any_packet_is_a_segment_or_none(link: int, data: bytes) -> None:
    for segment in read(data, link=link)[0]:
        assert len(segment.data) <= len(data)


def test_a_chain_of_extension_headers_takes_no_quadratic_time() -> None:
    chain = b"\0\0" + bytes(6)
    with pytest.raises(StopIteration):
        next(iter(Segments([Packet(0, 229, ip6(chain * 8000, following=0), False)])))
