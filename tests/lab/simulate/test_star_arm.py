"""The arm of the STAR scene: its arithmetic of rotations."""

from __future__ import annotations

import numpy as np
import pytest

from igtl_gateway_lab.simulate.star_arm import quaternion
from tests.lab.simulate.star_truth import matrix


@pytest.mark.parametrize("axis", range(4))
def test_quaternion_of_every_branch(axis: int) -> None:
    """Turns by 170° about x, y, z (each another largest element) and a small one: back to the same matrix."""
    half = np.deg2rad(85 if axis < 3 else 10)
    q = np.zeros(4)
    q[axis % 3], q[3] = np.sin(half), np.cos(half)
    found = quaternion(matrix(q))
    np.testing.assert_allclose(found * np.sign(found[3]), q, atol=1e-12)
