"""How much better one lag explains a movement than another one, with noise of another size in each band of frequency.

The errors of a tracker in a video are slow, its jitter is fast.  With one size for all noise, what a lag explains at
the few frequencies of a movement is lost in the noise of all others (Whittle, 1953).
"""

from __future__ import annotations

import numpy as np

from igtl_gateway.addons.sync.signal import Floats

_LEAST_FREEDOM = 8.0  # degrees of freedom of a band
_WIDTH = 0.35  # of a band, relative to its lower end
_GAP = 4.0  # steps between two samples from which on nothing is known
_HIGHEST = 2.0  # frequency, relative to the cut-off, that the low-pass leaves anything of
_FLOOR = 1e-9  # power of a band relative to the largest: numbers are not more exact


def likelihood_ratio(times: Floats, first: Floats, second: Floats, cut_off_hz: float, drift: int) -> float:
    """Return twice the logarithm of the ratio of the likelihoods of two residuals (N), at times (N) in s.

    Args:
        times, first, second: the residuals, of equal samples.
        cut_off_hz: of the low-pass of the signals.
        drift: parameters of the slow drift, which the residuals are without.
    """
    step = float(np.median(np.diff(times)))
    grid = np.arange(times[0], times[-1] + step / 2, step)
    after = np.clip(np.searchsorted(times, grid), 1, len(times) - 1)
    known = times[after] - times[after - 1] <= _GAP * step
    residuals = np.stack([np.interp(grid, times, each) * known for each in (first, second)])
    seconds, top = float(np.count_nonzero(known)) * step, min(_HIGHEST * cut_off_hz, 0.5 / step)
    size = 1 << (len(grid) - 1).bit_length()
    frequencies = np.fft.rfftfreq(size, step)
    used = frequencies < top
    edges = _edges(seconds, top)
    band = np.searchsorted(edges, frequencies[used], side="right") - 1
    freedom = 2 * seconds * np.diff(edges)
    freedom[0] = max(freedom[0] - drift, 1.0)
    powers = [np.bincount(band, each, len(freedom)) for each in np.abs(np.fft.rfft(residuals, size)[:, used]) ** 2]
    own, other = (np.maximum(each, max(_FLOOR * float(each.max()), 1e-300)) for each in powers)
    return float(np.sum(freedom * np.log(other / own)))


def _edges(seconds: float, top_hz: float) -> Floats:
    """The ends of bands from 0 on: wider at higher frequencies, and none with few degrees of freedom."""
    edges, least = [0.0], _LEAST_FREEDOM / 2 / max(seconds, 1e-9)
    while edges[-1] < top_hz:
        edges.append(edges[-1] + max(least, _WIDTH * edges[-1]))
    edges[-1] = top_hz
    if len(edges) > 2 and edges[-1] - edges[-2] < least / 2:
        del edges[-2]
    return np.array(edges)
