"""Filters of movements."""

from __future__ import annotations

import numpy as np

from igtl_gateway.addons.sync.signal import _smoothed


def test_columns_are_smoothed_as_a_table_is() -> None:
    """To the last bit, so that lags stay what they were."""
    values, sigma = np.random.default_rng(3).normal(size=(1_000, 3)), 20.0
    kernel = np.exp(-0.5 * (np.arange(-60, 61) / sigma) ** 2)
    both = np.column_stack([values - values.mean(axis=0), np.ones(1_000)])
    spectrum = np.fft.rfft(kernel, 2048)[:, np.newaxis]
    sums = np.fft.irfft(np.fft.rfft(both, 2048, axis=0) * spectrum, 2048, axis=0)[60:1_060]
    assert (_smoothed(values, sigma) == sums[:, :-1] / sums[:, -1:] + values.mean(axis=0)).all()
