"""Rows as pictures: SVG written by hand, so that no library is needed."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from html import escape
from typing import Any

from igtl_gateway_lab.bench.runner import Row
from igtl_gateway_lab.bench.sweeps import SWEEPS

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
        shown = [
            row
            for row in rows
            if row.get("direction") == direction and row["p50_ms"] is not None and "sweep" not in row
        ]
        if shown:
            plots[f"latency-{direction}.svg"] = bars(f"One-way latency, {direction} (ms, logarithmic)", shown)
    return plots


_HEIGHT, _CHART_LEFT, _CHART_TOP, _CHART_FOOT = 420, 70, 70, 46
_TICKS = 5
_STEPS = 60  # of a line of which logarithms make a curve
_COLOURS = ("#1f77b4", "#d62728")
_GREY = "#888888"
_FIGURES = {
    "gateway_cpu_percent": "CPU of the gateway, % of a core",
    "p50_ms": "p50 of one-way latency, ms",
    "floor_p50_ms": "floor",
}


@dataclass(frozen=True, slots=True)
class Series:
    """Points of one colour, and the line through them: ``a``, ``b`` and ``r2`` of ``sweeps.line``."""

    name: str
    colour: str
    points: tuple[tuple[float, float], ...]
    fit: dict[str, Any]


def sweep_plots(rows: Sequence[Row], fits: Sequence[dict[str, Any]]) -> dict[str, str]:
    """File name → SVG: of each sweep that was measured, its charts."""
    plots = {}
    for name, sweep in SWEEPS.items():
        for chart in sweep.charts:
            series: list[Series] = []
            for fit in fits:
                if fit["sweep"] == name and fit["figure"] in chart:
                    field, direction = fit["figure"], fit["direction"]
                    swept = [row for row in rows if (row.get("sweep"), row.get("direction")) == (name, direction)]
                    points = tuple((row["x"], row[field]) for row in swept if row.get(field) is not None)
                    main = field == chart[0]
                    colour = _COLOURS[sum(one.colour != _GREY for one in series)] if main else _GREY
                    series.append(Series(direction if main else _FIGURES[field], colour, points, fit))
            if series:
                title = f"{_FIGURES[chart[0]]}: {sweep.text}"
                plots[f"sweep-{name}-{chart[0]}.svg"] = lines(title, sweep.x, series, sweep.logarithmic)
    return plots


def lines(title: str, x_axis: str, series: Sequence[Series], logarithmic: bool) -> str:
    """Points and the straight lines through them, on linear axes from 0 or on logarithmic ones."""
    every = [point for one in series for point in one.points]
    along = _axis([x for x, _ in every], logarithmic, _CHART_LEFT, _WIDTH - _RIGHT)
    upwards = _axis([y for _, y in every], logarithmic, _HEIGHT - _CHART_FOOT, _CHART_TOP)
    parts = _page(title, _HEIGHT)
    for value in along.ticks:
        at = along.place(value)
        parts.append(f'<path d="M{at:.1f} {_CHART_TOP} V{_HEIGHT - _CHART_FOOT}" stroke="#dddddd"/>')
        parts.append(f'<text x="{at:.1f}" y="{_HEIGHT - _CHART_FOOT + 16}" text-anchor="middle">{value:g}</text>')
    for value in upwards.ticks:
        at = upwards.place(value)
        parts.append(f'<path d="M{_CHART_LEFT} {at:.1f} H{_WIDTH - _RIGHT}" stroke="#dddddd"/>')
        parts.append(f'<text x="{_CHART_LEFT - 8}" y="{at + 4:.1f}" text-anchor="end">{value:g}</text>')
    middle = (_CHART_LEFT + _WIDTH - _RIGHT) / 2
    parts.append(f'<text x="{middle:.0f}" y="{_HEIGHT - 10}" text-anchor="middle">{escape(x_axis)}</text>')
    for index, one in enumerate(series):
        left, top = _CHART_LEFT + 390 * (index % 2), 26 + 16 * (index // 2)
        a, b, r2 = (one.fit[name] for name in ("a", "b", "r2"))
        words = f"{one.name}: {a:.3g} + {b:.3g} x, r² = {r2:.3f}"
        parts.append(f'<rect x="{left}" y="{top}" width="10" height="10" fill="{one.colour}"/>')
        parts.append(f'<text x="{left + 14}" y="{top + 9}">{escape(words)}</text>')
        curve = [(x, a + b * x) for x in along.steps]
        seen = [(x, y) for x, y in curve if upwards.low <= y <= upwards.high]
        path = " L".join(f"{along.place(x):.1f} {upwards.place(y):.1f}" for x, y in seen)
        if path:
            parts.append(f'<path d="M{path}" stroke="{one.colour}" fill="none" stroke-dasharray="4 3"/>')
        for x, y in one.points:
            parts.append(f'<circle cx="{along.place(x):.1f}" cy="{upwards.place(y):.1f}" r="3.5" fill="{one.colour}"/>')
    return "\n".join([*parts, "</svg>"]) + "\n"


@dataclass(frozen=True, slots=True)
class _Axis:
    low: float
    high: float
    ticks: tuple[float, ...]
    steps: tuple[float, ...]
    place: Callable[[float], float]


def _axis(values: Sequence[float], logarithmic: bool, start: float, end: float) -> _Axis:
    """An axis that holds all values, between two places of the picture."""
    if logarithmic:
        first, last = math.floor(math.log10(min(values))), math.ceil(math.log10(max(values)))
        last = max(last, first + 1)
        ticks = tuple(10.0**power for power in range(first, last + 1))
        steps = tuple(10 ** (first + (last - first) * step / _STEPS) for step in range(_STEPS + 1))
        return _Axis(
            ticks[0],
            ticks[-1],
            ticks,
            steps,
            lambda value: start + (math.log10(value) - first) / (last - first) * (end - start),
        )
    most = max(values) or 1.0
    unit = 10 ** math.floor(math.log10(most / _TICKS))
    step = next(unit * many for many in (1, 2, 2.5, 5, 10) if unit * many * _TICKS >= most)
    high = step * math.ceil(most / step)
    ticks = tuple(step * tick for tick in range(round(high / step) + 1))
    steps = tuple(high * step / _STEPS for step in range(_STEPS + 1))
    return _Axis(0.0, high, ticks, steps, lambda value: start + value / high * (end - start))


def _page(title: str, height: float) -> list[str]:
    return [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {_WIDTH} {height}" font-family="sans-serif" '
        'font-size="11">',
        f'<rect width="{_WIDTH}" height="{height}" fill="white"/>',
        f'<text x="10" y="18" font-size="14">{escape(title)}</text>',
    ]


def bars(title: str, rows: Sequence[Row]) -> str:
    """Three bars a row on a logarithmic axis: floor, median and 99th percentile."""
    values = [row[field] for row in rows for field, _, _ in _BARS if row.get(field)]
    low = math.floor(math.log10(min(values)))
    high = max(math.ceil(math.log10(max(values))), low + 1)
    height = _TOP + len(rows) * (len(_BARS) * _BAR + _GAP) + _FOOT

    def x(value: float) -> float:
        share = (math.log10(value) - low) / (high - low)
        return _LEFT + share * (_WIDTH - _LEFT - _RIGHT)

    parts = _page(title, height)
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
    stream = "".join(f" {row[name]}" for name in ("stream", "client") if name in row)
    peer = f", {row['peer']}" if row.get("peer") else ""
    return f"{row['case']}{stream}, {rate}{', recording' if row.get('recording') else ''}{peer}"
