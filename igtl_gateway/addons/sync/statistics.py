"""Quantiles, and how many of correlated samples count as one."""

from __future__ import annotations

import math

import numpy as np

from igtl_gateway.addons.sync.signal import Floats

NORMAL_975 = 1.959964


def student(freedom: int) -> float:
    """Return the 97.5 % quantile of Student's t (Abramowitz and Stegun 26.7.5), within 1 % from 3 degrees on."""
    if freedom < 3:
        return (math.inf, 12.706, 4.303)[max(freedom, 0)]
    z, v = NORMAL_975, float(freedom)
    g1 = (z**3 + z) / 4
    g2 = (5 * z**5 + 16 * z**3 + 3 * z) / 96
    g3 = (3 * z**7 + 19 * z**5 + 17 * z**3 - 15 * z) / 384
    return z + g1 / v + g2 / v**2 + g3 / v**3


def chi_squared(freedom: int, z: float = 3.090232) -> float:
    """Return the quantile of chi-squared that z is of the normal distribution (Wilson and Hilferty, 1931).

    By default, 99.9 %.
    """
    part = 2 / (9 * freedom)
    return freedom * float((1 - part + z * math.sqrt(part)) ** 3)


def correlation_time(residual: Floats) -> float:
    """Return the integrated autocorrelation time of residuals, in samples: how many of them count as one."""
    centred = residual - residual.mean()
    total = float(np.sum(centred**2))
    if total == 0:
        return 1.0
    time = 1.0
    for shift in range(1, len(centred) // 4):
        correlation = float(np.sum(centred[shift:] * centred[:-shift])) / total
        if correlation < 0.05:
            break
        time += 2 * correlation
    return time


def half_waves(times: Floats, values: Floats) -> float:
    """Return how often a movement (N) without offset crosses 0, by its slopes (Rice, 1944): its degrees of freedom."""
    steps = np.diff(times)
    near = steps <= 3 * float(np.median(steps))
    slope = float(np.sum((np.diff(values)[near] / steps[near]) ** 2)) / max(int(np.count_nonzero(near)), 1)
    size = float(np.mean(values**2))
    return math.sqrt(slope / size) / math.pi * float(times[-1] - times[0]) if size > 0 else 0.0


def occupancy(values: Floats) -> float:
    """Return how much of the time something moves (N), 1 up to the kurtosis of noise, 3.

    What moves now and then has few independent values: two movements of one stroke each are alike at some lag.
    """
    squares = values**2
    size = float(np.mean(squares**2))
    return min(1.0, 3 * float(np.mean(squares)) ** 2 / size) if size > 0 else 0.0
