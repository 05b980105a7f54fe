"""When large messages pass: a burst waits for the recorder, but only for one that comes on, and for a limited time."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import pytest

from igtl_gateway.base.clock import ManualClock
from igtl_gateway.base.stamp import NS_PER_S
from igtl_gateway.gateway.log.note import Note
from igtl_gateway.record.admission import HOLD_NS, WAITS, Admission

MOST = 1000


class World:
    """An admission on manual time, and a recorder that takes what the test sets."""

    def __init__(self) -> None:
        self.clock = ManualClock()
        self.notes: list[Note] = []
        self.wakes = 0
        self.queue = SimpleNamespace(waiting=(0, 0), max_large_bytes=MOST, done_bytes=0)
        self.recorder: Any = cast(Any, SimpleNamespace(queue=self.queue, is_taking=True, wake=self._wake))
        self.admission = Admission(self.clock, self.notes.append)
        self.admission.recorder = self.recorder

    def _wake(self) -> None:
        self.wakes += 1

    def waiting(self, size: int) -> None:
        self.queue.waiting = (1, size)

    def passes(self, size: int) -> bool:
        """A message that is in the queue at once, if it passes."""
        passed = self.admission.admit(size)
        if passed:
            self.admission.leave(size)
        return passed


@pytest.fixture
def world() -> World:
    return World()


def test_what_has_room_passes_and_what_has_none_waits(world: World) -> None:
    world.waiting(400)
    assert world.passes(600)
    assert not world.passes(601) and world.wakes == 1
    world.waiting(0)
    assert world.passes(10 * MOST)


def test_messages_that_pass_at_one_time_share_the_room(world: World) -> None:
    assert world.admission.admit(10 * MOST)
    assert not world.admission.admit(1)
    world.admission.leave(10 * MOST)
    world.admission.enter(900)
    assert not world.admission.admit(200)
    world.admission.leave(900)
    assert world.admission.admit(200)


def test_a_message_beside_another_leaves_room_for_the_outputs_of_both(world: World) -> None:
    assert world.admission.admit(300)
    assert not world.admission.admit(300), "both and their outputs are more than there is room for"
    world.waiting(600)
    world.admission.leave(300)
    assert world.admission.admit(300)
    world.admission.leave(300)
    world.waiting(50)
    assert world.admission.admit(100)
    assert world.admission.admit(100) and not world.admission.admit(1)


def test_without_a_recorder_or_with_one_that_does_not_come_on_nothing_waits(world: World) -> None:
    world.waiting(MOST)
    assert not world.passes(100)
    world.recorder.is_taking = False
    assert world.passes(100)
    world.admission.recorder = None
    assert world.passes(100)


def test_after_a_while_the_live_side_goes_first_until_the_recorder_has_caught_up(world: World) -> None:
    world.waiting(MOST)
    assert not world.passes(100)
    world.clock.advance(HOLD_NS - 1)
    assert not world.passes(100)
    world.clock.advance(1)
    assert world.passes(100)
    world.waiting(MOST // 2)
    assert world.passes(MOST)
    world.waiting(MOST // 4)
    assert world.passes(100)
    world.waiting(MOST)
    assert not world.passes(100)


def test_one_note_an_episode_with_the_rate(world: World) -> None:
    world.waiting(MOST)
    assert not world.passes(100) and not world.notes
    world.clock.advance(2 * NS_PER_S)
    world.queue.done_bytes = 50_000_000
    assert not world.passes(100) and not world.passes(100)
    (note,) = world.notes
    assert note.code == WAITS and note.data == {"mb_per_s": 25.0} and "(25.0 MB/s)" in note.text
    world.waiting(0)
    assert world.passes(100)
    world.waiting(MOST)
    assert not world.passes(100)
    world.clock.advance(2 * NS_PER_S)
    assert not world.passes(100)
    assert len(world.notes) == 2
