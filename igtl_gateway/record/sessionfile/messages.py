"""An entry as a CDR message in the file, and back.

``igtl_msgs/msg/RawMessage`` and ``Note`` are packed by hand: the head is a few dozen bytes, and the payload must not be
copied on the way.  The messages of ROS topics are the payloads of their entries.
"""

from __future__ import annotations

import json
import struct

from igtl_gateway.base.buffers import Buffer
from igtl_gateway.base.errors import DamagedRecording
from igtl_gateway.base.quantities import count_text, counted
from igtl_gateway.base.stamp import NS_PER_S, ns_to_ros
from igtl_gateway.base.untrusted.text import parse_json
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.note import UNREADABLE, Level, Note
from igtl_gateway.record.sessionfile.layout import NOTE_KINDS, WIRE_TOPICS, LayoutError, escape, unescape
from igtl_gateway.wire.header import BODY_SIZE_AT, TICKS_AT, U64

_CDR_LE = b"\x00\x01\x00\x00"
_CDR_LE_NUMBER = int.from_bytes(_CDR_LE[:2], "little")
# The fixed heads of the messages behind this encapsulation.  Alignment counts from its end; as it has 4 bytes
# and nothing behind the heads is aligned to more than 4, offsets in the whole buffer do as well.
_RAW_HEAD = struct.Struct("<4s iI iI Q B3x")  # stamp, source_stamp, source_ticks, direction
_RAW_START = struct.Struct("<H10xiI8xB3x")  # the same: first half of the encapsulation, source_stamp, direction
_NOTE_HEAD = struct.Struct("<4s iI B3x")  # stamp, level
_U32 = struct.Struct("<I")
_MAX_SEC = (1 << 31) - 1


def pack_message(entry: Entry) -> bytes:
    """The CDR message of an entry, with one copy of the payload; without a copy where it is one ``bytes`` of ROS.

    Raises LayoutError for an entry whose fields contradict its kind.
    """
    try:
        if entry.kind in WIRE_TOPICS:
            data = entry.data()
            return RawPacker(entry).head(entry, data) + data
        if entry.kind in NOTE_KINDS:
            return _pack_note(entry)
    except struct.error as error:
        raise LayoutError(f"{_named(entry)}: {error}") from None
    if entry.links:
        raise LayoutError(f"{_named(entry)}: found links {entry.links}, expected none")
    return entry.data()


def device_name(entry: Entry) -> str:
    """Device name of an OpenIGTLink entry.  Raises LayoutError if its channel is not ``TYPE/device name``."""
    head = f"{entry.type}/"
    if not entry.channel.startswith(head):
        raise LayoutError(f"{_named(entry)}: found channel {entry.channel!r}, expected {head!r} and a name")
    return entry.channel[len(head) :]


def unpack_raw(data: Buffer, seq: int, log_ns: int, publish_ns: int) -> Entry:
    """The entry in a RawMessage; its payload is a view on ``data``.

    Args:
        data: the CDR message.
        seq: entry number.
        log_ns: log_time of the MCAP message, UTC nanoseconds.
        publish_ns: its publish_time.

    Raises LayoutError.
    """
    view = memoryview(data)
    try:
        encapsulation, _, _, source_sec, source_nanosec, _, direction = _RAW_HEAD.unpack_from(view)
        _check_encapsulation(encapsulation)
        links, at = _get_links(view, _RAW_HEAD.size)
        message_type, at = _get_string(view, at)
        device, at = _get_string(view, at)
        size, at = _get_u32(view, at)
    except (struct.error, UnicodeDecodeError) as error:
        raise LayoutError(f"RawMessage of {counted(view.nbytes, 'byte')}: {error}") from None
    if at + size != view.nbytes:
        raise LayoutError(f"RawMessage: found {counted(view.nbytes - at, 'byte')} of data, expected {size}")
    message_type = unescape(message_type)
    # publish_time equals log_time where the sender set no stamp; the message itself shows whether it is a coincidence
    stamped = publish_ns != log_ns or source_sec or source_nanosec
    return Entry(
        seq,
        log_ns,
        Kind.IGTL_OUT if direction else Kind.IGTL_IN,
        f"{message_type}/{unescape(device)}",
        message_type,
        (view[at:],),
        links,
        publish_ns if stamped else 0,
    )


