"""Check that docstrings and comments name what exists: parameters, names of the code, errors, modules and files.

    .venv/bin/python tools/docstrings.py

An entry below ``Args:`` must be a parameter of the function, or of ``__init__`` of the class.  A word in double
backquotes, in a docstring or in a comment, must occur somewhere in the code, outside of docstrings and comments, or in
the table of foreign names; of ``module.name`` the name must occur in that module.  The errors behind "Raises" must
exist, and so must a file that is named.  In comments of C, names are words before ``()`` and words with an underscore.
"""

from __future__ import annotations

import ast
import builtins
import inspect
import io
import re
import subprocess
import sys
import tokenize
from collections import deque
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

ROOT = Path(__file__).resolve().parents[1]
FOLDERS = ("igtl_gateway", "lab", "tools")
#: What also has names, beside the tests: definitions of messages, programs of the page, stubs.
OTHERS = ("*.pyi", "*.msg", "*.srv", "*.js", "*.html")
C = (".c", ".h")

#: Names of other projects and of the system, and names that only a file or a message has.
FOREIGN = frozenset(
    "FRAMEToBASE ToolsToBASE PACKAGE_s__rosidl_typesupport_c z_rad_s COLUMN OPTION PSM1_yaw SeekingReader "
    "Seq_Frame0012_ProbeToTrackerTransform PlusIgtlClientInfo vtkPlusIgtlMessageFactory vtkPlusOpenIGTLinkDevice "
    "vtkPlusOpenIGTLinkServer vtkPlusTemporalCalibrationAlgo CellExecutionError rmw_zenohd "
    # fields of frames, and types of ROS that a comment compares with ours
    "next_t rcl_guard_condition_t rcl_wait_set_t rmw_clients_t rmw_guard_conditions_t rmw_message_info_sequence_t "
    "rmw_publisher_options_t rmw_serialized_message_t rmw_services_t rmw_topic_endpoint_info_array_t".split()
)
#: Files of other projects, by their folders and by themselves, and files that programs make.
FOREIGN_FOLDERS = ("Protocol", "bits", "linux", "meta", "rcl", "rcutils", "rmw", "sys")
FOREIGN_FILES = frozenset(
    "LoaderDriverInterface.md Python.h header.md igtl_util.c nifti1.h query.md subscription.py unit.md "
    "docs/evidence/mutants.md".split()
)
#: Names of parameters and of fields that are names of modules, too.
VARIABLES = frozenset({"header", "message"})

_WORD = re.compile(r"\w+")
_COMMENT = re.compile(r"(?:^ *|  )#:? .*", re.MULTILINE)
_QUOTED = re.compile(r"``([A-Za-z_](?:[\w.]{0,200}\w)?)``")
_ENTRY = re.compile(r"    ((?:[\w*]{1,80}, ){0,9}[\w*]{1,80}):")
_RAISES = re.compile(r"\b[Rr]aises?\s+((?:_?[A-Z]\w+(?:,\s+|\s+or\s+)?)+)")
_ERROR = re.compile(r"\b_?[A-Z]\w*[a-z]\w*")
_FILE = re.compile(r"(?<![\w./*{}-])((?:[\w-]+/)*[\w-]+\.(?:py|pyi|c|h|md|sh|toml|yml))\b(?!\.?\w|[*/])")
_OTHER_FILE = re.compile(r"\.(?:cpp|csv|json|jsonl|mcap|txt|yaml)$")
_C_COMMENT = re.compile(r"\"(?:[^\"\\\n]|\\.)*\"|'(?:[^'\\\n]|\\.)*'|(/\*.*?\*/|//[^\n]*)", re.DOTALL)
_C_NAME = re.compile(r"\b([A-Za-z_]\w*)\(\)|(?<![\w/.<*-])(_?[a-z][a-z0-9]*_\w*[a-z0-9])\b(?![*/.])")

Documented = ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef | ast.Module


@dataclass(frozen=True)
class Known:
    """What prose may name.

    Attributes:
        words: all words of the code.
        modules: stem of a module → the words of all modules with it.
        files: paths of the repository.
    """

    words: set[str]
    modules: Mapping[str, set[str]]
    files: frozenset[str]

    def has(self, name: str) -> bool:
        """Return whether a name exists, ``a.b`` in the module ``a`` if there is one."""
        before, _, last = name.rpartition(".")
        owner = before.rpartition(".")[2]
        names = self.modules.get(owner, self.words) if owner not in VARIABLES else self.words
        return last in names or last in FOREIGN

    def has_module(self, name: str) -> bool:
        """Return whether ``name`` has the last parts of the name of a module or package."""
        path = name.replace(".", "/")
        return f"{path}.py" in self.files or f"{path}/__init__.py" in self.files

    def has_file(self, name: str) -> bool:
        """Return whether the repository has a file, of which ``name`` has the last parts."""
        return (
            name in self.files
            or name in FOREIGN_FILES
            or "NAME" in name  # any of its kind
            or name.startswith(tuple(f"{each}/" for each in FOREIGN_FOLDERS))
        )


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


