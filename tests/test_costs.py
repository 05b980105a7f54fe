"""The most expensive message of each type costs in proportion to its size: counted in calls, which need no clock.

A function that is called for each part of a message is called four times as often for four times as many.  What a call
itself costs is bounded by its arguments: so characters that names are made of are counted, too.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from types import FrameType
from typing import Any

import pytest

from igtl_gateway.base.buffers import join
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.to_ros import beforehand
from igtl_gateway.wire import decode, describe, encode
from tests.costly import TABLE, Costly
from tests.script import Script
from tests.tables import table

#: Calls of a message beside those for its parts: caches that are filled, libraries that are prepared.
_SPARE = 8_000
#: Calls with the sequence lock: about three milliseconds, of the tools of MAX_TOOLS, each of which gets its frame.
_WITH_LOCK = 40_000


def calls(work: Callable[[], object]) -> int:
    """The number of calls of functions, in Python and in C."""
    count = 0

    def note(_frame: FrameType, event: str, _what: Any) -> None:
        nonlocal count
        count += event in ("call", "c_call")

    before = sys.getprofile()
    sys.setprofile(note)
    try:
        work()
    finally:
        sys.setprofile(before)
    return count


def stages(data: bytes, *, of_gateway_alone: bool = False) -> dict[str, tuple[int, int]]:
    """Stage → calls, and bytes that it has made, of a message that a gateway has not seen yet and then sees again.

    Args:
        data: the message.
        of_gateway_alone: without what costs most to count: the codec and the full path.
    """
    script = Script()
    script.gateway.fast_path._enabled = False  # compiled streams are small or have one call for all parts
    script.up(1)
    found: dict[str, tuple[int, int]] = {}

    def measure(name: str, work: Callable[[], object]) -> None:
        made: list[object] = []
        number = calls(lambda: made.append(work()))
        (result,) = made
        entries = result if isinstance(result, list) else []
        size = sum(one.size for one in entries if isinstance(one, Entry) and not one.kind.is_input)
        found[name] = number, size

    if not of_gateway_alone:
        measure("decode", lambda: decode(data))
        measure("describe", lambda: describe(data))
        measure("encode", lambda: join(encode(decode(data))))
    for time in ("first", "second"):
        prepared: list[Any] = []
        measure(f"beforehand, {time}", lambda: prepared.append(_prepared(script, data)))  # noqa: B023
        measure(f"with the lock, {time}", lambda: _handled(script, data, prepared[0]))  # noqa: B023
    if not of_gateway_alone:
        measure("full path", lambda: _handled(script, data, None))
    return found


def _prepared(script: Script, data: bytes) -> Any:
    return script.session.prepare(Kind.IGTL_IN, data, "", "", (1,), 0)


def _handled(script: Script, data: bytes, prepared: Any) -> list[Entry]:
    script.now_ns += 1_000_000
    return script.session.input(script.now_ns, Kind.IGTL_IN, (data,), links=(1,), prepared=prepared)


@pytest.fixture(autouse=True)
def all_beforehand(monkeypatch: pytest.MonkeyPatch) -> None:
    """Small messages, too, so that both of a pair take the same way."""
    monkeypatch.setattr(beforehand, "AT_ONCE_NS", 0)


@table("row", TABLE, ids=lambda row: row.name)
def test_four_times_the_parts_cost_four_times_as_much(row: Costly) -> None:
    number = max(min(row.most // 4, 1_000), 1)
    small, large = stages(row.data(number)), stages(row.data(4 * number))
    for stage, (count, size) in small.items():
        more, larger = large[stage]
        assert more <= 4 * count + _SPARE, f"{stage}: {count} calls, then {more}"
        assert larger <= 5 * size + (1 << 16), f"{stage}: {size} bytes, then {larger}"


@table("row", TABLE, ids=lambda row: row.name)
def test_little_is_left_for_the_lock(row: Costly) -> None:
    """What the lock is held for does not grow with the parts, except for children and tools, which have bounds."""
    data = row.data(min(row.most, 4_000))
    few = stages(data, of_gateway_alone=True)["with the lock, second"][0]
    assert few < _WITH_LOCK, f"{few} calls with the sequence lock"
