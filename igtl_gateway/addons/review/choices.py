"""What a user can choose of a review.  A choice is a field that has the help of its option."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import Any, TypeVar

from igtl_gateway.addon.settings import Setting

T = TypeVar("T")


def option(default: T, metavar: str, about: str, **more: Any) -> T:
    """A field with its default, the placeholder and the help of its option, and other columns of its row."""
    made: T = field(default=default, metadata={"metavar": metavar, "about": about, **more})
    return made


def limit(default: float, metavar: str, about: str) -> float:
    """A threshold: a number above 0; the help has what it is, and the reason of the default."""
    return option(default, metavar, about, least=0, open_ends=True)


def rows_of(kind: Any, group: str = "") -> tuple[Setting, ...]:
    """Return the options of a dataclass of such fields."""
    rows: list[Any] = list(fields(kind))
    return tuple(Setting(each.name, each.default, group=group, **each.metadata) for each in rows)


#: Default for the maximum number of clouds that a review uses.
CLOUDS = 24


@dataclass(frozen=True, slots=True)
class ReviewSelection:
    """What a review is about; "" selects the default of the help."""

    plan: str = option("", "TOPIC", "topic of the plan", shown="pairs of points on the tissue")
    cloud: str = option("", "TOPIC", "topic of the point cloud", shown="the largest")
    tool: str = option("", "TOPIC", "topic or frame of the tool", shown="the one that comes nearest")
    clouds: int = option(CLOUDS, "N", "maximum number of clouds, evenly spread over time", least=1)


@dataclass(frozen=True, slots=True)
class Thresholds:
    """The limits that make a figure a reason; the help of each has the reason of its default.

    The difference that ``reading_mm`` limits is also that of the surface from one of a window twice as wide.
    """

    wrong_mm: float = limit(
        1.0, "MM", "a point this far from the tissue is wrong; two fifths of the needle's bite of 2.5 mm"
    )
    look_mm: float = limit(
        0.5, "MM", "a point this far from the tissue needs a look; the cost of lifting a point from one cloud"
    )
    sure: float = limit(3.0, "FACTOR", "standard errors that a distance must exceed to be wrong; once in 400 by chance")
    noise_mm: float = limit(0.4, "MM", "depth noise above which a point needs a look; 0.4 times --wrong-mm")
    reading_mm: float = limit(
        0.7, "MM", "depth difference to the tissue around it above which a point needs a look; wet spots, glints, folds"
    )
    density_mm2: float = limit(
        2.0, "PER_MM2", "points/mm² below which a point needs a look; a hundred in the window for six unknowns"
    )
    missing: float = limit(0.5, "SHARE", "share of pixels without depth above which a point needs a look")
    spacing: float = limit(0.4, "SHARE", "largest deviation from the usual spacing of the plan, as a share")
    bite: float = limit(0.4, "SHARE", "largest deviation from the usual bite length of the plan, as a share")
    reach_mm: float = limit(5.0, "MM", "the tool has reached a point if it came this near")
    window_mm: float = limit(4.0, "MM", "radius of the tissue that the quadric is fitted to")
    place_mm: float = limit(2.5, "MM", "radius in which noise, density and missing pixels are measured")
    core_mm: float = limit(1.0, "MM", "radius in which the depth at the point is measured")
