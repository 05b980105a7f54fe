"""What the figures should be: a table, and which of it is met."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from fnmatch import fnmatch

from igtl_gateway_lab.bench.cases import CASES
from igtl_gateway_lab.bench.figures import Row


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
        rate_hz: only for this rate.
    """

    field: str
    limit: float
    cases: tuple[str, ...] = ("*",)
    stream: str = "*"
    least: bool = False
    flood: bool | None = None
    recording: bool | None = None
    rate_hz: float | None = None

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
            and self.flood in (None, row.get("rate_hz") is None)
            and self.rate_hz in (None, row.get("rate_hz"))
            and self.recording in (None, row.get("recording", False))
        )


#: A floor whose p99 is below this leaves room for an absolute bound.
_CALM_MS = 2.0
_POSES_TEXTS = ("transform", "string-*")
_ALONE = tuple(name for name, case in CASES.items() if not case.together)

BOUNDS: Sequence[Bound] = (
    Bound("lost", 0),
    Bound("ratio_hop", 1.10, _POSES_TEXTS, flood=False),
    Bound("ratio", 1.10, ("image-*",)),
    Bound("ratio", 1.15, ("cloud-*", "polydata-*")),
    Bound("ratio", 1.6, ("points-*",)),
    Bound("p99/p50", 3, _ALONE, flood=False),
    Bound("ms over floor", 2, ("points-10000", "cloud-10k")),
    Bound("p50_ms", 150, ("polydata-600k",), flood=False),
    Bound("gateway_cpu_us_per_message", 60, _POSES_TEXTS, rate_hz=1000.0),
    Bound("gateway_cpu_us_per_message", 300, _POSES_TEXTS, rate_hz=30.0),
    Bound("received_per_s", 30_000, ("transform",), least=True, flood=True),
    Bound("rate/DDS", 0.85, ("transform",), least=True, flood=True),
    Bound("received_per_s", 60, ("image-fullhd",), least=True, flood=True),
    Bound("ratio_p99", 1.5, ("mixed",), stream="transform"),
    Bound("p99_ms where that of the floor is below 2", 3, ("mixed",), stream="transform"),
    Bound("recording_p50_ratio", 1.05),
    Bound("recording_p99_ratio", 1.10),
    Bound("sealing_p50_ratio", 1.05),
    Bound("sealing_cpu_percent", 3, ("mixed",)),
    Bound("recorder_dropped", 0),
    Bound("gateway_rss_peak_mb", 400, ("stalled-client",), recording=False),
    Bound("lost after resume", 0, ("stalled-client",), stream="transform"),
    Bound("gateway_cpu_percent", 0.5, ("idle",)),
    Bound("times_mixed_load", 8, ("recording",), least=True),
    Bound("port_p50_s", 3, ("start-up",)),
    Bound("gateway_rss_mb", 120, ("start-up", "idle")),
    Bound("cpu_ratio", 1.0, ("offline",), stream="info, *"),
    Bound("cpu_ratio", 2.0, ("offline",), stream="recover, *"),
    Bound("cpu_ratio", 2.0, ("offline",), stream="slice *"),
    Bound("cpu_ratio", 2.0, ("offline",), stream="view *, A"),
    Bound("cpu_ratio", 0.3, ("offline",), stream="export *"),
    Bound("us_an_entry", 3.4, ("offline",), stream="verify, A"),
    Bound("us_an_entry", 1.7, ("offline",), stream="diff *, A"),
    Bound("us_an_input", 100, ("offline",), stream="resim *"),
    Bound("sent_per_s", 150_000, ("offline",), stream="replay *", least=True),
)


def with_verdict(row: Row) -> Row:
    """A row of the gateway over DDS, with our own programs, with its ``bounds``: what should be → whether it is."""
    if row.get("peer") or row.get("bridge") or row.get("middleware"):
        return row
    values = with_derived_figures(row)
    found = {
        bound.text: bound.met(values[bound.field])
        for bound in BOUNDS
        if values.get(bound.field) is not None and bound.concerns(row)
    }
    return row | {"bounds": found} if found or row.get("direction") else row


def with_derived_figures(row: Row) -> Row:
    """A row, and what bounds need to know besides."""
    p50, p99, floor, rate = (row.get(name) for name in ("p50_ms", "p99_ms", "floor_p50_ms", "received_per_s"))
    dds, floor_p99 = row.get("floor_dds_per_s"), row.get("floor_p99_ms")
    values = row | {
        "p99/p50": p99 / p50 if p50 and p99 else None,
        "ms over floor": p50 - floor if p50 and floor else None,
        "rate/DDS": rate / dds if rate and dds else None,
        "p99_ms where that of the floor is below 2": p99 if floor_p99 is not None and floor_p99 < _CALM_MS else None,
    }
    if "sent_after_resume" in row:
        return values | {"lost after resume": row["sent_after_resume"] - row["delivered_after_resume"]}
    return values | {"lost": row["sent"] - row["delivered"]} if "direction" in row else values


def shown(row: Row) -> str:
    """For people: "met", or what is not."""
    bounds = row.get("bounds")
    if not bounds:
        return ""
    missed = [text for text, met in bounds.items() if not met]
    return f"not {', '.join(missed)}" if missed else "met"
