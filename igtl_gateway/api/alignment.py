"""Streams sampled at the times of one of them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from datetime import timedelta
from typing import TYPE_CHECKING, Any, Literal
from warnings import warn

import numpy as np
import numpy.typing as npt

from igtl_gateway.api.moments import tolerance_ns
from igtl_gateway.api.poses import Poses, between_poses
from igtl_gateway.api.stream import Stream, to_frame
from igtl_gateway.base.errors import ClockWarning, ConfigError
from igtl_gateway.base.near import one_of
from igtl_gateway.base.stamp import NS_PER_S
from igtl_gateway.gateway.log.joining import NEAR_NS, pick
from igtl_gateway.gateway.log.one_clock import GATEWAY, one_clock

if TYPE_CHECKING:
    import pandas
    import pyarrow

Array = npt.NDArray[Any]
Times = npt.NDArray[np.int64]
Method = Literal["nearest", "interpolate"]
Clock = Literal["auto", "gateway", "source"]

#: Default of ``tolerance``, s.
NEAR_S = NEAR_NS / NS_PER_S


@dataclass(frozen=True, slots=True, eq=False)
class Match:
    """The messages of one stream that belong to N times.

    Attributes:
        stream: the stream.
        rows: (N,) int64, index of the nearest message in the stream; -1: none within the tolerance.
        offsets: (N,) int64, time of that message minus the time that is wanted, ns; 0 without message.
        poses: (N,) poses, NaN without message; None if the messages of the stream are not poses.
        interpolated: the poses are between those of the messages.
    """

    stream: Stream
    rows: Times
    offsets: Times
    poses: Poses | None
    interpolated: bool = False

    def __repr__(self) -> str:
        found = int((self.rows >= 0).sum())
        return f"<Match: {found:,} of {len(self.rows):,} times have a message of {self.stream.key}>"


@dataclass(frozen=True, slots=True, eq=False)
class Aligned:
    """Streams sampled at the times of one of them; :func:`~igtl_gateway.align` returns it.

    Attributes:
        on: key of the stream whose times are used.
        times: (N,) int64, UTC ns on the clock that was chosen.
        matches: key → the messages of a stream; the stream ``on`` has offsets of 0.
        clock: ``"source"``: stamps; ``"gateway"``: times of receipt.
        notes: what was corrected or assumed to have one clock; a ``ClockWarning`` has it, too.
    """

    on: str
    times: Times
    matches: Mapping[str, Match]
    clock: str = GATEWAY
    notes: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.times)

    def __repr__(self) -> str:
        others = ", ".join(key for key in self.matches if key != self.on)
        notes = f", {len(self.notes)} in .notes" if self.notes else ""
        return f"<Aligned: {others} at {len(self):,} times of {self.on}, clock: {self.clock}{notes}>"

    def __getitem__(self, key: str) -> Match:
        if key not in self.matches:
            raise KeyError(f"found {key!r}, expected {one_of(key, self.matches)}")
        return self.matches[key]

    def poses(self, key: str) -> Poses:
        """Return the poses of a stream at ``times``: (N, 4, 4), NaN where there is none.

        Raises:
            ConfigError: the messages of the stream are not poses.
        """
        poses = self[key].poses
        if poses is None:
            raise ConfigError(f"{key}: found type {self[key].stream.type}, expected one with a pose")
        return poses

    def to_arrow(self) -> pyarrow.Table:
        """Return an Arrow table with a row per time.

        The columns are ``time_ns``, and for each stream ``KEY.offset_ns`` and the columns of ``Stream.to_arrow`` as
        ``KEY.COLUMN``, null without a message.  Interpolated poses have ``KEY.x_mm`` … and ``KEY.qx`` … instead.

        Raises:
            Unavailable: pyarrow is not installed; the extra ``arrow`` installs it.
        """
        from igtl_gateway.api import arrow_tables  # pyarrow is an extra

        columns: dict[str, tuple[Any, str]] = {"time_ns": (self.times, "ns")}
        tables = {}
        for key, match in self.matches.items():
            columns[f"{key}.offset_ns"] = (np.ma.array(match.offsets, mask=match.rows < 0), "ns")
            if match.poses is not None and match.interpolated:
                columns |= {f"{key}.{name}": cell for name, cell in _pose_cells(match.poses).items()}
            else:
                tables[key] = (*match.stream.arrow_and_rows(), match.rows)
        return arrow_tables.side_by_side(columns, tables)

    def to_pandas(self) -> pandas.DataFrame:
        """Return the table of :meth:`to_arrow` as a data frame with the time as index.

        Raises:
            Unavailable: pandas is not installed; the extra ``pandas`` installs it.
        """
        return to_frame(self.to_arrow())


def align(
    streams: Iterable[Stream],
    on: Stream | str,
    tolerance: float | timedelta | None = NEAR_S,
    *,
    method: Method = "nearest",
    clock: Clock = "auto",
    missing: Literal["nan", "drop"] = "nan",
) -> Aligned:
    """Sample streams at the times of one of them.

    Args:
        streams: the streams, of one or of several recordings.
        on: the stream whose times are used, or its key among ``streams``.
        tolerance: largest distance in time, in seconds or as ``timedelta``; None: any.
        method: ``"nearest"``: the message that is nearest in time, the earlier one of two.  ``"interpolate"``: poses
            between the messages before and after, both within the tolerance; never extrapolated; messages that are not
            poses are the nearest ones.
        clock: ``"auto"``: the senders' stamps (``Stream.stamps``) if every message has one and the session shows one
            clock; stamps of another clock than that of ``on`` are corrected by its offset, which is measured, and
            ``Aligned.notes`` and a ``ClockWarning`` state it; otherwise times of receipt.
            ``"gateway"``: times of receipt.  ``"source"``: stamps, corrected likewise.
            ``docs/reference/which-moment.md`` has the rules.
        missing: ``"nan"`` keeps the times without a message; ``"drop"`` keeps the times that all streams have.

    Returns:
        The times, and for each stream its messages at them.

    Raises:
        ConfigError: an argument has another value, two streams have one key, or ``clock="source"`` and a message has
            no stamp.

    Examples:
        >>> tool, cloud = recording["TRANSFORM/ToolToBase"], recording["/star/cloud"]
        >>> table = igtl_gateway.align([tool, cloud], on=cloud, tolerance=0.02, method="interpolate")
        >>> table.poses("TRANSFORM/ToolToBase").matrices.shape
        (12, 4, 4)
    """
    for name, value, expected in (
        ("method", method, ("nearest", "interpolate")),
        ("clock", clock, ("auto", "gateway", "source")),
        ("missing", missing, ("nan", "drop")),
    ):
        if value not in expected:
            raise ConfigError(f"{name}: found {value!r}, expected {one_of(str(value), expected)}")
    most = tolerance_ns(tolerance)
    by_key: dict[str, Stream] = {}
    for stream in (*streams, *(() if isinstance(on, str) else (on,))):
        if by_key.setdefault(stream.key, stream) is not stream:
            raise ConfigError(f"streams: found two streams {stream.key!r}, expected different keys")
        stream.check_sender()
    key = on if isinstance(on, str) else on.key
    if key not in by_key:
        raise ConfigError(f"on: found {key!r}, expected {one_of(key, by_key)}")
    every = [each.stream_times for each in by_key.values()]
    chosen = one_clock(every, clock)
    if chosen.notes:
        warn("; ".join(chosen.notes), ClockWarning, stacklevel=2)
    own = list(by_key).index(key)
    # the times of ``on`` are those of its own clock, whatever that of the others is
    joined = [chosen.times(each, number) - chosen.shifts[own] for number, each in enumerate(every)]
    times = joined[own]
    matches = {
        name: _match(stream, at, times, most, method)
        for (name, stream), at in zip(by_key.items(), joined, strict=True)
        if name != key
    }
    here = np.arange(len(times))
    matches[key] = Match(by_key[key], here, np.zeros(len(times), np.int64), _own_poses(by_key[key]))
    if missing == "drop":
        kept = np.flatnonzero(np.all([match.rows >= 0 for match in matches.values()], axis=0))
        times = times[kept]
        matches = {
            name: replace(
                each,
                rows=each.rows[kept],
                offsets=each.offsets[kept],
                poses=None if each.poses is None else each.poses[kept],
            )
            for name, each in matches.items()
        }
    return Aligned(key, times, {name: matches[name] for name in by_key}, chosen.name, chosen.notes)


def _poses(stream: Stream) -> Poses | None:
    try:
        return stream.poses()
    except ConfigError:
        return None


def _own_poses(stream: Stream) -> Poses | None:
    """The poses of a stream at its own times, NaN for messages without one."""
    poses = _poses(stream)
    if poses is None or len(poses) == len(stream.times):
        return poses
    matrices = np.full((len(stream.times), 4, 4), np.nan)
    matrices[poses.rows] = poses.matrices
    stamps = np.zeros(len(stream.times), np.int64)
    stamps[poses.rows] = poses.stamps
    rows = np.arange(len(stream.times))
    return Poses(
        matrices, poses.unit, stream.times, stream.source_times, stamps, poses.parent, poses.child, poses.left_out, rows
    )


def _match(stream: Stream, at: Times, wanted: Times, most: int | None, method: Method) -> Match:
    """The messages of a stream, which are ``at`` (M,), at the wanted times (N,) of the same clock."""
    poses = _poses(stream)
    rows = np.arange(len(at)) if poses is None else poses.rows
    order = np.argsort(at[rows], kind="stable")  # stamps of a sender may decrease
    samples, rows = at[rows][order], rows[order]
    if not len(samples):
        nobody = np.full(len(wanted), -1, np.int64)
        return Match(stream, nobody, 0 * nobody, None if poses is None else _sampled(poses, wanted, None, nobody))
    nearest = pick(samples, wanted, "nearest", most_ns=most)
    chosen, good = nearest.before, nearest.good
    is_between = poses is not None and method == "interpolate"
    matrices = None
    if poses is not None and is_between:
        found = pick(samples, wanted, "interpolate", most_ns=most)
        good, own = found.good, poses.matrices[order]
        matrices = np.full((len(wanted), 4, 4), np.nan)
        matrices[good] = between_poses(own[found.before[good]], own[found.after[good]], found.share[good])
    elif poses is not None:
        matrices = np.where(good[:, None, None], poses.matrices[order][chosen], np.nan)
    own_rows = np.where(good, rows[chosen], -1)
    return Match(
        stream,
        own_rows,
        np.where(good, samples[chosen] - wanted, 0),
        None if poses is None else _sampled(poses, wanted, matrices, own_rows),
        is_between,
    )


def _sampled(poses: Poses, times: Times, matrices: Array | None, rows: Times) -> Poses:
    """Poses at other times; without matrices there is none."""
    nothing = np.zeros(len(times), np.int64)
    if matrices is None:
        matrices = np.full((len(times), 4, 4), np.nan)
    return Poses(matrices, poses.unit, times, nothing, nothing, poses.parent, poses.child, poses.left_out, rows)


def _pose_cells(poses: Poses) -> dict[str, tuple[Any, str]]:
    cells: dict[str, tuple[Any, str]] = {
        f"{axis}_{poses.unit}": (poses.positions[:, number], poses.unit) for number, axis in enumerate("xyz")
    }
    quaternions = poses.quaternions
    return cells | {f"q{axis}": (quaternions[:, number], "") for number, axis in enumerate("xyzw")}