def comments_of(source: str) -> list[tuple[int, str]]:
    """Return the comments of a module in Python: line and text, adjacent lines joined."""
    found: list[tuple[int, str]] = []
    last = 0
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT:
            line, text = token.start[0], token.string.lstrip("#: ")
            if found and line == last + 1:
                found[-1] = found[-1][0], f"{found[-1][1]} {text}"
            else:
                found.append((line, text))
            last = line
    return found


def words_of(source: str, docstrings: Iterable[ast.Constant]) -> set[str]:
    """Return the words of a module, without docstrings and comments."""
    lines = source.splitlines()
    for each in docstrings:
        lines[each.lineno - 1 : each.end_lineno] = [""] * ((each.end_lineno or each.lineno) - each.lineno + 1)
    return set(_WORD.findall(_COMMENT.sub("", "\n".join(lines))))


def c_parts(source: str) -> tuple[str, list[tuple[int, str]]]:
    """Return a file in C without comments, and its comments: line and text."""
    comments = [
        (source.count("\n", 0, match.start()) + 1, " ".join(match[1].strip("/*").replace("\n *", "\n").split()))
        for match in _C_COMMENT.finditer(source)
        if match[1]
    ]
    return _C_COMMENT.sub(lambda match: "" if match[1] else match[0], source), comments


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


def missing_in(text: str, known: Known) -> Iterator[str]:
    """Yield the names in prose about Python that do not exist."""
    for name in _QUOTED.findall(text):
        if not (known.has(name) or known.has_module(name) or _OTHER_FILE.search(name) or _FILE.fullmatch(name)):
            yield name
    for errors in _RAISES.findall(text):
        yield from (name for name in _ERROR.findall(errors) if not known.has(name) and not hasattr(builtins, name))
    yield from (name for name in _FILE.findall(text) if not known.has_file(name))


def faults(place: str, node: Documented, docstring: ast.Constant, known: Known) -> Iterator[str]:
    """Yield a line for each name in a docstring that does not exist."""
    text, at = inspect.cleandoc(str(docstring.value)), f"{place}:{docstring.lineno}"
    for name in missing_in(text, known):
        yield f"{at}: the docstring names {name!r}, which does not exist"
    if not isinstance(node, ast.Module):
        for name in documented_parameters(text):
            if name not in parameters(node):
                yield f"{at}: the docstring of {node.name} describes {name!r}, which is not among its parameters"


def c_faults(place: str, comments: Iterable[tuple[int, str]], known: Known) -> Iterator[str]:
    """Yield a line for each name in a comment of C that does not exist."""
    for line, text in comments:
        for called, other in _C_NAME.findall(_FILE.sub("", text)):
            if not known.has(called or other):
                yield f"{place}:{line}: the comment names {called or other!r}, which does not exist"
        for name in _FILE.findall(text):
            if not known.has_file(name):
                yield f"{place}:{line}: the comment names the file {name!r}, which does not exist"


def all_faults(sources: Mapping[str, str], others: Iterable[str] = (), files: Iterable[str] = ()) -> list[str]:
    """Return the faults of all modules, by their paths.

    Args:
        sources: path → source, in Python or C.
        others: names that are in neither.
        files: the other files of the repository.
    """
    words = {*others, *FOREIGN, *(part for place in sources for part in Path(place).with_suffix("").parts)}
    modules: dict[str, set[str]] = {}
    found: list[tuple[str, Documented, ast.Constant]] = []
    in_c: dict[str, list[tuple[int, str]]] = {}
    for place, source in sources.items():
        if place.endswith(C):
            code, in_c[place] = c_parts(source)
            words |= set(_WORD.findall(code))
            continue
        of_module = list(documented(ast.parse(source)))
        here = words_of(source, [docstring for _, docstring in of_module])
        words |= here
        modules.setdefault(Path(place).stem, set()).update(here)
        found += [(place, *each) for each in of_module]
    ends = {
        "/".join(PurePosixPath(path).parts[at:])
        for path in (*files, *sources)
        for at in range(len(PurePosixPath(path).parts))
    }
    known = Known(words, modules, frozenset(ends))
    lines = [fault for each in found for fault in faults(*each, known)]
    for place, source in sources.items():
        if place in in_c:
            lines += c_faults(place, in_c[place], known)
            continue
        for line, text in comments_of(source):
            lines += [
                f"{place}:{line}: the comment names {name!r}, which does not exist" for name in missing_in(text, known)
            ]
    return lines


def main() -> int:
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    files = [path for path in listed.split("\0") if path and (ROOT / path).is_file()]
    read = [path for path in files if path.startswith(FOLDERS) and path.endswith((".py", *C))]
    sources = {path: (ROOT / path).read_text("utf-8") for path in read}
    others = [path for folder in FOLDERS for kind in OTHERS for path in (ROOT / folder).rglob(kind)]
    texts = [path.read_text("utf-8") for path in (*others, *(ROOT / "tests").rglob("*.py"))]
    found = all_faults(sources, {word for text in texts for word in _WORD.findall(text)}, files)
    print(*found, sep="\n", end="\n" if found else "")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
