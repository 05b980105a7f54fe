"""Least squares, compared with NumPy."""

from __future__ import annotations

import numpy as np

from igtl_gateway.addons.review.linear import Design, times

_NOISE = np.random.default_rng(3)
_DESIGN = _NOISE.standard_normal((40, 6))
_VALUES = _NOISE.standard_normal(40)
_WEIGHTS = _NOISE.random(40)


def test_the_solution_is_that_of_lapack() -> None:
    root = np.sqrt(_WEIGHTS)
    expected = np.linalg.lstsq(_DESIGN * root[:, None], _VALUES * root, rcond=None)[0]
    found = Design(_DESIGN.T).solve(_VALUES, _WEIGHTS)
    assert found is not None
    np.testing.assert_allclose(found, expected, atol=1e-12)


def test_the_influence_of_each_value_adds_up_to_the_solution() -> None:
    matrix = Design(_DESIGN.T).influence(_WEIGHTS)
    solution = Design(_DESIGN.T).solve(_VALUES, _WEIGHTS)
    assert matrix is not None
    assert solution is not None
    np.testing.assert_allclose(times(matrix, _VALUES), solution, atol=1e-12)


def test_a_singular_system_has_no_solution() -> None:
    design = Design(np.stack([np.ones(9), np.arange(9.0), 2 * np.arange(9.0) + 1]))
    assert design.solve(np.arange(9.0), np.ones(9)) is None
    assert Design(_DESIGN.T).influence(np.zeros(40)) is None


def test_the_values_of_a_solution_are_those_of_the_model() -> None:
    np.testing.assert_allclose(Design(_DESIGN.T).values(np.arange(6.0)), _DESIGN @ np.arange(6.0), atol=1e-12)
