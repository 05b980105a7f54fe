"""The samples of one stream: times on the clock of the data set, entry numbers, and values in metres and radians."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from igtl_gateway.addon import NS_PER_S, ConfigError, GatewayError, one_of
from igtl_gateway.addon.notes import StampCorrection
from igtl_gateway.addon.reading import Recording, Stream
from igtl_gateway.addon.streams import NAME_FIELDS, between_poses, by_name, completed, one_clock, quaternions_of
from igtl_gateway.addon.terminal import count_text, counted
from igtl_gateway.addons.lerobot.pictures import Pictures, has_pictures
from igtl_gateway.addons.lerobot.recipe import Feature
from igtl_gateway.addons.sync.lag import Lag, Verdict, measure_lag
from igtl_gateway.addons.sync.lags import POSES_BY_NAME, movement, picture_components
from igtl_gateway.addons.sync.signal import Signal

Array = npt.NDArray[Any]
Times = npt.NDArray[np.int64]

#: Units of columns → the unit in the data set, and the factor.
_UNITS = {"um": ("m", 1e-6), "mm": ("m", 1e-3), "cm": ("m", 1e-2), "dm": ("m", 1e-1), "deg": ("rad", np.pi / 180)}
_JOINTS, _POSITION = "sensor_msgs/msg/JointState", "position"
_TEXTS = {"STRING": "string", "std_msgs/msg/String": "data"}
#: Kind → its name, and its rules, of which the first one is the usual one.
_RULES = {
    "pose": ("a pose", ("interpolate", "nearest", "hold")),
    "picture": ("a picture", ("nearest", "hold")),
    "numbers": ("numbers", ("hold", "nearest", "interpolate")),
    "text": ("a string", ("hold", "nearest", "none")),
}
_AXES = ("x", "y", "z")
_ORIENTATION_NAMES = {
    "quaternion": ("qx", "qy", "qz", "qw"),
    "rotation_vector": ("rx", "ry", "rz"),
    "rotation_6d": ("r11", "r21", "r31", "r12", "r22", "r32"),
    "none": (),
}
#: Numbers of a row of the recipe in a frame: an arm has ten, and a hundred sensors have a thousand.
MAX_NUMBERS = 4096
#: Columns of a table that are not numbers of the message.
_HEADS = ("entry", "time_ns", "source_ns")


@dataclass(frozen=True, slots=True, eq=False)
class Samples:
    """The usable samples of a row of the recipe, sorted by time, one for each time.

    Attributes:
        row: the row of the recipe, with the rule that applies.
        type: of the messages.
        kind: ``"pose"``, ``"numbers"``, ``"text"`` or ``"picture"``.
        times: (N,) int64, strictly increasing, ns on the clock of the data set, without the lag.
        stamps: (N,) int64, the stamps as recorded, ns; on the clock ``gateway`` times of receipt.
        entries: (N,) int64, entry numbers; 0 in files of other programs.
        values: (N, 4, 4) poses in m; (N, K) numbers; (N,) strings; (N,) indices of pictures.
        names: names of the numbers.
        recorded_names: those that they have in the recording.
        units: the units of the numbers, as far as the recording states them.
        count: messages in the stream.
        unusable, duplicates, disordered: messages without a value, with the time of another one, with a time before
            that of the message before.
        pictures: the pictures, for ``"picture"``.
        correction: what was subtracted from the stamps.
        lag: the measured lag, if the recipe asks for it.
    """

    row: Feature
    type: str
    kind: str
    times: Times
    stamps: Times
    entries: Times
    values: Any
    names: tuple[str, ...]
    recorded_names: tuple[str, ...]
    units: tuple[str, ...]
    count: int
    unusable: int
    duplicates: int
    disordered: int
    pictures: Pictures | None = None
    correction: StampCorrection | None = None
    lag: Lag | None = None

    @property
    def are_angles(self) -> npt.NDArray[np.bool_]:
        """(K,) bool, whether each number is the position of a joint, of which most are angles."""
        last = (each.rpartition(".")[2] for each in self.recorded_names)
        return np.array([self.type == _JOINTS and each.startswith(_POSITION) for each in last], np.bool_)

    def at(self, before: Array, after: Array, share: Array) -> Any:
        """Return values at ``share`` (N,) of the way from the samples ``before`` to ``after`` (indices, N).

        Poses and numbers are (N, K) float64, with rotations as the row has them; strings and pictures those ``before``,
        and by the rule ``none`` the strings from ``before`` to ``after``, a line each.
        """
        if self.kind == "pose":
            found = between_poses(self.values[before], self.values[after], share)
            return np.concatenate([found[:, :3, 3], orientation(found, self.row.orientation)], axis=1)
        if self.kind == "numbers":
            one, two = self.values[before], self.values[after]
            parts = np.broadcast_to(share[:, None], one.shape)
            # between two angles that are more than half a turn apart, a number in the middle may be none of the joint
            parts = np.where(self.are_angles & (np.abs(two - one) > np.pi), parts > 0.5, parts)
            return np.where(parts == 0, one, np.where(parts == 1, two, one + parts * (two - one)))
        if self.row.rule == "none":
            lines = ("\n".join(self.values[one : two + 1]) for one, two in zip(before, after, strict=True))
            return np.array(list(lines), object)
        return self.values[before]


def orientation(poses: Array, form: str) -> Array:
    """Return the rotations of poses (N, 4, 4) as (N, K): a quaternion x, y, z, w with w ≥ 0, or another form."""
    if form == "none":
        return np.zeros((len(poses), 0))
    if form == "rotation_6d":
        return np.concatenate([poses[:, :3, 0], poses[:, :3, 1]], axis=1)
    quaternions = np.asarray(quaternions_of(poses)[0])
    if form == "quaternion":
        return quaternions
    sines = np.linalg.norm(quaternions[:, :3], axis=1)
    angles = 2 * np.arctan2(sines, quaternions[:, 3])
    return np.asarray(quaternions[:, :3] * np.where(sines > 1e-12, angles / np.maximum(sines, 1e-12), 2.0)[:, None])


def stream_of(recording: Recording, key: str, place: str) -> Stream:
    """Return a stream with messages.  Raises ConfigError with ``place``."""
    try:
        stream = recording[key]
    except KeyError as error:
        raise ConfigError(f"{place}: {error.args[0]}") from None
    if not len(stream):
        raise ConfigError(f"{place}: found no message in {key}, expected one or more")
    return stream


class JoinedStreams:
    """Streams on the one clock of a data set.

    Args:
        streams: those of the features.
        wanted: ``auto``, ``source`` or ``gateway``.
        others: streams of events; where they fit, they have this clock, otherwise their gateway times are moved to it.

    Attributes:
        clock: ``source`` or ``gateway``.
        notes: what was corrected, or is assumed.
        offset_ns: gateway time minus the clock: the least age of the streams.

    Raises ConfigError: ``source``, and a message of a feature has no stamp.
    """

    def __init__(self, streams: Sequence[Stream], wanted: str, others: Sequence[Stream] = ()) -> None:
        every = list({each.key: each for each in streams}.values())
        try:
            one = one_clock([each.stream_times for each in every], wanted)
        except ConfigError as error:
            raise ConfigError(f"dataset.{error}") from None
        for other in others:
            if other.key not in {each.key for each in every} and one.name == "source":
                more = one_clock([*(each.stream_times for each in every), other.stream_times])
                if more.name == "source":
                    one, every = more, [*every, other]
        self._one, self._places = one, {each.key: number for number, each in enumerate(every)}
        self.clock, self.notes = one.name, one.notes
        ages = [int((each.times - self.times(each)).min()) for each in every if len(each.times)]
        self.offset_ns = min(ages, default=0) if self.clock == "source" else 0

    def times(self, stream: Stream, stamps: Times | None = None) -> Times:
        """Return the times of the messages of a stream (N,) int64, ns; ``stamps``: others than those of the stream."""
        place = self._places.get(stream.key)
        if place is None:
            return stream.times - self.offset_ns
        if stamps is not None and self.clock == "source":
            return stamps + self._one.shifts[place]
        return self._one.times(stream.stream_times, place)


def read_samples(
    recording: Recording, row: Feature, joined: JoinedStreams, place: str, names_of_set: Sequence[str] = ()
) -> Samples:
    """Return the samples of a row of the recipe.

    Args:
        recording: the session.
        row: the row.
        joined: its streams on one clock.
        place: of the row, for errors.
        names_of_set: names of the numbers, as another session of the data set has them: these go in its order.

    Raises ConfigError with ``place``.
    """
    stream = stream_of(recording, row.stream, place)
    try:
        kind, rows, values, recorded, pictures = _values(stream, row)
        units = _units(stream, row)
        stamps, recorded_at = stamps_of(stream, row, joined), _recorded_at(stream, row, joined)
    except ConfigError as error:
        raise ConfigError(f"{place}: {error}") from None
    what, rules = _RULES[kind]
    if row.native and kind == "text":
        raise ConfigError(f"{place}.native: found it for {what}, expected numbers or poses")
    rule = row.rule or rules[0]
    if rule not in rules:
        raise ConfigError(f"{place}.rule: found {rule} for {what}, expected one of {', '.join(rules)}")
    if not len(rows):
        raise ConfigError(
            f"{place}: found no usable value in {count_text(len(stream), 'message')} of {row.stream}, expected one"
        )
    if recorded != tuple(names_of_set) and sorted(recorded) == sorted(names_of_set):
        values = values[:, [recorded.index(each) for each in names_of_set]]
        recorded = tuple(names_of_set)
    names = _named(recorded, row, place)
    lag, correction = _correction(recording, stream, row, joined, place, pictures)
    every = stamps if correction is None else correction.corrected(stamps)
    disordered = int(np.sum(stamps[1:] < stamps[:-1]))
    order = np.argsort(every[rows], kind="stable")
    times = every[rows][order]
    last = np.ones(len(times), bool)  # of several messages with one stamp, the last one received
    last[:-1] = times[1:] > times[:-1]
    kept = order[last]
    chosen = [values[int(each)] for each in kept] if kind == "text" else values[kept]
    return Samples(
        replace(row, rule=rule), stream.type, kind, times[last], recorded_at[rows][kept], stream.numbers[rows][kept],
        np.array(chosen, object) if kind == "text" else chosen, names, recorded, units, len(stream),
        len(stream) - len(rows),
        len(rows) - len(kept), disordered, pictures, correction, lag,
    )  # fmt: skip


def stamps_of(stream: Stream, row: Feature, joined: JoinedStreams) -> Times:
    """Return the times of messages (N,), ns; of a topic with poses of several frames, those in the header of one."""
    return joined.times(stream, recorded_stamps(stream, row)) if row.frame else joined.times(stream)


def recorded_stamps(stream: Stream, row: Feature) -> Times:
    """Return the stamps in the messages (N,), ns; 0: none; in the header of one frame, if the row has one."""
    if not row.frame:
        return stream.stamps
    poses, stamps = stream.poses(row.frame), stream.stamps.copy()
    if np.all(poses.stamps > 0):
        stamps[poses.rows] = poses.stamps
    return stamps


def _recorded_at(stream: Stream, row: Feature, joined: JoinedStreams) -> Times:
    """The stamps as recorded, without what ``joined`` has corrected; times of receipt on the clock of the gateway."""
    return stream.times if joined.clock == "gateway" else recorded_stamps(stream, row)


def _named(names: tuple[str, ...], row: Feature, place: str) -> tuple[str, ...]:
    if not row.names:
        return names
    if len(row.names) != len(names):
        raise ConfigError(
            f"{place}.names: found {counted(len(row.names), 'name')}, expected {len(names)}: {', '.join(names)}"
        )
    return row.names


def _values(stream: Stream, row: Feature) -> tuple[str, Array, Any, tuple[str, ...], Pictures | None]:
    """Kind, indices of the usable messages, their values, names of the numbers, pictures."""
    stream.check_sender()
    if row.is_picture:
        pictures = Pictures(stream, row.window, row.depth_mm)
        rows = pictures.usable
        return "picture", rows, rows, (), pictures
    if has_pictures(stream):
        raise ConfigError(f"found pictures in {stream.key}, expected the name {row.name!r} to be observation.images.…")
    fields = row.fields
    if not fields:
        if stream.type not in _TEXTS:
            return _poses(stream, row)
        fields = (_TEXTS[stream.type],)
    return _columns(stream, fields, row)


def recorded_numbers(stream: Stream, row: Feature) -> tuple[Times, Array, tuple[str, ...], Times]:
    """Return the numbers of all messages, in the units of the data set and without those of other messages.

    Returns:
        Indices (M,) of the messages that can be read, numbers (M, K) float64 with NaN for those that a message does
        not have, their names, and the indices of the messages of which a frame can have the numbers.
    """
    usable = _values(stream, row)[1]
    if row.fields:
        _, rows, numbers, names, _ = _columns(stream, row.fields, row, as_recorded=True)
        return rows, numbers, names, usable
    poses = stream.poses(row.frame).in_unit("m")
    turns = np.full((len(poses.rows), len(_ORIENTATION_NAMES[row.orientation])), np.nan)
    good = np.isfinite(poses.matrices).all(axis=(1, 2))
    turns[good] = orientation(poses.matrices[good], row.orientation)
    numbers = np.concatenate([poses.matrices[:, :3, 3], turns], axis=1)
    return poses.rows, numbers, _AXES + _ORIENTATION_NAMES[row.orientation], usable


def _units(stream: Stream, row: Feature) -> tuple[str, ...]:
    """The units of the columns in the data set, and those in the messages of SENSOR, whose numbers keep them."""
    if not row.fields:
        return ()
    table = stream.to_arrow()
    found = [(table.schema.field(name).metadata or {}).get(b"unit", b"").decode() for name in row.fields]
    units = [_UNITS.get(each, (each, 1.0))[0] for each in found]
    if stream.type == "SENSOR":
        units += sorted({each for each in table["unit"].to_pylist() if each is not None})
    return tuple(units)


def _poses(stream: Stream, row: Feature) -> tuple[str, Array, Any, tuple[str, ...], None]:
    try:
        poses = stream.poses(row.frame).in_unit("m")
    except ConfigError as error:
        if stream.type in POSES_BY_NAME:
            raise
        raise ConfigError(f"{error}; or fields = […] of {', '.join(columns_of(stream)) or 'no column'}") from None
    numbers = np.concatenate([poses.matrices.reshape(-1, 16), poses.quaternions], axis=1)
    good = _finite_float32(numbers)
    return "pose", poses.rows[good], poses.matrices[good], _AXES + _ORIENTATION_NAMES[row.orientation], None


def columns_of(stream: Stream) -> list[str]:
    """Return the names of the columns with numbers or strings."""
    return _value_columns(stream.to_arrow())


def _value_columns(table: Any) -> list[str]:
    import pyarrow as pa

    def is_value(kind: Any) -> bool:
        if pa.types.is_list(kind) or pa.types.is_fixed_size_list(kind):
            kind = kind.value_type
            return bool(pa.types.is_integer(kind) or pa.types.is_floating(kind))
        return bool(
            pa.types.is_integer(kind) or pa.types.is_floating(kind) or pa.types.is_boolean(kind)
            or pa.types.is_string(kind)
        )  # fmt: skip

    return [each.name for each in table.schema if each.name not in _HEADS and is_value(each.type)]


def _check_lengths(table: Any, fields: Sequence[str]) -> None:
    """Raise ConfigError for lists with more numbers than a frame may have, before they are read."""
    import pyarrow as pa
    from pyarrow import compute

    for name in fields:
        if pa.types.is_list(table[name].type) or pa.types.is_large_list(table[name].type):
            longest = compute.max(compute.list_value_length(table[name])).as_py() or 0
            if longest > MAX_NUMBERS:
                raise ConfigError(
                    f"fields: found {count_text(longest, 'number')} in {name}, expected at most {MAX_NUMBERS:,}"
                )


def _columns(
    stream: Stream, fields: Sequence[str], row: Feature, *, as_recorded: bool = False
) -> tuple[str, Array, Any, tuple[str, ...], None]:
    """The numbers in columns of the table of the stream, or the text in one; ``as_recorded``: with unusable ones."""
    import pyarrow as pa

    table, rows = stream.arrow_and_rows()
    known = _value_columns(table)
    for name in fields:
        if name not in known:
            raise ConfigError(f"fields: found {name!r}, expected columns of {stream.key}, {one_of(name, known)}")
    _check_lengths(table, fields)
    if any(pa.types.is_string(table[name].type) for name in fields):
        if len(fields) > 1:
            raise ConfigError(f"fields: found {counted(len(fields), 'column')} with a string, expected one")
        texts = table[fields[0]].to_pylist()
        good = np.array([each is not None for each in texts], bool)
        return "text", rows[good], [each for each in texts if each is not None], (fields[0],), None
    blocks, names = [], []
    for name in fields:
        unit = (table.schema.field(name).metadata or {}).get(b"unit", b"").decode()
        wanted, factor = _UNITS.get(unit, (unit, 1.0))
        values = table[name].to_pylist()
        shown = f"{name.removesuffix(f'_{unit}')}_{wanted}" if unit and name.endswith(f"_{unit}") else name
        size = next((len(each) for each in values if isinstance(each, list) and each), 0)
        if size and (named := _by_name(table, values, stream, rows, row, name, as_recorded)):
            blocks.append(named[1] * factor)
            names += [f"{joint}.{shown}" for joint in named[0]]
        elif any(isinstance(each, list) for each in values):
            blocks.append(np.array([_row(each, size) for each in values]).reshape(len(values), size) * factor)
            names += [f"{shown}_{number}" for number in range(size)]
        else:
            blocks.append(np.array([np.nan if each is None else float(each) for each in values])[:, None] * factor)
            names.append(shown)
    found = np.concatenate(blocks, axis=1)
    if not found.shape[1]:
        raise ConfigError(f"fields: found no number in {', '.join(fields)} of {stream.key}, expected one or more")
    if as_recorded:
        return "numbers", rows, found, tuple(names), None
    finite = _finite_float32(found)
    return "numbers", rows[finite], found[finite], tuple(names), None


def _finite_float32(values: Array) -> npt.NDArray[np.bool_]:
    """The rows of which float32 holds every number: others have no value."""
    with np.errstate(over="ignore"):
        return np.asarray(np.isfinite(values.astype(np.float32)).all(axis=1))


def _row(values: Any, size: int) -> list[float]:
    if values is None or len(values) != size or any(each is None for each in values):
        return [float("nan")] * size
    return [float(each) for each in values]


def _by_name(
    table: Any, values: list[Any], stream: Stream, rows: Times, row: Feature, column: str, as_recorded: bool
) -> tuple[tuple[str, ...], Array] | None:
    """The names of the joints and their values (N, K), of messages with any of them in any order; None without names.

    A message that does not have a joint has the value by the rule of the row, within its tolerance: so the last value
    of each joint, or the one between two, is exact at the times of all messages.  ``as_recorded``: it has NaN.
    """
    field = next((each for each in NAME_FIELDS if each in table.schema.names), "")
    lists = table[field].to_pylist() if field else []
    if not any(isinstance(each, list) and each and isinstance(each[0], str) for each in lists):
        return None
    found = by_name(lists, values)
    if found is None:
        return None
    if len(found.names) > MAX_NUMBERS:
        raise ConfigError(f"fields: found {count_text(len(found.names), 'name')}, expected at most {MAX_NUMBERS:,}")
    names = tuple(each if each.isprintable() else repr(each) for each in found.names)
    if as_recorded:
        return names, found.values
    sources = stream.stamps[rows]
    times = sources if np.all(sources > 0) else stream.times[rows]
    most_ns = (1 << 62) - 1 if row.tolerance_ms is None else round(row.tolerance_ms * 1e6)
    half_turn = np.pi if (stream.type, column) == (_JOINTS, _POSITION) else np.inf
    return names, completed(found, times, row.rule or "hold", most_ns, half_turn)


def signal_of(stream: Stream, at: Times, frame: str = "", pictures: Pictures | None = None) -> Signal:
    """Return what moves in a stream.

    Args:
        stream: the stream.
        at: (N,) int64, times of its messages, ns.
        frame: of streams with several poses.
        pictures: the pictures of the stream, if they are read already.

    Raises:
        GatewayError: nothing in it could move, or a message is damaged.
    """
    if has_pictures(stream):
        pictures = pictures or Pictures(stream)
        grey = (pictures.rgb(int(index)).mean(axis=2) for index in pictures.usable)
        return Signal.of(at[pictures.usable], picture_components(grey), stream.key)
    return movement(stream, frame=frame, at=at)


def _correction(
    recording: Recording, stream: Stream, row: Feature, joined: JoinedStreams, place: str, pictures: Pictures | None
) -> tuple[Lag | None, StampCorrection | None]:
    if row.lag_ms:
        lag_ns = round(row.lag_ms * 1e6)
        return None, StampCorrection(stream.key, "the recipe", lag_ns, lag_ns, lag_ns, 0.0, 0)
    if not row.lag:
        return None, None
    other = stream_of(recording, row.against, f"{place}.against")
    try:
        own = stamps_of(stream, row, joined)
        lag = measure_lag(signal_of(other, joined.times(other)), signal_of(stream, own, row.frame, pictures))
    except GatewayError as error:
        raise ConfigError(f"{place}.lag: {error}") from None
    if lag.verdict is not Verdict.MEASURED:
        raise ConfigError(f"{place}.lag: found {lag.verdict.value} ({row.stream} behind {row.against}), expected a lag "
                          "that is measured; set lag_ms, or see `igtl-gateway sync`")  # fmt: skip
    lag_ns, low_ns, high_ns = (round(value * NS_PER_S) for value in (lag.lag_s, lag.low_s, lag.high_s))
    skew_ppm = lag.skew_ppm if lag.has_skew else 0.0
    return lag, StampCorrection(stream.key, other.key, lag_ns, low_ns, high_ns, skew_ppm, lag.middle_ns)
