"""What a session has to show: entity paths by kind, frames, times.  Blueprints are chosen and built from this alone.

``SessionView`` fills it while it draws; nothing here knows rerun.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum

from igtl_gateway.stamp import NS_PER_S

#: Entities that are there besides those of topics.
LOG, LINKS, DROPS = "session/log", "session/links", "session/drops"
RATES, LATENCIES = "plots/rate", "plots/latency"
#: Frames of the transform tree: ``frames/<frame id>`` each, with axes.
FRAMES = "frames"
#: Where entities stand before their first row, see ``Pen.stand``.
PLACES = "places"
REVIEW = "review"
REVIEW_CLOUD, REVIEW_STITCHES, REVIEW_TABLE = f"{REVIEW}/cloud", f"{REVIEW}/stitches", f"{REVIEW}/table"
REVIEW_DISTANCE = f"{REVIEW}/distance"
REVIEW_LEGENDS = {REVIEW_CLOUD: f"{REVIEW}/legends/noise", REVIEW_DISTANCE: f"{REVIEW}/legends/distance"}


class EntityKind(Enum):
    """What an entity is to the eye, which decides the view that it belongs in."""

    CLOUD = "cloud"  #: many points, 3-D
    POINTS = "points"  #: a few points, perhaps with names, 3-D
    POSE = "pose"  #: axes of a tool; its trail is ``<path>/trail``, 3-D
    POSES = "poses"  #: several tools, ``<path>/<tool>`` each, 3-D
    FRAMES = "frames"  #: /tf: nothing at its own path but the names; the tree is at ``frames/<frame id>``
    LINES = "lines"  #: lines, trajectories, markers of lines: plans, 3-D
    MARKERS = "markers"  #: markers of other forms at ``<path>/<namespace>/<id>``, 3-D
    MESH = "mesh"  #: surface, 3-D
    IMAGE = "image"  #: picture, 2-D
    PLANE = "plane"  #: picture with a place: 2-D at ``<path>``, 3-D at ``<path>/plane``
    VOLUME = "volume"  #: tensor at ``<path>``, slice 2-D at ``<path>/slice``, slices 3-D at ``<path>/plane/i, j, k``
    VIDEO = "video"  #: encoded frames, 2-D
    CAMERA = "camera"  #: intrinsics: a pinhole in its frame, whose pictures are in the frame ``<frame id>/image``
    PLOT = "plot"  #: numbers over time
    BARS = "bars"  #: an array of numbers, bar chart
    TENSOR = "tensor"  #: an array of several dimensions
    TEXT = "text"  #: text document at its path, and a line of ``session/log``
    DATA = "data"  #: nothing to look at but the fields (selection panel); a line of ``session/log`` says so


#: Kinds that have something in 3-D.
IN_3D = frozenset(
    (
        EntityKind.CLOUD,
        EntityKind.POINTS,
        EntityKind.POSE,
        EntityKind.POSES,
        EntityKind.LINES,
        EntityKind.MARKERS,
        EntityKind.MESH,
        EntityKind.PLANE,
        EntityKind.VOLUME,
    )
)
#: Kinds that have something in 2-D at their own path (VOLUME: at ``<path>/slice``).
IN_2D = frozenset((EntityKind.IMAGE, EntityKind.PLANE, EntityKind.VIDEO))


@dataclass(slots=True)
class ShownTopic:
    """One topic and its picture.

    Attributes:
        path: entity path, without leading slash; parts are escaped, so it stands for itself in blueprints.
        topic: ROS topic.
        ros_type: of its messages.
        what: kind of picture; of the first message where messages differ.
        frame: frame id of the last message, the session's base frame where it has none.
        count: messages so far.
        outdone: how many of them came with a fuller message made of the same OpenIGTLink message (POLYDATA as
            ``polydata`` outdoes its ``mesh``): the same thing twice in 3-D.
        first_ns, last_ns: gateway time of the first and the last message, UTC ns.
        width, height: of pictures in pixels; 0 for others.
        coloured: whether a cloud has colours of its own.
        scale: of a cloud that is coloured by numbers: of which, and from blue to red with the unit.
        low, high: corners of the box around most of what was drawn (of a cloud without its outliers), metres in
            ``frame``; None while there is none.  The eye of a 3-D view is set by it.
        right, up: directions to the right and to the top of a picture with a place, in ``frame``; None for others.
    """

    path: str
    topic: str
    ros_type: str
    what: EntityKind
    frame: str = ""
    count: int = 0
    outdone: int = 0
    first_ns: int = 0
    last_ns: int = 0
    width: int = 0
    height: int = 0
    coloured: bool = False
    scale: str = ""
    low: tuple[float, float, float] | None = None
    high: tuple[float, float, float] | None = None
    right: tuple[float, float, float] | None = None
    up: tuple[float, float, float] | None = None

    @property
    def drawn(self) -> bool:
        """Whether to draw it in 3-D: it has something there that no fuller message has, too."""
        return self.what in IN_3D and not self.superseded

    @property
    def superseded(self) -> bool:
        """Whether every message of it came with a fuller one."""
        return self.outdone >= self.count


@dataclass(slots=True)
class SessionContents:
    """All of it.

    Attributes:
        base_frame: the session's base frame (of its configuration): what has no frame is drawn there.
        shown: topic → what there is of it, in the order of appearance.
        parents: child frame → parent frame, last told.
        places: child frame → its place in the parent frame, last told: x, y, z in metres, quaternion x, y, z, w.
        first_ns, last_ns: gateway time of the first and last entry, UTC ns; 0 = none.
        reviewed: whether a review of the suture plan was drawn.
        scales: clouds of the review → what their colours mean.
        fields: names of the fields that clouds had, to colour by.
        frames: child frame → its entity, ``frames/<frame id>``.
    """

    base_frame: str = "world"
    shown: dict[str, ShownTopic] = field(default_factory=dict)
    parents: dict[str, str] = field(default_factory=dict)
    places: dict[str, tuple[float, ...]] = field(default_factory=dict)
    first_ns: int = 0
    last_ns: int = 0
    reviewed: bool = False
    scales: dict[str, str] = field(default_factory=dict)
    fields: set[str] = field(default_factory=set)
    frames: dict[str, str] = field(default_factory=dict)

    def of(self, *kinds: EntityKind) -> list[ShownTopic]:
        """Everything of these kinds, in the order of appearance."""
        return [shown for shown in self.shown.values() if shown.what in kinds]

    def root_of(self, frame: str) -> str:
        """The frame without parent above ``frame`` (itself where it has none; where frames go in a circle, any)."""
        passed = {frame}
        while (parent := self.parents.get(frame)) is not None and parent not in passed:
            frame = parent
            passed.add(frame)
        return frame

    def way_to_root(self, frame: str) -> list[tuple[float, ...]]:
        """The places of ``frame`` in its parent, of that in its own, and so on up to the root."""
        steps, passed = [], {frame}
        while frame in self.places and (parent := self.parents.get(frame)) is not None:
            steps.append(self.places[frame])
            if parent in passed:
                break
            passed.add(parent)
            frame = parent
        return steps

    def trees(self) -> dict[str, list[ShownTopic]]:
        """Root frame → what is drawn in 3-D below it, the fullest first.

        What lies in different trees has no place to each other: one 3-D view each, else the viewer reports
        missing transforms.
        """
        trees: dict[str, list[ShownTopic]] = {}
        for shown in self.shown.values():
            if shown.drawn:
                trees.setdefault(self.root_of(shown.frame), []).append(shown)
        return dict(sorted(trees.items(), key=lambda tree: -sum(_WEIGHTS.get(shown.what, 1) for shown in tree[1])))

    @property
    def root(self) -> str:
        """Root of the fullest tree: the target frame of the main 3-D view."""
        return next(iter(self.trees()), self.root_of(self.base_frame))

    def frames_of(self, root: str) -> list[str]:
        """Entity paths of the frames below a root, for their axes."""
        return [path for child, path in self.frames.items() if self.root_of(child) == root]

    @property
    def seconds(self) -> float:
        """From the first entry to the last."""
        return (self.last_ns - self.first_ns) / NS_PER_S


#: How much a picture counts where trees compete for the main view.
_WEIGHTS = {
    EntityKind.CLOUD: 5,
    EntityKind.VOLUME: 5,
    EntityKind.MESH: 4,
    EntityKind.PLANE: 3,
    EntityKind.LINES: 3,
    EntityKind.POSE: 2,
    EntityKind.POSES: 2,
}

#: What stands for itself in one part of an entity path; the rest becomes ``_``, so that no tool needs escapes.
_PLAIN = frozenset("abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789_-.")


def escape_path_part(name: str) -> str:
    """A name as one part of an entity path."""
    return "".join(sign if sign in _PLAIN else "_" for sign in name) or "unnamed"


def path_of(topic: str) -> str:
    """Entity path of a topic or stream: ``/star/cloud`` → ``star/cloud``."""
    return "/".join(escape_path_part(part) for part in topic.split("/") if part) or "unnamed"
