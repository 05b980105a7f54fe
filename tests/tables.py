"""One test over a table: every row is checked, and each that fails is named.

Strategy: rows that differ in their values only are one test, not one id each: collecting, sending to a worker and
reporting an id takes longer than such a check.  A failure must not hide the rows behind it, so all of them are
collected, each with its name and the lines that failed.
"""

from __future__ import annotations

import traceback
from collections.abc import Callable, Iterable, Mapping
from typing import TypeVar

import pytest

Case = TypeVar("Case")

#: Failures that are written out; of more there is the number.
SHOWN = 20


def all_hold(cases: Mapping[str, Case] | Iterable[Case], check: Callable[[Case], object]) -> None:
    """Call ``check`` with every case; fail with the name of each case for which it raised, and why.

    Args:
        cases: name → case; of a plain iterable, a case is its own name.
        check: raises what a test would raise.
    """
    named = cases.items() if isinstance(cases, Mapping) else ((str(case), case) for case in cases)
    count, failures = 0, []
    for name, case in named:
        count += 1
        try:
            check(case)
        except (Exception, pytest.fail.Exception) as error:
            failures.append(f"--- {name}\n{_shown(error)}")
    assert count, "found a table without rows"
    if failures:
        rest = f"\n--- and {len(failures) - SHOWN} more" if len(failures) > SHOWN else ""
        pytest.fail(f"{len(failures)} of {count} rows fail:\n" + "\n".join(failures[:SHOWN]) + rest, pytrace=False)


def _shown(error: BaseException) -> str:
    """The lines of the tests that failed, and the error."""
    frames = [frame for frame in traceback.extract_tb(error.__traceback__) if frame.filename != __file__]
    return "".join(traceback.format_list(frames[-3:]) + traceback.format_exception_only(error)).rstrip()
