"""What rows are compared with: the bare hops, and the bridge that does nothing but the hop."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from igtl_gateway_lab.bench.bridges import HOP
from igtl_gateway_lab.bench.figures import Row, ratio


def against_floor(row: Row, ros: Row, tcp: Row, middleware: str = "dds") -> Row:
    """What stands in a row of the bare hops: in a flood their rates, else their medians and how many times those."""
    if row["rate_hz"] is None:
        return {f"floor_{middleware}_per_s": ros["received_per_s"], "floor_tcp_per_s": tcp["received_per_s"]}
    hops = (ros["p50_ms"], tcp["p50_ms"])
    floor = round(sum(hops), 4) if None not in hops else None
    return {
        f"floor_{middleware}_p50_ms": hops[0],
        "floor_tcp_p50_ms": hops[1],
        "floor_p50_ms": floor,
        "ratio": ratio(row["p50_ms"], floor),
    }


def against_mixed_floor(row: Row, floor: Row) -> Row:
    """What stands in a row of the mixed load over the bare hops."""
    return {
        "floor_p50_ms": floor["p50_ms"],
        "floor_p99_ms": floor["p99_ms"],
        "floor_p999_ms": floor["p999_ms"],
        "ratio_p50": ratio(row["p50_ms"], floor["p50_ms"]),
        "ratio_p99": ratio(row["p99_ms"], floor["p99_ms"]),
    }


def against_hop(rows: Sequence[Row]) -> list[Row]:
    """The rows, with what the hop needed for the same."""

    def key(row: Row) -> tuple[Any, ...]:
        return row.get("stream"), row["direction"]

    hops = {key(row): row for row in rows if row.get("bridge") == HOP}
    return [row if row.get("bridge") == HOP else row | _hop_figures(row, hops[key(row)]) for row in rows]


def _hop_figures(row: Row, hop: Row) -> Row:
    beside: Row = {"hop_cpu_us_per_message": hop.get("gateway_cpu_us_per_message")}
    if row["rate_hz"] is None:
        return beside | {"hop_per_s": hop["received_per_s"]}
    beside |= {f"hop_{name}": hop[name] for name in ("p50_ms", "p99_ms", "p999_ms")}
    return beside | {"ratio_hop": ratio(row["p50_ms"], hop["p50_ms"])}
