"""Rows of a measurement as SVG charts, drawn with matplotlib: latencies as bars, sweeps as points with their lines."""

from __future__ import annotations

from collections.abc import Sequence
from io import StringIO
from typing import TYPE_CHECKING, Any

import numpy as np

from igtl_gateway_lab.bench.figures import Row
from igtl_gateway_lab.bench.sweeps import SWEEPS

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Bar → field, colour, name in the legend.
_BARS = (
    ("floor_p50_ms", "#b8b8b8", "floor, p50"),
    ("p50_ms", "#1f77b4", "p50"),
    ("p99_ms", "#aec7e8", "p99"),
)
_COLOURS, _FLOOR_COLOUR, _GRID = ("#1f77b4", "#d62728"), "#888888", "#dddddd"
_FIGURES = {
    "gateway_cpu_percent": "CPU of the gateway, % of a core",
    "p50_ms": "p50 of one-way latency, ms",
    "floor_p50_ms": "floor",
}
#: Inches; a chart is 860 px wide in a browser.
_WIDTH, _HEIGHT, _ROW_HEIGHT, _MARGIN = 9.0, 4.4, 0.38, 1.2
#: Text stays text, and equal rows give equal files.
_STYLE: Any = {"svg.fonttype": "none", "svg.hashsalt": "igtl-gateway"}


def latency_plots(rows: Sequence[Row]) -> dict[str, str]:
    """File name → SVG: one chart of latencies for each direction that was measured."""
    plots = {}
    for direction in dict.fromkeys(row["direction"] for row in rows if row.get("direction")):
        shown = [
            row
            for row in rows
            if row.get("direction") == direction and row["p50_ms"] is not None and "sweep" not in row
        ]
        if shown:
            figure, axes = _chart(f"One-way latency, {direction}", _MARGIN + _ROW_HEIGHT * len(shown))
            _draw_bars(axes, shown)
            plots[f"latency-{direction}.svg"] = to_svg(figure)
    return plots


def sweep_plots(rows: Sequence[Row], fits: Sequence[dict[str, Any]]) -> dict[str, str]:
    """File name → SVG: the charts of each sweep that was measured, with the lines of ``sweeps.fit_lines``."""
    plots = {}
    for name, sweep in SWEEPS.items():
        for chart in sweep.charts:
            drawn = [fit for fit in fits if fit["sweep"] == name and fit["figure"] in chart]
            if not drawn:
                continue
            figure, axes = _chart(f"{_FIGURES[chart[0]]}: {sweep.text}", _HEIGHT)
            axes.set_xlabel(sweep.x)
            axes.set_ylabel(_FIGURES[chart[0]])
            if sweep.logarithmic:
                axes.set_xscale("log")
                axes.set_yscale("log")
            colours = iter(_COLOURS)
            for fit in drawn:
                is_main = fit["figure"] == chart[0]
                swept = [row for row in rows if (row.get("sweep"), row.get("direction")) == (name, fit["direction"])]
                points = [(row["x"], row[fit["figure"]]) for row in swept if row.get(fit["figure"]) is not None]
                label = fit["direction"] if is_main else _FIGURES[fit["figure"]]
                _draw_series(axes, points, fit, label, next(colours) if is_main else _FLOOR_COLOUR)
            if not sweep.logarithmic:
                axes.set_xlim(left=0)
                axes.set_ylim(bottom=0)
            axes.grid(color=_GRID)
            axes.legend(loc="lower left", bbox_to_anchor=(0, 1), ncols=2, frameon=False)
            plots[f"sweep-{name}-{chart[0]}.svg"] = to_svg(figure)
    return plots


def _draw_bars(axes: Axes, rows: Sequence[Row]) -> None:
    """Floor, median and 99th percentile of each row on a logarithmic axis."""
    values = [row[field] for row in rows for field, _, _ in _BARS if row.get(field)]
    low = 10.0 ** np.floor(np.log10(min(values)))
    height = 0.27
    for index, (field, colour, label) in enumerate(_BARS):
        places = [at + (index - 1) * height for at, row in enumerate(rows) if row.get(field)]
        widths = [row[field] for row in rows if row.get(field)]
        bars = axes.barh(places, [width - low for width in widths], height * 0.9, left=low, color=colour, label=label)
        axes.bar_label(bars, [f"{width:.3g}" for width in widths], padding=3, fontsize=7)
    axes.set_xscale("log")
    axes.set_xlim(low, max(values) * 2)
    axes.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
    axes.set_xlabel("ms, logarithmic")
    axes.set_yticks(range(len(rows)), [_label(row) for row in rows])
    axes.set_ylim(len(rows) - 0.5, -0.5)
    axes.grid(axis="x", color=_GRID)
    axes.legend(loc="lower right", bbox_to_anchor=(1, 1), ncols=len(_BARS), frameon=False)


def _draw_series(
    axes: Axes, points: Sequence[tuple[float, float]], fit: dict[str, Any], label: str, colour: str
) -> None:
    """Points, and the straight line through them, which is a curve on logarithmic axes."""
    a, b, r2 = (fit[name] for name in ("a", "b", "r2"))
    x, y = np.array(points, np.float64).T
    axes.scatter(x, y, 18, colour, label=f"{label}: {a:.3g} + {b:.3g} x, r² = {r2:.3f}", zorder=3)
    steps = np.geomspace(min(x), max(x), 60) if axes.get_xscale() == "log" else np.linspace(0, max(x), 2)
    line = a + b * steps
    axes.plot(steps[line > 0], line[line > 0], "--", color=colour, linewidth=1)


def _chart(title: str, height: float) -> tuple[Figure, Axes]:
    from matplotlib.figure import Figure

    figure = Figure((_WIDTH, height), layout="constrained")
    axes = figure.add_subplot()
    figure.suptitle(title, x=0.01, ha="left", fontsize=11)
    axes.set_axisbelow(True)
    return figure, axes


def to_svg(figure: Figure) -> str:
    """The figure as SVG whose text is text; the same file for the same figure."""
    from matplotlib import rc_context

    with rc_context(_STYLE):
        out = StringIO()
        figure.savefig(out, format="svg", metadata={"Date": None})
    return out.getvalue()


def _label(row: Row) -> str:
    rate = f"{row['rate_hz']:g} Hz" if row.get("rate_hz") else "flood"
    stream = "".join(f" {row[name]}" for name in ("stream", "client") if name in row)
    others = "".join(f", {row[name]}" for name in ("peer", "bridge") if row.get(name))
    marks = "".join(f", {name}" for name in ("recording", "sealed") if row.get(name))
    return f"{row['case']}{stream}, {rate}{marks}{others}"
