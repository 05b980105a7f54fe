"""Copies of the package without its add-ons, and without each of them: what is left works, and states what is absent.

Each copy runs in one process of its own, which imports nothing from the checkout.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from igtl_gateway.base.addons import ADDONS
from tests.integration.bridge import string
from tests.places import FIXTURES, ROOT

STAR, SMALL, OTHER = (FIXTURES / f"{name}.mcap" for name in ("star", "paper-types", "brain"))

#: Runs verbs, given as lists of words, and imports all modules; prints code, stderr and what failed
#: as JSON.
PROGRAM = """\
import contextlib, importlib, io, json, pkgutil, sys
import igtl_gateway
from igtl_gateway.base.errors import GatewayError
from igtl_gateway.cli import main

def run(words):
    out, error = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(error):
        try:
            code = main(words)
        except SystemExit as end:
            code = end.code or 0
        except BaseException as problem:
            code, error = f"{type(problem).__name__}: {problem}", error
    return [code, error.getvalue(), out.getvalue()]

def imported():
    for each in pkgutil.walk_packages(igtl_gateway.__path__, "igtl_gateway."):
        if each.name.startswith("igtl_gateway.addons") or each.name.endswith("__main__"):
            continue
        try:
            importlib.import_module(each.name)
        except (GatewayError, ImportError) as problem:
            yield f"{each.name}: {type(problem).__name__}: {problem}"

