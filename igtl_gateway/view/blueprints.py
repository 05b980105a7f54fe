"""Arrangements of views for a session: which of them, where each looks at, what stands in it.

A blueprint is made from ``Seen`` alone.  There are four: ``star`` for suture plans on a cloud, ``ultrasound`` for
pictures that have a place, ``navigation`` for volumes, surfaces and tools, ``generic`` for all else; they differ in
what is large and what goes where, the views themselves are made by the same few functions.

Two rules keep the views free of errors.  A 3-D view shows things of one tree of frames only, since things of
different trees have no place to each other; a picture shows things of space only where a camera's intrinsics are known.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import rerun.blueprint as rrb

from igtl_gateway.errors import ConfigError
from igtl_gateway.session.entry import Kind
from igtl_gateway.view.seen import (
    LATENCIES,
    LOG,
    RATES,
    REVIEW_CLOUD,
    REVIEW_STITCHES,
    REVIEW_TABLE,
    Seen,
    Shown,
    What,
)

TIME_LINE = "gateway_time"
DARK = (18, 20, 24)  #: behind 3-D: lets dark tissue and black tools be told from nothing

#: What the subject of a 3-D view can be, the likeliest first: the eye is set to it.
_SUBJECTS = (What.CLOUD, What.VOLUME, What.MESH, What.PLANE, What.LINES, What.POINTS, What.MARKERS, What.POSE)
_TOOLS = (What.POSE, What.POSES)
_CELLS = 6  #: of a grid
_HALF_HEIGHT, _HALF_WIDTH = math.radians(25), math.radians(33)  #: what a 3-D view of rerun takes in, half of it
_ROOM = 0.95  #: a box is seldom filled to its corners
_LEAST_M = 0.02  #: a single tool is not looked at from nearer than that gives
_FROM_CAMERA, _FROM_ABOVE = (0.2, 0.5, -0.85), (0.55, -0.65, 0.52)  #: from the subject to the eye
_BESIDE, _ABOVE, _BEFORE = 0.7, 0.35, 0.6  #: the same, for pictures with a place
_IN_PICTURE = (What.LINES, What.POINTS, What.MARKERS, What.POSE)  #: of space, what is drawn over a camera's picture

Xyz = tuple[float, float, float]
Part = Any  #: a view or a container of rerun, whose types are unknown to the checker; None: nothing to show


def choose(seen: Seen) -> str:
    """The name of the blueprint that fits what the session holds."""
    planned = any(_of(tree, What.CLOUD) and _of(tree, What.LINES) for tree in seen.trees().values())
    if seen.reviewed or planned:
        return "star"
    if any(plane.count > 1 for plane in seen.of(What.PLANE)) and not seen.of(What.VOLUME):
        return "ultrasound"
    if seen.of(What.VOLUME, What.MESH, What.POSE, What.POSES):
        return "navigation"
    return "generic"


def blueprint(name: str, seen: Seen) -> rrb.Blueprint:
    """The blueprint of that name for this session.

    Raises ConfigError if there is none of that name.
    """
    if name not in _BLUEPRINTS:
        raise ConfigError(f"blueprint: found {name!r}, expected {', '.join(NAMES)}")
    return rrb.Blueprint(
        _BLUEPRINTS[name](seen),
        rrb.TimePanel(state="collapsed", timeline=TIME_LINE),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        auto_views=False,
        auto_layout=False,
    )


def _star(seen: Seen) -> Part:
    """The tissue large; beside it the camera's picture and the noise; words and numbers below."""
    words: list[Part] = [_log()]
    if seen.reviewed:
        words.insert(0, rrb.TextDocumentView(name="Stitches", origin=f"/{REVIEW_TABLE}"))
    side = _stack([*_pictures(seen)[:1], *_noise(seen), *_pictures(seen)[1:]])
    below = _row((_tabs(words), 3), (_plots(seen), 2))
    return _page(_row((_tabs(_spaces(seen)), 3), (side, 2)), below)


def _ultrasound(seen: Seen) -> Part:
    """Picture and space side by side."""
    top = _row((_tabs(_pictures(seen)), 1), (_tabs(_spaces(seen)), 1))
    return _page(top, _words_and_numbers(seen))


def _navigation(seen: Seen) -> Part:
    """Space large; slices and pictures beside it."""
    top = _row((_tabs(_spaces(seen)), 2), (_stack([*_slices(seen), *_pictures(seen)]), 1))
    return _page(top, _words_and_numbers(seen))


def _generic(seen: Seen) -> Part:
    """A view of everything, as many as there are."""
    everything = _grid([*_slices(seen), *_pictures(seen), *_tables(seen)])
    return _page(_row((_tabs(_spaces(seen)), 1), (everything, 1)), _words_and_numbers(seen))


_BLUEPRINTS: dict[str, Callable[[Seen], Part]] = {
    "star": _star,
    "ultrasound": _ultrasound,
    "navigation": _navigation,
    "generic": _generic,
}
NAMES = tuple(_BLUEPRINTS)


# The views


