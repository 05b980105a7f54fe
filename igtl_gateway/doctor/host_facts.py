"""What ``doctor --host`` reads of a machine: facts about scheduling, memory, clocks and network, without a judgement.

All files are below one root folder, so that tests provide their own.  A fact that the system does not have, or does not
show to this user, is None or empty: no reading fails.
"""

from __future__ import annotations

import ctypes
import re
import shutil
import struct
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from igtl_gateway.base.errors import ConfigError
from igtl_gateway.base.realtime import CAP_IPC_LOCK, CAP_SYS_NICE, has_capability
from igtl_gateway.base.untrusted.numbers import whole_number
from igtl_gateway.config.notations import cpus
from igtl_gateway.doctor.middleware import Version, installed, prefixes

ROOT = Path("/")

T = TypeVar("T")

#: ``adjtimex`` (sys/timex.h): size of its struct with room to spare, the field ``status``, and the flag in it.
_TIMEX_BYTES, _STATUS_AT, _STA_UNSYNC = 512, 40, 0x40


@dataclass(frozen=True, slots=True)
class CpuTimes:
    """Time of all CPUs since the start of the system, in ticks of the kernel (/proc/stat)."""

    total: int
    steal: int

    def steal_since(self, before: CpuTimes) -> float | None:
        """Return the share of the time since ``before`` that other virtual machines used; None without time."""
        total = self.total - before.total
        return (self.steal - before.steal) / total if total > 0 else None


@dataclass(frozen=True, slots=True)
class IdleState:
    """A sleep state of the CPUs that is enabled on at least one of them."""

    name: str
    latency_us: int


@dataclass(frozen=True, slots=True)
class HostFacts:
    """The facts; None or empty: unknown, or the system has no such thing.

    Attributes:
        version: of the kernel, as in /proc/version.
        preemption: how the kernel preempts itself: ``rt``, ``full``, ``lazy``, ``voluntary`` or ``none``.
        governors: of the CPU frequency, each once.
        idle_states: of the CPUs, with the time to wake up.
        dma_latency_us: limit of that time that a program has set (/dev/cpu_dma_latency).
        cpus: CPUs that this process may use.
        isolated: CPUs that the scheduler leaves alone.
        smt: whether two CPUs share a core.
        load: processes that run or wait to run, averaged over one minute.
        times: of the CPUs.
        high_resolution: whether timers are more precise than the tick of the kernel.
        timer_slack_ns: time by which the system may delay the wake-up of a normal thread of this program.
        autogroup: whether each session gets an equal share of the CPUs, so that nice values count only within it.
        realtime_limit: highest permitted priority of SCHED_FIFO; None: unlimited.
        rt_runtime_us, rt_period_us: share of time for real-time threads of the system; -1: unlimited.
        group_rt_runtime_us: the same of this control group, if the system divides the budget among groups.
        memlock_bytes: memory that this process may lock; None: unlimited.
        huge_pages: transparent huge pages: ``always``, ``madvise`` or ``never``.
        swap_bytes: size of the swap space.
        shared_memory_bytes: free space in /dev/shm.
        rmem_max, wmem_max: largest socket buffers, in bytes.
        busy_poll_us: time that a waiting receiver polls the network card.
        interrupts: number of interrupts.
        free_interrupts: number of those that may run on every CPU that this process may use.
        clock_source: of the kernel.
        synchronised: whether a program (NTP, PTP) adjusts the clock.
        ptp_clocks: number of clocks for PTP.
        quota: CPUs' worth of time that the control group may use; infinity: no limit.
        middleware: versions of the packages of `middleware.LOSSES` that are installed.
    """

    version: str
    preemption: str | None
    governors: tuple[str, ...]
    idle_states: tuple[IdleState, ...]
    dma_latency_us: int | None
    cpus: frozenset[int]
    isolated: frozenset[int]
    smt: bool | None
    load: float | None
    times: CpuTimes | None
    high_resolution: bool | None
    timer_slack_ns: int | None
    autogroup: bool | None
    realtime_limit: int | None
    rt_runtime_us: int | None
    rt_period_us: int | None
    group_rt_runtime_us: int | None
    memlock_bytes: int | None
    huge_pages: str | None
    swap_bytes: int | None
    shared_memory_bytes: int | None
    rmem_max: int | None
    wmem_max: int | None
    busy_poll_us: int | None
    interrupts: int
    free_interrupts: int
    clock_source: str | None
    synchronised: bool | None
    ptp_clocks: int
    quota: float | None
    middleware: Mapping[str, Version]


