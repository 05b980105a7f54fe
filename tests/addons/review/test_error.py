"""The 95 % interval contains the true value in 95 of 100 cases, for five kinds of simulated cameras.

``tools/evidence/review_coverage.py`` has more draws; its table is in docs/evidence/review.md.
"""

from __future__ import annotations

import numpy as np
import pytest

from tests.addons.review.coverage import covered
from tests.addons.review.sensors import SENSORS


@pytest.mark.slow
@pytest.mark.parametrize("sensor", SENSORS)
def test_the_interval_holds_over_distances_and_shapes(sensor: str) -> None:
    """36 draws of six scenes: by chance 31 or more of a true 95 %."""
    found = np.concatenate([covered(sensor, kind, mm, 6, 1, 6) for mm, kind in _PLACES])
    inside = np.abs(found[:, 0]) <= 1.96 * found[:, 1]
    assert len(found) == 36
    assert inside.mean() >= 0.85
    assert 0.6 < np.sqrt(np.median((found[:, 0] / found[:, 1]) ** 2) / 0.4549) < 1.4


_PLACES = [(mm, kind) for mm in (60, 250, 1000) for kind in ("flat", "curved")]
