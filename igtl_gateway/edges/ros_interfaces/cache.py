"""Cache of compiled packages, stored with the environment that they are compiled for.

A compiled wheel has the packages compiled ahead (``--ahead`` of :mod:`.__main__`); the cache is for all other
installations.

``ROOT/KEY/PACKAGE`` is a compiled package.  The key is a hash of everything that the package depends on, so an existing
package is always up to date.  ROOT is in the environment itself, or in the user's cache folder if the environment is
not writable or its disk is full.

A program with a ROS side compiles all packages before it starts (:func:`make_ready`), so that nothing is compiled while
messages pass.  Any other program compiles a package at its first import.  :mod:`.compiling` does it.
"""

from __future__ import annotations

import hashlib
import json
import os
import sys
import sysconfig
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path

from igtl_gateway.base.extras import missing
from igtl_gateway.convert.interfaces import PACKAGES, definition_folder, interface_files
from igtl_gateway.edges.ros_interfaces.compiling import BUILD, compile_packages
from igtl_gateway.edges.ros_interfaces.progress import write_line

_SOURCES = (BUILD, BUILD.with_name("dispatch.h"))
#: In a checkout, those that are imported are of the installed package, and not these.
_STAND_INS = Path(__file__).parent / "python"
#: A module of the ROS wheels.  Only with them packages are compiled: a sourced ROS 2 has colcon for this.
_WHEEL_MODULE = "ros_wheels_bootstrapper"
#: One of the code generators, to find the folder of the wheels.
_GENERATOR = "rosidl_generator_py"
#: Packages that could not be compiled before the node of this process started: it does not try again while it runs.
_FAILED: set[str] = set()


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


def make_ready() -> None:
    """Compile all packages that are missing, before a node starts; a line names those that cannot be compiled.

    Nothing is compiled with a sourced ROS 2, or without ROS.

    Raises:
        KeyboardInterrupt: it was interrupted, and nothing half-made is left.
    """
    try:
        compile_missing()
    except ImportError as error:
        write_line(f"igtl-gateway: {error}; messages of these packages do not pass.")


def compile_missing() -> None:
    """Compile all packages that are missing.

    Raises:
        ImportError, KeyboardInterrupt: as in :func:`package_path` and :func:`make_ready`.
    """
    packages = missing_packages()
    if not packages:
        return
    try:
        _compile(packages, cache_folders())
    except ImportError:
        _FAILED.update(packages)
        raise


def missing_packages() -> list[str]:
    """Return the packages that are to be compiled here."""
    try:
        is_ros = find_spec(_WHEEL_MODULE) is not None and find_spec("rclpy") is not None
    except ImportError:
        is_ros = False
    if not is_ros:
        return []
    folders = cache_folders()
    return [package for package in PACKAGES if not is_installed(package) and find(package, folders) is None]


def is_installed(package: str) -> bool:
    """Return whether another installation of a package than its stand-in is imported."""
    found = find_spec(package)
    return bool(found and found.origin and Path(found.origin).parents[1].parts[-3:] != _STAND_INS.parts[-3:])


def compiled(package: str, folders: Sequence[Path]) -> Path:
    """Return the folder of the compiled ``package``: an existing one, or a new one.

    Raises:
        ImportError: as in :func:`package_path`.
    """
    if found := find(package, folders):
        return found
    if package in _FAILED:
        raise ImportError(f"{package} is not compiled, for the reason above", name=package)
    return _compile([package], folders) / _place(package)


def find(package: str, folders: Sequence[Path]) -> Path | None:
    """Return the folder of the compiled ``package``; None if it is not compiled yet.

    Raises:
        ImportError: without the ROS wheels.
    """
    wheels = wheels_folder(package)
    if ahead := compiled_ahead(package, wheels, prefix_of(wheels)):
        return ahead
    place = _place(package)
    return next((folder / place for folder in folders if (folder / place).is_dir()), None)


def _compile(packages: Sequence[str], folders: Sequence[Path]) -> Path:
    prefix = prefix_of(wheels_folder(packages[0]))
    return compile_packages({package: _place(package) for package in packages}, folders, prefix)


def _place(package: str) -> Path:
    return Path(_key(package, wheels_folder(package))) / package


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
