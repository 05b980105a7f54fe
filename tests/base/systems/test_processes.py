"""Processes: the priority that one gives up."""

from __future__ import annotations

import subprocess
import sys

import pytest

from tests.base.systems.sessions import knows_sessions

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


_BEHIND = """
import os, subprocess, sys, time
from igtl_gateway.base.systems.processes import apart, stand_back
import signal
stand_back(7)
print(open("/proc/self/autogroup").read().split()[-1])
time.sleep(0.3)  # an ordinary user may change a session's niceness ten times a second
child = [sys.executable, "-c", "print(open('/proc/self/autogroup').read().split()[-1])"]
print(subprocess.check_output(child, text=True, **apart(signal.SIGINT)))
"""


@pytest.mark.skipif(not knows_sessions(), reason="this system does not know sessions' niceness")
def test_a_session_has_the_niceness_of_its_process() -> None:
    """Where the system shares among sessions, the niceness of a process alone does not count."""
    command = [sys.executable, "-c", _BEHIND]
    done = subprocess.run(command, capture_output=True, text=True, check=True, start_new_session=True)
    own, child = (int(word) for word in done.stdout.split())
    assert own == child == 7
