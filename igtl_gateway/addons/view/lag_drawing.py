"""The lag between two streams: what moves in both of them over time, and the verdict."""

from __future__ import annotations

import rerun as rr

from igtl_gateway.addon.terminal import counted
from igtl_gateway.addons.sync.curves import lag_curves, lag_text
from igtl_gateway.addons.sync.lag import Lag
from igtl_gateway.addons.sync.signal import Signal
from igtl_gateway.addons.view.colours import GREY, SERIES
from igtl_gateway.addons.view.contents import LAG_CURVES, LAG_TEXT
from igtl_gateway.addons.view.pen import Pen


def draw_lag(fixed: Signal, moving: Signal, lag: Lag, shift_ns: int, pen: Pen) -> None:
    """Draw three curves, the fixed stream, the moving one, and the moving one without its lag; and the verdict.

    Args:
        fixed, moving: what moves in the streams, at their stamps.
        lag: of the moving stream.
        shift_ns: gateway time - stamp, for the time line.
        pen: to draw with.
    """
    one, other, late_ns = lag_curves(fixed, moving, lag)
    curves = [("fixed", fixed.name, one, 0, SERIES[0]), ("moving", moving.name, other, 0, GREY)]
    if late_ns:
        curves.append(("corrected", f"{moving.name}, {-late_ns / 1e6:+.1f} ms", other, late_ns, SERIES[1]))
    for part, name, curve, early_ns, colour in curves:
        path = f"{LAG_CURVES}/{part}"
        pen.static(path, rr.SeriesLines(names=[pen.displayable(name)], colors=[colour]))
        pen.series(path, curve.times_ns + (shift_ns - early_ns), curve.values)
    pen.static(LAG_TEXT, rr.TextDocument(pen.displayable(_text(fixed, moving, lag)), media_type="text/markdown"))


def _text(fixed: Signal, moving: Signal, lag: Lag) -> str:
    rows = [("verdict", lag.verdict.value), ("lag, 95 %", lag_text(lag)), ("R²", f"{lag.r2:.3f}")]
    if lag.has_skew:
        rows.append(("skew", f"{lag.skew_ppm:+.0f} ppm"))
    if lag.windows:
        spread = [window.lag_s * 1e3 for window in lag.windows]
        rows.append((counted(len(spread), "window"), f"{min(spread):+.1f} to {max(spread):+.1f} ms"))
    rows.append(("samples", f"{lag.samples:,}"))
    table = "\n".join(f"| {name} | {value} |" for name, value in rows)
    return f"**{_plain(moving.name)} behind {_plain(fixed.name)}**\n\n| | |\n|---|---|\n{table}"


def _plain(name: str) -> str:
    return name.replace("|", "/").replace("*", " ")
