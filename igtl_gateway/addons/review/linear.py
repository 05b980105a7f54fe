"""Least squares with normal equations and explicit Cholesky factors: the same bits on every machine.

The systems are small (six unknowns) and well scaled, so the squared condition number is acceptable.
"""

from __future__ import annotations

import math
from operator import mul
from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[Any]

#: If a pivot is below this share of its diagonal element, the columns are linearly dependent.
_SINGULAR = 1e-9


class Design:
    """The columns of a linear model, prepared for many solutions with different weights.

    Args:
        columns: (k, n) coefficient of each of k unknowns in each of n equations.
    """

    def __init__(self, columns: Array) -> None:
        self.columns = columns
        self._rows, self._others = np.tril_indices(len(columns))
        self._products = columns[self._rows] * columns[self._others]

    def solve(self, values: Array, weights: Array) -> Array | None:
        """Return the (k,) unknowns that minimise the weighted squares; None if the equations do not determine them."""
        factor = self._factor(weights)
        if factor is None:
            return None
        return np.array(_solve(factor, times(self.columns, values * weights).tolist()))

    def influence(self, weights: Array) -> Array | None:
        """Return the (k, n) matrix whose product with the values is the solution: ``times(influence, values)``."""
        factor = self._factor(weights)
        return None if factor is None else np.stack(_solve(factor, list(self.columns * weights)))

    def weights_of(self, functional: Array, weights: Array) -> Array | None:
        """Return the (n,) weight of each value in a linear functional (k,) of the solution."""
        factor = self._factor(weights)
        return None if factor is None else weights * self.values(np.array(_solve(factor, functional.tolist())))

    def variances(self, functionals: Array, weights: Array) -> Array | None:
        """Return the (m,) variances of linear functionals (m, k) of the solution, for values of variance 1 / weight."""
        factor = self._factor(weights)
        if factor is None:
            return None
        solved = np.stack(_solve(factor, list(functionals.T)))
        return times(functionals, np.ascontiguousarray(solved.T))  # by rows: the order of the sum decides its bits

    def values(self, unknowns: Array) -> Array:
        """Return the (n,) values of the model."""
        values: Array = (self.columns * unknowns[:, None]).sum(axis=0)
        return values

    def _factor(self, weights: Array) -> list[list[float]] | None:
        gram = np.zeros((len(self.columns), len(self.columns)))
        gram[self._rows, self._others] = times(self._products, weights)
        return _cholesky(gram.tolist())


def times(matrix: Array, vector: Array) -> Array:
    """Return matrix times vector, without BLAS."""
    product: Array = (matrix * vector).sum(axis=-1)
    return product


def _cholesky(matrix: list[list[float]]) -> list[list[float]] | None:
    """Return the lower factor of a positive definite matrix; only its lower half is read.  None if it is singular."""
    factor: list[list[float]] = []
    for i, row in enumerate(matrix):
        done: list[float] = []
        for j in range(i):
            done.append((row[j] - sum(map(mul, done, factor[j][:j]))) / factor[j][j])
        pivot = row[i] - sum(map(mul, done, done))
        if not pivot > _SINGULAR * row[i]:
            return None
        factor.append([*done, math.sqrt(pivot)])
    return factor


def _solve(factor: list[list[float]], right: list[Any]) -> list[Any]:
    """Return x of factor factorᵀ x = right; the items are numbers, or arrays with one element for each system."""
    x = list(right)
    size = len(factor)
    for i in range(size):
        for j in range(i):
            x[i] = x[i] - factor[i][j] * x[j]
        x[i] = x[i] / factor[i][i]
    for i in reversed(range(size)):
        for j in range(i + 1, size):
            x[i] = x[i] - factor[j][i] * x[j]
        x[i] = x[i] / factor[i][i]
    return x
