"""A lag as a chart: both signals with the lag removed, the search, and the lag in windows."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from io import StringIO
from typing import TYPE_CHECKING, Any

import numpy as np

from igtl_gateway.addon import NS_PER_S, ViewerError
from igtl_gateway.addon.processes import missing
from igtl_gateway.addons.sync.curves import lag_curves, lag_text
from igtl_gateway.addons.sync.lag import Lag
from igtl_gateway.addons.sync.signal import Signal

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_FIXED, _MOVING, _GREY = "#1f77b4", "#d62728", "#888888"
_WIDTH, _HEIGHT = 9.0, 2.6  # inches of one row
#: Text stays text, and equal results give equal files.
_STYLE: Any = {"svg.fonttype": "none", "svg.hashsalt": "igtl-gateway", "axes.grid": True, "grid.color": "#dddddd"}


def check_library() -> None:
    """Raise ViewerError if matplotlib is missing: before the search whose result it draws."""
    try:
        import matplotlib.figure  # noqa: F401
    except ImportError as error:
        raise ViewerError(missing("matplotlib", error)) from None


def lag_chart(fixed: Signal, lags: Sequence[tuple[Signal, Lag]], unreadable: Iterable[str] = ()) -> str:
    """Return an SVG with a row of charts for each stream, and the names of those that are unreadable.

    Raises ViewerError if matplotlib is missing.
    """
    check_library()
    import matplotlib as mpl
    from matplotlib.figure import Figure

    with mpl.rc_context(_STYLE):
        figure = Figure(figsize=(_WIDTH, 2 * _HEIGHT * len(lags)), layout="constrained")
        rows = figure.subfigures(len(lags), 1, squeeze=False)
        for (signal, lag), row in zip(lags, rows[:, 0], strict=True):
            axes = row.subplot_mosaic([["signals", "signals"], ["search", "windows"]])
            row.suptitle(f"{signal.name} behind {fixed.name}: {lag_text(lag)}", fontsize="medium")
            _draw_signals(axes["signals"], fixed, signal, lag)
            _draw_search(axes["search"], lag)
            _draw_windows(axes["windows"], lag)
        if left := ", ".join(unreadable):
            figure.supxlabel(f"unreadable: {left}", fontsize="small", wrap=True)
        out = StringIO()
        figure.savefig(out, format="svg", metadata={"Date": None})
        return out.getvalue()


def _draw_signals(axes: Axes, fixed: Signal, moving: Signal, lag: Lag) -> None:
    """The main components, normalised, in the common time; the moving one without its lag."""
    one, other, late_ns = lag_curves(fixed, moving, lag)
    begin_ns = int(max(fixed.times_ns[0], moving.times_ns[0]))
    label = f"{moving.name}, {-late_ns / 1e6:+.1f} ms" if late_ns else moving.name
    for curve, early_ns, name, colour in ((one, 0, fixed.name, _FIXED), (other, late_ns, label, _MOVING)):
        alone = curve.alone  # a line breaks at a gap, and does not show what is between two
        axes.plot(_seconds(curve.times_ns - early_ns, begin_ns), curve.values, color=colour, linewidth=0.9, label=name)
        axes.plot(_seconds(alone.times_ns - early_ns, begin_ns), alone.values, ".", color=colour, markersize=3)
    axes.set_xlabel("s")
    axes.set_ylabel("movement")
    axes.legend(loc="lower left", bbox_to_anchor=(0, 1), ncols=2, frameon=False, fontsize="small")


def _seconds(times_ns: Any, begin_ns: int) -> Any:
    return (times_ns - begin_ns) / NS_PER_S


def _draw_search(axes: Axes, lag: Lag) -> None:
    axes.set_xlabel("lag, ms")
    axes.set_ylabel("R²")
    if lag.search:
        lags, r2 = np.array(lag.search).T
        axes.plot(lags * 1e3, r2, color=_GREY)
    if lag.verdict.has_lag:
        axes.axvspan(lag.low_s * 1e3, lag.high_s * 1e3, color=_MOVING, alpha=0.25)
        axes.axvline(lag.lag_s * 1e3, color=_MOVING)
    elif not math.isnan(lag.other_s):
        for value in (lag.lag_s, lag.other_s):
            axes.axvline(value * 1e3, color=_MOVING, linestyle=":")


def _draw_windows(axes: Axes, lag: Lag) -> None:
    axes.set_xlabel("s")
    axes.set_ylabel("lag, ms")
    for window in lag.windows:
        middle, half = (window.start_s + window.end_s) / 2, (window.end_s - window.start_s) / 2
        axes.errorbar(middle, window.lag_s * 1e3, window.error_s * 1.96e3, half, color=_GREY, capsize=2)
    if lag.verdict.has_lag:
        axes.axhspan(lag.low_s * 1e3, lag.high_s * 1e3, color=_MOVING, alpha=0.25)
        axes.axhline(lag.lag_s * 1e3, color=_MOVING)
