"""Bounds of time in tests: the only place that has them in seconds.

What a test forbids takes minutes, or has no end; what it asks for takes less than a second on a quiet machine.  The
bounds lie so far between that a machine with ten times its work does not reach them: no verdict depends on the load.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager

#: CPU time of what has to be quick.
MOST_CPU_S = 30.0
#: How long a test lets something wait that has to end at once, and what "at once" may take.
WAIT_S, MOST_WAIT_S = 90.0, 60.0
#: Limit of reading a file (``--limit seconds``), which counts time of the clock, in all tests that do not set it.
MOST_READING_S = 600


@contextmanager
def quick() -> Iterator[None]:
    """A calculation that a bad input could make last for minutes.  Also if it ends with an error."""
    begun = time.process_time()
    try:
        yield
    finally:
        assert time.process_time() - begun < MOST_CPU_S


@contextmanager
def at_once() -> Iterator[None]:
    """A wait of `WAIT_S` that something else ends."""
    begun = time.monotonic()
    try:
        yield
    finally:
        assert time.monotonic() - begun < MOST_WAIT_S
