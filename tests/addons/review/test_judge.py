"""From figures to levels: each limit from both sides."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from igtl_gateway.addons.review import judge
from igtl_gateway.addons.review.choices import Thresholds
from igtl_gateway.addons.review.model import EndReview, Level
from tests.tables import table

_GOOD = EndReview(
    (0.0, 0.0, 0.25),
    distance_mm=0.1,
    error_mm=0.05,
    noise_mm=0.2,
    reading_mm=0.1,
    density_mm2=8.0,
    missing=0.1,
    spacing_mm=3.0,
)
_LIMITS = Thresholds()


def _level(change: dict[str, Any]) -> Level:
    return judge.worst_level(list(judge.of_end("entry", replace(_GOOD, **change), _LIMITS)))[0]


@table(
    ("change", "level"),
    [
        ({}, Level.OK),
        ({"distance_mm": 0.49}, Level.OK),
        ({"distance_mm": -0.51}, Level.LOOK),
        ({"distance_mm": 0.99}, Level.LOOK),
        ({"distance_mm": 1.01}, Level.WRONG),
        ({"distance_mm": -1.01}, Level.WRONG),
        ({"distance_mm": 1.5, "error_mm": 0.6}, Level.LOOK),  # a large distance, but uncertain
        ({"distance_mm": None}, Level.LOOK),
        ({"noise_mm": 0.41}, Level.LOOK),
        ({"noise_mm": None}, Level.OK),
        ({"reading_mm": -0.8}, Level.LOOK),
        ({"wider_mm": 0.6}, Level.OK),
        ({"wider_mm": -0.8}, Level.LOOK),
        ({"density_mm2": 1.9}, Level.LOOK),
        ({"missing": 0.51}, Level.LOOK),
    ],
)
def test_each_limit(change: dict[str, Any], level: Level) -> None:
    assert _level(change) is level


def test_the_worst_reason_is_first_and_has_side_and_distance() -> None:
    end = replace(_GOOD, distance_mm=-2.0, noise_mm=0.5, reading_mm=-1.9)
    level, texts = judge.worst_level([*judge.of_length("bite", 9.0, 6.0, 0.4), *judge.of_end("exit", end, _LIMITS)])
    assert level is Level.WRONG
    assert texts[0] == "exit 2.00 ± 0.05 mm below the tissue"
    assert "bite 9.0 mm, median of the plan 6.0 mm" in texts
    assert any("1.9 mm too deep" in text for text in texts)
    assert any("depth noise 0.50 mm" in text for text in texts)


def test_a_length_is_compared_with_the_median() -> None:
    assert not list(judge.of_length("bite", 8.3, 6.0, 0.4))
    assert not list(judge.of_length("bite", 8.3, 0.0, 0.4))  # too few stitches for a median
    assert list(judge.of_length("bite", 3.5, 6.0, 0.4))
