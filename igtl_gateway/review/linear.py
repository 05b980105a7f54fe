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


class Design:
    """The columns of a linear model, ready to be solved many times with other weights.

    Args:
        columns: (k, n): what each of k unknowns is multiplied with in each of n equations.
    """

    def __init__(self, columns: Array) -> None:
        self.columns = columns
        self._rows, self._others = np.tril_indices(len(columns))
        self._products = columns[self._rows] * columns[self._others]

    def solve(self, values: Array, weights: Array) -> Array | None:
        """(k,) unknowns that minimise the weighted squares; None where the equations do not determine them."""
        factor = self._factor(weights)
        if factor is None:
            return None
        return _solve(factor, times(self.columns, values * weights)[:, None])[:, 0]

    def influence(self, weights: Array) -> Array | None:
        """(k, n): the matrix that gives the solution, ``times(influence, values)``."""
        factor = self._factor(weights)
        return None if factor is None else _solve(factor, self.columns * weights)

    def values(self, unknowns: Array) -> Array:
        """(n,) what the model gives."""
        values: Array = (self.columns * unknowns[:, None]).sum(axis=0)
        return values

    def _factor(self, weights: Array) -> Array | None:
        gram = np.zeros((len(self.columns), len(self.columns)))
        gram[self._rows, self._others] = times(self._products, weights)
        return _cholesky(gram)


def times(matrix: Array, vector: Array) -> Array:
    """Matrix times vector, without BLAS."""
    product: Array = (matrix * vector).sum(axis=-1)
    return product


def _cholesky(matrix: Array) -> Array | None:
    """The lower factor of a positive definite matrix, of which the lower half is read."""
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
