"""Makefile, CONTRIBUTING, git hooks and GitHub's workflow name the same commands, and the gate leaves no test out."""

from __future__ import annotations

import re
import shlex
import shutil
import subprocess
import sys
from functools import cache
from pathlib import Path
from typing import Any

import pytest
from ruamel.yaml import YAML

from igtl_gateway.base.versions import tomllib
from tests.conftest import LONG, LONG_FILES, SLOW
from tests.places import ROOT
from tests.tables import table

MAKEFILE = (ROOT / "Makefile").read_text("utf-8")
PYPROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "ARCHITECTURE.md", *sorted((ROOT / "docs").rglob("*.md"))]

RULES = set(re.findall(r"^([\w-]+):", MAKEFILE, re.MULTILINE))
#: What `make help` names: the targets for people.
PUBLIC = set(re.findall(r'^\t@echo "make ([\w-]+)', MAKEFILE, re.MULTILINE))


def targets_in(text: str) -> set[str]:
    """Every target of a ``make TARGET …`` in code of ``text``: a line of a listing, or between backticks."""
    code = re.findall(r"^    .*$|^\$.*$|`[^`]*`", text, re.MULTILINE)
    calls = [re.search(r"^[\s$`]*make((?: [a-z][a-z-]*)+)", line) for line in code]
    return {name for call in calls if call for name in re.split(r" {2,}", call[1].lstrip())[0].split()}


