"""The results of the judges of real programs, and their page."""

from __future__ import annotations

import json
from pathlib import Path

from tools.judges.page import page
from tools.judges.results import DIFFERS, EXACT, FAILS, TO_IGTL, TO_ROS, Row, summed, write


def test_only_exact_rows_without_a_remark_are_summed() -> None:
    one = Row("IMAGE", TO_ROS, EXACT)
    differs, fails = Row("IMAGE", TO_ROS, DIFFERS, text="a digit"), Row("IMAGE", TO_IGTL, FAILS)
    assert summed([one, differs, one, fails]) == [Row("IMAGE", TO_ROS, EXACT, 2), differs, fails]


def test_a_judge_fails_if_anything_differs_and_the_page_shows_how(tmp_path: Path) -> None:
    rows = [Row("IMAGE", TO_ROS, EXACT, 3), Row("IMAGE", TO_IGTL, EXACT)]
    assert write("fine", "Fine", "1.0", "client", rows, tmp_path) == 0
    assert (
        write("wrong", "Wrong", "2.0", "server", [*rows, Row("STRING", TO_ROS, DIFFERS, 1, "a|b, theirs")], tmp_path)
        == 1
    )
    head = json.loads((tmp_path / "wrong.jsonl").read_text("utf-8").splitlines()[0])
    shown = page(tmp_path)
    assert f"| Wrong | 2.0 | server | 4 | 1 | 0 | 0 | {head['date']} | `{head['commit']}` | {head['load']} |" in shown
    assert "| IMAGE | exact (3) | exact (1) |" in shown
    assert r"| STRING | differs (1): a\|b, theirs |  |" in shown
