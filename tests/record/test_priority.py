"""The worker is behind all others as long as that costs no entries."""

from __future__ import annotations

from igtl_gateway.record.priority import Priority

S = 1_000_000_000
BYTES = 6_400


def ranked(works: bool = True) -> tuple[Priority, list[bool]]:
    """A priority with a queue of this size, and what it sets."""
    calls: list[bool] = []

    def rank(is_raised: bool) -> bool:
        calls.append(is_raised)
        return works

    return Priority(rank, BYTES, 0), calls


def test_it_depends_on_what_waits() -> None:
    priority, calls = ranked()
    for waiting in (BYTES // 64 + 1, BYTES // 64, BYTES // 8, BYTES // 8 + 1, BYTES // 64 + 1, BYTES // 64):
        priority.look(0, waiting, S)
    assert calls == [False, True, False] and not priority.is_raised


def test_who_is_late_stays_raised_for_some_time() -> None:
    priority, calls = ranked()
    priority.set(False, 0)
    priority.look(150_000_000, 0, S)
    assert calls == [False], "not yet late"
    for now_s in (1, 2, 31):
        priority.look(150_000_001 if now_s == 2 else 0, 0, now_s * S)
    assert calls == [False, True] and priority.is_raised
    priority.look(0, 0, 32 * S)
    assert calls == [False, True, False]


def test_it_is_lowered_again_and_not_raised_again() -> None:
    priority, calls = ranked()
    priority.set(True, 61 * S)
    assert calls == []
    for now_s in (61, 121, 122):
        priority.set(False, now_s * S)
    assert calls == [False, False]


def test_what_did_not_work_is_tried_again() -> None:
    priority, calls = ranked(works=False)
    priority.set(False, 1)
    priority.set(False, 2)
    assert calls == [False, False] and priority.is_raised
