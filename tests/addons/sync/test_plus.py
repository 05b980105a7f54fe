"""PLUS's own pair of sequences: its method, and ours, against its published lag."""

from __future__ import annotations

import numpy as np
import pytest

from igtl_gateway.addons.sync.lag import Verdict, measure_lag
from igtl_gateway.addons.sync.plus import line_height, plus_lag
from tests.addons.sync.worlds import pair_of_plus
from tests.plus_sequences import water_tank, water_tank_pictures

#: TrackerLagSec of TemporalCalibrationResultsBaseline.xml.
BASELINE_S = -0.0648266


def test_the_bright_line_of_a_picture() -> None:
    rows, columns = np.mgrid[0:200, 0:300]
    picture = 200 * np.exp(-(((rows - 80 - 0.1 * columns) / 3) ** 2))
    picture[:, 100:110] = 0  # a shadow
    picture[20:23, 200:230] = 250  # a reflection, on some scan lines
    assert line_height(picture) == pytest.approx(80 + 0.1 * 150, abs=0.1)
    assert np.isnan(line_height(np.zeros((200, 300))))


def test_the_published_lag() -> None:
    fixed, moving = pair_of_plus()
    found = plus_lag(fixed, moving)
    assert found
    assert found.lag_s == pytest.approx(BASELINE_S, abs=0.001)
    assert found.error == pytest.approx(25.0423, abs=0.1)


def test_our_estimate_of_it() -> None:
    """The delay of the video changes by 50 ms from window to window: the lag is 65 ms, give or take 20."""
    fixed, moving = pair_of_plus()
    lag = measure_lag(fixed, moving)
    assert lag.verdict is Verdict.VARIES
    assert lag.lag_s == pytest.approx(BASELINE_S, abs=0.002)
    assert 0.012 < (lag.high_s - lag.low_s) / 2 < 0.025


def test_the_line_is_found_in_noise() -> None:
    found = np.array([line_height(picture) for picture in water_tank_pictures()])
    assert np.abs(found - water_tank().line_px).max() < 0.5  # of 270 rows of movement
