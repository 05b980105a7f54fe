"""How entries are laid out in a session file: topics, message types, metadata.  No file is touched here.

``docs/session-log.md`` is the specification of what is written down here, and :data:`FORMAT_VERSION` its number.
Recorder and reader meet only in this module.

Every channel of the file is CDR with a ``ros2msg`` definition, because one channel of another encoding makes
``ros2 bag play`` and rosbags refuse the whole file.  So OpenIGTLink bytes travel in a message of our own,
``igtl_msgs/msg/RawMessage``, and notes in ``igtl_msgs/msg/Note``.  Both are packed here by hand: the head is
a few dozen bytes, and the payload must not be copied on the way.

Text from a peer may be anything, but a ROS string has to be UTF-8 without NUL.  :func:`escape` makes it so, and
reversibly: an entry read back equals the entry written.
"""

from __future__ import annotations

import json
import re
import struct
import zlib

from igtl_gateway.buffers import Buffer
from igtl_gateway.errors import DamagedRecording
from igtl_gateway.qos import Qos
from igtl_gateway.session.entry import Entry, Kind
from igtl_gateway.session.note import UNREADABLE, Level, Note
from igtl_gateway.stamp import NS_PER_S, ns_to_ros
from igtl_gateway.untrusted.text import parse_json
from igtl_gateway.wire.header import BODY_SIZE_AT, TICKS_AT, U64

#: Version of ``docs/session-log.md``; a reader refuses a file with a newer one.
FORMAT_VERSION = 1

MCAP_PROFILE = "ros2"
MESSAGE_ENCODING = "cdr"
SCHEMA_ENCODING = "ros2msg"

SESSION_METADATA = "igtl_gateway.session"
#: The same once more: without it a recording cannot be verified.
SESSION_COPY_METADATA = "igtl_gateway.session_copy"
LEDGER_METADATA = "igtl_gateway.ledger"
CONFIGURATION_ATTACHMENT = "configuration.json"
#: Inputs before the first entry: an MCAP file of this layout within the file.
PROLOGUE_ATTACHMENT = "prologue.mcap"
#: Keys of the session metadata of a part of a split recording: its number, from 0, and the file before it.
PART_KEY, PREVIOUS_KEY = "part", "previous_part"
#: Key of the session metadata of a snapshot: how many seconds it was to hold.
SNAPSHOT_KEY = "snapshot_seconds"
#: Keys of the session metadata where streams were chosen: globs, a JSON array.
INCLUDE_KEY, EXCLUDE_KEY = "record_include", "record_exclude"
#: Key of the session metadata for what the user has to say: a JSON object of texts.
CUSTOM_KEY = "custom_data"
#: Key of the session metadata that is repeated in the attachment.
CONFIGURATION_KEY = "config"
FORMAT_VERSION_KEY = "format_version"
#: Metadata records have no CRC in MCAP, so each of ours carries one over its other items.
CHECKSUM_KEY = "crc32"
LEDGER_KEY = "ledger"
#: Key of the ledger of a recording that was closed because the bridge was gone: its last outputs may be missing.
CUT_OFF_KEY = "cut_off"

#: Keys of the channel metadata.  The first two are rosbag2's.
QOS_KEY = "offered_qos_profiles"
TYPE_HASH_KEY = "topic_type_hash"
#: The kind of the channel's entries, as the value of Kind.  A topic has one channel for each kind.
KIND_KEY = "igtl_gateway.kind"
#: ``TYPE/device name`` of an OpenIGTLink channel, escaped; absent on the one that many streams share.
STREAM_KEY = "igtl_gateway.stream"

WIRE_TOPICS = {Kind.IGTL_IN: "/igtl_gateway/wire/in", Kind.IGTL_OUT: "/igtl_gateway/wire/out"}
NOTES_TOPIC = "/igtl_gateway/notes"
#: Topic token of a device without a name, and of the streams beyond MAX_WIRE_STREAMS.
UNNAMED = "unnamed"
OTHER = "other"
SHARED_TOPICS = frozenset(f"{root}/{OTHER}" for root in WIRE_TOPICS.values())
#: A channel costs about 2 kB in the file and in every reader, and MCAP has 65,535 of them.  A session has some
#: dozens of streams; a peer that invents names must not make a file that nothing opens.
MAX_WIRE_STREAMS = 500

RAW_MESSAGE_TYPE = "igtl_msgs/msg/RawMessage"
NOTE_TYPE = "igtl_msgs/msg/Note"

#: Our own message types: name → text of the .msg file.
OWN_TYPES = {
    RAW_MESSAGE_TYPE: """\
# One OpenIGTLink message, as its bytes crossed the gateway's border.
uint8 DIRECTION_IN=0
uint8 DIRECTION_OUT=1
builtin_interfaces/Time stamp  # gateway time
builtin_interfaces/Time source_stamp  # the sender's own stamp, 0 = unset
uint64 source_ticks  # the same, as in the header: 32.32 fixed point seconds
uint8 direction
uint32[] links  # numbers of the links that it came from or went to
string type
string device_name
uint8[] data  # header and body
""",
    NOTE_TYPE: """\
# What happened besides messages: links, drops, refusals, errors.
builtin_interfaces/Time stamp  # gateway time
uint8 level  # as in rcl_interfaces/Log: 20 info, 30 warning, 40 error
string kind  # link, edge_note (inputs), note (output)
string code  # stable name for programs
string text  # one sentence for people
string stream  # the stream concerned, or empty
uint32[] links  # numbers of the links concerned
string data  # further facts, JSON
""",
}

