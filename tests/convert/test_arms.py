"""The rows of arms: which values are refused, with their places, and which row a device belongs to."""

from __future__ import annotations

import math
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from igtl_gateway.base.errors import ConfigError
from igtl_gateway.convert.arms import EVERY_ARM, ArmsRow, arms_of_profile, arms_row
from tests.tables import table


@table(
    "values",
    [
        {},
        {"arms": "**"},
        {"arms": "/PSM*", "igtl_unit": "mm"},
        {"workspace": (0.0, 0.0, 0.0, 1e-9)},
        {"workspace": (-1.0, -1.0, -1.0, -0.5, -0.5, -0.5)},
        {"max_speed": 0.0, "max_turn_speed": 0.0, "max_age_s": 0.0, "max_behind_s": 0.0},
        {"max_age_s": 365 * 86_400.0},
        {"joint_min": (-1.0, 0.0), "joint_max": (-1.0, 3.0)},
        {"joint_min": (-1.0, 0.0), "joint_max": (1.0, 3.0), "joint_speed": ()},
        {"joint_min": (-1.0, 0.0), "joint_max": (1.0, 3.0), "joint_speed": (1.0, 2.0)},
        {"joint_speed": (1.0, 2.0, 3.0)},
    ],
)
def test_possible_values(values: dict[str, Any]) -> None:
    ArmsRow(**values).check("crtk[0]")


@table(
    ("values", "text"),
    [
        ({"arms": "PSM1"}, ".arms: found 'PSM1', expected namespaces such as /PSM1 or /PSM*"),
        ({"arms": "*"}, ".arms: found '*', expected namespaces"),
        ({"arms": ""}, ".arms: found '', expected namespaces"),
        ({"arms": "/PSM 1"}, ".arms: found '/PSM 1', expected namespaces"),
        ({"igtl_unit": "inch"}, ".igtl_unit: found 'inch', expected one of m, dm, cm, mm, um"),
        ({"max_speed": -0.1}, ".max_speed: found -0.1, expected a number of at least 0"),
        ({"max_age_s": math.nan}, ".max_age_s: found nan, expected a number of at least 0"),
        ({"max_force": math.inf}, ".max_force: found inf, expected a number of at least 0"),
        ({"max_behind_s": -1.0}, ".max_behind_s: found -1.0, expected a number of at least 0"),
        ({"max_age_s": 365 * 86_400.0 + 1}, ".max_age_s: found 31536001.0"),
        ({"joint_speed": (1.0, math.nan)}, ".joint_speed: found [1.0, nan], expected finite numbers"),
        ({"workspace": (0.0, 0.0, math.inf, 1.0)}, ".workspace: found [0.0, 0.0, inf, 1.0], expected finite numbers"),
        ({"workspace": (0.0,) * 5}, ".workspace: found 5 numbers, expected 4 of a sphere or 6 of a box"),
        ({"workspace": (0.0, 0.0, 0.0, 0.0)}, ".workspace: found radius 0.0, expected more than 0"),
        (
            {"workspace": (0.0, 0.0, 0.0, 1.0, 0.0, 1.0)},
            ".workspace: found [0.0, 0.0, 0.0, 1.0, 0.0, 1.0], expected the least x, y, z, then the greatest",
        ),
        ({"joint_min": (0.0,)}, ".joint_max: found 0 joints, expected 1 as joint_min"),
        ({"joint_min": (1.0,), "joint_max": (0.5,)}, ".joint_max: found [0.5], expected at least joint_min"),
        ({"joint_speed": (0.0,)}, ".joint_speed: found [0.0], expected numbers above 0"),
        (
            {"joint_min": (0.0,) * 3, "joint_max": (1.0,) * 3, "joint_speed": (1.0,) * 2},
            ".joint_speed: found 2 joints, expected 1 or 3",
        ),
    ],
)
def test_impossible_values(values: dict[str, Any], text: str) -> None:
    with pytest.raises(ConfigError) as error:
        ArmsRow(**values).check("crtk[2]")
    assert str(error.value).startswith(f"crtk[2]{text}")


@given(st.lists(st.floats(-1, 1), min_size=6, max_size=6))
def test_a_box_has_room_along_each_axis(box: list[float]) -> None:
    row = ArmsRow(workspace=tuple(box))
    if all(least < most for least, most in zip(box[:3], box[3:], strict=True)):
        row.check("")
    else:
        with pytest.raises(ConfigError, match="expected the least x, y, z, then the greatest"):
            row.check("")


@table(
    ("profile", "glob"),
    [
        ("crtk", EVERY_ARM), ("crtk:", None), ("crtk:/PSM*", "/PSM*"), ("crtk:**", "**"), ("crtk:PSM1", None),
        ("crtk:*", None),
    ],
)  # fmt: skip
def test_the_arms_of_a_profile(profile: str, glob: str | None) -> None:
    if glob is None:
        with pytest.raises(ConfigError, match=r"found 'crtk:.*', expected crtk:/NAMESPACE such as crtk:/PSM1"):
            arms_of_profile(profile)
    else:
        assert arms_of_profile(profile) == glob


@table("profile", ["auto", "slicer", "", "crtkx", "crtkx:/PSM1", "CRTK"])
def test_other_profiles_have_no_arms(profile: str) -> None:
    assert arms_of_profile(profile) is None


def test_a_device_belongs_to_the_first_row_of_any_of_its_namespaces() -> None:
    jaw, psm, every = ArmsRow("/PSM1/jaw"), ArmsRow("/PSM*"), ArmsRow()
    rows = (jaw, psm, every)
    assert arms_row(rows, "PSM1/jaw/measured_js") is jaw
    assert arms_row(rows, "PSM1/measured_js") is psm
    assert arms_row((psm, jaw), "PSM1/jaw/measured_js") is psm, "a sub-device belongs to its arm, too"
    assert arms_row(rows, "MTM/measured_js") is every
    assert arms_row((jaw, psm), "MTM/measured_js") is None
    assert arms_row(rows, "PSM1/unknown") is None
    assert arms_row((), "PSM1/measured_js") is None
