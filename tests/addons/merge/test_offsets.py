"""Offsets of clocks, against planted ones."""

from __future__ import annotations

import math
from random import Random
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from igtl_gateway.addons.merge.offsets import MOST_PIECES, ClockOffset, Contradiction, Piece, measure_offset
from igtl_gateway.record.sessionfile.merged import Method
from tests.tables import table

Array = npt.NDArray[Any]
START_NS = 1_700_000_000_000_000_000
NOTHING = (np.zeros(0, np.int64), np.zeros(0, np.int64))


def test_interval_contains_the_truth_and_a_drift_is_proven_only_if_there_is_one() -> None:
    chance = np.random.default_rng(1)
    proven = 0
    for _ in range(150):
        seconds = 10 ** chance.uniform(0, 4)
        ppm = float(chance.choice([0, 0, chance.uniform(-100, 100)]))
        ahead = int(chance.choice([0, chance.normal() * 1e9, 1e17]))

        def clock(time: Array, ppm: float = ppm, ahead: int = ahead) -> Array:
            return np.asarray(time + ahead + np.rint(ppm * 1e-6 * (time - START_NS)).astype(np.int64))

        def messages(seconds: float = seconds) -> tuple[Array, Array]:
            count = int(chance.integers(1, 300))
            sent = START_NS + np.sort(chance.random(count) * seconds * 1e9).astype(np.int64)
            return sent, sent + (chance.choice([1e5, 5e7]) * (1 + chance.exponential(1, count))).astype(np.int64)

        (sent, arrived), (sent_back, arrived_back) = messages(), messages()
        found = measure_offset((sent, clock(arrived)), (clock(sent_back), arrived_back))
        times = np.sort(np.concatenate([arrived, sent_back]))
        wrong = found.of(clock(times)) - (clock(times) - times)
        assert (wrong <= found.low_ns + 2).all() and (wrong >= -found.high_ns - 2).all()
        assert found.of(clock(times)).tolist() == [found.at(int(time)) for time in clock(times)]
        assert not (found.is_drifting and not ppm)
        proven += found.is_drifting
    assert proven > 10


def test_one_direction_gives_a_bound() -> None:
    sent = START_NS + np.arange(10)
    found = measure_offset((sent, sent + 500 - np.arange(10)), NOTHING)
    assert (found.method, found.at(START_NS), found.low_ns, found.high_ns) == (Method.ONE_WAY, 491, math.inf, 0)
    back = measure_offset(NOTHING, (sent, sent + 500 - np.arange(10)))
    assert (back.at(START_NS), back.low_ns, back.high_ns) == (-491, 0, math.inf)


def test_a_clock_that_was_set_has_two_pieces() -> None:
    sent = START_NS + np.arange(1000) * 10_000_000
    step = np.where(np.arange(1000) < 600, 0, 2_000_000_000)
    found = measure_offset((sent, sent + 1_000_000 + step), (sent + step + 5_000, sent + 1_000_000))
    assert len(found.pieces) == 2
    assert abs(found.at(int(sent[10])) - 2_500) < 1_000_000
    assert abs(found.at(int(sent[-1] + step[-1])) - 2_000_000_000) < 1_000_000


PIECES = ClockOffset(
    Method.BOTH_WAYS, (Piece(START_NS, 100), Piece(START_NS + 10, 200), Piece(START_NS + 20, 300, 1e9)), 3.0, 5.0
)


@table(
    ("since", "expected"),
    [(-5, 100), (0, 100), (9, 100), (10, 200), (19, 200), (20, 300), (25, 305), (10**9 + 20, 10**9 + 300)],
)
def test_a_piece_applies_from_its_start_on(since: int, expected: int) -> None:
    assert PIECES.at(START_NS + since) == expected
    assert PIECES.of(np.array([START_NS + since], np.int64)).tolist() == [expected]


def test_an_offset_without_bounds_is_exact_and_does_not_drift() -> None:
    found = ClockOffset(Method.GIVEN, (Piece(START_NS, 7),))
    assert (found.low_ns, found.high_ns, found.error_ns, found.is_drifting) == (0.0, 0.0, 0.0, False)
    assert math.isnan(found.low_ppm) and math.isnan(found.high_ppm)
    assert [found.at(START_NS + at) for at in (-(10**9), 0, 10**9)] == [7, 7, 7]


def test_what_an_offset_states_of_itself() -> None:
    assert (PIECES.error_ns, PIECES.is_drifting) == (4.0, True)
    assert not ClockOffset(Method.GIVEN, (Piece(0, 5), Piece(7, 9))).is_drifting


@table("ppm", [0, 150, -150, 195, -195])
def test_a_line_is_as_steep_as_the_clocks_drift(ppm: int) -> None:
    sent = START_NS + np.arange(200, dtype=np.int64) * 1_000_000_000
    shown = sent + np.round((sent - START_NS) * (ppm * 1e-6)).astype(np.int64)
    found = measure_offset((sent, shown + 1_000), (shown, sent + 1_000))
    (piece,) = found.pieces
    assert piece.slope == pytest.approx(1e3 * ppm, abs=60)
    assert found.low_ppm - 0.06 <= ppm <= found.high_ppm + 0.06 < found.low_ppm + 0.2
    assert found.is_drifting is bool(ppm)


