"""Cache of compiled packages, stored with the environment that they are compiled for.

A compiled wheel has the packages compiled ahead (:mod:`.ahead`); the cache is for all other installations.

``ROOT/KEY/PACKAGE`` is a compiled package.  The key is a hash of everything that the package depends on, so an existing
package is always up to date.  ROOT is in the environment itself, or in the user's cache folder if the environment is
not writable.

Many processes can import a package for the first time at once: one compiles it under a lock, and the others wait.
It compiles in a work folder and renames the result at the end, so an existing package is complete, even if the process
is killed.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import subprocess
import sys
import sysconfig
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path

from igtl_gateway.base.extras import missing
from igtl_gateway.base.versions import add_note, python_command
from igtl_gateway.convert.interfaces import definition_folder, interface_files

_BUILD = Path(__file__).with_name("build.py")
_SOURCES = (_BUILD, _BUILD.with_name("dispatch.h"))
#: A module of the ROS wheels.  Only with them packages are compiled: a sourced ROS 2 has colcon for this.
_WHEEL_MODULE = "ros_wheels_bootstrapper"
#: One of the code generators, to find the folder of the wheels.
_GENERATOR = "rosidl_generator_py"


#: Packages that are compiled ahead, in a compiled wheel: their users need no compiler, and do not wait for one.
#: ``python -m igtl_gateway.edges.ros_interfaces --ahead FOLDER`` writes them.  They are used if they fit to the ROS
#: wheels of the environment: ROS 2 keeps binary interfaces within a distribution, so the first two numbers of each
#: version must be the same; and the wheels must be in the environment of this package, because the extensions look for
#: the libraries there.  Otherwise they are ignored, and a package is compiled at its first import.
COMPILED = Path(__file__).with_name("compiled")
VERSIONS = "versions.json"
#: From ``PREFIX/lib/python3.11/site-packages/igtl_gateway/edges/ros_interfaces/compiled/PACKAGE`` to
#: ``PREFIX/lib``.
LIBRARIES = "/".join([".."] * 7)


def compiled_ahead(package: str, wheels: Path, prefix: Path, folder: Path = COMPILED) -> Path | None:
    """Return the folder of the compiled ``package``; None if there is none that fits.

    Args:
        package: name of the package.
        wheels: folder with the Python packages of the ROS wheels.
        prefix: folder with ``share``, ``include`` and ``lib`` of the wheels.
        folder: with the packages that were compiled ahead.
    """
    found = folder / package
    if not found.is_dir() or (found / LIBRARIES).resolve() != (prefix / "lib").resolve():
        return None
    expected = json.loads((folder / VERSIONS).read_text("utf-8"))
    installed = ros_versions(wheels)
    return found if all(installed.get(name) in {None, version} for name, version in expected.items()) else None


def ros_versions(wheels: Path) -> dict[str, str]:
    """Return name → first two numbers of the version, for all ROS wheels in a folder with Python packages."""
    versions = {}
    for path in sorted(wheels.glob("ros_*.dist-info")):
        name, _, version = path.name.removesuffix(".dist-info").rpartition("-")
        versions[name] = ".".join(version.split(".")[:2])
    return versions


def package_path(package: str) -> list[str]:
    """Return the ``__path__`` of ``package``; compile it first if necessary.

    Raises:
        ImportError: the package cannot be compiled; the text is one sentence with the reason.
    """
    return [str(compiled(package, cache_folders()))]


def cache_folders() -> list[Path]:
    """Return the folders for compiled packages, the preferred one first."""
    user_cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return [
        Path(sys.prefix) / "share" / "igtl_gateway" / "ros_interfaces",
        user_cache / "igtl_gateway" / "ros_interfaces",
    ]


def compiled(package: str, folders: Sequence[Path]) -> Path:
    """Return the folder of the compiled ``package``: an existing one, or a new one in the first writable folder.

    Raises:
        ImportError: as in :func:`package_path`.
    """
    wheels = wheels_folder(package)
    if ahead := compiled_ahead(package, wheels, prefix_of(wheels)):
        return ahead
    path = Path(_key(package, wheels)) / package
    found = next((folder / path for folder in folders if (folder / path).is_dir()), None)
    if found:
        return found
    _check_compiler(package)
    root = next((folder for folder in folders if _is_writable(folder)), None)
    if root is None:
        places = " nor ".join(map(str, folders))
        raise ImportError(f"{package} must be compiled once, but neither {places} is writable", name=package)
    with _locked(root / f"{package}.lock") as lock:
        if not (root / path).is_dir():
            # The lock excludes other processes, so an existing work folder is from a process that was killed.
            work = root / f"{package}.work"
            shutil.rmtree(work, ignore_errors=True)
            compile_package(package, prefix_of(wheels), work, pass_fds=[lock])
            (root / path).parent.mkdir(exist_ok=True)
            (work / "result" / package).rename(root / path)
            shutil.rmtree(work)
    return root / path


def wheels_folder(package: str) -> Path:
    """Return the folder with the Python packages of the ROS wheels.  Raises ImportError without them."""
    generator = find_spec(_GENERATOR)
    if find_spec(_WHEEL_MODULE) and generator and generator.origin:
        return Path(generator.origin).parents[1]
    if find_spec("rclpy") is None:
        raise ImportError(f"{package} needs ROS 2: {missing('rclpy')}", name=package)
    if package == "igtl_msgs":
        advice = f"build {definition_folder(package)} with colcon and source the workspace"
    else:
        advice = f"install ros-{os.environ.get('ROS_DISTRO', 'DISTRO')}-{package.replace('_', '-')}"
    raise ImportError(f"{package} is not part of this ROS 2 installation: {advice}", name=package)


def prefix_of(wheels: Path) -> Path:
    """Return the folder with ``share``, ``include`` and ``lib`` of the wheels."""
    return next(folder for folder in wheels.parents if (folder / "share" / _GENERATOR).is_dir())


def _key(package: str, wheels: Path) -> str:
    """Return a hash of everything that the compiled package depends on."""
    versions = sorted(path.name for kind in ("ros_*", "numpy-*") for path in wheels.glob(f"{kind}.dist-info"))
    parts: list[object] = [wheels, sys.version, sysconfig.get_config_var("EXT_SUFFIX"), versions]
    for path in [*_SOURCES, *interface_files(package)]:
        parts += [path.name, path.read_bytes()]
    return hashlib.sha256(repr(parts).encode()).hexdigest()[:16]


def _check_compiler(package: str) -> None:
    python = f"python{sys.version_info.major}.{sys.version_info.minor}"
    missing = [(name, "g++") for name in ("gcc", "g++") if not shutil.which(name)]
    if not (Path(sysconfig.get_path("include")) / "Python.h").is_file():
        missing.append(("Python.h", f"{python}-dev"))
    if missing:
        names = " and ".join(name for name, _ in missing)
        advice = " ".join(dict.fromkeys(debian for _, debian in missing))
        raise ImportError(
            f"{package} must be compiled once, but there is no {names} (Debian and Ubuntu: apt install {advice})",
            name=package,
        )


def _is_writable(folder: Path) -> bool:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return False
    return os.access(folder, os.W_OK)


@contextmanager
def _locked(path: Path) -> Iterator[int]:
    """Lock the file against other processes; the kernel releases the lock when the last descriptor is closed."""
    with path.open("w") as file:
        if sys.platform != "win32":  # for which there are no ROS wheels
            import fcntl

            fcntl.flock(file, fcntl.LOCK_EX)
        yield file.fileno()


def compile_package(
    package: str, prefix: Path, work: Path, libraries: str = "", pass_fds: Collection[int] = ()
) -> None:
    """Compile to ``work/result/PACKAGE`` in a separate process: the generators print and have global state.

    Args:
        package: name of the package.
        prefix: folder with ``share``, ``include`` and ``lib`` of the wheels.
        work: folder for all files; it must not exist.
        libraries: as in :mod:`.build`.
        pass_fds: what the process inherits.  With the lock, no other process may use the same work folder if this
            one is killed.

    Raises:
        ImportError: as in :func:`package_path`; a note has the output of the process.
    """
    sys.stderr.write(f"{package}: compiling, once for this environment ...\n")
    # -P: modules must not be imported from the folder of build.py
    command: list[str | Path] = [*python_command(_BUILD), package, definition_folder(package), prefix, work]
    if libraries:
        command.append(libraries)
    run = subprocess.run(
        command,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        check=False,
        pass_fds=pass_fds,
    )
    if run.returncode:
        output = run.stdout.decode(errors="replace").strip()
        reason = output.rpartition("\n")[2] or f"exit code {run.returncode}"
        error = ImportError(f"{package} could not be compiled: {reason}", name=package)
        add_note(error, output)
        raise error