given = json.load(sys.stdin)
print(json.dumps({"place": igtl_gateway.__file__, "runs": [run(words) for words in given], "left": list(imported())}))
"""

#: What the core does.
CORE = (
    ("--help",),
    ("--version",),
    ("info", SMALL),
    ("verify", SMALL),
    ("diff", SMALL, SMALL),
    ("slice", SMALL, "-o", "OUT/slice.mcap", "--end", "1"),
    ("recover", SMALL, "-o", "OUT/recovered.mcap"),
    ("doctor", SMALL),
    ("keep", "OUT", "--retention", "1 h"),
    ("replay", "--help"),
    ("doctor", "--help"),
    ("bridge", "--help"),
    ("bridge", "--no-ros", "--listen", "127.0.0.1:0", "--duration", "0.1"),
    ("decode", "OUT/bytes.igtl"),
    ("completion", "bash"),
)  # fmt: skip
#: Add-on → words of its verb, and of other verbs for what only they need it; one line, exit code 1.
NEEDED: dict[str, tuple[tuple[object, ...], ...]] = {
    "sync": (
        ("sync", STAR),
        ("merge", STAR, STAR, "-o", "OUT/n.mcap", "--sync", "/a", "/b"),
        ("view", STAR, "-o", "OUT/lag.rrd", "--sync", "/star/tool", "/star/tool"),
        ("cohort", "sync", STAR, "-o", "OUT/cohort"),
        ("export", STAR, "--to", "lerobot", "--write-recipe", "OUT/recipe.toml"),
    ),
    "merge": (("merge", STAR, STAR, "-o", "OUT/m.mcap"),),
    "deidentify": (("deidentify", STAR, "-o", "OUT/d.mcap"),),
    "exchange": (("import", STAR, "-o", "OUT/i.mcap"), ("export", STAR, "--to", "csv", "-o", "OUT/csv")),
    "upload": (
        ("upload", "OUT", "--to", "s3://bucket"),
        ("keep", "OUT", "--upload", "s3://bucket"),
        ("bridge", "--no-ros", "--record", "OUT/up.mcap", "--upload", "s3://bucket"),
    ),
    "view": (("view", STAR), ("bridge", "--no-ros", "--view")),
    "page": (("page", "OUT"), ("bridge", "--no-ros", "--page")),
    "resim": (("resim", STAR, "--", "true"),),
    "review": (("review", STAR), ("cohort", "review", STAR, "-o", "OUT/cohort")),
    "cohort": (("cohort", "info", SMALL, "-o", "OUT/cohort"),),
    "lerobot": (("export", STAR, "--to", "lerobot", "-o", "OUT/set"),),
    "zenoh": (
        ("zenoh-router",),
        ("bridge", "--site=or1"),
        ("bridge", "--ros", "zenoh", "--listen", "127.0.0.1:0", "--duration", "0.1"),
    ),
}
#: Add-on → what other add-ons do without it.
WITHOUT: dict[str, tuple[tuple[object, ...], ...]] = {
    "sync": (
        ("view", SMALL, "-o", "OUT/view.rrd"),
        ("merge", f"a={STAR}", f"b={OTHER}", "-o", "OUT/m.mcap", "--offset", "b=0.1"),
        ("cohort", "info", SMALL, "-o", "OUT/cohort"),
    ),
    "exchange": (("cohort", "info", SMALL, "-o", "OUT/cohort"),),
    "review": (("view", SMALL, "-o", "OUT/view.rrd"), ("cohort", "info", SMALL, "-o", "OUT/cohort")),
    "lerobot": (("export", SMALL, "--to", "csv", "-o", "OUT/csv"), ("export", "--help")),
}
EVERY = tuple(ADDONS)


def _outcome(tmp_path: Path, absent: tuple[str, ...], runs: list[tuple[object, ...]]) -> dict[str, Any]:
    """The runs in a copy of the package without these add-ons."""
    package = tmp_path / "copy" / "igtl_gateway"
    out = tmp_path / "out"
    out.mkdir()
    out.joinpath("bytes.igtl").write_bytes(string("hello", "Guest"))
    folders = {"addons"} if absent == EVERY else set(absent)

    def left_out(folder: str, names: list[str]) -> set[str]:
        place = Path(folder).relative_to(ROOT / "igtl_gateway")
        written = {name for name in names if ".pyc." in name}  # by another process, which renames it
        return folders & set(names) if place == Path("." if absent == EVERY else "addons") else written

    shutil.copytree(ROOT / "igtl_gateway", package, ignore=left_out)  # with what is compiled, which takes half the time
    assert not any((package / "addons" / name).exists() for name in absent)
    words = [[str(word).replace("OUT", str(out)) for word in each] for each in runs]
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM], input=json.dumps(words), cwd=tmp_path, capture_output=True, text=True,
        timeout=300, check=False, env={**os.environ, "PYTHONPATH": str(package.parent)},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    found: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    assert Path(found["place"]).is_relative_to(package)
    return found


@pytest.mark.slow
@pytest.mark.parametrize("addon", ["", *ADDONS], ids=["all", *ADDONS])  # a process of some seconds each
def test_what_is_left_works_without_an_addon(addon: str, tmp_path: Path) -> None:
    absent = (addon,) if addon else EVERY
    needed = [words for each in absent for words in NEEDED[each] if addon or words[0] in ADDONS[each]]
    kept = [*CORE, *WITHOUT.get(addon, ())]
    found = _outcome(tmp_path, absent, [*kept, *needed])
    ran = list(zip([*kept, *needed], found["runs"], strict=True))
    assert [run for run in ran[: len(kept)] if run[1][0] != 0] == []
    told = [run for run in ran[len(kept) :] if run[1][0] == 1 and run[1][1].count("\n") == 1]
    assert [run for run in told if "found no add-on" in run[1][1]] == ran[len(kept) :]
    assert found["left"] == []


def test_the_c_of_an_addon_goes_with_its_folder() -> None:
    """Without the add-ons, no line of C is left that only they need: each part has its module in the core."""
    package = ROOT / "igtl_gateway"
    lines = {path: path.read_text("utf-8").splitlines() for path in package.rglob("_*.[ch]")}
    left = {path: text for path, text in lines.items() if not path.is_relative_to(package / "addons")}
    owners = {path.relative_to(package).parts[1] for path in lines.keys() - left.keys()}
    assert owners == {"resim"}
    assert sum(len(text) for text in lines.values()) - sum(len(text) for text in left.values()) > 3_000
    assert [line for text in left.values() for line in text for owner in owners if owner in line.lower()] == []
    modules = [path for path in package.rglob("*.py") if not path.is_relative_to(package / "addons")]
    code = "\n".join(path.read_text("utf-8") for path in modules)
    for part in (path for path in left if path.suffix == ".c"):
        assert re.search(rf"native(\.| import (\w+, )*|\", \"){part.stem}\b", code), part
