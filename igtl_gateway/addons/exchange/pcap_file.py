"""Reads packets from a capture file: pcap of tcpdump, or pcapng of Wireshark with python-pcapng (extra ``pcap``).

python-pcapng decodes the blocks of pcapng, in linear time.  It reads as many bytes as a block claims, so its stream
refuses more than ``MAX_PACKET``.  It gets only the blocks and options that are needed: it would store the statistics of
every interface, also of invented ones, and would reject a file for a comment that is not UTF-8 or an option that is
repeated.

Other libraries were measured too.  The reader of dpkt supports one interface, has times in ``float``, and needs
quadratic time for the options of a block (17 s for 1 MiB).  scapy truncates packets at 65,535 bytes, mixes the
interfaces of different sections, and has a licence (GPL 2) that does not fit this project.

Documents: draft-ietf-opsawg-pcap, draft-ietf-opsawg-pcapng.
"""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO

from igtl_gateway.addon import NS_PER_S, DamagedRecording, Unavailable, UnsupportedRecording
from igtl_gateway.addon.processes import missing
from igtl_gateway.addon.terminal import counted
from igtl_gateway.addon.untrusted import files, limits
from igtl_gateway.addons.exchange.source import library_errors_as_damage

#: Largest packet, and largest block of pcapng, in bytes.
MAX_PACKET = 1 << 22
#: Interfaces of a section of pcapng.
MAX_INTERFACES = 10_000

PCAPNG = b"\x0a\x0d\x0d\x0a"
#: First four bytes of pcap → byte order, and the unit of the second word of a time stamp in nanoseconds.
MAGICS = {
    b"\xd4\xc3\xb2\xa1": ("<", 1000),
    b"\xa1\xb2\xc3\xd4": (">", 1000),
    b"\x4d\x3c\xb2\xa1": ("<", 1),
    b"\xa1\xb2\x3c\x4d": (">", 1),
}
_DEADLINE_PACKETS = 1_000
_MAX_TIME_NS = 1 << 63

_SECTION = int.from_bytes(PCAPNG, "little")
_INTERFACE, _OBSOLETE_PACKET, _SIMPLE_PACKET, _ENHANCED_PACKET = 1, 2, 3, 6
#: Bytes of the blocks before the options of an interface, and before the bytes of a packet; where their number is.
_INTERFACE_HEAD, _PACKET_HEAD, _CAPTURED = 8, 20, 12
#: if_tsresol and if_tsoffset.
_OPTIONS = (9, 14)
#: Bits of the link type; those above are of the frame check sequence.
_LINK_TYPE = 0xFFFF
_MICROSECONDS = 6  # the default of if_tsresol, as a negative power of ten


@dataclass(frozen=True, slots=True)
class Packet:
    """A captured packet.

    Attributes:
        time_ns: UTC; for a block without a time that of the previous packet.
        link_type: kind of the header at the start of ``data``, by its number at tcpdump.org (LINKTYPE).
        data: the captured bytes.
        is_cut: whether the sent packet was longer than the captured bytes.
    """

    time_ns: int
    link_type: int
    data: bytes
    is_cut: bool


def is_capture(start: bytes) -> bool:
    """Return whether these are the first bytes of pcap or pcapng."""
    return start[:4] in MAGICS or start[:4] == PCAPNG


