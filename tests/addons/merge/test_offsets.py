"""Offsets of clocks, against planted ones."""

from __future__ import annotations

import math
from random import Random
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from igtl_gateway.addons.merge.offsets import MOST_PIECES, Contradiction, measure_offset
from igtl_gateway.record.sessionfile.merged import Method

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


def test_no_clock() -> None:
    with pytest.raises(Contradiction, match="found no message in either direction"):
        measure_offset(NOTHING, NOTHING)
    chance = Random(1)
    sent = START_NS + np.arange(500) * 1_000_000_000
    wild = np.array([chance.randrange(-(10**12), 10**12) for _ in sent])
    with pytest.raises(Contradiction, match=f"more than {MOST_PIECES} places"):
        measure_offset((sent, sent + wild), (sent, sent + wild))
