"""Memory is returned once, when a burst is over."""

from __future__ import annotations

import mmap
import sys

import pytest

from igtl_gateway.base.systems.memory import IdleMemory, own_bytes

MIB = 1 << 20


class Process:
    """A process whose memory the test sets; giving memory back leaves ``used``."""

    def __init__(self) -> None:
        self.own = self.used = 50 * MIB
        self.trims = self.asked = 0

    def free(self) -> int:
        self.asked += 1
        return self.own - self.used

    def give_back(self) -> None:
        self.trims += 1
        self.own = self.used

    def memory(self) -> IdleMemory:
        return IdleMemory(lambda: self.own, self.free, self.give_back)


def test_memory_of_a_burst_is_returned_once_it_is_over() -> None:
    process = Process()
    memory = process.memory()
    for grown in (500, 900, 935):
        process.own = grown * MIB
        memory.look()
    assert process.trims == 0, "it still grows"
    for _ in range(5):
        memory.look()
    assert (process.trims, process.own) == (1, 50 * MIB)
    process.own = process.used = 300 * MIB  # in use
    for _ in range(50):
        memory.look()
    assert process.trims == 2
    process.own = process.used = 60 * MIB
    memory.look()
    process.own = 200 * MIB
    for _ in range(5):
        memory.look()
    assert process.trims == 3


def test_what_was_in_use_after_a_burst_is_returned_when_it_is_free() -> None:
    """Such as the queue of a peer that stalls: the process does not grow any more when it leaves."""
    process = Process()
    memory = process.memory()
    process.own = process.used = 500 * MIB
    for _ in range(5):
        memory.look()
    process.used = 300 * MIB
    for _ in range(5):
        memory.look()
    assert process.own == 300 * MIB, "soon after a burst it is asked each time"
    for _ in range(100):
        memory.look()
    asked = process.asked
    process.used = 60 * MIB
    for _ in range(15):
        memory.look()
    assert process.own == 60 * MIB
    for _ in range(50):
        memory.look()
    assert process.asked - asked <= 5, "later now and then, at its least never"


def test_small_changes_and_other_systems_cost_nothing() -> None:
    process = Process()
    memory = process.memory()
    for step in range(20):
        process.own = (50 + step % 5) * MIB
        memory.look()
    assert process.trims == 0
    other = IdleMemory(lambda: process.own, process.free, None)
    process.own = 900 * MIB
    for _ in range(10):
        other.look()


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_own_memory_is_what_the_process_takes() -> None:
    before = own_bytes()
    # pages of its own: malloc could give what an earlier test has freed
    with mmap.mmap(-1, 100 * MIB, mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS) as block:
        for page in range(0, len(block), mmap.PAGESIZE):
            block[page] = 1
        assert 90 * MIB < own_bytes() - before < 150 * MIB
