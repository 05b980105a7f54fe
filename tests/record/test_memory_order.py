"""The queue on processors with weak memory (ARM): litmus tests of its hand-overs, in every order that these permit.

The model is that of AArch64 for programs without branches: the accesses of a thread may take place in each order
that fences, acquire, release, dependencies and equal places leave, and all threads see one memory.  Each test has the
order that must not be seen, and what permits it if it is left out.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import pytest


@dataclass(frozen=True)
class Access:
    """A read into ``name``, a write of ``value``, or a fence (no place).

    Attributes:
        ordered: acquire of a read, release of a write.
        needs: name of the read that decides whether this write takes place.
    """

    place: str = ""
    value: int | None = None
    name: str = ""
    ordered: bool = False
    needs: str = ""

    @property
    def is_write(self) -> bool:
        return self.value is not None


Program = Sequence[Access]


def read(place: str, name: str) -> Access:
    return Access(place, name=name)


def write(place: str, value: int, *, release: bool = False, needs: str = "") -> Access:
    return Access(place, value, ordered=release, needs=needs)


FENCE = (Access(),)


def lock(place: str) -> Program:
    """A lock that is taken and released, as a semaphore of glibc does it: acquire, then release."""
    taken = Access(place, name="", ordered=True), write(place, 1)
    return *taken, Access(place, name=""), write(place, 0, release=True)


def twice(place: str) -> Program:
    """What ``barrier`` of shared_queue.py does without the compiled fence."""
    return *lock(place), *lock(place)


def stays(first: Access, second: Access) -> bool:
    """Whether two accesses of a thread keep their order."""
    return (
        not first.place
        or not second.place
        or first.place == second.place
        or (first.ordered and not first.is_write)
        or (second.ordered and second.is_write)
        or (first.ordered and second.ordered)  # a release, then an acquire
        or bool(second.needs and first.name == second.needs)
    )


def outcomes(threads: Sequence[Program], start: Mapping[str, int]) -> set[tuple[tuple[str, int], ...]]:
    """What the named reads may have seen, in every order of all accesses."""
    programs = [tuple(program) for program in threads]
    before = [
        [frozenset(i for i in range(k) if stays(program[i], program[k])) for k in range(len(program))]
        for program in programs
    ]
    found: set[tuple[tuple[str, int], ...]] = set()
    todo = [(tuple(frozenset[int]() for _ in programs), tuple(sorted(start.items())), ())]
    seen = set(todo)
    while todo:
        done, memory, reads = todo.pop()
        if all(len(own) == len(program) for own, program in zip(done, programs, strict=True)):
            found.add(reads)
        for state in _steps(programs, before, done, memory, reads):
            if state not in seen:
                seen.add(state)
                todo.append(state)
    return found


def _steps(programs, before, done, memory, reads) -> Iterator:  # type: ignore[no-untyped-def,type-arg]
    for thread, (program, own) in enumerate(zip(programs, done, strict=True)):
        for k, access in enumerate(program):
            if k in own or not before[thread][k] <= own:
                continue
            values, known = dict(memory), dict(reads)
            if access.is_write and (not access.needs or known[access.needs]):
                values[access.place] = access.value
            elif access.name:
                known[access.name] = values.get(access.place, 0)
            after = (*done[:thread], own | {k}, *done[thread + 1 :])
            yield after, tuple(sorted(values.items())), tuple(sorted(known.items()))


#: Name → (threads with ``barrier`` in place of None, memory at the start, what must not be seen).
HAND_OVERS: dict[str, tuple[Sequence[Sequence[Access | None]], dict[str, int], dict[str, int]]] = {
    "a record, then its position": (
        ([write("record", 1), None, write("head", 1)], [read("head", "head"), None, read("record", "record")]),
        {},
        {"head": 1, "record": 0},
    ),
    "a payload, then that it is complete": (
        ([write("payload", 1), None, write("what", 1)], [read("what", "what"), None, read("payload", "payload")]),
        {},
        {"what": 1, "payload": 0},
    ),
    "the record at the beginning": (
        (
            [write("restart", 1), write("record", 1), None, write("head", 1)],
            [read("head", "head"), None, read("restart", "restart")],
        ),
        {},
        {"head": 1, "restart": 0},
    ),
    "room that is free again": (
        (
            [read("record", "record"), None, write("tail", 1)],
            [read("tail", "tail"), write("record", 2, needs="tail")],
        ),
        {"record": 1},
        {"record": 2, "tail": 1},
    ),
    "a reader that goes to sleep": (
        ([write("head", 1), None, read("bell", "bell")], [write("bell", 0), None, read("head", "head")]),
        {"bell": 1},
        {"bell": 1, "head": 0},
    ),
}


def programs(threads: Sequence[Sequence[Access | None]], barriers: Sequence[Program]) -> list[Program]:
    """The threads, each with its barrier."""
    return [
        [access for each in thread for access in ([each] if each else barrier)]
        for thread, barrier in zip(threads, barriers, strict=True)
    ]


def sees(name: str, barriers: Sequence[Program]) -> bool:
    """Whether what must not be seen can be seen."""
    threads, start, forbidden = HAND_OVERS[name]
    return tuple(sorted(forbidden.items())) in outcomes(programs(threads, barriers), start)


@pytest.mark.parametrize("name", HAND_OVERS)
def test_every_hand_over_holds_with_the_fence_and_with_two_takings_of_a_lock(name: str) -> None:
    ways = [FENCE, twice("lock 1")], [FENCE, twice("lock 2")]
    for first in ways[0]:
        for second in ways[1]:
            assert not sees(name, (first, second))


@pytest.mark.parametrize("name", HAND_OVERS)
def test_one_taking_of_a_lock_is_no_barrier(name: str) -> None:
    """What the queue had before."""
    assert sees(name, (lock("lock 1"), lock("lock 2")))


@pytest.mark.parametrize("name", [name for name in HAND_OVERS if name != "room that is free again"])
def test_no_barrier_is_left_over(name: str) -> None:
    assert all(sees(name, barriers) for barriers in ((FENCE, ()), ((), FENCE)))


def test_the_native_writer_needs_the_release_of_its_position_only() -> None:
    reader = [read("head", "head"), *FENCE, read("record", "record")]
    lost = (("head", 1), ("record", 0))
    for release, is_seen in ((True, False), (False, True)):
        writer = [write("record", 1), write("head", 1, release=release)]
        assert (lost in outcomes([writer, reader], {})) is is_seen


#: Name → (reader, the thread that looks after the queue, native writer, memory at the start, what must not be seen).
ATTENDED: dict[str, tuple[Program, Program, Program, dict[str, int], dict[str, int]]] = {
    "room that it finds for the writer": (
        [read("record", "record"), *FENCE, write("tail", 1)],
        [read("tail", "tail"), write("lock", 1, release=True, needs="tail")],
        [Access("lock", name="lock", ordered=True), write("record", 2, needs="lock")],
        {"record": 1},
        {"lock": 1, "record": 2, "tail": 1},
    ),
    "a bell that it rings for the writer": (
        [write("bell", 0), *FENCE, read("head", "head")],
        [Access("lock", name="lock", ordered=True), *FENCE, read("bell", "bell")],
        [write("head", 1), write("lock", 1, release=True)],
        {"bell": 1},
        {"bell": 1, "head": 0, "lock": 1},
    ),
}


@pytest.mark.parametrize("name", ATTENDED)
def test_the_thread_that_looks_after_the_queue_needs_the_fence_of_the_reader_and_the_lock(name: str) -> None:
    reader, attendant, writer, start, forbidden = ATTENDED[name]
    unfenced = [access for access in reader if access not in FENCE]
    unlocked = [replace(access, ordered=False) for access in writer]
    lost = tuple(sorted(forbidden.items()))
    assert lost not in outcomes([reader, attendant, writer], start)
    assert lost in outcomes([unfenced, attendant, writer], start)
    assert (lost in outcomes([reader, attendant, unlocked], start)) == (writer[0].is_write)


def test_the_model_itself() -> None:
    """Litmus tests whose results are known for AArch64: coherence, load buffering."""
    same = outcomes([[write("x", 1), write("x", 2)], [read("x", "a"), read("x", "b")]], {})
    assert (("a", 2), ("b", 1)) not in same
    buffered = outcomes([[read("x", "a"), write("y", 1)], [read("y", "b"), write("x", 1)]], {})
    assert (("a", 1), ("b", 1)) in buffered
    depends = [read("x", "a"), write("y", 1, needs="a")], [read("y", "b"), write("x", 1, needs="b")]
    assert outcomes(list(depends), {}) == {(("a", 0), ("b", 0))}
