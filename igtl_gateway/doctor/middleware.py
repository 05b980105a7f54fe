"""What installed versions of the ROS middleware lose of the messages that pass here: one table, a row for each loss.

The versions are those of the package manifests in ``share``, of a sourced ROS 2 and of the wheels alike.  A row has the
issue or change that describes the loss; ``edges/ros/distributions.py`` has what was read of its source.
"""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

Version = tuple[int, ...]

_VERSION = re.compile(r"<version>\s*([0-9]{1,9}\.[0-9]{1,9}\.[0-9]{1,9})\s*</version>")


@dataclass(frozen=True, slots=True)
class Loss:
    """A loss of some versions of a package.

    Attributes:
        package: of ROS.
        versions: ranges, each of the first and the last version with the loss.
        source: the change that repairs it.
        effect: what is lost, in words.
    """

    package: str
    versions: tuple[tuple[Version, Version], ...]
    source: str
    effect: str

    def concerns(self, version: Version) -> bool:
        """Whether a version has this loss."""
        return any(first <= version <= last for first, last in self.versions)

    @property
    def versions_text(self) -> str:
        """The versions in words: ``9.4.6 to 9.4.8``."""
        return ", ".join(f"{_text(first)} to {_text(last)}" for first, last in self.versions)


#: Since 9.4.6 a message with uint8[] goes over a channel of its own if all subscribers know it (rosidl::Buffer).  What
#: the bridge publishes is serialised and does not.  Lyrical: no changelog up to 9.4.10 names the first change.
LOSSES = (
    Loss(
        "rmw_fastrtps_cpp",
        (((9, 4, 6), (9, 4, 10)),),
        "ros2/rmw_fastrtps#881",
        "messages with uint8[] (pictures, clouds) from ROS nodes do not reach the bridge",
    ),
    Loss(
        "rmw_fastrtps_cpp",
        (((9, 4, 6), (9, 4, 8)), ((9, 5, 0), (9, 5, 1))),
        "ros2/rmw_fastrtps#898",
        "late joiners do not get latched messages with uint8[] from ROS nodes",
    ),
    Loss(
        "rmw_fastrtps_cpp",
        (((9, 4, 6), (9, 4, 8)), ((9, 5, 0), (9, 5, 1))),
        "ros2/rmw_fastrtps#900",
        "a message with uint8[] may wait in a ROS node with several threads until the next one comes",
    ),
)
PACKAGES = tuple(dict.fromkeys(loss.package for loss in LOSSES))


def prefixes(environ: Mapping[str, str] = os.environ) -> tuple[Path, ...]:
    """Return the folders with ``share``: of the sourced ROS 2, then that of the wheels."""
    sourced = environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)
    return tuple(Path(folder) for folder in (*sourced, sys.prefix) if folder)


def installed(folders: Iterable[Path]) -> dict[str, Version]:
    """Return package → version of the packages of the table that are installed; the first folder counts."""
    found: dict[str, Version] = {}
    for folder in folders:
        for package in PACKAGES:
            if package not in found and (version := _version(folder / "share" / package / "package.xml")):
                found[package] = version
    return found


def losses_of(versions: Mapping[str, Version]) -> list[Loss]:
    """Return the losses of installed versions, in the order of the table."""
    return [loss for loss in LOSSES if loss.package in versions and loss.concerns(versions[loss.package])]


def versions_text(versions: Mapping[str, Version]) -> str:
    """Return packages and versions in words."""
    return ", ".join(f"{package} {_text(version)}" for package, version in versions.items())


def _version(manifest: Path) -> Version:
    """Return the version of a package; empty without a manifest."""
    try:
        found = _VERSION.search(manifest.read_text("utf-8", "replace"))
    except OSError:
        return ()
    return tuple(map(int, found[1].split("."))) if found else ()


def _text(version: Version) -> str:
    return ".".join(map(str, version))
