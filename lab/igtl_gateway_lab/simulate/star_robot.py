"""The robot of the STAR session as a ROS program: its plan, its arm, its status.

The plan is drawn in the picture and lifted by the first cloud that it receives.  From then on the robot waits, and
takes over every corrected plan that comes, until one is approved; then it sews that one, stitch by stitch.
**Synthetic data**: the first status message states it, too.
"""

from __future__ import annotations

import colorsys
from collections.abc import Callable, Iterable

import numpy as np

from igtl_gateway.base.stamp import NS_PER_MS, NS_PER_S
from igtl_gateway.convert.rosmsg import Header, Marker, String, TransformStamped
from igtl_gateway_lab.simulate import star_topics as topics
from igtl_gateway_lab.simulate.actor import ActorProtocol, ActorReport, Publishes, Received, RosReceived, RosSent, Sent
from igtl_gateway_lab.simulate.agenda import Agenda
from igtl_gateway_lab.simulate.star_arm import (
    APPROACH_S,
    BASE_FROM_CAMERA,
    CYCLE_S,
    DRIVE_S,
    ToolPath,
    quaternion,
    to_camera,
)
from igtl_gateway_lab.simulate.star_numbers import SEED, Array, Noise, dot
from igtl_gateway_lab.simulate.star_scene import NEVER_S, StarScene, lifted
from igtl_gateway_lab.simulate.star_tissue import PLANTED, STITCHES, SuturePlan

TOOL_NS = 10 * NS_PER_MS  #: from tool pose to tool pose
DRAWING_NS = 230 * NS_PER_MS  #: from the first cloud to the plan

_MOVED_M = 0.00005  #: a point that comes back so near to where it was has not been moved
_LATCHED = (topics.CAMERA_POSE, topics.STATUS, topics.PLAN, topics.PLAN_POINTS)


