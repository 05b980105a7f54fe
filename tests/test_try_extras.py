"""tools/try_extras.py: the wheel alone and with each extra; what is absent is one line with the right extra."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from igtl_gateway.base.extras import PURPOSES, missing
from igtl_gateway.cli.verbs import LABORATORY, available
from tests.test_workflows import PYTHONS
from tools import core, try_extras
from tools.try_extras import CALLS, Call, fault


def test_each_extra_has_a_call() -> None:
    beside = {"video", "pandas"}  # no verb that needs nothing else; tables in Python
    assert {call.extra for call in CALLS} == {"", *PURPOSES} - beside


def test_each_verb_has_a_call_that_does_something() -> None:
    done = {call.words.split()[0] for call in CALLS if not call.words.endswith("--help")}
    assert {*available()} - {*LABORATORY} - done == set()


def test_a_call_without_an_extra_ends_with_its_code() -> None:
    assert fault(Call("verify", code=1), {""}, 1, "") == fault(Call("info"), {""}, 0, "") == ""
    assert fault(Call("info"), {""}, 2, "unknown option") == "found code 2 (unknown option), expected 0"


@pytest.mark.parametrize(
    ("extra", "code", "errors", "wrong"),
    [
        ("", 1, missing("pyarrow"), ""),
        ("seal", 1, missing("pyarrow"), ""),
        ("", 1, missing("rerun"), "expected code 1 and one line with arrow"),
        ("", 0, "", "expected code 1 and one line with arrow"),
        ("", 1, "one\n" + missing("pyarrow"), "of 2 lines"),
        ("", 1, "Traceback (most recent call last):\nImportError: x", "found a traceback (ImportError: x)"),
        ("arrow", 0, "", ""),
        ("cohort", 2, "no such file", ""),
        ("arrow", 1, missing("pyarrow"), "found that arrow is absent"),
    ],
)
def test_faults(extra: str, code: int, errors: str, wrong: str) -> None:
    found = fault(Call("export", "arrow"), {extra}, code, errors)
    assert wrong in found and bool(wrong) == bool(found)


def test_an_extra_with_a_digit() -> None:
    assert not fault(Call("import t.toml", "hdf5"), {""}, 1, missing("h5py"))


def test_a_call_that_needs_what_no_other_extra_has() -> None:
    query = Call("cohort query", "cohort", alone=True)
    assert not fault(query, {"arrow"}, 1, missing("duckdb")) and not fault(query, {"cohort"}, 2, "no such file")
    assert "expected code 1 and one line with cohort" in fault(query, {"arrow"}, 0, "")


def test_an_extra_that_brings_pyarrow() -> None:
    assert fault(Call("cohort info", "cohort"), {"view"}, 0, "")
    assert not fault(Call("cohort info", "cohort"), {"view", "arrow"}, 0, "")


def test_a_python_may_be_a_path(tmp_path: Path) -> None:
    assert core.present(sys.executable) == sys.executable
    assert core.present(str(tmp_path / "python")) is None


def test_the_oldest_and_the_newest_python() -> None:
    present = [path for version in (PYTHONS[0], PYTHONS[-1]) if (path := core.present(f"python{version}"))]
    if not present:
        pytest.skip(f"found neither Python {PYTHONS[0]} nor {PYTHONS[-1]}")
    assert try_extras.main([word for path in present for word in ("--python", path)]) == 0
