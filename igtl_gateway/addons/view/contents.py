"""The contents of a session view: entity paths by kind, frames, times.  Blueprints are built from this alone.

``SessionView`` fills it while it draws.  Nothing here imports rerun.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum

from igtl_gateway.addon import NS_PER_S

#: Entities that belong to no topic.
LOG, LINKS, DROPS, MARKS = "session/log", "session/links", "session/drops", "session/marks"
RATES, LATENCIES = "plots/rate", "plots/latency"
#: Plots of fields that were asked for by name: ``chosen/<number>/<curve>``.
CHOSEN = "chosen"
#: The lag between two streams.
LAG = "lag"
LAG_TEXT, LAG_CURVES = f"{LAG}/text", f"{LAG}/curves"
#: Frames of the transform tree: one entity ``frames/<frame id>`` each, with axes.
FRAMES = "frames"
#: Frames of entities before their first row, see ``Pen.stand``.
PLACES = "places"
#: Rulers of the 3-D views, one for each view.
RULERS = "session/rulers"
REVIEW = "review"
REVIEW_CLOUD, REVIEW_STITCHES, REVIEW_TABLE = f"{REVIEW}/cloud", f"{REVIEW}/stitches", f"{REVIEW}/table"
REVIEW_DISTANCE = f"{REVIEW}/distance"
REVIEW_WRONG = f"{REVIEW}/wrong"
REVIEW_LEGENDS = {REVIEW_CLOUD: f"{REVIEW}/legends/noise", REVIEW_DISTANCE: f"{REVIEW}/legends/distance"}


class EntityKind(Enum):
    """Kind of an entity: decides in which views it is drawn."""

    CLOUD = "cloud"  #: many points, 3-D
    POINTS = "points"  #: a few points, with or without labels, 3-D
    POSE = "pose"  #: axes of a tool; its trail is ``<path>/trail``, 3-D
    POSES = "poses"  #: several tools, ``<path>/<tool>`` each, 3-D
    FRAMES = "frames"  #: /tf: names at its own path, the tree at ``frames/<frame id>``
    LINES = "lines"  #: lines, trajectories, markers of lines: plans, 3-D
    MARKERS = "markers"  #: other markers at ``<path>/<namespace>/<id>``, 3-D
    MESH = "mesh"  #: surface, 3-D
    ROBOT = "robot"  #: links of a robot, ``<path>/<link>`` each; its frames are in the tree, 3-D
    IMAGE = "image"  #: image, 2-D
    PLANE = "plane"  #: image with a pose: 2-D at ``<path>``, 3-D at ``<path>/plane``
    VOLUME = "volume"  #: tensor at ``<path>``, slice 2-D at ``<path>/slice``, slices 3-D at ``<path>/plane/i, j, k``
    VIDEO = "video"  #: encoded frames, 2-D
    CAMERA = "camera"  #: intrinsics: a pinhole in its frame; its images are in the frame ``<frame id>/image``
    PLOT = "plot"  #: numbers over time
    BARS = "bars"  #: an array of numbers, bar chart
    TENSOR = "tensor"  #: an array of several dimensions
    TEXT = "text"  #: text document at its path, and a line in ``session/log``
    DATA = "data"  #: no drawing: the fields are in the selection panel, and ``session/log`` has a line


#: Kinds that are drawn in 3-D.
IN_3D = frozenset(
    (
        EntityKind.CLOUD,
        EntityKind.POINTS,
        EntityKind.POSE,
        EntityKind.POSES,
        EntityKind.LINES,
        EntityKind.MARKERS,
        EntityKind.MESH,
        EntityKind.ROBOT,
        EntityKind.PLANE,
        EntityKind.VOLUME,
    )
)
#: Kinds that are drawn in 2-D at their own path (VOLUME: at ``<path>/slice``).
IN_2D = frozenset((EntityKind.IMAGE, EntityKind.PLANE, EntityKind.VIDEO))


@dataclass(slots=True)
class ShownTopic:
    """One topic and how it is drawn.

    Attributes:
        path: entity path without a leading slash; its parts are escaped, so that blueprints can use it as it is.
        topic: ROS topic.
        ros_type: ROS type of its messages.
        what: kind; that of the first message if messages differ.
        frame: frame id of the latest message, or the base frame of the session if it has none.
        count: number of messages.
        outdone: how many of them have a fuller sibling, converted from the same OpenIGTLink message (the ``polydata``
            of a POLYDATA is fuller than its ``mesh``): both in 3-D would show the same surface twice.
        first_ns, last_ns: gateway time of the first and the last message, UTC ns.
        width, height: size of images in pixels; 0 for other kinds.
        coloured: whether a cloud has colours.
        scale: colour scale of a cloud that is coloured by a field: field, range and unit.
        low, high: corners of the bounding box (of a cloud without its outliers), metres in ``frame``; None at first.
            The eye of a 3-D view depends on it.
        links: frames of the links of a robot, at whose latest poses the eye looks; empty for other kinds.
        right, up: directions to the right and to the top of an image with a pose, in ``frame``; None for other kinds.
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
    links: tuple[str, ...] = ()
    right: tuple[float, float, float] | None = None
    up: tuple[float, float, float] | None = None

    @property
    def drawn(self) -> bool:
        """Whether to show it in 3-D: not all of its messages have a fuller sibling."""
        return self.what in IN_3D and not self.superseded

    @property
    def superseded(self) -> bool:
        """Whether every message has a fuller sibling."""
        return 0 < self.count <= self.outdone


