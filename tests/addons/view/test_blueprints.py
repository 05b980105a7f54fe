"""Blueprints: the one that fits, views without errors by their making, and the eye that fits."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

from igtl_gateway.addons.view.contents import EntityKind, SessionContents, ShownTopic, path_of
from igtl_gateway.base.errors import ConfigError
from tests.tables import table

rr = pytest.importorskip("rerun", reason="rerun is not installed (extra 'view')")

from igtl_gateway.addons.view import blueprints  # noqa: E402  needs rerun

CAMERA, BASE = "camera_optical", "base"
BOX = ((-0.035, -0.026, 0.245), (0.035, 0.026, 0.275))


def seen(*rows: tuple[str, EntityKind, str], **more: Any) -> SessionContents:
    """A session with these topics: (topic, what, frame)."""
    made = SessionContents(base_frame="world", **more)
    for topic, what, frame in rows:
        made.shown[topic] = ShownTopic(
            path_of(topic), topic, "a/msg/Type", what, frame, count=3, low=BOX[0], high=BOX[1]
        )
    return made


SUTURING = seen(
    ("/cloud", EntityKind.CLOUD, CAMERA),
    ("/plan", EntityKind.LINES, CAMERA),
    ("/tool", EntityKind.POSE, BASE),
    ("/picture", EntityKind.IMAGE, CAMERA),
    ("/camera_info", EntityKind.CAMERA, CAMERA),
    ("/force", EntityKind.PLOT, ""),
    parents={CAMERA: BASE},
)
SWEEP = seen(("/frame", EntityKind.PLANE, "world"), ("/probe", EntityKind.POSE, "world"))
HEAD = seen(
    ("/mr", EntityKind.VOLUME, "world"),
    ("/probe", EntityKind.POSE, "world"),
    ("/landmarks", EntityKind.POINTS, "world"),
)
SOUNDS = seen(("/text", EntityKind.TEXT, ""), ("/numbers", EntityKind.PLOT, ""), ("/array", EntityKind.BARS, ""))
TWO_TREES = seen(("/cloud", EntityKind.CLOUD, CAMERA), ("/plan", EntityKind.LINES, "elsewhere"), parents={CAMERA: BASE})
NOTHING = SessionContents()
SESSIONS = {
    "suturing": SUTURING,
    "sweep": SWEEP,
    "head": HEAD,
    "sounds": SOUNDS,
    "two trees": TWO_TREES,
    "nothing": NOTHING,
}


def views(part: Any) -> Iterator[Any]:
    """All views of a blueprint."""
    if hasattr(part, "root_container"):
        part = part.root_container
    if hasattr(part, "class_identifier"):
        yield part
    else:
        for inner in part.contents:
            yield from views(inner)


def of_class(name: str, session: SessionContents, view_class: str) -> list[Any]:
    return [view for view in views(blueprints.blueprint(name, session)) if view.class_identifier == view_class]


def frame_of(view: Any) -> str | None:
    information = view.properties.get("SpatialInformation")
    return None if information is None else str(information.target_frame.as_arrow_array()[0])


@pytest.mark.parametrize(
    ("session", "name"),
    [(SUTURING, "star"), (SWEEP, "ultrasound"), (HEAD, "navigation"), (SOUNDS, "generic"), (NOTHING, "generic")],
)
def test_the_blueprint_that_fits_is_chosen(session: SessionContents, name: str) -> None:
    assert blueprints.choose(session) == name


def test_a_plan_that_lies_elsewhere_makes_no_suturing_session() -> None:
    assert blueprints.choose(TWO_TREES) != "star"


@table("name", blueprints.NAMES)
@table("session", SESSIONS.values(), ids=SESSIONS)
def test_every_blueprint_takes_every_session(
    name: str, session: SessionContents, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("RERUN_STRICT", "1")
    stream = rr.RecordingStream("test", send_properties=False)
    memory = stream.memory_recording()
    stream.send_blueprint(blueprints.blueprint(name, session))
    assert memory.num_msgs() > 0
    assert any(view.class_identifier == "TextLog" for view in views(blueprints.blueprint(name, session)))


def test_a_name_that_is_none() -> None:
    with pytest.raises(ConfigError, match="found 'stars', expected one of star, ultrasound, navigation, generic"):
        blueprints.blueprint("stars", SUTURING)


@pytest.mark.parametrize("name", blueprints.NAMES)
def test_what_has_no_place_to_each_other_is_not_in_one_view(name: str) -> None:
    spaces = of_class(name, TWO_TREES, "3D")
    assert sorted(frame_of(space) or "" for space in spaces) == [CAMERA, "elsewhere"]
    for space in spaces:
        assert ("+ /plan/**" in space.contents) == (frame_of(space) == "elsewhere")


def test_plan_and_tool_are_drawn_on_the_picture_of_a_known_camera() -> None:
    (picture,) = of_class("star", SUTURING, "2D")
    assert frame_of(picture) == f"{CAMERA}/image"
    assert {"+ /picture", "+ /camera_info", "+ /plan/**", "+ /tool/**"} <= set(picture.contents)
    assert "+ /cloud/**" not in picture.contents  # it would hide the picture


def test_nothing_of_space_is_drawn_on_a_picture_without_intrinsics() -> None:
    unknown = seen(
        ("/plan", EntityKind.LINES, CAMERA),
        ("/cloud", EntityKind.CLOUD, CAMERA),
        ("/picture", EntityKind.IMAGE, CAMERA),
    )
    (picture,) = of_class("star", unknown, "2D")
    assert picture.contents == ["+ /picture"]
    assert frame_of(picture) is None


def test_the_review_has_its_noise_and_its_table() -> None:
    reviewed = seen(("/cloud", EntityKind.CLOUD, CAMERA), ("/plan", EntityKind.LINES, CAMERA), reviewed=True)
    assert [view.name for view in of_class("star", reviewed, "TextDocument")] == ["Stitches"]
    noise, distance = of_class("star", reviewed, "3D")[-2:]
    assert "+ /review/cloud" in noise.contents
    assert "+ /review/distance" in distance.contents
    assert frame_of(noise) == CAMERA


@pytest.mark.parametrize("name", blueprints.NAMES)
def test_drops_and_gaps_have_a_view(name: str) -> None:
    session = seen(("/pose", EntityKind.POSE, "base"))
    assert "Drops and gaps" in [view.name for view in of_class(name, session, "TimeSeries")]


def test_the_eye_is_that_of_a_camera_in_a_cameras_frame() -> None:
    ups = []
    for frame in (CAMERA, "world"):
        (space,) = of_class("generic", seen(("/cloud", EntityKind.CLOUD, frame)), "3D")
        ups.append(tuple(space.properties["EyeControls3D"].eye_up.as_arrow_array()[0].as_py()))
    assert ups == [(0, -1, 0), (0, 0, 1)]


def test_the_view_of_the_tissue_marks_the_wrong_stitches() -> None:
    rows = (("/cloud", EntityKind.CLOUD, CAMERA), ("/plan", EntityKind.LINES, CAMERA))
    for reviewed in (True, False):
        space, *_ = of_class("star", seen(*rows, reviewed=reviewed), "3D")
        assert ("+ /review/wrong/**" in space.contents) is reviewed


def test_each_view_has_the_ruler_of_its_own() -> None:
    both = seen(("/cloud", EntityKind.CLOUD, CAMERA), ("/plan", EntityKind.LINES, "elsewhere"), parents={CAMERA: BASE})
    spaces = of_class("generic", both, "3D")
    assert [[each for each in space.contents if "ruler" in each] for space in spaces] == [
        ["+ /session/rulers/0"],
        ["+ /session/rulers/1"],
    ]


def test_a_legend_stands_before_the_curves() -> None:
    first_ns, last_ns = 1_767_225_600_000_000_000, 1_767_225_610_000_000_000
    session = seen(("/force", EntityKind.PLOT, ""), first_ns=first_ns, last_ns=last_ns)
    for plot in of_class("generic", session, "TimeSeries"):
        bounds = plot.properties["TimeAxis"].view_range.as_arrow_array()[0].as_py()
        assert bounds["end"] == last_ns
        assert first_ns - bounds["start"] == pytest.approx(0.45 * 10e9)
