"""Captured packets: put together here header by header, in every order that a network makes of them."""

from __future__ import annotations

import random
import struct
import tracemalloc
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass, field
from ipaddress import ip_address
from pathlib import Path

import pytest

from igtl_gateway.addons.exchange.pcap import MAX_OPEN, MAX_ROWS, Pcap
from igtl_gateway.addons.exchange.source import ImportedItem
from igtl_gateway.base.buffers import join
from igtl_gateway.base.errors import DamagedRecording, UnsupportedRecording
from igtl_gateway.gateway.log.entry import Kind
from igtl_gateway.gateway.log.note import Note
from igtl_gateway.wire import Message, encode
from igtl_gateway.wire.text import String
from tests.files import CAPTURES, write_anew
from tests.tables import table
from tests.timing import quick

FIN, SYN, RST, ACK = 1, 2, 4, 16
CLIENT, SERVER = ("10.0.0.1", 50_000), ("10.0.0.2", 18_944)
CLIENT_6, SERVER_6 = ("fd00::1", 50_000), ("fd00::2", 18_944)

End = tuple[str, int]


def message(text: str) -> bytes:
    return join(encode(Message("STRING", "Said", String.of(text))))


def ip_packet(source: End, target: End, seq: int, flags: int, data: bytes = b"", *, size: int | None = None) -> bytes:
    tcp = struct.pack(">HHIIBBHHH", source[1], target[1], seq % 2**32, 0, 8 << 4, flags, 1000, 0, 0)
    tcp += b"\1" * 12 + data  # with options
    ends = ip_address(source[0]).packed + ip_address(target[0]).packed
    if ":" in source[0]:
        extension = bytes([6, 0]) + bytes(6)  # hop by hop, nothing in it
        return struct.pack(">IHBB", 6 << 28, len(tcp) + 8, 0, 64) + ends + extension + tcp
    total = 20 + len(tcp) if size is None else size
    return struct.pack(">BBHHHBBH", 0x45, 0, total, 0, 0, 64, 6, 0) + ends + tcp


@dataclass
class Talk:
    """The packets of a connection in which each side sends bytes in pieces."""

    client: End = CLIENT
    server: End = SERVER
    client_seq: int = 2**32 - 30  # wraps soon
    server_seq: int = 1000
    packets: list[bytes] = field(default_factory=list)

    def open(self) -> Talk:
        self.packets.append(ip_packet(self.client, self.server, self.client_seq, SYN))
        self.packets.append(ip_packet(self.server, self.client, self.server_seq, SYN | ACK))
        self.client_seq += 1
        self.server_seq += 1
        return self

    def say(self, data: bytes, piece: int = 1000, *, by_server: bool = False) -> Talk:
        for start in range(0, len(data), piece):
            part = data[start : start + piece]
            if by_server:
                self.packets.append(ip_packet(self.server, self.client, self.server_seq, ACK, part))
                self.server_seq += len(part)
            else:
                self.packets.append(ip_packet(self.client, self.server, self.client_seq, ACK, part))
                self.client_seq += len(part)
        return self

    def close(self) -> Talk:
        self.packets.append(ip_packet(self.client, self.server, self.client_seq, FIN | ACK))
        self.packets.append(ip_packet(self.client, self.server, self.client_seq + 1, ACK))
        self.packets.append(ip_packet(self.server, self.client, self.server_seq, FIN | ACK))
        self.packets.append(ip_packet(self.client, self.server, self.client_seq + 1, ACK))
        return self


FRAMES: dict[int, Callable[[bytes], bytes]] = {
    0: lambda p: struct.pack("<I", 2) + p,
    1: lambda p: bytes(12) + (b"\x86\xdd" if p[0] >> 4 == 6 else b"\x08\x00") + p + bytes(6),  # padded
    101: lambda p: p,
    113: lambda p: bytes(14) + (b"\x86\xdd" if p[0] >> 4 == 6 else b"\x08\x00") + p,
    276: lambda p: (b"\x86\xdd" if p[0] >> 4 == 6 else b"\x08\x00") + bytes(18) + p,
}


def write(path: Path, packets: list[bytes], *, link: int = 101, order: str = "<", nanoseconds: bool = False) -> Path:
    magic = 0xA1B23C4D if nanoseconds else 0xA1B2C3D4
    data = struct.pack(f"{order}IHHIIII", magic, 2, 4, 0, 0, 65535, link)
    for index, packet in enumerate(packets):
        made = FRAMES[link](packet)
        data += struct.pack(f"{order}4I", 1000, index, len(made), len(made)) + made
    write_anew(path, data)
    return path


