"""The arms of a configuration: which namespaces are robots with CRTK topics, and the limits of commands to them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields

from igtl_gateway.base.errors import ConfigError
from igtl_gateway.base.globs import matches
from igtl_gateway.base.near import one_of
from igtl_gateway.base.quantities import counted
from igtl_gateway.convert.choices import UNITS
from igtl_gateway.convert.crtk import namespaces, row_of

#: Value of the setting ``profile``: all namespaces, or ``crtk:`` and a glob of them.
PROFILE = "crtk"
EVERY_ARM = "/**"

_SPHERE, _BOX = 4, 6
_YEAR_S = 365 * 86_400.0


@dataclass(frozen=True, slots=True)
class ArmsRow:
    """Arms with CRTK topics (a glob of namespaces) and the limits of commands of peers to them.

    Attributes:
        arms: namespaces, such as ``/PSM*``; sub-devices belong to their arm.
        igtl_unit: length unit of their devices in OpenIGTLink.
        frame_id: frame of poses that are commanded; "": that of the last ``measured_cp``.
        max_age_s: maximum age of a command on arrival, and how far its stamp may be in the future, s; 0: no limit,
            also for commands without a stamp.
        workspace: where the tool may be commanded, m: sphere (x, y, z, radius) or box (x, y, z least, then most);
            empty: anywhere.
        max_speed, max_turn_speed: highest speed of a streamed pose, m/s and rad/s; 0: no limit.
        max_behind_s: how far a streamed pose or joint may be from the measured one, as a time at the limits of speed,
            s; 0: any distance; None: the setting of ``[gateway]``.
        joint_min, joint_max: range of each joint, rad or m; empty: no limit.
        joint_speed: highest speed of each joint, rad/s or m/s, or one for all of them; empty: no limit.
        max_force, max_torque: highest commanded force and torque, N and N m; 0: no limit.
    """

    arms: str = EVERY_ARM
    igtl_unit: str = "m"
    frame_id: str = ""
    max_age_s: float = 0.5
    workspace: tuple[float, ...] = ()
    max_speed: float = 0.25
    max_turn_speed: float = 3.0
    max_behind_s: float | None = None
    joint_min: tuple[float, ...] = ()
    joint_max: tuple[float, ...] = ()
    joint_speed: tuple[float, ...] = (1.0,)
    max_force: float = 5.0
    max_torque: float = 0.5

    def check(self, place: str) -> None:
        """Raise ConfigError with ``place`` for a value that is not possible."""
        if not self.arms.startswith(("/", "**")) or any(character.isspace() for character in self.arms):
            raise ConfigError(f"{place}.arms: found {self.arms!r}, expected namespaces such as /PSM1 or /PSM*")
        if self.igtl_unit not in UNITS:
            raise ConfigError(f"{place}.igtl_unit: found {self.igtl_unit!r}, expected {one_of(self.igtl_unit, UNITS)}")
        for item in fields(self):
            value = getattr(self, item.name)
            if isinstance(value, float) and not 0 <= value <= _YEAR_S:
                raise ConfigError(f"{place}.{item.name}: found {value!r}, expected a number of at least 0")
            if isinstance(value, tuple) and not all(map(math.isfinite, value)):
                raise ConfigError(f"{place}.{item.name}: found {list(value)}, expected finite numbers")
        self._check_workspace(f"{place}.workspace")
        if len(self.joint_min) != len(self.joint_max):
            raise ConfigError(
                f"{place}.joint_max: found {counted(len(self.joint_max), 'joint')}, expected {len(self.joint_min)} "
                "as joint_min"
            )
        if any(least > most for least, most in zip(self.joint_min, self.joint_max, strict=True)):
            raise ConfigError(f"{place}.joint_max: found {list(self.joint_max)}, expected at least joint_min")
        if any(speed <= 0 for speed in self.joint_speed):
            raise ConfigError(f"{place}.joint_speed: found {list(self.joint_speed)}, expected numbers above 0")
        if self.joint_min and len(self.joint_speed) not in (0, 1, len(self.joint_min)):
            count = len(self.joint_min)
            raise ConfigError(
                f"{place}.joint_speed: found {counted(len(self.joint_speed), 'joint')}, expected 1 or {count}"
            )

    def _check_workspace(self, place: str) -> None:
        box = self.workspace
        if len(box) not in (0, _SPHERE, _BOX):
            raise ConfigError(
                f"{place}: found {counted(len(box), 'number')}, expected {_SPHERE} of a sphere or {_BOX} of a box"
            )
        if len(box) == _SPHERE and not box[3] > 0:
            raise ConfigError(f"{place}: found radius {box[3]}, expected more than 0")
        if len(box) == _BOX and any(least >= most for least, most in zip(box[:3], box[3:], strict=True)):
            raise ConfigError(f"{place}: found {list(box)}, expected the least x, y, z, then the greatest")


def arms_of_profile(profile: str) -> str | None:
    """Return the glob of namespaces of a profile such as ``crtk:/PSM*``; None for other profiles.

    Raises ConfigError for a glob that cannot match a namespace.
    """
    name, colon, glob = profile.partition(":")
    if name != PROFILE:
        return None
    if colon and not glob.startswith(("/", "**")):
        raise ConfigError(
            f"found {profile!r}, expected {PROFILE}:/NAMESPACE such as {PROFILE}:/PSM1 or {PROFILE}:/PSM*"
        )
    return glob or EVERY_ARM


def arms_row(rows: Sequence[ArmsRow], path: str) -> ArmsRow | None:
    """Return the first row whose arms a device such as ``PSM1/jaw/measured_js`` belongs to."""
    if not rows or row_of(path) is None:
        return None
    places = namespaces(path)
    return next((row for row in rows if any(matches(row.arms, place) for place in places)), None)
