"""Every type of contents against one list of checks: round trips, foreign bytes, sizes that lie.

What a single type has of its own is in the test file of its module.
"""

from __future__ import annotations

import json
import tracemalloc

import pytest
from hypothesis import given
from hypothesis import strategies as st

from igtl_gateway.base.buffers import join, total_size
from igtl_gateway.base.errors import WireError
from igtl_gateway.wire import Message, decode, encode
from igtl_gateway.wire.body import Body
from igtl_gateway.wire.elements import Elements
from igtl_gateway.wire.registry import BODIES
from tests import strategies
from tests.tables import table
from tests.timing import quick

#: One type name of every class of contents: many queries share theirs.
KINDS = sorted({body: kind for kind, body in BODIES.items()}.values())

#: What must arrive with every bit of its NaNs.
EXACT = [
    *(name for name, kind in BODIES.items() if issubclass(kind, Elements)),
    *("SENSOR", "NDARRAY", "COLORT", "CAPABILITY"),
]


@pytest.mark.slow
@table("kind", EXACT)
def test_what_is_decoded_equals_what_was_encoded(kind: str) -> None:
    @given(strategies.bodies()[kind], st.sampled_from([1, 2]))
    def run(body: Body, version: int) -> None:
        message = Message(kind, "device", body, 1, version)
        assert decode(join(encode(message))) == message

    run()


@pytest.mark.slow
@table("kind", KINDS)
def test_round_trip_of_every_body(kind: str) -> None:
    @given(strategies.bodies(strategies.finite32)[kind])
    def run(body: Body) -> None:
        data = join(body.pack())
        assert total_size(body.pack()) == len(data)
        if data:
            again = BODIES[kind].unpack(memoryview(data))
            assert join(again.pack()) == data
            assert again == body
            assert json.dumps(again.describe()) == json.dumps(body.describe())

    run()


@pytest.mark.slow
@table("kind", KINDS)
def test_arbitrary_content_raises_only_wire_errors(kind: str) -> None:
    @given(st.binary(max_size=150) | strategies.damaged(strategies.bodies()[kind].map(lambda b: join(b.pack())), 0))
    def run(data: bytes) -> None:
        try:
            body = BODIES[kind].unpack(memoryview(data))
        except WireError:
            return
        body.describe()
        assert join(body.pack()) == data

    run()


@table("kind", KINDS)
def test_ones_all_over_cost_nothing(kind: str) -> None:
    """Every count and size at its maximum: refused or read, without the memory that they announce."""
    contents = [b"\xff" * size for size in (1, 12, 28, 40, 48, 72, 136, 1000)]
    tracemalloc.start()
    with quick():
        for content in contents:
            try:
                BODIES[kind].unpack(memoryview(content))
            except WireError:
                pass
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 200_000
