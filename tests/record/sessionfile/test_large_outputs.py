"""Which large outputs a file has in full: those that cannot be computed from it."""

from __future__ import annotations

from hashlib import sha256

import pytest

from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.record.sessionfile.large_outputs import (
    DIGEST_BYTES,
    LARGE_BYTES,
    Causes,
    LargeOutputs,
    OutputDigest,
    pack_digest,
)
from igtl_gateway.record.sessionfile.layout import LayoutError
from igtl_gateway.record.sessionfile.messages import pack_message
from tests.tables import table

INPUT = Entry(10, 100, Kind.IGTL_IN, "IMAGE/Probe", "IMAGE", (bytes(LARGE_BYTES),), (1,))
OUTPUT = Entry(11, 101, Kind.ROS_OUT, "/probe", "sensor_msgs/msg/Image", (bytes(LARGE_BYTES + 40),))
VIDEO = Entry(11, 101, Kind.ROS_OUT, "/probe", "foxglove_msgs/msg/CompressedVideo", (bytes(LARGE_BYTES),))
ASSEMBLED = Entry(11, 101, Kind.ROS_OUT, "/probe", "igtl_msgs/msg/Volume", (bytes(4 * LARGE_BYTES),))


def follows(output: Entry = OUTPUT, cause: Entry = INPUT, place: int = 6, midway: bool = False, **facts: bool) -> bool:
    """Whether an output behind an input, before which the file has five entries, can be computed."""
    outputs = LargeOutputs("digest")
    for name, value in facts.items():
        setattr(outputs, name, value)
    causes = Causes(outputs, midway=midway)
    causes.input(cause, 5)
    return causes.follows(output, place)


def test_an_output_follows_from_the_input_before_it() -> None:
    assert follows() and follows(midway=True) and follows(lacks_parts=True)
    later = Entry(13, 103, *(getattr(OUTPUT, name) for name in ("kind", "channel", "type", "payload")))
    assert follows(later, place=8)


def test_without_an_input_there_is_nothing_to_follow_from() -> None:
    assert not Causes(LargeOutputs("digest"), midway=False).follows(OUTPUT, 0)


@table(
    "why, output, cause, facts",
    [
        ("an entry is missing", Entry(12, 102, *(Kind.ROS_OUT, "/probe", "t", OUTPUT.payload)), INPUT, {}),
        ("a query: it follows from the state", OUTPUT, Entry(10, 100, Kind.IGTL_IN, "GET_IMAGE/P", "GET_IMAGE"), {}),
        ("the queue has refused something", OUTPUT, INPUT, {"lacks_inputs": True}),
        ("a video of which earlier frames are missing", VIDEO, INPUT, {"midway": True}),
        ("a video after a pause", VIDEO, INPUT, {"lacks_parts": True}),
        ("a volume in parts", ASSEMBLED, INPUT, {"midway": True}),
    ],
)
def test_what_may_not_follow_is_written_in_full(why: str, output: Entry, cause: Entry, facts: dict[str, bool]) -> None:
    assert not follows(output, cause, **facts), why


def test_with_all_inputs_videos_and_volumes_in_parts_follow() -> None:
    assert follows(VIDEO) and follows(ASSEMBLED)


@table(
    "entry",
    [
        Entry(7, 1000, Kind.ROS_OUT, "/probe", "sensor_msgs/msg/Image", (b"abc" * 30_000,), (), 900),
        Entry(7, 1000, Kind.IGTL_OUT, "IMAGE/Größe", "IMAGE", (b"abc" * 30_000,), (1, 5), 900),
        Entry(7, 1000, Kind.IGTL_OUT, "IMAGE/", "IMAGE", (b"abc" * 30_000,), (), 0),
    ],
)
def test_a_digest_gives_the_message_of_its_output(entry: Entry) -> None:
    message = pack_digest(entry, entry.data())
    assert len(message) < 200 and sha256(entry.data()).digest() in message
    digest = OutputDigest(message, 7, 1000, entry.source_ns or 1000)
    assert digest.size == entry.size
    assert digest.is_of(entry.data())
    assert not digest.is_of(entry.data()[:-1] + b"d")
    assert not digest.is_of(entry.data()[:-1])
    assert digest.message(entry.data(), entry.kind) == pack_message(entry)


def test_a_message_of_another_size_is_no_digest() -> None:
    entry = Entry(7, 1000, Kind.IGTL_OUT, "IMAGE/P", "IMAGE", (bytes(DIGEST_BYTES + 1),))
    with pytest.raises(LayoutError, match=f"digest: found {DIGEST_BYTES + 1} bytes, expected {DIGEST_BYTES}"):
        OutputDigest(pack_message(entry), 7, 1000, 1000)
