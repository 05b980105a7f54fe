"""Where one topic draws: its entity and what lies below, in its frame, and what is known of it."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt
import rerun as rr

from igtl_gateway.view.colours import SERIES
from igtl_gateway.view.contents import FRAMES, LOG, EntityKind, SessionContents, ShownTopic, escape_path_part
from igtl_gateway.view.pen import Pen, Pose, Xyz

NS_PER_MS = 1_000_000

#: A trail: how long it is, how close its points are in time, and how often it is drawn anew.
TRAIL_NS, _STEP_NS, _DRAW_NS = 5_000 * NS_PER_MS, 20 * NS_PER_MS, 100 * NS_PER_MS

#: Points that a box is made of, and from how many on outliers are left out.
_SAMPLE, _MANY = 2000, 500
#: Nothing that is further away, metres, decides where the eye of a view is: it is a wrong number.
_FAR_M = 1e6
#: Lines of the log that are said once may be so many for a topic.
_ONCES = 20


@dataclass(frozen=True, slots=True)
class Options:
    """How to draw.

    Attributes:
        colour_by: field of clouds that gives their colour; "" = their own colours, else intensity, else none.
        axis_m: length of a tool's axes, metres.
        trails: draw where tools have been.
        plain: escape letters that are not in the viewer's own font: without a screen it ends at one.
    """

    colour_by: str = ""
    axis_m: float = 0.02
    trails: bool = True
    plain: bool = False


@dataclass(slots=True)
class _Trail:
    """The last places of a tool."""

    points: deque[tuple[int, Xyz]] = field(default_factory=deque)
    drawn_ns: int = 0
    frame: str = ""


class Canvas:
    """Handed to the function that draws a message of the topic.

    Attributes:
        shown: what is told of the topic; functions refine it.
        rows: rows so far at the topic's own path: one for each message, see ``SessionView``.
        memory: what a function keeps from message to message (a colour scale, markers that are shown).
    """

    def __init__(self, pen: Pen, seen: SessionContents, shown: ShownTopic, options: Options, number: int) -> None:
        self.pen = pen
        self.shown = shown
        self.options = options
        self.rows = 0
        self.memory: dict[str, Any] = {}
        self.colour = SERIES[number % len(SERIES)]
        self._seen = seen
        self._trails: dict[str, _Trail] = {}
        self._paths = {"": shown.path}  # child → its entity

    def fields(self, names: Iterable[str]) -> None:
        """Say what a cloud could be coloured by."""
        self._seen.fields.update(names)

    def frame(self, frame_id: str) -> str:
        """The frame to draw in; the session's base frame where the message names none."""
        self.shown.frame = self.pen.letters(frame_id.lstrip("/")) or self._seen.base_frame
        return self.shown.frame

    def what(self, what: EntityKind) -> None:
        """What the topic's picture is, if this is its first message."""
        if not self.shown.count:
            self.shown.what = what

    def log(self, *archetypes: Any, child: str = "", frame: str = "") -> None:
        """A row of the topic (or of ``child`` below it), in 3-D in the frame ``frame``."""
        path = self._path(child)
        if frame:
            self.pen.stand(path, frame)
        where: tuple[Any, ...] = (rr.CoordinateFrame(frame),) if frame else ()
        self.pen.log(path, *where, *archetypes)
        self.rows += not child

    def static(self, archetype: Any, child: str = "") -> None:
        """What holds for the whole session: of an archetype that no row of the entity has."""
        self.pen.static(self._path(child), archetype)

    def numbers(self, values: Sequence[float], child: str = "") -> None:
        """A row of numbers over time."""
        self.pen.numbers(self._path(child), values)
        self.rows += not child

    def text(self, text: str, level: str = "INFO", colour: int | None = None) -> None:
        """A line of the session's log."""
        self.pen.text(LOG, f"{self.shown.topic}: {text}", level, colour)

    def once(self, text: str, about: str = "") -> None:
        """A line of the session's log, only the first one of all ``about`` the same thing (default: the text)."""
        said = self.memory.setdefault("said", set())
        if (about or text) not in said and len(said) < _ONCES:
            said.add(about or text)
            self.text(text)

    def tool(self, pose: Xyz, frame: str, child: str = "", *, labelled: bool = True) -> None:
        """Axes of a tool and its trail.

        Args:
            pose: x, y, z in metres, quaternion x, y, z, w.
            frame: the frame that the pose is given in.
            child: entity below the topic, where the topic has several tools.
            labelled: write the entity's path at the axes, as their frame has no name of its own.
        """
        path = self._path(child)
        self.pen.stand(path, frame)
        self.pen.pose(path, Pose(frame, f"/{path}" if labelled else "", pose[:3], pose[3:], self.options.axis_m))
        self.rows += not child
        if self.options.trails and self.pen.stamp_ns:
            self._trail(child, frame, pose[:3])

    def box(self, places: npt.NDArray[Any]) -> None:
        """Where the topic's things are: the eye of a 3-D view is set by the box around most of them."""
        some = places[:: max(len(places) // _SAMPLE, 1)].astype(np.float64)
        some = some[(np.abs(some) < _FAR_M).all(axis=1)]
        if not len(some):
            return
        low, high = np.percentile(some, (2, 98), axis=0) if len(some) >= _MANY else (some.min(axis=0), some.max(axis=0))
        if self.shown.low is not None and self.shown.high is not None:
            low, high = np.minimum(low, self.shown.low), np.maximum(high, self.shown.high)
        (a, b, c), (d, e, f) = low.tolist(), high.tolist()
        self.shown.low, self.shown.high = (a, b, c), (d, e, f)

    def reach(self, place: Xyz) -> None:
        """As ``box``, for a single place: tools come by the thousand."""
        low, high = self.shown.low, self.shown.high
        x, y, z = place
        if max(abs(x), abs(y), abs(z)) >= _FAR_M:
            return
        if low is None or high is None:
            self.shown.low = self.shown.high = (x, y, z)
        elif not (low[0] <= x <= high[0] and low[1] <= y <= high[1] and low[2] <= z <= high[2]):
            self.shown.low = (min(low[0], x), min(low[1], y), min(low[2], z))
            self.shown.high = (max(high[0], x), max(high[1], y), max(high[2], z))

    def link(self, child: str, frame: str, pose: Xyz, *, static: bool = False) -> None:
        """One edge of the transform tree: the frame ``child`` in the frame ``frame``.

        A frame is told at one entity, whatever topics tell it; the topic that told it first is believed.
        """
        child = self.pen.letters(child.lstrip("/"))
        owner = self.pen.owners.setdefault(child, self.shown.path)
        if not child or child == frame or owner != self.shown.path:
            return
        path = self._seen.frames.get(child)
        if path is None:
            path = self._seen.frames[child] = self.pen.claim(f"{FRAMES}/{escape_path_part(child)}")
        self._seen.parents[child] = frame
        self._seen.places[child] = tuple(pose)
        told = Pose(frame, child, pose[:3], pose[3:], self.options.axis_m)
        if static:
            self.pen.static_pose(path, told)
        else:
            self.pen.stand(path, child)
            self.pen.begin(path, told)
            self.pen.pose(path, told)

    def _path(self, child: str) -> str:
        """The entity of the topic, or of ``child`` below it."""
        path = self._paths.get(child)
        if path is None:
            path = self._paths[child] = self.pen.claim(f"{self.shown.path}/{child}")
        return path

    def _trail(self, child: str, frame: str, place: Xyz) -> None:
        trail = self._trails.get(child)
        if trail is None:
            trail = self._trails[child] = _Trail(frame=frame)
        now = self.pen.stamp_ns
        if trail.frame != frame:
            trail.points.clear()
            trail.frame = frame
        if trail.points and now - trail.points[-1][0] < _STEP_NS:
            return
        trail.points.append((now, place))
        while now - trail.points[0][0] > TRAIL_NS:
            trail.points.popleft()
        if now - trail.drawn_ns >= _DRAW_NS and len(trail.points) > 1:
            trail.drawn_ns = now
            strip = np.array([point for _, point in trail.points], np.float32)
            lines = rr.LineStrips3D([strip], colors=[self.colour], radii=[rr.Radius.ui_points(1.5)])
            self.log(lines, child=f"{child}/trail" if child else "trail", frame=frame)
