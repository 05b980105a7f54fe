"""``tools/terms.py``: finds terms in prose of each kind, with the right line, and nothing in code."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.tables import table
from tools import terms

PYTHON = '''\
"""A module.

It is told what it needs.
"""

from heard import told  # nobody sees this

said = {"heard": f"{told} becomes of {told}", "hears": b"told and said"}
#: A comment of two lines, which the peer wants it for
#: ever, and ``told`` is code.
raise ValueError("found a text, "
                 "expected none")
'''


def found(path: str, text: str) -> list[tuple[int, str]]:
    return sorted((each.line, each.term) for each in terms.check(path, text))


def test_python_has_prose_in_docstrings_comments_and_strings_of_several_words() -> None:
    assert found("a.py", PYTHON) == [
        *[(3, "told"), (6, "nobody"), (8, "becomes of"), (9, "for ever"), (9, "peer wants"), (11, "a text")],
    ]


def test_markdown_has_prose_outside_of_code_and_addresses() -> None:
    block = "```console\n$ told --said  # heard of it\nsaid\n```\n"
    page = f"Nobody is here.\n\n{block}`told` [x](told.md) so\nmany of them\n\n    said\n"
    assert found("a.md", page) == [(1, "Nobody"), (4, "heard"), (7, "so many")]


def test_c_has_prose_in_comments_and_strings() -> None:
    assert found("a.c", '/* one\n   told */\nint told; // said\nchar *said = "told", *text = "is told";\n') == [
        *[(2, "told"), (3, "said"), (4, "told")],
    ]


@table(
    "text",
    [
        "there is none",
        "it is no longer than that",
        "so long as it runs",
        "so many that it fails",
        "holds a lock against others",
        "textual texture",
        "forever",
        "is None",
    ],
)
def test_good_prose_passes(text: str) -> None:
    assert found("a.md", text) == []


def test_a_file_can_have_exceptions() -> None:
    assert found("docs/reference/style.md", "told") == []


def test_main_prints_what_to_write_instead(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "new").mkdir()
    for name in ("old.md", "new/a.md"):
        (tmp_path / name).write_text("One.\nIt is told.\n")
    monkeypatch.setattr(terms, "ROOT", tmp_path)
    monkeypatch.setattr(terms, "tracked", lambda paths=(): paths or ["old.md", "new/a.md"])
    assert terms.main([]) == 1
    assert capsys.readouterr().out.splitlines() == [
        f"{name}:2: found 'told', write instead: reports, sends, shows; distinguishes"
        for name in ("old.md", "new/a.md")
    ]
    assert terms.main(["new/a.md"]) == 1
    assert capsys.readouterr().out.startswith("new/a.md:2: ")
    (tmp_path / "old.md").write_text("One.\n")
    assert terms.main(["old.md"]) == 0
