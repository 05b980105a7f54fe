"""What a picture of two movements draws: lines where something is known, and nothing where it is not."""

from __future__ import annotations

import numpy as np
import pytest

from igtl_gateway.addons.sync.curves import Curve, lag_curves
from igtl_gateway.addons.sync.lag import measure_lag
from igtl_gateway.addons.sync.signal import Signal
from tests.addons.sync.worlds import stamps
from tests.tables import table


def drawn(seconds: list[float]) -> Curve:
    at = np.array(seconds)
    signal = Signal.of(stamps(at), np.sin(at))
    return lag_curves(signal, signal, measure_lag(signal, signal))[0]


def regular(begin: float, end: float, hz: float) -> list[float]:
    return np.arange(begin, end, 1 / hz).tolist()


@table(
    ("seconds", "breaks", "alone"),
    [
        (regular(0, 20, 50), 0, 0),
        (regular(0, 20, 50) + regular(28, 40, 50), 1, 0),  # eight seconds without data
        (regular(0, 20, 1) + regular(28, 40, 1), 1, 0),
        ([*regular(0, 10, 50), 15.0, *regular(20, 30, 50)], 2, 1),
        (sorted(regular(0, 20, 10) + regular(0.001, 20, 10)), 0, 0),  # in pairs
        ([*regular(0, 10, 50), *regular(10.03, 20, 50)], 0, 0),  # two samples missing: one cannot see that
    ],
)
def test_a_line_breaks_where_nothing_was_measured(seconds: list[float], breaks: int, alone: int) -> None:
    curve = drawn(seconds)
    unknown = np.isnan(curve.values)
    assert int(unknown.sum()) == breaks
    assert len(curve.times_ns) == len(seconds) + breaks
    assert (np.diff(curve.times_ns) > 0).all()
    assert len(curve.alone.times_ns) == alone
    assert np.isfinite(curve.values[~unknown]).all()


def test_the_chart_has_a_line_for_each_side_of_a_gap() -> None:
    pytest.importorskip("matplotlib")
    from matplotlib.figure import Figure

    from igtl_gateway.addons.sync.plot import _draw_signals

    at = np.array(regular(0, 20, 50) + regular(28, 40, 50))
    signal = Signal.of(stamps(at), np.sin(at), "A")
    axes = Figure().subplots()
    _draw_signals(axes, signal, signal, measure_lag(signal, signal))
    for line in (axes.lines[0], axes.lines[2]):
        x, y = np.asarray(line.get_xdata(), float), np.asarray(line.get_ydata(), float)
        inside = (x > 20.1) & (x < 27.9)
        assert inside.sum() == 1 and np.isnan(y[inside]).all(), "nothing is drawn in the gap"
