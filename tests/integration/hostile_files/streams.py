"""Hostile captures of packets and of OpenIGTLink streams, configurations, and paths that are not files."""

from __future__ import annotations

import os
import struct
from collections.abc import Callable
from functools import partial
from pathlib import Path

from tests.addons.exchange.test_pcap import ACK, FIN, SYN, ip_packet
from tests.integration.hostile_cases import CASES as PEERS
from tests.integration.hostile_cases import raw
from tests.integration.hostile_files.case import ESCAPE, FORGED, MIB, NAUGHTY, Danger, Hostile, file

CLIENT, SERVER = ("10.0.0.1", 50_000), ("10.0.0.2", 18_944)


def pcap(
    *packets: bytes, link: int = 101, magic: int = 0xA1B2C3D4, snap: int = 65_535, stamps: tuple[int, int] = (1, 0)
) -> bytes:
    """Packets as libpcap writes them."""
    head = struct.pack("<IHHiIII", magic, 2, 4, 0, 0, snap, link)
    return head + b"".join(struct.pack("<IIII", *stamps, len(packet), len(packet)) + packet for packet in packets)


def block(kind: int, body: bytes, length: int | None = None) -> bytes:
    """A block of pcapng."""
    size = 12 + len(body) if length is None else length
    return struct.pack("<II", kind, size & 0xFFFFFFFF) + body + struct.pack("<I", size & 0xFFFFFFFF)


def pcapng(*blocks: bytes) -> bytes:
    return block(0x0A0D0D0A, struct.pack("<IHHq", 0x1A2B3C4D, 1, 0, -1)) + b"".join(blocks)


def talks(count: int) -> bytes:
    """Very many connections, each begun."""
    packets = []
    for number in range(count):
        client = (f"10.{number >> 16 & 255}.{number >> 8 & 255}.{number & 255}", 1024 + number % 60_000)
        packets.append(ip_packet(client, SERVER, 1, SYN))
        packets.append(ip_packet(client, SERVER, 2, ACK, b"x"))
    return pcap(*packets)


def holes(count: int) -> bytes:
    """One connection with very many pieces, of which the first never comes."""
    packets = [ip_packet(CLIENT, SERVER, 1, SYN), ip_packet(SERVER, CLIENT, 1, SYN | ACK)]
    packets += [ip_packet(CLIENT, SERVER, 10 + 1000 * number, ACK, b"x" * 500) for number in range(count)]
    return pcap(*packets)


def one_byte_each(data: bytes) -> bytes:
    packets = [ip_packet(CLIENT, SERVER, 1, SYN), ip_packet(SERVER, CLIENT, 1, SYN | ACK)]
    packets += [ip_packet(CLIENT, SERVER, 2 + at, ACK, data[at : at + 1]) for at in range(len(data))]
    return pcap(*packets, ip_packet(CLIENT, SERVER, 2 + len(data), FIN | ACK))


def talk(data: bytes) -> bytes:
    packets = [ip_packet(CLIENT, SERVER, 1, SYN), ip_packet(SERVER, CLIENT, 1, SYN | ACK)]
    packets += [ip_packet(CLIENT, SERVER, 2 + at, ACK, data[at : at + 1000]) for at in range(0, len(data), 1000)]
    return pcap(*packets)


def _capture(name: str, danger: Danger, what: str, data: Callable[[], bytes]) -> Hostile:
    return Hostile(f"pcap-{name}", "capture", danger, what, file(f"pcap-{name}.pcap", data))


