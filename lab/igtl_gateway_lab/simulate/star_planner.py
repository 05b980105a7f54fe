"""The planner of the STAR session: an OpenIGTLink program that looks at the plan against the cloud.

It knows what its peer sends, and nothing else.  As soon as it has a plan and a cloud that is newer, it holds every
planned point against the cloud's depth along the same ray.  A point that is off is put onto the cloud, and the plan
goes back as POINT, under the name that it came with; when the robot repeats it, it is approved by a STRING.

Such a check finds what was wrong with the one cloud that the plan was made from.  Where every cloud is wrong, as at
a wet spot, plan and cloud agree: that takes the surface around the point (``igtl-gateway review``).
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from igtl_gateway.base.stamp import NS_PER_MS, ns_to_ticks
from igtl_gateway.wire import Message
from igtl_gateway.wire.point import Points
from igtl_gateway.wire.polydata import PolyData
from igtl_gateway.wire.text import Status, String
from igtl_gateway_lab.simulate import star_topics as topics
from igtl_gateway_lab.simulate.actor import ActorProtocol, ActorReport, Publishes, Received, Sent
from igtl_gateway_lab.simulate.agenda import Agenda

Array = NDArray[Any]

LIMIT_MM = 1.0  #: a point so far off the cloud is moved
REACH_MM = 0.9  #: points of the cloud within this distance of a ray determine the depth
_ENOUGH = 5  # of them
_SAME_MM = 0.01  # the robot's float32 metres and our float32 millimetres

_LOOKING_NS, _APPROVING_NS = 400 * NS_PER_MS, 250 * NS_PER_MS  # a person's time
_COLOUR, _MOVED_COLOUR = (255, 255, 255, 255), (255, 160, 0, 255)


class SuturePlanner:
    """An actor of OpenIGTLink; see the module."""

    name = "star_planner"
    side = ActorProtocol.IGTL

    def __init__(self, duration_ns: int) -> None:
        self.subscribes: dict[str, str] = {}
        self.publishes: dict[str, Publishes] = {}
        self._duration_ns = duration_ns
        self._agenda = Agenda()
        self._heard = self._over = False
        self._clouds = 0
        self._plan: Message | None = None  # waits for a newer cloud
        self._wanted: Array | None = None  # the corrected plan, until the robot repeats it
        self._moved: dict[str, float] = {}  # name of a point → how far it was off the cloud, mm
        self._approved = False

    def begin(self, now_ns: int) -> None:
        self._agenda.add(now_ns, lambda at_ns: [_message("STATUS", Status(1, 0, "", "ready"), at_ns)])

    @property
    def due_ns(self) -> int | None:
        return self._agenda.due_ns

    def act(self, now_ns: int) -> Iterable[Sent]:
        return self._agenda.act(now_ns)

    def receive(self, now_ns: int, received: Received) -> Iterable[Sent]:
        if not self._heard:  # the session begins; until then a planner that was started alone waits
            self._heard = True
            self._agenda.add(now_ns + self._duration_ns, self._end)
        if not isinstance(received, Message) or self._approved:
            return ()
        match received.content:
            case Points() if received.device_name == topics.POINTS_DEVICE:
                self._on_plan(now_ns, received)
            case PolyData() if received.device_name == topics.CLOUD_DEVICE:
                self._on_cloud(now_ns, received)
            case _:
                pass
        return ()

    @property
    def done(self) -> bool:
        return self._over

    def report(self) -> ActorReport:
        moved = {name: round(by_mm, 2) for name, by_mm in self._moved.items()}
        moves = ", ".join(f"{name} by {by_mm:.1f} mm" for name, by_mm in moved.items()) or "nothing"
        lines = (
            f"clouds looked at: {self._clouds}; moved: {moves}",
            "plan approved" if self._approved else "plan not approved",
        )
        return ActorReport(
            self._approved, lines, {"clouds": self._clouds, "moved_mm": moved, "approved": self._approved}
        )

    def _on_plan(self, now_ns: int, plan: Message) -> None:
        if self._wanted is None:
            self._plan = plan
            return
        received = _positions(plan)
        if received.shape == self._wanted.shape and (np.abs(received - self._wanted) < _SAME_MM).all():
            self._wanted = None
            self._agenda.add(now_ns + _APPROVING_NS, self._approve)

    def _on_cloud(self, now_ns: int, cloud: Message) -> None:
        if self._plan is None or cloud.ticks <= self._plan.ticks or not isinstance(cloud.content, PolyData):
            return
        plan, self._plan = _positions(self._plan), None
        self._clouds += 1
        off = offsets(plan, cloud.content.points.astype(np.float64))
        wrong = np.abs(off) > LIMIT_MM
        if not wrong.any():
            self._agenda.add(now_ns + _LOOKING_NS, self._approve)
            return
        corrected = plan.copy()
        corrected[wrong] *= (1 - off[wrong] / plan[wrong, 2])[:, None]
        points = Points.of(corrected, np.where(wrong[:, None], _MOVED_COLOUR, _COLOUR))
        points.elements["name"] = names = _names(len(plan))
        points.elements["group"] = "Plan"
        self._moved = {names[index]: float(abs(off[index])) for index in np.flatnonzero(wrong)}
        self._wanted = points.elements["position"].astype(np.float64)
        self._agenda.add(now_ns + _LOOKING_NS, lambda at_ns: self._correct(at_ns, points))

    def _correct(self, now_ns: int, points: Points) -> Iterable[Sent]:
        moves = ", ".join(f"{name}, {by_mm:.1f} mm off the cloud" for name, by_mm in self._moved.items())
        yield _message("STRING", String.of(f"moved: {moves}"), now_ns)
        yield _message("POINT", points, now_ns, topics.POINTS_DEVICE)

    def _approve(self, now_ns: int) -> Iterable[Sent]:
        self._approved = True
        yield _message("STRING", String.of(topics.APPROVAL), now_ns)

    def _end(self, _now_ns: int) -> Iterable[Sent]:
        self._agenda.clear()
        self._over = True
        return ()


def offsets(plan: Array, cloud: Array) -> Array:
    """How far (mm along z, + deeper) each planned point is off the cloud's median depth around its ray.

    0 where the cloud has too few points.

    Args:
        plan: (n, 3) mm in the frame of the camera.
        cloud: (m, 3) mm in the same.
    """
    found = np.zeros(len(plan))
    across = cloud[:, :2] / cloud[:, 2:]
    for index, (x, y, z) in enumerate(plan):
        side, down = across[:, 0] - x / z, across[:, 1] - y / z
        near = cloud[side * side + down * down < (REACH_MM / z) ** 2, 2]
        if len(near) >= _ENOUGH:
            found[index] = z - np.median(near)
    return found


def _positions(message: Message) -> Array:
    assert isinstance(message.content, Points)
    return np.asarray(message.content.elements["position"].astype(np.float64))


def _names(count: int) -> list[str]:
    """The first half of a plan's points are where the needle enters, the second where it leaves."""
    half = count // 2
    return [f"{'entry' if index < half else 'exit'} {index % half + 1}" for index in range(count)]


def _message(
    igtl_type: str, content: Status | String | Points, now_ns: int, device: str = topics.PLANNER_DEVICE
) -> Message:
    return Message(igtl_type, device, content, ns_to_ticks(now_ns))
