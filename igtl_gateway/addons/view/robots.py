"""Robots: drawn from their description, and moved by joint states.

A link is a frame of the transform tree, and its bodies are entities in this frame.  If a topic publishes the frame
(/tf), it takes precedence over the joint states: there is one robot, wherever its poses are from.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr

from igtl_gateway.addon import RecordingError
from igtl_gateway.addon.terminal import by_count, counted
from igtl_gateway.addons.view.canvas import Canvas
from igtl_gateway.addons.view.colours import GREY, rgba
from igtl_gateway.addons.view.contents import EntityKind
from igtl_gateway.addons.view.meshes import MeshFolders
from igtl_gateway.addons.view.robot_model import MOVING, Joint, JointKind, Robot, Visual, Xyz
from igtl_gateway.addons.view.urdf import parse_urdf

#: CRTK: joint states with these names are commands and goals, not positions of the robot.
_WANTED = ("setpoint_", "goal_", "servo_", "interpolate_", "move_")
#: The link that all robots of a URDF share, by convention: it gets no prefix.
_WORLD = "world"
_HUGE = 1e9  #: larger positions, in radians or metres, are invalid
_SHOWN = 5  #: names in one line of the log
_BINDINGS = 1000  #: lists of joint names that are remembered
_LINE_M = 0.0015  #: half the width of a line between joints


@dataclass(frozen=True, slots=True)
class _DrawnRobot:
    """A robot with its place in the session.

    Attributes:
        namespace: of its description; "" = the root.
        text: its URDF.
        prefix: of its frames.
        canvas: that it is drawn on.
        joints: name → joint.
        movers: joint → topic that moves it.
    """

    namespace: str
    text: str | bytes
    prefix: str
    canvas: Canvas
    joints: dict[str, Joint]
    movers: dict[str, str]

    def frame(self, link: str) -> str:
        """Return the frame of a link."""
        return self.canvas.pen.displayable((link if link == _WORLD else self.prefix + link).lstrip("/"))

    def place(self, joint: Joint, position: float) -> None:
        """Place the link below a joint."""
        self.canvas.link(self.frame(joint.child), self.frame(joint.parent), joint.pose(position), modelled=True)


@dataclass(frozen=True, slots=True)
class _Binding:
    """A position in a message that moves a joint: position of the joint = multiplier · position + offset."""

    index: int
    robot: _DrawnRobot
    joint: Joint
    multiplier: float = 1.0
    offset: float = 0.0


class Robots:
    """The robots of a session.

    Args:
        environment: with the folders of ROS packages.
    """

    def __init__(self, environment: Mapping[str, str] = os.environ) -> None:
        self._meshes = MeshFolders(environment)
        self._robots: dict[str, _DrawnRobot] = {}
        self._bindings: dict[tuple[str, tuple[str, ...]], list[_Binding]] = {}

    def __bool__(self) -> bool:
        """Whether there is one."""
        return bool(self._robots)

    def describe(self, data: str | bytes, namespace: str, canvas: Canvas, urdf: Path | None = None) -> None:
        """Draw a robot.

        Args:
            data: its URDF.
            namespace: of its joint states, as ``/PSM1``; "" = any.
            canvas: to draw on.
            urdf: the file, if the user named it.

        Raises DamagedRecording, LimitExceeded.
        """
        namespace = namespace.rstrip("/")
        known = self._robots.get(namespace)
        if known is not None:
            if known.text != data:
                canvas.text_once(f"not drawn: {known.canvas.shown.topic} is the robot of the namespace {namespace!r}")
            return
        model = parse_urdf(data, str(urdf or canvas.shown.topic))
        links = [model.root, *(joint.child for joint in model.joints)]
        taken = any(link in canvas.pen.link_axes for link in links)
        prefix = f"{namespace.strip('/') or model.name}/" if taken else ""
        joints = {joint.name: joint for joint in model.joints}
        canvas.pen.changes += 1
        robot = self._robots[namespace] = _DrawnRobot(namespace, data, prefix, canvas, joints, {})
        self._bindings.clear()
        canvas.shown.what = EntityKind.ROBOT
        canvas.frame(robot.frame(model.root))
        canvas.shown.links = tuple(map(robot.frame, links))
        canvas.text(f"robot {model.name}: {counted(len(links), 'link')}, {counted(len(joints), 'joint')}")
        self._draw(robot, model, links, urdf)

    def move(self, names: tuple[str, ...], positions: Sequence[float], canvas: Canvas) -> None:
        """Move the joints with these names; positions in radians or metres, mimic joints follow."""
        if not self._robots:
            return
        key = (canvas.shown.topic, names)
        bindings = self._bindings.get(key)
        if bindings is None:
            if len(self._bindings) >= _BINDINGS:
                self._bindings.clear()
            bindings = self._bindings[key] = self._bind(names, canvas)
        for each in bindings:
            if each.index < len(positions):
                position = positions[each.index]
                if abs(position) < _HUGE:
                    each.robot.place(each.joint, each.multiplier * position + each.offset)
                else:
                    canvas.text_once(f"joint {each.joint.name}: found {position}, expected a position", "position")

    def _bind(self, names: tuple[str, ...], canvas: Canvas) -> list[_Binding]:
        """Return which positions of a message move which joints, and log those that move none."""
        topic = canvas.shown.topic
        if topic.rpartition("/")[2].startswith(_WANTED):
            canvas.text_once("commands and goals: they do not move the robot", "wanted")
            return []
        if not names:
            canvas.text_once("joint states without names: they do not move a robot", "unnamed")
            return []
        bindings: list[_Binding] = []
        unknown = []
        for index, name in enumerate(names):
            robot = self._robot_of(name, topic, canvas)
            if robot is None:
                unknown.append(name)
                continue
            joint = robot.joints[name]
            if joint.kind in MOVING:
                if (mover := robot.movers.setdefault(name, topic)) == topic:
                    bindings.append(_Binding(index, robot, joint))
                else:
                    canvas.text_once(f"joint {name}: {mover} moves it", f"mover {mover}")
        if unknown:
            some = ", ".join(unknown[:_SHOWN]) + (", …" if len(unknown) > _SHOWN else "")
            canvas.text_once(f"joints that no robot has: {some}", "unknown")
        return [*bindings, *_followers(bindings, topic)]

    def _robot_of(self, name: str, topic: str, canvas: Canvas) -> _DrawnRobot | None:
        """Return the robot that a joint of this topic belongs to: with the longest namespace that is in the topic."""
        having = [robot for robot in self._robots.values() if name in robot.joints]
        near = [robot for robot in having if f"{robot.namespace}/" in topic]
        if near:
            return max(near, key=lambda robot: len(robot.namespace))
        if len(having) > 1:
            canvas.text_once(f"joint {name}: {len(having)} robots have it, and the topic is in no namespace of theirs")
        return having[0] if len(having) == 1 else None

    def _draw(self, robot: _DrawnRobot, model: Robot, links: Sequence[str], urdf: Path | None) -> None:
        """Draw all links, with all joints at zero; lines between joints where bodies are missing."""
        canvas = robot.canvas
        missing: list[str] = []
        bodies: dict[str, list[tuple[str, list[Any]]]] = {}
        for link in links:
            drawn = [self._body(visual, urdf, missing) for visual in model.visuals.get(link, ())]
            whole = bool(drawn) and None not in drawn
            name = canvas.part(link)
            bodies[link] = [(f"{name}/{n}", body) for n, body in enumerate(drawn, 1) if body is not None]
            ground = link == model.root and link not in model.visuals and bool(model.visuals)
            if not whole and not ground and (lines := _lines(model, link)):
                bodies[link].append((f"{name}/lines", [rr.LineStrips3D(lines, colors=[GREY], radii=[_LINE_M])]))
            bare = not whole and (link in model.visuals or not model.visuals)
            if link != _WORLD:
                canvas.pen.link_axes[robot.frame(link)] = canvas.options.axis_m if bare else 0.0
        for joint in model.joints:
            robot.place(joint, joint.offset if joint.driver else 0.0)
            if joint.kind in (JointKind.PLANAR, JointKind.FLOATING):
                canvas.text_once(f"{joint.kind} joints are drawn at zero", joint.kind)
        for link, parts in bodies.items():
            for child, body in parts:
                canvas.log(*body, child=child, frame=robot.frame(link), static=urdf is not None)
        if missing:
            meshes = sum(visual.shape == "mesh" for visuals in model.visuals.values() for visual in visuals)
            text = (
                f"{len(missing)} of {counted(meshes, 'mesh', 'meshes')} {by_count(len(missing), 'is', 'are')} "
                f"missing: {missing[0]}"
            )
            canvas.text(text, "WARN")

    def _body(self, visual: Visual, urdf: Path | None, missing: list[str]) -> list[Any] | None:
        """Return a body for rerun, in the frame of its link; None if it cannot be drawn."""
        colour = int(rgba(np.array([visual.colour]))[0]) if visual.colour else GREY
        where: dict[str, Any] = {"centers": [visual.xyz], "quaternions": [rr.Quaternion(xyzw=visual.quaternion)]}
        solid: dict[str, Any] = {"colors": [colour], "fill_mode": rr.components.FillMode.Solid}
        if visual.shape != "mesh" and not all(size > 0 for size in visual.size):
            return None
        match visual.shape:
            case "box":
                return [rr.Boxes3D(sizes=[visual.size], **where, **solid)]
            case "sphere":
                return [rr.Ellipsoids3D(radii=[visual.size[0]], **where, **solid)]
            case "cylinder":
                radius, length = visual.size
                return [rr.Cylinders3D(radii=[radius], lengths=[length], **where, **solid)]
        try:
            mesh = self._meshes.find(visual.uri, urdf)
        except RecordingError as error:
            missing.append(str(error))
            return None
        has_colours = mesh.media_type not in ("model/stl", "model/obj")
        factor = None if has_colours and not visual.colour else colour
        places = rr.InstancePoses3D(translations=[visual.xyz], quaternions=where["quaternions"], scales=[visual.size])
        return [rr.Asset3D(contents=mesh.data, media_type=mesh.media_type, albedo_factor=factor), places]


def _followers(bindings: Sequence[_Binding], topic: str) -> list[_Binding]:
    """Return the mimic joints that follow; a position in the message itself counts more."""
    found = []
    for each in bindings:
        for joint in each.robot.joints.values():
            is_moved = each.robot.movers.get(joint.name)
            if joint.driver == each.joint.name and joint.kind in MOVING and is_moved is None:
                found.append(_Binding(each.index, each.robot, joint, joint.multiplier, joint.offset))
    return found


def _lines(model: Robot, link: str) -> list[list[Xyz]]:
    """Return lines from a link to the joints below it, and along the travel of prismatic joints."""
    lines = []
    for joint in model.joints:
        if joint.parent == link:
            lines.append([(0.0, 0.0, 0.0), joint.xyz])
            if joint.kind is JointKind.PRISMATIC:
                low, high = (joint.pose(limit)[:3] for limit in joint.travel)
                lines.append([(low[0], low[1], low[2]), (high[0], high[1], high[2])])
    return [line for line in lines if line[0] != line[1]]