@table("ppm", [210, -210])
def test_no_clock_drifts_by_more_than_200_ppm(ppm: int) -> None:
    sent = START_NS + np.arange(200, dtype=np.int64) * 1_000_000_000
    shown = sent + np.round((sent - START_NS) * (ppm * 1e-6)).astype(np.int64)
    with pytest.raises(Contradiction, match=f"more than {MOST_PIECES} places"):
        measure_offset((sent, shown + 1_000), (shown, sent + 1_000))


def test_bounds_that_are_equal_leave_one_line() -> None:
    """Messages without a delay, there and back, are an offset to the rounding of their stamps."""
    sent = START_NS + np.arange(50, dtype=np.int64) * 1_000_000_000
    found = measure_offset((sent, sent + 700), (sent + 700, sent))
    assert [(piece.offset_ns, piece.slope) for piece in found.pieces] == [(700, 0.0)]
    assert 0 <= found.low_ns <= 1 and 0 <= found.high_ns <= 1


def test_two_bounds_are_half_way() -> None:
    sent = np.array([START_NS], np.int64)
    found = measure_offset((sent, sent + 1_000), (sent + 400, sent))
    assert (found.method, found.at(START_NS)) == (Method.BOTH_WAYS, 700)
    assert (found.low_ns, found.high_ns) == pytest.approx((300, 300), abs=1)


def test_after_a_clock_was_set_one_direction_is_as_near_as_it_can_be() -> None:
    """Only one direction has messages after the clock of B was set 5 s ahead: a bound, and no interval."""
    step_ns = 5_000_000_000
    sent = START_NS + np.arange(20, dtype=np.int64) * 1_000_000_000
    shown = np.where(np.arange(20) < 10, sent, sent + step_ns)
    only_back = measure_offset((sent[:10], sent[:10] + 1_000), (shown + 400, sent))
    assert only_back.at(int(sent[0])) == pytest.approx(700, abs=2)
    assert only_back.at(int(shown[-1])) == step_ns + 400, "at least that"
    assert (math.isinf(only_back.low_ns), math.isinf(only_back.high_ns)) == (False, True)
    only_there = measure_offset((shown, sent + 1_000), (sent[:10], shown[:10] + 400))
    assert only_there.at(int(sent[0])) == pytest.approx(300, abs=2)
    assert only_there.at(int(sent[-1])) == 1_000 - step_ns, "at most that"
    assert (math.isinf(only_there.low_ns), math.isinf(only_there.high_ns)) == (True, False)


def test_no_clock() -> None:
    with pytest.raises(Contradiction, match="found no message in either direction"):
        measure_offset(NOTHING, NOTHING)
    chance = Random(1)
    sent = START_NS + np.arange(500) * 1_000_000_000
    wild = np.array([chance.randrange(-(10**12), 10**12) for _ in sent])
    with pytest.raises(Contradiction, match=f"more than {MOST_PIECES} places"):
        measure_offset((sent, sent + wild), (sent, sent + wild))


DAY_NS = 86_400 * 10**9


@table(
    ("pieces", "until_ns", "is_exact"),
    [
        ((Piece(START_NS, 7),), DAY_NS, True),
        ((Piece(START_NS, (1 << 50) - 1),), DAY_NS, True),
        ((Piece(START_NS, 1 << 50),), DAY_NS, False),
        ((Piece(START_NS, -(1 << 50)),), DAY_NS, False),
        ((Piece(1 << 62, 7),), DAY_NS, False),
        ((Piece(START_NS, 7), Piece(START_NS + DAY_NS, 9)), DAY_NS, True),
        ((Piece(START_NS, 7), Piece(START_NS + 2, 9), Piece(START_NS + 1, 9)), DAY_NS, False),
        ((Piece(START_NS, 7, 0.5),), (1 << 52) - 1, True),
        ((Piece(START_NS, 7, 0.5),), 1 << 52, False),
        ((Piece(START_NS, 7, 1e9),), DAY_NS, False),
        ((Piece(START_NS + (1 << 52), 7, 0.5),), DAY_NS, False),
    ],
)
def test_where_columns_of_times_have_the_offsets_of_single_ones(
    pieces: tuple[Piece, ...], until_ns: int, is_exact: bool
) -> None:
    """Beyond these limits floating-point numbers round, and each time is computed alone."""
    found = ClockOffset(Method.GIVEN, pieces)
    assert found.is_exact(START_NS, START_NS + until_ns) is is_exact
    if is_exact:
        times = START_NS + np.arange(0, until_ns, max(1, until_ns // 1_009))
        assert found.of(times).tolist() == [found.at(time) for time in times.tolist()]
