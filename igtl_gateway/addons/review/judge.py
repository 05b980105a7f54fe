"""Comparison of the figures of a stitch with the thresholds: levels and their reasons."""

from __future__ import annotations

from collections.abc import Iterator
from math import hypot

from igtl_gateway.addons.review.choices import Thresholds
from igtl_gateway.addons.review.model import EndReview, Level

#: A level and the reason for it.
Reason = tuple[Level, str]


def worst_level(reasons: list[Reason]) -> tuple[Level, tuple[str, ...]]:
    """Return the worst level, and the reasons as text, the worst first."""
    ordered = sorted(reasons, key=lambda reason: -reason[0].rank)
    return (ordered[0][0] if ordered else Level.OK), tuple(text for _, text in ordered)


def of_end(name: str, end: EndReview, limits: Thresholds) -> Iterator[Reason]:
    """Yield the reasons of an entry or exit point; ``name`` is "entry" or "exit"."""
    if end.distance_mm is None or end.error_mm is None:
        yield Level.LOOK, f"{name}: too few points of tissue around it for a comparison"
    else:
        off, side = abs(end.distance_mm), "above" if end.distance_mm > 0 else "below"
        text = f"{name} {off:.2f} ± {end.error_mm:.2f} mm {side} the tissue"
        error_mm = hypot(end.error_mm, end.scatter_mm or 0.0)
        if off >= limits.wrong_mm and off > limits.sure * error_mm:
            yield Level.WRONG, text
        elif off >= limits.wrong_mm and off > limits.sure * end.error_mm:
            yield Level.LOOK, f"{text}, but the complete plan scatters by {end.scatter_mm:.2f} mm"
        elif off >= limits.look_mm:
            yield Level.LOOK, text
    if end.reading_mm is not None and abs(end.reading_mm) >= limits.reading_mm:
        where = "near" if end.reading_mm > 0 else "deep"
        yield (
            Level.LOOK,
            f"{name}: the camera reads {abs(end.reading_mm):.1f} mm too {where}, compared with the tissue around",
        )
    if end.wider_mm is not None and abs(end.wider_mm) >= limits.reading_mm:
        side = "above" if end.wider_mm > 0 else "below"
        yield (
            Level.LOOK,
            f"{name}: with a wider window the tissue is {abs(end.wider_mm):.1f} mm {side} the fitted surface",
        )
    if end.noise_mm is not None and end.noise_mm > limits.noise_mm:
        yield Level.LOOK, f"{name}: depth noise {end.noise_mm:.2f} mm"
    if end.density_mm2 is not None and end.density_mm2 < limits.density_mm2:
        yield Level.LOOK, f"{name}: {end.density_mm2:.1f} points/mm²"
    if end.missing is not None and end.missing > limits.missing:
        yield Level.LOOK, f"{name}: {end.missing:.0%} of the pixels have no depth"


def of_length(name: str, length_mm: float, median_mm: float, share: float) -> Iterator[Reason]:
    """Yield a reason for a length that differs from the plan's median by more than this share of the median."""
    if median_mm > 0 and abs(length_mm - median_mm) > share * median_mm:
        yield Level.LOOK, f"{name} {length_mm:.1f} mm, median of the plan {median_mm:.1f} mm"