def read(path: Path) -> tuple[list[ImportedItem], Pcap]:
    with closing(Pcap(path)) as source:
        return list(source.items()), source


def said(items: list[ImportedItem]) -> list[bytes]:
    return [bytes(item.payload) for item in items if item.kind is Kind.IGTL_IN]


@table("link", FRAMES)
@table("ends", [(CLIENT, SERVER), (CLIENT_6, SERVER_6)])
def test_both_directions_of_a_connection(tmp_path: Path, link: int, ends: tuple[End, End]) -> None:
    talk = Talk(*ends).open().say(message("a") + message("b"), 40).say(message("c"), by_server=True).close()
    items, source = read(write(tmp_path / "some.pcap", talk.packets, link=link))
    assert said(items) == [message("a"), message("b"), message("c")]
    notes = [Note.unpack(bytes(item.payload)) for item in items if item.kind is Kind.LINK]
    assert [(note.code, note.data["role"]) for note in notes] == [
        ("link_up", "server"),
        ("link_up", "client"),
        ("link_down", "server"),
        ("link_down", "client"),
    ]
    assert [item.links for item in items if item.kind is Kind.IGTL_IN] == [(1,), (1,), (2,)]
    assert [(row.declared, row.taken) for row in source.rows if row.unit == "bytes"] == [
        (len(message("a") + message("b")),) * 2,
        (len(message("c")),) * 2,
    ]
    assert all(row.good for row in source.rows)


@pytest.mark.parametrize("tags", [b"\x81\0\0\7", b"\x88\xa8\0\1\x81\0\0\2"])
@pytest.mark.parametrize("ends", [(CLIENT, SERVER), (CLIENT_6, SERVER_6)])
def test_packets_with_vlan_tags(
    tmp_path: Path, tags: bytes, ends: tuple[End, End], monkeypatch: pytest.MonkeyPatch
) -> None:
    plain = FRAMES[1]
    monkeypatch.setitem(FRAMES, 1, lambda packet: plain(packet)[:12] + tags + plain(packet)[12:])
    talk = Talk(*ends).open().say(message("a"), 40).close()
    items, source = read(write(tmp_path / "some.pcap", talk.packets, link=1))
    assert said(items) == [message("a")]
    assert all(row.good for row in source.rows)


def test_fragments_of_both_versions_are_counted(tmp_path: Path) -> None:
    four = ip_packet(CLIENT, SERVER, 1, ACK, b"x")
    six = ip_packet(CLIENT_6, SERVER_6, 1, ACK, b"x")
    fragments = [four[:6] + b"\x20\x01" + four[8:], six[:6] + bytes([44]) + six[7:]]
    _, source = read(write(tmp_path / "some.pcap", fragments))
    assert source.notes == ["2 fragments of IP packets are not reassembled"]


@pytest.mark.parametrize("order", "<>")
@pytest.mark.parametrize("nanoseconds", [False, True])
def test_a_message_has_the_time_of_the_packet_that_completes_it(tmp_path: Path, order: str, nanoseconds: bool) -> None:
    talk = Talk().open().say(message("a"), 50)
    items, _ = read(write(tmp_path / "some.pcap", talk.packets, order=order, nanoseconds=nanoseconds))
    last = len(talk.packets) - 1
    assert items[1].time_ns == 1000 * 10**9 + last * (1 if nanoseconds else 1000)


def test_whatever_order_a_network_makes_of_it(tmp_path: Path) -> None:
    sent = [message("x" * size) for size in (1, 100, 3000, 7, 900)]
    chance = random.Random(4)
    for _ in range(50):
        talk = Talk(client_seq=2**32 - chance.randrange(5000)).open()
        opened = len(talk.packets)
        start, data = talk.client_seq, b"".join(sent)
        talk.say(data, chance.randrange(20, 900))
        pieces = talk.packets[opened:]
        for _ in range(20):  # sent again, cut otherwise
            at = chance.randrange(len(data))
            pieces.append(ip_packet(CLIENT, SERVER, start + at, ACK, data[at : at + chance.randrange(1, 400)]))
        chance.shuffle(pieces)
        talk.packets[opened:] = pieces
        items, source = read(write(tmp_path / "some.pcap", talk.close().packets))
        assert said(items) == sent
        assert all(row.good for row in source.rows)


