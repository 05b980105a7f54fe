"""The search: how alike the signals of probes are at every lag, and which of the peaks is the lag."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import reduce

import numpy as np

from igtl_gateway.addons.sync.fit import Fit
from igtl_gateway.addons.sync.probe import Probe
from igtl_gateway.addons.sync.signal import Floats

_STEP_S, _STEP_PERIODS = 0.04, 0.1  # the step is at most this, and this part of the shortest period
_HALVINGS = 4  # of the two steps around a peak, before a parabola finds its top
_BEYOND = 1.5  # a lag beyond the search range shows itself in a search of this times the range ...
_BEYOND_S = 2.5  # ... and up to this at least
_SIMILAR_R2, _EQUAL_R2 = 0.9, 0.98  # R² of another peak, relative to the best, that may be, or is, as good
_SIMILAR_OF_SEVERAL = 0.5  # likewise for the R² of several probes, of which some cannot choose
_CLEAR_T = 3.0  # Student's t of their difference from which on one lag is better
_CLEAR_LIKELIHOOD = 12.0  # likewise twice the logarithm of the ratio of their likelihoods: 400 to 1 ...
_CLEAR_OF_FEW = 9.0  # ... and 90 to 1 among the few lags that a movement that repeats itself leaves


@dataclass(frozen=True, slots=True)
class Curve:
    """R² at the lags of a search.

    Attributes:
        lags: (L,) s, increasing.
        each: (P, L) R² of each probe, NaN where a lag covers too few of its samples.
        max_lag_s: the search range; lags beyond it only show whether the lag is in it.
        step_s: of the search.
    """

    lags: Floats
    each: Floats
    max_lag_s: float
    step_s: float

    @classmethod
    def of(cls, probes: Sequence[Probe], max_lag_s: float, cut_off_hz: float) -> Curve:
        step_s = min(_STEP_S, _STEP_PERIODS / cut_off_hz)
        reach = math.ceil(max(_BEYOND * max_lag_s, _BEYOND_S) / step_s)
        lags = np.arange(-reach, reach + 1, dtype=np.float64) * step_s
        each = np.array([[probe.r2(lag) for lag in lags.tolist()] for probe in probes])
        return cls(lags, each, max_lag_s, step_s)

    def sharpened(self, probes: Sequence[Probe]) -> Curve:
        """Return the curve with each peak of all probes at its top, which is between the lags of the search.

        The peaks of a fast movement are so narrow that the next lag of the search decides which of them is higher.
        """
        lags, each = self.lags.copy(), self.each.copy()

        def at(tried: Floats) -> Floats:
            return np.array([[probe.r2(lag) for lag in tried.tolist()] for probe in probes])

        def moved(place: int, tried: Floats) -> Floats:
            """The R² of some lags and of the peak, which becomes the best of them."""
            values = np.column_stack([at(tried), each[:, place]])
            together = _together(values)
            best = int(np.argmax(np.where(np.isfinite(together), together, -np.inf)))
            if best < len(tried):
                lags[place], each[:, place] = tried[best], values[:, best]
            return together

        for place in peaks_of(self.of_probes([True] * len(probes))):
            step = (self.lags[place + 1] - self.lags[place - 1]) / 4
            for _ in range(_HALVINGS):
                moved(place, np.array([lags[place] - step, lags[place] + step]))
                step /= 2
            left, right, top = moved(place, around := np.array([lags[place] - step, lags[place] + step]))
            bend = left + right - 2 * top
            if bend < 0:
                moved(place, np.array([around.mean() + np.clip((left - right) / bend / 2, -1, 1) * step]))
        return replace(self, lags=lags, each=each)

    def of_probes(self, chosen: Sequence[bool]) -> Floats:
        """Return R² of some probes together (L): from 1, the geometric mean of what is left."""
        return _together(self.each[np.array(chosen)])

    def largest(self) -> Floats:
        """Return the largest R² of each probe in the search range (P), 0 without one."""
        return np.asarray(np.max(np.where(self.inside & np.isfinite(self.each), self.each, 0.0), axis=1))

    @property
    def inside(self) -> Floats:
        """Which lags are in the search range, and one step more for its peaks (L), bool."""
        return np.asarray(np.abs(self.lags) <= self.max_lag_s + self.step_s)


def _together(each: Floats) -> Floats:
    """R² of probes (P, L) together (L)."""
    return np.asarray(1 - np.exp(np.mean(np.log(1 - np.clip(each, 0.0, 1 - 1e-9)), axis=0)))


def peaks_of(values: Floats) -> list[int]:
    """Return where values are larger than their neighbours."""
    return [i for i in range(1, len(values) - 1) if values[i] >= values[i - 1] and values[i] > values[i + 1]]


def chosen_peak(curve: Curve, probes: Sequence[Probe], deciders: Sequence[bool], *, is_known: bool) -> int | None:
    """Return the index of the lag among the peaks of all probes; None if it is at the edge of the range or beyond it.

    Args:
        curve: R² of the probes.
        probes: the probes.
        deciders: which of them do not repeat themselves, and choose; without one, only the search range counts.
        is_known: whether the range is a given one, which has the lag: one beyond it has to be clearly better.
    """
    every = curve.of_probes([True] * len(probes))
    if not any(deciders):
        every = np.where(curve.inside, every, np.nan)
    peaks = peaks_of(every)
    if not peaks:
        return None
    if all(deciders) or not any(deciders):
        best = int(np.nanargmax(every))
        return best if best in peaks and curve.inside[best] else None
    votes, fit = curve.of_probes(deciders), Fit(probes)
    least = _SIMILAR_OF_SEVERAL * max(float(every[i]) for i in peaks)
    likely = sorted((i for i in peaks if every[i] >= least), key=lambda i: -float(votes[i]))

    def better(best: int, other: int, *, by: float = 0.0) -> bool:
        return fit.advantage(float(curve.lags[best]), float(curve.lags[other]))[1] < -by

    def best_of(among: list[int]) -> int:
        return reduce(lambda best, other: other if better(best, other) else best, among)

    inside = [i for i in likely if curve.inside[i]]
    if not is_known or not inside:
        best = best_of(likely)
        return best if curve.inside[best] else None
    # few samples have a lag beyond the range, and some of those lags are alike by chance
    best = best_of(inside)
    beyond = [i for i in likely if not curve.inside[i]]
    return None if any(better(best, other, by=_CLEAR_LIKELIHOOD) for other in beyond) else best


def rival(curve: Curve, best: int, probes: Sequence[Probe], deciders: Sequence[bool], *, beyond: bool) -> float:
    """Return the lag of another peak that explains the data almost as well as the best one, s; NaN without one.

    Args:
        curve, probes, deciders: as of ``chosen_peak``.
        best: index of the lag.
        beyond: whether a peak beyond the search range counts.
    """
    every = curve.of_probes([True] * len(probes))
    fit, chooses = Fit(probes), Fit([probe for probe, decides in zip(probes, deciders, strict=True) if decides])
    is_one, least = len(probes) == 1, _CLEAR_LIKELIHOOD if all(deciders) else _CLEAR_OF_FEW
    for other in peaks_of(every if beyond else np.where(curve.inside, every, np.nan)):
        ratio = float(every[other] / every[best])
        if other == best or ratio < (_SIMILAR_R2 if is_one else _SIMILAR_OF_SEVERAL):
            continue
        lags = float(curve.lags[best]), float(curve.lags[other])
        if not _is_clear(fit, chooses, *lags, least) or (is_one and ratio > _EQUAL_R2):
            return lags[1]
    return math.nan


def _is_clear(fit: Fit, chooses: Fit, lag_s: float, other_s: float, least: float) -> bool:
    """Whether a lag is clearly better than another one: those that choose, and all of them, have to prefer it.

    Noise of one size at all frequencies hides a difference, and that of another size in each band exaggerates one where
    little is left.  So one of them suffices if the other one does not contradict.
    """
    t, votes = chooses.advantage(lag_s, other_s)
    if t >= _CLEAR_T:
        return True
    likelihood = fit.advantage(lag_s, other_s)[1]
    if votes < 0 or likelihood < 0:
        return False
    if likelihood >= least:
        return True
    return chooses.advantage_by_bands(lag_s, other_s) >= 0 and fit.advantage_by_bands(lag_s, other_s) >= least
