"""pcapng: every block with packets, both byte orders, interfaces and sections; damaged files; Wireshark as judge."""

from __future__ import annotations

import random
import shutil
import struct
import subprocess
import sys
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path

import pytest

from igtl_gateway.addons.exchange.pcap import Pcap
from igtl_gateway.addons.exchange.pcap_file import MAX_INTERFACES, MAX_PACKET
from igtl_gateway.addons.exchange.source import ImportedItem
from igtl_gateway.base.errors import DamagedRecording, GatewayError, Unavailable
from tests.addons.exchange.test_pcap import FRAMES, Talk, message, read, said, write
from tests.files import CAPTURES, write_anew
from tests.tables import table

SECOND = 10**9
ETHERNET, RAW, USB = 1, 101, 189


class Pcapng:
    """Writes blocks of one byte order."""

    def __init__(self, order: str = "<") -> None:
        self._order = order
        self.data = self.block(0x0A0D0D0A, self.pack("IHHq", 0x1A2B3C4D, 1, 0, -1))

    def pack(self, form: str, *values: object) -> bytes:
        return struct.pack(self._order + form, *values)

    def block(self, kind: int, body: bytes) -> bytes:
        body += bytes(-len(body) % 4)
        size = 12 + len(body)
        return self.pack("II", kind, size) + body + self.pack("I", size)

    def option(self, code: int, value: bytes) -> bytes:
        return self.pack("HH", code, len(value)) + value + bytes(-len(value) % 4)

    def interface(self, link: int = RAW, snap: int = 0, options: bytes = b"") -> Pcapng:
        end = self.option(0, b"") if options else b""
        self.data += self.block(1, self.pack("HHI", link, 0, snap) + options + end)
        return self

    def packet(self, data: bytes, ticks: int = 0, interface: int = 0, options: bytes = b"") -> Pcapng:
        head = self.pack("5I", interface, ticks >> 32, ticks & 0xFFFFFFFF, len(data), len(data))
        self.data += self.block(6, head + data + bytes(-len(data) % 4) + options)
        return self

    def obsolete_packet(self, data: bytes, ticks: int = 0, interface: int = 0) -> Pcapng:
        head = self.pack("2H4I", interface, 0xFFFF, ticks >> 32, ticks & 0xFFFFFFFF, len(data), len(data))
        self.data += self.block(2, head + data)
        return self

    def simple_packet(self, data: bytes, size: int | None = None) -> Pcapng:
        self.data += self.block(3, self.pack("I", len(data) if size is None else size) + data)
        return self

    def other(self, kind: int, body: bytes) -> Pcapng:
        self.data += self.block(kind, body)
        return self


def items_of(path: Path, data: bytes) -> tuple[list[ImportedItem], Pcap]:
    write_anew(path, data)
    return read(path)


def talk() -> list[bytes]:
    return Talk().open().say(message("a") + message("b"), 40).say(message("c"), by_server=True).close().packets


def alike(items: Sequence[ImportedItem]) -> list[tuple[int, str, bytes, tuple[int, ...]]]:
    return [(item.time_ns, item.kind.name, bytes(item.payload), item.links) for item in items]


@table("order", "<>")
@table("link", FRAMES)
def test_the_same_items_as_of_pcap(tmp_path: Path, order: str, link: int) -> None:
    expected, _ = read(write(tmp_path / "some.pcap", talk(), link=link))
    file = Pcapng(order).interface(link)
    for index, packet in enumerate(talk()):
        file.packet(FRAMES[link](packet), 1000 * 10**6 + index)
    items, source = items_of(tmp_path / "some.pcapng", file.data)
    assert alike(items) == alike(expected)
    assert len(said(items)) == 3
    assert all(row.good for row in source.rows)
    assert source.notes == []


