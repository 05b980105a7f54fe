"""The eye of a 3-D view: its position is chosen so that the contents fill the view, from a usual direction.

The inputs are the bounding boxes in ``SessionContents`` and the latest poses of their frames.  Lengths are in metres.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from igtl_gateway.addons.view.contents import EntityKind, SessionContents, ShownTopic

Xyz = tuple[float, float, float]

_TOOLS = (EntityKind.POSE, EntityKind.POSES)
_BODIES = {EntityKind.CLOUD, EntityKind.MESH, EntityKind.VOLUME}
_ARMS = {EntityKind.MARKERS, EntityKind.LINES}  # a robot that is drawn as lines is a subject too, wherever it stands
_LINKS = 30  #: about the number of links that the eye regards: each is followed to the root
HALF_HEIGHT, HALF_WIDTH = (
    math.radians(25),
    math.radians(30),
)  #: half of the opening angle of a narrow 3-D view of rerun
_ROOM, _MORE_ROOM = 0.88, 1.2  #: boxes are seldom filled to their corners, but trails end in them
_SPOT_M, _FROM_SPOT_M = 0.01, 0.1  #: smaller contents, such as a single tool, and the distance of the eye from them
#: Direction from the subject to the eye: in a camera frame (REP 103: x right, y down, z forward); in others (z up).
_FROM_CAMERA, _FROM_ABOVE = (0.2, 0.5, -0.85), (0.55, -0.65, 0.52)
_BESIDE, _ABOVE, _BEFORE = 0.7, 0.35, 0.6  #: the same for images with a pose


@dataclass(frozen=True, slots=True)
class Eye:
    """Position of the eye, the point that it looks at, and the up direction; metres in the frame of the view."""

    place: Xyz
    target: Xyz
    up: Xyz


def eye_of(seen: SessionContents, tree: list[ShownTopic], frame: str, *, camera: bool) -> Eye | None:
    """Return the eye for a view of ``tree`` in ``frame``; None if nothing has a box.

    Args:
        seen: the session.
        tree: the contents of the view.
        frame: target frame of the view.
        camera: whether ``frame`` is a camera frame: then the eye is beside the camera.  If there is an image with a
            pose, the eye is in front of it with its top up; else at the front right, above.
    """
    corners = _corners(seen, tree, frame)
    if not corners:
        return None
    way, up = _view_direction(seen, tree, frame, camera)
    axes = (_unit(_cross(up, way)), _unit(_cross(way, _cross(up, way))), way)  # right, up, towards the eye
    places = [[_dot(corner, axis) for axis in axes] for corner in corners]
    middle = [(min(along) + max(along)) / 2 for along in zip(*places, strict=True)]
    room = _ROOM if any(shown.what in _BODIES or shown.what is EntityKind.LINES for shown in tree) else _MORE_ROOM
    distance = 0.0
    for place in places:
        right, above, near = (abs(place[0] - middle[0]), abs(place[1] - middle[1]), place[2] - middle[2])
        spread = max(right / math.tan(HALF_WIDTH), above / math.tan(HALF_HEIGHT))
        distance = max(distance, room * (near + spread))
    if distance < _SPOT_M:
        distance = _FROM_SPOT_M
    target = _xyz(sum(part * axis[i] for part, axis in zip(middle, axes, strict=True)) for i in range(3))
    return Eye(_xyz(at + distance * step for at, step in zip(target, way, strict=True)), target, up)


def _view_direction(seen: SessionContents, tree: list[ShownTopic], frame: str, camera: bool) -> tuple[Xyz, Xyz]:
    """Return the direction from the subject to the eye and the up direction, unit vectors."""
    if camera:
        return _unit(_FROM_CAMERA), (0.0, -1.0, 0.0)
    for shown in tree:
        if shown.right and shown.up:
            right, up = (_moved(seen, shown.frame, frame, axis, turn_only=True) for axis in (shown.right, shown.up))
            sides = zip(right, up, _cross(right, up), strict=True)
            return _unit(_xyz(a * _BESIDE + b * _ABOVE + c * _BEFORE for a, b, c in sides)), up
    return _unit(_FROM_ABOVE), (0.0, 0.0, 1.0)


def _corners(seen: SessionContents, tree: list[ShownTopic], frame: str) -> list[Xyz]:
    """Return the corners of all boxes and the links of robots in ``frame``; if there is a body, tools do not count."""
    boxed = [shown for shown in tree if shown.low is not None and shown.high is not None]
    bodies = {shown.frame for shown in boxed if shown.what in _BODIES}
    if bodies and not any(shown.what is EntityKind.PLANE for shown in boxed):
        boxed = [
            shown for shown in boxed if (shown.frame in bodies or shown.what in _ARMS) and shown.what not in _TOOLS
        ]
    corners = [
        _moved(seen, shown.frame, frame, corner)
        for shown in boxed
        for corner in itertools.product(*zip(shown.low or (), shown.high or (), strict=True))
    ]
    links = [link for shown in tree for link in shown.links]
    some = [*links[:: len(links) // _LINKS + 1], *links[-1:]]
    return corners + [_moved(seen, link, frame, (0.0, 0.0, 0.0)) for link in some]


def _moved(seen: SessionContents, source: str, target: str, point: Sequence[float], *, turn_only: bool = False) -> Xyz:
    """Transform a point (or a direction) between two frames of one tree, by the latest poses."""
    x, y, z = point
    for place in seen.path_to_root(source):
        x, y, z = _rotated((x, y, z), place[3:])
        if not turn_only:
            x, y, z = x + place[0], y + place[1], z + place[2]
    for place in reversed(seen.path_to_root(target)):
        if not turn_only:
            x, y, z = x - place[0], y - place[1], z - place[2]
        qx, qy, qz, qw = place[3:]
        x, y, z = _rotated((x, y, z), (-qx, -qy, -qz, qw))
    return x, y, z


def _rotated(point: Xyz, quaternion: Sequence[float]) -> Xyz:
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
