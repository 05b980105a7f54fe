"""Blueprints: which views a session gets, where the eye of each view is, and what it contains.

A blueprint is built from ``SessionContents`` alone.  There are four: ``star`` for suture plans on a cloud,
``ultrasound`` for images with a pose, ``navigation`` for volumes, surfaces, robots and tools, ``generic`` for
everything else.  They differ in the size and the position of their views.  The same functions build the views of all
four.

Two rules keep the views free of errors.  A 3-D view shows entities of one frame tree only, because no transform
connects different trees.  A 2-D view shows 3-D entities only where the intrinsics of its camera are known.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import rerun.blueprint as rrb

from igtl_gateway.addon import ConfigError, one_of
from igtl_gateway.addon.reading import Kind
from igtl_gateway.addons.view.contents import (
    CHOSEN,
    DROPS,
    LAG_CURVES,
    LAG_TEXT,
    LATENCIES,
    LOG,
    RATES,
    REVIEW_CLOUD,
    REVIEW_DISTANCE,
    REVIEW_LEGENDS,
    REVIEW_STITCHES,
    REVIEW_TABLE,
    REVIEW_WRONG,
    RULERS,
    EntityKind,
    SessionContents,
    ShownTopic,
)
from igtl_gateway.addons.view.eye import eye_of

TIME_LINE = "gateway_time"
DARK = (18, 20, 24)  #: background of 3-D views: dark tissue and black tools stay visible on it

#: Kinds that can be the subject of a 3-D view, by precedence: the eye is set to the subject.
_SUBJECTS = (
    EntityKind.CLOUD,
    EntityKind.VOLUME,
    EntityKind.MESH,
    EntityKind.ROBOT,
    EntityKind.PLANE,
    EntityKind.LINES,
    EntityKind.POINTS,
    EntityKind.MARKERS,
    EntityKind.POSE,
)
_LEGEND_ROOM = 0.45  #: room for the legend of a plot, as a fraction of the time of the session
_CELLS = 6  #: maximum number of views in a grid
_IN_PICTURE = (
    EntityKind.LINES,
    EntityKind.POINTS,
    EntityKind.MARKERS,
    EntityKind.POSE,
)  #: 3-D kinds that are projected into a camera image

Part = Any  #: a view or a container of rerun (mypy does not know their types); None: nothing to show


def choose(seen: SessionContents) -> str:
    """Return the name of the blueprint for the contents of the session."""
    planned = any(_of(tree, EntityKind.CLOUD) and _of(tree, EntityKind.LINES) for tree in seen.trees().values())
    if seen.reviewed or planned:
        return "star"
    if any(plane.count > 1 for plane in seen.of(EntityKind.PLANE)) and not seen.of(EntityKind.VOLUME):
        return "ultrasound"
    if seen.of(EntityKind.VOLUME, EntityKind.MESH, EntityKind.ROBOT, EntityKind.POSE, EntityKind.POSES):
        return "navigation"
    return "generic"


def blueprint(name: str, seen: SessionContents) -> rrb.Blueprint:
    """Build the blueprint with this name for this session.

    Raises ConfigError for an unknown name.
    """
    if name not in _BLUEPRINTS:
        raise ConfigError(f"blueprint: found {name!r}, expected {one_of(name, NAMES)}")
    return rrb.Blueprint(
        _BLUEPRINTS[name](seen),
        rrb.TimePanel(state="collapsed", timeline=TIME_LINE),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        auto_views=False,
        auto_layout=False,
    )


def _star(seen: SessionContents) -> Part:
    """Large: the tissue.  Beside it: the camera image and the noise.  Below: text and plots."""
    words = _words(seen)
    if seen.reviewed:
        words.insert(0, rrb.TextDocumentView(name="Stitches", origin=f"/{REVIEW_TABLE}"))
    side = _stack([*_pictures(seen)[:1], *_noise(seen), *_pictures(seen)[1:]])
    below = _row((_tabs(words), 3), (_plots(seen), 2))
    return _page(_row((_tabs(_spaces(seen)), 3), (side, 2)), below)


def _ultrasound(seen: SessionContents) -> Part:
    """The image and the 3-D view side by side."""
    top = _row((_tabs(_pictures(seen)), 1), (_tabs(_spaces(seen)), 1))
    return _page(top, _words_and_numbers(seen))


def _navigation(seen: SessionContents) -> Part:
    """Large: the 3-D view.  Beside it: slices and images."""
    top = _row((_tabs(_spaces(seen)), 2), (_stack([*_slices(seen), *_pictures(seen)]), 1))
    return _page(top, _words_and_numbers(seen))


def _generic(seen: SessionContents) -> Part:
    """One view for each kind of content that the session has."""
    everything = _grid([*_slices(seen), *_pictures(seen), *_tables(seen)])
    return _page(_row((_tabs(_spaces(seen)), 1), (everything, 1)), _words_and_numbers(seen))


_BLUEPRINTS: dict[str, Callable[[SessionContents], Part]] = {
    "star": _star,
    "ultrasound": _ultrasound,
    "navigation": _navigation,
    "generic": _generic,
}
NAMES = tuple(_BLUEPRINTS)


# The views


def _spaces(seen: SessionContents) -> list[Part]:
    """Build a 3-D view for each frame tree, in the order of ``SessionContents.trees``."""
    views: list[Part] = []
    for number, (root, tree) in enumerate(seen.trees().items()):
        contents = [entity for shown in tree for entity in _solids(shown)]
        contents.append(f"+ /{RULERS}/{number}")
        if seen.reviewed and _of(tree, EntityKind.CLOUD):
            contents.append(f"+ /{REVIEW_WRONG}/**")
        scales = [shown.scale for shown in tree if shown.scale]
        views.append(
            _space(
                seen,
                ", ".join([f"Space of {root} (m)", *scales]),
                tree,
                [*contents, *(f"+ /{path}" for path in seen.frames_of(root))],
            )
        )
    return views


def _space(seen: SessionContents, name: str, tree: list[ShownTopic], contents: list[str]) -> rrb.Spatial3DView:
    frame = target_frame(seen, tree)
    return rrb.Spatial3DView(
        name=name,
        origin="/",
        contents=contents,
        background=DARK,
        line_grid=False,
        spatial_information=rrb.SpatialInformation(target_frame=frame),
        eye_controls=_eye(seen, tree, frame),
    )


def _noise(seen: SessionContents) -> list[Part]:
    """Views of a review: the cloud coloured by depth noise and by distance from the plan, with the stitches."""
    clouds = [shown for tree in seen.trees().values() for shown in tree if shown.what is EntityKind.CLOUD]
    if not seen.reviewed or not clouds:
        return []
    plan = [shown for shown in seen.of(EntityKind.LINES) if shown.frame == clouds[0].frame]
    return [
        _space(
            seen,
            seen.scales.get(cloud, cloud),
            plan or clouds,
            [f"+ /{cloud}", f"+ /{REVIEW_STITCHES}/**", f"+ /{REVIEW_LEGENDS[cloud]}/**"],
        )
        for cloud in (REVIEW_CLOUD, REVIEW_DISTANCE)
    ]


def _pictures(seen: SessionContents) -> list[Part]:
    """Build a 2-D view for each image stream, with the plan and the tool if its camera is known."""
    views: list[Part] = []
    for shown in seen.of(EntityKind.IMAGE, EntityKind.PLANE, EntityKind.VIDEO):
        if shown.superseded:
            continue
        contents = [f"+ /{shown.path}"]
        frame = f"{shown.frame}/image"
        information = None
        if shown.frame in _cameras(seen):
            information = rrb.SpatialInformation(target_frame=frame)
            root = seen.root_of(shown.frame)
            tree = seen.trees().get(root, [])
            contents += [f"+ /{camera.path}" for camera in seen.of(EntityKind.CAMERA) if camera.frame == shown.frame]
            contents += [entity for other in _of(tree, *_IN_PICTURE) for entity in _solids(other)]
            contents += [f"- /{tool.path}/trail" for tool in _of(tree, EntityKind.POSE)]  # a trail hides the image
        views.append(
            rrb.Spatial2DView(
                name=shown.topic, origin=f"/{shown.path}", contents=contents, spatial_information=information
            )
        )
    return views


def _slices(seen: SessionContents) -> list[Part]:
    return [rrb.Spatial2DView(name=shown.topic, origin=f"/{shown.path}/slice") for shown in seen.of(EntityKind.VOLUME)]


def _tables(seen: SessionContents) -> list[Part]:
    """Build the views of arrays and text."""
    views: list[Part] = [
        rrb.BarChartView(name=shown.topic, origin=f"/{shown.path}") for shown in seen.of(EntityKind.BARS)
    ]
    views += [rrb.TensorView(name=shown.topic, origin=f"/{shown.path}") for shown in seen.of(EntityKind.TENSOR)]
    return views + [
        rrb.TextDocumentView(name=shown.topic, origin=f"/{shown.path}") for shown in seen.of(EntityKind.TEXT)
    ]


def _log() -> rrb.TextLogView:
    return rrb.TextLogView(
        name="Log",
        origin=f"/{LOG}",
        # rerun cuts a column of times after the date, even if there is room
        columns=rrb.TextLogColumns(
            timeline_columns=[rrb.encodings.TimelineColumn(TIME_LINE, visible=False)],
            text_log_columns=["loglevel", "body"],
        ),
    )


def _words_and_numbers(seen: SessionContents) -> Part:
    return _row((_tabs(_words(seen)), 1), (_plots(seen), 1))


def _words(seen: SessionContents) -> list[Part]:
    lag = [rrb.TextDocumentView(name="Lag", origin=f"/{LAG_TEXT}")] if seen.lag else []
    return [*lag, _log()]


def _plots(seen: SessionContents) -> Part:
    """Plots of sensors, then plots of the gateway: rates and latencies."""
    plots = [_plot(seen, shown.topic, f"/{shown.path}") for shown in seen.of(EntityKind.PLOT)]
    inputs = [f"+ $origin/{kind.value}/**" for kind in (Kind.ROS_IN, Kind.IGTL_IN)]  # outputs follow from the inputs
    has_rates = seen.seconds >= 1  # a shorter session has none
    rates = [_plot(seen, "Rate (Hz)", f"/{RATES}", inputs)] if has_rates else []
    lag = [_plot(seen, seen.lag, f"/{LAG_CURVES}")] if seen.lag else []
    chosen = [_plot(seen, title, f"/{CHOSEN}/{number}") for number, title in enumerate(seen.chosen)]
    gateway = [_plot(seen, "Latency (ms)", f"/{LATENCIES}"), _plot(seen, "Drops and gaps", f"/{DROPS}")]
    return _tabs([*chosen, *lag, *plots, *rates, *gateway])


def _plot(
    seen: SessionContents, name: str, origin: str, contents: list[str] | str = "$origin/**"
) -> rrb.TimeSeriesView:
    """Build a plot with room for its legend before the first time: rerun draws legends over the curves."""
    axis = None
    if seen.last_ns > seen.first_ns:
        room_ns = round(_LEGEND_ROOM * (seen.last_ns - seen.first_ns))
        begin, end = (_boundary(time_ns) for time_ns in (max(seen.first_ns - room_ns, 1), seen.last_ns))
        axis = rrb.TimeAxis(view_range=rrb.TimeRange(begin, end))
    return rrb.TimeSeriesView(
        name=name, origin=origin, contents=contents, plot_legend=rrb.Corner2D.LeftTop, axis_x=axis
    )


def _boundary(time_ns: int) -> rrb.TimeRangeBoundary:
    return rrb.TimeRangeBoundary.absolute(nanos=time_ns)


# Contents of views


def _of(tree: Iterable[ShownTopic], *kinds: EntityKind) -> list[ShownTopic]:
    return [shown for shown in tree if shown.what in kinds]


def _solids(shown: ShownTopic) -> list[str]:
    """Return the 3-D entities of a topic: of an image only its plane, because the image itself is 2-D."""
    if shown.what in {EntityKind.PLANE, EntityKind.VOLUME}:
        return [f"+ /{shown.path}/plane/**"]
    return [f"+ /{shown.path}/**"]


def _cameras(seen: SessionContents) -> set[str]:
    """Return the frames of cameras with known intrinsics."""
    return {shown.frame for shown in seen.of(EntityKind.CAMERA)}


def _subject(tree: list[ShownTopic]) -> ShownTopic:
    """Return the subject of a 3-D view."""
    return min(tree, key=lambda shown: (_SUBJECTS.index(shown.what) if shown.what in _SUBJECTS else 99, -shown.count))


def target_frame(seen: SessionContents, tree: list[ShownTopic]) -> str:
    """Return the frame of a 3-D view: that of its subject, which exists before any transform is known."""
    subject = _subject(tree)
    # in the frame of a moving probe its image would not move, but everything else would
    return seen.root_of(subject.frame) if subject.what is EntityKind.PLANE else subject.frame


def is_camera(seen: SessionContents, frame: str) -> bool:
    """Return whether a frame has the axes of a camera (REP 103: y down, z forward)."""
    return frame in _cameras(seen) or "optical" in frame


def _eye(seen: SessionContents, tree: list[ShownTopic], frame: str) -> rrb.EyeControls3D | None:
    """Return the eye of a 3-D view; None leaves the choice to the viewer."""
    eye = eye_of(seen, tree, frame, camera=is_camera(seen, frame))
    return eye and rrb.EyeControls3D(position=eye.place, look_target=eye.target, eye_up=eye.up)


# Layout: containers leave out parts that are None


def _page(top: Part, below: Part) -> Part:
    return _column((top, 5), (below, 2))


def _tabs(parts: list[Part]) -> Part:
    """Return one view unchanged, several views as tabs with the first in front."""
    if len(parts) < 2:
        return parts[0] if parts else None
    return rrb.Tabs(*parts, active_tab=0)


def _stack(parts: list[Part]) -> Part:
    """Stack two views; further views become tabs of the lower one."""
    return _column((_tabs(parts[:1]), 1), (_tabs(parts[1:]), 1))


def _grid(parts: list[Part]) -> Part:
    """Arrange up to ``_CELLS`` views in a grid; further views become tabs of the last cell."""
    shown = [*parts[: _CELLS - 1], *filter(None, [_tabs(parts[_CELLS - 1 :])])]
    return _tabs(shown) if len(shown) < 2 else rrb.Grid(*shown, grid_columns=2)


def _row(*parts: tuple[Part, int]) -> Part:
    """Arrange views side by side, each with its share of the width."""
    there, shares = _non_empty(parts)
    return _tabs(there) if len(there) < 2 else rrb.Horizontal(*there, column_shares=shares)


def _column(*parts: tuple[Part, int]) -> Part:
    """Arrange views one above the other, each with its share of the height."""
    there, shares = _non_empty(parts)
    return _tabs(there) if len(there) < 2 else rrb.Vertical(*there, row_shares=shares)


def _non_empty(parts: tuple[tuple[Part, int], ...]) -> tuple[list[Part], list[int]]:
    there = [(part, share) for part, share in parts if part is not None]
    return [part for part, _ in there], [share for _, share in there]