class RawUnpacker:
    """:func:`unpack_raw` for the messages of one channel: fields that the last message had as well are not parsed."""

    def __init__(self) -> None:
        self._same = b""  # links, type and device name, as the last message had them
        self._head = _RAW_START  # all before the payload
        self._channel = self._type = ""
        self._links: tuple[int, ...] = ()

    def __call__(self, data: bytes | memoryview, seq: int, log_ns: int, publish_ns: int, begin: int, end: int) -> Entry:
        """The entry in the bytes of ``data`` from ``begin`` to ``end``; its payload is a part of them.

        Other arguments and errors as of :func:`unpack_raw`.
        """
        if not self._same or end - begin < self._head.size:
            return self._parse(data[begin:end], seq, log_ns, publish_ns)
        encapsulation, source_sec, source_nanosec, direction, same, size = self._head.unpack_from(data, begin)
        payload = begin + self._head.size
        if same != self._same or encapsulation != _CDR_LE_NUMBER or payload + size != end:
            return self._parse(data[begin:end], seq, log_ns, publish_ns)
        return Entry(
            seq,
            log_ns,
            Kind.IGTL_OUT if direction else Kind.IGTL_IN,
            self._channel,
            self._type,
            (data[payload:end],),
            self._links,
            publish_ns if publish_ns != log_ns or source_sec or source_nanosec else 0,
        )

    def _parse(self, data: bytes | memoryview, seq: int, log_ns: int, publish_ns: int) -> Entry:
        entry = unpack_raw(data, seq, log_ns, publish_ns)
        self._channel, self._type, self._links = entry.channel, entry.type, entry.links
        self._same = raw_head(data, entry)
        self._head = struct.Struct(f"{_RAW_START.format}{len(self._same)}sI")
        return entry


def raw_head(data: Buffer, entry: Entry) -> bytes:
    """The links, type and device name in the RawMessage of an entry, with the padding behind them."""
    return bytes(memoryview(data)[_RAW_HEAD.size : len(data) - entry.size - _U32.size])


def unpack_note(data: Buffer, seq: int, log_ns: int) -> Entry:
    """The entry in a Note message (arguments as of :func:`unpack_raw`).  Raises LayoutError."""
    view = memoryview(data)
    try:
        encapsulation, _, _, level = _NOTE_HEAD.unpack_from(view)
        _check_encapsulation(encapsulation)
        kind_name, at = _get_string(view, _NOTE_HEAD.size)
        code, at = _get_string(view, at)
        text, at = _get_string(view, at)
        stream, at = _get_string(view, at)
        links, at = _get_links(view, at)
        facts = parse_json(_get_string(view, at)[0], "facts")
        kind = Kind(kind_name)
        if isinstance(facts, str):
            payload = facts.encode("utf-8", "surrogateescape")
        else:
            payload = Note(Level(level), unescape(code), unescape(text), unescape(stream), facts).pack()
    except (struct.error, ValueError, RecursionError, DamagedRecording) as error:
        raise LayoutError(f"Note of {counted(view.nbytes, 'byte')}: {error}") from None
    if kind not in NOTE_KINDS:
        raise LayoutError(f"Note: found kind {kind_name!r}, expected one of {[each.value for each in NOTE_KINDS]}")
    return Entry(seq, log_ns, kind, payload=(payload,), links=links)


def _named(entry: Entry) -> str:
    return f"entry {entry.seq} ({entry.kind.value})"


