"""What the robot and the planner of the LEGO scenario agree on: names, frames and words."""

from __future__ import annotations

from igtl_gateway.config.configuration import Config, ToIgtlRow, ToRosRow

#: Frames: the foot of the robot (x forward, z up) and the patient's of the image (RAS).
BASE, IMAGE, PEN = "LegoBase", "HeadImage", "Pen"

#: Devices of the planner.
VOLUME, LANDMARKS, PLAN, POINTS, TOUCHED = "HeadMR", "Landmarks", "DrawingPlan", "DrawingPoints", "Touched"
REGISTRATION = f"{IMAGE}To{BASE}"
SAYS = "Planner"

#: Topics of the robot, and the devices that they become.
JOINTS_TOPIC, PEN_TOPIC, ARM_TOPIC = "/lego/joint_states", "/lego/pen", "/lego/arm"
INK_TOPIC, STATUS_TOPIC = "/lego/ink", "/lego/status"
PEN_DEVICE, INK_DEVICE, STATUS_DEVICE = f"{PEN}To{BASE}", "DrawnLine", "LegoStatus"

#: First words of the robot's messages on ``STATUS_TOPIC``; a number follows the first four.
READY, TOUCHED_ALL, REGISTERED, DRAWN = "ready", "touched", "registered", "drawn"
REFUSED, FINISHED = "refused", "finished"
#: First word of the planner's last sentence, which it repeats until the robot has finished.
RESULT = "result"

CONFIG = Config(
    base_frame=BASE,
    to_igtl=(
        ToIgtlRow(topic=JOINTS_TOPIC, device="LegoJoints", type="SENSOR"),
        ToIgtlRow(topic=PEN_TOPIC, device=PEN_DEVICE, type="TRANSFORM"),
        ToIgtlRow(topic=ARM_TOPIC, device="LegoArm", type="POLYDATA"),
        ToIgtlRow(topic=INK_TOPIC, device=INK_DEVICE, type="POLYDATA"),
        ToIgtlRow(topic=STATUS_TOPIC, device=STATUS_DEVICE, type="STRING"),
    ),
    to_ros=tuple(ToRosRow(device=name, frame_id=IMAGE) for name in (VOLUME, LANDMARKS, PLAN, POINTS, TOUCHED)),
)


def topic_of(device: str, kind: str) -> str:
    """Where what a device of the planner sends appears."""
    return f"/igtl/in/{device}/{kind}"
