"""Processes: the priority that one gives up."""

from __future__ import annotations

import subprocess
import sys

import pytest

_PROGRAM = """
import os
from igtl_gateway.base.systems.processes import lower_priority
before = os.nice(0)
os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))
lower_priority(5)
print(os.sched_getscheduler(0) == os.SCHED_OTHER, os.nice(0) - before)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="real-time priority of Linux")
def test_a_lowered_process_has_no_real_time_priority() -> None:
    """With it, nice values do not count: the recorder would run before all else on the CPU of the bridge."""
    done = subprocess.run([sys.executable, "-c", _PROGRAM], capture_output=True, text=True, check=False)
    if "PermissionError" in done.stderr:
        pytest.skip("real-time priority is not permitted")
    assert done.stdout.split() == ["True", "5"]
