"""Verification by compiled conversions beside that of the full path, while the code of both is changed.

    python -m tools.recheck_code [FOUND] [SEED] [WORKERS]

Draws mutants of the code that computes outputs (`tools/mutants.py`), and verifies recordings with each, until the full
path has found this number of them.  Prints them as a table, with what the default verification finds.
"""

from __future__ import annotations

import json
import random
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from importlib.machinery import SourceFileLoader
from pathlib import Path
from typing import Any

from tools import mutants

FOLDERS = (
    "gateway/to_ros",
    "gateway/to_igtl",
    "gateway/dialogue",
    "gateway/fastpath",
    "gateway/log",
    "convert",
    "wire",
)
FIXTURES = ("paper-types", "lego", "every-type")
_MOST, _STEPS, _TIMEOUT_S = 600, 300, 120


def use(mutant: mutants.Mutant) -> None:
    """Have the module of a mutant loaded with its change.  It must not be loaded yet."""
    path = str(mutants.ROOT / mutants.PACKAGE / mutant.path)
    right = SourceFileLoader.get_code

    def get_code(self: SourceFileLoader, fullname: str) -> Any:
        if self.path != path:
            return right(self, fullname)
        return compile(mutant.applied(Path(path).read_bytes()), path, "exec", dont_inherit=True)

    setattr(SourceFileLoader, "get_code", get_code)  # noqa: B010  # a type checker knows no change of a method


def judge(number: int, seed: int, paths: list[str]) -> dict[str, Any]:
    """Verify recordings with a mutant; the first in which the full path finds it decides."""
    use(mutants.drawn(number + 1, seed, FOLDERS)[number])
    from tools.recheck import both, judged  # loads the mutant

    for path in paths:
        quick, reference = (judged(each) for each in both(Path(path)))
        if not reference.get("good") or quick != reference:
            return {"found": not reference.get("good"), "equal": quick == reference, "file": Path(path).stem}
    return {"found": False, "equal": True}


def recordings(folder: Path) -> list[str]:
    """A random session, and fixtures."""
    from tools.recheck import random_session, written

    path = written(folder / "random.mcap", *random_session(random.Random(0), _STEPS))
    return [str(path), *(str(mutants.ROOT / "fixtures" / f"{name}.mcap") for name in FIXTURES)]


def verdict(number: int, seed: int, paths: list[str]) -> dict[str, Any] | None:
    """What a program with a mutant finds; None: it does not start, or does not end."""
    words = [sys.executable, "-m", "tools.recheck_code", "--judge", str(number), str(seed), *paths]
    try:
        done = subprocess.run(words, cwd=mutants.ROOT, capture_output=True, timeout=_TIMEOUT_S, check=True)
        return dict(json.loads(done.stdout.splitlines()[-1]))
    except (subprocess.SubprocessError, ValueError, IndexError):
        return None


def main(found: int = 50, seed: int = 52, workers: int = 2) -> int:
    drawn = mutants.drawn(_MOST, seed, FOLDERS)
    shown = silent = broken = wrong = at = 0
    with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor(workers) as pool:
        paths = recordings(Path(folder))
        while shown < found and at < len(drawn):
            numbers = range(at, min(at + workers, len(drawn)))
            at = numbers.stop
            for number, one in zip(numbers, pool.map(lambda each: verdict(each, seed, paths), numbers), strict=True):
                broken += one is None
                silent += one is not None and one["equal"] and not one["found"]
                wrong += one is not None and not one["equal"]
                if one is not None and (one["found"] or not one["equal"]):
                    shown += 1
                    print(_row(drawn[number], one), flush=True)
    print(f"\n{shown} of {at}; {silent} change nothing in these recordings, {broken} do not start or do not end")
    return 1 if wrong else 0


def _row(mutant: mutants.Mutant, one: Mapping[str, Any]) -> str:
    change = f"`{mutant.old}` → `{mutant.new}`".replace("|", "\\|").replace("\n", " ")
    return f"| {mutant.path}:{mutant.line} | {change} | {one['file']} | {'yes' if one['equal'] else '**no**'} |"


if __name__ == "__main__":
    if sys.argv[1:2] == ["--judge"]:
        print(json.dumps(judge(int(sys.argv[2]), int(sys.argv[3]), sys.argv[4:])))
        sys.exit(0)
    sys.exit(main(*map(int, sys.argv[1:])))