class SutureRobot:
    """An actor of ROS; see the module."""

    name = "star_robot"
    side = ActorProtocol.ROS

    def __init__(self, duration_ns: int, seed: int = SEED) -> None:
        self.subscribes = {topic: topics.TYPES[topic] for topic in (topics.CLOUD, topics.CORRECTED, topics.SAID)}
        self.publishes = {
            topic: Publishes(topics.TYPES[topic], topic in _LATCHED) for topic in (topics.TOOL, *_LATCHED)
        }
        self._hearing: dict[str, Callable[[int, RosReceived], Iterable[Sent]]] = {
            topics.CLOUD: self._on_cloud,
            topics.CORRECTED: self._on_correction,
            topics.SAID: self._on_text,
        }
        self._duration_ns = duration_ns
        self._scene = StarScene(seed)
        self._agenda = Agenda()
        self._jitter = Noise(seed, 5, 3)
        self._start_ns = 0
        self._over = False
        #: The plan as first measured, and the one in force.
        self._measured: SuturePlan | None = None
        self._plan: SuturePlan | None = None
        self._moved: dict[int, float] = {}  # number of a stitch → how far it was moved, in all, metres
        self._begun_s = NEVER_S
        self._times: Array = np.arange(0, duration_ns, TOOL_NS) / NS_PER_S
        self._path: ToolPath = self._scene.tool(self._times, self._scene.plan)

    def begin(self, now_ns: int) -> None:
        self._start_ns = now_ns
        self._agenda.add(now_ns + 5 * NS_PER_MS, self._camera_pose)
        self._agenda.add(now_ns + 20 * NS_PER_MS, _status("session: SYNTHETIC suturing scene, no patient data"))
        self._agenda.add(now_ns + self._delay_ns(), lambda _now_ns: self._tool(0))
        self._agenda.add(now_ns + self._duration_ns, self._end)

    @property
    def due_ns(self) -> int | None:
        return self._agenda.due_ns

    def act(self, now_ns: int) -> Iterable[Sent]:
        return self._agenda.act(now_ns)

    def receive(self, now_ns: int, received: Received) -> Iterable[Sent]:
        return (
            self._hearing[received.topic](now_ns, received)
            if isinstance(received, RosReceived) and not self._over
            else ()
        )

    @property
    def done(self) -> bool:
        return self._over

    def report(self) -> ActorReport:
        if self._measured is None or self._plan is None:
            return ActorReport(False, ("no cloud came, so there was no plan",), {"planned": 0})
        first, last = (self._wrong_mm(plan) for plan in (self._measured, self._plan))
        moved = {str(number): round(1000 * by_m, 2) for number, by_m in sorted(self._moved.items())}
        beside_mm = self._lateral_errors_mm()
        facts = {
            "planned": STITCHES,
            "planted_mm": first,
            "moved_mm": moved,
            "approved": self._begun_s < NEVER_S,
            "still_wrong_mm": last,
            "executed": len(beside_mm),
            "beside_plan_mm": round(max(beside_mm), 3) if beside_mm else None,
        }
        executed = f"executed: {len(beside_mm)} of {STITCHES} stitches"
        lines = (
            f"plan: {STITCHES} stitches from the first cloud; planted at a wrong depth: {_lengths_text(first)}",
            f"moved by the planner: {_lengths_text(moved)}",
            f"still wrong, for `igtl-gateway review` to find: {_lengths_text(last)}",
            f"{executed}, at most {max(beside_mm):.2f} mm beside the plan" if beside_mm else executed,
            "the plan was approved" if facts["approved"] else "the plan was not approved, so the arm did not move",
        )
        return ActorReport(bool(beside_mm), lines, facts)

    # -- received messages ------------------------------------------------------------------------------------------

    def _on_cloud(self, now_ns: int, received: RosReceived) -> Iterable[Sent]:
        if self._measured is None:
            self._measured = self._plan = lifted(self._scene.plan, topics.positions(received.cdr))
            text = f"plan: {STITCHES} stitches from the first cloud"
            self._agenda.add(now_ns + DRAWING_NS, lambda at_ns: self._publish_plan(at_ns, text))
        return ()

    def _on_correction(self, now_ns: int, received: RosReceived) -> Iterable[Sent]:
        """Entry points, then exit points, in the order of the plan; refused once the arm moves."""
        points = topics.positions(received.cdr)[0].astype(np.float64)
        if self._plan is None or self._begun_s < NEVER_S:
            reason = "there is none yet" if self._plan is None else "the arm is at work"
            return [RosSent(topics.STATUS, String(f"plan: correction refused, {reason}"))]
        if len(points) != 2 * STITCHES or not np.isfinite(points).all():
            text = f"plan: correction refused, found {len(points)} points, expected {2 * STITCHES}"
            return [RosSent(topics.STATUS, String(text))]
        moved = []
        before = np.concatenate([self._plan.entry, self._plan.exit])
        for index, off in enumerate(points - before):
            by_m = float(np.sqrt(dot(off, off)))
            if by_m > _MOVED_M:
                number = index % STITCHES + 1
                self._moved[number] = self._moved.get(number, 0.0) + by_m
                moved.append(f"{'entry' if index < STITCHES else 'exit'} of stitch {number} by {1000 * by_m:.1f} mm")
                before[index] = points[index]
        self._plan = SuturePlan(before[:STITCHES], before[STITCHES:])
        text = f"plan: corrected by the planner: {', '.join(moved) or 'nothing moved'}"
        self._agenda.add(now_ns + 2 * NS_PER_MS, lambda at_ns: self._publish_plan(at_ns, text))
        return ()

    def _on_text(self, now_ns: int, received: RosReceived) -> Iterable[Sent]:
        if not String.unpack(received.cdr).data.startswith(topics.APPROVAL):
            return ()
        if self._plan is None or self._begun_s < NEVER_S:
            return ()
        begin_ns = -(-(now_ns - self._start_ns) // TOOL_NS) * TOOL_NS
        self._begun_s = begin_ns / NS_PER_S
        self._path = self._scene.tool(self._times, self._plan, self._begun_s)
        for number in range(STITCHES):
            name = f"stitch {number + 1}/{STITCHES}"
            for offset_s, phase in ((0.0, "approach"), (APPROACH_S, "drive"), (APPROACH_S + DRIVE_S, "pull")):
                self._schedule_text(begin_ns, number * CYCLE_S + offset_s, f"{name}: {phase}")
        self._schedule_text(begin_ns, STITCHES * CYCLE_S, "session: all stitches placed")
        return [RosSent(topics.STATUS, String("plan: approved, the arm begins"))]

    # -- what it does -------------------------------------------------------------------------------------------

    def _schedule_text(self, begin_ns: int, after_s: float, text: str) -> None:
        """Report after this duration of the work."""
        self._agenda.add(self._start_ns + begin_ns + round(after_s * NS_PER_S), _status(text))

    def _end(self, _now_ns: int) -> Iterable[Sent]:
        self._agenda.clear()
        self._over = True
        return ()

    def _delay_ns(self) -> int:
        """From the encoders to the message."""
        return NS_PER_MS + int(self._jitter.uniform(1)[0] * NS_PER_MS / 2)

    def _tool(self, number: int) -> Iterable[Sent]:
        at_ns = self._start_ns + (number + 1) * TOOL_NS + self._delay_ns()
        self._agenda.add(at_ns, lambda _now_ns: self._tool(number + 1))
        if number < len(self._times):
            stamp_ns = self._start_ns + number * TOOL_NS
            position, rotation = self._path.position[number], self._path.rotation[number]
            yield RosSent(topics.TOOL, _transform(stamp_ns, topics.TOOL_FRAME, position, rotation))

    def _camera_pose(self, now_ns: int) -> Iterable[Sent]:
        self._agenda.add(now_ns + NS_PER_S, self._camera_pose)
        rotation = quaternion(BASE_FROM_CAMERA[:3, :3])
        yield RosSent(topics.CAMERA_POSE, _transform(now_ns, topics.CAMERA_FRAME, BASE_FROM_CAMERA[:3, 3], rotation))

    def _publish_plan(self, now_ns: int, text: str) -> Iterable[Sent]:
        if self._plan is None:
            return
        header = Header(now_ns, topics.CAMERA_FRAME)
        rows = np.concatenate([self._plan.entry, self._plan.exit])
        yield RosSent(topics.PLAN, _marker(header, self._plan))
        yield RosSent(topics.PLAN_POINTS, topics.plain_cloud(header, rows))
        yield RosSent(topics.STATUS, String(text))

    # -- the outcome --------------------------------------------------------------------------------------

    def _wrong_mm(self, plan: SuturePlan) -> dict[str, float]:
        """Of the planted stitches those that are off the true tissue, by how much."""
        found = {}
        for number in PLANTED:
            ends = ((plan.entry, self._scene.plan.entry), (plan.exit, self._scene.plan.exit))
            off = [rows[number - 1] - truth[number - 1] for rows, truth in ends]
            by_mm = 1000 * max(float(np.sqrt(dot(one, one))) for one in off)
            if by_mm > 1:
                found[str(number)] = round(by_mm, 2)
        return found

    def _lateral_errors_mm(self) -> list[float]:
        """For each stitch that was driven through, how far from its planned ends the needle went in and out."""
        assert self._plan is not None
        found = []
        for number in range(STITCHES):
            into_s = self._begun_s + number * CYCLE_S + APPROACH_S
            if into_s + DRIVE_S >= self._duration_ns / NS_PER_S:
                break
            ends = [round(at_s * NS_PER_S / TOOL_NS) for at_s in (into_s, into_s + DRIVE_S)]
            tips = to_camera(self._path.position[ends])
            off = tips - np.stack([self._plan.entry[number], self._plan.exit[number]])
            found.append(1000 * float(np.sqrt(dot(off, off)).max()))
        return found


def _status(text: str) -> Callable[[int], Iterable[Sent]]:
    return lambda _now_ns: (RosSent(topics.STATUS, String(text)),)


def _lengths_text(millimetres: dict[str, float]) -> str:
    return ", ".join(f"stitch {number} ({value:.1f} mm)" for number, value in millimetres.items()) or "none"


def _transform(stamp_ns: int, child: str, position: Array, rotation: Array) -> TransformStamped:
    x, y, z = (float(value) for value in position)
    qx, qy, qz, qw = (float(value) for value in rotation)
    return TransformStamped(Header(stamp_ns, topics.BASE_FRAME), child, (x, y, z), (qx, qy, qz, qw))


def _marker(header: Header, plan: SuturePlan) -> Marker:
    """A line of its own colour for each stitch."""
    colours = [(*colorsys.hsv_to_rgb(i / STITCHES, 0.8, 1.0), 1.0) for i in range(STITCHES)]
    return Marker(
        header,
        ns="suture_plan",
        id=0,
        type=Marker.LINE_LIST,
        scale=(0.0005, 0.0, 0.0),  # width of the lines, metres
        points=np.stack([plan.entry, plan.exit], 1).reshape(-1, 3),
        colors=np.repeat(np.array(colours, np.float32), 2, axis=0),
    )