def test_a_packet_that_was_not_captured_shows(tmp_path: Path) -> None:
    talk = Talk().open().say(message("a")).say(message("b" * 100)).say(message("c"))
    del talk.packets[3]
    items, source = read(write(tmp_path / "some.pcap", talk.packets))
    assert said(items) == [message("a")]
    (row,) = (row for row in source.rows if not row.good)
    assert (row.declared, row.taken) == (len(message("a") + message("b" * 100) + message("c")), len(message("a")))
    assert row.why == f"a segment is missing after {len(message('a'))} bytes"


def test_an_end_inside_a_message_shows(tmp_path: Path) -> None:
    talk = Talk().open().say(message("a") + message("b")[:-1]).close()
    items, source = read(write(tmp_path / "some.pcap", talk.packets))
    assert said(items) == [message("a")]
    assert [row.why for row in source.rows if not row.good] == [
        f"ends inside a message, after {len(message('b')) - 1} bytes of it"
    ]


def test_the_same_ports_again_are_another_connection(tmp_path: Path) -> None:
    first = Talk().open().say(message("a"))  # no FIN: the client crashed
    second = Talk(client_seq=77, server_seq=88).open().say(message("b")).close()
    third = Talk(client_seq=99, server_seq=88).open().say(message("c")).close()
    items, source = read(write(tmp_path / "some.pcap", first.packets + second.packets + third.packets))
    assert said(items) == [message("a"), message("b"), message("c")]
    assert [item.links for item in items if item.kind is Kind.IGTL_IN] == [(1,), (3,), (5,)]
    assert all(row.good for row in source.rows)


def test_a_capture_that_begins_in_the_middle_goes_by_the_port(tmp_path: Path) -> None:
    talk = Talk().say(message("a"), by_server=True).say(message("b"))
    items, source = read(write(tmp_path / "some.pcap", talk.packets))
    assert said(items) == [message("a"), message("b")]
    roles = [Note.unpack(bytes(item.payload)).data["role"] for item in items if item.kind is Kind.LINK]
    assert roles == ["client", "server", "client", "server"]
    assert all(row.good for row in source.rows)


def test_other_traffic_is_left_out_and_named(tmp_path: Path) -> None:
    web = Talk(("10.0.0.9", 4444), ("10.0.0.2", 80)).open().say(b"GET / HTTP/1.1\r\n" * 9).close()
    dns = struct.pack(">BBHHHBBH", 0x45, 0, 28, 0, 0, 64, 17, 0) + bytes(16)
    talk = Talk().open().say(message("a")).close()
    items, source = read(write(tmp_path / "some.pcap", [dns, b"\x45", *web.packets, *talk.packets]))
    assert said(items) == [message("a")]
    assert [(row.left_out, row.why) for row in source.rows if row.left_out] == [(144, "not OpenIGTLink")]
    assert all(row.good for row in source.rows)


def test_what_cannot_be_read_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "some.pcap"
    path.write_bytes(b"\xa1\xb2\xc3\xd5" + bytes(40))
    with pytest.raises(UnsupportedRecording, match="found a1 b2 c3 d5, expected a pcap or pcapng file"):
        Pcap(path)
    write(path, [])
    path.write_bytes(path.read_bytes()[:20] + struct.pack("<I", 147))
    with pytest.raises(UnsupportedRecording, match="link type 147"):
        Pcap(path)
    write(path, Talk().open().say(message("a")).packets)
    path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(DamagedRecording, match="cut off inside packet 3, 1 byte short"):
        read(path)


def test_the_real_capture_comes_whole() -> None:
    items, source = read(CAPTURES / "reference_mixed.pcap")
    assert all(row.good for row in source.rows)
    counts = {(row.type, row.stream): row.taken for row in source.rows if row.type}
    assert counts == {
        ("TRANSFORM", "Probe"): 20,
        ("TRANSFORM", "Needle"): 20,
        ("GET_POLYDATA", "Client"): 4,
        ("POLYDATA", "Client"): 4,
        ("STT_TDATA", "TDataClient"): 1,
        ("TDATA", "Tracker"): 10,
        ("STP_TDATA", "TDataClient"): 1,
        ("IMAGE", "ImagerClient"): 2,
        ("CAPABILITY", "Device"): 2,
    }
    assert sum(counts.values()) == len(said(items))


