"""The recorder's ring against a model: every order of steps in small rings, and random orders in larger ones.

The writers are those of the bridge: Python, its C part, and the native passage.  The reader takes entries one by one,
or as rows.  ``RING_STATES=1000000 pytest -o faulthandler_timeout=0`` searches that many states of each small ring.
"""

from __future__ import annotations

import ctypes
import os
from collections import deque
from collections.abc import Sequence

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, rule, run_state_machine_as_test

from igtl_gateway.base.versions import add_note
from igtl_gateway.record.sessionfile.chunk_rows import add_rows
from igtl_gateway.record.shared_queue import QueueReader
from tests.record.native_queue import native_library
from tests.record.ring_model import ALL_ROWS, LARGE_BYTES, ONE_ROW, RingModel, Sizes, small_ring
from tests.tables import table

pytestmark = pytest.mark.skipif(add_rows is None, reason="installed without the C part")

#: States of each ring that are searched.
STATES = int(os.environ.get("RING_STATES", "800"))

Step = tuple[str, tuple[int, ...]]

#: Steps that nearly every ring has.
_TAKE: tuple[Step, ...] = (("get", ()), ("done", ()), ("rows", (ALL_ROWS,)))
_LARGE: tuple[Step, ...] = (("reserve", (0, 64)), ("fill", (0,)), ("void", (0,)))


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> ctypes.CDLL:
    return native_library(tmp_path_factory.mktemp("native"))


def search(library: ctypes.CDLL, sizes: Sizes, steps: Sequence[Step], states: int, *, compiled: bool = True) -> bool:
    """Try every step from every state that is reached; return whether these were all states."""
    with small_ring(sizes, compiled=compiled):
        model = RingModel(library, sizes)
        seen = {model.key()}
        front = deque([(model.snapshot(), tuple[Step, ...]())])
        while front and len(seen) < states:
            snapshot, path = front.popleft()
            for step in steps:
                model.restore(snapshot)
                name, arguments = step
                try:
                    getattr(model, name)(*arguments)
                    model.check()
                except Exception as error:
                    add_note(error, f"after {path}, at {step}")
                    raise
                if (key := model.key()) not in seen:
                    seen.add(key)
                    front.append((model.snapshot(), (*path, step)))
        return not front


#: Small rings, and the steps that are tried in all orders.
RINGS: dict[str, tuple[Sizes, tuple[Step, ...]]] = {
    "small entries": (
        Sizes(room=400, max_entries=3, enough=120, free=32, streams=1),
        (("put", (0, 0)), ("native", (0, 30)), *_TAKE),
    ),
    "commands": (
        Sizes(room=400, max_entries=2, enough=200, free=48, streams=1),
        (("put", (0, 0)), ("native", (0, 30)), ("command", ()), *_TAKE),
    ),
    "streams start again": (
        Sizes(room=420, max_entries=2, enough=200, free=48, streams=1),
        (("put", (0, 0)), ("put", (1, 40)), ("native", (1, 30)), *_TAKE, ("rows", (ONE_ROW,))),
    ),
    "two streams": (
        Sizes(room=800, max_entries=3, enough=200, free=48, streams=2),
        (("put", (0, 0)), ("native", (1, 0)), *_TAKE),
    ),
    "pages": (
        Sizes(room=16_000, max_entries=3, enough=0, free=1, streams=1),
        (("put", (0, 2000)), ("native", (0, 5000)), *_TAKE),
    ),
    "large entries": (
        Sizes(room=400, max_entries=3, enough=120, free=32, streams=1),
        (("put", (0, 0)), ("native", (0, 30)), *_LARGE, *_TAKE),
    ),
    "one that fills the room": (
        Sizes(room=800, max_entries=3, enough=400, free=32, streams=1),
        (("put", (0, 0)), ("native", (0, 30)), ("reserve", (1, 490)), *_LARGE[1:], *_TAKE),
    ),
    "at once": (
        Sizes(room=360, max_entries=3, enough=0, free=1, streams=1),
        (("put", (0, 0)), ("native", (0, 30)), *_LARGE, *_TAKE),
    ),
}


