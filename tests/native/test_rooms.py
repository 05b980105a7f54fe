"""The rooms of the parts in C: what each includes, how long its files are, and the walks of ARCHITECTURE.md."""

from __future__ import annotations

import re
import shlex
import subprocess
import sysconfig
from functools import cache

import pytest

from tests.places import PACKAGE, ROOT
from tests.tables import table
from tools import sanitize

NATIVE = PACKAGE / "native"
FILES = {path.relative_to(NATIVE).as_posix(): path.read_text("utf-8") for path in sorted(NATIVE.rglob("_*.[ch]"))}
HEADERS = [name for name in FILES if name.endswith(".h")]
MOST_LINES = 600
#: To a file that a walk has left.
MOST_RETURNS = 8

#: What the kernel may include of the system: neither Python nor threads, clocks, sockets or files.
_OF_KERNEL = {"immintrin.h", "math.h", "stddef.h", "stdint.h", "string.h", "sys/types.h"}
_INCLUDE = re.compile(r'^#include (?:<([\w/.]+)>|"([\w/.]+)")$', re.MULTILINE)
_CLOCKS_AND_THREADS = re.compile(r"\b(?:clock_gettime|time|pthread_\w+|Py\w+|malloc|calloc|realloc|free)\(")


def included(name: str) -> set[str]:
    """The files below native/ that a file includes."""
    here = (NATIVE / name).parent
    found = (of_ours for _, of_ours in _INCLUDE.findall(FILES[name]) if of_ours)
    return {(here / one).resolve().relative_to(NATIVE.resolve()).as_posix() for one in found}


def test_there_are_rooms() -> None:
    assert {"kernel", "passage", "passage/python"} <= {name.rpartition("/")[0] for name in HEADERS}


def test_no_file_is_long() -> None:
    assert {name: lines for name, text in FILES.items() if (lines := text.count("\n")) > MOST_LINES} == {}


@table("name", [name for name in HEADERS if name.startswith("kernel/")])
def test_the_kernel_has_neither_python_nor_threads_nor_a_clock_nor_memory_of_its_own(name: str) -> None:
    system = {of_system for of_system, _ in _INCLUDE.findall(FILES[name]) if of_system}
    assert system <= _OF_KERNEL
    assert {one for one in included(name) if not one.startswith("kernel/")} == set()
    assert _CLOCKS_AND_THREADS.findall(FILES[name]) == []


def test_rooms_include_downwards_and_in_no_circle() -> None:
    """The binding stands on the passage, which stands on the kernel; the passage knows nothing of its binding."""
    for name in HEADERS:
        if name.startswith("passage/_"):
            assert all(one.startswith(("kernel/", "passage/_")) for one in included(name)), name
    left = {name: included(name) for name in FILES}
    while ground := {name for name, others in left.items() if not others & left.keys()}:
        left = {name: others for name, others in left.items() if name not in ground}
    assert left == {}, "these are in a circle, or above one"


def test_every_header_is_part_of_a_module() -> None:
    used, waiting = set[str](), [name for name in FILES if name.endswith(".c")]
    while waiting:
        name = waiting.pop()
        waiting += included(name) - used
        used |= included(name)
    assert sorted(set(HEADERS) - used) == []


@pytest.fixture(scope="module")
def compiler() -> str:
    return shlex.split(sysconfig.get_config_var("CC") or "cc")[0]


@table("name", [name for name in HEADERS if name.startswith("kernel/")])
def test_a_header_of_the_kernel_compiles_alone_without_a_warning(name: str, compiler: str) -> None:
    # a static function that only others use is no fault of a header
    warnings = ("-Wall", "-Wextra", "-Wconversion", "-Wshadow", "-Wno-unused-function", "-Werror")
    command = [compiler, "-fsyntax-only", "-x", "c", "-std=gnu11", *warnings, f"-I{NATIVE}", "-"]
    try:
        run = subprocess.run(command, input=f'#include "{name}"\n', capture_output=True, text=True, check=False)
    except OSError:
        pytest.skip("no C compiler")
    assert (run.returncode, run.stderr) == (0, "")


def test_each_module_has_tests_under_the_sanitizers() -> None:
    assert sanitize.doors() == sorted(sanitize.TESTS)
    assert [test for tests in sanitize.TESTS.values() for test in tests if not (ROOT / test).exists()] == []


@table("source", [path.relative_to(PACKAGE).as_posix() for path in sorted(PACKAGE.rglob("_*.c"))])
def test_a_part_compiles_without_a_warning(source: str, compiler: str) -> None:
    """Each module in C, those of add-ons too; a conversion that may lose bits or the sign is written out."""
    warnings = ("-Wall", "-Wextra", "-Wconversion", "-Wshadow", "-Werror")
    # the macros of Python's headers are not ours
    command = [compiler, "-fsyntax-only", "-std=gnu11", *warnings, "-isystem", sysconfig.get_path("include")]
    try:
        run = subprocess.run([*command, PACKAGE / source], capture_output=True, text=True, check=False)
    except OSError:
        pytest.skip("no C compiler")
    assert (run.returncode, run.stderr) == (0, "")


# -- the walks -------------------------------------------------------------------------------------------------------

_STEP = re.compile(r"^( *)((?:kernel|passage)/[\w/]+\.h): (\w+)", re.MULTILINE)


@cache
def body_of(name: str, function: str) -> str:
    """The text of a function, from its name to the brace that ends it."""
    found = re.search(
        rf"^[a-zA-Z][^;{{}}\n]*\b{function}\([^;{{}}]*\)(?:\n\{{\n.*?\n\}}| \{{[^\n]*\}})",
        FILES[name],
        re.MULTILINE | re.DOTALL,
    )
    assert found, f"{name} has no function {function}"
    return found[0]


def test_the_walks_are_those_of_the_code() -> None:
    """Each line is called by the line that it stands below, behind the line before it; walks seldom come back."""
    pictures = [part for part in (ROOT / "ARCHITECTURE.md").read_text("utf-8").split("```text\n") if _STEP.match(part)]
    assert len(pictures) == 3
    for picture in pictures:
        steps = _STEP.findall(picture.partition("```")[0])
        callers: list[tuple[str, int]] = []
        for blanks, place, function in steps:
            del callers[len(blanks) // 2 :]
            if callers:
                text, after = callers[-1]
                found = re.compile(rf"\b{function}\b").search(text, after)
                assert found, f"{function} is not called there"
                callers[-1] = text, found.end()
            text = body_of(place, function)
            callers.append((text, text.index("{")))
        left, returns, here = set[str](), 0, steps[0][1]
        for _, place, _ in steps:
            if place != here:
                left.add(here)
                returns += place in left
                here = place
        assert returns <= MOST_RETURNS
        assert len(steps) > 4


def test_the_table_of_rooms_names_each_header_of_kernel_and_passage() -> None:
    rows = re.findall(r"^\| `native/(\w+)` \|.*$", (ROOT / "ARCHITECTURE.md").read_text("utf-8"), re.MULTILINE)
    assert rows == ["kernel", "passage"]
    for room in rows:
        (row,) = re.findall(rf"^\| `native/{room}` \|.*$", (ROOT / "ARCHITECTURE.md").read_text("utf-8"), re.MULTILINE)
        headers = {name.removeprefix(f"{room}/") for name in HEADERS if name.startswith(f"{room}/_")}
        assert set(re.findall(r"`(_\w+\.h)`", row)) == headers
