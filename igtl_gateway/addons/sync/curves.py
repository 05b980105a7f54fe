"""A lag as curves and text, for charts and for the viewer."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from igtl_gateway.addon import NS_PER_S
from igtl_gateway.addons.sync.lag import Lag
from igtl_gateway.addons.sync.signal import GAP, Floats, Signal, main_component

#: Percentile of the pauses that is usual, also where messages come in pairs; part of a picture that one can see.
_USUAL, _SEEN = 75, 300


@dataclass(frozen=True, slots=True)
class Curve:
    """The main component of a signal.

    Attributes:
        times_ns: int64 (N,), UTC ns, as stamped.
        values: float64 (N,), without unit: standard deviation 1; NaN in the middle of a gap, where nothing is known.
    """

    times_ns: npt.NDArray[np.int64]
    values: Floats

    @property
    def alone(self) -> Curve:
        """The samples between two gaps: a line does not show them."""
        unknown = np.concatenate([[True], np.isnan(self.values), [True]])
        found = ~unknown[1:-1] & unknown[:-2] & unknown[2:]
        return Curve(self.times_ns[found], self.values[found])


def lag_text(lag: Lag) -> str:
    """Return the lag and its interval in ms, or the reason why there is none."""
    if not lag.verdict.has_lag:
        return lag.verdict.value
    return f"{lag.lag_s * 1e3:+.1f} ms ({lag.low_s * 1e3:+.1f} to {lag.high_s * 1e3:+.1f})"


def lag_curves(fixed: Signal, moving: Signal, lag: Lag) -> tuple[Curve, Curve, int]:
    """Return the movements of both streams in their common time, and the lag of the second one in ns (0 if unknown).

    The sign of a main component means nothing, so the second curve has the one that is like the first.
    """
    late_ns = round(lag.lag_s * NS_PER_S) if lag.verdict.has_lag else 0
    if not len(fixed.times_ns) or not len(moving.times_ns):
        nothing = Curve(np.zeros(0, np.int64), np.zeros(0))
        return nothing, nothing, late_ns
    begin_ns = int(max(fixed.times_ns[0], moving.times_ns[0]))
    end_ns = int(min(fixed.times_ns[-1], moving.times_ns[-1]))
    one, other = (_curve(signal, begin_ns, end_ns) for signal in (fixed, moving))
    if len(one.values) and len(other.values):
        seen = np.interp(one.times_ns - begin_ns, other.times_ns - late_ns - begin_ns, other.values)
        if float(np.sum(seen * one.values)) < 0:
            other = Curve(other.times_ns, -other.values)
    return _with_gaps(one), _with_gaps(other), late_ns


def _with_gaps(curve: Curve) -> Curve:
    """Return the curve with a NaN in each gap: a pause of several usual intervals, which a picture shows."""
    if len(curve.times_ns) < 3:
        return curve
    pauses = np.diff(curve.times_ns)
    usual_ns = float(np.percentile(pauses, _USUAL))
    least_ns = max(GAP * usual_ns, float(curve.times_ns[-1] - curve.times_ns[0]) / _SEEN)
    gaps = np.flatnonzero(pauses > least_ns)
    middles = curve.times_ns[gaps] + pauses[gaps] // 2
    return Curve(np.insert(curve.times_ns, gaps + 1, middles), np.insert(curve.values, gaps + 1, np.nan))


def _curve(signal: Signal, begin_ns: int, end_ns: int) -> Curve:
    common = (signal.times_ns >= begin_ns) & (signal.times_ns <= end_ns)
    values = main_component(signal.values[common]) if np.any(common) else np.zeros(0)
    return Curve(signal.times_ns[common], values / (np.std(values) or 1.0) if len(values) else values)
