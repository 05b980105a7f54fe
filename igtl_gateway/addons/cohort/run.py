"""What a run does with which files, and where: what its tasks, the scheduler and the tables share."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, NamedTuple

from igtl_gateway.addons.cohort.sources import Located

Reply = dict[str, Any]


class KnownFile(NamedTuple):
    """A file.

    Attributes:
        file: where it is.
        content: the SHA-256 of its content at the last time.
        part: settings of a task that is not the whole file.
    """

    file: Located
    content: str
    part: Mapping[str, Any] = MappingProxyType({})


#: Does the tasks of files, and yields each with its reply.
Runner = Callable[["RunSettings", Sequence[KnownFile]], Iterator[tuple[KnownFile, Reply]]]


@dataclass(frozen=True, slots=True)
class RunPlace:
    """Where the tasks run.

    Attributes:
        workers: number of files at a time on this machine.
        scheduler: address of the scheduler of a cluster; "": this machine.
        tls_ca, tls_cert, tls_key: files for TLS; "": none.
    """

    workers: int
    scheduler: str = ""
    tls_ca: str = ""
    tls_cert: str = ""
    tls_key: str = ""


@dataclass(frozen=True, slots=True)
class RunSettings:
    """What a run does with each file.

    Attributes:
        verb: one of ``ends.VERB_NAMES``.
        settings: of the verb.
        limits: words of ``--limit``.
        memory: bytes that a worker's data may take; 0: any number.
        timeout_s: time for a file, s.
    """

    verb: str
    settings: Mapping[str, Any]
    limits: Sequence[str] = ()
    memory: int = 2 << 30
    timeout_s: float = 600.0

    @property
    def text(self) -> str:
        """The settings that decide about the rows."""
        return json.dumps({"limits": sorted(self.limits), **self.settings}, sort_keys=True)
