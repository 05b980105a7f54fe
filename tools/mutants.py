"""Mutants: small changes of the source that a fast test of the mirrored folder has to notice.

    python -m tools.mutants run [--mutants 500] [--minutes 60] [--folder convert] [--survivors]
    python -m tools.mutants survivors        what no test has noticed, with its line
    python -m tools.mutants table            writes docs/evidence/mutants.md
    python -m tools.mutants unmirrored       modules of more than 40 lines without a test file of their own

Strategy: the checkout is copied to out/mutants, so that it stays clean.  The fast tests of each folder run there once
under coverage, which shows the tests of each line.  A mutant is one change of one place; the places are drawn by a
hash, so the draw stays the same where the rest of the source changes.  For each one, a process that has the outside
libraries already is forked; it runs the tests that run the changed line, those of the mirrored file first, the shortest
next, until one fails.  Results are appended at once, and a run goes on where the last one ended.

Why our own: mutmut 3 changes code inside functions only, but most survivors of the first trial were constants of
modules; its functions become trampolines, which the pictures of calls in ARCHITECTURE.md do not survive.  cosmic-ray
has one test command for all mutants, a new interpreter for each, no choice of tests by line, and rewrites the checkout.
"""

from __future__ import annotations

import argparse
import ast
import contextlib
import functools
import hashlib
import json
import os
import resource
import shutil
import signal
import subprocess
import sys
import time
import traceback
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
WORK = ROOT / "out" / "mutants"
TREE, MAP, RESULTS = WORK / "tree", WORK / "tests.json", WORK / "results.jsonl"
EQUIVALENT = ROOT / "tools" / "mutants_equivalent.txt"
PAGE = ROOT / "docs" / "evidence" / "mutants.md"
PACKAGE = "igtl_gateway"
FOLDERS = ("gateway", "convert", "record", "replay", "addons/deidentify", "addons/merge", "addons/upload")
#: Loaded before the fork; nothing of the project is.
PRELOADED = ("numpy", "mcap.reader", "mcap.writer", "rosbags.typesys", "av", "zstandard", "cryptography")
#: Seconds of the tests of one mutant, as the run under coverage took them.
MOST_TESTS_S = 30.0
MIRRORED_LINES = 40
_PYTEST = ("-q", "-x", "-m", "not slow", "-p", "no:cacheprovider", "-p", "no:randomly", "--no-header", "--tb=line")
_COMPARED = {
    ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot, ast.IsNot: ast.Is, ast.In: ast.NotIn, ast.NotIn: ast.In,
}  # fmt: skip
_KILLED, _SURVIVED, _TIMEOUT, _UNRUN = "killed", "survived", "timeout", "no test runs it"


@dataclass(frozen=True)
class Mutant:
    """A change of one place.

    Attributes:
        path: of the module, relative to the package.
        line: of the place, from 1.
        start, end: of the place, bytes.
        old, new: the text.
        operator: what kind of change.
        name: a hash of path, function, change and how often it was there before: that of other versions, too.
    """

    path: str
    line: int
    start: int
    end: int
    old: str
    new: str
    operator: str
    name: str

    @property
    def folder(self) -> str:
        return next(folder for folder in FOLDERS if self.path.startswith(folder + "/"))

    def applied(self, source: bytes) -> bytes:
        return source[: self.start] + self.new.encode() + source[self.end :]


def mutants_of(path: str, source: bytes) -> list[Mutant]:
    """All mutants of a module, by place."""
    found: list[Mutant] = []
    seen: Counter[tuple[str, ...]] = Counter()
    starts = [0]
    for line in source.splitlines(keepends=True):
        starts.append(starts[-1] + len(line))
    for node, new, operator, within in _changes(ast.parse(source)):
        start = starts[node.lineno - 1] + node.col_offset
        end = starts[node.end_lineno - 1] + node.end_col_offset
        old = source[start:end].decode()
        # brackets: what is written may bind less than what was read
        text = f"({new})" if isinstance(node, ast.expr) and not isinstance(node, ast.Call | ast.Constant) else new
        key = (path, within, operator, old, text)
        seen[key] += 1
        name = hashlib.sha256("\0".join((*key, str(seen[key]))).encode()).hexdigest()[:10]
        found.append(Mutant(path, node.lineno, start, end, old, text, operator, name))
    return sorted(found, key=lambda each: (each.start, each.end))