def is_clock_synchronised() -> bool | None:
    """Return whether a program adjusts the system's clock; None if that is unknown."""
    try:
        adjtimex = ctypes.CDLL(None).adjtimex
    except (OSError, AttributeError, TypeError):  # not Linux
        return None
    timex = ctypes.create_string_buffer(_TIMEX_BYTES)  # modes = 0: read only
    if adjtimex(timex) < 0:
        return None
    (status,) = struct.unpack_from("=i", timex.raw, _STATUS_AT)
    return not status & _STA_UNSYNC


def free_bytes(folder: Path) -> int | None:
    """Return the free space of a file system; None without the folder."""
    try:
        return shutil.disk_usage(folder).free
    except OSError:  # no such folder
        return None


def read_times(root: Path = ROOT) -> CpuTimes | None:
    """Return the times of the CPUs."""
    words = _text(root / "proc/stat").partition("\n")[0].split()
    if len(words) < 9 or words[0] != "cpu":
        return None
    numbers = [int(word) for word in words[1:9]]  # the last two fields are included in the first two
    return CpuTimes(sum(numbers), numbers[7])


def read_facts(
    root: Path = ROOT,
    synchronised: Callable[[], bool | None] = is_clock_synchronised,
    free: Callable[[Path], int | None] = free_bytes,
    ros: Iterable[Path] | None = None,
) -> HostFacts:
    """Read all facts of the machine whose folders ``proc``, ``sys`` and ``dev`` are in ``root``.

    Args:
        root, synchronised, free: of the machine.
        ros: the folders with ROS packages; None: those of this environment.
    """
    proc, cpu, kernel = root / "proc", root / "sys/devices/system/cpu", root / "proc/sys/kernel"
    core = root / "proc/sys/net/core"
    status = proc / "self/status"
    cpus = _cpus(_field(status, "Cpus_allowed_list:"))
    interrupts = [_cpus(_text(path)) for path in sorted(proc.glob("irq/[0-9]*/smp_affinity_list"))]
    version = _text(proc / "version").strip()
    return HostFacts(
        version=version,
        preemption=_preemption(root, version),
        governors=tuple(sorted({_text(path).strip() for path in cpu.glob("cpu[0-9]*/cpufreq/scaling_governor")})),
        idle_states=_idle_states(cpu),
        dma_latency_us=_dma_latency(root / "dev/cpu_dma_latency"),
        cpus=cpus,
        isolated=_cpus(_text(cpu / "isolated")),
        smt={"0": False, "1": True}.get(_text(cpu / "smt/active").strip()),
        load=_float(_text(proc / "loadavg").partition(" ")[0]),
        times=read_times(root),
        high_resolution=_high_resolution(proc / "timer_list"),
        timer_slack_ns=_number(proc / "self/timerslack_ns"),
        autogroup=None if (autogroup := _number(kernel / "sched_autogroup_enabled")) is None else bool(autogroup),
        realtime_limit=None if has_capability(CAP_SYS_NICE, status) else _limit(proc, "Max realtime priority"),
        rt_runtime_us=_number(kernel / "sched_rt_runtime_us"),
        rt_period_us=_number(kernel / "sched_rt_period_us"),
        group_rt_runtime_us=_first(_number(folder / "cpu.rt_runtime_us") for folder in _groups(root)),
        memlock_bytes=None if has_capability(CAP_IPC_LOCK, status) else _limit(proc, "Max locked memory"),
        huge_pages=_chosen(_text(root / "sys/kernel/mm/transparent_hugepage/enabled")),
        swap_bytes=_kib(_field(proc / "meminfo", "SwapTotal:")),
        shared_memory_bytes=free(root / "dev/shm"),
        rmem_max=_number(core / "rmem_max"),
        wmem_max=_number(core / "wmem_max"),
        busy_poll_us=_number(core / "busy_poll"),
        interrupts=len(interrupts),
        free_interrupts=sum(bool(cpus) and cpus <= allowed for allowed in interrupts),
        clock_source=_text(root / "sys/devices/system/clocksource/clocksource0/current_clocksource").strip() or None,
        synchronised=synchronised(),
        ptp_clocks=len(list(root.glob("sys/class/ptp/ptp*"))),
        quota=_first(_quota(folder) for folder in _groups(root)),
        middleware=installed(prefixes() if ros is None else ros),
    )


