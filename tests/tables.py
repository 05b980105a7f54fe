"""One test over a table: every row is checked, and each that fails is named.

Strategy: rows that differ in their values only are one test, not one id each: collecting, sending to a worker and
reporting an id takes longer than such a check.  A failure must not hide the rows behind it, so all of them are
collected, each with its name and the lines that failed.  ``table`` is written as ``pytest.mark.parametrize`` is; use
that one where a row is a scenario that is run alone, or takes more than a second.

Of a table whose rows take many seconds, and differ little in what they prove, the gate has some (``gate``): the others
are a second test of the third tier.
"""

from __future__ import annotations

import functools
import inspect
import traceback
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import pytest

_PARAM = type(pytest.param())

Case = TypeVar("Case")
Test = Callable[..., None]

#: Failures that are written out; of more there is the number.
SHOWN = 20
#: Characters of a value in the name of a row.
WIDTH = 60


def all_hold(cases: Mapping[str, Case] | Iterable[Case], check: Callable[[Case], object]) -> None:
    """Call ``check`` with every case; fail with the name of each case for which it raised, and why.

    Skips if every case is skipped.

    Args:
        cases: name → case; of a plain iterable, a case is its own name.
        check: raises what a test would raise.
    """
    named = cases.items() if isinstance(cases, Mapping) else ((str(case), case) for case in cases)
    count, failures, skipped = 0, [], []
    for name, case in named:
        count += 1
        try:
            check(case)
        except pytest.skip.Exception as reason:
            skipped.append(str(reason))
        except (Exception, pytest.fail.Exception) as error:
            failures.append(f"--- {name}\n{_shown(error)}")
    assert count, "found a table without rows"
    if failures:
        rest = f"\n--- and {len(failures) - SHOWN} more" if len(failures) > SHOWN else ""
        pytest.fail(f"{len(failures)} of {count} rows fail:\n" + "\n".join(failures[:SHOWN]) + rest, pytrace=False)
    if len(skipped) == count:
        pytest.skip(skipped[0])


def table(
    names: str | Sequence[str],
    rows: Iterable[Any],
    ids: Callable[[Any], object] | Iterable[str] | None = None,
    gate: Callable[..., bool] | None = None,
) -> Callable[[Test], Test]:
    """Make a test of one row a test of all rows; arguments as those of ``pytest.mark.parametrize``.

    With ``gate``, which is called with the values of a row, it is two tests: ``[gate]`` has the rows for which it is
    true, ``[rest]`` the others, in the third tier.

    Each row has a ``tmp_path``, a ``monkeypatch`` and an empty ``capsys`` of its own; other fixtures are the same for
    all rows.  Tables above each other are every row with every row.
    """
    keys = [key.strip() for key in names.split(",")] if isinstance(names, str) else list(names)
    cases = _cases(keys, list(rows), ids)

    def joined(test: Test) -> Test:
        def run_all(cases: Mapping[str, dict[str, Any]], fixtures: dict[str, Any]) -> None:
            number = iter(range(len(cases)))

            def check(values: dict[str, Any]) -> None:
                with _of_one_row(fixtures, next(number)) as own:
                    test(**values, **own)

            all_hold(cases, check)

        @functools.wraps(test)
        def run(**fixtures: Any) -> None:
            run_all(cases, fixtures)

        @functools.wraps(test)
        def run_part(part: Mapping[str, dict[str, Any]], **fixtures: Any) -> None:
            run_all(part, fixtures)

        signature = inspect.signature(test)
        rest = [each for name, each in signature.parameters.items() if name not in keys]
        if gate is None:
            run.__signature__ = signature.replace(parameters=rest)  # type: ignore[attr-defined]
            return run
        part = inspect.Parameter("part", inspect.Parameter.POSITIONAL_OR_KEYWORD)
        run_part.__signature__ = signature.replace(parameters=[part, *rest])  # type: ignore[attr-defined]
        return pytest.mark.parametrize("part", _tiers(cases, gate))(run_part)

    return joined


def _tiers(cases: Mapping[str, dict[str, Any]], gate: Callable[..., bool]) -> list[Any]:
    """The rows of the gate, and those of the third tier."""
    chosen = {name: values for name, values in cases.items() if gate(**values)}
    rest = {name: values for name, values in cases.items() if name not in chosen}
    assert chosen and rest, f"found {len(chosen)} of {len(cases)} rows for the gate, expected some and not all"
    marks = (pytest.mark.slow, pytest.mark.long)
    return [pytest.param(chosen, id="gate"), pytest.param(rest, id="rest", marks=marks)]


def _cases(
    keys: Sequence[str], rows: Sequence[Any], ids: Callable[[Any], object] | Iterable[str] | None
) -> dict[str, dict[str, Any]]:
    """Name of each row → its values by the names of the arguments."""
    given = list(ids) if ids is not None and not callable(ids) else [None] * len(rows)
    cases: dict[str, dict[str, Any]] = {}
    for told, row in zip(given, rows, strict=True):
        name: object = told
        values = (row,) if len(keys) == 1 else tuple(row)
        if isinstance(row, _PARAM):  # one that ``pytest.param`` made
            assert not row.marks, "found a row with marks, expected a test of its own"
            name, values = row.id, tuple(row.values)
        shown = map(ids, values) if callable(ids) else (_short(value) for value in values)
        label = str(name or "-".join(map(str, shown)))
        cases[label if label not in cases else f"{label} (row {len(cases)})"] = dict(zip(keys, values, strict=True))
    return cases


def _short(value: Any) -> str:
    text = getattr(value, "__name__", None) or repr(value)
    return text if len(text) <= WIDTH else f"{text[: WIDTH - 1]}…"


@contextmanager
def _of_one_row(fixtures: Mapping[str, Any], number: int) -> Iterator[dict[str, Any]]:
    """The fixtures for one row: what a row writes, prints and replaces must not reach the next."""
    own = dict(fixtures)
    if isinstance(folder := own.get("tmp_path"), Path):
        own["tmp_path"] = folder / str(number)
        own["tmp_path"].mkdir()
    if isinstance(captured := own.get("capsys"), pytest.CaptureFixture):
        captured.readouterr()
    if isinstance(patches := own.get("monkeypatch"), pytest.MonkeyPatch):
        with patches.context() as own["monkeypatch"]:
            yield own
        return
    yield own


def _shown(error: BaseException) -> str:
    """The lines of the tests that failed, and the error."""
    frames = [frame for frame in traceback.extract_tb(error.__traceback__) if frame.filename != __file__]
    return "".join(traceback.format_list(frames[-3:]) + traceback.format_exception_only(error)).rstrip()
