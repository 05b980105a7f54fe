"""Exact pins of everything that the extras install, read off the environment that runs this.

    .venv/bin/python tools/constraints.py > constraints.txt     write the pins again
    .venv/bin/python tools/constraints.py --check               is everything here pinned as it is installed?

Strategy: walk the requirements from our own package with all extras and take the version that is installed.
Walking, rather than listing the environment, leaves out what came by other ways (pip itself, and the Python
packages inside the ROS wheels, whose names belong to other projects on the package index).
"""

from __future__ import annotations

import sys
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

#: The extras that users install; ``dev`` is for developers, and ``lab`` is a distribution of the same release.
EXTRAS = "ros,view,video,nifti,plot,pcap,arrow,pandas,lerobot,seal,cohort,zenoh"
PROJECT = Requirement(f"igtl-gateway[{EXTRAS},lab,dev]")
CONSTRAINTS = Path(__file__).parent.parent / "constraints.txt"
HEADER = f"""\
# What the extras [{EXTRAS},lab,dev] install, with all that they need;
# CPython 3.11, Linux x86_64.
# To renew: make a virtual environment without this file, and in it
#   pip install -e '.[{EXTRAS},lab,dev]' -e ./lab
#   python tools/constraints.py > constraints.txt
"""


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


def differences(pins: dict[str, str], constraints: str) -> list[str]:
    """One line for each installed package that the text of ``constraints`` does not pin as it is."""
    lines = set(constraints.splitlines())
    return [f"{name}=={version}" for name, version in pins.items() if f"{name}=={version}" not in lines]


def main() -> int:
    """Print the pins, or with ``--check`` compare; 1 where they differ."""
    pins = installed_pins(PROJECT)
    if sys.argv[1:] == ["--check"]:
        unpinned = differences(pins, CONSTRAINTS.read_text(encoding="utf-8"))
        for line in unpinned:
            print(f"constraints.txt does not have {line}, which is installed", file=sys.stderr)
        return 1 if unpinned else 0
    print(HEADER + "\n".join(f"{name}=={version}" for name, version in pins.items()))
    return 0


if __name__ == "__main__":
    sys.exit(main())
