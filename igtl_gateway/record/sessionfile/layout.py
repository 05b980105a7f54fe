"""How entries are laid out in a session file: topics, channels, message types, metadata.  This module opens no file.

``docs/reference/session-log.md`` is the specification of what is written down here and in ``messages``, and
:data:`FORMAT_VERSION` its number.  Recorder and reader meet only in these two modules.

Every channel of the file is CDR with a ``ros2msg`` definition, because one channel of another encoding makes
``ros2 bag play`` and rosbags refuse the whole file.  So OpenIGTLink bytes travel in a message of our own,
``igtl_msgs/msg/RawMessage``, and notes in ``igtl_msgs/msg/Note``.

Text from a peer may be anything, but a ROS string must be UTF-8 without NUL.  :func:`escape` makes it so, reversibly:
an entry read back equals the entry written.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from typing import Any

from igtl_gateway.base.qos import Qos
from igtl_gateway.base.untrusted.numbers import whole_number
from igtl_gateway.convert.names import topic_token
from igtl_gateway.gateway.log.entry import Kind
from igtl_gateway.record.sessionfile.records import crc32

#: Version of ``docs/reference/session-log.md`` of a file with all bytes of its messages.
FORMAT_VERSION = 1
#: That of a file which may have the digest of an output in its place; its entries are those of the version before.
DIGEST_VERSION = 2
#: Versions whose entries need no step; a reader refuses a file with a newer one.
PRESENT_VERSIONS = (FORMAT_VERSION, DIGEST_VERSION)

#: Uncompressed size of a chunk: a reader has to hold it, and unpacks it for one message.
CHUNK_BYTES = 1 << 20

MCAP_PROFILE = "ros2"
MESSAGE_ENCODING = "cdr"
SCHEMA_ENCODING = "ros2msg"

SESSION_METADATA = "igtl_gateway.session"
#: A second copy of the session metadata: without them a recording cannot be verified.
SESSION_COPY_METADATA = "igtl_gateway.session_copy"
SESSION_RECORDS = (SESSION_METADATA, SESSION_COPY_METADATA)
LEDGER_METADATA = "igtl_gateway.ledger"
#: What the recorder counted of the entries of the file, see ``figures``.
FIGURES_METADATA = "igtl_gateway.figures"
#: A seal: a signed statement about the records before it, see ``sealing``.
SEAL_METADATA = "igtl_gateway.seal"
#: Attachment behind the last seal: the reply of a time-stamp authority.
TIME_STAMP_ATTACHMENT = "time-stamp.tsr"
CONFIGURATION_ATTACHMENT = "configuration.json"
#: Inputs before the first entry: an MCAP file of this layout inside the file.
PROLOGUE_ATTACHMENT = "prologue.mcap"
#: Attachments with a meaning in a session, and the beginning of the names of its metadata records.
ATTACHMENTS = frozenset({CONFIGURATION_ATTACHMENT, PROLOGUE_ATTACHMENT, TIME_STAMP_ATTACHMENT})
OWN_METADATA = "igtl_gateway."
#: The metadata record in which rosbag2 repeats its ``metadata.yaml``; it follows from the messages.
ROSBAG2_METADATA = "rosbag2"
#: Keys of the session metadata of a part of a split recording: its number, from 0, and the file before it.
PART_KEY, PREVIOUS_KEY = "part", "previous_part"
#: Key of the session metadata of a snapshot: the requested seconds.
SNAPSHOT_KEY = "snapshot_seconds"
#: Key of the session metadata of a file of the black box: the first trigger; and of its ledger: a row for each.
TRIGGER_KEY, TRIGGERS_KEY = "trigger", "triggers"
#: Keys of the session metadata where streams were selected: globs, a JSON array.
INCLUDE_KEY, EXCLUDE_KEY = "record_include", "record_exclude"
#: Key of the session metadata for keys and values of the user: a JSON object of strings.
CUSTOM_KEY = "custom_data"
#: Key of the session metadata for the configuration; the attachment repeats it.
CONFIGURATION_KEY = "config"
#: The source format of an imported session.
IMPORTED_KEY = "imported_format"
FORMAT_VERSION_KEY = "format_version"
#: Metadata records have no CRC in MCAP, so each of our own has one over its other items.
CHECKSUM_KEY = "crc32"
LEDGER_KEY = "ledger"
#: Key of the ledger of a recording that was closed because the bridge ended: its last outputs may be missing.
CUT_OFF_KEY = "cut_off"
#: Key of the ledger of a part that was closed because a next one follows.
GOES_ON_KEY = "goes_on"
#: Keys of the ledger that declare losses.
_LOSSES = ("recorder", "recovered", CUT_OFF_KEY)

#: Keys of the channel metadata.  The first two are those of rosbag2.
QOS_KEY = "offered_qos_profiles"
TYPE_HASH_KEY = "topic_type_hash"
#: The kind of the channel's entries, as the value of Kind.  A topic has one channel for each kind.
KIND_KEY = "igtl_gateway.kind"
#: ``TYPE/device name`` of an OpenIGTLink channel, escaped; absent on the channel that many streams share.
STREAM_KEY = "igtl_gateway.stream"

#: On a channel with digests: the name of the digest; topic, type and type hash of the outputs that they stand for.
DIGEST_KEY, DIGEST_TOPIC_KEY = "igtl_gateway.digest", "igtl_gateway.digest_topic"
DIGEST_TYPE_KEY, DIGEST_HASH_KEY = "igtl_gateway.digest_type", "igtl_gateway.digest_type_hash"
#: The beginning of the topics of these channels.
DIGEST_TOPIC = "/igtl_gateway/digest"

WIRE_TOPICS = {Kind.IGTL_IN: "/igtl_gateway/wire/in", Kind.IGTL_OUT: "/igtl_gateway/wire/out"}
NOTES_TOPIC = "/igtl_gateway/notes"
#: Topic token of the streams beyond MAX_WIRE_STREAMS.
OTHER = "other"
SHARED_TOPICS = frozenset(f"{root}/{OTHER}" for root in WIRE_TOPICS.values())
#: A channel costs about 2 kB in the file and in every reader, and MCAP has 65,535 of them.  A session has some
#: dozens of streams; a peer that invents names must not cause a file that no program opens.
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


def type_of(kind: Kind) -> str:
    """Message type in the file of the entries of a kind; ``""`` where they have their own (ROS messages)."""
    if kind in WIRE_TOPICS:
        return RAW_MESSAGE_TYPE
    return NOTE_TYPE if kind in NOTE_KINDS else ""


class LayoutError(ValueError):
    """Bytes that do not follow the layout, or an entry that the layout cannot hold."""


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


class WireTopics:
    """Gives each OpenIGTLink stream of a session its topic; equal streams in equal order get equal topics."""

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
        # topics in ROS differ by case, but files that tools name after them might not
        while topic.lower() in self._taken:
            number += 1
            topic = f"{wanted}_{number}"
        self._taken.add(topic.lower())
        self._topics[key] = topic
        return topic


# --- quality of service ----------------------------------------------------------------------------------------

# What rosbag2 writes for "infinite" and for "the default of the middleware"
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


#: Largest depth that DDS has; a larger one in a file counts as none.
_MOST_DEPTH = (1 << 31) - 1


def parse_qos_yaml(text: str) -> Qos | None:
    """First profile in what rosbag2 wrote: names (Jazzy and later) or rmw's numbers (before); None if there is none."""
    fields: dict[str, str] = {}
    for name, value in re.findall(r"^[ -]*(depth|reliability|durability)\s*:\s*(\w+)", text, re.MULTILINE):
        fields.setdefault(name, value)
    if len(fields) != 3:
        return None
    return Qos(
        depth=whole_number(fields["depth"], _MOST_DEPTH) or Qos().depth,
        reliable=fields["reliability"] not in ("best_effort", "2"),
        latched=fields["durability"] in ("transient_local", "1"),
    )


