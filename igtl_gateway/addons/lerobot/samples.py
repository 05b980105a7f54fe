"""The samples of one stream: times on the clock of the data set, entry numbers, and values in metres and radians."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from igtl_gateway.addon import NS_PER_S, ConfigError, GatewayError
from igtl_gateway.addon.notes import StampCorrection
from igtl_gateway.addon.reading import Recording, Stream
from igtl_gateway.addon.streams import between_poses, one_clock
from igtl_gateway.addon.terminal import count_text, counted
from igtl_gateway.addons.lerobot.pictures import Pictures, has_pictures
from igtl_gateway.addons.lerobot.recipe import Feature
from igtl_gateway.addons.lerobot.values import JOINTS, POSITION, Recorded, orientation, read_values
from igtl_gateway.addons.sync.lag import Lag, Verdict, measure_lag
from igtl_gateway.addons.sync.lags import movement, picture_components
from igtl_gateway.addons.sync.signal import Signal

Array = npt.NDArray[Any]
Times = npt.NDArray[np.int64]

#: Kind → its name, and its rules, of which the first one is the usual one.
_RULES = {
    "pose": ("a pose", ("interpolate", "nearest", "hold")),
    "picture": ("a picture", ("nearest", "hold")),
    "numbers": ("numbers", ("hold", "nearest", "interpolate")),
    "text": ("a string", ("hold", "nearest", "none")),
}


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
        rows: indices of the messages that have a value, in the order of the recording.
        recorded: the numbers of all messages, for rows with ``native``.
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
    rows: Times | None = None
    recorded: Recorded | None = None

    @property
    def are_angles(self) -> npt.NDArray[np.bool_]:
        """(K,) bool, whether each number is the position of a joint, of which most are angles."""
        last = (each.rpartition(".")[2] for each in self.recorded_names)
        return np.array([self.type == JOINTS and each.startswith(POSITION) for each in last], np.bool_)

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
        found = read_values(stream, row)
        stamps, recorded_at = stamps_of(stream, row, joined), _recorded_at(stream, row, joined)
    except ConfigError as error:
        raise ConfigError(f"{place}: {error}") from None
    kind, rows, values, recorded, pictures = found.kind, found.rows, found.values, found.names, found.pictures
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
    native = found.recorded
    if recorded != tuple(names_of_set) and sorted(recorded) == sorted(names_of_set):
        order_of_set = [recorded.index(each) for each in names_of_set]
        values = values[:, order_of_set]
        native = native and replace(native, numbers=native.numbers[:, order_of_set])
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
        np.array(chosen, object) if kind == "text" else chosen, names, recorded, found.units, len(stream),
        len(stream) - len(rows),
        len(rows) - len(kept), disordered, pictures, correction, lag, rows, native,
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