class PacketFile:
    """An open capture file.

    Args:
        path: the file.
        link_types: link types that the caller can read.

    Attributes:
        other_links: link type → number of pcapng packets left out because it is not in ``link_types``.

    Raises:
        UnsupportedRecording: neither pcap nor pcapng, or pcap of another link type.
        Unavailable: pcapng without the extra ``pcap``.
    """

    def __init__(self, path: Path, link_types: frozenset[int]) -> None:
        self._path = path
        self._link_types = link_types
        self.other_links: Counter[int] = Counter()
        with library_errors_as_damage(path):
            self._stream = files.open_file(path)
        try:
            with library_errors_as_damage(path):
                self._deadline = files.deadline_of(path)
                self._packets = self._open()
        except BaseException:
            self._stream.close()
            raise

    def _open(self) -> Iterator[Packet]:
        head = self._stream.read(24)
        if head[:4] == PCAPNG:
            _import_pcapng(self._path)
            self._stream.seek(0)
            return self._pcapng_packets()
        if head[:4] not in MAGICS or len(head) < 24:
            raise UnsupportedRecording(f"{self._path}: found {head[:4].hex(' ')}, expected a pcap or pcapng file")
        order, unit_ns = MAGICS[head[:4]]
        link_type = int(struct.unpack(f"{order}I", head[20:])[0]) & _LINK_TYPE
        if link_type not in self._link_types:
            expected = ", ".join(map(str, sorted(self._link_types)))
            raise UnsupportedRecording(f"{self._path}: found link type {link_type}, expected one of {expected}")
        return self._pcap_packets(struct.Struct(f"{order}4I"), unit_ns, link_type)

    def packets(self) -> Iterator[Packet]:
        """Return an iterator over the packets in the order of the file.  Raises DamagedRecording, LimitExceeded."""
        return self._packets

    def close(self) -> None:
        """Close the file."""
        self._stream.close()

    def _pcap_packets(self, record: struct.Struct, unit_ns: int, link_type: int) -> Iterator[Packet]:
        number = 0
        while head := self._stream.read(record.size):
            number += 1
            if number % _DEADLINE_PACKETS == 0:
                self._deadline.check(str(self._path))
            if len(head) < record.size:
                raise DamagedRecording(f"{self._path}: cut off inside the header of packet {number}")
            seconds, rest, size, original = record.unpack(head)
            if size > MAX_PACKET:
                raise DamagedRecording(
                    f"{self._path}: packet {number}: found {counted(size, 'byte')}, expected at most {MAX_PACKET}"
                )
            data = self._stream.read(size)
            if len(data) < size:
                raise DamagedRecording(
                    f"{self._path}: cut off inside packet {number}, {counted(size - len(data), 'byte')} short"
                )
            yield Packet(seconds * NS_PER_S + rest * unit_ns, link_type, data, size < original)

    def _pcapng_packets(self) -> Iterator[Packet]:
        time_ns = 0
        for place, interface, ticks, block in _packet_blocks(self._stream, str(self._path), self._deadline):
            if interface.link_type not in self._link_types:
                self.other_links[interface.link_type] += 1
                continue
            if ticks is not None:
                time_ns = interface.time_ns(ticks, place)
            data = bytes(block.packet_data)
            yield Packet(time_ns, interface.link_type, data, len(data) < block.packet_len)


@dataclass(frozen=True, slots=True)
class _Interface:
    """An interface of pcapng: time = ``offset_s`` seconds + ticks, of which ``units`` are a second."""

    link_type: int
    units: int
    offset_s: int

    def time_ns(self, ticks: int, place: str) -> int:
        time_ns = self.offset_s * NS_PER_S + ticks * NS_PER_S // self.units
        if not 0 <= time_ns < _MAX_TIME_NS:
            raise DamagedRecording(f"{place}: found a time of {time_ns // NS_PER_S} s, expected 1970 to 2262")
        return time_ns


class _BoundedStream:
    """A file that rejects long reads, for a library that reads as many bytes as the file claims."""

    def __init__(self, stream: BinaryIO) -> None:
        self._stream = stream
        self.tell = stream.tell

    def read(self, size: int) -> bytes:
        if not 0 <= size <= MAX_PACKET:
            raise DamagedRecording(f"found a length of {counted(size, 'byte')}, expected at most {MAX_PACKET}")
        return self._stream.read(size)


