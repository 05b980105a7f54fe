"""Review of a suture plan: the depth noise of the camera and the distance from the tissue, for each stitch.

A flat image of the plan does not show the noise along the depth axis: a point at a wrong depth looks like a correct
one.  The review compares every planned entry and exit point with the tissue around it:

* ``material`` collects clouds, plans and transforms from the entries of a session, by their content (not by topic);
* ``scene`` combines the clouds into one depth image with the noise of each pixel (``noise``);
* ``surface`` fits the tissue around a point robustly; ``error`` computes the standard error of the distance from it;
* ``judge`` compares the figures with ``Thresholds``: the level is *ok*, *look* or *wrong*, with the reasons as text;
* ``executed`` finds where the tool passed each planned point.

Pure functions on arrays: no file, no clock, no LAPACK.  Formulae and limits: ``docs/evidence/review.md``.

The names load at their first use: the list of verbs imports this package, and needs none of them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from igtl_gateway.addons.review.assess import review_of
    from igtl_gateway.addons.review.choices import Thresholds
    from igtl_gateway.addons.review.material import Material
    from igtl_gateway.addons.review.model import (
        Change,
        CloudReview,
        EndReview,
        Executed,
        Level,
        PlanReview,
        Review,
        StitchReview,
    )

__all__ = [
    "Change",
    "CloudReview",
    "EndReview",
    "Executed",
    "Level",
    "Material",
    "PlanReview",
    "Review",
    "StitchReview",
    "Thresholds",
    "review_of",
]


def __getattr__(name: str) -> Any:
    """Import the names of the package when one of them is first used."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from igtl_gateway.addons.review import assess, choices, material, model

    for module in (assess, choices, material, model):
        globals().update({each: getattr(module, each) for each in __all__ if hasattr(module, each)})
    return globals()[name]
