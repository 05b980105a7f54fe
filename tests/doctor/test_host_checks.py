"""The judgement of facts: each check with a good, a bad and an unknown fact."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from igtl_gateway.doctor.host_checks import HOST_CHECKS, Status
from igtl_gateway.doctor.host_facts import CpuTimes, HostFacts, IdleState
from igtl_gateway.doctor.host_probe import Delays, HostMeasurement
from igtl_gateway.doctor.rules import Severity
from tests.tables import table

#: A machine without a finding.
GOOD = HostFacts(
    version="Linux version 6.1 SMP PREEMPT_RT",
    preemption="rt",
    governors=("performance",),
    idle_states=(IdleState("POLL", 0), IdleState("C1", 2)),
    dma_latency_us=2_000_000_000,
    cpus=frozenset(range(8)),
    isolated=frozenset({6, 7}),
    smt=False,
    load=1.0,
    times=CpuTimes(100_000, 50),
    high_resolution=True,
    timer_slack_ns=50_000,
    autogroup=False,
    realtime_limit=None,
    rt_runtime_us=950_000,
    rt_period_us=1_000_000,
    group_rt_runtime_us=None,
    memlock_bytes=None,
    huge_pages="madvise",
    swap_bytes=0,
    shared_memory_bytes=1 << 30,
    rmem_max=8 << 20,
    wmem_max=16 << 20,
    busy_poll_us=50,
    interrupts=20,
    free_interrupts=0,
    clock_source="tsc",
    synchronised=True,
    ptp_clocks=2,
    quota=float("inf"),
    middleware={"rmw_fastrtps_cpp": (8, 4, 3)},
)
MEASURED = HostMeasurement(Delays(60_000, 120_000, 900_000), Delays(4_000, 12_000, 80_000), 0.001)

#: Check, changed facts, and what was found.
BAD: list[tuple[str, dict[str, Any], str]] = [
    ("W901", {"preemption": "voluntary", "version": ""}, "preemption: voluntary"),
    ("I902", {"preemption": "full"}, "no PREEMPT_RT"),
    ("W903", {"governors": ("performance", "powersave")}, "governor performance, powersave"),
    ("W904", {"idle_states": (IdleState("C1", 2), IdleState("C6", 133))}, "C6 takes 133 µs to wake up"),
    ("W905", {"cpus": frozenset({0, 2, 3}), "load": 0.0}, "3 CPUs: 0,2-3"),
    ("W905", {"cpus": frozenset({1}), "load": 0.0}, "1 CPU: 1"),
    ("I906", {"smt": True}, "two CPUs share a core"),
    ("W907", {"load": 6.0}, "load 6 on 8 CPUs"),
    ("W909", {"high_resolution": False}, "resolution of the tick"),
    ("I910", {"timer_slack_ns": 4_000_000}, "4000 µs"),
    ("I911", {"autogroup": True}, "autogroup is on"),
    ("I912", {"realtime_limit": 0}, "RLIMIT_RTPRIO 0"),
    ("W913", {"rt_runtime_us": 100_000}, "100,000 of 1,000,000 µs"),
    ("W913", {"group_rt_runtime_us": 0}, "0 µs for this control group"),
    ("I914", {"memlock_bytes": 8 << 20}, "RLIMIT_MEMLOCK 8,192 KiB"),
    ("W915", {"huge_pages": "always"}, "always"),
    ("W916", {"swap_bytes": 2 << 30}, "2,048 MiB swap space"),
    ("W917", {"shared_memory_bytes": 64 << 20}, "64 MiB free in /dev/shm"),
    ("W918", {"rmem_max": 212_992}, "rmem_max 212,992, wmem_max 16,777,216 bytes"),
    ("I919", {"busy_poll_us": 0}, "busy_poll 0 µs"),
    ("I920", {"isolated": frozenset()}, "0 of 20 interrupts run on every CPU; no CPU isolated"),
    ("I920", {"free_interrupts": 3}, "3 of 20 interrupts run on every CPU; CPUs 6-7 isolated"),
    ("W921", {"clock_source": "hpet"}, "hpet"),
    ("W922", {"synchronised": False}, "not synchronised; 2 PTP clocks"),
    ("W922", {"synchronised": False, "ptp_clocks": 0}, "not synchronised"),
    ("W923", {"quota": 1.5}, "quota of 1.5 CPUs"),
    (
        "W926",
        {"middleware": {"rmw_fastrtps_cpp": (9, 4, 10)}},
        "rmw_fastrtps_cpp 9.4.10: messages with uint8[] (pictures, clouds) from ROS nodes do not reach the bridge "
        "(ros2/rmw_fastrtps#881)",
    ),
]

#: Facts that a system might not show, and the checks that are then unknown.
HIDDEN: dict[str, Any] = {
    "version": "",
    "preemption": None,
    "governors": (),
    "idle_states": (),
    "cpus": frozenset(),
    "smt": None,
    "load": None,
    "high_resolution": None,
    "timer_slack_ns": None,
    "autogroup": None,
    "rt_runtime_us": None,
    "huge_pages": None,
    "swap_bytes": None,
    "shared_memory_bytes": None,
    "wmem_max": None,
    "busy_poll_us": None,
    "interrupts": 0,
    "clock_source": None,
    "synchronised": None,
    "quota": None,
    "middleware": {},
}


def findings(facts: HostFacts, measured: HostMeasurement = MEASURED) -> dict[str, str]:
    judged = {check.id.removeprefix("IGTL-"): check.judge(facts, measured) for check in HOST_CHECKS}
    return {name: one.found for name, one in judged.items() if one.status is Status.FINDING}


def test_a_good_machine() -> None:
    assert findings(GOOD) == {}
    assert all(check.judge(GOOD, MEASURED).status is Status.OK for check in HOST_CHECKS)


@table(("name", "changed", "found"), BAD)
def test_each_finding(name: str, changed: dict[str, Any], found: str) -> None:
    assert findings(replace(GOOD, **changed)) == {name: found}


def test_measurements() -> None:
    late, slow = Delays(60_000, 900_000, 4_000_000), Delays(4_000, 300_000, 400_000)
    assert findings(GOOD, replace(MEASURED, lateness=late)) == {"W924": "p50 60 µs, p99 900 µs, max 4,000 µs"}
    assert findings(GOOD, replace(MEASURED, handover=slow)) == {"W925": "p50 4 µs, p99 300 µs, max 400 µs"}
    found = {"W908": "3.0% of the time during the measurement; 0.1% since the start"}
    assert findings(GOOD, replace(MEASURED, steal=0.03)) == found


def test_every_check_has_a_finding() -> None:
    measured = {"W908", "W924", "W925"}
    assert {name for name, _, _ in BAD} | measured == {check.id.removeprefix("IGTL-") for check in HOST_CHECKS}


def test_facts_that_are_not_shown() -> None:
    hidden = replace(GOOD, **HIDDEN)
    assert findings(hidden, replace(MEASURED, steal=None)) == {}
    unknown = {check.id for check in HOST_CHECKS if check.judge(hidden, MEASURED).status is Status.UNKNOWN}
    known = {"IGTL-I912", "IGTL-I914", "IGTL-W908", "IGTL-W924", "IGTL-W925"}
    assert unknown == {check.id for check in HOST_CHECKS} - known


def test_a_limit_for_idle_states_that_a_program_has_set() -> None:
    deep = replace(GOOD, idle_states=(IdleState("C1", 2), IdleState("C6", 133)), dma_latency_us=20)
    assert findings(deep) == {}
    assert findings(replace(deep, dma_latency_us=0)) == {}


def test_real_time_without_a_bound_for_it() -> None:
    assert findings(replace(GOOD, rt_runtime_us=-1)) == {}


def test_no_check_is_an_error() -> None:
    assert {check.severity for check in HOST_CHECKS} == {Severity.WARNING, Severity.INFO}