def _changes(tree: ast.Module) -> Iterator[tuple[Any, str, str, str]]:
    """Node, its new text, kind of the change, and the function that it is in."""
    stack: list[tuple[ast.AST, str]] = [(tree, "")]
    while stack:
        node, within = stack.pop()
        for new, operator in _of_node(node):
            yield node, new, operator, within
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            within = f"{within}.{node.name}"
        stack += [(child, within) for child in _children(node)]


def _children(node: ast.AST) -> Iterator[ast.AST]:
    """The parts that decide what a program does: no annotations, decorators, docstrings and words of errors."""
    skipped = {"annotation", "returns", "decorator_list", "type_params"}
    if isinstance(node, ast.JoinedStr | ast.Assert) or (
        isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"
    ):
        return
    for name, value in ast.iter_fields(node):
        if name in skipped:
            continue
        for child in value if isinstance(value, list) else [value]:
            is_text = isinstance(child, ast.Expr) and isinstance(child.value, ast.Constant)
            if isinstance(child, ast.AST) and not is_text:
                yield child


def _of_node(node: ast.AST) -> Iterator[tuple[str, str]]:
    match node:
        case ast.Compare():
            for at, operator in enumerate(node.ops):
                ops = [*node.ops[:at], _COMPARED[type(operator)](), *node.ops[at + 1 :]]
                yield ast.unparse(ast.Compare(node.left, ops, node.comparators)), "comparison"
        case ast.Constant(value=bool() as truth):
            yield str(not truth), "truth"
        case ast.Constant(value=int() as number):
            yield str(number + 1), "number + 1"
            if number > 1:
                yield str(number - 1), "number - 1"
        case ast.Constant(value=float() as real):
            yield repr(real * 2 or 1.0), "number × 2"
        case ast.BoolOp():
            yield (
                ast.unparse(ast.BoolOp(ast.Or() if isinstance(node.op, ast.And) else ast.And(), node.values)),
                "and, or",
            )
        case ast.UnaryOp(op=ast.Not()):
            yield ast.unparse(node.operand), "not"
        case ast.Call(args=[first, second, *rest]) if not any(isinstance(each, ast.Starred) for each in node.args):
            if ast.dump(first) != ast.dump(second):
                yield ast.unparse(ast.Call(node.func, [second, first, *rest], node.keywords)), "swapped arguments"
        case ast.Expr(value=ast.Call()) | ast.AugAssign() | ast.Raise():
            yield "pass", "removed statement"
        case ast.Assign(targets=[ast.Attribute() | ast.Subscript()]) | ast.Continue() | ast.Break():
            yield "pass", "removed statement"
        case ast.Return(value=ast.expr() as value) if ast.unparse(value) != "None":
            yield "return None", "return None"


def drawn(count: int, seed: int, folders: Iterable[str]) -> list[Mutant]:
    """The first mutants of a draw, as many of each folder; those of the folders in turn."""
    columns = []
    for folder in folders:
        paths = sorted((ROOT / PACKAGE / folder).rglob("*.py"))
        every = [each for path in paths for each in mutants_of(_module(path), path.read_bytes())]
        every.sort(key=lambda each: hashlib.sha256(f"{seed} {each.name}".encode()).digest())
        columns.append(every)
    rows = max(map(len, columns), default=0)
    turns = [column[row] for row in range(rows) for column in columns if row < len(column)]
    return turns[:count]


def _module(path: Path, root: Path = ROOT) -> str:
    return path.relative_to(root / PACKAGE).as_posix()


def mirrored(module: str) -> str:
    """The test file of a module, whether it is there or not."""
    path = Path(module)
    return (Path("tests") / path.parent / f"test_{path.stem.lstrip('_')}.py").as_posix()


