"""The eye: what is shown is in its view and fills it, wherever its frames are; what is up is up."""

from __future__ import annotations

import itertools
import math

import pytest

from igtl_gateway.addons.view.contents import EntityKind, SessionContents, ShownTopic
from igtl_gateway.addons.view.eye import Eye, eye_of

BOX = ((-0.035, -0.026, 0.245), (0.035, 0.026, 0.275))
HALF = math.sqrt(0.5)
TURNED = (0.0, 0.0, HALF, HALF)  #: a quarter turn about z


def shown(
    what: EntityKind, frame: str, low: tuple[float, ...] = BOX[0], high: tuple[float, ...] = BOX[1]
) -> ShownTopic:
    (a, b, c), (d, e, f) = low, high
    return ShownTopic("path", "/topic", "a/msg/Type", what, frame, count=1, low=(a, b, c), high=(d, e, f))


def angle(eye: Eye, point: tuple[float, ...]) -> float:
    """Degrees between the direction of sight and that of the point."""
    ahead = [b - a for a, b in zip(eye.place, eye.target, strict=True)]
    there = [b - a for a, b in zip(eye.place, point, strict=True)]
    dot = sum(a * b for a, b in zip(ahead, there, strict=True))
    return math.degrees(math.acos(dot / math.hypot(*ahead) / math.hypot(*there)))


@pytest.mark.parametrize("camera", [True, False])
def test_what_is_shown_fills_the_view(camera: bool) -> None:
    eye = eye_of(SessionContents(), [shown(EntityKind.CLOUD, "here")], "here", camera=camera)
    assert eye is not None
    widest = max(angle(eye, corner) for corner in itertools.product(*zip(*BOX, strict=True)))
    assert 22 < widest < 45  # a view takes in 25 each way in height, 33 in width and 40 to its corners


def test_a_camera_looks_along_z_and_all_others_from_above() -> None:
    seen, cloud = SessionContents(), [shown(EntityKind.CLOUD, "here")]
    by_camera = eye_of(seen, cloud, "here", camera=True)
    other = eye_of(seen, cloud, "here", camera=False)
    assert by_camera is not None
    assert other is not None
    assert by_camera.up == (0.0, -1.0, 0.0)
    assert by_camera.place[2] < by_camera.target[2]
    assert other.up == (0.0, 0.0, 1.0)
    assert other.place[2] > other.target[2]


def test_things_of_other_frames_are_looked_at_where_they_are() -> None:
    seen = SessionContents(parents={"tip": "arm", "arm": "base"})
    seen.places = {"tip": (0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0), "arm": (1.0, 0.0, 0.0, *TURNED)}
    tip = [shown(EntityKind.MESH, "tip", (0.9, 0.0, -0.1), (1.1, 0.0, 0.1))]
    eye = eye_of(seen, tip, "base", camera=False)
    assert eye is not None
    assert eye.target == pytest.approx((1.0, 1.0, 1.0))  # a quarter turn takes x to y
    back = eye_of(seen, [shown(EntityKind.MESH, "base", (1, 1, 0.9), (1, 1, 1.1))], "tip", camera=False)
    assert back is not None
    assert back.target == pytest.approx((1.0, 0.0, 0.0))


def test_a_picture_is_seen_from_before_it_with_its_top_up() -> None:
    plane = shown(EntityKind.PLANE, "here", (0.0, 0.0, 0.0), (0.04, 0.0, 0.05))
    plane.right, plane.up = (1.0, 0.0, 0.0), (0.0, 0.0, -1.0)
    eye = eye_of(SessionContents(), [plane], "here", camera=False)
    assert eye is not None
    assert eye.up == (0.0, 0.0, -1.0)
    assert eye.place[1] > 0.01  # right × up points along y: from there the picture is not mirrored


def test_tools_do_not_count_where_there_is_a_body_to_look_at() -> None:
    tool = shown(EntityKind.POSE, "here", (5.0, 0.0, 0.0), (5.0, 0.0, 0.0))
    cloud, plane = shown(EntityKind.CLOUD, "here"), shown(EntityKind.PLANE, "here")
    targets = []
    for tree in ([cloud, tool], [plane, tool], [tool]):
        eye = eye_of(SessionContents(), tree, "here", camera=False)
        assert eye is not None
        targets.append(round(eye.target[0]))
    assert targets == [0, 2, 5]


def test_nothing_to_look_at() -> None:
    assert (
        eye_of(SessionContents(), [ShownTopic("path", "/topic", "a/msg/Type", EntityKind.CLOUD)], "here", camera=True)
        is None
    )
    assert eye_of(SessionContents(), [], "here", camera=True) is None


def test_an_arm_of_lines_is_in_the_view_of_a_volume_in_another_frame() -> None:
    seen = SessionContents(parents={"head": "base"})
    seen.places = {"head": (0.5, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)}
    volume = shown(EntityKind.VOLUME, "head", (-0.1, -0.1, -0.1), (0.1, 0.1, 0.1))
    arm = shown(EntityKind.LINES, "base", (0.0, 0.0, 0.0), (0.5, 0.0, 0.6))
    eye = eye_of(seen, [volume, arm], "base", camera=False)
    assert eye is not None
    assert max(angle(eye, corner) for corner in ((0.0, 0.0, 0.0), (0.5, 0.0, 0.6), (0.6, 0.1, -0.1))) < 45
