"""The interface definitions of ROS messages that no wheel has: their folders and files.

Those of igtl_msgs lie in ``ros2/`` of the source tree, and here in a wheel.
"""

from __future__ import annotations

from pathlib import Path

#: The packages with a stand-in in ``python/``.
PACKAGES = ("igtl_msgs", "tf2_msgs", "foxglove_msgs", "rosbag2_interfaces", "crtk_msgs")

#: Folders with ``PACKAGE/msg/NAME.msg``.  In the source tree igtl_msgs is an ordinary ROS package in ros2/; in the
#: wheel it is with the others.
SHARES = (Path(__file__).parent, Path(__file__).parents[3] / "ros2")


def definition_folder(package: str) -> Path:
    """Return the folder of ``package``, one of :data:`PACKAGES`."""
    return next(share / package for share in SHARES if (share / package).is_dir())


def interface_files(package: str) -> list[Path]:
    """Return the ``.msg`` and ``.srv`` files of ``package``, messages first, sorted by name."""
    folder = definition_folder(package)
    return [*sorted(folder.glob("msg/*.msg")), *sorted(folder.glob("srv/*.srv"))]
