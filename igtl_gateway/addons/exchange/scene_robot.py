"""Robots in a scene: a transform for each joint, below each other, and the bodies of the links as models.

A link whose frame a stream publishes keeps that; the others follow the joint states, as in ``view``, which has the
reader of robots.  Boxes, cylinders, spheres and meshes (STL) are drawn; lengths become millimetres.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from igtl_gateway.addon import GatewayError, failure_text
from igtl_gateway.addon.igtl import Cells, PolyData
from igtl_gateway.addon.processes import is_present, part_of
from igtl_gateway.addon.streams import matrices_of
from igtl_gateway.addon.terminal import by_count, counted
from igtl_gateway.addons.exchange.scene_tracks import NumberTrack, PoseTrack, Track
from igtl_gateway.addons.exchange.surface_out import vtk

Array = npt.NDArray[Any]

_MM = 1000.0
_GREY = (0.7, 0.7, 0.72)
_SIDES = 24
#: Joint states of these names are requests.
_WANTED = ("setpoint_", "goal_", "servo_", "interpolate_", "move_")


@dataclass(frozen=True, slots=True)
class Body:
    """A body in a frame: the content of a VTK file, and its lowest and highest coordinates (2, 3), mm."""

    name: str
    frame: str
    data: bytes
    colour: tuple[float, float, float]
    box: Array


@dataclass(slots=True)
class Robots:
    """The robots of a session.

    Attributes:
        joints: tracks of the joints.
        bodies: of links.
        notes: what is not shown, for people.
        frames: frames of links that have a body, or other links below them.
    """

    joints: list[PoseTrack] = field(default_factory=list)
    bodies: list[Body] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    frames: set[str] = field(default_factory=set)

    @classmethod
    def of(cls, descriptions: Sequence[tuple[str, str]], tracks: Mapping[Any, Track], published: set[str]) -> Robots:
        """Return the robots of descriptions.

        Args:
            descriptions: topic and content of each.
            tracks: of the session.
            published: frames that a stream has.
        """
        found = cls()
        if not descriptions:
            return found
        if not is_present("view"):
            found.notes.append("the robot is not shown: the add-on view, which reads its description, is not installed")
            return found
        states = [each for each in tracks.values() if isinstance(each, NumberTrack) and each.joints]
        for topic, text in dict(descriptions).items():
            try:
                found._add(topic, text, states, published)
            except GatewayError as error:
                found.notes.append(f"{topic}: the robot is not shown: {failure_text(error)}")
        return found

    def tracks(self) -> list[PoseTrack]:
        """Return the poses of the joints."""
        return self.joints

    def _add(self, topic: str, text: str, states: Sequence[NumberTrack], published: set[str]) -> None:
        model = part_of("view", "urdf:parse_urdf")(text, topic)
        for joint in model.joints:
            self.frames |= {joint.parent, joint.child}
            if joint.child in published:
                continue
            track = PoseTrack(
                f"robot:{topic}", "joint", joint.name, frame=joint.parent, child=joint.child, name=joint.name, rank=3
            )
            moved = _mover(joint.driver or joint.name, states)
            if joint.kind == "fixed" or moved is None:
                track.static = True
                track.parts.append(_pose(joint, joint.offset if joint.driver else 0.0)[None])
            else:
                state, rows = moved
                track.order, track.ms = np.arange(len(rows)), state.ms[rows[:, 0].astype(np.int64)]
                positions = rows[:, 1] * (joint.multiplier if joint.driver else 1.0) + (
                    joint.offset if joint.driver else 0
                )
                track.times = [0] * len(rows)
                track.parts.append(np.array([_pose(joint, float(each)) for each in positions]))
            self.joints.append(track)
        missing: list[str] = []
        folders = part_of("view", "meshes:MeshFolders")(os.environ)
        for link, visuals in model.visuals.items():
            self.frames.add(link)
            for number, visual in enumerate(visuals, 1):
                try:
                    points, faces = _shape(visual, folders)
                except GatewayError as error:
                    missing.append(failure_text(error))
                    continue
                place = matrices_of(np.array([visual.xyz]), np.array([visual.quaternion]))[0]
                points = (points @ place[:3, :3].T + place[:3, 3]) * _MM
                cells = np.empty((len(faces), 4), np.uint32)
                cells[:, 0], cells[:, 1:] = 3, faces
                content = PolyData(points.astype(np.float32), polygons=Cells(len(faces), cells.ravel()))
                colour = tuple(visual.colour[:3]) if visual.colour else _GREY
                name = "".join(sign if sign.isalnum() and sign.isascii() else "_" for sign in f"{link}_{number}")
                box = np.array([points.min(axis=0), points.max(axis=0)])
                self.bodies.append(Body(f"robot_{name}", link, vtk(content).data, colour, box))
        if missing:
            self.notes.append(
                f"{topic}: {counted(len(missing), 'body', 'bodies')} of the robot "
                f"{by_count(len(missing), 'is', 'are')} not shown: {missing[0]}"
            )


def _mover(joint: str, states: Sequence[NumberTrack]) -> tuple[NumberTrack, Array] | None:
    """Return the stream that moves a joint, and (N, 2) its row of ``ms`` and the position."""
    for state in states:
        if state.source.rpartition("/")[2].startswith(_WANTED):
            continue
        rows = [
            (row, names_positions[1][names_positions[0].index(joint)])
            for row, message in enumerate(state.order.tolist())
            if joint in (names_positions := state.joints[message])[0]
            and names_positions[0].index(joint) < len(names_positions[1])
        ]
        good = np.array([each for each in rows if math.isfinite(each[1])], np.float64).reshape(-1, 2)
        if len(good):
            return state, good
    return None


def _pose(joint: Any, position: float) -> Array:
    """Return the pose of a joint at a position, mm."""
    pose = np.array(joint.pose(position))
    matrix: Array = matrices_of(pose[None, :3] * _MM, pose[None, 3:])[0]
    return matrix


def _shape(visual: Any, folders: Any) -> tuple[Array, Array]:
    """Return points (N, 3) and triangles (M, 3) of a body in its own frame, m."""
    match visual.shape:
        case "box":
            return _box(visual.size)
        case "cylinder":
            return _cylinder(*visual.size)
        case "sphere":
            return _sphere(visual.size[0])
    mesh = folders.find(visual.uri)
    if mesh.media_type != "model/stl":
        raise GatewayError(f"{visual.uri[:200]}: found {mesh.media_type}, expected STL in a scene")
    points = _stl(mesh.data)
    return points * np.array(visual.size), np.arange(len(points)).reshape(-1, 3)


def _box(size: Iterable[float]) -> tuple[Array, Array]:
    corners = np.array([(x, y, z) for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)]) * np.array([*size])
    quads = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
    return corners, np.array([part for a, b, c, d in quads for part in ((a, b, c), (a, c, d))])


def _ring(radius: float, z: float) -> Array:
    turn = np.linspace(0, 2 * math.pi, _SIDES, endpoint=False)
    return np.c_[radius * np.cos(turn), radius * np.sin(turn), np.full(_SIDES, z)]


def _cylinder(radius: float, length: float) -> tuple[Array, Array]:
    return _rings([_ring(radius, -length / 2), _ring(radius, length / 2)], -length / 2, length / 2)


def _sphere(radius: float) -> tuple[Array, Array]:
    tilts = np.linspace(-math.pi / 2, math.pi / 2, _SIDES // 2)[1:-1]
    rings = [_ring(radius * math.cos(tilt), radius * math.sin(tilt)) for tilt in tilts]
    return _rings(rings, -radius, radius)


def _rings(rings: Sequence[Array], low: float, high: float) -> tuple[Array, Array]:
    """Join rings of points from below to above, and close them with a point each."""
    points = np.concatenate([*rings, [[0, 0, low], [0, 0, high]]])
    bottom, top = len(points) - 2, len(points) - 1

    def triangles() -> Iterator[tuple[int, int, int]]:
        for side in range(_SIDES):
            after = (side + 1) % _SIDES
            for ring in range(len(rings) - 1):
                a, b = ring * _SIDES + side, ring * _SIDES + after
                yield a, b, b + _SIDES
                yield a, b + _SIDES, a + _SIDES
            yield bottom, after, side
            last = (len(rings) - 1) * _SIDES
            yield top, last + side, last + after

    return points, np.array(list(triangles()))


def _stl(data: bytes) -> Array:
    """Return the corners of the triangles of an STL file, three for each.  Raises GatewayError."""
    count = int.from_bytes(data[80:84], "little")
    if len(data) == 84 + 50 * count:
        triangles = np.frombuffer(data, np.uint8, 50 * count, 84).reshape(count, 50)[:, 12:48]
        return np.ascontiguousarray(triangles).view("<f4").reshape(-1, 3).astype(np.float64)
    words = data.decode("ascii", "replace").split()
    try:
        numbers = [
            [float(each) for each in words[at + 1 : at + 4]] for at, word in enumerate(words) if word == "vertex"
        ]
    except ValueError:
        numbers = []
    found = np.array(numbers, np.float64)
    if found.ndim != 2 or found.shape[1] != 3 or len(found) % 3:
        raise GatewayError("found an STL file without triangles, expected some")
    return found
