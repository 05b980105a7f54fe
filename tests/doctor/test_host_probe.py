"""The measurement of wake-ups and hand-overs."""

from __future__ import annotations

from igtl_gateway.base.clock import SystemClock
from igtl_gateway.doctor.host_probe import Delays, measure


def test_percentiles_are_durations_that_occurred() -> None:
    assert Delays.of([5]) == Delays(5, 5, 5)
    assert Delays.of(list(range(1, 201))) == Delays(100, 198, 200)
    assert Delays.of([3, 1, 2]) == Delays(2, 3, 3)


def test_a_short_measurement() -> None:
    found = measure(SystemClock(), sleeps=20, handovers=50)
    for delays in (found.lateness, found.handover):
        assert 0 <= delays.p50_ns <= delays.p99_ns <= delays.max_ns
    assert found.handover.p50_ns > 0 and found.steal is None