@table("order", "<>")
@table(
    ("resolution", "ticks", "expected_ns"),
    [
        (None, 1_700_000_000_123_456, 1_700_000_000_123_456_000),
        (6, 1_700_000_000_123_456, 1_700_000_000_123_456_000),
        (9, 1_700_000_000_123_456_789, 1_700_000_000_123_456_789),
        (3, 1_700_000_000_123, 1_700_000_000_123_000_000),
        (0, 1_700_000_000, 1_700_000_000 * SECOND),
        (0x80 | 30, (1_700_000_000 << 30) + (1 << 29), 1_700_000_000 * SECOND + SECOND // 2),
        (0x80 | 127, 1 << 63, 0),
        (127, 1 << 63, 0),
    ],
)
def test_times_are_exact_in_every_resolution(
    tmp_path: Path, order: str, resolution: int | None, ticks: int, expected_ns: int
) -> None:
    file = Pcapng(order)
    file.interface(options=b"" if resolution is None else file.option(9, bytes([resolution])))
    for packet in talk():
        file.packet(packet, ticks)
    items, _ = items_of(tmp_path / "some.pcapng", file.data)
    assert {item.time_ns for item in items} == {expected_ns}


@pytest.mark.parametrize("order", "<>")
def test_an_interface_adds_its_offset(tmp_path: Path, order: str) -> None:
    file = Pcapng(order)
    file.interface(options=file.option(14, file.pack("q", -5)))
    for packet in talk():
        file.packet(packet, 7 * 10**6 + 1)
    items, _ = items_of(tmp_path / "some.pcapng", file.data)
    assert {item.time_ns for item in items} == {2 * SECOND + 1000}


def test_interfaces_and_sections_have_their_own_link_type_units_and_byte_order(tmp_path: Path) -> None:
    packets = talk()
    first = Pcapng("<")
    first.interface(USB).interface(ETHERNET, options=first.option(9, b"\x09")).interface(RAW)
    first.packet(b"\x80" * 64)
    for index, packet in enumerate(packets[:4]):
        if index % 2:
            first.packet(packet, 2 * 10**6, 2)
        else:
            first.packet(FRAMES[ETHERNET](packet), 2 * SECOND, 1)
    second = Pcapng(">").interface(RAW)
    for packet in packets[4:]:
        second.packet(packet, 3 * 10**6)
    items, source = items_of(tmp_path / "some.pcapng", first.data + second.data)
    assert said(items) == [message("a"), message("b"), message("c")]
    assert {item.time_ns for item in items} == {2 * SECOND, 3 * SECOND}
    assert source.notes == [f"1 packet of other link types ({USB}) are left out"]


def test_simple_and_obsolete_packet_blocks(tmp_path: Path) -> None:
    packets = talk()
    file = Pcapng().interface(snap=300).obsolete_packet(packets[0], 4 * 10**6)
    for packet in packets[1:]:
        file.simple_packet(packet)
    file.simple_packet(packets[1] + bytes(300 - len(packets[1])), 301)  # an ACK that was captured in part
    items, source = items_of(tmp_path / "some.pcapng", file.data)
    assert said(items) == [message("a"), message("b"), message("c")]
    assert {item.time_ns for item in items} == {4 * SECOND}  # a simple block has no time of its own
    assert source.notes == ["1 packet was captured only in part"]


def test_other_blocks_and_options_do_not_matter(tmp_path: Path) -> None:
    file = Pcapng()
    names = file.option(2, b"eth0") + file.option(3, "Netzwerkkarte Nº 1".encode()) + file.option(60_000, b"x")
    file.interface(options=names)
    file.other(
        4, file.pack("HH", 1, 8) + b"\x7f\0\0\1\xff\xfe\xfd\0" + file.pack("HH", 0, 0)
    )  # a name that is not UTF-8
    file.other(5, file.pack("III", 0, 0, 0) + b"\xff" * 9)  # statistics with damaged options
    file.other(10, b"secrets")
    file.other(0x40000000, b"of a vendor")
    comment = file.option(1, b"first") + file.option(1, b"second") + file.option(2, bytes(4)) + file.option(0, b"")
    for packet in talk():
        file.packet(packet, options=comment)
    items, source = items_of(tmp_path / "some.pcapng", file.data)
    assert len(said(items)) == 3
    assert source.notes == []


def test_a_file_that_is_cut_off_anywhere_is_damaged_or_has_fewer_blocks(tmp_path: Path) -> None:
    file = Pcapng().interface()
    starts = {28, 48}
    for packet in talk()[:4]:
        file.packet(packet)
        starts.add(len(file.data))
    for size in range(4, len(file.data)):
        if size in starts:
            items_of(tmp_path / "some.pcapng", file.data[:size])
        else:
            with pytest.raises(DamagedRecording, match=r"some.pcapng: block \d: "):
                items_of(tmp_path / "some.pcapng", file.data[:size])


@pytest.mark.parametrize(
    ("block", "reason"),
    [
        (struct.pack("<II", 6, 0), "block 3: found a length of -12 bytes"),
        (struct.pack("<II", 6, 13), "Mismatching block lengths"),
        (struct.pack("<II", 6, 0xFFFFFFFC), f"found a length of 4294967280 bytes, expected at most {MAX_PACKET}"),
        (Pcapng().block(6, struct.pack("<5I", 7, 0, 0, 4, 4) + b"abcd"), "found interface 7, expected one of 1"),
        (Pcapng().block(6, struct.pack("<5I", 0, 0, 0, 999, 999) + b"abcd"), "TruncatedFile"),
        (Pcapng().block(6, struct.pack("<5I", 0, 1 << 31, 0, 4, 4) + b"abcd"), "found a time of 9223372036854 s"),
        (Pcapng().block(6, bytes(20))[:-4] + bytes(4), "Mismatching block lengths"),
    ],
)
def test_a_damaged_block_is_named(tmp_path: Path, block: bytes, reason: str) -> None:
    with pytest.raises(DamagedRecording) as caught:
        items_of(tmp_path / "some.pcapng", Pcapng().interface().data + block + bytes(40))
    assert reason in str(caught.value)
    assert "block 3" in str(caught.value)


@table("code", [9, 14])
@table("size", [0, 2, 3, 7, 9])
def test_an_option_of_an_interface_with_another_length_is_named(tmp_path: Path, code: int, size: int) -> None:
    file = Pcapng()
    file.interface(options=file.option(code, b"\6" * size))
    file.packet(talk()[0], 1)
    with pytest.raises(DamagedRecording, match="block 2: "):
        items_of(tmp_path / "some.pcapng", file.data)


@table("code", [9, 14])
def test_a_needed_option_that_is_repeated_is_named(tmp_path: Path, code: int) -> None:
    file = Pcapng()
    file.interface(options=file.option(code, b"\6" * (1 if code == 9 else 8)) * 2)
    with pytest.raises(DamagedRecording, match="block 2: found an if_tsresol or if_tsoffset twice, expected it once"):
        items_of(tmp_path / "some.pcapng", file.data)


@table("order", "<>")
def test_options_that_are_not_needed_may_be_repeated_or_be_no_text(tmp_path: Path, order: str) -> None:
    expected, _ = items_of(tmp_path / "some.pcapng", _whole(order, b"", b""))
    file = Pcapng(order)
    of_interface = (file.option(2, b"eth0") + file.option(8, bytes(8)) + file.option(3, b"\xff")) * 2
    of_packet = (file.option(1, b"\xff") + file.option(2, bytes(4))) * 2
    found, _ = items_of(tmp_path / "some.pcapng", _whole(order, of_interface, of_packet))
    assert found and alike(found) == alike(expected)


def _whole(order: str, of_interface: bytes, of_packet: bytes) -> bytes:
    file = Pcapng(order)
    file.interface(options=of_interface + file.option(9, b"\6"))
    for data in talk():
        file.packet(data, 10**15, options=of_packet)
    return file.data


def test_a_simple_packet_without_an_interface_is_damaged(tmp_path: Path) -> None:
    with pytest.raises(DamagedRecording, match="block 2"):
        items_of(tmp_path / "some.pcapng", Pcapng().simple_packet(b"abcd").data)


def test_interfaces_are_bounded(tmp_path: Path) -> None:
    file = Pcapng()
    interface = Pcapng().interface().data[len(file.data) :]
    items_of(tmp_path / "some.pcapng", file.data + interface * MAX_INTERFACES)
    with pytest.raises(DamagedRecording, match=f"expected at most {MAX_INTERFACES}"):
        items_of(tmp_path / "some.pcapng", file.data + interface * (MAX_INTERFACES + 1))


def test_without_the_extra_it_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pcapng", None)
    with pytest.raises(Unavailable, match=r'pip install "igtl-gateway\[pcap\]", or convert .* `editcap -F pcap`'):
        items_of(tmp_path / "some.pcapng", Pcapng().interface().data)


# -- Wireshark's own programs as judges ----------------------------------------------------------------------------


def wireshark(program: str, *arguments: str | Path) -> None:
    if not shutil.which(program):
        pytest.skip(f"{program} is not installed (Debian: wireshark-common)")
    subprocess.run([program, *map(str, arguments)], check=True, capture_output=True, timeout=60)


@table("nanoseconds", [False, True])
@table("link", FRAMES)
def test_editcap_converts_to_a_file_with_the_same_items(tmp_path: Path, link: int, nanoseconds: bool) -> None:
    path = write(tmp_path / "some.pcap", talk(), link=link, nanoseconds=nanoseconds)
    wireshark("editcap", "-F", "pcapng", path, tmp_path / "some.pcapng")
    expected, items = read(path)[0], read(tmp_path / "some.pcapng")[0]
    assert alike(items) == alike(expected)
    assert len(said(items)) == 3


def test_mergecap_joins_files_of_two_link_types(tmp_path: Path) -> None:
    one = write(tmp_path / "one.pcap", talk(), link=ETHERNET)
    other = Talk(("10.0.0.7", 999)).open().say(message("d")).close().packets
    two = write(tmp_path / "two.pcap", other, link=276, nanoseconds=True)
    wireshark("mergecap", "-w", tmp_path / "both.pcapng", one, two)
    items, source = read(tmp_path / "both.pcapng")
    assert sorted(said(items)) == sorted(map(message, "abcd"))
    assert all(row.good for row in source.rows)


def test_editcap_converts_the_real_capture(tmp_path: Path) -> None:
    path = CAPTURES / "reference_mixed.pcap"
    wireshark("editcap", "-F", "pcapng", path, tmp_path / "some.pcapng")
    assert alike(read(tmp_path / "some.pcapng")[0]) == alike(read(path)[0])


def test_random_changes_are_read_or_rejected(tmp_path: Path) -> None:
    chance = random.Random(5)
    file = Pcapng()
    file.interface(options=file.option(9, b"\x09") + file.option(14, bytes(8)))
    for packet in talk():
        file.packet(packet, options=file.option(2, bytes(4)) + file.option(0, b""))
    path = tmp_path / "some.pcapng"
    for _ in range(300):
        data = bytearray(file.data)
        for _ in range(chance.randint(1, 4)):
            data[chance.randrange(4, len(data))] = chance.choice((0, 1, 0x7F, 0x80, 0xFF, chance.randrange(256)))
        path.write_bytes(data)
        try:
            with closing(Pcap(path)) as source:
                list(source.items())
        except GatewayError:
            continue


@table("bits", [0x0400_0000, 0x2400_0000, 0x0800_0000, 0x0001_0000])
def test_bits_above_the_link_type_are_of_the_check_sequence(tmp_path: Path, bits: int) -> None:
    talk = Talk().open().say(message("a")).close()
    path = write(tmp_path / "some.pcap", talk.packets)
    data = bytearray(path.read_bytes())
    data[20:24] = struct.pack("<I", struct.unpack("<I", data[20:24])[0] | bits)
    write_anew(path, bytes(data))
    items, _ = read(path)
    assert said(items) == [message("a")]