def _text(path: Path) -> str:
    """Return the content of a file; empty if it cannot be read."""
    try:
        return path.read_text("utf-8", "replace")
    except OSError:
        return ""


def _number(path: Path) -> int | None:
    with suppress(ValueError):
        return int(_text(path))
    return None


def _float(text: str) -> float | None:
    with suppress(ValueError):
        return float(text)
    return None


def _cpus(text: str) -> frozenset[int]:
    with suppress(ConfigError):
        return cpus(text.strip())
    return frozenset()


def _field(path: Path, name: str) -> str:
    """Return the rest of the line that begins with a name."""
    return next((line.removeprefix(name).strip() for line in _text(path).splitlines() if line.startswith(name)), "")


def _kib(text: str) -> int | None:
    number = _float(text.removesuffix("kB"))
    return None if number is None else int(number) << 10


def _limit(proc: Path, name: str) -> int | None:
    """Return a soft limit of this process; None: unlimited."""
    soft = _field(proc / "self/limits", name).partition(" ")[0]
    return whole_number(soft)


def _chosen(text: str) -> str | None:
    """Return the word in brackets: ``always [madvise] never``.  Parentheses are used as well."""
    found = re.search(r"[\[(](\w+)[\])]", text)
    return found[1] if found else None


def _first(numbers: Iterator[T | None]) -> T | None:
    return next((number for number in numbers if number is not None), None)


def _preemption(root: Path, version: str) -> str | None:
    if "PREEMPT_RT" in version or _text(root / "sys/kernel/realtime").strip() == "1":
        return "rt"
    if "PREEMPT_DYNAMIC" not in version:
        return "full" if re.search(r"\bPREEMPT\b", version) else "voluntary" if version else None
    chosen = re.findall(r"\bpreempt=(\w+)", _text(root / "proc/cmdline"))
    return _chosen(_text(root / "sys/kernel/debug/sched/preempt")) or (chosen[-1] if chosen else None)


def _idle_states(cpu: Path) -> tuple[IdleState, ...]:
    states = set()
    for folder in cpu.glob("cpu[0-9]*/cpuidle/state[0-9]*"):
        latency = _number(folder / "latency")
        if latency is not None and _number(folder / "disable") != 1:
            states.add(IdleState(_text(folder / "name").strip(), latency))
    return tuple(sorted(states, key=lambda state: (state.latency_us, state.name)))


def _dma_latency(path: Path) -> int | None:
    """Return the strictest request of all programs; the device has four bytes and is for root."""
    try:
        with path.open("rb") as file:
            data = file.read(4)
    except OSError:
        return None
    return int.from_bytes(data, "little") if len(data) == 4 else None


def _high_resolution(path: Path) -> bool | None:
    found = re.findall(r"\.hres_active\s*: ([0-9])", _text(path))
    return all(one == "1" for one in found) if found else None


def _groups(root: Path) -> Iterator[Path]:
    """Yield the folders of this process's control group for CPUs, of versions 2 and 1, then the top folders."""
    base = root / "sys/fs/cgroup"
    for line in _text(root / "proc/self/cgroup").splitlines():
        _, controllers, path = [*line.split(":", 2), "", ""][:3]
        if not controllers:
            yield base / path.lstrip("/")
        elif "cpu" in controllers.split(","):
            yield base / "cpu" / path.lstrip("/")
    yield from (base, base / "cpu")


def _quota(folder: Path) -> float | None:
    limit = _text(folder / "cpu.max").split()
    if len(limit) == 2:
        return float("inf") if limit[0] == "max" else int(limit[0]) / int(limit[1])
    quota, period = _number(folder / "cpu.cfs_quota_us"), _number(folder / "cpu.cfs_period_us")
    if quota is None or not period:
        return None
    return quota / period if quota > 0 else float("inf")
