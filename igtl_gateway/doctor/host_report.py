"""The report of ``doctor --host``: each check with what was found, what is expected, and how to get it."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from typing import Any

from igtl_gateway.base.clock import Clock
from igtl_gateway.base.errors import Unavailable
from igtl_gateway.doctor.host_checks import HOST_CHECKS, HostCheck, Judgement, Status
from igtl_gateway.doctor.host_facts import HostFacts, read_facts, read_times
from igtl_gateway.doctor.host_probe import HostMeasurement, measure
from igtl_gateway.doctor.rules import Severity

SECTION = "docs/reference/doctor.md: The machine"


@dataclass(frozen=True, slots=True)
class HostReport:
    """The checks of a machine.

    Attributes:
        measured: the results of the measurement.
        rows: the checks with their judgements, in the order of the table.
    """

    measured: HostMeasurement
    rows: tuple[tuple[HostCheck, Judgement], ...]

    @classmethod
    def of(cls, facts: HostFacts, measured: HostMeasurement) -> HostReport:
        """Apply the checks."""
        return cls(measured, tuple((check, check.judge(facts, measured)) for check in HOST_CHECKS))

    @property
    def findings(self) -> list[HostCheck]:
        """The checks whose expectation is not met, in the order of the table."""
        return [check for check, judgement in self.rows if judgement.status is Status.FINDING]

    @property
    def failed(self) -> bool:
        """Whether there is an error among the findings."""
        return any(check.severity is Severity.ERROR for check in self.findings)

    def to_dict(self) -> dict[str, Any]:
        """Return the report as JSON values."""
        return {
            "checks": [
                {
                    "id": check.id,
                    "severity": check.severity.value,
                    "title": check.title,
                    "status": judgement.status.value,
                    "found": judgement.found,
                    "expected": check.expected,
                    "advice": check.advice,
                    "section": SECTION,
                }
                for check, judgement in self.rows
            ],
            "measured": asdict(self.measured),
        }

    def lines(self) -> Iterator[str]:
        """Yield the lines that are printed: findings with their remedy, then what is good, then what is unknown."""
        for check, judgement in self.rows:
            if judgement.status is Status.FINDING:
                yield f"{check.severity.value.upper():<7} {check.id}  {check.title}"
                yield f"        - found {judgement.found}, expected {check.expected}"
                yield f"        {check.advice}"
        for status in (Status.OK, Status.UNKNOWN):
            for check, judgement in self.rows:
                if judgement.status is status:
                    yield f"{status.value:<7} {check.id}  {check.title}: {judgement.found}"
        warnings = [check for check in self.findings if check.severity is not Severity.INFO]
        if warnings:
            first = ", ".join(f"{check.title} ({check.id})" for check in warnings[:3])
            yield f"{len(warnings)} warning{'' if len(warnings) == 1 else 's'}: {first}{', …' if warnings[3:] else ''}"
        else:
            yield "no problems found"


def examine_host(clock: Clock) -> HostReport:
    """Measure this machine and apply the checks; takes two seconds.  Raises Unavailable on systems other than Linux."""
    if sys.platform != "linux":
        raise Unavailable(f"--host: found {sys.platform}, expected Linux")
    facts = read_facts()  # before the measurement, which is load itself
    measured = measure(clock)
    after = read_times()
    if facts.times and after:
        measured = replace(measured, steal=after.steal_since(facts.times))
    return HostReport.of(facts, measured)