def _spaces(seen: Seen) -> list[Part]:
    """A 3-D view for each tree of frames, the fullest first."""
    views: list[Part] = []
    for root, tree in seen.trees().items():
        contents = [entity for shown in tree for entity in _solids(shown)]
        views.append(
            _space(seen, f"Space of {root}", tree, [*contents, *(f"+ /{path}" for path in seen.frames_of(root))])
        )
    return views


def _space(seen: Seen, name: str, tree: list[Shown], contents: list[str]) -> rrb.Spatial3DView:
    """In the frame of its subject, which may be drawn before any transform is known."""
    subject = _subject(tree)
    # What moves with a probe would stand still, and the world move about it.
    frame = seen.root_of(subject.frame) if subject.what is What.PLANE else subject.frame
    return rrb.Spatial3DView(
        name=name,
        origin="/",
        contents=contents,
        background=DARK,
        line_grid=False,
        spatial_information=rrb.SpatialInformation(target_frame=frame),
        eye_controls=_eye(seen, tree, frame),
    )


def _noise(seen: Seen) -> list[Part]:
    """The cloud coloured by its depth noise with the judged stitches, where a review was made."""
    clouds = [shown for tree in seen.trees().values() for shown in tree if shown.what is What.CLOUD]
    if not seen.reviewed or not clouds:
        return []
    contents = [f"+ /{REVIEW_CLOUD}", f"+ /{REVIEW_STITCHES}/**"]
    plan = [shown for shown in seen.of(What.LINES) if shown.frame == clouds[0].frame]
    return [_space(seen, "Depth noise", plan or clouds, contents)]


def _pictures(seen: Seen) -> list[Part]:
    """A 2-D view for each stream of pictures, with the plan and the tool on it where its camera is known."""
    views: list[Part] = []
    for shown in seen.of(What.IMAGE, What.PLANE, What.VIDEO):
        contents = [f"+ /{shown.path}"]
        frame = f"{shown.frame}/image"
        information = None
        if shown.frame in _cameras(seen):
            information = rrb.SpatialInformation(target_frame=frame)
            root = seen.root_of(shown.frame)
            tree = seen.trees().get(root, [])
            contents += [f"+ /{camera.path}" for camera in seen.of(What.CAMERA) if camera.frame == shown.frame]
            contents += [entity for other in _of(tree, *_IN_PICTURE) for entity in _solids(other)]
            contents += [f"- /{tool.path}/trail" for tool in _of(tree, What.POSE)]  # where it was hides what is
        views.append(
            rrb.Spatial2DView(
                name=shown.topic, origin=f"/{shown.path}", contents=contents, spatial_information=information
            )
        )
    return views


def _slices(seen: Seen) -> list[Part]:
    return [rrb.Spatial2DView(name=shown.topic, origin=f"/{shown.path}/slice") for shown in seen.of(What.VOLUME)]


def _tables(seen: Seen) -> list[Part]:
    """Arrays and texts."""
    views: list[Part] = [rrb.BarChartView(name=shown.topic, origin=f"/{shown.path}") for shown in seen.of(What.BARS)]
    views += [rrb.TensorView(name=shown.topic, origin=f"/{shown.path}") for shown in seen.of(What.TENSOR)]
    return views + [rrb.TextDocumentView(name=shown.topic, origin=f"/{shown.path}") for shown in seen.of(What.TEXT)]


def _log() -> rrb.TextLogView:
    return rrb.TextLogView(
        name="Log",
        origin=f"/{LOG}",
        # a column of times is cut after the date, whatever there is of room
        columns=rrb.TextLogColumns(
            timeline_columns=[rrb.encodings.TimelineColumn(TIME_LINE, visible=False)],
            text_log_columns=["loglevel", "body"],
        ),
    )


def _words_and_numbers(seen: Seen) -> Part:
    return _row((_log(), 1), (_plots(seen), 1))


def _plots(seen: Seen) -> Part:
    """Sensors first, then how the gateway did."""
    plots = [_plot(shown.topic, f"/{shown.path}") for shown in seen.of(What.PLOT)]
    inputs = [f"+ $origin/{kind.value}/**" for kind in (Kind.ROS_IN, Kind.IGTL_IN)]  # the outputs follow them
    return _tabs([*plots, _plot("Rate (Hz)", f"/{RATES}", inputs), _plot("Latency (ms)", f"/{LATENCIES}")])


def _plot(name: str, origin: str, contents: list[str] | str = "$origin/**") -> rrb.TimeSeriesView:
    return rrb.TimeSeriesView(name=name, origin=origin, contents=contents, plot_legend=rrb.Corner2D.LeftTop)


# What stands in them


def _of(tree: Iterable[Shown], *kinds: What) -> list[Shown]:
    return [shown for shown in tree if shown.what in kinds]


def _solids(shown: Shown) -> list[str]:
    """The entities of a topic that are in space: of a picture only its plane, the picture itself has none."""
    if shown.what in {What.PLANE, What.VOLUME}:
        return [f"+ /{shown.path}/plane/**"]
    return [f"+ /{shown.path}/**"]


def _cameras(seen: Seen) -> set[str]:
    """Frames of cameras whose intrinsics are known."""
    return {shown.frame for shown in seen.of(What.CAMERA)}


