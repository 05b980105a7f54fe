"""Review of a suture plan: what the camera's depth was worth at each stitch, and whether the stitch lies on tissue.

On a flat picture of the plan the noise along the depth axis cannot be seen, and a point that was lifted to a wrong
depth looks as good as any.  Here every planned entry and exit point is held against the tissue around it:

* ``material`` collects clouds, plans and transforms from the entries of a session (whatever their topics are called);
* ``scene`` makes of the clouds one depth picture and the noise of each pixel, in millimetres (``noise``);
* ``surface`` fits the tissue around a point, robustly, and says how far the point is from it, and how sure that is;
* ``judge`` compares the figures with ``Thresholds`` and says *ok*, *look* or *wrong*, with the reasons as text;
* ``executed`` finds where the tool passed each planned point.

Pure functions on arrays: no file, no clock, no LAPACK.  Formulae and limits: ``docs/review.md``.
"""

from igtl_gateway.review.assess import review_of
from igtl_gateway.review.material import Material
from igtl_gateway.review.model import (
    Change,
    CloudReview,
    EndReview,
    Executed,
    Level,
    PlanReview,
    Review,
    StitchReview,
    Thresholds,
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
