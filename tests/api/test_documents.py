"""The examples of docs/how-to/python.md print what the document has."""

from __future__ import annotations

import contextlib
import io
import re

import pytest

from tests.places import ROOT
from tests.tables import table

EXAMPLE = re.compile(r"```python\n([^`]*)```\n\n((?:    .*\n)+)")
DOCUMENT = ROOT / "docs" / "how-to" / "python.md"
EXAMPLES = EXAMPLE.findall(DOCUMENT.read_text("utf-8"))


@pytest.mark.slow
@table(("code", "output"), EXAMPLES)
def test_an_example_prints_its_output(code: str, output: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        exec(compile(code, str(DOCUMENT), "exec"), {})
    shown = [line.removeprefix("    ").rstrip() for line in output.splitlines()]
    assert [line.rstrip() for line in printed.getvalue().splitlines()] == shown


def test_each_block_but_the_slow_one_states_its_output() -> None:
    assert len(EXAMPLES) == DOCUMENT.read_text("utf-8").count("```python\n") - 1 == 11
