"""Processes of a measurement: events, ends, and what they used."""

from __future__ import annotations

import os
import sys
import threading

import pytest

from igtl_gateway_lab.bench.processes import BenchError, Program, Usage, wakeups
from igtl_gateway_lab.programs import ours


def test_one_that_ends_early_is_quoted() -> None:
    with Program("verifier", ours("verify", "no-such-file.mcap")) as program:
        with pytest.raises(BenchError, match=r"verifier: igtl-gateway verify: .*no-such-file"):
            program.wait_for("ready", 60.0)
        with pytest.raises(BenchError, match="no-such-file"):
            program.wait_ended()


def test_one_that_says_nothing() -> None:
    with Program("printer", ours("--version")) as program:
        with pytest.raises(BenchError, match="ended with exit code 0 before 'ready'"):
            program.wait_for("ready", 60.0)


def test_what_this_process_used() -> None:
    usage = Usage.of(os.getpid())
    if not os.path.isdir("/proc/self"):
        pytest.skip("no /proc here")
    assert usage.cpu_s > 0
    assert 1 < usage.rss_mb <= usage.peak_mb


def test_who_waits_is_woken() -> None:
    if not os.path.isdir("/proc/self"):
        pytest.skip("no /proc here")
    before = wakeups(os.getpid())
    threading.Event().wait(0.01)
    after = wakeups(os.getpid())
    assert after[threading.get_native_id()] > before[threading.get_native_id()]


def test_children_count_separately() -> None:
    with Program(
        "spender", [sys.executable, "-c", "import sys; sum(range(10**7)); print('{}'); sys.stdin.read()"]
    ) as one:
        with pytest.raises(BenchError, match="within 1 s"):
            one.wait_for("never", 1.0)
        usage = Usage.of(os.getpid())
        assert usage.children_cpu_s >= Usage.of(one.pid).cpu_s > 0


def test_of_one_that_is_gone_nothing_is_told() -> None:
    assert Usage.of(1 << 30) == Usage(0.0, 0.0, 0.0, 0.0)
    assert wakeups(1 << 30) == {}