CAPTURES = (
    _capture("connections", Danger.BOMB, "60,000 connections", lambda: talks(60_000)),
    _capture("holes", Danger.BOMB, "100,000 pieces behind a gap", lambda: holes(100_000)),
    _capture(
        "bytes",
        Danger.BOMB,
        "a message byte by byte, 20,000 packets",
        lambda: one_byte_each(raw(b"STRING", b"A", bytes(19_000))),
    ),
    _capture(
        "length",
        Danger.LIE,
        "a packet of 4 GiB",
        lambda: pcap() + struct.pack("<IIII", 1, 0, 0xFFFFFFFF, 0xFFFFFFFF) + b"x" * 50,
    ),
    _capture(
        "length-1g",
        Danger.LIE,
        "a packet of 1 GB",
        lambda: pcap() + struct.pack("<IIII", 1, 0, 10**9, 10**9) + b"x" * 50,
    ),
    _capture(
        "snap", Danger.LIE, "a snap length of 4 GiB", lambda: pcap(ip_packet(CLIENT, SERVER, 1, SYN), snap=0xFFFFFFFF)
    ),
    _capture("link", Danger.SHAPE, "an unknown link type", lambda: pcap(b"x" * 50, link=65_000)),
    _capture(
        "stamps",
        Danger.SHAPE,
        "times of 2^32 − 1 s and µs",
        lambda: pcap(
            ip_packet(CLIENT, SERVER, 1, SYN),
            ip_packet(CLIENT, SERVER, 2, ACK, raw(b"STRING", b"A", bytes(4))),
            stamps=(0xFFFFFFFF, 0xFFFFFFFF),
        ),
    ),
    _capture(
        "short-ip",
        Danger.SHAPE,
        "packets that end inside the IP header",
        lambda: pcap(b"", b"\x45", b"\x45" * 10, b"\x60" * 20),
    ),
    _capture(
        "ip-lengths",
        Danger.LIE,
        "IP and TCP headers that are longer than the packet",
        lambda: pcap(
            ip_packet(CLIENT, SERVER, 1, ACK, b"x", size=65_535),
            b"\x4f" + bytes(40),
            ip_packet(CLIENT, SERVER, 1, SYN)[:22],
        ),
    ),
    _capture(
        "ip6-chain",
        Danger.LIE,
        "an endless chain of IPv6 headers",
        lambda: pcap(struct.pack(">IHBB", 6 << 28, 8000, 0, 64) + bytes(32) + b"\0\0" * 4000),
    ),
    _capture(
        "fragments",
        Danger.SHAPE,
        "fragments of IP",
        lambda: pcap(
            *(
                ip_packet(CLIENT, SERVER, 1, ACK, b"x")[:6] + b"\x20\x01" + ip_packet(CLIENT, SERVER, 1, ACK, b"x")[8:]
                for _ in range(99)
            )
        ),
    ),
    _capture(
        "sequence",
        Danger.LIE,
        "sequence numbers that jump by 2^31",
        lambda: pcap(
            *(ip_packet(CLIENT, SERVER, number * 0x7FFFFFFF % 2**32, ACK, b"x" * 100) for number in range(2000))
        ),
    ),
    _capture(
        "message",
        Danger.LIE,
        "a message that announces 2^62 bytes",
        lambda: talk(raw(b"STRING", b"A", b"")[:42] + struct.pack(">QQ", 1 << 62, 0)),
    ),
    _capture(
        "device",
        Danger.TERMINAL,
        "escape sequences in a device name",
        lambda: talk(raw(b"STRING", b"A\x1b[2J\nFORGED", b"\0\3\0\1x") * 3),
    ),
    *(
        Hostile(f"pcapng-{name}", "capture", danger, what, file(f"pcapng-{name}.pcapng", data))
        for name, danger, what, data in (
            ("length", Danger.LIE, "a block of 4 GiB", lambda: pcapng(block(1, bytes(8), 0xFFFFFFFC))),
            ("length-0", Danger.LIE, "a block of no length", lambda: pcapng(block(6, bytes(20), 0))),
            ("length-odd", Danger.LIE, "a block of 13 bytes", lambda: pcapng(block(6, bytes(20), 13))),
            (
                "interfaces",
                Danger.LIE,
                "300,000 interfaces",
                lambda: pcapng(block(1, struct.pack("<HHI", 101, 0, 65_535)) * 300_000),
            ),
            (
                "statistics",
                Danger.BOMB,
                "statistics of 300,000 interfaces",
                lambda: pcapng(*(block(5, struct.pack("<III", number, 0, 0)) for number in range(300_000))),
            ),
            ("sections", Danger.BOMB, "100,000 sections", lambda: pcapng() * 100_000),
            (
                "many-options",
                Danger.BOMB,
                "a packet with 1,000,000 options",
                lambda: pcapng(
                    block(1, struct.pack("<HHI", 101, 0, 0)),
                    block(6, struct.pack("<IIIII", 0, 0, 0, 0, 0) + struct.pack("<HH", 1, 0) * 1_000_000),
                ),
            ),
            (
                "offset",
                Danger.SHAPE,
                "an interface that adds 2^62 s",
                lambda: pcapng(
                    block(1, struct.pack("<HHI", 101, 0, 0) + struct.pack("<HHq", 14, 8, 1 << 62)),
                    block(6, struct.pack("<IIIII", 0, 0, 0, 40, 40) + ip_packet(CLIENT, SERVER, 1, SYN)[:40]),
                ),
            ),
            (
                "resolution",
                Danger.SHAPE,
                "times in units of 2^-127 s",
                lambda: pcapng(
                    block(1, struct.pack("<HHI", 101, 0, 0) + struct.pack("<HH4s", 9, 1, b"\xff\0\0\0")),
                    block(
                        6,
                        struct.pack("<IIIII", 0, 0xFFFFFFFF, 0xFFFFFFFF, 40, 40)
                        + ip_packet(CLIENT, SERVER, 1, SYN)[:40],
                    ),
                ),
            ),
            (
                "interface",
                Danger.LIE,
                "a packet of an interface that is not there",
                lambda: pcapng(block(6, struct.pack("<IIIII", 7, 0, 0, 4, 4) + b"abcd")),
            ),
            (
                "options",
                Danger.TERMINAL,
                "options with escape sequences and wrong lengths",
                lambda: pcapng(
                    block(1, struct.pack("<HHI", 101, 0, 0) + struct.pack("<HH", 2, 60_000) + NAUGHTY.encode())
                ),
            ),
        )
    ),
)