# --- the copy and the map of its tests


def copy_tree() -> None:
    """The files of git, also new ones, and the compiled parts; what did not change keeps its time."""
    told = subprocess.run(["git", "ls-files", "-co", "--exclude-standard"], cwd=ROOT, capture_output=True, check=True)
    names = set(told.stdout.decode().splitlines())
    names |= {path.relative_to(ROOT).as_posix() for path in (ROOT / PACKAGE).rglob("*.so")}
    for name in sorted(names):
        source, target = ROOT / name, TREE / name
        if not source.is_file() or (target.is_file() and target.read_bytes() == source.read_bytes()):
            continue
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(source, target)
    for path in (*(TREE / PACKAGE).rglob("*.py"), *(TREE / "tests").rglob("*.py")):
        if path.relative_to(TREE).as_posix() not in names:
            path.unlink()


class _Mapping:
    """Plugin of pytest: which test runs which line, and how long each takes."""

    def __init__(self, coverage: Any) -> None:
        self._coverage, self.seconds = coverage, dict[str, float]()

    def pytest_runtest_logstart(self, nodeid: str) -> None:
        self._coverage.switch_context(nodeid)
        self._started = time.monotonic()

    def pytest_runtest_logreport(self, report: Any) -> None:
        if report.when == "call" and report.passed:
            self.seconds[report.nodeid] = time.monotonic() - self._started

    def pytest_runtest_logfinish(self) -> None:
        self._coverage.switch_context("")


def _map_files(folder: str, files: list[str], target: Path) -> int:
    """In a process of its own: run the fast tests of some files under coverage."""
    import coverage
    import pytest

    measured = coverage.Coverage(data_file=None, config_file=False, include=[str(TREE / PACKAGE / folder / "*")])
    plugin = _Mapping(measured)
    measured.start()
    pytest.main([*files, *(word for word in _PYTEST if word != "-x")], plugins=[plugin])
    measured.stop()
    data, lines = measured.get_data(), dict[str, dict[int, list[str]]]()
    for path in data.measured_files():
        lines[_module(Path(path), TREE)] = {
            line: [one for one in ids if one in plugin.seconds] for line, ids in data.contexts_by_lineno(path).items()
        }
    target.write_text(json.dumps({"seconds": plugin.seconds, "lines": lines}))
    return 0


def test_map(folders: Iterable[str]) -> dict[str, Any]:
    """Folder → seconds of each test, tests of each line, digests of files.

    Test files that are new are run, and those that ran a module which is another one by now.
    """
    known = json.loads(MAP.read_text()) if MAP.exists() else {}
    for folder in folders:
        part = known.setdefault(folder, {"seconds": {}, "lines": {}, "files": {}, "sources": {}})
        paths = sorted((ROOT / "tests" / folder).rglob("test_*.py"))
        digests = {path.relative_to(ROOT).as_posix(): _digest(path) for path in paths}
        again = _forget_changed(part)
        new = [name for name, digest in digests.items() if part["files"].get(name) != digest or name in again]
        if not new:
            continue
        target, log = WORK / "part.json", WORK / f"map-{folder.replace('/', '-')}.log"
        target.unlink(missing_ok=True)
        code = _forked(functools.partial(_map_files, folder, new, target), log, 3600, 7200)
        if not target.exists():
            raise SystemExit(f"{folder}: the tests under coverage ended with {code}, see {log}")
        _merge_map(part, json.loads(target.read_text()), set(new))
        part["files"] = digests
        for path in (ROOT / PACKAGE / folder).rglob("*.py"):
            part["sources"].setdefault(_module(path), _digest(path))
        MAP.write_text(json.dumps(known))
        print(f"{folder}: {len(new)} test files, {len(part['seconds'])} tests", flush=True)
    return known


