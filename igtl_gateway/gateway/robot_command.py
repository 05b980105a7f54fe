"""A command of a peer to a robot: what it is, where it puts the arm, and why it may be refused."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from igtl_gateway.convert.arms import ArmsRow
from igtl_gateway.convert.crtk import CrtkName
from igtl_gateway.convert.poses import Quaternion

#: The tool in another frame, not another arm: ``/PSM1/local`` moves what ``/PSM1`` moves.
_SAME_ARM = "/local"


class Refused(Exception):
    """A command is refused: ``code`` is one of ``REFUSED_COMMANDS``."""

    def __init__(self, code: str, text: str) -> None:
        super().__init__(text)
        self.code = code


@dataclass(frozen=True, slots=True)
class RobotCommand:
    """A command under examination.

    Attributes:
        device: its device, such as ``PSM1/servo_cp``.
        name: its row in the table of CRTK.
        arms: the limits that apply.
        base: its arm or sub-device, such as ``/PSM1``.
        arrived_ns: gateway time of its arrival.
        stamp_ns: the stamp of the sender, UTC ns; 0: none.
        frame_id: the frame that its metadata name; "" if none.
        joints: the joints that its metadata name, in its order; () if none.
    """

    device: str
    name: CrtkName
    arms: ArmsRow
    base: str
    arrived_ns: int
    stamp_ns: int
    frame_id: str
    joints: tuple[str, ...] = ()

    @property
    def arm(self) -> str:
        """What it moves."""
        return self.base.removesuffix(_SAME_ARM)


@dataclass(slots=True)
class SetPoint:
    """Where an arm is: by a command to it, or measured.

    Attributes:
        arrived_ns: gateway time of the command or of the measured state.
        stamp_ns: the stamp of its sender, UTC ns; 0: none.
        values: position of the tool, m, or of the joints, rad or m; empty for other commands.
        rotation: orientation of the tool, as it is published; None for joints.
        frame: frame of the pose; "" if the arm names none, None if it is not known.
    """

    arrived_ns: int
    stamp_ns: int = 0
    values: Sequence[float] = ()
    rotation: Quaternion | None = None
    frame: str | None = None