@pytest.mark.slow
@table("compiled", [True, False], ids=["in C", "in Python"])
@table("name", RINGS)
def test_every_order_of_steps_in_a_small_ring(library: ctypes.CDLL, name: str, compiled: bool) -> None:
    sizes, steps = RINGS[name]
    assert search(library, sizes, steps, STATES, compiled=compiled) or STATES < 1_000_000


def test_the_search_finds_rows_beyond_the_room(library: ctypes.CDLL, monkeypatch: pytest.MonkeyPatch) -> None:
    """The end of the rows that let valid pictures end a recording."""

    def rows(self: QueueReader) -> tuple[memoryview, int, int]:
        if self._position == self._head:
            self._poll()
        return self._room, self._place, self._place + self._head - self._position

    monkeypatch.setattr(QueueReader, "rows", rows)
    with pytest.raises(AssertionError):
        search(library, *RINGS["small entries"], STATES)


#: Around the sizes at which an entry is large, a page ends, and memory goes back.
_SIZES = st.sampled_from((0, 1, 30, LARGE_BYTES - 1, LARGE_BYTES, 500, 2000, 5000, 9000))
_STREAMS = st.integers(0, 3)


class Ring(RuleBasedStateMachine):
    """Random orders of all steps in a ring of some pages."""

    library: ctypes.CDLL
    sizes: Sizes
    compiled: bool

    def __init__(self) -> None:
        super().__init__()
        self._constants = small_ring(self.sizes, compiled=self.compiled)
        self._constants.__enter__()
        self.model = RingModel(self.library, self.sizes)

    def teardown(self) -> None:
        try:
            self.model.drain()
        finally:
            self._constants.__exit__(None, None, None)

    @rule(stream=_STREAMS, size=_SIZES)
    def put(self, stream: int, size: int) -> None:
        self.model.put(stream, size)

    @rule(stream=_STREAMS, size=_SIZES)
    def reserve(self, stream: int, size: int) -> None:
        self.model.reserve(stream, size)

    @rule(stream=_STREAMS, size=_SIZES)
    def native(self, stream: int, size: int) -> None:
        self.model.native(stream, size)

    @rule(index=st.integers(0, 9))
    def fill(self, index: int) -> None:
        self.model.fill(index)

    @rule(index=st.integers(0, 9))
    def void(self, index: int) -> None:
        self.model.void(index)

    @rule()
    def command(self) -> None:
        self.model.command()

    @rule()
    def get(self) -> None:
        self.model.get()

    @rule()
    def done(self) -> None:
        self.model.done()

    @rule(size=st.sampled_from((ONE_ROW, 100, ALL_ROWS)))
    def rows(self, size: int) -> None:
        self.model.rows(size)

    @rule()
    def empty(self) -> None:
        self.model.drain()

    @invariant()
    def check(self) -> None:
        self.model.check()


@pytest.mark.slow
@pytest.mark.parametrize("compiled", [True, False], ids=["in C", "in Python"])
@pytest.mark.parametrize(
    "sizes",
    [
        Sizes(room=24_000, max_bytes=20_000, enough=12_000, free=5_000, kept=8192, streams=3),
        Sizes(room=20_000, max_bytes=20_000, enough=4_000, free=1_000, kept=0, streams=1),
        Sizes(room=30_000, max_entries=8, enough=0, free=1, kept=0, streams=2),
    ],
    ids=["as in the bridge", "memory goes back", "bound of entries"],
)
def test_random_orders_of_steps(library: ctypes.CDLL, sizes: Sizes, compiled: bool) -> None:
    machine = type("ThisRing", (Ring,), {"library": library, "sizes": sizes, "compiled": compiled})
    run_state_machine_as_test(machine, settings=settings(max_examples=12, stateful_step_count=50, deadline=None))
