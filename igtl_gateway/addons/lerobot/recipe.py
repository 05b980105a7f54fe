"""The recipe of a data set; ``docs/how-to/lerobot.md`` has the table of keys; ``recipe_file`` reads and checks it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

FORMATS = ("v2.1", "v3.0")
RATES = ("same", "any")
CLOCKS = ("auto", "source", "gateway")
CODECS = ("h264", "av1")
RULES = ("nearest", "hold", "interpolate", "none")
FILLS = ("cut", "hold")
ORIENTATIONS = ("quaternion", "rotation_vector", "rotation_6d", "none")
CUTS = ("whole", "ranges", "markers", "notes", "marks", "gap", "still")
IMAGES, OBSERVATION = "observation.images.", "observation."
STATE, ACTION = "observation.state", "action"
#: Columns of a recipe with ``stamps``.
TIME, STAMPS = "time_ns", "stamp_ns"
#: Columns that every data set has; no feature can have these names.
OWN_COLUMNS = ("timestamp", "frame_index", "episode_index", "index", "task_index")


@dataclass(frozen=True, slots=True)
class Feature:
    """One row ``[[feature]]``: a stream that becomes a feature, or a part of one.

    Attributes:
        name: feature; rows of the same name are joined in their order.
        stream: key of the stream in the recording.
        frame: tool or child frame, for streams with several poses.
        fields: columns of ``Stream.to_arrow``; empty: the pose, the picture or the text.
        names: names of the numbers in info.json; empty: derived.
        orientation: how a pose has its rotation.
        rule: how the stream is sampled; empty: ``interpolate`` for poses, ``nearest`` for pictures, else ``hold``.
            ``none`` is for strings: each is in the frame nearest to it, and in no other one.
        tolerance_ms: largest gap (interpolate), distance (nearest) or age (hold); None: any.
        fill: what happens beyond the tolerance: ``cut`` ends the episode, ``hold`` repeats the last sample.
        lag_ms: subtracted from the stamps.
        lag: ``"measured"``: the lag behind ``against`` by ``sync`` is subtracted.
        against: key of the stream that the lag is measured against.
        window: (low, high) values that become black and white, for pictures of more than 8 bits.
        depth_mm: (low, high) depth in mm of the lowest and the highest code of a video of 12 bits; empty: no depth.
        native: whether all messages are in a table of their own, too, at the rate of the stream.
        next_of: name of the feature whose next value this one has; then nothing but the name is set.
    """

    name: str
    stream: str = ""
    frame: str = ""
    fields: tuple[str, ...] = ()
    names: tuple[str, ...] = ()
    orientation: str = "quaternion"
    rule: str = ""
    tolerance_ms: float | None = 100.0
    fill: str = "cut"
    lag_ms: float = 0.0
    lag: str = ""
    against: str = ""
    window: tuple[float, ...] = ()
    depth_mm: tuple[float, ...] = ()
    native: bool = False
    next_of: str = ""

    @property
    def is_picture(self) -> bool:
        """Whether the feature is a video."""
        return self.name.startswith(IMAGES)


@dataclass(frozen=True, slots=True)
class Range:
    """A row ``[[episodes.range]]``: seconds from the start of the recording, the end not included, and its task."""

    start: float
    end: float
    task: str = ""


@dataclass(frozen=True, slots=True)
class Cuts:
    """The table ``[episodes]``.

    Attributes:
        by: ``whole``, ``ranges``, ``markers`` (strings of a stream), ``notes``, ``marks`` (phases), ``gap`` or
            ``still`` (of a stream).
        stream: the stream of the markers, of the gaps or of the movement.
        start, stop: what the strings that start and stop an episode begin with; the rest of the start is the task.
        label: glob of the labels of the phases; the text of the mark is the task.
        pause_s: length of a gap, or of a time without movement, that ends an episode.
        still_mm: movement below this within ``pause_s`` does not count.
        range: the rows of ``ranges``.
    """

    by: str = "whole"
    stream: str = ""
    start: str = "start"
    stop: str = "stop"
    label: str = "**"
    pause_s: float = 1.0
    still_mm: float = 1.0
    range: tuple[Range, ...] = ()


@dataclass(frozen=True, slots=True)
class Recipe:
    """A recipe; the attributes without a table of their own are those of ``[dataset]``.

    Attributes:
        fps: frames per second.
        task: what is done, where the episode has no text of its own.
        format: ``v2.1`` or ``v3.0``.
        robot_type: for info.json.
        clock: ``source``: the senders' stamps; ``gateway``: times of receipt; ``auto``: source if every
            message has one.
        codec: of the videos.
        min_frames: shorter episodes are left out.
        split_long: divide episodes that are too long for float32 time stamps, instead of refusing them.
        measure_lags: measure the lags between the streams for the card.
        stamps: whether the time of each frame and the stamps of its messages are features.
        features: the rows of ``[[feature]]``.
        episodes: the table ``[episodes]``.
        rates: ``same``: sessions whose streams have other rates are refused; ``any``: they are not.
        splits: name → share, or names of sessions or patients, or, for one session, a half-open range ``"0:8"`` of
            demonstrations.
        patient: what is a patient in the path of a session; "": each session is alone.
        card: heading of the card → text, of what the recording does not know.
    """

    fps: int
    task: str
    format: str = "v2.1"
    robot_type: str = "unknown"
    clock: str = "auto"
    codec: str = "h264"
    min_frames: int = 2
    split_long: bool = False
    measure_lags: bool = True
    stamps: bool = False
    features: tuple[Feature, ...] = ()
    episodes: Cuts = Cuts()
    rates: str = "same"
    splits: Mapping[str, str | float | tuple[str, ...]] | None = None
    patient: str = ""
    card: Mapping[str, str] | None = None

    def rows(self, name: str) -> list[int]:
        """Return the indices of the rows of a feature."""
        return [index for index, row in enumerate(self.features) if row.name == name]

    def label(self, index: int) -> str:
        """Return the name of a row: that of its feature, and its number among the rows of this name."""
        name = self.features[index].name
        return f"{name}[{self.rows(name).index(index)}]"

    @property
    def names(self) -> list[str]:
        """The names of the features, in their order."""
        return list(dict.fromkeys(row.name for row in self.features))

    @property
    def has_next(self) -> bool:
        """Whether a feature has the next value of another one, so that an episode needs one more moment."""
        return any(row.next_of for row in self.features)
