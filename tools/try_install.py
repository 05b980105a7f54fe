"""Install the files of a release with each installer, run it, uninstall it, and upgrade an older version.

    .venv/bin/python tools/try_install.py dist [--ways pip,uv] [--older COMMIT]

Strategy: a table has the commands of each installer.  Each gets a home directory of its own; after the removal no file
there and in its environment has our name.  An upgrade leaves no file of the version before, and each version must
read, or refuse in one line, what the other one wrote.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent.parent))

from igtl_gateway.base.version import __version__

ROOT = Path(__file__).parents[1]
UV = str(Path(sys.executable).with_name("uv"))
RECORDING = str(ROOT / "fixtures" / "paper-types.mcap")
LONGEST_S = 600
#: The version of an older commit: what pip takes for older than every release.
OLDER = "0.0.1"
CALLS = (
    "--version",
    f"info {RECORDING}",
    f"verify {RECORDING}",
    f"slice {RECORDING} -o slice.mcap --end 0.4",
    f"export {RECORDING} --to csv -o csv",
    "bridge --no-ros --duration 0.1 --listen :0 --record bridge.mcap",
)


@dataclass(frozen=True)
class Way:
    """An installer.

    Attributes:
        install, remove: its commands; ``{wheels}`` and ``{uv}`` are filled in, the home directory is the working one.
        run: what stands in front of the words of a call.
    """

    install: Sequence[str]
    run: str
    remove: Sequence[str]


_PIPX = "{uv} tool run pipx"
WAYS = {
    "pip": Way(
        ("{python} -m venv env", "env/bin/pip install -q --find-links {wheels} igtl-gateway"),
        "env/bin/igtl-gateway",
        ("env/bin/pip uninstall -q -y igtl-gateway",),
    ),
    "uv": Way(
        ("{uv} venv -q env", "{uv} pip install -q --python env/bin/python --find-links {wheels} igtl-gateway"),
        "env/bin/igtl-gateway",
        ("{uv} pip uninstall -q --python env/bin/python igtl-gateway",),
    ),
    "uv tool": Way(
        ("{uv} tool install -q --find-links {wheels} igtl-gateway",),
        ".local/bin/igtl-gateway",
        ("{uv} tool uninstall -q igtl-gateway",),
    ),
    "uvx": Way((), "{uv} tool run -q --find-links {wheels} igtl-gateway", ()),
    "pipx": Way(
        (f"{_PIPX} install -q igtl-gateway --pip-args=--find-links={{wheels}}",),
        ".local/bin/igtl-gateway",
        (f"{_PIPX} uninstall igtl-gateway",),
    ),
}


class Place:
    """A home directory, and what runs in it."""

    def __init__(self, folder: Path, wheels: Path) -> None:
        self.folder, self.wheels = folder, wheels
        caches = {"UV_CACHE_DIR": "uv", "PIP_CACHE_DIR": "pip"}
        usual = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
        hidden = ("PYTHONPATH", "VIRTUAL_ENV", "XDG_")
        self.environment: Mapping[str, str] = {
            **{name: value for name, value in os.environ.items() if not name.startswith(hidden)},
            **{name: os.environ.get(name, str(usual / own)) for name, own in caches.items()},  # not part of the result
            "HOME": str(folder),
            "PATH": f"{folder}/.local/bin:{os.environ['PATH']}",
        }

    def run(self, command: str, words: str = "", *, within: str = "") -> subprocess.CompletedProcess[str]:
        """Run a command of a table, and ``words`` behind it; ``within``: a folder below the home directory."""
        filled = command.format(uv=UV, python=sys.executable, wheels=self.wheels).split()
        if "/" in filled[0] and not filled[0].startswith("/"):
            filled[0] = str(self.folder / filled[0])
        return subprocess.run(
            [*filled, *words.split()],
            cwd=self.folder / within,
            env=self.environment,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            timeout=LONGEST_S,
            check=False,
        )

    def ours(self) -> set[Path]:
        """The files and folders with our name, except what the calls wrote and the empty locks of pipx."""
        found = (path for path in self.folder.rglob("*") if "igtl" in path.name.lower() and path.suffix != ".lock")
        return {path.relative_to(self.folder) for path in found if "work" not in path.relative_to(self.folder).parts}


def failure(done: subprocess.CompletedProcess[str]) -> str:
    """How a command failed, or ``""``."""
    last = (done.stderr or done.stdout).strip().splitlines()[-1:]
    return f"{' '.join(map(str, done.args))}: exit code {done.returncode} {last}" if done.returncode else ""


def faults_of(way: Way, wheels: Path) -> Iterator[str]:
    """Install, run each call, remove; what fails, and what stays."""
    with tempfile.TemporaryDirectory() as name:
        place = Place(Path(name), wheels)
        (place.folder / "work").mkdir()
        for command in way.install:
            if text := failure(place.run(command)):
                yield text
                return
        for words in CALLS:
            yield from filter(None, [failure(place.run(way.run, words, within="work"))])
        for command in way.remove:
            yield from filter(None, [failure(place.run(command))])
        yield from (f"{path} stays" for path in sorted(place.ours()))


def older_wheel(commit: str, folder: Path) -> Path:
    """Write the pure wheel of a commit, with an older version."""
    source, archive = folder / "source", folder / "source.tar"
    source.mkdir(parents=True)
    subprocess.run(["git", "archive", "-o", str(archive), commit], cwd=ROOT, check=True)
    subprocess.run(["tar", "-xf", str(archive)], cwd=source, check=True)
    path = source / "igtl_gateway" / "base" / "version.py"
    path.write_text(f'__version__ = "{OLDER}"\n', "utf-8")
    command = [sys.executable, "-m", "build", "--no-isolation", "--wheel", "--outdir", str(folder), str(source)]
    subprocess.run(command, env=os.environ | {"IGTL_GATEWAY_PURE": "1"}, capture_output=True, check=True)
    return next(folder.glob(f"igtl_gateway-{OLDER}-*.whl"))


def faults_of_upgrade(older: Path, wheels: Path) -> Iterator[str]:
    """Install an older wheel, record, upgrade, read; and with the older one read what the newer one wrote.

    The recording that they slice is one of the older version: rules of later ones that it states are not known to it.
    """
    recording = older.parent / "source" / Path(RECORDING).relative_to(ROOT)
    with tempfile.TemporaryDirectory() as name:
        place = Place(Path(name), wheels)
        (place.folder / "work").mkdir()
        for env in ("env", "old"):
            place.run(f"{{uv}} venv -q --seed {env}")
            yield from filter(None, [failure(place.run(f"{env}/bin/pip install -q {older}"))])
        yield from _read(place, "old", f"slice {recording} -o before.mcap --end 0.4", "verify before.mcap")
        upgrade = "env/bin/pip install -q --upgrade --find-links {wheels} igtl-gateway"
        yield from filter(None, [failure(place.run(upgrade))])
        found = place.run("env/bin/igtl-gateway", "--version").stdout
        if f"igtl-gateway {__version__}" not in found:
            yield f"after the upgrade: found {found.splitlines()[:1]}, expected version {__version__}"
        yield from _not_recorded(place)
        written = f"slice {recording} -o after.mcap --end 0.4"
        yield from _read(place, "env", "verify before.mcap", "info before.mcap", written, "diff before.mcap after.mcap")
        yield from _read(place, "old", "info after.mcap", "verify after.mcap")


def _read(place: Place, env: str, *calls: str) -> Iterator[str]:
    for words in calls:
        yield from filter(None, [failure(place.run(f"{env}/bin/igtl-gateway", words, within="work"))])


def _not_recorded(place: Place) -> Iterator[str]:
    """Files of the package that the upgraded distribution does not have."""
    program = (
        "import importlib.metadata as m; d = m.distribution('igtl-gateway'); "
        "print(*{str(d.locate_file(f).resolve()) for f in d.files}, sep='\\n')"
    )
    listed = subprocess.run(
        [place.folder / "env" / "bin" / "python", "-c", program], capture_output=True, text=True, check=True
    ).stdout.splitlines()
    (package,) = (place.folder / "env" / "lib").glob("python*/site-packages/igtl_gateway")
    for path in package.rglob("*"):
        if path.is_file() and path.suffix != ".pyc" and str(path.resolve()) not in listed:
            yield f"{path.relative_to(package)} is of the version before"


def main(args: Sequence[str] | None = None) -> int:
    """Try all installers; 1 if something fails or stays."""
    parser = argparse.ArgumentParser(description="Install a release with each installer, and remove it.")
    parser.add_argument("wheels", type=Path, help="the folder with the files of the release")
    parser.add_argument("--ways", default=",".join(WAYS), help="installers to try (default: all)")
    parser.add_argument("--older", metavar="COMMIT", help="try the upgrade from the wheel of this commit, too")
    options = parser.parse_args(args)
    wheels, found = options.wheels.resolve(), []
    for name in filter(None, options.ways.split(",")):
        found += _printed(name, faults_of(WAYS[name], wheels))
    if options.older:
        with tempfile.TemporaryDirectory() as folder:
            older = older_wheel(options.older, Path(folder))
            found += _printed(f"upgrade from {options.older}", faults_of_upgrade(older, wheels))
    return int(bool(found))


def _printed(name: str, faults: Iterator[str]) -> list[str]:
    wrong = list(faults)
    print(f"{name}: {len(wrong)} wrong", *wrong, sep="\n  ", flush=True)
    return wrong


if __name__ == "__main__":
    sys.exit(main())
