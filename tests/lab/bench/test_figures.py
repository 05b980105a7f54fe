"""Numbers made of times, on numbers that can be checked by hand."""

from __future__ import annotations

import numpy as np
import pytest

from igtl_gateway_lab.bench.figures import Transmission, in_turn, latency, lateness, quantile, ratio

MS = 1_000_000


def passage(waits_ms: list[float], warm: int = 0) -> Transmission:
    """Sent every 10 ms, arriving so much later."""
    sent = np.arange(len(waits_ms)) * 10 * MS
    return Transmission(sent, np.arange(1, len(waits_ms) + 1), sent + (np.array(waits_ms) * MS).astype(np.int64), warm)


def test_latency_of_known_times() -> None:
    told = latency([passage([1.0, 2.0, 3.0, 4.0])])
    assert told["sent"] == told["delivered"] == 4
    assert (told["p50_ms"], told["p99_ms"], told["mean_ms"], told["max_ms"]) == (2.0, 4.0, 2.5, 4.0)
    assert told["sd_ms"] == pytest.approx(1.25**0.5, abs=1e-4)
    assert told["received_per_s"] == pytest.approx(3 / 0.033, abs=0.01)


def test_what_warms_up_does_not_count() -> None:
    told = latency([passage([500.0, 500.0, 1.0, 2.0], warm=2)])
    assert (told["sent"], told["delivered"], told["max_ms"]) == (2, 2, 2.0)


def test_losses_duplicates_and_disorder() -> None:
    sent = np.arange(5) * 10 * MS
    numbers = np.array([2, 1, 2, 5, 0, 9])
    received = np.array([11, 12, 99, 41, 1, 1]) * MS
    told = latency([Transmission(sent, numbers, received)])
    assert (told["sent"], told["delivered"]) == (5, 3)
    assert told["max_ms"] == 12.0  # number 1; the second arrival of number 2 does not count


def test_streams_together() -> None:
    told = latency([passage([1.0] * 50), passage([3.0] * 50)])
    assert (told["sent"], told["p50_ms"], told["p99_ms"], told["mean_ms"]) == (100, 1.0, 3.0, 2.0)


def test_nothing_arrived() -> None:
    nothing = np.empty(0, np.int64)
    told = latency([Transmission(np.arange(3), nothing, nothing)])
    assert (told["sent"], told["delivered"]) == (3, 0)
    assert told["p50_ms"] is None and told["received_per_s"] is None


def test_quantiles_are_values_that_occurred() -> None:
    hundred = np.arange(1, 101)
    assert [quantile(hundred, share) for share in (0.5, 0.99, 1.0)] == [50, 99, 100]
    assert quantile(np.array([7]), 0.5) == 7


def test_ratio() -> None:
    assert ratio(3.0, 2.0) == 1.5
    assert ratio(None, 2.0) is ratio(3.0, None) is None


def test_how_late_a_sender_was() -> None:
    nothing = np.empty(0, np.int64)
    sent = (np.array([5.0, 10.0, 15.5, 20.0]) * MS).astype(np.int64)
    assert lateness([Transmission(sent, nothing, nothing)], 200.0) == {"late_p99_ms": 0.5, "late_max_ms": 0.5}
    assert lateness([Transmission(nothing, nothing, nothing)], 200.0)["late_p99_ms"] is None


def test_two_hops_in_turn_need_the_sum() -> None:
    first, second = passage([1.0, 2.0, 3.0], warm=1), passage([10.0, 20.0, 30.0])
    lost = Transmission(second.sent, second.numbers[[0, 2]], second.received[[0, 2]])
    measured, _ = in_turn(first, second).measured()
    assert list(measured // MS) == [22, 33]  # the first one warms up
    measured, _ = in_turn(first, lost).measured()
    assert list(measured // MS) == [33]
