"""Packages that are compiled ahead, in a compiled wheel: their users need no compiler, and do not wait for one.

``python -m igtl_gateway.edges.ros_interfaces --ahead FOLDER`` writes them; the wheel has them in ``compiled/``.  They
are used if they fit to the ROS wheels of the environment: ROS 2 keeps binary interfaces within a distribution, so the
first two numbers of each version must be the same; and the wheels must be in the environment of this package, because
the extensions look for the libraries there.  Otherwise they are ignored, and a package is compiled at its first import.
"""

from __future__ import annotations

import json
from pathlib import Path

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