def _after(data: bytes) -> bytes:
    """Bytes of a peer behind a good message."""
    return raw(b"STRING", b"Before", b"\0\3\0\1x") + data


_STREAM_CASES = tuple(
    Hostile(
        f"stream-{case.name}".replace(" ", "-").replace("/", "-"),
        "stream",
        Danger.LIE,
        f"a hostile peer's bytes: {case.what}",
        file("peer.igtl", partial(_after, case.data)),
    )
    for case in PEERS[::4]
    if len(case.data) < 4 * MIB
)

STREAMS = (
    *_STREAM_CASES,
    Hostile(
        "stream-announces",
        "stream",
        Danger.LIE,
        "a message that announces 2^62 bytes",
        file("a.igtl", lambda: raw(b"STRING", b"A", b"")[:42] + struct.pack(">QQ", 1 << 62, 0) + b"x" * 100),
    ),
    Hostile(
        "stream-announces-400m",
        "stream",
        Danger.LIE,
        "a message that announces 400 MB",
        file("a.igtl", lambda: raw(b"STRING", b"A", b"")[:42] + struct.pack(">QQ", 400_000_000, 0) + b"x" * 100),
    ),
    Hostile(
        "stream-device",
        "stream",
        Danger.TERMINAL,
        "escape sequences in a device name and a string",
        file("a.igtl", lambda: raw(b"STRING", b"A\x1b[2J\nFORGED", b"\0\3\0\x0a\x1b[2J\nFORGE") * 3),
    ),
    Hostile(
        "stream-cut",
        "stream",
        Danger.LIE,
        "a stream that ends inside a message",
        file("a.igtl", lambda: raw(b"STRING", b"A", bytes(90))[:100]),
    ),
)


def _toml(name: str, danger: Danger, what: str, data: Callable[[], bytes]) -> Hostile:
    return Hostile(f"toml-{name}", "configuration", danger, what, file(f"toml-{name}.toml", data))