NOTE_KINDS = frozenset({Kind.LINK, Kind.EDGE_NOTE, Kind.NOTE})
ROS_KINDS = frozenset({Kind.ROS_IN, Kind.ROS_OUT})

_CDR_LE = b"\x00\x01\x00\x00"
_CDR_LE_NUMBER = int.from_bytes(_CDR_LE[:2], "little")
# The fixed heads of the messages behind this encapsulation.  Alignment counts from its end; as it has 4 bytes
# and nothing behind the heads is aligned to more than 4, offsets in the whole buffer do as well.
_RAW_HEAD = struct.Struct("<4s iI iI Q B3x")  # stamp, source_stamp, source_ticks, direction
_RAW_START = struct.Struct("<H10xiI8xB3x")  # the same: first half of the encapsulation, source_stamp, direction
_NOTE_HEAD = struct.Struct("<4s iI B3x")  # stamp, level
_U32 = struct.Struct("<I")
_MAX_SEC = (1 << 31) - 1


def type_of(kind: Kind) -> str:
    """Message type in the file of the entries of a kind; ``""`` where they have their own (ROS messages)."""
    if kind in WIRE_TOPICS:
        return RAW_MESSAGE_TYPE
    return NOTE_TYPE if kind in NOTE_KINDS else ""


class LayoutError(ValueError):
    """Bytes that are not laid out as this module says, or an entry that it cannot lay out."""


# --- text ------------------------------------------------------------------------------------------------------

_TO_ESCAPE = re.compile("[\\\\\x00\ud800-\udfff]")
_ESCAPED = re.compile(r"\\(?:u([0-9a-f]{4})|(\\))")


def escape(text: str) -> str:
    """``text`` without NUL and lone surrogates (undecodable bytes): these, and the backslash, are escaped."""
    if not _TO_ESCAPE.search(text):
        return text
    return _TO_ESCAPE.sub(lambda found: "\\\\" if found[0] == "\\" else f"\\u{ord(found[0]):04x}", text)


def unescape(text: str) -> str:
    """The inverse of :func:`escape`."""
    if "\\" not in text:
        return text
    return _ESCAPED.sub(lambda found: found[2] or chr(int(found[1], 16)), text)


# --- topics ----------------------------------------------------------------------------------------------------


def topic_token(name: str) -> str:
    """``name`` as one token of a ROS 2 topic name: letters, digits, single underscores, no digit first."""
    token = re.sub(r"[^A-Za-z0-9]+", "_", name).strip("_")
    if not token:
        return UNNAMED
    return f"_{token}" if token[0].isdigit() else token


class WireTopics:
    """Gives each OpenIGTLink stream of a session its topic; the same streams in the same order get the same."""

    def __init__(self) -> None:
        self._topics: dict[tuple[Kind, str], str] = {}
        self._taken: set[str] = set()
        self._counts = dict.fromkeys(WIRE_TOPICS, 0)

    def topic(self, kind: Kind, message_type: str, device_name: str) -> str:
        """Topic of a stream; ``…/other`` for those beyond :data:`MAX_WIRE_STREAMS` of one direction."""
        key = (kind, f"{message_type}/{device_name}")
        if key in self._topics:
            return self._topics[key]
        if self._counts[kind] >= MAX_WIRE_STREAMS:
            return f"{WIRE_TOPICS[kind]}/{OTHER}"
        self._counts[kind] += 1
        wanted = f"{WIRE_TOPICS[kind]}/{topic_token(message_type).lower()}/{topic_token(device_name)}"
        topic, number = wanted, 1
        # ROS takes topics as distinct by case, but tools that make files of them may not
        while topic.lower() in self._taken:
            number += 1
            topic = f"{wanted}_{number}"
        self._taken.add(topic.lower())
        self._topics[key] = topic
        return topic


# --- quality of service ----------------------------------------------------------------------------------------

# What rosbag2 writes for "infinite" and for "as the middleware likes"
_QOS_TEMPLATE = """\
- history: keep_last
  depth: {depth}
  reliability: {reliability}
  durability: {durability}
  deadline:
    sec: 9223372036
    nsec: 854775807
  lifespan:
    sec: 9223372036
    nsec: 854775807
  liveliness: automatic
  liveliness_lease_duration:
    sec: 9223372036
    nsec: 854775807
  avoid_ros_namespace_conventions: false
"""


