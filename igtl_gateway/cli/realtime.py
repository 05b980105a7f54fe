"""Options for the scheduling of a bridge, also as the table ``[host]`` of its configuration file.

::

    [host]
    realtime_priority = 20
    lock_memory = true
    cpu_affinity = "2,3"

Each setting has the name and the meaning of its option; an option on the command line replaces it.  A recording does
not contain these settings.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from igtl_gateway.cli.options import Options
from igtl_gateway.config import HOST_TABLE, from_values, read_toml
from igtl_gateway.errors import ConfigError
from igtl_gateway.realtime import PRIORITIES, RealtimeOptions, parse_cpus


def add_arguments(group: Options) -> None:
    group.add_argument(
        "--realtime-priority",
        type=int,
        metavar="N",
        help=f"run the threads that pass messages with SCHED_FIFO at this priority, {PRIORITIES[0]} (lowest) to "
        f"{PRIORITIES[-1]}; needs CAP_SYS_NICE or RLIMIT_RTPRIO",
    )
    group.add_argument(
        "--lock-memory",
        action="store_true",
        help="keep the used memory of the bridge from being paged out; needs CAP_IPC_LOCK or RLIMIT_MEMLOCK",
    )
    group.add_argument(
        "--cpu-affinity",
        type=_cpus,
        metavar="LIST",
        help="run the threads that pass messages on these CPUs only, for example 2,4-6",
    )


def realtime_options(options: argparse.Namespace, path: Path | None) -> RealtimeOptions:
    """Return the options, completed by the configuration file.  Raises ConfigError."""
    file = _HostFile.read(path) if path else _HostFile()
    priority = options.realtime_priority
    if priority == 0:
        raise ConfigError(f"--realtime-priority: found 0, expected {PRIORITIES[0]} (lowest) to {PRIORITIES[-1]}")
    return RealtimeOptions(
        file.realtime_priority if priority is None else priority,
        options.lock_memory or file.lock_memory,
        parse_cpus(file.cpu_affinity)
        if options.cpu_affinity is None and file.cpu_affinity
        else options.cpu_affinity or frozenset(),
    )


@dataclass(frozen=True, slots=True)
class _HostFile:
    """The settings of the table; see the module."""

    realtime_priority: int = 0
    lock_memory: bool = False
    cpu_affinity: str = ""

    @classmethod
    def read(cls, path: Path) -> _HostFile:
        """Return the table of a file.  Raises ConfigError with file and setting."""
        table = read_toml(path).get(HOST_TABLE, {})
        try:
            if not isinstance(table, Mapping):
                raise ConfigError(f"found {HOST_TABLE} = {table!r}, expected a table [{HOST_TABLE}]")
            made = from_values(HOST_TABLE, cls, table)
            if made.realtime_priority and made.realtime_priority not in PRIORITIES:
                raise ConfigError(
                    f"{HOST_TABLE}.realtime_priority: found {made.realtime_priority}, "
                    f"expected {PRIORITIES[0]} (lowest) to {PRIORITIES[-1]}"
                )
            if made.cpu_affinity:
                parse_cpus(made.cpu_affinity)
        except ConfigError as error:
            raise ConfigError(f"{path}: {error}") from None
        except ValueError as error:
            raise ConfigError(f"{path}: {HOST_TABLE}.cpu_affinity: {error}") from None
        return made


def _cpus(text: str) -> frozenset[int]:
    try:
        return parse_cpus(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None