def _forget_changed(part: dict[str, Any]) -> set[str]:
    """Forget the lines of modules that have changed since they were mapped; return the test files that ran them."""
    files = set[str]()
    for module, digest in list(part["sources"].items()):
        path = ROOT / PACKAGE / module
        if path.exists() and _digest(path) == digest:
            continue
        del part["sources"][module]
        lines = part["lines"].pop(module, {})
        files |= {one.partition("::")[0] for ids in lines.values() for one in ids}
    return files


def _merge_map(part: dict[str, Any], found: dict[str, Any], files: set[str]) -> None:
    def stays(one: str) -> bool:
        return one.partition("::")[0] not in files

    part["seconds"] = {one: s for one, s in part["seconds"].items() if stays(one)} | found["seconds"]
    for lines in part["lines"].values():
        for line, ids in lines.items():
            lines[line] = [one for one in ids if stays(one)]
    for module, lines in found["lines"].items():
        mine = part["lines"].setdefault(module, {})
        for line, ids in lines.items():
            mine[line] = [*mine.get(line, ()), *ids]


def _digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def tests_of(mutant: Mutant, known: dict[str, Any]) -> list[str]:
    """The tests that run the line of a mutant; of a line that runs at import, those of the module."""
    part = known[mutant.folder]
    lines = part["lines"].get(mutant.path, {})
    is_same = part["sources"].get(mutant.path) == _digest(ROOT / PACKAGE / mutant.path)
    own = mirrored(mutant.path)
    ids = set(lines.get(str(mutant.line), ()) if is_same else ())
    if not ids:  # those of the mirrored file may look at constants only
        ids = {one for each in lines.values() for one in each}
        ids |= {one for one in part["seconds"] if one.partition("::")[0] == own}
    chosen, total = list[str](), 0.0
    for one in sorted(ids, key=lambda each: (not each.startswith(own), part["seconds"][each])):
        total += part["seconds"][one]
        if chosen and total > MOST_TESTS_S:
            break
        chosen.append(one)
    return chosen


# --- one mutant


class _Chosen:
    """Plugin of pytest: only the chosen tests, in their order."""

    def __init__(self, ids: list[str], verdict: Path) -> None:
        self._rank, self._verdict = {one: number for number, one in enumerate(ids)}, verdict

    def pytest_collection_modifyitems(self, items: list[Any]) -> None:
        kept = [item for item in items if item.nodeid in self._rank]
        items[:] = sorted(kept, key=lambda item: self._rank[item.nodeid])

    def pytest_runtest_logreport(self, report: Any) -> None:
        if report.failed:
            self._verdict.write_text(report.nodeid)


def _forked(work: Any, log: Path, cpu_s: float, wall_s: float) -> int | None:
    """Run a function in a forked process, in the copy; return its exit code, None at a limit."""
    child = os.fork()
    if not child:
        code = 70
        try:
            os.setsid()
            out = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600)
            for number in (1, 2):
                os.dup2(out, number)
            os.chdir(TREE)
            sys.path[:] = [str(TREE), str(TREE / "lab"), *(each for each in sys.path if each not in ("", str(ROOT)))]
            os.environ["PYTHONPATH"] = os.pathsep.join((str(TREE), str(TREE / "lab")))
            resource.setrlimit(resource.RLIMIT_CPU, (round(cpu_s), round(cpu_s) + 5))
            code = int(work())
        except BaseException:
            traceback.print_exc()
        os._exit(code)
    ends = time.monotonic() + wall_s
    while time.monotonic() < ends:
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            _end_group(child)
            return os.waitstatus_to_exitcode(status) if os.WIFEXITED(status) else None
        time.sleep(0.05)
    _end_group(child)
    os.waitpid(child, 0)
    return None


def _end_group(leader: int) -> None:
    with contextlib.suppress(ProcessLookupError, PermissionError):
        os.killpg(leader, signal.SIGKILL)


