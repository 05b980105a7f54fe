"""Scheduling of the threads that pass messages: which ones, what a missing permission reports, and what is set."""

from __future__ import annotations

import ctypes
import errno
import os
import resource
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from igtl_gateway.app.bridge import Bridge
from igtl_gateway.app.bridge_options import BridgeOptions
from igtl_gateway.base import realtime
from igtl_gateway.base.clock import SystemClock
from igtl_gateway.base.errors import ConfigError, Unavailable
from igtl_gateway.base.realtime import RealtimeOptions, cpus_text, has_capability, message_threads
from igtl_gateway.config.configuration import Config
from igtl_gateway.gateway.log.entry import Entry
from tests.timing import WAIT_S

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="Linux only")


def test_cpus_as_text() -> None:
    assert cpus_text({6, 4, 5, 2, 0}) == "0,2,4-6"


@pytest.mark.parametrize("priority", [-1, 100])
def test_priorities_out_of_range(priority: int) -> None:
    with pytest.raises(ConfigError, match=f"found {priority}, expected 1"):
        RealtimeOptions(priority)


def test_no_option_sets_nothing() -> None:
    options = RealtimeOptions()
    options.check()
    assert not options and options.apply() == ""


def test_threads_by_name(tmp_path: Path) -> None:
    """The names in the system, and those of Python where it has the thread."""
    for number, name in enumerate(
        ("python", "dds.shm.7411", "dds.shm.wdog", "dds.udp.7400", "dds.asyn.0.0", "dds.ev.0", "igtl-timer"), 1
    ):
        (tmp_path / str(number)).mkdir()
        (tmp_path / str(number) / "comm").write_text(f"{name}\n")
    (tmp_path / "99").mkdir()  # it has just ended
    expected = {2: "dds.shm.7411", 4: "dds.udp.7400", 5: "dds.asyn.0.0", 6: "dds.ev.0"}
    assert message_threads(tmp_path) == expected
    done = threading.Event()
    thread = threading.Thread(target=done.wait, name="igtl-tcp")
    thread.start()
    try:
        (tmp_path / str(thread.native_id)).mkdir()
        assert message_threads(tmp_path) == expected | {thread.native_id: "igtl-tcp"}
    finally:
        done.set()
        thread.join()


def test_capabilities(tmp_path: Path) -> None:
    status = tmp_path / "status"
    status.write_text("Name:\tpython\nCapEff:\t0000000000800000\n")
    assert has_capability(realtime.CAP_SYS_NICE, status) and not has_capability(realtime.CAP_IPC_LOCK, status)
    assert not has_capability(realtime.CAP_SYS_NICE, tmp_path / "none")


def refuse(monkeypatch: pytest.MonkeyPatch, capabilities: int = 0, limit: int = 0) -> None:
    """A system without permissions, or with these."""

    def denied(*_arguments: object) -> None:
        raise PermissionError(errno.EPERM, "Operation not permitted")

    monkeypatch.setattr(os, "sched_setscheduler", denied)
    monkeypatch.setattr(realtime, "has_capability", lambda number: bool(capabilities >> number & 1))
    monkeypatch.setattr(resource, "getrlimit", lambda _which: (limit, limit))


def test_a_missing_permission_for_a_priority_is_named_with_the_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    refuse(monkeypatch)
    with pytest.raises(Unavailable, match="found RLIMIT_RTPRIO 0 without CAP_SYS_NICE, expected 30 or more; add 'USER"):
        RealtimeOptions(30).check()


@pytest.mark.parametrize(("capabilities", "limit"), [(1 << realtime.CAP_SYS_NICE, 0), (0, 30), (0, -1)])
def test_with_the_permission_the_control_group_refuses(
    monkeypatch: pytest.MonkeyPatch, capabilities: int, limit: int
) -> None:
    refuse(monkeypatch, capabilities, limit)
    with pytest.raises(Unavailable, match="real-time budget"):
        RealtimeOptions(30).check()


