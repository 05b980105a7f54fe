"""Least squares by normal equations and Cholesky's factors, written out: the same bits on every machine.

The systems are small (six unknowns) and well scaled, so that the squared condition number does no harm.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[Any]

#: A pivot below this share of its diagonal element: the columns depend on each other.
_SINGULAR = 1e-9


def influence(design: Array, weights: Array) -> Array | None:
    """(k, n): the matrix that gives the weighted least squares solution, ``influence @ values``.

    None where the points do not determine it.

    Args:
        design: (n, k).
        weights: (n,), none below 0.
    """
    weighted = design * weights[:, None]
    factor = _cholesky(_gram(weighted, design))
    return None if factor is None else _solve(factor, weighted.T)


def least_squares(design: Array, values: Array, weights: Array) -> Array | None:
    """(k,) coefficients that minimise the weighted squares; None where the points do not determine them."""
    weighted = design * weights[:, None]
    factor = _cholesky(_gram(weighted, design))
    if factor is None:
        return None
    right = (weighted * values[:, None]).sum(axis=0)
    return _solve(factor, right[:, None])[:, 0]


def times(matrix: Array, vector: Array) -> Array:
    """Matrix times vector, without BLAS."""
    product: Array = (matrix * vector).sum(axis=-1)
    return product


def _gram(a: Array, b: Array) -> Array:
    """aᵀ b."""
    gram: Array = (a[:, :, None] * b[:, None, :]).sum(axis=0)
    return gram


def _cholesky(matrix: Array) -> Array | None:
    """The lower factor of a positive definite matrix."""
    factor = np.zeros_like(matrix)
    for j in range(len(matrix)):
        pivot = matrix[j, j] - (factor[j, :j] ** 2).sum()
        if not pivot > _SINGULAR * matrix[j, j]:
            return None
        factor[j, j] = np.sqrt(pivot)
        for i in range(j + 1, len(matrix)):
            factor[i, j] = (matrix[i, j] - (factor[i, :j] * factor[j, :j]).sum()) / factor[j, j]
    return factor


def _solve(factor: Array, right: Array) -> Array:
    """x of factor factorᵀ x = right, column by column."""
    x = right.astype(np.float64)
    size = len(factor)
    for i in range(size):
        x[i] = (x[i] - (factor[i, :i, None] * x[:i]).sum(axis=0)) / factor[i, i]
    for i in reversed(range(size)):
        x[i] = (x[i] - (factor[i + 1 :, i, None] * x[i + 1 :]).sum(axis=0)) / factor[i, i]
    return x