def judge(mutant: Mutant, known: dict[str, Any], number: int) -> tuple[str, str]:
    """Return the verdict, and the test that failed."""
    ids = tests_of(mutant, known)
    if not ids:
        return _UNRUN, ""
    target, verdict = TREE / PACKAGE / mutant.path, WORK / "verdict.txt"
    source = (ROOT / PACKAGE / mutant.path).read_bytes()
    if source[mutant.start : mutant.end].decode(errors="replace") != mutant.old:
        raise SystemExit(f"{mutant.path} has changed since the draw: start again")
    verdict.unlink(missing_ok=True)
    files = sorted({one.partition("::")[0] for one in ids})
    total = sum(known[mutant.folder]["seconds"][one] for one in ids)

    def work() -> int:
        import pytest

        return int(pytest.main([*_PYTEST, *files], plugins=[_Chosen(ids, verdict)]))

    try:
        target.write_bytes(mutant.applied(source))
        # a file of the same size within the same second would have the compiled module of the last mutant
        os.utime(target, (number + 1_000_000_000, number + 1_000_000_000))
        code = _forked(work, WORK / "mutant.log", 30 + 5 * total, 120 + 20 * total)
    finally:
        target.write_bytes(source)
    if code is None:
        return _TIMEOUT, ""
    return (_SURVIVED if code == 0 else _KILLED), (verdict.read_text() if verdict.exists() else f"exit code {code}")


def run(count: int, seed: int, minutes: float, folders: list[str], survivors: bool) -> None:
    """Judge the mutants of a draw that have no verdict yet, or those that survived once more."""
    WORK.mkdir(parents=True, exist_ok=True)
    copy_tree()
    for name in PRELOADED:
        with contextlib.suppress(ImportError):
            import_module(name)
    known, last = test_map(folders), {row["name"]: row for row in results()}
    ends = time.monotonic() + 60 * minutes
    for number, mutant in enumerate(drawn(count, seed, folders)):
        row = last.get(mutant.name)
        if time.monotonic() > ends:
            print(f"the time is over, at {number} of {count}")
            break
        if row and (not survivors or row["verdict"] in (_KILLED, _TIMEOUT)):
            continue
        if survivors and not row:
            continue
        verdict, by = judge(mutant, known, len(last) + number + int(time.monotonic()))
        new = {
            "name": mutant.name, "path": mutant.path, "line": mutant.line, "operator": mutant.operator,
            "old": mutant.old, "new": mutant.new, "verdict": verdict, "by": by,
        }  # fmt: skip
        last[mutant.name] = new
        with RESULTS.open("a") as stream:
            stream.write(json.dumps(new) + "\n")
        print(f"{verdict:16} {mutant.path}:{mutant.line} {mutant.old!r:.60} → {mutant.new!r:.60}", flush=True)


# --- what is shown


def results() -> list[dict[str, Any]]:
    return [json.loads(line) for line in RESULTS.read_text().splitlines()] if RESULTS.exists() else []


def equivalent() -> dict[str, str]:
    """Name of a mutant → why no test can notice it."""
    lines = EQUIVALENT.read_text("utf-8").splitlines() if EQUIVALENT.exists() else []
    return {name: why.strip() for name, _, why in (line.partition(" ") for line in lines if line[:1] not in ("", "#"))}


def judged() -> tuple[dict[str, dict[str, Any]], dict[str, dict[str, Any]]]:
    """Name → first and last result, of the mutants of today's source."""
    today = {one.name for folder in FOLDERS for path in (ROOT / PACKAGE / folder).rglob("*.py")
             for one in mutants_of(_module(path), path.read_bytes())}  # fmt: skip
    first, last = dict[str, dict[str, Any]](), dict[str, dict[str, Any]]()
    for row in results():
        if row["name"] in today:
            first.setdefault(row["name"], row)
            last[row["name"]] = row
    return first, last


