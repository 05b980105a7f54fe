"""SHA-256 of every file of the packages that users install, for ``pip --require-hashes``.

    .venv/bin/python tools/hashes.py             write hashes.txt again, from the package index
    .venv/bin/python tools/hashes.py --check     has hashes.txt the pins of constraints.txt, each with hashes?

The file has the versions of ``constraints.txt`` without what only developers need, and no address of an index.
``docs/start/install.md`` shows how to install with it.  Setting up the development environment does not use it.
"""

from __future__ import annotations

import re
import subprocess
import sys
import tempfile
from importlib.metadata import distribution
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent.parent))

from packaging.requirements import Requirement

from tools.constraints import (
    CONSTRAINTS,
    EXTRAS,
    OLDEST,
    lines_of,
    older_pins_of,
    pins_of,
    requirements,
    resolved_for_the_oldest,
)

HASHES = CONSTRAINTS.with_name("hashes.txt")
HEADER = f"# SHA-256 of what the extras [{EXTRAS}] install; see constraints.txt.  To renew: python tools/hashes.py\n"
_HASHES = r"(?:\n    --hash=sha256:[0-9a-f]{64}(?: \\)?)+"
_PIN = re.compile(rf"^([a-z0-9][a-z0-9._-]*)==(\S+)(?: ; [^\\\n]+)? \\$({_HASHES})$", re.MULTILINE)
_ALL = ("--universal", "--python-version", OLDEST)


def pins() -> dict[str, str]:
    """Return name and version of all pins of ``constraints.txt`` but those of the oldest Python."""
    return pins_of(CONSTRAINTS.read_text("utf-8"))


def older_pins() -> dict[str, str]:
    """Return name and version of those of the oldest Python."""
    return older_pins_of(CONSTRAINTS.read_text("utf-8"))


def needed(of: dict[str, str]) -> dict[str, str]:
    """Return the pins that users need, as far as they are installed here."""
    own = [Requirement(line) for line in distribution("igtl-gateway").requires or () if "extra ==" not in line]
    names = {*requirements(Requirement(f"igtl-gateway[{EXTRAS}]")), *(need.name for need in own)}
    return {name: version for name, version in of.items() if name in names}


def needed_by_the_oldest(older: dict[str, str], pinned: dict[str, str]) -> dict[str, str]:
    """Return those of ``older`` that users need, or that nothing needs in newer Pythons."""
    return {**needed(older), **{name: version for name, version in older.items() if name not in pinned}}


def compiled(wanted: dict[str, str], older: dict[str, str]) -> str:
    """Return the content of the file, by the hashes of the package index."""
    with tempfile.TemporaryDirectory() as folder:
        given, found = Path(folder) / "pins.in", Path(folder) / "pins.txt"
        newer = wanted.keys() - resolved_for_the_oldest(pins())
        given.write_text("\n".join(lines_of(wanted, older, newer)), "utf-8")
        quiet = ("--quiet", "--no-header", "--no-annotate", "--no-emit-index-url")
        uv = str(Path(sys.executable).with_name("uv"))
        subprocess.run(
            [uv, "pip", "compile", given, "--no-deps", "--generate-hashes", *quiet, *_ALL, "--output-file", found],
            check=True,
        )
        return HEADER + found.read_text("utf-8")


def faults(text: str, pinned: dict[str, str], wanted: dict[str, str], older: dict[str, str]) -> list[str]:
    """Return what is wrong with the content of the file.

    Args:
        text: the content.
        pinned: name → version of the pins.
        wanted: those that the file must have.
        older: name → version of those that it must have for the oldest Python beside.
    """
    pairs = [(name, version) for name, version, _ in _PIN.findall(text)]
    found = {name: version for name, version in pairs if older.get(name) != version}
    wrong = [f"{name}: found no hashes, expected those of {wanted[name]}" for name in wanted.keys() - found]
    wrong += [
        f"{name}: found {version}, expected {pinned.get(name)} of constraints.txt"
        for name, version in found.items()
        if pinned.get(name) != version
    ]
    wrong += [
        f"{name}: found no hashes of {version}" for name, version in older.items() if (name, version) not in pairs
    ]
    rest = _PIN.sub("", text.removeprefix(HEADER)).strip()
    return sorted(wrong) + [f"found {rest[:60]!r}, expected pins with hashes only"] * bool(rest)


def main() -> int:
    """Write the file, or with ``--check`` compare; 1 where it differs."""
    pinned = pins()
    older = needed_by_the_oldest(older_pins(), pinned)
    if sys.argv[1:] != ["--check"]:
        HASHES.write_text(compiled(needed(pinned), older), "utf-8")
        return 0
    wrong = faults(HASHES.read_text("utf-8"), pinned, needed(pinned), older)
    for line in wrong:
        print(f"{HASHES.name}: {line}", file=sys.stderr)
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
