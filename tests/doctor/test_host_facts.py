"""The facts of a machine, read from a folder with a prepared system."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from igtl_gateway.doctor.host_facts import (
    CpuTimes,
    HostFacts,
    IdleState,
    free_bytes,
    is_clock_synchronised,
    read_facts,
    read_times,
)

#: A physical machine that is set up for low jitter.
QUIET = {
    "proc/version": "Linux version 6.1.0-rt5 (gcc) #1 SMP PREEMPT_RT Debian 6.1.7-1",
    "proc/cmdline": "quiet isolcpus=2,3",
    "proc/loadavg": "0.12 0.30 0.20 1/200 4711",
    "proc/stat": "cpu  100 0 50 800 10 0 5 35 7 0\ncpu0 1 2 3\n",
    "proc/meminfo": "MemTotal: 1000 kB\nSwapTotal:       2048 kB\n",
    "proc/timer_list": "  .hres_active    : 1\n  .hres_active    : 1\n",
    "proc/self/timerslack_ns": "1000\n",
    "proc/self/status": "Name: python\nCapEff: 0000000000000000\nCpus_allowed_list:\t0-3\n",
    "proc/self/limits": "Limit Soft Hard Units\n"
    "Max realtime priority     50                   50\n"
    "Max locked memory         8388608              8388608              bytes\n",
    "proc/self/cgroup": "0::/user.slice/bridge\n",
    "proc/irq/1/smp_affinity_list": "0-1\n",
    "proc/irq/24/smp_affinity_list": "0-3\n",
    "proc/sys/kernel/sched_autogroup_enabled": "0\n",
    "proc/sys/kernel/sched_rt_runtime_us": "950000\n",
    "proc/sys/kernel/sched_rt_period_us": "1000000\n",
    "proc/sys/net/core/rmem_max": "212992\n",
    "proc/sys/net/core/wmem_max": "212993\n",
    "proc/sys/net/core/busy_poll": "50\n",
    "sys/devices/system/cpu/isolated": "2-3\n",
    "sys/devices/system/cpu/smt/active": "1\n",
    "sys/devices/system/cpu/cpu0/cpufreq/scaling_governor": "performance\n",
    "sys/devices/system/cpu/cpu1/cpufreq/scaling_governor": "powersave\n",
    "sys/devices/system/cpu/cpu0/cpuidle/state0/name": "POLL\n",
    "sys/devices/system/cpu/cpu0/cpuidle/state0/latency": "0\n",
    "sys/devices/system/cpu/cpu0/cpuidle/state0/disable": "0\n",
    "sys/devices/system/cpu/cpu0/cpuidle/state1/name": "C6\n",
    "sys/devices/system/cpu/cpu0/cpuidle/state1/latency": "133\n",
    "sys/devices/system/cpu/cpu0/cpuidle/state1/disable": "0\n",
    "sys/devices/system/cpu/cpu0/cpuidle/state2/name": "C8\n",
    "sys/devices/system/cpu/cpu0/cpuidle/state2/latency": "260\n",
    "sys/devices/system/cpu/cpu0/cpuidle/state2/disable": "1\n",
    "sys/devices/system/clocksource/clocksource0/current_clocksource": "tsc\n",
    "sys/kernel/mm/transparent_hugepage/enabled": "always [madvise] never\n",
    "sys/fs/cgroup/user.slice/bridge/cpu.max": "150000 100000\n",
    "sys/class/ptp/ptp0/clock_name": "igb\n",
    "dev/cpu_dma_latency": "\x14\0\0\0",
    "share/rmw_fastrtps_cpp/package.xml": "<package><version>9.4.8</version></package>",
}


def system(root: Path, files: dict[str, str]) -> Path:
    for name, text in files.items():
        path = root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return root


def facts(root: Path, files: dict[str, str]) -> HostFacts:
    def free(folder: Path) -> int | None:
        return 64 << 20 if folder == root / "dev/shm" else None

    return read_facts(system(root, files), lambda: True, free, (root,))


def test_all_facts(tmp_path: Path) -> None:
    assert facts(tmp_path, QUIET) == HostFacts(
        version="Linux version 6.1.0-rt5 (gcc) #1 SMP PREEMPT_RT Debian 6.1.7-1",
        preemption="rt",
        governors=("performance", "powersave"),
        idle_states=(IdleState("POLL", 0), IdleState("C6", 133)),
        dma_latency_us=20,
        cpus=frozenset({0, 1, 2, 3}),
        isolated=frozenset({2, 3}),
        smt=True,
        load=0.12,
        times=CpuTimes(1000, 35),
        high_resolution=True,
        timer_slack_ns=1000,
        autogroup=False,
        realtime_limit=50,
        rt_runtime_us=950_000,
        rt_period_us=1_000_000,
        group_rt_runtime_us=None,
        memlock_bytes=8 << 20,
        huge_pages="madvise",
        swap_bytes=2 << 20,
        shared_memory_bytes=64 << 20,
        rmem_max=212_992,
        wmem_max=212_993,
        busy_poll_us=50,
        interrupts=2,
        free_interrupts=1,
        clock_source="tsc",
        synchronised=True,
        ptp_clocks=1,
        quota=1.5,
        middleware={"rmw_fastrtps_cpp": (9, 4, 8)},
    )


def test_an_empty_system_has_no_facts(tmp_path: Path) -> None:
    found = read_facts(tmp_path, lambda: None, ros=())
    assert found.middleware == {}
    rest = {getattr(found, name) for name in HostFacts.__slots__ if name != "middleware"}
    assert rest == {"", None, (), frozenset(), 0}


@pytest.mark.parametrize(
    ("files", "mode"),
    [
        ({"proc/version": "#1 SMP PREEMPT_DYNAMIC Debian"}, None),
        ({"proc/version": "#1 SMP PREEMPT_DYNAMIC", "proc/cmdline": "preempt=none quiet preempt=full"}, "full"),
        (
            {"proc/version": "#1 SMP PREEMPT_DYNAMIC", "sys/kernel/debug/sched/preempt": "none (voluntary) full"},
            "voluntary",
        ),
        ({"proc/version": "#1 SMP PREEMPT Debian"}, "full"),
        ({"proc/version": "#1 SMP Debian"}, "voluntary"),
        ({"proc/version": "#1 SMP Debian", "sys/kernel/realtime": "1\n"}, "rt"),
        ({}, None),
    ],
)
def test_preemption(tmp_path: Path, files: dict[str, str], mode: str | None) -> None:
    assert facts(tmp_path, files).preemption == mode


@pytest.mark.parametrize(
    ("files", "quota", "runtime"),
    [
        ({"proc/self/cgroup": "0::/\n", "sys/fs/cgroup/cpu.max": "max 100000"}, float("inf"), None),
        (
            {
                "proc/self/cgroup": "4:memory:/a\n1:cpu,cpuacct:/a/b\n",
                "sys/fs/cgroup/cpu/a/b/cpu.cfs_quota_us": "50000",
                "sys/fs/cgroup/cpu/a/b/cpu.cfs_period_us": "100000",
                "sys/fs/cgroup/cpu/a/b/cpu.rt_runtime_us": "0",
            },
            0.5,
            0,
        ),
        (
            {
                "proc/self/cgroup": "1:cpu:/not/in/this/container\n",
                "sys/fs/cgroup/cpu/cpu.cfs_quota_us": "-1",
                "sys/fs/cgroup/cpu/cpu.cfs_period_us": "100000",
            },
            float("inf"),
            None,
        ),
        ({"sys/fs/cgroup/cpu.max": "invalid"}, None, None),
    ],
)
def test_control_groups(tmp_path: Path, files: dict[str, str], quota: float | None, runtime: int | None) -> None:
    found = facts(tmp_path, files)
    assert (found.quota, found.group_rt_runtime_us) == (quota, runtime)


def test_capabilities_go_before_limits(tmp_path: Path) -> None:
    status = "CapEff:\t000001ffffffffff\n"
    found = facts(tmp_path, QUIET | {"proc/self/status": status})
    assert (found.realtime_limit, found.memlock_bytes) == (None, None)


def test_the_share_of_other_virtual_machines(tmp_path: Path) -> None:
    before = read_times(system(tmp_path, {"proc/stat": "cpu  100 0 50 800 10 0 5 35 7 0\n"}))
    after = read_times(system(tmp_path, {"proc/stat": "cpu  150 0 50 840 10 0 5 45 7 0\n"}))
    assert before and after
    assert after.steal_since(before) == 0.1
    assert after.steal_since(after) is None


@pytest.mark.skipif(sys.platform != "linux", reason="Linux only")
def test_this_machine(tmp_path: Path) -> None:
    found = read_facts()
    assert found.version.startswith("Linux version") and found.cpus and found.times and found.load is not None
    assert is_clock_synchronised() in (True, False, None)
    assert free_bytes(tmp_path) and free_bytes(tmp_path / "none") is None
