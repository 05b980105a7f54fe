"""What the figures should be: a table, and which of it is met."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from fnmatch import fnmatch

from igtl_gateway_lab.bench.cases import CASES
from igtl_gateway_lab.bench.runner import Row


@dataclass(frozen=True, slots=True)
class Bound:
    """One figure of some rows.

    Attributes:
        field: of the row, or of what is ``with_derived_figures`` of it; a row without the field is not compared.
        limit: at most so much, or, with ``least``, at least.
        cases: patterns, one of which the name of the case matches.
        stream: pattern for what was sent.
        flood: for floods (True), for what has a rate (False), for both (None).
        recording: the same, for what was measured with a recording.
    """

    field: str
    limit: float
    cases: tuple[str, ...] = ("*",)
    stream: str = "*"
    least: bool = False
    flood: bool | None = None
    recording: bool | None = None

    @property
    def text(self) -> str:
        return f"{self.field} {'>=' if self.least else '<='} {self.limit:g}"

    def met(self, value: float) -> bool:
        return value >= self.limit if self.least else value <= self.limit

    def concerns(self, row: Row) -> bool:
        """Whether it is for a row of a measurement."""
        return (
            any(fnmatch(row["case"], case) for case in self.cases)
            and fnmatch(row.get("stream", row["case"]), self.stream)
            and self.flood in (None, row["rate_hz"] is None)
            and self.recording in (None, row.get("recording", False))
        )


_LARGE = ("image-*", "cloud-*", "polydata-*")
_SMALL = ("transform", "string-*", "points-*")
_ALONE = tuple(name for name, case in CASES.items() if not case.together)

BOUNDS: Sequence[Bound] = (
    Bound("lost", 0),
    Bound("ratio", 1.3, _LARGE),
    Bound("ratio", 1.6, _SMALL),
    Bound("p99/p50", 3, _ALONE, flood=False),
    Bound("ms over floor", 2, ("points-10000", "cloud-10k")),
    Bound("p50_ms", 150, ("polydata-600k",), flood=False),
    Bound("received_per_s", 20_000, ("transform",), least=True, flood=True),
    Bound("received_per_s", 60, ("image-fullhd",), least=True, flood=True),
    Bound("p99_ms", 3, ("mixed",), stream="transform"),
    Bound("recording_p50_ratio", 1.10),
    Bound("recording_p99_ratio", 1.25),
    Bound("recorder_dropped", 0),
    Bound("gateway_rss_peak_mb", 400, ("stalled-client",), recording=False),
    Bound("lost after resume", 0, ("stalled-client",), stream="transform"),
)


def with_verdict(row: Row) -> Row:
    """A row of a measurement, with our own programs, with its ``bounds``: what should be → whether it is."""
    if not row.get("direction") or row.get("peer"):
        return row
    values = with_derived_figures(row)
    found = {
        bound.text: bound.met(values[bound.field])
        for bound in BOUNDS
        if values.get(bound.field) is not None and bound.concerns(row)
    }
    return row | {"bounds": found}


def with_derived_figures(row: Row) -> Row:
    """A row, and what bounds need to know besides."""
    p50, floor = row.get("p50_ms"), row.get("floor_p50_ms")
    told = row | {
        "p99/p50": row["p99_ms"] / p50 if p50 else None,
        "ms over floor": p50 - floor if p50 and floor else None,
    }
    if "sent_after_resume" in row:
        return told | {"lost after resume": row["sent_after_resume"] - row["delivered_after_resume"]}
    return told | {"lost": row["sent"] - row["delivered"]}


def shown(row: Row) -> str:
    """For people: "met", or what is not."""
    bounds = row.get("bounds")
    if not bounds:
        return ""
    missed = [text for text, met in bounds.items() if not met]
    return f"not {', '.join(missed)}" if missed else "met"