CONFIGURATIONS = (
    _toml(
        "deep", Danger.LIE, "TOML that nests 100,000 deep", lambda: b"[gateway]\na = " + b"[" * 100_000 + b"]" * 100_000
    ),
    _toml("deep-300", Danger.LIE, "TOML that nests 300 deep", lambda: b"[gateway]\na = " + b"[" * 300 + b"]" * 300),
    _toml("dotted", Danger.LIE, "a key with 100,000 dots", lambda: b".".join([b"a"] * 100_000) + b" = 1"),
    _toml(
        "dotted-tables",
        Danger.LIE,
        "5,000 tables with 200 dots each",
        lambda: b"\n".join(b"[" + b".".join(b"k%d" % n for _ in range(200)) + b"]" for n in range(5_000)),
    ),
    _toml("giant", Danger.BOMB, "TOML of 70 MB", lambda: b"a = '" + b"x" * (70 * MIB) + b"'"),
    _toml("many", Danger.LIE, "300,000 rules", lambda: b'[[to_igtl]]\ntopic = "/a"\n' * 300_000),
    _toml("integer", Danger.SHAPE, "an integer of 5,000 digits", lambda: b"[gateway]\nfault_seed = " + b"9" * 5000),
    _toml(
        "integer-long",
        Danger.LIE,
        "an integer of 1,000,000 digits",
        lambda: b"[gateway]\nfault_seed = 0x" + b"f" * 1_000_000,
    ),
    _toml("no-utf8", Danger.SHAPE, "TOML that is invalid UTF-8", lambda: b"[gateway]\nbase_frame = '\xff\xfe'"),
    _toml("nul", Danger.SHAPE, "TOML with NUL", lambda: b"[gateway]\nbase_frame = 'a\0b'"),
    _toml("empty-key", Danger.SHAPE, "an empty key", lambda: b'"" = 1'),
    _toml("binary", Danger.SHAPE, "bytes that are not text", lambda: bytes(range(256)) * 100),
    *(
        _toml(f"shape-{number}", Danger.SHAPE, f"`{text}`", text.encode)
        for number, text in enumerate(
            (
                "base_frame = 7",
                "[gateway]\nbase_frame = 7",
                "to_igtl = 7",
                "to_igtl = [7]",
                "to_igtl = [[1]]",
                "[to_igtl]\na = 1",
                "[[to_igtl]]\ntopic = 7",
                "tf_out = [{}]",
                "peers = {a = 1}",
                "gateway = 5",
                "[gateway]\ndeny_in = 'x'",
                "[gateway]\ndeny_in = [1]",
                "[gateway]\nigtl_unit = nan",
                "[gateway]\nwatch = 5",
                "[gateway.watch]\na = [1]",
                "[gateway]\npublish_tf = 'no'",
                "[gateway]\nbase_frame = 1979-05-27T07:32:00Z",
                "to_ros = [{device = [1], kinds = 7}]",
                "[gateway]\nstamp = {}",
                "[gateway]\nprofile = []",
                "[gateway]\nmax_age = -inf",
                "[gateway]\nmax_age_s = nan",
                "[gateway]\nmetadata = [1]",
                "[gateway.metadata]\na = {b = 1}",
                "[gateway]\nros_unit = ''",
                "[gateway]\nfaults = 'loss=1e999%'",
                "[gateway]\nfaults = 7",
                "[gateway]\nfault_seed = 1.5",
                "igtl = 7",
                "[igtl]\nlisten = 7",
                "[igtl]\nmax_body = {IMAGE = -1}",
                "[igtl]\nallow = [[]]",
                "[igtl]\nconnect = ['\\n']",
                "[[igtl]]\nlisten = ['x']",
            )
        )
    ),
    _toml(
        "unknown",
        Danger.TERMINAL,
        "escape sequences and a forged line in keys",
        f'"a\\u001b[2J\\n{FORGED}" = 1'.encode,
    ),
    _toml(
        "value",
        Danger.TERMINAL,
        "the same in a value",
        f'[gateway]\nigtl_unit = "a\\u001b[2J\\n{FORGED}"'.encode,
    ),
    _toml(
        "topic",
        Danger.TERMINAL,
        "the same in a topic",
        f'[[to_igtl]]\ntopic = "/a\\u001b[2J\\n{FORGED}"\n'.encode,
    ),
    _toml(
        "frame",
        Danger.TERMINAL,
        "the same in a frame",
        f'[gateway]\nbase_frame = "a\\u001b[2J\\n{FORGED}"'.encode,
    ),
    Hostile(
        "toml-file-name",
        "configuration",
        Danger.TERMINAL,
        "the same in the file name",
        file(f"a{ESCAPE}\n{FORGED}.toml".replace("/", ""), lambda: b"x = 1"),
    ),
)


def _fifo(folder: Path) -> Path:
    path = folder / "fifo.mcap"
    os.mkfifo(path)
    return path


def _linked(target: str) -> Callable[[Path], Path]:
    def build(folder: Path) -> Path:
        path = folder / "link.mcap"
        path.symlink_to(target)
        return path

    return build


def _folder(folder: Path) -> Path:
    path = folder / f"folder{ESCAPE}\n{FORGED}".replace("/", "")
    path.mkdir()
    return path


PLACES = (
    Hostile("place-fifo", "place", Danger.LIE, "a FIFO without a writer", _fifo),
    Hostile("place-zero", "place", Danger.LIE, "a link to /dev/zero", _linked("/dev/zero")),
    Hostile("place-loop", "place", Danger.LIE, "a link to itself", _linked("link.mcap")),
    Hostile("place-folder", "place", Danger.TERMINAL, "a folder with escape sequences in its name", _folder),
    Hostile(
        "place-missing",
        "place",
        Danger.TERMINAL,
        "no file, with escape sequences in its name",
        lambda folder: folder / f"none{ESCAPE}\n{FORGED}".replace("/", ""),
    ),
    Hostile("place-long", "place", Danger.SHAPE, "a name of 5,000 characters", lambda folder: folder / ("x" * 5000)),
    Hostile("place-empty", "place", Danger.SHAPE, "an empty file", file("empty.mcap", lambda: b"")),
    Hostile("place-zeros", "place", Danger.SHAPE, "a file of zeros", file("zeros.mcap", lambda: bytes(MIB))),
)

CASES = CAPTURES + STREAMS + CONFIGURATIONS + PLACES
