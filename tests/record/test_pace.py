"""Why a recorder is too slow: the disk, the processors, or its work."""

from __future__ import annotations

import os
import sys
import time

import pytest

from igtl_gateway.base.systems.processes import processor_times
from igtl_gateway.record.pace import DISK, PROCESSORS, WORK, Pace
from tests.tables import table

SECOND = 1_000_000_000


@table(
    "cause, ran, ready, text",
    [
        (DISK, 0.1, 0.2, "worked for 10 % of the time, waited for a processor for 20 %, for the disk for 70 %"),
        (PROCESSORS, 0.3, 0.6, "worked for 30 % of the time, waited for a processor for 60 %, for the disk for 10 %"),
        (WORK, 0.9, 0.1, "worked for 90 % of the time, waited for a processor for 10 %, for the disk for 0 %"),
        (WORK, 1.1, 0.1, "worked for 100 % of the time, waited for a processor for 10 %, for the disk for 0 %"),
    ],
)
def test_the_cause_is_what_takes_most_time(cause: int, ran: float, ready: float, text: str) -> None:
    times = iter([(5, 7), (5 + int(2 * ran * SECOND), 7 + int(2 * ready * SECOND))] * 2)
    pace = Pace(lambda: next(times))
    pace.begin(SECOND, 1_000_000)
    shares = pace.shares(3 * SECOND)
    assert shares is not None and shares.cause == cause and text in str(shares)
    pace.begin(SECOND, 1_000_000)
    words, figures = pace.describe(3 * SECOND, 101_000_000)
    assert words and figures == f"in 2 s it took 50.0 MB/s; {shares}"


def test_where_the_system_does_not_count_there_are_no_figures() -> None:
    pace = Pace(lambda: None)
    pace.begin(0, 0)
    assert pace.describe(SECOND, 0) == ("the recorder is too slow", "")
    known = Pace(lambda: (1, 1))
    known.begin(SECOND, 0)
    assert known.shares(SECOND) is None, "no time has passed"


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux counts how long a thread has no processor")
def test_times_of_processes() -> None:
    before = processor_times(os.getpid())
    until = time.thread_time_ns() + 20_000_000
    while time.thread_time_ns() < until:
        pass
    after = processor_times(os.getpid())
    assert before and after and after[0] - before[0] >= 10_000_000 and after[1] >= before[1]
    assert processor_times(2**22 + 1) is None
