"""Check that docstrings name what exists: the parameters of their function, and names of the code.

    .venv/bin/python tools/docstrings.py

An entry below ``Args:`` must be a parameter of the function, or of ``__init__`` of the class.  A word in double
backquotes must occur somewhere in the code, outside of docstrings, or in the table of foreign names.
"""

from __future__ import annotations

import ast
import inspect
import re
import sys
from collections import deque
from collections.abc import Container, Iterable, Iterator, Mapping
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
FOLDERS = ("igtl_gateway", "lab", "tools")
#: What also has names, beside the tests: the parts in C, definitions of messages, programs of the page.
OTHERS = ("*.c", "*.h", "*.pyi", "*.msg", "*.srv", "*.js", "*.html")

#: Names of other projects and of the system, and names that only a file or a message has.
FOREIGN = frozenset(
    "FRAMEToBASE ToolsToBASE PACKAGE_s__rosidl_typesupport_c z_rad_s COLUMN OPTION PSM1_yaw SeekingReader "
    "Seq_Frame0012_ProbeToTrackerTransform PlusIgtlClientInfo vtkPlusIgtlMessageFactory vtkPlusOpenIGTLinkDevice "
    "vtkPlusOpenIGTLinkServer vtkPlusTemporalCalibrationAlgo CellExecutionError rmw_zenohd".split()
)

_WORD = re.compile(r"\w+")
_COMMENT = re.compile(r"(?:^|  )# .*", re.MULTILINE)
_QUOTED = re.compile(r"``([A-Za-z_](?:[\w.]{0,200}\w)?)``")
_ENTRY = re.compile(r"    ((?:[\w*]{1,80}, ){0,9}[\w*]{1,80}):")

Documented = ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef | ast.Module


def documented(tree: ast.Module) -> Iterator[tuple[Documented, ast.Constant]]:
    """Yield what has a docstring, and the docstring."""
    nodes: deque[ast.AST] = deque([tree])
    while nodes:
        node = nodes.popleft()
        nodes += [each for each in ast.iter_child_nodes(node) if isinstance(each, ast.stmt | ast.ExceptHandler)]
        match node:
            case ast.Module() | ast.ClassDef() | ast.FunctionDef() | ast.AsyncFunctionDef() if node.body:
                match node.body[0]:
                    case ast.Expr(value=ast.Constant(value=str()) as text):
                        yield node, text


def words_of(source: str, docstrings: Iterable[ast.Constant]) -> set[str]:
    """Return the words of a module, without docstrings and comments."""
    lines = source.splitlines()
    for each in docstrings:
        lines[each.lineno - 1 : each.end_lineno] = [""] * ((each.end_lineno or each.lineno) - each.lineno + 1)
    return set(_WORD.findall(_COMMENT.sub("", "\n".join(lines))))


def parameters(node: ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef) -> set[str]:
    """Return the parameters of a function; of a class: those of ``__init__``, or its fields."""
    if isinstance(node, ast.ClassDef):
        makers = [each for each in node.body if isinstance(each, ast.FunctionDef) and each.name == "__init__"]
        if not makers:
            return {each.target.id for each in node.body if isinstance(each, ast.AnnAssign | ast.AugAssign)
                    if isinstance(each.target, ast.Name)}  # fmt: skip
        (node,) = makers
    of = node.args
    rest = [each for each in (of.vararg, of.kwarg) if each]
    return {each.arg for each in (*of.posonlyargs, *of.args, *of.kwonlyargs, *rest)}


def documented_parameters(docstring: str) -> Iterator[str]:
    """Yield the names below ``Args:``."""
    _, _, section = docstring.partition("Args:\n")
    for line in section.splitlines():
        if line and not line.startswith(" "):
            return
        if found := _ENTRY.match(line):
            yield from (name.strip(" *") for name in found[1].split(","))


def faults(place: str, node: Documented, docstring: ast.Constant, known: Container[str]) -> Iterator[str]:
    """Yield a line for each name in a docstring that does not exist."""
    text, at = inspect.cleandoc(str(docstring.value)), f"{place}:{docstring.lineno}"
    for name in _QUOTED.findall(text):
        if name.rpartition(".")[2] not in known:
            yield f"{at}: the docstring names {name!r}, which does not exist"
    if not isinstance(node, ast.Module):
        for name in documented_parameters(text):
            if name not in parameters(node):
                yield f"{at}: the docstring of {node.name} describes {name!r}, which is not among its parameters"


def all_faults(sources: Mapping[str, str], others: Iterable[str] = ()) -> list[str]:
    """Return the faults of all modules, by their paths; ``others``: names that are not in Python."""
    known = {*others, *FOREIGN, *(part for place in sources for part in Path(place).with_suffix("").parts)}
    found: list[tuple[str, Documented, ast.Constant]] = []
    for place, source in sources.items():
        of_module = list(documented(ast.parse(source)))
        known |= words_of(source, [docstring for _, docstring in of_module])
        found += [(place, *each) for each in of_module]
    return [fault for each in found for fault in faults(*each, known)]


def main() -> int:
    paths = [path for folder in FOLDERS for path in sorted((ROOT / folder).rglob("*.py"))]
    sources = {path.relative_to(ROOT).as_posix(): path.read_text("utf-8") for path in paths}
    others = [path for folder in FOLDERS for kind in OTHERS for path in (ROOT / folder).rglob(kind)]
    texts = [path.read_text("utf-8") for path in (*others, *(ROOT / "tests").rglob("*.py"))]
    found = all_faults(sources, {word for text in texts for word in _WORD.findall(text)})
    print(*found, sep="\n", end="\n" if found else "")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
