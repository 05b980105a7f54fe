"""Marks of peers on manual time: their rate, and what they are not."""

from __future__ import annotations

from igtl_gateway.gateway.dialogue.marking import BURST, EVERY_NS
from igtl_gateway.testing.gateway import ManualGateway
from igtl_gateway.wire import Message
from igtl_gateway.wire.command import Command
from igtl_gateway.wire.text import String


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
