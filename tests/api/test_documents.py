"""The examples of docs/python-recordings.md print what the document has."""

from __future__ import annotations

import contextlib
import io
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
EXAMPLE = re.compile(r"```python\n([^`]*)```\n\n((?:    .*\n)+)")
EXAMPLES = EXAMPLE.findall((ROOT / "docs" / "python-recordings.md").read_text())


@pytest.mark.parametrize(("code", "output"), EXAMPLES, ids=[str(number) for number in range(len(EXAMPLES))])
def test_an_example_prints_its_output(code: str, output: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        exec(compile(code, "docs/python-recordings.md", "exec"), {})
    assert printed.getvalue().splitlines() == [line.removeprefix("    ") for line in output.splitlines()]


def test_there_are_examples() -> None:
    assert len(EXAMPLES) >= 2