def _packet_blocks(
    stream: BinaryIO, path: str, deadline: limits.Deadline
) -> Iterator[tuple[str, _Interface, int | None, Any]]:
    """Yield place, interface, time and block of each packet; the time is in the units of the interface, or None."""
    bounded = _BoundedStream(stream)
    blocks = _blocks(bounded)
    interfaces: list[_Interface] = []
    number = 0
    while True:
        number += 1
        place = f"{path}: block {number}"
        start = stream.tell()
        deadline.check(path)
        with _library_errors(place):
            kind, block = next(blocks, (None, None))
        if kind is None:
            if stream.tell() != start:  # the library treats a truncated block as the end of the file
                raise DamagedRecording(f"{place}: cut off")
            return
        if kind == _SECTION:
            interfaces = []
        elif kind == _INTERFACE:
            if len(interfaces) >= MAX_INTERFACES:
                raise DamagedRecording(f"{place}: found another interface, expected at most {MAX_INTERFACES}")
            interfaces.append(_interface(block, place))
        elif block is not None:
            if block.interface_id >= len(interfaces):
                raise DamagedRecording(
                    f"{place}: found interface {block.interface_id}, expected one of {len(interfaces)}"
                )
            has_time = kind != _SIMPLE_PACKET
            ticks = (block.timestamp_high << 32 | block.timestamp_low) if has_time else None
            yield place, interfaces[block.interface_id], ticks, block


@contextmanager
def _library_errors(place: str) -> Iterator[None]:
    """Raise DamagedRecording with the place of a block; python-pcapng raises many types of errors."""
    try:
        yield
    except DamagedRecording as error:
        raise DamagedRecording(f"{place}: {error}") from None
    except Exception as error:
        raise DamagedRecording(f"{place}: {type(error).__name__}: {error}") from error


def _blocks(stream: _BoundedStream) -> Iterator[tuple[int, Any]]:
    """Yield kind and contents of each block; the contents of a kind that is not needed are None."""
    from pcapng.blocks import KNOWN_BLOCKS, SectionHeader
    from pcapng.exceptions import StreamEmpty
    from pcapng.structs import read_block_data, read_int, read_section_header

    section: Any = None
    wanted = (_INTERFACE, _OBSOLETE_PACKET, _SIMPLE_PACKET, _ENHANCED_PACKET)
    try:
        while True:
            kind = read_int(stream, 32, False, section.endianness if section else "<")
            if kind == _SECTION:  # the same bytes in both byte orders
                found = read_section_header(stream)
                section = SectionHeader(raw=found["data"], endianness=found["endianness"])
                yield kind, section
            else:
                data = read_block_data(stream, section.endianness)
                yield (
                    kind,
                    section.new_member(KNOWN_BLOCKS[kind], raw=_needed(kind, data, section.endianness))
                    if kind in wanted
                    else None,
                )
    except StreamEmpty:
        return


def _needed(kind: int, data: bytes, order: str) -> bytes:
    """Return the contents of a block without the options that are not needed."""
    from pcapng.structs import read_options

    if kind == _INTERFACE:
        options = read_options(BytesIO(data[_INTERFACE_HEAD:]), order)
        needed = [(code, value) for code, value in options if code in _OPTIONS]
        if len(dict(needed)) < len(needed):
            raise DamagedRecording("found an if_tsresol or if_tsoffset twice, expected it once")
        packed = (
            struct.pack(f"{order}2H", code, len(value)) + value + bytes(-len(value) % 4) for code, value in needed
        )
        return data[:_INTERFACE_HEAD] + b"".join(packed)
    if kind == _SIMPLE_PACKET or len(data) < _PACKET_HEAD:
        return data
    (size,) = struct.unpack_from(f"{order}I", data, _CAPTURED)
    return data[: _PACKET_HEAD + size + -size % 4]


def _interface(block: Any, place: str) -> _Interface:
    with _library_errors(place):  # an option is decoded when it is read
        resolution = block.options["if_tsresol"] if "if_tsresol" in block.options else bytes([_MICROSECONDS])
        offset_s = block.options["if_tsoffset"] if "if_tsoffset" in block.options else 0
    if len(resolution) != 1:
        raise DamagedRecording(f"{place}: found an if_tsresol of {counted(len(resolution), 'byte')}, expected 1 byte")
    exponent = resolution[0]
    units: int = 2 ** (exponent & 0x7F) if exponent & 0x80 else 10**exponent
    return _Interface(block.link_type, units, offset_s)


def _import_pcapng(path: Path) -> None:
    try:
        import pcapng  # noqa: F401
    except ImportError as error:
        raise Unavailable(
            f"{path}: pcapng: {missing('pcapng', error)}, or convert the file with `editcap -F pcap`"
        ) from None
