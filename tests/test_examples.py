"""The worked examples in examples/ do what they show."""

from __future__ import annotations

import re

from tests.integration.bridge import ROOT
from tests.testing.outside import run_pytest


def test_without_hardware() -> None:
    result = run_pytest(ROOT / "examples" / "test_without_hardware")
    assert result.returncode == 0, result.stdout + result.stderr
    outcome = re.search(r"(\d+) passed(?:, 1 skipped)?[ ,]", result.stdout)  # without ROS one is skipped
    assert outcome, result.stdout
    assert int(outcome[1]) >= 4