@dataclass(slots=True)
class SessionContents:
    """The contents of a session view.

    Attributes:
        base_frame: base frame of the session, from its configuration: messages without a frame are drawn in it.
        shown: topic → its facts, in the order of appearance.
        parents: child frame → latest parent frame.
        places: child frame → its latest pose in the parent frame: x, y, z in metres, quaternion x, y, z, w.
        first_ns, last_ns: gateway time of the first and last entry, UTC ns; 0 = none.
        reviewed: whether a review of the suture plan was drawn.
        chosen: titles of the plots of fields that were asked for.
        lag: names of the two streams whose lag was drawn; "" = none.
        scales: cloud of the review → its colour scale.
        fields: names of fields of clouds, for ``--color-by``.
        frames: child frame → its entity, ``frames/<frame id>``.
    """

    base_frame: str = "world"
    shown: dict[str, ShownTopic] = field(default_factory=dict)
    parents: dict[str, str] = field(default_factory=dict)
    places: dict[str, tuple[float, ...]] = field(default_factory=dict)
    first_ns: int = 0
    last_ns: int = 0
    reviewed: bool = False
    chosen: list[str] = field(default_factory=list)
    lag: str = ""
    scales: dict[str, str] = field(default_factory=dict)
    fields: set[str] = field(default_factory=set)
    frames: dict[str, str] = field(default_factory=dict)

    def of(self, *kinds: EntityKind) -> list[ShownTopic]:
        """Return the topics of these kinds, in the order of appearance."""
        return [shown for shown in self.shown.values() if shown.what in kinds]

    def root_of(self, frame: str) -> str:
        """Return the root frame above ``frame``: itself if it has no parent, any frame of a cycle."""
        passed = {frame}
        while (parent := self.parents.get(frame)) is not None and parent not in passed:
            frame = parent
            passed.add(frame)
        return frame

    def path_to_root(self, frame: str) -> list[tuple[float, ...]]:
        """Return the poses of ``frame`` in its parent, of the parent in its parent, and so on to the root."""
        steps, passed = [], {frame}
        while frame in self.places and (parent := self.parents.get(frame)) is not None:
            steps.append(self.places[frame])
            if parent in passed:
                break
            passed.add(parent)
            frame = parent
        return steps

    def trees(self) -> dict[str, list[ShownTopic]]:
        """Return root frame → topics that are drawn in 3-D below it, the tree with the largest weight first.

        Each tree has a 3-D view of its own: no transform connects two trees, and the viewer would report that.
        """
        trees: dict[str, list[ShownTopic]] = {}
        for shown in self.shown.values():
            if shown.drawn:
                trees.setdefault(self.root_of(shown.frame), []).append(shown)
        return dict(sorted(trees.items(), key=lambda tree: -sum(_WEIGHTS.get(shown.what, 1) for shown in tree[1])))

    @property
    def root(self) -> str:
        """Root of the first of ``trees``: the target frame of the main 3-D view."""
        return next(iter(self.trees()), self.root_of(self.base_frame))

    def frames_of(self, root: str) -> list[str]:
        """Return the entity paths of the frames below a root, for their axes."""
        roots: dict[str, str] = {}
        for child in self.frames:
            passed = {child: child}
            while (frame := next(reversed(passed))) not in roots:
                parent = self.parents.get(frame)
                if parent is None:
                    roots[frame] = frame
                elif parent in passed:  # a cycle, whose root depends on where it is entered
                    roots |= {each: self.root_of(each) for each in passed}
                else:
                    passed[parent] = parent
            roots |= {each: roots[frame] for each in passed if each not in roots}
        return [path for child, path in self.frames.items() if roots[child] == root]

    @property
    def seconds(self) -> float:
        """Seconds from the first entry to the last."""
        return (self.last_ns - self.first_ns) / NS_PER_S


#: Weights of kinds: the tree with the largest sum gets the main view.
_WEIGHTS = {
    EntityKind.CLOUD: 5,
    EntityKind.VOLUME: 5,
    EntityKind.MESH: 4,
    EntityKind.ROBOT: 4,
    EntityKind.PLANE: 3,
    EntityKind.LINES: 3,
    EntityKind.POSE: 2,
    EntityKind.POSES: 2,
}

#: Characters that stay in a part of an entity path; all others become ``_``, so that nothing needs escapes.
_PLAIN = frozenset("abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789_-.")


def escape_path_part(name: str) -> str:
    """Return a name as one part of an entity path."""
    return "".join(sign if sign in _PLAIN else "_" for sign in name) or "unnamed"


def path_of(topic: str) -> str:
    """Return the entity path of a topic or stream: ``/star/cloud`` → ``star/cloud``."""
    return "/".join(escape_path_part(part) for part in topic.split("/") if part) or "unnamed"
