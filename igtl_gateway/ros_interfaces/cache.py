"""Compiled packages, kept with the environment that they were compiled for.

``ROOT/KEY/PACKAGE`` is a compiled package.  The key is a hash of all that goes into it, so it is never out of date
and never has to be checked: what is there is right.  ROOT is in the environment itself or, where that may not be
written, in the user's cache folder.

Many processes may import a package for the first time at once: one compiles under a lock, the others wait for it.
It compiles beside the place where the package belongs and renames it at the end, so a package that can be seen is
complete, whatever happens to the process.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import subprocess
import sys
import sysconfig
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path

from igtl_gateway.extras import missing
from igtl_gateway.ros_interfaces.definitions import definition_folder, interface_files

_BUILD = Path(__file__).with_name("build.py")
_SOURCES = (_BUILD, _BUILD.with_name("dispatch.h"))
#: Only the ROS wheels have it, and only with them do we compile: a sourced ROS 2 has colcon for that.
_MARK_OF_THE_WHEELS = "ros_wheels_bootstrapper"
#: One of the wheels without which nothing can be compiled.
_A_GENERATOR = "rosidl_generator_py"


def package_path(package: str) -> list[str]:
    """The ``__path__`` of ``package``, which is compiled first where it has to be.

    Raises:
        ImportError: this cannot be done here; one sentence says why.
    """
    return [str(compiled(package, cache_folders()))]


def cache_folders() -> list[Path]:
    """Where compiled packages may be, the preferred place first."""
    of_user = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return [Path(sys.prefix) / "share" / "igtl_gateway" / "ros_interfaces", of_user / "igtl_gateway" / "ros_interfaces"]


def compiled(package: str, folders: Sequence[Path]) -> Path:
    """The folder of the compiled ``package``: found in one of ``folders``, or else made in the first that lets us.

    Raises:
        ImportError: as in :func:`package_path`.
    """
    wheels = _wheels(package)
    wanted = Path(_key(package, wheels)) / package
    found = next((folder / wanted for folder in folders if (folder / wanted).is_dir()), None)
    if found:
        return found
    _check_compiler(package)
    root = next((folder for folder in folders if _is_writable(folder)), None)
    if root is None:
        places = " nor ".join(map(str, folders))
        raise ImportError(f"{package} has to be compiled once, but neither {places} can be written", name=package)
    with _locked(root / f"{package}.lock") as lock:
        if not (root / wanted).is_dir():
            # One at a time by the lock, so what lies there is left over from a process that was killed.
            work = root / f"{package}.work"
            shutil.rmtree(work, ignore_errors=True)
            _compile(package, _prefix(wheels), work, lock)
            (root / wanted).parent.mkdir(exist_ok=True)
            (work / "result" / package).rename(root / wanted)
            shutil.rmtree(work)
    return root / wanted


def _wheels(package: str) -> Path:
    """The folder of Python packages that the ROS wheels are in; ImportError without them."""
    generator = find_spec(_A_GENERATOR)
    if find_spec(_MARK_OF_THE_WHEELS) and generator and generator.origin:
        return Path(generator.origin).parents[1]
    if find_spec("rclpy") is None:
        raise ImportError(f"{package} needs ROS 2: {missing('rclpy')}", name=package)
    if package == "igtl_msgs":
        advice = f"build {definition_folder(package)} with colcon and source the workspace"
    else:
        advice = f"install ros-{os.environ.get('ROS_DISTRO', 'DISTRO')}-{package.replace('_', '-')}"
    raise ImportError(f"{package} is not part of this ROS 2 installation: {advice}", name=package)


def _prefix(wheels: Path) -> Path:
    """The folder below which they have put ``share``, ``include`` and ``lib``."""
    return next(folder for folder in wheels.parents if (folder / "share" / _A_GENERATOR).is_dir())


def _key(package: str, wheels: Path) -> str:
    """A name that changes with all that the compiled package depends on."""
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
            f"{package} has to be compiled once, but there is no {names} (Debian and Ubuntu: apt install {advice})",
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
    """Alone among all processes; the kernel opens the lock when nobody holds the descriptor any more."""
    import fcntl  # not on Windows, where no wheel of ROS brings us here

    with path.open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield file.fileno()


def _compile(package: str, prefix: Path, work: Path, lock: int) -> None:
    """Compile into ``work/result/PACKAGE``, in a process of its own: the generators print and keep global state.

    That process holds the lock, too: should we be killed, the next one must not work in the same folder beside it.
    """
    sys.stderr.write(f"{package}: compiling it, once for this environment ...\n")
    # -P: the folder of build.py is not to be searched for modules
    command: list[str | Path] = [sys.executable, "-P", _BUILD, package, definition_folder(package), prefix, work]
    run = subprocess.run(
        command,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        check=False,
        pass_fds=[lock],
    )
    if run.returncode:
        output = run.stdout.decode(errors="replace").strip()
        reason = output.rpartition("\n")[2] or f"exit code {run.returncode}"
        error = ImportError(f"{package} could not be compiled: {reason}", name=package)
        error.add_note(output)
        raise error