def talks(path: Path, talks: list[Talk], order: str = "<") -> Path:
    """The packets of many connections, one connection after the other."""
    with path.open("wb") as out:
        out.write(struct.pack(f"{order}IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, 2**32 - 1, 101))  # a giant snap length
        for talk in talks:
            for packet in talk.packets:
                out.write(struct.pack(f"{order}4I", 1000, 0, len(packet), len(packet)) + packet)
    return path


def client(number: int) -> End:
    return f"10.{1 + number // 50_000}.0.1", 1024 + number % 50_000


def test_very_many_connections_are_followed_within_bounds(tmp_path: Path) -> None:
    scan = [Talk(client(number)).open() for number in range(4_000)]
    path = talks(tmp_path / "some.pcap", [Talk().open().say(message("first")), *scan])
    tracemalloc.start()
    with quick(), closing(Pcap(path)) as source:
        items = list(source.items())
        rows, notes = source.rows, source.notes
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert sum(item.kind is Kind.IGTL_IN for item in items) == 1
    assert len(rows) < 2 * MAX_ROWS
    assert notes[0].startswith(f"{4_001 - MAX_OPEN} connections were closed early: at most {MAX_OPEN} are followed")
    assert all(row.good for row in rows)
    assert peak < 100 << 20


def test_connections_without_a_row_of_their_own_are_counted(tmp_path: Path) -> None:
    both = [Talk(client(number)).open().say(message(f"{number}")).close() for number in range(MAX_ROWS)]
    other = [Talk(client(number)).open().say(b"x" * 100).close() for number in range(MAX_ROWS, MAX_ROWS + 50)]
    with closing(Pcap(talks(tmp_path / "some.pcap", [*both, *other]))) as source:
        items = list(source.items())
        rows = {row.stream: row for row in source.rows}
    assert sum(item.kind is Kind.IGTL_IN for item in items) == MAX_ROWS
    igtl, rest = rows["(further connections, OpenIGTLink)"], rows["(further connections, not OpenIGTLink)"]
    assert igtl.declared == igtl.taken > 0
    assert (rest.declared, rest.left_out) == (5000, 5000)
    own = sum(row.taken for row in rows.values() if " to " in row.stream)
    assert own + igtl.taken == sum(len(message(f"{number}")) for number in range(MAX_ROWS))


def test_gaps_without_end_cost_the_direction_that_holds_most(tmp_path: Path) -> None:
    good, greedy = Talk().open(), Talk(client(1)).open()
    greedy.client_seq += 1  # a byte that never comes
    for _ in range(60_000):
        greedy.say(b"x")
        greedy.client_seq += 1  # and another
    greedy.say(bytes(40 << 20), piece=60_000)
    good.client_seq += 5
    good.say(message("late")[5:])
    good.client_seq -= len(message("late"))
    good.say(message("late")[:5])
    half = len(good.packets) // 2 + 1
    first, last = Talk(packets=good.packets[:half]), Talk(packets=good.packets[half:])
    with quick(), closing(Pcap(talks(tmp_path / "some.pcap", [first, greedy, last]))) as source:
        items = list(source.items())
        rows = {row.stream: row for row in source.rows}
    assert [bytes(item.payload) for item in items if item.kind is Kind.IGTL_IN] == [message("late")]
    row = next(row for name, row in rows.items() if name.startswith(f"{client(1)[0]}:{client(1)[1]}"))
    assert row.why == "too many bytes wait for a missing segment: given up after 0 bytes"
    assert not row.good


def test_messages_that_begin_and_never_end_are_bounded(tmp_path: Path) -> None:
    head = bytearray(message("x")[:58])
    head[42:50] = struct.pack(">Q", 200 << 20)
    begun = [Talk(client(number)).open().say(bytes(head)) for number in range(100)]
    with closing(Pcap(talks(tmp_path / "some.pcap", begun))) as source:
        assert [item.kind for item in source.items() if item.kind is Kind.IGTL_IN] == []
        given_up = [row for row in source.rows if row.why.startswith("too many bytes of incomplete messages")]
    assert 50 < len(given_up) < 100


def test_streams_without_a_row_of_their_own_are_counted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("igtl_gateway.addons.exchange.capture.MAX_STREAMS", 3)
    talk = Talk().open()
    for name in ("A", "B", "C", "D", "E", "A"):
        talk.say(join(encode(Message("STRING", name, String.of("x")))))
    with closing(Pcap(talks(tmp_path / "some.pcap", [talk]))) as source:
        list(source.items())
        counts = {row.stream: row.taken for row in source.rows}
    assert {name: counts[name] for name in ("A", "B", "C")} == {"A": 2, "B": 1, "C": 1}
    assert counts["(further streams)"] == 2
