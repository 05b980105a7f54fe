"""A Python in which ROS is not installed: for programs that have to do without.  It is on PYTHONPATH of such a test."""

from __future__ import annotations

import re
import sys
from importlib.abc import MetaPathFinder
from typing import Any

_OF_ROS = re.compile(r"rclpy|rpyutils|rcl_\w+|rosidl_\w+|ament_\w+|rmw_\w+|\w+_msgs|\w+_interfaces|std_srvs")


class WithoutRos(MetaPathFinder):
    """Finds nothing, and ends the search for modules of ROS."""

    def find_spec(self, name: str, path: Any = None, target: Any = None) -> None:
        if _OF_ROS.fullmatch(name):
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)


sys.meta_path.insert(0, WithoutRos())
