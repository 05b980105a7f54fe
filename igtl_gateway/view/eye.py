"""Where the eye of a 3-D view is put: such that what the view shows fills it, from the side that people look from.

Everything is told by the boxes of ``SessionContents`` and by the last places of their frames.  Lengths are metres.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from igtl_gateway.view.contents import EntityKind, SessionContents, ShownTopic

Xyz = tuple[float, float, float]

_TOOLS = (EntityKind.POSE, EntityKind.POSES)
_BODIES = {EntityKind.CLOUD, EntityKind.MESH, EntityKind.VOLUME}
_HALF_HEIGHT, _HALF_WIDTH = (
    math.radians(25),
    math.radians(30),
)  #: half of what a 3-D view of rerun takes in, a narrow one
_ROOM, _MORE_ROOM = 0.88, 1.2  #: boxes are seldom filled to their corners, but the way of a tool ends in them
_SPOT_M, _FROM_SPOT_M = 0.01, 0.1  #: what is smaller, as a single tool, is looked at from there
#: From what is seen to the eye: in a camera's frame (REP 103: x right, y down, z forward), and in others (z up).
_FROM_CAMERA, _FROM_ABOVE = (0.2, 0.5, -0.85), (0.55, -0.65, 0.52)
_BESIDE, _ABOVE, _BEFORE = 0.7, 0.35, 0.6  #: the same for pictures with a place


@dataclass(frozen=True, slots=True)
class Eye:
    """Where the eye is, what it looks at, and the direction that is up there; metres in the frame of the view."""

    place: Xyz
    target: Xyz
    up: Xyz


def eye_of(seen: SessionContents, tree: list[ShownTopic], frame: str, *, camera: bool) -> Eye | None:
    """The eye for a view of ``tree`` in ``frame``; None where nothing has a box.

    Args:
        seen: the session.
        tree: what the view shows.
        frame: target frame of the view.
        camera: whether that is a camera's: seen from beside the camera.  Where there is a picture with a place, it is
            seen from before it, its top up; else from the front right above.
    """
    corners = _corners(seen, tree, frame)
    if not corners:
        return None
    way, up = _look(seen, tree, frame, camera)
    axes = (_unit(_cross(up, way)), _unit(_cross(way, _cross(up, way))), way)  # to the right, above, towards the eye
    places = [[_dot(corner, axis) for axis in axes] for corner in corners]
    middle = [(min(along) + max(along)) / 2 for along in zip(*places, strict=True)]
    room = _ROOM if any(shown.what in _BODIES or shown.what is EntityKind.LINES for shown in tree) else _MORE_ROOM
    distance = 0.0
    for place in places:
        right, above, near = (abs(place[0] - middle[0]), abs(place[1] - middle[1]), place[2] - middle[2])
        spread = max(right / math.tan(_HALF_WIDTH), above / math.tan(_HALF_HEIGHT))
        distance = max(distance, room * (near + spread))
    if distance < _SPOT_M:
        distance = _FROM_SPOT_M
    target = _xyz(sum(part * axis[i] for part, axis in zip(middle, axes, strict=True)) for i in range(3))
    return Eye(_xyz(at + distance * step for at, step in zip(target, way, strict=True)), target, up)


def _look(seen: SessionContents, tree: list[ShownTopic], frame: str, camera: bool) -> tuple[Xyz, Xyz]:
    """From what is seen to the eye, and what is up there; of length 1."""
    if camera:
        return _unit(_FROM_CAMERA), (0.0, -1.0, 0.0)
    for shown in tree:
        if shown.right and shown.up:
            right, up = (_moved(seen, shown.frame, frame, axis, turn_only=True) for axis in (shown.right, shown.up))
            sides = zip(right, up, _cross(right, up), strict=True)
            return _unit(_xyz(a * _BESIDE + b * _ABOVE + c * _BEFORE for a, b, c in sides)), up
    return _unit(_FROM_ABOVE), (0.0, 0.0, 1.0)


def _corners(seen: SessionContents, tree: list[ShownTopic], frame: str) -> list[Xyz]:
    """Of all boxes, in that frame; where there is a body, tools and robots that come to it are not counted."""
    boxed = [shown for shown in tree if shown.low is not None and shown.high is not None]
    bodies = {shown.frame for shown in boxed if shown.what in _BODIES}
    if bodies and not any(shown.what is EntityKind.PLANE for shown in boxed):
        boxed = [shown for shown in boxed if shown.frame in bodies and shown.what not in _TOOLS]
    return [
        _moved(seen, shown.frame, frame, corner)
        for shown in boxed
        for corner in itertools.product(*zip(shown.low or (), shown.high or (), strict=True))
    ]


def _moved(seen: SessionContents, source: str, target: str, point: Sequence[float], *, turn_only: bool = False) -> Xyz:
    """A point (or a direction) of one frame in another one of the same tree, by the last places of both."""
    x, y, z = point
    for place in seen.way_to_root(source):
        x, y, z = _turned((x, y, z), place[3:])
        if not turn_only:
            x, y, z = x + place[0], y + place[1], z + place[2]
    for place in reversed(seen.way_to_root(target)):
        if not turn_only:
            x, y, z = x - place[0], y - place[1], z - place[2]
        qx, qy, qz, qw = place[3:]
        x, y, z = _turned((x, y, z), (-qx, -qy, -qz, qw))
    return x, y, z


def _turned(point: Xyz, quaternion: Sequence[float]) -> Xyz:
    length = math.hypot(*quaternion) or 1.0
    x, y, z, w = (part / length for part in quaternion)
    across = _cross((x, y, z), point)
    twice = _cross((x, y, z), across)
    a, b, c = (p + 2 * (w * q + r) for p, q, r in zip(point, across, twice, strict=True))
    return a, b, c


def _xyz(values: Iterable[float]) -> Xyz:
    x, y, z = values
    return x, y, z


def _unit(a: Xyz) -> Xyz:
    length = math.hypot(*a) or 1.0
    return a[0] / length, a[1] / length, a[2] / length


def _dot(a: Xyz, b: Xyz) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _cross(a: Xyz, b: Xyz) -> Xyz:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]
