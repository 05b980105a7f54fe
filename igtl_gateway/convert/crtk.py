"""The names of CRTK, the Collaborative Robotics Toolkit: what a topic or a device of an arm carries.

A stream has the name ``<namespace>/<name>``, in ROS with a slash before it: ``PSM1/measured_cp``, and below sub-devices
``PSM1/jaw/measured_js``, ``PSM1/local/measured_cp``.  The last level has a row in the table.  The OpenIGTLink types are
those of sawOpenIGTLink, whose lengths are metres.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from enum import Enum

#: Namespaces of the gateway itself: a device there is none of a robot.
_OWN = "igtl/"
_PATH = re.compile(r"[A-Za-z_]\w*(/[A-Za-z_]\w*)+", re.ASCII)

#: Words of ``state_command``.
STATE_COMMANDS = ("enable", "disable", "pause", "resume", "home", "unhome")


class Motion(Enum):
    """What a command asks for; the value is for documents."""

    POSE = "pose of the tool"
    JOINTS = "positions of all joints"
    JOINT_STEPS = "changes of the positions of all joints"
    WRENCH = "force and torque"
    STATE = "operating state"
    STOP = "no motion"


@dataclass(frozen=True, slots=True)
class CrtkName:
    """One name of CRTK.

    Attributes:
        name: last level of topic and device.
        ros_type: type in ROS.
        igtl_type: type in OpenIGTLink.
        kind: row of the conversion table from OpenIGTLink to ROS.
        motion: what it asks for, if it is a command; None for a state of the robot.
        streamed: a command that the robot follows at once, so that its speed is limited; else it is a goal.
    """

    name: str
    ros_type: str
    igtl_type: str
    kind: str
    motion: Motion | None = None
    streamed: bool = False


_POSE, _JOINTS = "geometry_msgs/msg/PoseStamped", "sensor_msgs/msg/JointState"
_TWIST, _WRENCH = "geometry_msgs/msg/TwistStamped", "geometry_msgs/msg/WrenchStamped"
_TEXT = "std_msgs/msg/String"

NAMES: tuple[CrtkName, ...] = (
    *(CrtkName(f"{level}_js", _JOINTS, "NDARRAY", "joint_state") for level in ("measured", "setpoint", "goal")),
    *(CrtkName(f"{level}_cp", _POSE, "TRANSFORM", "pose") for level in ("measured", "setpoint", "goal")),
    *(CrtkName(f"{level}_cv", _TWIST, "SENSOR", "twist") for level in ("measured", "setpoint")),
    *(CrtkName(f"{level}_cf", _WRENCH, "SENSOR", "wrench") for level in ("measured", "setpoint")),
    CrtkName("operating_state", "crtk_msgs/msg/OperatingState", "STRING", "operating_state"),
    *(CrtkName(level, _TEXT, "STRING", "string") for level in ("error", "warning", "status")),
    *(
        CrtkName(button, "sensor_msgs/msg/Joy", "SENSOR", "buttons")
        for button in ("button", "clutch", "camera", "operator_present", "cam_plus", "cam_minus", "coag", "bicoag")
    ),
    CrtkName("servo_cp", _POSE, "TRANSFORM", "pose", Motion.POSE, streamed=True),
    CrtkName("move_cp", _POSE, "TRANSFORM", "pose", Motion.POSE),
    CrtkName("servo_jp", _JOINTS, "SENSOR", "joint_command", Motion.JOINTS, streamed=True),
    CrtkName("move_jp", _JOINTS, "SENSOR", "joint_command", Motion.JOINTS),
    CrtkName("servo_jr", _JOINTS, "SENSOR", "joint_command", Motion.JOINT_STEPS, streamed=True),
    CrtkName("move_jr", _JOINTS, "SENSOR", "joint_command", Motion.JOINT_STEPS),
    CrtkName("servo_cf", _WRENCH, "SENSOR", "wrench", Motion.WRENCH, streamed=True),
    CrtkName("state_command", "crtk_msgs/msg/StringStamped", "STRING", "string_stamped", Motion.STATE),
    CrtkName("hold", "std_msgs/msg/Empty", "STRING", "empty", Motion.STOP),
    CrtkName("free", "std_msgs/msg/Empty", "STRING", "empty", Motion.STOP),
)

BY_NAME = {row.name: row for row in NAMES}


def row_of(path: str) -> CrtkName | None:
    """Return the row of a device such as ``PSM1/measured_cp``; None if it is not one of CRTK."""
    row = BY_NAME.get(path.rpartition("/")[2])
    if row is None or path.startswith(_OWN) or not _PATH.fullmatch(path):
        return None
    return row


def namespaces(path: str) -> list[str]:
    """Return the namespaces of a device as in ROS, the innermost first: ``/PSM1/jaw``, then ``/PSM1``."""
    levels = path.split("/")[:-1]
    return ["/" + "/".join(levels[:count]) for count in range(len(levels), 0, -1)]
