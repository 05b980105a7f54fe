"""Several rounds of one measurement as one: medians, but the worst of what must not happen even once."""

from __future__ import annotations

from collections.abc import Sequence
from statistics import median_low
from typing import Any

from igtl_gateway_lab.bench.cases import SLICER
from igtl_gateway_lab.bench.figures import Row, ratio

#: Numeric fields that identify a measurement, besides all fields without numbers.
_NAMES = frozenset({"rate_hz", "x", "clients"})
#: Of these the most counts.
_MOST = frozenset(
    {
        "max_ms",
        "late_max_ms",
        "ros_lost",
        "recorder_dropped",
        "gateway_rss_mb",
        "gateway_rss_growth_mb",
        "gateway_rss_peak_mb",
        "peak_mb",
        "other_peak_mb",
    }
)
#: These belong together: those of the round that lost most.
_LOSSES = (("sent", "delivered"), ("sent_after_resume", "delivered_after_resume"))


def merge_rounds(rounds: Sequence[Sequence[Row]]) -> list[Row]:
    """A row for each of a round, with the figures of all of them as ``rounds``; of one round alone its rows."""
    if len(rounds) == 1:
        return list(rounds[0])
    groups: dict[tuple[Any, ...], list[Row]] = {}
    for rows in rounds:
        for row in rows:
            groups.setdefault(tuple((name, row[name]) for name in row if _names(name, row[name])), []).append(row)
    return [_merged(rows) for rows in groups.values()]


def _merged(rows: Sequence[Row]) -> Row:
    typical: Row = {}
    for name in rows[0]:
        values = [row[name] for row in rows if row.get(name) is not None]
        if not values or _names(name, values[0]):
            typical[name] = rows[0][name]
        else:
            typical[name] = _typical(name, values)
    for sent, delivered in _LOSSES:
        if delivered in typical and sent in typical:
            worst = max(rows, key=lambda row: row[sent] - row[delivered])
            typical |= {sent: worst[sent], delivered: worst[delivered]}
    typical["rounds"] = [{name: value for name, value in row.items() if not _names(name, value)} for row in rows]
    return typical


def _typical(name: str, values: Sequence[Any]) -> Any:
    """The median, or the most; of a group of figures, each by itself."""
    if isinstance(values[0], dict):
        names = dict.fromkeys(inner for value in values for inner in value)
        return {inner: _typical(inner, [value[inner] for value in values if inner in value]) for inner in names}
    return max(values) if name in _MOST else median_low(values)


def _names(name: str, value: Any) -> bool:
    """Return whether a field identifies a measurement."""
    return name in _NAMES or isinstance(value, str | bool)


def with_costs(rows: Sequence[Row]) -> list[Row]:
    """The rows, those of recordings with how many times they took of what they take without.

    Those of sealed recordings, with what they took of those that are not sealed, and how much more of a core.
    """

    def key(row: Row) -> tuple[Any, ...]:
        return (
            row["case"],
            row.get("stream"),
            row.get("direction"),
            row.get("peer"),
            row.get("bridge"),
            row.get("middleware"),
        )

    plain = {key(row): row for row in rows if not row.get("recording")}
    recorded = {key(row): row for row in rows if row.get("recording") and not row.get("sealed")}
    return [row | _cost(row, plain.get(key(row)), recorded.get(key(row))) for row in rows]


def against_version_1(rows: Sequence[Row]) -> list[Row]:
    """The rows, those of what 3D Slicer sends with how many times they took of the same in header version 1."""

    def key(case: str, row: Row) -> tuple[Any, ...]:
        return case, row.get("direction"), row.get("recording"), row.get("bridge"), row.get("peer")

    first = {key(SLICER[row["case"]], row): row for row in rows if row["case"] in SLICER}
    return [row | _of_version_1(row, first.get(key(row["case"], row))) for row in rows]


def _of_version_1(row: Row, first: Row | None) -> Row:
    if first is None:
        return {}
    cpu = "gateway_cpu_us_per_message"
    return {
        "version_1_p50_ratio": ratio(row["p50_ms"], first["p50_ms"]),
        "version_1_cpu_ratio": ratio(row.get(cpu), first.get(cpu)),
    }


def _cost(row: Row, plain: Row | None, recorded: Row | None) -> Row:
    if not row.get("recording") or plain is None:
        return {}
    name, other = ("sealing", recorded) if row.get("sealed") else ("recording", plain)
    if other is None:
        return {}
    cost: Row = {
        f"{name}_{figure}_ratio": ratio(row[f"{figure}_ms"], other[f"{figure}_ms"]) for figure in ("p50", "p99")
    }
    if name == "sealing":
        cost["sealing_cpu_percent"] = round(row["recorder_cpu_percent"] - other["recorder_cpu_percent"], 1)
    return cost