class RawPacker:
    """:func:`pack_message` for the OpenIGTLink messages of one stream to or from the same links, without the payload.

    Args:
        entry: one of them.

    Raises LayoutError for an entry whose fields contradict its kind.
    """

    def __init__(self, entry: Entry) -> None:
        texts = _packed_texts(entry.type, device_name(entry))
        try:
            same = struct.pack(f"<I{len(entry.links)}I", len(entry.links), *entry.links) + texts
        except struct.error as error:
            raise LayoutError(f"{_named(entry)}: {error}") from None
        self._same = same
        self._pack = struct.Struct(f"{_RAW_HEAD.format}{len(same)}sI").pack
        self._is_out = entry.kind is Kind.IGTL_OUT

    @property
    def common(self) -> tuple[int, bytes]:
        """What all have in common: the direction, and the head from the links to the device name."""
        return int(self._is_out), self._same

    def head(self, entry: Entry, data: Buffer) -> bytes:
        """All before the payload, which is ``data``, in one piece.  Raises LayoutError."""
        sec, nanosec = divmod(entry.stamp_ns, NS_PER_S)
        source_sec, source_nanosec = divmod(entry.source_ns, NS_PER_S)
        size = len(data)
        ticks = U64.unpack_from(data, TICKS_AT)[0] if size >= BODY_SIZE_AT else 0
        try:
            return self._pack(
                _CDR_LE,
                # as ns_to_ros, but with one division
                sec if sec <= _MAX_SEC else ns_to_ros(entry.stamp_ns)[0],
                nanosec,
                source_sec if source_sec <= _MAX_SEC else ns_to_ros(entry.source_ns)[0],
                source_nanosec,
                ticks,
                self._is_out,
                self._same,
                size,
            )
        except struct.error as error:
            raise LayoutError(f"{_named(entry)}: {error}") from None


def _packed_texts(*texts: str) -> bytes:
    """Strings as they follow each other at an aligned offset; the end is aligned, too."""
    out = bytearray()
    for text in texts:
        _put_string(out, escape(text))
    _align(out)
    return bytes(out)


def _pack_note(entry: Entry) -> bytes:
    if entry.channel or entry.type:
        raise LayoutError(f"{_named(entry)}: found channel {entry.channel!r}, type {entry.type!r}, expected neither")
    payload = entry.data()
    note, canonical = _note_of(payload)
    out = bytearray(_NOTE_HEAD.pack(_CDR_LE, *ns_to_ros(entry.stamp_ns), note.level))
    _put_string(out, entry.kind.value)
    for text in (note.code, note.text, note.stream):
        _put_string(out, escape(text))
    _put_links(out, entry.links)
    # ASCII, so that no undecodable byte of a peer enters the file
    facts = note.data if canonical else payload.decode("utf-8", "surrogateescape")
    _put_string(out, json.dumps(facts, sort_keys=True, separators=(",", ":")))
    return bytes(out)


def _note_of(payload: bytes) -> tuple[Note, bool]:
    """The note in a payload, and whether packing its fields gives the same bytes again."""
    try:
        note = Note.unpack(payload)
        return note, note.pack() == payload
    except (ValueError, RecursionError):
        return UNREADABLE, False


# --- CDR -------------------------------------------------------------------------------------------------------


def _check_encapsulation(found: bytes) -> None:
    if found[:2] != _CDR_LE[:2]:
        raise LayoutError(f"found encapsulation {found.hex()}, expected {_CDR_LE.hex()} (CDR, little-endian)")


def _align(out: bytearray) -> None:
    """Pad to the next multiple of 4: behind their heads, the messages need no wider alignment."""
    out += bytes(-len(out) % 4)


def _put_string(out: bytearray, text: str) -> None:
    data = text.encode()
    _align(out)
    out += _U32.pack(len(data) + 1)
    out += data
    out.append(0)


def _put_links(out: bytearray, links: tuple[int, ...]) -> None:
    _align(out)
    out += struct.pack(f"<I{len(links)}I", len(links), *links)


def _get_u32(view: memoryview, at: int) -> tuple[int, int]:
    at += -at % 4
    return int(_U32.unpack_from(view, at)[0]), at + 4


def _get_string(view: memoryview, at: int) -> tuple[str, int]:
    size, at = _get_u32(view, at)
    data = bytes(view[at : at + size])
    if len(data) != size or not data.endswith(b"\0"):
        raise LayoutError(
            f"offset {at}: found {data[:40]!r}, expected a string of {counted(size, 'byte')} with its NUL"
        )
    return data[:-1].decode(), at + size


def _get_links(view: memoryview, at: int) -> tuple[tuple[int, ...], int]:
    count, at = _get_u32(view, at)
    if 4 * count > view.nbytes - at:
        raise LayoutError(
            f"offset {at}: found {counted(view.nbytes - at, 'byte')}, expected {count_text(count, 'link')}"
        )
    return struct.unpack_from(f"<{count}I", view, at), at + 4 * count
