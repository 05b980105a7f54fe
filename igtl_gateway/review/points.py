"""The planned points' own errors: what a point was lifted from, it inherits.

Whether a point lies off the tissue is a question about a difference, and both sides of it have errors.  A point that
is one of the camera's readings has all of that reading's noise.  One that was lifted from some readings, or from a
cloud that is not in the file, has less, or cannot be recognised: but then the whole plan scatters about the tissue
by more than the errors of the tissue, and no single point of it stands out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from igtl_gateway.review.error import SURE_95
from igtl_gateway.review.model import EndReview
from igtl_gateway.review.noise import MAD
from igtl_gateway.review.scene import DepthScene

Array = npt.NDArray[Any]

#: An end, and the standard deviation of single readings about the tissue there, in mm; None where it is not known.
Assessed = tuple[EndReview, float | None]

_SCATTERING = 6  # ends of a plan that tell how much it scatters
_AT_MOST = 1.5  # a median of so few sizes may well be too small by this
_NOTABLE = 2.0  # as variance; of 22 ends chance gives more once in 40


def with_own_errors(scene: DepthScene, ends: Sequence[Assessed]) -> list[EndReview]:
    """All ends of one version of a plan, with the errors of the planned points themselves."""
    return _scattered([(end, reading_mm) for end, reading_mm in _lifted(scene, ends)])


def _lifted(scene: DepthScene, ends: Sequence[Assessed]) -> list[Assessed]:
    """With the noise of the readings that the points are; one alone may be a reading by chance."""
    same = [scene.holds(scene.axes.optical(np.array(end.position))) for end, _ in ends]
    if 2 * sum(same) < len(same):
        return list(ends)
    return [
        (_read(end, reading_mm) if own and reading_mm is not None else end, reading_mm)
        for (end, reading_mm), own in zip(ends, same, strict=True)
    ]


def _read(end: EndReview, reading_mm: float) -> EndReview:
    """A reading's scatter about the tissue has the error of the tissue in it."""
    error_mm = max(end.error_mm or 0.0, reading_mm)
    return replace(end, lifted=True, error_mm=error_mm, interval_mm=SURE_95 * error_mm)


def _scattered(ends: Sequence[Assessed]) -> list[EndReview]:
    """With how much the plan scatters about the tissue by more than the errors say."""
    distances = np.array([end.distance_mm for end, _ in ends if end.distance_mm is not None])
    errors = np.array([end.error_mm for end, _ in ends if end.error_mm is not None])
    if len(distances) < _SCATTERING:
        return [end for end, _ in ends]
    scatter = float((MAD * np.median(np.abs(distances - np.median(distances)))) ** 2)
    expected = float(np.median(errors)) ** 2
    beyond_mm = _AT_MOST * float(np.sqrt(scatter - expected)) if scatter > _NOTABLE * expected else 0.0
    return [
        end if reading_mm is None else replace(end, scatter_mm=0.0 if end.lifted else min(beyond_mm, reading_mm))
        for end, reading_mm in ends
    ]