def test_a_finite_limit_does_not_permit_to_lock_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    refuse(monkeypatch, limit=8 << 20)
    with pytest.raises(Unavailable, match="found RLIMIT_MEMLOCK 8192 KiB without CAP_IPC_LOCK, expected unlimited"):
        RealtimeOptions(lock_memory=True).check()
    refuse(monkeypatch, limit=resource.RLIM_INFINITY)
    RealtimeOptions(lock_memory=True).check()
    refuse(monkeypatch, capabilities=1 << realtime.CAP_IPC_LOCK, limit=8 << 20)
    RealtimeOptions(lock_memory=True).check()


@pytest.mark.parametrize(
    ("number", "text"), [(errno.EINVAL, "needs Linux 4.4 or later"), (errno.ENOMEM, "Cannot allocate memory")]
)
def test_a_system_that_does_not_lock(number: int, text: str) -> None:
    flags: list[int] = []

    def mlockall(given: int) -> int:
        flags.append(given)
        ctypes.set_errno(number)
        return -1

    with pytest.raises(Unavailable, match=text):
        realtime._lock_memory(mlockall)
    assert flags == [7]


def test_a_cpu_that_the_process_may_not_use() -> None:
    with pytest.raises(Unavailable, match="found CPU 8000, expected CPUs of "):
        RealtimeOptions(cpus=frozenset({8000})).check()


def test_other_systems(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "platform", "darwin")
    RealtimeOptions().check()
    with pytest.raises(Unavailable, match="on Linux only"):
        RealtimeOptions(1).check()


def test_a_missing_permission_opens_nothing(tmp_path: Path) -> None:
    """The check precedes ports and files: an existing recording remains."""
    recording = tmp_path / "out.mcap"
    recording.write_bytes(b"yesterday")
    options = BridgeOptions(
        (("127.0.0.1", 0),), ros=False, record=recording, realtime=RealtimeOptions(cpus=frozenset({8000}))
    )
    bridge = Bridge(Config(), options, SystemClock())
    with pytest.raises(Unavailable):
        bridge.start()
    assert recording.read_bytes() == b"yesterday" and bridge.addresses == []


def test_the_thread_of_tcp_gets_its_cpus_and_others_keep_theirs() -> None:
    cpu = max(os.sched_getaffinity(0))
    before = message_threads()  # those of ROS, where an earlier test has started it
    seen: list[Entry] = []
    options = BridgeOptions((("127.0.0.1", 0),), ros=False, realtime=RealtimeOptions(cpus=frozenset({cpu})))
    bridge = Bridge(Config(), options, SystemClock(), seen.append)
    bridge.start()
    try:
        found = message_threads()
        (number,) = found.keys() - before.keys()
        assert found[number] == "igtl-tcp" and os.sched_getaffinity(number) == {cpu}
        if not before:
            assert bridge.realtime == f"real-time: CPUs {cpu} for 1 thread (igtl-tcp)"
        assert len(os.sched_getaffinity(0)) >= 1
    finally:
        bridge.stop()


_SCRIPT = """
import os, threading
from igtl_gateway.base.realtime import RealtimeOptions, message_threads
os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))  # whatever the tests run with
done = threading.Event()
threading.Thread(target=done.wait, name="igtl-ros-receiver", daemon=True).start()
options = RealtimeOptions({priority}, {lock})
options.check()
print(options.apply())
(thread,) = message_threads()
print(os.sched_getscheduler(thread) == os.SCHED_FIFO, os.sched_getparam(thread).sched_priority)
print(os.sched_getscheduler(0) == os.SCHED_OTHER)
print([line.split()[1] for line in open("/proc/self/status") if line.startswith("VmLck")][0] != "0")
"""


@pytest.mark.parametrize(("priority", "lock"), [(7, False), (0, True), (7, True)])
def test_in_a_process_with_the_permissions(priority: int, lock: bool) -> None:
    try:
        RealtimeOptions(priority, lock).check()
    except Unavailable as error:
        pytest.skip(str(error))
    script = _SCRIPT.format(priority=priority, lock=lock)
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=WAIT_S, check=False)
    what = [f"SCHED_FIFO {priority} for 1 thread"] * bool(priority) + ["memory locked"] * lock
    names = " (igtl-ros-receiver)" if priority else ""
    assert done.stdout.splitlines() == [
        f"real-time: {', '.join(what)}{names}",
        f"{bool(priority)} {priority}",
        "True",
        str(lock),
    ], done.stderr
