"""Where the definitions of the packages are: ``FOLDER/msg/NAME.msg`` and ``FOLDER/srv/NAME.srv``."""

from __future__ import annotations

from pathlib import Path

#: The packages with a stand-in in ``python/``.
PACKAGES = ("igtl_msgs", "tf2_msgs", "foxglove_msgs")

_INSTALLED = Path(__file__).parent / "definitions"
# In the source tree igtl_msgs is an ordinary ROS package; the wheel has a copy of it beside the others.
_SOURCE_TREE = Path(__file__).parents[2] / "ros2"


def folder_of(package: str) -> Path:
    """The folder of ``package``, one of :data:`PACKAGES`."""
    installed = _INSTALLED / package
    return installed if installed.is_dir() else _SOURCE_TREE / package


def interface_files(package: str) -> list[Path]:
    """Its ``.msg`` and ``.srv`` files, messages first, by name."""
    folder = folder_of(package)
    return [*sorted(folder.glob("msg/*.msg")), *sorted(folder.glob("srv/*.srv"))]
