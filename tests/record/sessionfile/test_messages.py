"""The layout: text, topics, quality of service, metadata, and CDR that an independent library reads alike."""

from __future__ import annotations

import json

import pytest
from hypothesis import given
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from igtl_gateway.base.stamp import ns_to_ticks
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.note import Level, Note
from igtl_gateway.record.sessionfile import layout, messages
from igtl_gateway.record.sessionfile.layout import LayoutError
from tests.record import samples


@pytest.fixture(scope="module")
def store() -> Typestore:
    """rosbags, knowing our types from their text."""
    store = get_typestore(Stores.ROS2_JAZZY)
    for name, text in layout.OWN_TYPES.items():
        store.register(get_types_from_msg(text, name))
    return store


@given(samples.sessions(max_size=4))
def test_messages_come_back(entries: list[Entry]) -> None:
    for entry in entries:
        data = bytes(messages.pack_message(entry))
        if entry.kind in layout.WIRE_TOPICS:
            publish_ns = entry.source_ns or entry.stamp_ns
            assert messages.unpack_raw(data, entry.seq, entry.stamp_ns, publish_ns) == samples.flat(entry)
        elif entry.kind in layout.NOTE_KINDS:
            assert messages.unpack_note(data, entry.seq, entry.stamp_ns) == samples.flat(entry)
        else:
            assert data == entry.data()


def test_rosbags_reads_a_raw_message_alike(store: Typestore) -> None:
    source_ns = 1_699_999_999_250_000_000
    entry = samples.igtl(3, Kind.IGTL_OUT, device="Größe", links=(4, 5), source_ns=source_ns)
    data = bytes(messages.pack_message(entry))
    message = store.deserialize_cdr(data, layout.RAW_MESSAGE_TYPE)
    assert (message.stamp.sec, message.stamp.nanosec) == (1_700_000_000, 3)  # type: ignore[attr-defined]
    assert (message.source_stamp.sec, message.source_stamp.nanosec) == (1_699_999_999, 250_000_000)  # type: ignore[attr-defined]
    assert message.source_ticks == ns_to_ticks(source_ns)  # type: ignore[attr-defined]
    assert message.direction == message.DIRECTION_OUT  # type: ignore[attr-defined]
    assert message.links.tolist() == [4, 5]  # type: ignore[attr-defined]
    assert (message.type, message.device_name) == ("TRANSFORM", "Größe")  # type: ignore[attr-defined]
    assert message.data.tobytes() == entry.data()  # type: ignore[attr-defined]
    assert bytes(store.serialize_cdr(message, layout.RAW_MESSAGE_TYPE)) == data


def test_rosbags_reads_a_note_alike(store: Typestore) -> None:
    entry = samples.note(9, Kind.LINK, code="link_up", links=(7,))
    data = bytes(messages.pack_message(entry))
    message = store.deserialize_cdr(data, layout.NOTE_TYPE)
    told = Note.unpack(entry.data())
    assert (message.level, message.kind, message.code) == (Level.WARN, "link", "link_up")  # type: ignore[attr-defined]
    assert (message.text, message.stream) == (told.text, told.stream)  # type: ignore[attr-defined]
    assert message.links.tolist() == [7]  # type: ignore[attr-defined]
    assert json.loads(message.data) == told.data  # type: ignore[attr-defined]
    assert bytes(store.serialize_cdr(message, layout.NOTE_TYPE)) == data


def test_an_unset_stamp_stays_unset() -> None:
    entry = samples.igtl(1)
    assert messages.unpack_raw(messages.pack_message(entry), 1, entry.stamp_ns, entry.stamp_ns).source_ns == 0


def test_a_stamp_that_equals_ours_is_kept() -> None:
    entry = Entry(1, 1_000_000_000, Kind.IGTL_IN, "STATUS/x", "STATUS", (b"",), source_ns=1_000_000_000)
    again = messages.unpack_raw(messages.pack_message(entry), 1, entry.stamp_ns, entry.stamp_ns)
    assert again.source_ns == 1_000_000_000


def test_payload_is_a_view() -> None:
    data = messages.pack_message(samples.igtl(1, body=b"body"))
    (payload,) = messages.unpack_raw(data, 1, 1, 1).payload
    assert isinstance(payload, memoryview)
    assert payload.obj is data


@pytest.mark.parametrize(
    ("entry", "words"),
    [
        (Entry(1, 1, Kind.IGTL_IN, "probe", "IMAGE"), "'probe'"),
        (Entry(1, 1, Kind.IGTL_IN, "A/b", "A", links=(-1,)), "igtl_in"),
        (Entry(1, 1, Kind.NOTE, payload=(Note(Level.INFO, "a", "b").pack(),), links=(1 << 40,)), "note"),
        (Entry(1, 1, Kind.NOTE, "/topic"), "/topic"),
        (Entry(1, 1, Kind.ROS_IN, "/a", "std_msgs/msg/String", links=(1,)), r"\(1,\)"),
    ],
    ids=[
        "channel without its type",
        "link out of range",
        "link of a note out of range",
        "note with a channel",
        "ROS with links",
    ],
)
def test_what_the_format_cannot_hold_is_refused(entry: Entry, words: str) -> None:
    with pytest.raises(LayoutError, match=words):
        messages.pack_message(entry)


@pytest.mark.parametrize("entry", [samples.igtl(1), samples.note(1)], ids=["raw", "note"])
def test_damaged_messages_raise_only_layout_errors(entry: Entry) -> None:
    data = bytes(messages.pack_message(entry))
    refused = 0
    broken = [data[:length] for length in range(len(data))]
    broken += [data[:at] + bytes([data[at] ^ flip]) + data[at + 1 :] for at in range(len(data)) for flip in (1, 0xFF)]
    for each in broken:
        try:
            if entry.kind is Kind.IGTL_IN:
                messages.unpack_raw(each, 1, 1, 1)
            else:
                messages.unpack_note(each, 1, 1)
        except LayoutError:
            refused += 1
    assert refused >= len(data)  # every cut one at least
