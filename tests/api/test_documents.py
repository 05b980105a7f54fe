"""The examples of docs/how-to/python-*.md print what the document has."""

from __future__ import annotations

import contextlib
import io
import re
from pathlib import Path

import pytest

from tests.places import ROOT
from tests.tables import table

EXAMPLE = re.compile(r"```python\n([^`]*)```\n\n((?:    .*\n)+)")
DOCUMENTS = sorted((ROOT / "docs" / "how-to").glob("python-*.md"))
EXAMPLES = [
    pytest.param(path, code, output, id=f"{path.stem}-{number}")
    for path in DOCUMENTS
    for number, (code, output) in enumerate(EXAMPLE.findall(path.read_text("utf-8")))
]


@pytest.mark.slow
@table(("path", "code", "output"), EXAMPLES)
def test_an_example_prints_its_output(path: Path, code: str, output: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        exec(compile(code, str(path), "exec"), {})
    shown = [line.removeprefix("    ").rstrip() for line in output.splitlines()]
    assert [line.rstrip() for line in printed.getvalue().splitlines()] == shown


@pytest.mark.parametrize("path", DOCUMENTS, ids=lambda path: path.stem)
def test_every_document_has_examples(path: Path) -> None:
    assert len(EXAMPLE.findall(path.read_text("utf-8"))) >= 2