@cache
def recipe(target: str) -> list[list[str]]:
    """The commands of a target as make prints them, word by word; nothing runs."""
    make = shutil.which("make")
    if make is None:
        pytest.skip("no make here")
    # -o: as if the environment were installed.
    run = [make, "--dry-run", "--no-print-directory", "-o", ".venv/.ready", target]
    printed = subprocess.run(run, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    return [shlex.split(line) for line in printed.replace("\\\n", " ").splitlines()]


def pytest_words(target: str) -> list[str]:
    """The arguments of the first pytest that a target starts."""
    words = next(command for command in recipe(target) if "pytest" in command)
    return words[words.index("pytest") + 1 : words.index("||")]


def yaml(name: str) -> Any:
    return YAML(typ="safe", pure=True).load(ROOT / name)


def hooks() -> dict[str, list[str]]:
    """Git hook → the words of its command."""
    (repository,) = yaml(".pre-commit-config.yaml")["repos"]
    assert repository["repo"] == "local", "nothing is downloaded"
    return {hook["id"]: hook["entry"].split() for hook in repository["hooks"]}


def test_the_public_targets_are_rules_that_help_lists() -> None:
    assert {"check", "test", "test-fast", "coverage", "hooks"} <= PUBLIC <= RULES
    (phony,) = re.findall(r"^\.PHONY: (.*)$", MAKEFILE, re.MULTILINE)
    assert set(phony.split()) == RULES


@table("page", PAGES, ids=lambda page: page.name)
def test_every_target_that_a_page_names_exists(page: Path) -> None:
    assert targets_in(page.read_text("utf-8")) <= RULES


def test_contributors_are_told_of_every_public_target() -> None:
    assert targets_in((ROOT / "CONTRIBUTING.md").read_text("utf-8")) >= PUBLIC


def test_targets_are_found_in_code_alone() -> None:
    page = "    make check test-fast    both\nwords make sense\n`make test`; `PYTHON=x make no`\n$ make demo   # it\n"
    assert targets_in(page) == {"check", "test-fast", "test", "demo"}


def test_the_tiers_together_are_everything() -> None:
    """The gate leaves out what is marked long, the fast tier what is marked slow, and neither anything else."""
    gate, fast, long = pytest_words("test"), pytest_words("test-fast"), pytest_words("test-long")
    assert gate[-2:] == ["-m", "not long"]
    assert fast == [*gate[:-1], "not slow"]
    assert long[-2:] == ["-m", "long"]
    everywhere = [*gate[:-2], *shlex.split(PYPROJECT["tool"]["pytest"]["ini_options"]["addopts"])]
    selecting = ("-m", "-k", "--ignore", "--deselect", "--lf", "--last-failed")
    assert [word for word in everywhere if word.startswith(selecting)] == []
    assert [word for word in everywhere if (ROOT / word).exists()] == [], "a path leaves out what lies elsewhere"
    assert PYPROJECT["tool"]["pytest"]["ini_options"]["testpaths"] == ["tests"]


def test_the_third_tier_has_tests_and_no_folders() -> None:
    """A folder would take each test with it that is written there later, and the gate would not run it."""
    for name in LONG:
        file, _, test = name.partition("::")
        path = ROOT / "tests" / file
        assert path.suffix == ".py" and path.is_file(), name
        assert (name in LONG_FILES) == (not test), name
        begin = test.partition("[")[0].rpartition("::")[2]
        assert not test or re.search(rf"^ *def {begin}", path.read_text("utf-8"), re.MULTILINE), name


def test_for_each_file_of_the_third_tier_the_gate_has_another() -> None:
    for substitute in LONG_FILES.values():
        assert (ROOT / "tests" / substitute).is_file() and substitute not in LONG_FILES, substitute


@pytest.mark.slow
def test_the_gate_runs_each_test_file_but_those_of_the_third_tier(request: pytest.FixtureRequest) -> None:
    """As pytest collects them, with the selection of the gate: in the gate those that it runs."""
    marks = pytest_words("test")[-2:]
    if _is_whole(request.config, marks[-1]):
        collected = {item.path.relative_to(ROOT).as_posix() for item in request.session.items}
    else:
        collect = [sys.executable, "-m", "pytest", "--collect-only", "-q", "-p", "no:cacheprovider", *marks]
        done = subprocess.run(collect, cwd=ROOT, capture_output=True, text=True, check=True)
        collected = {line.partition("::")[0] for line in done.stdout.splitlines() if "::" in line}
    files = {path.relative_to(ROOT).as_posix(): path.read_text("utf-8") for path in (ROOT / "tests").rglob("test_*.py")}
    optional = {
        name for name, text in files.items() if re.search(r"^(\w+ = )?pytest\.importorskip", text, re.MULTILINE)
    }
    assert files.keys() - collected - optional == {f"tests/{name}" for name in LONG_FILES}


def _is_whole(config: pytest.Config, marks: str) -> bool:
    """Whether this run has all tests with these marks: pytest was given no other selection."""
    chosen = config.option
    others = (chosen.keyword, chosen.deselect, chosen.ignore, chosen.ignore_glob, getattr(chosen, "lf", False))
    is_all = config.args_source is config.ArgsSource.TESTPATHS and not any(others)
    return is_all and bool(chosen.markexpr == marks)


@pytest.mark.parametrize(("tier", "code"), [("slow", 0), ("not slow", 5)])
def test_a_file_of_the_second_tier_has_no_fast_test(tier: str, code: int) -> None:
    """5 is pytest's code for "no tests collected"."""
    smallest = min((ROOT / "tests" / name for name in SLOW), key=lambda path: path.stat().st_size)
    run = [sys.executable, "-m", "pytest", "--collect-only", "-q", "-p", "no:cacheprovider", "-m", tier, str(smallest)]
    assert subprocess.run(run, cwd=ROOT, capture_output=True, text=True, check=False).returncode == code


def test_the_gate_begins_with_the_checks() -> None:
    """Those that end in seconds; mypy runs beside the tests, and its exit code counts, too."""
    gate, quick, (types,) = recipe("test"), recipe("quick"), recipe("types")
    assert gate[: len(quick)] == quick
    beside = next(command for command in gate if "pytest" in command)
    assert beside[: len(types) + 2] == ["nice", *types, "&"]
    assert beside[-5:] == ["wait", "$types", "&&", "exit", "$tests"]
    checks = recipe("static")
    assert recipe("check")[: len(checks)] == checks
    assert [command for command in checks if command not in (*quick, types)] == checks[:1]  # what starts the others
    assert (ROOT / ".ci" / "run").read_text("utf-8").count("make --no-print-directory test <") == 1


def test_git_hooks_run_what_check_runs() -> None:
    checks = recipe("static")
    for name, command in hooks().items():
        if command[0] == "make":
            assert recipe(command[-1])[0] in checks, name
        else:
            assert (ROOT / command[-1]).is_file(), name
