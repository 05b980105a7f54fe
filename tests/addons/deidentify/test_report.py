"""The report: what is counted is a rule, and its options follow from what was done."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from igtl_gateway.addons.deidentify import rules as package
from igtl_gateway.addons.deidentify.report import Report
from igtl_gateway.addons.deidentify.rules import RULES
from tests.tables import table


def test_what_the_code_counts_is_a_rule() -> None:
    folder = Path(str(package.__file__)).parent
    used = {name for path in folder.glob("*.py") for name in re.findall(r'report\.add\("([^"]+)"', path.read_text())}
    assert len(used) >= 10 and used <= RULES.keys()
    with pytest.raises(KeyError, match="names"):
        Report().add("names")


@table(
    ("given", "options"),
    [
        ({}, {"113100", "113101", "113104", "113105", "113107"}),
        ({"kept_times": True}, {"113100", "113101", "113104", "113105", "113106"}),
        ({"left": {"pixels": "no mask for them"}}, {"113100", "113104", "113105", "113107"}),
        ({"left": {"other": "why not"}}, {"113100", "113101", "113104", "113105", "113107"}),
        ({"kept": 1}, {"113100", "113101", "113104", "113105", "113107", "113111"}),
    ],
)
def test_options_follow_from_what_was_done(given: dict[str, object], options: set[str]) -> None:
    report = Report(kept_times=bool(given.get("kept_times")), left=dict(given.get("left", {})))  # type: ignore[call-overload]
    if given.get("kept"):
        report.add("kept type")
    assert set(report.options) == options == set(report.to_dict()["options"])
    assert "113102" not in report.options, "faces in volumes are not looked at"


@table(
    ("left", "unused", "misses"),
    [
        ({}, {}, False),
        ({"pixels": "no mask"}, {}, False),
        ({}, {"mask[0]": "?"}, False),
        ({"pixels": "no mask"}, {"name[0]": "?"}, False),
        ({"pixels": "no mask"}, {"mask[0]": "?"}, True),
    ],
)
def test_pictures_are_missed_only_where_a_mask_matches_nothing(
    left: dict[str, str], unused: dict[str, str], misses: bool
) -> None:
    assert Report(left=left, unused=unused).may_miss_pictures is misses


def test_counts_add_up() -> None:
    report = Report()
    report.add("name")
    report.add("name", 4)
    report.add("time", 0)
    rows = {row["rule"]: row["changes"] for row in report.to_dict()["rules"]}
    assert rows["name"] == 5 and not rows.get("time") and not rows.get("text")
