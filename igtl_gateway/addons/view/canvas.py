"""The canvas of one topic: its entity and child entities, its frame, and its facts in ``SessionContents``."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt
import rerun as rr

from igtl_gateway.addon import ConversionError
from igtl_gateway.addon.live import NoteEvent
from igtl_gateway.addon.processes import Once
from igtl_gateway.addon.reading import Kind, Level, Note
from igtl_gateway.addons.view.colours import SERIES
from igtl_gateway.addons.view.contents import FRAMES, EntityKind, SessionContents, ShownTopic, escape_path_part
from igtl_gateway.addons.view.pen import MAX_ENTITIES, Pen, Pose, Xyz
from igtl_gateway.addons.view.trails import Trail

HUGE = 1e18  #: its square fits into float32
#: Number of points that are sampled for a box; from _MANY points on, outliers are left out.
_SAMPLE, _MANY = 2000, 500
#: Coordinates beyond this distance, in metres, are invalid and do not count for the eye of a view.
_FAR_M = 1e6
#: The owner of frames that are computed from joint states, instead of a topic.
MODEL = ""
#: Maximum number of lines that a topic can log by ``text_once``.
_ONCES = 20


@dataclass(frozen=True, slots=True)
class Options:
    """Options for drawing.

    Attributes:
        colour_by: field that colours clouds; "" = the colours of the cloud, else its intensity, else none.
        axis_m: length of the axes of a tool, in metres.
        trails: draw the trails of tools.
        plain: escape characters that the font of the viewer does not have: a headless viewer exits at one.
    """

    colour_by: str = ""
    axis_m: float = 0.02
    trails: bool = True
    plain: bool = False


class RobotModels(Protocol):
    """The robots of a session (`igtl_gateway.addons.view.robots`), for the functions that draw their messages."""

    def __bool__(self) -> bool: ...

    def describe(self, data: str | bytes, namespace: str, canvas: Canvas, urdf: Path | None = None) -> None:
        """Take a robot description (URDF)."""
        ...

    def move(self, names: tuple[str, ...], positions: Sequence[float], canvas: Canvas) -> None:
        """Move the joints with these names."""
        ...


class Canvas:
    """What the function that draws a message of the topic draws on.

    Attributes:
        robots: the robots of the session.
        shown: the facts of the topic; drawing functions refine them.
        rows: number of rows at the path of the topic: one for each message, see ``SessionView``.
        memory: what a drawing function keeps between messages (a colour scale, the visible markers).
    """

    def __init__(
        self, pen: Pen, seen: SessionContents, shown: ShownTopic, options: Options, number: int, robots: RobotModels
    ) -> None:
        self.pen = pen
        self.robots = robots
        self.shown = shown
        self.options = options
        self.rows = 0
        self.memory: dict[str, Any] = {}
        self._once = Once(_ONCES)
        self.colour = SERIES[number % len(SERIES)]
        self._seen = seen
        self._trails: dict[str, Trail] = {}
        self._parts: dict[str, str] = {}  # name → part of a path
        self._taken: set[str] = set()
        self._paths = {"": shown.path}  # child → its entity

    def fields(self, names: Iterable[str]) -> None:
        """Record the names of fields that can colour a cloud."""
        self._seen.fields.update(names)

    def part(self, name: str) -> str:
        """Return a name as one part of the path of a child: a different one for each name.

        Raises ConversionError above the maximum number of entities.
        """
        part = self._parts.get(name)
        if part is None:
            if len(self._parts) >= MAX_ENTITIES:
                raise ConversionError(f"found more than {MAX_ENTITIES:,} names, expected fewer")
            wanted = part = escape_path_part(name)
            number = 1
            while part in self._taken:
                number += 1
                part = f"{wanted}_{number}"
            if part != wanted:
                self.text_once(f"{name!r} is drawn at {part}: {wanted} is another name")
            self._parts[name] = part
            self._taken.add(part)
        return part

    def frame(self, frame_id: str) -> str:
        """Return the frame to draw in; the base frame of the session if the message names none."""
        self.shown.frame = self.pen.displayable(frame_id.lstrip("/")) or self._seen.base_frame
        return self.shown.frame

    def set_kind(self, what: EntityKind) -> None:
        """Set the kind of the topic if this is its first message."""
        if not self.shown.count:
            self.shown.what = what

    def log(self, *archetypes: Any, child: str = "", frame: str = "", static: bool = False) -> None:
        """Log a row of the topic, or of the entity ``child`` below it; 3-D contents are in ``frame``.

        ``static`` contents are there at all times: only for entities without rows.
        """
        path = self._path(child)
        if static:
            self.pen.static(path, rr.CoordinateFrame(frame), *archetypes)
            return
        if frame:
            self.pen.set_default_frame(path, frame)
        where: tuple[Any, ...] = (rr.CoordinateFrame(frame),) if frame else ()
        self.pen.log(path, *where, *archetypes)
        self._drawn(child)

    def static(self, archetype: Any, child: str = "") -> None:
        """Log static data: only for an archetype that no row of the entity has."""
        self.pen.static(self._path(child), archetype)

    def numbers(self, values: Sequence[Any], child: str = "") -> None:
        """Log a row of numbers for a plot over time."""
        self.pen.numbers(self._path(child), values)
        self._drawn(child)

    def text(self, text: str, level: str = "INFO", *, is_list: bool = False) -> None:
        """Write a line to the log of the session, unless it is the same again; of lists only a few in a second."""
        topic = self.shown.topic
        note = Note(Level[level], topic, f"{topic}: {text}", topic)
        self.pen.report(NoteEvent(self.pen.stamp_ns, Kind.ROS_OUT, note, ()), is_words=not is_list)

    def text_once(self, text: str, about: str = "") -> None:
        """Write a line to the log of the session, once for each ``about`` (default: the text)."""
        if self._once.first(about or text):
            self.text(text)

    def is_pose(self, pose: Sequence[Any]) -> bool:
        """Return whether the numbers are finite in float32 and the quaternion is not zero."""
        return all(abs(part) < HUGE for part in pose) and any(pose[3:])

    def tool(self, pose: Sequence[Any], frame: str, child: str = "", *, labelled: bool = True) -> None:
        """Draw the axes of a tool and its trail.

        Args:
            pose: x, y, z in metres, quaternion x, y, z, w; columns for many messages.
            frame: parent frame of the pose.
            child: entity below the topic, for topics with several tools.
            labelled: label the axes with the path of the entity, for frames without a name.
        """
        path = self._path(child)
        self.pen.set_default_frame(path, frame)
        self.pen.pose(path, Pose(frame, f"/{path}" if labelled else "", pose, self.options.axis_m))
        self._drawn(child)
        if self.options.trails:
            self._trail(child, frame, pose[:3])

    def box(self, places: npt.NDArray[Any]) -> None:
        """Extend the bounding box of the topic by (n, 3) positions in metres; outliers are left out."""
        some = places[:: max(len(places) // _SAMPLE, 1)].astype(np.float64)
        some = some[(np.abs(some) < _FAR_M).all(axis=1)]
        if not len(some):
            return
        low, high = np.percentile(some, (2, 98), axis=0) if len(some) >= _MANY else (some.min(axis=0), some.max(axis=0))
        if self.shown.low is not None and self.shown.high is not None:
            low, high = np.minimum(low, self.shown.low), np.maximum(high, self.shown.high)
        (a, b, c), (d, e, f) = low.tolist(), high.tolist()
        self.shown.low, self.shown.high = (a, b, c), (d, e, f)

    def extend_box(self, place: Sequence[Any]) -> None:
        """Extend the bounding box by one position: faster than ``box`` for streams of poses; columns for many."""
        if self.pen.rows is None:
            least = most = place
        else:
            least, most = [float(each.min()) for each in place], [float(each.max()) for each in place]
        if max(map(abs, (*least, *most))) < _FAR_M:
            self._extend(least, most)
        elif self.pen.rows is not None:
            near = np.stack(place, axis=1)
            near = near[(np.abs(near) < _FAR_M).all(axis=1)]
            if len(near):
                self._extend(near.min(axis=0).tolist(), near.max(axis=0).tolist())

    def _extend(self, least: Xyz, most: Xyz) -> None:
        low, high = self.shown.low, self.shown.high
        if low is None or high is None:
            (a, b, c), (d, e, f) = least, most
        else:
            (a, b, c), (d, e, f) = map(min, low, least), map(max, high, most)
        self.shown.low, self.shown.high = (a, b, c), (d, e, f)

    def link(
        self, child: str, frame: str, pose: Sequence[Any], *, static: bool = False, modelled: bool = False
    ) -> None:
        """Log one edge of the transform tree: the pose of the frame ``child`` in the frame ``frame``.

        Each frame has one entity.  If several topics publish a frame, the first of them counts; every topic that
        publishes it takes precedence over a pose that is ``modelled``: computed from joint states.
        """
        child = self.pen.displayable(child.lstrip("/"))
        owner = self.pen.owners.get(child)
        if owner is None or (owner == MODEL and not modelled):
            if owner == MODEL:
                self.text_once(f"moves {child} and other links: joint states do not move them now", "takes a robot")
            owner = self.pen.owners[child] = MODEL if modelled else self.shown.path
            self.pen.changes += 1
        if not child or child == frame or owner != (MODEL if modelled else self.shown.path):
            return
        path = self._seen.frames.get(child)
        if path is None:
            path = self._seen.frames[child] = self.pen.unique_path(f"{FRAMES}/{escape_path_part(child)}")
        self._seen.parents[child] = frame
        self._seen.places[child] = tuple(float(each[-1]) for each in pose) if self.pen.rows else tuple(pose)
        axis_m = self.pen.link_axes.get(child)
        drawn_m = self.options.axis_m if axis_m is None else axis_m
        pose_drawn = Pose(frame, child, pose, drawn_m, labelled=axis_m is None)
        if static and not self.pen.has_begun(path):  # a robot may have had a pose for it before
            self.pen.static_pose(path, pose_drawn)
        else:
            self.pen.set_default_frame(path, child)
            self.pen.begin(path, pose_drawn)
            self.pen.pose(path, pose_drawn)

    def is_settled(self, child: str, *, static: bool) -> bool:
        """Return whether ``link`` draws a pose of the frame ``child`` as it drew the last one, or draws none."""
        child = self.pen.displayable(child.lstrip("/"))
        owner = self.pen.owners.get(child)
        return owner != MODEL and owner is not None and (owner != self.shown.path or not static)

    def is_trailed(self, child: str) -> bool:
        """Return whether a tool leaves no trail, or left one before."""
        return not self.options.trails or _trail_of(child) in self._paths

    def has_stated(self, about: str) -> bool:
        """Return whether ``text_once`` writes nothing about this."""
        return self._once.is_over(about)

    def _drawn(self, child: str) -> None:
        """Count the rows of the topic."""
        if not child:
            self.rows += len(self.pen.rows) if self.pen.rows else 1

    def _path(self, child: str) -> str:
        """Return the path of the topic's entity, or of the entity ``child`` below it."""
        path = self._paths.get(child)
        if path is None:
            path = self._paths[child] = self.pen.unique_path(f"{self.shown.path}/{child}")
        return path

    def _trail(self, child: str, frame: str, place: Sequence[Any]) -> None:
        trail = self._trails.get(child)
        if trail is None:
            trail = self._trails[child] = Trail()
        pen, rows = self.pen, self.pen.rows
        if rows is None:
            if not pen.stamp_ns:
                return
            stamps, places = np.array([pen.stamp_ns]), np.array([place], np.float32)
        else:
            stamps, places = rows.stamps, np.stack(place, axis=1)
        drawn, lines = trail.lines(frame, stamps, places)
        if not drawn:
            return
        path = self._path(_trail_of(child))
        pen.set_default_frame(path, frame)
        if rows is not None:
            pen.at_rows(rows.where(np.array(drawn)))
        pen.trail(path, frame, self.colour, lines)
        pen.rows = rows


def _trail_of(child: str) -> str:
    """Return the entity below the topic with the trail of a tool."""
    return f"{child}/trail" if child else "trail"