def qos_yaml(qos: Qos) -> str:
    """``qos`` as rosbag2 (Jazzy) writes it into the channel metadata."""
    return _QOS_TEMPLATE.format(
        depth=qos.depth,
        reliability="reliable" if qos.reliable else "best_effort",
        durability="transient_local" if qos.latched else "volatile",
    )


def parse_qos_yaml(text: str) -> Qos | None:
    """First profile in what rosbag2 wrote: names (Jazzy and later) or rmw's numbers (before); None if there is none."""
    fields: dict[str, str] = {}
    for name, value in re.findall(r"^[ -]*(depth|reliability|durability)\s*:\s*(\w+)", text, re.MULTILINE):
        fields.setdefault(name, value)
    if len(fields) != 3:
        return None
    depth = int(fields["depth"]) if fields["depth"].isascii() and fields["depth"].isdigit() else 0
    return Qos(
        depth=depth or Qos().depth,
        reliable=fields["reliability"] not in ("best_effort", "2"),
        latched=fields["durability"] in ("transient_local", "1"),
    )


# --- metadata --------------------------------------------------------------------------------------------------


def seal(items: dict[str, str]) -> dict[str, str]:
    """``items`` and their checksum, as they go into a metadata record (undecodable bytes of a shell made visible)."""
    clean = {key: value.encode("utf-8", "backslashreplace").decode() for key, value in items.items()}
    return {**clean, CHECKSUM_KEY: _checksum(clean)}


def unseal(items: dict[str, str]) -> dict[str, str]:
    """The items without their checksum.  Raises LayoutError if it is missing or wrong."""
    rest = {key: value for key, value in items.items() if key != CHECKSUM_KEY}
    found, expected = items.get(CHECKSUM_KEY, "none"), _checksum(rest)
    if found != expected:
        raise LayoutError(f"metadata: checksum {found}, expected {expected}")
    return rest


def _checksum(items: dict[str, str]) -> str:
    return f"{zlib.crc32(json.dumps(sorted(items.items())).encode()):08x}"


# --- messages --------------------------------------------------------------------------------------------------


def pack_message(entry: Entry) -> bytes:
    """The CDR message of an entry: one copy of the payload, or none where it is one ``bytes`` of a ROS message.

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
        raise LayoutError(f"RawMessage of {view.nbytes} bytes: {error}") from None
    if at + size != view.nbytes:
        raise LayoutError(f"RawMessage: found {view.nbytes - at} bytes of data, expected {size}")
    message_type = unescape(message_type)
    # publish_time equals log_time where the sender set no stamp; the message itself tells that from a coincidence
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
    """:func:`unpack_raw` for the messages of one channel: what the last one said again is not read again."""

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
            return self._learn(data[begin:end], seq, log_ns, publish_ns)
        encapsulation, source_sec, source_nanosec, direction, same, size = self._head.unpack_from(data, begin)
        payload = begin + self._head.size
        if same != self._same or encapsulation != _CDR_LE_NUMBER or payload + size != end:
            return self._learn(data[begin:end], seq, log_ns, publish_ns)
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

    def _learn(self, data: bytes | memoryview, seq: int, log_ns: int, publish_ns: int) -> Entry:
        entry = unpack_raw(data, seq, log_ns, publish_ns)
        self._channel, self._type, self._links = entry.channel, entry.type, entry.links
        self._same = bytes(data[_RAW_HEAD.size : len(data) - entry.size - _U32.size])
        self._head = struct.Struct(f"{_RAW_START.format}{len(self._same)}sI")
        return entry


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
        raise LayoutError(f"Note of {view.nbytes} bytes: {error}") from None
    if kind not in NOTE_KINDS:
        raise LayoutError(f"Note: found kind {kind_name!r}, expected one of {[each.value for each in NOTE_KINDS]}")
    return Entry(seq, log_ns, kind, payload=(payload,), links=links)


def _named(entry: Entry) -> str:
    return f"entry {entry.seq} ({entry.kind.value})"


class RawPacker:
    """:func:`pack_message` for the OpenIGTLink messages of one stream to or from the same links, without the payload.

    Args: ``entry``: one of them.  Raises LayoutError for one that contradicts its kind.
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
    # ASCII, so that no undecodable byte of a peer gets into the file
    facts = note.data if canonical else payload.decode("utf-8", "surrogateescape")
    _put_string(out, json.dumps(facts, sort_keys=True, separators=(",", ":")))
    return bytes(out)


def _note_of(payload: bytes) -> tuple[Note, bool]:
    """The note in a payload, and whether its fields give the very same bytes again."""
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
    """Pad to the next multiple of 4, which is all that our messages need behind their heads."""
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
        raise LayoutError(f"offset {at}: found {data[:40]!r}, expected a string of {size} bytes with its NUL")
    return data[:-1].decode(), at + size


def _get_links(view: memoryview, at: int) -> tuple[tuple[int, ...], int]:
    count, at = _get_u32(view, at)
    if 4 * count > view.nbytes - at:
        raise LayoutError(f"offset {at}: found {view.nbytes - at} bytes, expected {count} links")
    return struct.unpack_from(f"<{count}I", view, at), at + 4 * count
