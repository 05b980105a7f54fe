"""The checks of ``doctor --host``: one table, each row with the judgement of a fact.

A judgement is a pure function of the facts and the measurement.  The identifiers continue those of ``rules``: the
letter is the severity, and a number never changes its meaning.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum

from igtl_gateway.base.quantities import count_text
from igtl_gateway.base.realtime import cpus_text
from igtl_gateway.doctor.host_facts import HostFacts
from igtl_gateway.doctor.host_probe import Delays, HostMeasurement
from igtl_gateway.doctor.middleware import losses_of, versions_text
from igtl_gateway.doctor.rules import Severity

#: A CPU that needs longer to wake up delays each pose of a slow stream noticeably.
MAX_IDLE_LATENCY_US = 50
#: The bridge has threads for DDS and for TCP, and a recorder; the other programs of the machine need CPUs, too.
MIN_CPUS = 4
#: Processes that run or wait, for each CPU.
MAX_LOAD = 0.7
#: Share of the time that other virtual machines may take.
MAX_STEAL = 0.005
#: By default Linux gives normal processes 50 µs.
MAX_SLACK_NS = 50_000
#: Share of the time that real-time threads need at least.
MIN_RT_SHARE = 0.9
#: Room for some segments of Fast DDS (see edges/ros/env.py): of the bridge and of other programs.
MIN_SHARED_BYTES = 128 << 20
#: A Full HD image in RGB has 6 MB.
MIN_SOCKET_BYTES = 8 << 20
#: The least CPU time that the mixed load needs, with its recorder.
MIN_QUOTA = 2.0
#: Clock sources that the kernel reads without a system call.
FAST_CLOCKS = frozenset({"tsc", "kvm-clock", "hyperv_clocksource_tsc_page", "arch_sys_counter"})
#: Bounds of the measurement: a tenth of the bound of a pose (docs/evidence/performance.md), and a half of its median.
MAX_LATE_P99_NS, MAX_HANDOVER_P99_NS = 300_000, 100_000


class Status(Enum):
    """The result of a check."""

    OK = "ok"
    FINDING = "finding"
    UNKNOWN = "unknown"  #: the system does not have the fact, or does not show it to this user


@dataclass(frozen=True, slots=True)
class Judgement:
    """The result of a check, and the fact in words."""

    status: Status
    found: str


@dataclass(frozen=True, slots=True)
class HostCheck:
    """A row of the table.

    Attributes:
        id: such as ``IGTL-W903``: letter of the severity, and a number that never changes its meaning.
        title: the subject of the check.
        expected: in words.
        advice: how to get it.
        judge: the judgement.
    """

    id: str
    title: str
    expected: str
    advice: str
    judge: Callable[[HostFacts, HostMeasurement], Judgement]

    @property
    def severity(self) -> Severity:
        return next(one for one in Severity if one.name[0] == self.id[5])


def _judged(is_good: bool, found: str) -> Judgement:
    return Judgement(Status.OK if is_good else Status.FINDING, found)


_UNKNOWN = Judgement(Status.UNKNOWN, "not shown by this system")


def of_fact(judge: Callable[[HostFacts], Judgement | None]) -> Callable[[HostFacts, HostMeasurement], Judgement]:
    """Return the judgement of facts alone; None stands for an unknown fact."""
    return lambda facts, _measured: judge(facts) or _UNKNOWN


def preemption(facts: HostFacts) -> Judgement | None:
    mode = facts.preemption
    return None if mode is None else _judged(mode in ("rt", "full", "lazy"), f"preemption: {mode}")


def realtime_kernel(facts: HostFacts) -> Judgement | None:
    if not facts.version:
        return None
    return _judged(facts.preemption == "rt", "PREEMPT_RT" if facts.preemption == "rt" else "no PREEMPT_RT")


def governor(facts: HostFacts) -> Judgement | None:
    if not facts.governors:
        return None
    return _judged(facts.governors == ("performance",), f"governor {', '.join(facts.governors)}")


def idle_states(facts: HostFacts) -> Judgement | None:
    if not facts.idle_states:
        return None
    limit = facts.dma_latency_us
    usable = [state for state in facts.idle_states if limit is None or state.latency_us <= limit]
    deepest = usable[-1] if usable else facts.idle_states[0]
    return _judged(
        deepest.latency_us <= MAX_IDLE_LATENCY_US, f"{deepest.name} takes {deepest.latency_us} µs to wake up"
    )


def cpu_count(facts: HostFacts) -> Judgement | None:
    count = len(facts.cpus)
    return (
        _judged(count >= MIN_CPUS, f"{count} CPU{'' if count == 1 else 's'}: {cpus_text(facts.cpus)}")
        if count
        else None
    )


def smt(facts: HostFacts) -> Judgement | None:
    if facts.smt is None:
        return None
    return _judged(not facts.smt, "two CPUs share a core" if facts.smt else "one CPU for each core")


def load(facts: HostFacts) -> Judgement | None:
    if facts.load is None or not facts.cpus:
        return None
    return _judged(facts.load <= MAX_LOAD * len(facts.cpus), f"load {facts.load:g} on {len(facts.cpus)} CPUs")


def interrupts(facts: HostFacts) -> Judgement | None:
    if not facts.interrupts:
        return None
    isolated = f"CPUs {cpus_text(facts.isolated)} isolated" if facts.isolated else "no CPU isolated"
    found = f"{facts.free_interrupts} of {facts.interrupts} interrupts run on every CPU; {isolated}"
    return _judged(bool(facts.isolated) and not facts.free_interrupts, found)


def timers(facts: HostFacts) -> Judgement | None:
    if facts.high_resolution is None:
        return None
    return _judged(facts.high_resolution, "high resolution" if facts.high_resolution else "resolution of the tick")


def timer_slack(facts: HostFacts) -> Judgement | None:
    slack_ns = facts.timer_slack_ns
    return None if slack_ns is None else _judged(slack_ns <= MAX_SLACK_NS, f"{slack_ns / 1000:g} µs")


def autogroup(facts: HostFacts) -> Judgement | None:
    if facts.autogroup is None:
        return None
    return _judged(not facts.autogroup, "autogroup is on" if facts.autogroup else "autogroup is off")


def realtime_limit(facts: HostFacts) -> Judgement:
    limit = facts.realtime_limit
    return _judged(limit is None or limit > 0, "all priorities" if limit is None else f"RLIMIT_RTPRIO {limit}")


def realtime_budget(facts: HostFacts) -> Judgement | None:
    runtime, period = facts.rt_runtime_us, facts.rt_period_us
    if runtime is None or not period:
        return None
    if facts.group_rt_runtime_us == 0:
        return _judged(False, "0 µs for this control group")
    if runtime < 0:
        return _judged(True, "unlimited")
    return _judged(runtime >= MIN_RT_SHARE * period, f"{runtime:,} of {period:,} µs")


def memory_limit(facts: HostFacts) -> Judgement:
    limit = facts.memlock_bytes
    return _judged(limit is None, "unlimited" if limit is None else f"RLIMIT_MEMLOCK {limit >> 10:,} KiB")


def huge_pages(facts: HostFacts) -> Judgement | None:
    mode = facts.huge_pages
    return None if mode is None else _judged(mode != "always", mode)


def swap(facts: HostFacts) -> Judgement | None:
    size = facts.swap_bytes
    return None if size is None else _judged(size == 0, f"{_mib(size)} swap space" if size else "no swap space")


def shared_memory(facts: HostFacts) -> Judgement | None:
    free = facts.shared_memory_bytes
    return None if free is None else _judged(free >= MIN_SHARED_BYTES, f"{_mib(free)} free in /dev/shm")


def socket_buffers(facts: HostFacts) -> Judgement | None:
    if facts.rmem_max is None or facts.wmem_max is None:
        return None
    found = f"rmem_max {facts.rmem_max:,}, wmem_max {count_text(facts.wmem_max, 'byte')}"
    return _judged(min(facts.rmem_max, facts.wmem_max) >= MIN_SOCKET_BYTES, found)


def busy_poll(facts: HostFacts) -> Judgement | None:
    poll_us = facts.busy_poll_us
    return None if poll_us is None else _judged(poll_us > 0, f"busy_poll {poll_us} µs")


def clock_source(facts: HostFacts) -> Judgement | None:
    source = facts.clock_source
    return None if source is None else _judged(source in FAST_CLOCKS, source)


def synchronised(facts: HostFacts) -> Judgement | None:
    if facts.synchronised is None:
        return None
    hardware = f"; {facts.ptp_clocks} PTP clock{'' if facts.ptp_clocks == 1 else 's'}" if facts.ptp_clocks else ""
    return _judged(facts.synchronised, f"{'' if facts.synchronised else 'not '}synchronised{hardware}")


def quota(facts: HostFacts) -> Judgement | None:
    cpus = facts.quota
    if cpus is None:
        return None
    return _judged(cpus >= MIN_QUOTA, "no quota" if cpus == float("inf") else f"quota of {cpus:g} CPUs")


def middleware(facts: HostFacts) -> Judgement:
    versions = facts.middleware
    if not versions:
        return Judgement(Status.UNKNOWN, "no ROS 2 with Fast DDS here")
    lost = [f"{loss.effect} ({loss.source})" for loss in losses_of(versions)]
    return _judged(not lost, ": ".join((versions_text(versions), *(["; ".join(lost)] if lost else []))))


def steal(facts: HostFacts, measured: HostMeasurement) -> Judgement:
    share = measured.steal
    if share is None:
        return _UNKNOWN
    total = (
        f"; {facts.times.steal / facts.times.total:.1%} since the start" if facts.times and facts.times.total else ""
    )
    return _judged(share <= MAX_STEAL, f"{share:.1%} of the time during the measurement{total}")


def lateness(_facts: HostFacts, measured: HostMeasurement) -> Judgement:
    return _judged(measured.lateness.p99_ns <= MAX_LATE_P99_NS, _delays(measured.lateness))


def handover(_facts: HostFacts, measured: HostMeasurement) -> Judgement:
    return _judged(measured.handover.p99_ns <= MAX_HANDOVER_P99_NS, _delays(measured.handover))


def _delays(delays: Delays) -> str:
    p50, p99, most = (ns / 1000 for ns in (delays.p50_ns, delays.p99_ns, delays.max_ns))
    return f"p50 {p50:,.0f} µs, p99 {p99:,.0f} µs, max {most:,.0f} µs"


def _mib(size: int) -> str:
    return f"{size >> 20:,} MiB"


HOST_CHECKS: tuple[HostCheck, ...] = (
    HostCheck(
        "IGTL-W924", "lateness of wake-ups (1,000 sleeps of 1 ms)", f"p99 up to {MAX_LATE_P99_NS // 1000} µs",
        "see the other findings; `bridge --realtime-priority` for the threads that pass messages", lateness,
    ),
    HostCheck(
        "IGTL-W925", "hand-over between two threads", f"p99 up to {MAX_HANDOVER_P99_NS // 1000} µs",
        "see the other findings; stop other programs that use the CPUs", handover,
    ),
    HostCheck(
        "IGTL-W908", "time taken by other virtual machines (steal)", f"up to {MAX_STEAL:.1%}",
        "reserve physical CPUs for the virtual machine, or use a physical machine", steal,
    ),
    HostCheck(
        "IGTL-W907", "load", f"up to {MAX_LOAD:g} for each CPU",
        "stop other programs, or move them to another machine", of_fact(load),
    ),
    HostCheck(
        "IGTL-W923", "CPU quota of the control group", f"none, or {MIN_QUOTA:g} CPUs",
        "Docker: no `--cpus`; Kubernetes: no CPU limit, or the static CPU manager; systemd: no CPUQuota=",
        of_fact(quota),
    ),
    HostCheck(
        "IGTL-W905", "number of CPUs", f"{MIN_CPUS} or more",
        "use a machine with more CPUs, or run other programs on another machine", of_fact(cpu_count),
    ),
    HostCheck(
        "IGTL-I906", "SMT (hyper-threading)", "one CPU for each core",
        "`echo off > /sys/devices/system/cpu/smt/control`, or in the firmware", of_fact(smt),
    ),
    HostCheck(
        "IGTL-W903", "CPU frequency", "governor performance",
        "`cpupower frequency-set --governor performance`", of_fact(governor),
    ),
    HostCheck(
        "IGTL-W904", "idle states of the CPUs", f"{MAX_IDLE_LATENCY_US} µs or less to wake up",
        f"`cpupower idle-set --disable-by-latency {MAX_IDLE_LATENCY_US}`, or a program that keeps /dev/cpu_dma_latency "
        "open with this limit",
        of_fact(idle_states),
    ),
    HostCheck(
        "IGTL-W901", "preemption of the kernel", "full, lazy or rt",
        "boot with `preempt=full`; the current mode is in /sys/kernel/debug/sched/preempt (root)", of_fact(preemption),
    ),
    HostCheck(
        "IGTL-I902", "real-time kernel", "PREEMPT_RT",
        "Debian: `apt install linux-image-rt-amd64`; Ubuntu: `pro enable realtime-kernel`", of_fact(realtime_kernel),
    ),
    HostCheck(
        "IGTL-I920", "interrupts and isolated CPUs", "CPUs without interrupts for `--cpu-affinity`",
        "boot with `isolcpus=` and `irqaffinity=`, stop irqbalance, and pass the isolated CPUs to "
        "`bridge --cpu-affinity`",
        of_fact(interrupts),
    ),
    HostCheck(
        "IGTL-W909", "timers", "high resolution", "boot without `highres=off`, and with an invariant TSC",
        of_fact(timers),
    ),
    HostCheck(
        "IGTL-I910", "timer slack", f"{MAX_SLACK_NS // 1000} µs or less",
        "start the bridge from a service manager that does not raise it; SCHED_FIFO has none", of_fact(timer_slack),
    ),
    HostCheck(
        "IGTL-I911", "scheduling by session (autogroup)", "off",
        "`sysctl kernel.sched_autogroup_enabled=0`; with it, a nice value counts only within its session",
        of_fact(autogroup),
    ),
    HostCheck(
        "IGTL-I912", "permission for real-time priorities", "1 or more",
        "add 'USER - rtprio 50' to /etc/security/limits.conf and log in again (systemd: LimitRTPRIO=)",
        of_fact(realtime_limit),
    ),
    HostCheck(
        "IGTL-W913", "time for real-time threads", f"{MIN_RT_SHARE:.0%} or more",
        "`sysctl kernel.sched_rt_runtime_us=950000`; control groups of version 1: write to cpu.rt_runtime_us",
        of_fact(realtime_budget),
    ),
    HostCheck(
        "IGTL-I914", "permission to lock memory", "unlimited",
        "add 'USER - memlock unlimited' to /etc/security/limits.conf and log in again (systemd: LimitMEMLOCK=infinity)",
        of_fact(memory_limit),
    ),
    HostCheck(
        "IGTL-W916", "swap", "no swap space", "`swapoff -a`, or `bridge --lock-memory`", of_fact(swap),
    ),
    HostCheck(
        "IGTL-W915", "transparent huge pages", "madvise or never",
        "`echo madvise > /sys/kernel/mm/transparent_hugepage/enabled`", of_fact(huge_pages),
    ),
    HostCheck(
        "IGTL-W917", "shared memory for Fast DDS", f"{_mib(MIN_SHARED_BYTES)} free in /dev/shm",
        "`mount -o remount,size=1G /dev/shm`; Docker: `--shm-size 1g`", of_fact(shared_memory),
    ),
    HostCheck(
        "IGTL-W918", "socket buffers", f"rmem_max and wmem_max {MIN_SOCKET_BYTES:,} bytes or more",
        f"`sysctl net.core.rmem_max={MIN_SOCKET_BYTES} net.core.wmem_max={MIN_SOCKET_BYTES}`", of_fact(socket_buffers),
    ),
    HostCheck(
        "IGTL-I919", "busy polling of the network", "busy_poll above 0",
        "`sysctl net.core.busy_poll=50 net.core.busy_read=50`: lower latency with network cards at the cost of CPU "
        "time; no effect within the machine",
        of_fact(busy_poll),
    ),
    HostCheck(
        "IGTL-W921", "clock source", "one without a system call: " + ", ".join(sorted(FAST_CLOCKS)),
        "`echo tsc > /sys/devices/system/clocksource/clocksource0/current_clocksource`, if it is available",
        of_fact(clock_source),
    ),
    HostCheck(
        "IGTL-W922", "synchronised clock", "synchronised by NTP or PTP",
        "run chrony or systemd-timesyncd; ptp4l and phc2sys for network cards with a PTP clock", of_fact(synchronised),
    ),
    HostCheck(
        "IGTL-W926", "ROS middleware", "a version without a known loss",
        "update the package, or use `bridge --ros zenoh` with rmw_zenoh_cpp in all nodes", of_fact(middleware),
    ),
)  # fmt: skip
