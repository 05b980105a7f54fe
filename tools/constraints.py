"""Exact pins of everything that the extras install, read off the environment that runs this.

    .venv/bin/python tools/constraints.py > constraints.txt     write the pins again
    .venv/bin/python tools/constraints.py --check               is everything here pinned as it is installed?

What has no such version for Python 3.10 has a second pin, with a marker.

Strategy: walk the requirements from our own package with all extras and take the version that is installed.
Walking, rather than listing the environment, leaves out what came by other ways (pip itself, and the Python
packages inside the ROS wheels, whose names belong to other projects on the package index).
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from collections.abc import Collection
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

sys.path.insert(0, str(Path(__file__).parent.parent))

from tools import core

#: The extras that users install; ``dev`` is for developers, and ``lab`` is a distribution of the same release.
EXTRAS = "ros,view,video,nifti,plot,pcap,hdf5,arrow,pandas,lerobot,seal,cohort,zenoh,websocket"
PROJECT = Requirement(f"igtl-gateway[{EXTRAS},lab,dev]")
CONSTRAINTS = Path(__file__).parent.parent / "constraints.txt"
HEADER = f"""\
# What the extras [{EXTRAS},lab,dev] install, with all that they need;
# CPython 3.11, Linux x86_64.
# To renew: make a virtual environment without this file, and in it
#   pip install -e '.[{EXTRAS},lab,dev]' -e ./lab
#   python tools/constraints.py > constraints.txt
"""
#: The oldest Python, and the marker of what only it has, or has in another version.
OLDEST = "3.10"
_OLDER, _NEWER = (f"; python_version {compared} '3.11'" for compared in ("<", ">="))


def requirements(project: Requirement) -> dict[str, set[str]]:
    """Name of each installed direct and indirect requirement of ``project``, itself included → what it needs.

    What a marker excludes is not needed; what is needed but absent is in the values only (ROS 2 without wheels).
    """
    needs: dict[str, set[str]] = {}
    seen: set[tuple[str, str]] = set()
    waiting = [project]
    while waiting:
        wanted = waiting.pop()
        name = canonicalize_name(wanted.name)
        try:
            found = distribution(name)
        except PackageNotFoundError:
            continue
        names = needs.setdefault(name, set())
        # The empty extra stands for the plain requirements.
        for extra in {"", *wanted.extras}:
            if (name, extra) in seen:
                continue
            seen.add((name, extra))
            lines = [Requirement(line) for line in found.requires or ()]
            more = [need for need in lines if need.marker is None or need.marker.evaluate({"extra": extra})]
            names.update(canonicalize_name(need.name) for need in more)
            waiting += more
    return dict(sorted(needs.items()))


def installed_pins(project: Requirement) -> dict[str, str]:
    """Name → installed version of all direct and indirect requirements of ``project`` except its own parts."""
    own = {canonicalize_name(project.name), "igtl-gateway-lab"}
    return {name: distribution(name).version for name in requirements(project) if name not in own}


def pins_of(text: str) -> dict[str, str]:
    """Return name → version of the pins in the content of a file, without those of the oldest Python."""
    lines = [line.removesuffix(_NEWER) for line in text.splitlines() if not line.endswith(_OLDER)]
    return {name: version for name, equal, version in (line.partition("==") for line in lines) if equal}


def older_pins_of(text: str) -> dict[str, str]:
    """Return name → version of the pins in the content of a file that only the oldest Python has."""
    lines = [line.removesuffix(_OLDER) for line in text.splitlines() if line.endswith(_OLDER)]
    return {name: version for name, _, version in (line.partition("==") for line in lines)}


def older_pins(pins: dict[str, str]) -> dict[str, str]:
    """Return what the oldest Python needs otherwise than ``pins``: an older version, or one more distribution."""
    return {name: version for name, version in resolved_for_the_oldest(pins).items() if pins.get(name) != version}


def resolved_for_the_oldest(pins: dict[str, str]) -> dict[str, str]:
    """Return name → version of all that users and ``make core`` need on the oldest Python, at most that of ``pins``."""
    limits = "".join(f"{name}<={version}\n" for name, version in pins.items())
    extras = [word for extra in EXTRAS.split(",") for word in ("--extra", extra)]
    command = [str(Path(sys.executable).with_name("uv")), "pip", "compile", "--quiet", "--python-version", OLDEST]
    command += [*extras, "--no-annotate", "--no-header", str(CONSTRAINTS.with_name("pyproject.toml")), "-"]
    with tempfile.NamedTemporaryFile("w") as file:
        file.write(limits)
        file.flush()
        tests = "\n".join(core.requirements(ros=False))
        command += ["--constraint", file.name]
        found = subprocess.run(command, input=tests, capture_output=True, text=True, check=True).stdout
    return pins_of(found)


def lines_of(pins: dict[str, str], older: dict[str, str], newer: Collection[str] = ()) -> list[str]:
    """Return the lines of a file of pins.

    Args:
        pins: name → version.
        older: those of the oldest Python instead.
        newer: names that the oldest Python does not need.
    """
    marked = {*older, *newer}
    rows = [(name, f"{name}=={version}{_NEWER if name in marked else ''}") for name, version in pins.items()]
    rows += [(name, f"{name}=={version}{_OLDER}") for name, version in older.items()]
    return [line for _, line in sorted(rows, key=lambda row: row[0])]


def differences(pins: dict[str, str], constraints: str) -> list[str]:
    """One line for each installed package that the text of ``constraints`` does not pin as it is."""
    found = pins_of(constraints)
    return [f"{name}=={version}" for name, version in pins.items() if found.get(name) != version]


def main() -> int:
    """Print the pins, or with ``--check`` compare; 1 where they differ."""
    pins = installed_pins(PROJECT)
    if sys.argv[1:] == ["--check"]:
        unpinned = differences(pins, CONSTRAINTS.read_text(encoding="utf-8"))
        for line in unpinned:
            print(f"constraints.txt does not have {line}, which is installed", file=sys.stderr)
        return 1 if unpinned else 0
    print(HEADER + "\n".join(lines_of(pins, older_pins(pins))))
    return 0


if __name__ == "__main__":
    sys.exit(main())
