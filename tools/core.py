"""The core's tests on other Pythons: codecs, conversions, gateway, recordings, replay and the native passage.

    python -m tools.core [--ros] [PYTHON …]        make core [PYTHONS="python3.12 python3.13"]

Without names it takes each of python3.10 to python3.14 that is present, on the path or of pyenv.  Each has an
environment of its own in out/core, with the versions of constraints.txt, and its own compiled C parts.

``--ros`` adds the extra ``ros`` and the tests of the ROS edge.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from hatch_build import SOURCES, compiled
from igtl_gateway.base.versions import tomllib

ROOT = Path(__file__).parents[1]
WORK = ROOT / "out" / "core"
NAMES = ("python3.10", "python3.11", "python3.12", "python3.13", "python3.14")
TESTS = tuple(f"tests/{name}" for name in ("wire", "convert", "gateway", "record/sessionfile", "replay", "native"))
ROS_TESTS = ("tests/edges/ros",)
#: What these tests need of the extra ``dev``.
TEST_NEEDS = {"hypothesis", "mcap-ros2-support", "packaging", "pyigtl", "pymcap-cli", "pytest", "pytest-xdist", "ruff"}
WORKERS = "2"
_COMPILE = "from tools.core import compile_c_parts; compile_c_parts()"
_OF_ROS_WHEELS = ("LD_LIBRARY_PATH", "_ROS_WHEELS_BOOTSTRAP_COMPLETE")


def present(name: str) -> str | None:
    """The path of a Python such as ``python3.12``: on the path, else the newest of pyenv.  A path is itself."""
    if os.sep in name:
        return shutil.which(name)
    versions = Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv"), "versions")
    of_pyenv = sorted(
        map(str, versions.glob(f"{name.removeprefix('python')}.*/bin/python")),
        key=lambda path: int(re.findall(r"\d+", path.split(os.sep)[-3])[2]),
        reverse=True,
    )
    return next((path for path in (shutil.which(name), *of_pyenv) if path and runs(path)), None)


def runs(python: str) -> bool:
    """Whether a program is a Python: pyenv has one on the path for each version, also for those that are not active."""
    return subprocess.run([python, "-S", "-c", ""], capture_output=True, check=False).returncode == 0


def requirements(*, ros: bool) -> list[str]:
    """What pip installs for these tests."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    extras = project["optional-dependencies"]
    dev = [need for need in extras["dev"] if re.split(r"[^\w-]", need)[0] in TEST_NEEDS]
    return [*project["dependencies"], *extras["seal"], *dev, *(extras["ros"] if ros else ()), "hatchling"]


def compile_c_parts() -> None:
    """Compile the C parts for this Python, beside their sources; Pythons have different names for theirs."""
    for source in SOURCES:
        if compiled(ROOT, source, ROOT) is None:
            print(f"{source} is not compiled: its tests are skipped", file=sys.stderr)


def run_tests(python: str, *, ros: bool) -> bool:
    """Install and run the tests with one Python; returns whether they pass."""
    version = subprocess.run([python, "--version"], capture_output=True, text=True, check=True).stdout.split()[1]
    print(f"== Python {version}", flush=True)
    folder = WORK / version
    own = folder / "bin" / "python"
    if not own.is_file():
        subprocess.run([python, "-m", "venv", folder], check=True)
    install: list[str | Path] = [
        own,
        "-m",
        "pip",
        "install",
        "-q",
        "--disable-pip-version-check",
        "-c",
        ROOT / "constraints.txt",
    ]
    subprocess.run([*install, *requirements(ros=ros)], check=True)
    # The ROS wheels restart Python once with the path of their libraries: that of this Python is of no use to another.
    inherited = {key: value for key, value in os.environ.items() if key not in _OF_ROS_WHEELS}
    environment = inherited | {"PYTHONPATH": os.pathsep.join((str(ROOT), str(ROOT / "lab")))}
    subprocess.run([own, "-c", _COMPILE], cwd=ROOT, env=environment, check=True)
    tests = (*TESTS, *(ROS_TESTS if ros else ()))
    command = [own, "-m", "pytest", "-q", "-n", WORKERS, "-m", "not slow", "-p", "no:cacheprovider", *tests]
    return subprocess.run(command, cwd=ROOT, env=environment, check=False).returncode == 0


def main(args: Sequence[str] | None = None) -> int:
    """Run the tests with each Python; 1 if one of them fails, 2 if there is no Python."""
    parser = argparse.ArgumentParser(description="Run the core's tests on other Pythons.")
    parser.add_argument("pythons", nargs="*", metavar="PYTHON", help="interpreters (default: those present)")
    parser.add_argument("--ros", action="store_true", help="with ROS 2 and the tests of the ROS edge")
    options = parser.parse_args(args)
    found = {name: present(name) for name in options.pythons or NAMES}
    pythons = [path for path in found.values() if path]
    if not pythons or (options.pythons and None in found.values()):
        wanted = [name for name, path in found.items() if path is None]
        print(f"found no {', '.join(wanted)} on the path and of pyenv, expected it", file=sys.stderr)
        return 2
    failed = [python for python in pythons if not run_tests(python, ros=options.ros)]
    for python in failed:
        print(f"failed: {python}", file=sys.stderr)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
