"""``tools/mutants.py``: which changes it makes, and that they are the same ones tomorrow."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

from tests.tables import table
from tools import mutants

SOURCE = '''"""Of 5."""
LIMIT = 5


def f(a: int = 3, *rest: int) -> bool:
    """Less than 7."""
    if TYPE_CHECKING:
        import x
    assert a < 100
    g(a, LIMIT)
    while not a in rest:
        a += 1
    if a < LIMIT and rest:
        raise ValueError(f"found {a + 1}")
    self.a = 0.5
    return True
'''


def changes(source: str) -> set[tuple[int, str, str]]:
    return {(each.line, each.old, each.new) for each in mutants.mutants_of("convert/x.py", source.encode())}


@table(
    "change",
    [
        (2, "5", "6"), (2, "5", "4"), (5, "3", "4"), (10, "g(a, LIMIT)", "g(LIMIT, a)"), (10, "g(a, LIMIT)", "pass"),
        (11, "not a in rest", "(a in rest)"), (11, "a in rest", "(a not in rest)"), (12, "a += 1", "pass"),
        (12, "1", "2"), (13, "a < LIMIT and rest", "(a < LIMIT or rest)"), (13, "a < LIMIT", "(a <= LIMIT)"),
        (14, 'raise ValueError(f"found {a + 1}")', "pass"), (15, "self.a = 0.5", "pass"), (15, "0.5", "1.0"),
        (16, "return True", "return None"), (16, "True", "False"),
    ],
)  # fmt: skip
def test_a_change_of_each_kind(change: tuple[int, str, str]) -> None:
    assert change in changes(SOURCE)


def test_texts_annotations_and_assertions_are_left_out() -> None:
    assert {line for line, _, _ in changes(SOURCE)} == {2, 5, 10, 11, 12, 13, 14, 15, 16}
    assert (14, "1", "2") not in changes(SOURCE), "the words of an error"


def test_each_mutant_is_a_program_with_one_change() -> None:
    path = mutants.ROOT / mutants.PACKAGE / "convert" / "poses.py"
    source = path.read_bytes()
    found = mutants.mutants_of("convert/poses.py", source)
    for each in found[::7]:
        assert ast.dump(ast.parse(each.applied(source))) != ast.dump(ast.parse(source)), each
    assert len({each.name for each in found}) == len(found) > 100


def test_a_mutant_keeps_its_name_where_lines_move() -> None:
    def names(source: str) -> set[str]:
        return {each.name for each in mutants.mutants_of("convert/x.py", source.encode())}

    assert names(SOURCE) == names(SOURCE.replace("LIMIT = 5\n", "# a comment with ä\n\nLIMIT = 5\n"))
    assert names(SOURCE) != names(SOURCE.replace("< LIMIT", "<= LIMIT"))


def test_a_draw_has_as_many_of_each_folder_and_is_that_of_its_seed() -> None:
    folders = ("addons/merge", "addons/upload")
    one = mutants.drawn(20, 1, folders)
    assert one == mutants.drawn(20, 1, folders) == mutants.drawn(30, 1, folders)[:20]
    assert [each.folder for each in one] == list(folders) * 10
    assert one != mutants.drawn(20, 2, folders)


@pytest.mark.parametrize(
    ("module", "test"), [("base/stamp.py", "tests/base/test_stamp.py"), ("x/_y.py", "tests/x/test_y.py")]
)
def test_the_mirrored_file(module: str, test: str) -> None:
    assert mutants.mirrored(module) == test


def test_equivalent_mutants_have_a_reason() -> None:
    assert all(len(name) == 10 and why for name, why in mutants.equivalent().items())


def test_a_module_that_has_changed_is_mapped_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With the lines that it had before, its mutants would have the tests of other lines."""
    monkeypatch.setattr(mutants, "ROOT", tmp_path)
    folder = tmp_path / mutants.PACKAGE / "convert"
    folder.mkdir(parents=True)
    (folder / "same.py").write_text("a = 1\n")
    (folder / "other.py").write_text("a = 1\n")
    lines = {"1": ["tests/convert/test_a.py::test_1", "tests/convert/test_b.py::test_2"]}
    names = ("convert/same.py", "convert/other.py", "convert/gone.py")
    digest = mutants._digest(folder / "same.py")
    part = {"sources": dict.fromkeys(names, digest), "lines": {name: dict(lines) for name in names}}
    assert mutants._forget_changed({"sources": {names[0]: digest}, "lines": {names[0]: lines}}) == set()
    (folder / "other.py").write_text("a = 2\n")
    assert mutants._forget_changed(part) == {"tests/convert/test_a.py", "tests/convert/test_b.py"}
    assert part == {"sources": {names[0]: digest}, "lines": {names[0]: lines}}
