"""Marks of peers on manual time: their rate, their time, and what they are not."""

from __future__ import annotations

from typing import Any

import pytest

from igtl_gateway.base.stamp import NS_PER_S, ns_to_ticks
from igtl_gateway.gateway.dialogue.marking import BURST, EVERY_NS
from igtl_gateway.gateway.log.marks import MarkNote
from igtl_gateway.testing.gateway import START_NS, ManualGateway
from igtl_gateway.wire import Message
from igtl_gateway.wire.command import Command
from igtl_gateway.wire.text import String
from igtl_gateway.wire.transform import Transform


def test_a_flood_of_marks_is_refused_and_time_lets_more_pass() -> None:
    gateway = ManualGateway(mark_from=["Nurse"])
    found = [
        len(gateway.from_peer(Message("STRING", "Nurse", String(b"slip"))).notes("mark_refused")) for _ in range(120)
    ]
    assert found == BURST * [0] + 20 * [1]
    gateway.advance(3 * EVERY_NS / 1e9)
    again = [
        len(gateway.from_peer(Message("STRING", "Nurse", String(b"slip"))).notes("mark_refused")) for _ in range(5)
    ]
    assert again == [0, 0, 0, 1, 1]


def test_a_text_that_cannot_be_a_mark_is_refused_and_goes_to_ros() -> None:
    gateway = ManualGateway(mark_from=["Nurse"])
    outputs = gateway.from_peer(Message("STRING", "Nurse", String(b"two\nlines")))
    (note,) = outputs.notes("mark_refused")
    assert note.text.startswith("mark: found label 'two\\nlines', expected up to 64 printable characters")
    assert not gateway.from_peer(Message("COMMAND", "Nurse", Command(1, "Other", b"slip"))).notes("mark_refused")
    assert not ManualGateway().from_peer(Message("STRING", "Nurse", String(b"\n"))).notes("mark_refused")


def test_a_phase_that_cannot_follow_is_refused() -> None:
    gateway = ManualGateway(mark_from=["Nurse"])

    def refused(line: bytes) -> list[str]:
        outputs = gateway.from_peer(Message("STRING", "Nurse", String(line)))
        return [note.text for note in outputs.notes("mark_refused")]

    assert not refused(b"+needle")
    assert refused(b"-other")[0].startswith("mark: found the end of 'other', expected a phase that is open")


def _stamped(igtl_type: str, device: str, content: String | Command | Transform, seconds: float) -> Message:
    return Message(igtl_type, device, content, ns_to_ticks(START_NS + round(seconds * NS_PER_S)))


@pytest.mark.parametrize(
    ("peer", "pose_s", "mark_s", "ago_s", "settings"),
    [
        ("127.0.0.1:5", None, 2.0, 8.0, {}),  # this machine: its clock is known
        ("[::1]:5", None, 2.0, 8.0, {}),
        ("10.0.0.7:5", None, 2.0, 0.0, {}),  # its clock may be anything
        ("10.0.0.7:5", 9.9999, 2.0, 8.0, {}),  # its poses are of now, so its clock is known
        ("10.0.0.7:5", 7.0, 2.0, 5.0, {}),  # its clock is 3 s behind
        ("127.0.0.1:5", 7.0, 2.0, 5.0, {}),  # so it is where a tunnel ends
        ("10.0.0.7:5", 100.0, 98.0, 2.0, {}),  # 90 s ahead
        ("127.0.0.1:5", None, 10.05, 0.0, {}),  # in the future
        ("127.0.0.1:5", None, -START_NS / NS_PER_S, 0.0, {}),  # without a stamp
        ("127.0.0.1:5", None, 60 - START_NS / NS_PER_S, 0.0, {}),  # a minute after 1970
        ("127.0.0.1:5", None, 2.0, 0.0, {"stamp": "receive"}),
    ],
)
@pytest.mark.parametrize("content", [String(b"slip"), Command(1, "Mark", b"slip")])
def test_a_message_that_was_stamped_earlier_marks_that_moment(
    peer: str, pose_s: float | None, mark_s: float, ago_s: float, settings: dict[str, Any], content: String | Command
) -> None:
    gateway = ManualGateway(mark_from=["Nurse"], watch=True, **settings)
    found: list[MarkNote] = []
    gateway._gateway.on_mark = found.append
    gateway.connect(peer=peer)
    gateway.advance(10)
    for _ in range(2):
        if pose_s is not None:
            gateway.from_peer(_stamped("TRANSFORM", "Tool", Transform((1, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0)), pose_s))
        gateway.from_peer(_stamped(type(content).__name__.upper(), "Nurse", content, mark_s))
    assert [mark.ago_ns / NS_PER_S for mark in found] == pytest.approx([ago_s, ago_s], abs=1e-3)


def test_a_line_states_how_long_ago_its_moment_was() -> None:
    gateway = ManualGateway(mark_from=["Nurse"])
    found: list[MarkNote] = []
    gateway._gateway.on_mark = found.append
    gateway.from_peer(Message("STRING", "Nurse", String(b"+suture 3 @-2.5: it holds")))
    assert found == [MarkNote("suture 3", "it holds", "Nurse", "begin", 2_500_000_000)]
