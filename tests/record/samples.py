"""Entries for tests: a session with every kind, and a Hypothesis strategy for any session."""

from __future__ import annotations

import struct
from collections.abc import Iterable, Sequence
from pathlib import Path

from hypothesis import strategies as st
from rosbags.typesys import Stores, get_typestore

from igtl_gateway.base.buffers import Buffer
from igtl_gateway.base.stamp import ns_to_ticks, ticks_to_ns
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.note import Level, Note
from igtl_gateway.record.sessionfile.writer import SessionWriter

START_NS = 1_700_000_000_000_000_000
SESSION = {"config": '{"base_frame":"world"}', "host": "theatre-2"}

_STORE = get_typestore(Stores.ROS2_JAZZY)


def igtl_bytes(message_type: str, device: str, stamp_ns: int = 0, body: bytes = b"") -> bytes:
    """An OpenIGTLink message (its CRC is left 0: the recording does not look at it)."""
    head = struct.pack(">H12s20sQQQ", 1, message_type.encode(), device.encode(), ns_to_ticks(stamp_ns), len(body), 0)
    return head + body


def string_cdr(text: str) -> bytes:
    """A std_msgs/String."""
    return bytes(_STORE.serialize_cdr(_STORE.types["std_msgs/msg/String"](data=text), "std_msgs/msg/String"))


def igtl(
    seq: int,
    kind: Kind = Kind.IGTL_IN,
    *,
    message_type: str = "TRANSFORM",
    device: str = "ProbeToTracker",
    body: bytes = bytes(48),
    links: tuple[int, ...] = (1,),
    source_ns: int = 0,
) -> Entry:
    """An OpenIGTLink entry; ``source_ns`` becomes what the header can hold of it."""
    data = igtl_bytes(message_type, device, source_ns, body)
    source_ns = ticks_to_ns(ns_to_ticks(source_ns))
    return Entry(seq, START_NS + seq, kind, f"{message_type}/{device}", message_type, (data,), links, source_ns)


def ros(seq: int, kind: Kind = Kind.ROS_IN, *, topic: str = "/chatter", text: str = "hello") -> Entry:
    """A std_msgs/String entry."""
    return Entry(seq, START_NS + seq, kind, topic, "std_msgs/msg/String", (string_cdr(text),), (), START_NS - 5)


def note(
    seq: int, kind: Kind = Kind.NOTE, *, code: str = "bad_crc", text: str = "a fact", links: tuple[int, ...] = (1,)
) -> Entry:
    """A note entry."""
    given = Note(Level.WARN, code, text, "IMAGE/probe", {"found": "0x1", "expected": [1, 2.5, None]})
    return Entry(seq, START_NS + seq, kind, payload=(given.pack(),), links=links)


def every_kind(repeats: int = 1) -> list[Entry]:
    """A session in which every kind of entry occurs, ``repeats`` times over."""
    entries: list[Entry] = []
    for _ in range(repeats):
        at = len(entries)
        entries += [
            note(at + 1, Kind.LINK, code="link_up"),
            igtl(at + 2, source_ns=START_NS - 1_000_000),
            ros(at + 3, Kind.ROS_OUT, topic="/igtl/probe"),
            ros(at + 4, text=f"message {at}"),
            igtl(at + 5, Kind.IGTL_OUT, message_type="STRING", device="chatter", body=b"\0\3\0\5hello", links=(1, 2)),
            note(at + 6, Kind.EDGE_NOTE, code="queue_drop"),
            note(at + 7, Kind.NOTE),
        ]
    return entries


def write(path: Path, entries: Iterable[Entry], session: dict[str, str] = SESSION) -> Path:
    """A closed session file."""
    writer = SessionWriter(path, session)
    for entry in entries:
        writer.write(entry)
    writer.close({"streams": {}})
    return path


def flat(entry: Entry) -> Entry:
    """The entry with its payload as one ``bytes``, as a reader gives it."""
    return Entry(
        entry.seq, entry.stamp_ns, entry.kind, entry.channel, entry.type, (entry.data(),), entry.links, entry.source_ns
    )


# Any string that a peer can produce: invalid UTF-8 becomes surrogates, NUL and backslashes can occur
_TEXT = st.one_of(
    st.text(max_size=20),
    st.binary(max_size=20).map(lambda data: data.decode("utf-8", "surrogateescape")),
    st.sampled_from(["", "a-b", "a_b", "\\u0000", "\\", "a\0b", "1st", "wire/in"]),
)
_JSON = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**53), 2**53) | st.floats(allow_nan=False) | _TEXT,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(_TEXT, inner, max_size=3),
    max_leaves=5,
)
_NOTES = st.one_of(
    st.builds(
        Note, st.sampled_from(Level), _TEXT, _TEXT, _TEXT, st.dictionaries(st.text(max_size=5), _JSON, max_size=3)
    ).map(Note.pack),
    # not as a note is packed, or no note at all
    st.sampled_from([b"{}", b"", b"[1]", b'"text"', b"\xff\x00", b'{ "level": "INFO" }', b"\\"]),
    st.binary(max_size=30),
)
_TIMES = st.integers(0, 2**63 - 1)


@st.composite
def _buffers(draw: st.DrawFn) -> Sequence[Buffer]:
    """Payload in one piece or several, of any buffer type."""
    wraps = (bytes, bytearray, memoryview)
    return tuple(draw(st.sampled_from(wraps))(part) for part in draw(st.lists(st.binary(max_size=60), max_size=4)))


@st.composite
def sessions(draw: st.DrawFn, max_size: int = 12) -> list[Entry]:
    """Any session: numbers and stamps increase, everything else is free within the contract of Entry."""
    # the first number of a file has to fit in MCAP's 32 bits (docs/reference/session-log.md)
    seq, stamp_ns = draw(st.integers(0, 2**32 - 1001)), draw(st.integers(0, 2**62))
    entries = []
    for _ in range(draw(st.integers(0, max_size))):
        seq += draw(st.integers(1, 1000))
        stamp_ns += draw(st.integers(1, 10**12))
        kind = draw(st.sampled_from(Kind))
        # a sender's stamp that equals ours means "unset" for all but OpenIGTLink (docs/reference/session-log.md)
        source_ns = draw(_TIMES)
        source_ns += source_ns == stamp_ns
        links = tuple(draw(st.lists(st.integers(0, 2**32 - 1), max_size=3)))
        if kind in (Kind.IGTL_IN, Kind.IGTL_OUT):
            message_type = draw(_TEXT)
            channel = f"{message_type}/{draw(_TEXT)}"
            entry = Entry(seq, stamp_ns, kind, channel, message_type, draw(_buffers()), links, source_ns)
        elif kind in (Kind.ROS_IN, Kind.ROS_OUT):
            ros_type = draw(st.sampled_from(["std_msgs/msg/String", "sensor_msgs/msg/Image", "unheard_of/msg/Thing"]))
            topic = draw(st.sampled_from(["/a", "/b/c"]))
            entry = Entry(seq, stamp_ns, kind, topic, ros_type, draw(_buffers()), (), source_ns)
        else:
            entry = Entry(seq, stamp_ns, kind, payload=(draw(_NOTES),), links=links)
        entries.append(entry)
    return entries