def _subject(tree: list[Shown]) -> Shown:
    """What a 3-D view is of."""
    return min(tree, key=lambda shown: (_SUBJECTS.index(shown.what) if shown.what in _SUBJECTS else 99, -shown.count))


def _eye(seen: Seen, tree: list[Shown], frame: str) -> rrb.EyeControls3D | None:
    """Such that what the view shows fills it; None leaves it to the viewer.

    In a camera's frame (REP 103: x right, y down, z forward) seen from beside the camera; where there is a picture with
    a place, from before it, its top up; else from the front right above, with z up.
    """
    box = _box(seen, tree, frame)
    if box is None:
        return None
    way, up = _look(seen, tree, frame)
    centre = _as_xyz((low + high) / 2 for low, high in zip(*box, strict=True))
    right, above = _unit(_cross(up, way)), _unit(_cross(way, _cross(up, way)))
    distance = _LEAST_M
    for corner in itertools.product(*zip(*box, strict=True)):
        off = _as_xyz(at - middle for at, middle in zip(corner, centre, strict=True))
        spread = max(abs(_dot(off, right)) / math.tan(_HALF_WIDTH), abs(_dot(off, above)) / math.tan(_HALF_HEIGHT))
        distance = max(distance, _dot(off, way) + spread)
    place = tuple(at + _ROOM * distance * step for at, step in zip(centre, way, strict=True))
    return rrb.EyeControls3D(position=place, look_target=centre, eye_up=up)


def _look(seen: Seen, tree: list[Shown], frame: str) -> tuple[Xyz, Xyz]:
    """From what is seen to the eye, and what is up there; of length 1."""
    if frame in _cameras(seen) or "optical" in frame:
        return _unit(_FROM_CAMERA), (0.0, -1.0, 0.0)
    for shown in tree:
        if shown.right and shown.up:
            right, up = (_moved(seen, shown.frame, frame, axis, turn_only=True) for axis in (shown.right, shown.up))
            ahead = _cross(right, up)
            sides = zip(right, up, ahead, strict=True)
            return _unit(_as_xyz(a * _BESIDE + b * _ABOVE + c * _BEFORE for a, b, c in sides)), up
    return _unit(_FROM_ABOVE), (0.0, 0.0, 1.0)


def _box(seen: Seen, tree: list[Shown], frame: str) -> tuple[Xyz, Xyz] | None:
    """Around all that is drawn, in that frame; tools count only where there is nothing else."""
    boxed = [shown for shown in tree if shown.low is not None and shown.high is not None]
    still = [shown for shown in boxed if shown.what not in _TOOLS] or boxed
    corners = [
        _moved(seen, shown.frame, frame, corner)
        for shown in still
        for corner in itertools.product(*zip(shown.low or (), shown.high or (), strict=True))
    ]
    if not corners:
        return None
    xs, ys, zs = zip(*corners, strict=True)
    return (min(xs), min(ys), min(zs)), (max(xs), max(ys), max(zs))


def _moved(seen: Seen, source: str, target: str, point: Sequence[float], *, turn_only: bool = False) -> Xyz:
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


def _as_xyz(values: Iterable[float]) -> Xyz:
    x, y, z = values
    return x, y, z


def _unit(a: Xyz) -> Xyz:
    length = math.hypot(*a) or 1.0
    return a[0] / length, a[1] / length, a[2] / length


def _dot(a: Xyz, b: Xyz) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _cross(a: Xyz, b: Xyz) -> Xyz:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


# How they stand to each other; where nothing is (None), nothing takes its place


def _page(top: Part, below: Part) -> Part:
    return _column((top, 5), (below, 2))


def _tabs(parts: list[Part]) -> Part:
    """One view as it is, several as tabs of which the first is on top."""
    if len(parts) < 2:
        return parts[0] if parts else None
    return rrb.Tabs(*parts, active_tab=0)


def _stack(parts: list[Part]) -> Part:
    """Two above each other; more of them as tabs of the lower one."""
    return _column((_tabs(parts[:1]), 1), (_tabs(parts[1:]), 1))


def _grid(parts: list[Part]) -> Part:
    """As many beside and above each other as can be looked at; more of them as tabs of the last."""
    shown = [*parts[: _CELLS - 1], *filter(None, [_tabs(parts[_CELLS - 1 :])])]
    return _tabs(shown) if len(shown) < 2 else rrb.Grid(*shown, grid_columns=2)


def _row(*parts: tuple[Part, int]) -> Part:
    """Side by side, each with its share of the width."""
    there, shares = _there(parts)
    return _tabs(there) if len(there) < 2 else rrb.Horizontal(*there, column_shares=shares)


def _column(*parts: tuple[Part, int]) -> Part:
    """One above the other, each with its share of the height."""
    there, shares = _there(parts)
    return _tabs(there) if len(there) < 2 else rrb.Vertical(*there, row_shares=shares)


def _there(parts: tuple[tuple[Part, int], ...]) -> tuple[list[Part], list[int]]:
    there = [(part, share) for part, share in parts if part is not None]
    return [part for part, _ in there], [share for _, share in there]
