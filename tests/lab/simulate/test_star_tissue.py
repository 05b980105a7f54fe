"""The tissue of the STAR scene: the true plan lies on it."""

from __future__ import annotations

import numpy as np

from igtl_gateway_lab.simulate.star_tissue import surface_distance, true_plan
from tests.lab.simulate.star_truth import length


def test_stitches_have_their_spacing_and_bite_and_lie_on_the_tissue() -> None:
    plan = true_plan()
    assert plan.entry.shape == plan.exit.shape == (11, 3)
    for row in (plan.entry, plan.exit):
        assert np.abs(surface_distance(row)).max() < 1e-9
        # 3 mm along the axis; the folds between two stitches make it a little more
        np.testing.assert_allclose(length(np.diff(row, axis=0)) * 1e3, 3.0, atol=0.25)
    # 3.5 mm of arc to either side; the chord is shorter, the folds change it by some tenths
    np.testing.assert_allclose(length(plan.entry - plan.exit) * 1e3, 7.0, atol=0.4)
    assert (plan.entry[:, 1] < plan.exit[:, 1]).all()