# --- metadata --------------------------------------------------------------------------------------------------


def seal(items: Mapping[str, str]) -> dict[str, str]:
    """``items`` and their checksum, for a metadata record; undecodable bytes of a shell become visible."""
    clean = {key: value.encode("utf-8", "backslashreplace").decode() for key, value in items.items()}
    return {**clean, CHECKSUM_KEY: _checksum(clean)}


def unseal(items: Mapping[str, str]) -> dict[str, str]:
    """The items without their checksum.  Raises LayoutError if it is missing or wrong."""
    rest = {key: value for key, value in items.items() if key != CHECKSUM_KEY}
    found, expected = items.get(CHECKSUM_KEY, "none"), _checksum(rest)
    if found != expected:
        raise LayoutError(f"metadata: checksum {found}, expected {expected}")
    return rest


def seal_ledger(ledger: Mapping[str, Any]) -> dict[str, str]:
    """The items of the metadata record of a ledger."""
    return seal({LEDGER_KEY: json.dumps(ledger, sort_keys=True)})


def _checksum(items: Mapping[str, str]) -> str:
    return f"{crc32(json.dumps(sorted(items.items())).encode()):08x}"


def declared_losses(ledger: Mapping[str, Any] | None) -> dict[str, Any]:
    """Return what the ledger of a recording declares as lost, for the ledger of a part or a copy.

    A recording without a ledger has lost its end.
    """
    return {CUT_OFF_KEY: True} if ledger is None else {key: ledger[key] for key in _LOSSES if key in ledger}