def table() -> str:
    """The page."""
    first, last = judged()
    equal = equivalent()
    counts: dict[str, Counter[str]] = defaultdict(Counter)
    for name, row in last.items():
        folder = next(each for each in FOLDERS if row["path"].startswith(each + "/"))
        for column in (counts[folder], counts["**all**"]):
            column["mutants"] += 1
            column["first"] += first[name]["verdict"] in (_KILLED, _TIMEOUT) and name not in equal
            column["equivalent" if name in equal else row["verdict"]] += 1
    lines = [
        "# Mutants\n",
        "<!-- generated by tools/mutants.py: python -m tools.mutants table -->\n",
        "Small changes of the source (a comparison, a number by one, a negation, a statement less, two arguments"
        " swapped), drawn evenly by folder; folders without a row have not run yet."
        " Each has the fast tests of the mirrored folder that run its line. Killed:"
        " a test failed, or did not end (timeout). The shares count without the equivalent ones. First: before a"
        " test was written for a survivor of the draw, so it is also the estimate for mutants outside of the draw.\n",
        "| folder | mutants | killed | timeout | survived | no test runs it | equivalent | first | now |",
        "| --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: |",
    ]
    for folder in (*FOLDERS, "**all**"):
        row = counts[folder]
        if not (real := row["mutants"] - row["equivalent"]):
            continue
        cells = [str(row[name]) for name in ("mutants", _KILLED, _TIMEOUT, _SURVIVED, _UNRUN, "equivalent")]
        shares = [f"{100 * row['first'] / real:.0f} %", f"{100 * (row[_KILLED] + row[_TIMEOUT]) / real:.0f} %"]
        lines.append("| " + " | ".join((folder, *cells, *shares)) + " |")
    for title, wanted in (("Equivalent", True), ("Survivors", False)):
        rows = [row for name, row in last.items()
                if (name in equal) == wanted and (wanted or row["verdict"] in (_SURVIVED, _UNRUN))]  # fmt: skip
        lines += [f"\n## {title}\n", f"| place | change |{' why |' * wanted}", f"| --- | --- |{' --- |' * wanted}"]
        for row in sorted(rows, key=lambda each: (each["path"], each["line"])):
            change = " → ".join(_code(row[key]) for key in ("old", "new"))
            lines.append(f"| {row['path']}:{row['line']} | {change} |" + (f" {equal[row['name']]} |" if wanted else ""))
    return "\n".join(lines) + "\n\n<!-- end of tools/mutants.py -->\n"


def _code(text: str) -> str:
    short = " ".join(text.split()).replace("|", "\\|").replace("`", "'")
    return f"`{short if len(short) <= 80 else short[:79] + '…'}`"


def unmirrored() -> list[tuple[int, str]]:
    """Lines and name of the modules without a test file of their own, the longest first."""
    rows = [(len(path.read_text("utf-8").splitlines()), _module(path)) for path in (ROOT / PACKAGE).rglob("*.py")]
    return sorted(
        (row for row in rows if row[0] > MIRRORED_LINES and not (ROOT / mirrored(row[1])).exists()), reverse=True
    )


def main(words: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="tools.mutants")
    verbs = parser.add_subparsers(dest="verb", required=True)
    running = verbs.add_parser("run")
    running.add_argument("--mutants", type=int, default=500)
    running.add_argument("--seed", type=int, default=1)
    running.add_argument("--minutes", type=float, default=60.0)
    running.add_argument("--folder", choices=FOLDERS, action="append")
    running.add_argument("--survivors", action="store_true", help="those that survived, once more")
    for name in ("survivors", "table", "unmirrored"):
        verbs.add_parser(name)
    options = parser.parse_args(words)
    match options.verb:
        case "run":
            run(options.mutants, options.seed, options.minutes, options.folder or list(FOLDERS), options.survivors)
        case "table":
            PAGE.write_text(table(), "utf-8")
        case "survivors":
            for name, row in judged()[1].items():
                if row["verdict"] in (_SURVIVED, _UNRUN) and name not in equivalent():
                    change = " → ".join(_code(row[key]) for key in ("old", "new"))
                    print(f"{name} {row['verdict']:16} {row['path']}:{row['line']}: {change}")
        case _:
            for lines, module in unmirrored():
                print(f"{lines:5} {module}")
            print(f"{len(unmirrored())} modules of more than {MIRRORED_LINES} lines")
    return 0


if __name__ == "__main__":
    sys.exit(main())
