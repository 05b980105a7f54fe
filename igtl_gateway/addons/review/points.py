"""The errors of the planned points themselves.

The distance of a point from the tissue is a difference, and both of its terms have errors.  A point that is one of the
camera's readings (*lifted*) has all noise of that reading.  A point that was computed from several readings has less
noise, and one from a cloud that is not in the file cannot be recognised.  In these cases the complete plan scatters
about the tissue by more than the errors of the tissue, and no single point of it stands out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from igtl_gateway.addons.review.error import SURE_95
from igtl_gateway.addons.review.model import EndReview
from igtl_gateway.addons.review.noise import MAD
from igtl_gateway.addons.review.scene import DepthScene

Array = npt.NDArray[Any]

#: An end, and the standard deviation of single readings about the tissue around it, in mm; None if unknown.
Assessed = tuple[EndReview, float | None]

_MIN_ENDS = 6  # of a plan, for an estimate of its scatter
_MARGIN = 1.5  # factor by which the median of few absolute values might be too small
_NOTABLE = 2.0  # ratio of variances; for 22 ends it is exceeded by chance once in 40 cases


def with_own_errors(scene: DepthScene, ends: Sequence[Assessed]) -> list[EndReview]:
    """Return all ends of one version of a plan, with the errors of the planned points themselves."""
    return _with_scatter(_with_reading_errors(scene, ends))


def _with_reading_errors(scene: DepthScene, ends: Sequence[Assessed]) -> list[Assessed]:
    """Return the ends with the noise of their readings, if at least half of the plan are readings (not by chance)."""
    same = [scene.holds(scene.axes.to_optical(np.array(end.position))) for end, _ in ends]
    if 2 * sum(same) < len(same):
        return list(ends)
    return [
        (_lifted(end, reading_mm) if is_reading and reading_mm is not None else end, reading_mm)
        for (end, reading_mm), is_reading in zip(ends, same, strict=True)
    ]


def _lifted(end: EndReview, reading_mm: float) -> EndReview:
    """Return the end as a reading.  The scatter of readings about the tissue contains the error of the tissue."""
    error_mm = max(end.error_mm or 0.0, reading_mm)
    return replace(end, lifted=True, error_mm=error_mm, interval_mm=SURE_95 * error_mm)


def _with_scatter(ends: Sequence[Assessed]) -> list[EndReview]:
    """Return the ends with the scatter of the plan about the tissue that the errors do not explain."""
    distances = np.array([end.distance_mm for end, _ in ends if end.distance_mm is not None])
    errors = np.array([end.error_mm for end, _ in ends if end.error_mm is not None])
    if len(distances) < _MIN_ENDS:
        return [end for end, _ in ends]
    scatter = float((MAD * np.median(np.abs(distances - np.median(distances)))) ** 2)
    expected = float(np.median(errors)) ** 2
    excess_mm = _MARGIN * float(np.sqrt(scatter - expected)) if scatter > _NOTABLE * expected else 0.0
    return [
        end if reading_mm is None else replace(end, scatter_mm=0.0 if end.lifted else min(excess_mm, reading_mm))
        for end, reading_mm in ends
    ]
