"""Rows as pictures: SVG written by hand, so that no library is needed."""

from __future__ import annotations

import math
from collections.abc import Sequence
from html import escape

from igtl_gateway.bench.runner import Row

_WIDTH, _LEFT, _RIGHT, _TOP, _BAR, _GAP, _FOOT = 860, 250, 70, 46, 9, 9, 34
#: Bar → field, colour, words.
_BARS = (
    ("floor_p50_ms", "#b8b8b8", "floor, p50"),
    ("p50_ms", "#1f77b4", "p50"),
    ("p99_ms", "#aec7e8", "p99"),
)


def latency_plots(rows: Sequence[Row]) -> dict[str, str]:
    """File name → SVG: one picture of latencies for each direction that was measured."""
    plots = {}
    for direction in dict.fromkeys(row["direction"] for row in rows if row.get("direction")):
        shown = [row for row in rows if row.get("direction") == direction and row["p50_ms"] is not None]
        if shown:
            plots[f"latency-{direction}.svg"] = bars(f"One-way latency, {direction} (ms, logarithmic)", shown)
    return plots


def bars(title: str, rows: Sequence[Row]) -> str:
    """Three bars a row on a logarithmic axis: floor, median and 99th percentile."""
    values = [row[field] for row in rows for field, _, _ in _BARS if row.get(field)]
    low = math.floor(math.log10(min(values)))
    high = max(math.ceil(math.log10(max(values))), low + 1)
    height = _TOP + len(rows) * (len(_BARS) * _BAR + _GAP) + _FOOT

    def x(value: float) -> float:
        share = (math.log10(value) - low) / (high - low)
        return _LEFT + share * (_WIDTH - _LEFT - _RIGHT)

    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {_WIDTH} {height}" font-family="sans-serif" '
        'font-size="11">',
        f'<rect width="{_WIDTH}" height="{height}" fill="white"/>',
        f'<text x="10" y="18" font-size="14">{escape(title)}</text>',
    ]
    for index, (_, colour, words) in enumerate(_BARS):
        left = _LEFT + 90 * index
        parts.append(f'<rect x="{left}" y="26" width="10" height="10" fill="{colour}"/>')
        parts.append(f'<text x="{left + 14}" y="35">{words}</text>')
    for power in range(low, high + 1):
        at = x(10.0**power)
        parts.append(f'<path d="M{at:.1f} {_TOP} V{height - _FOOT}" stroke="#dddddd"/>')
        parts.append(f'<text x="{at:.1f}" y="{height - _FOOT + 16}" text-anchor="middle">{10.0**power:g}</text>')
    top = _TOP + _GAP / 2
    for row in rows:
        middle = top + len(_BARS) * _BAR / 2 + 4
        parts.append(f'<text x="{_LEFT - 8}" y="{middle:.1f}" text-anchor="end">{escape(_label(row))}</text>')
        for index, (field, colour, _) in enumerate(_BARS):
            if value := row.get(field):
                y = top + index * _BAR
                width = max(1.0, x(value) - _LEFT)
                parts.append(f'<rect x="{_LEFT}" y="{y:.1f}" width="{width:.1f}" height="{_BAR - 1}" fill="{colour}"/>')
                parts.append(
                    f'<text x="{_LEFT + width + 4:.1f}" y="{y + _BAR - 1:.1f}" font-size="9">{value:.3g}</text>'
                )
        top += len(_BARS) * _BAR + _GAP
    return "\n".join([*parts, "</svg>"]) + "\n"


def _label(row: Row) -> str:
    rate = f"{row['rate_hz']:g} Hz" if row.get("rate_hz") else "flood"
    stream = f" {row['stream']}" if "stream" in row else ""
    peer = f", {row['peer']}" if row.get("peer") else ""
    return f"{row['case']}{stream}, {rate}{', recording' if row.get('recording') else ''}{peer}"
