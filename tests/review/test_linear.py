"""Least squares, against numpy's."""

from __future__ import annotations

import numpy as np

from igtl_gateway.review.linear import influence, least_squares, times

_NOISE = np.random.default_rng(3)
_DESIGN = _NOISE.standard_normal((40, 6))
_VALUES = _NOISE.standard_normal(40)
_WEIGHTS = _NOISE.random(40)


def test_the_solution_is_that_of_lapack() -> None:
    root = np.sqrt(_WEIGHTS)
    expected = np.linalg.lstsq(_DESIGN * root[:, None], _VALUES * root, rcond=None)[0]
    found = least_squares(_DESIGN, _VALUES, _WEIGHTS)
    assert found is not None
    np.testing.assert_allclose(found, expected, atol=1e-12)


def test_the_influence_of_each_value_adds_up_to_the_solution() -> None:
    matrix = influence(_DESIGN, _WEIGHTS)
    solution = least_squares(_DESIGN, _VALUES, _WEIGHTS)
    assert matrix is not None
    assert solution is not None
    np.testing.assert_allclose(times(matrix, _VALUES), solution, atol=1e-12)


def test_what_does_not_determine_the_unknowns_is_refused() -> None:
    design = np.stack([np.ones(9), np.arange(9.0), 2 * np.arange(9.0) + 1], axis=1)
    assert least_squares(design, np.arange(9.0), np.ones(9)) is None
    assert influence(_DESIGN, np.zeros(40)) is None
