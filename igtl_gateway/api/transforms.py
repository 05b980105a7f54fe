"""The frames of a recording: all their poses over time, and interpolated look-ups."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import timedelta
from functools import cached_property
from typing import Any, Literal
from warnings import warn

import numpy as np
import numpy.typing as npt

from igtl_gateway.api.moments import tolerance_ns
from igtl_gateway.api.poses import between_poses, inverse, ratio
from igtl_gateway.api.posing import tools_of, transforms_of
from igtl_gateway.api.source import Source
from igtl_gateway.api.stream import SeveralSenders, Stream
from igtl_gateway.base.errors import ClockWarning, ConfigError, GatewayError
from igtl_gateway.base.near import LISTED, one_of
from igtl_gateway.base.quantities import count_text, counted
from igtl_gateway.base.stamp import NS_PER_S
from igtl_gateway.convert.common_msgs import TFMessage
from igtl_gateway.convert.frames import frame_id
from igtl_gateway.convert.names import frames_of_name
from igtl_gateway.convert.rosmsg import TransformStamped
from igtl_gateway.gateway.log.joining import pick
from igtl_gateway.gateway.log.one_clock import GATEWAY, SOURCE, OneClock, StreamTimes, one_clock
from igtl_gateway.gateway.log.timing import GAP_NS

Array = npt.NDArray[Any]
Times = npt.NDArray[np.int64]

_STATIC_TOPIC = "tf_static"

#: Default of ``max_gap``, s.
GAP_S = GAP_NS / NS_PER_S


@dataclass(frozen=True, slots=True, eq=False)
class Edge:
    """The poses of a frame in its parent.

    Attributes:
        parent, child: frames.
        times: (N,) int64, stamps in UTC ns, strictly increasing; gateway times if a message has no stamp.
        matrices: (N, 4, 4) float64, in the unit of the tree.
        static: the last pose is valid at all times.
        stream: key of the stream that the poses are from.
        arrivals: (N,) int64, gateway times in UTC ns; empty: those of ``times``.
        stamped: whether ``times`` are stamps.
        segments: (N,) int64: between poses with different numbers the frame had another parent; empty: it never had.
    """

    parent: str
    child: str
    times: Times
    matrices: Array
    static: bool
    stream: str
    arrivals: Times = field(default_factory=lambda: np.zeros(0, np.int64))
    stamped: bool = True
    segments: Times = field(default_factory=lambda: np.zeros(0, np.int64))

    def __repr__(self) -> str:
        static = ", static" if self.static else ""
        return f"<Edge: {self.child} in {self.parent}, {count_text(len(self.times), 'pose')} of {self.stream}{static}>"

    @property
    def stream_times(self) -> StreamTimes:
        """Its times, as ``one_clock`` joins them with those of others, in the order of their stamps."""
        arrivals = self.arrivals if len(self.arrivals) else self.times
        stamps = self.times if self.stamped else 0 * self.times
        order = np.argsort(arrivals, kind="stable")
        return StreamTimes(f"{self.child} in {self.parent} ({self.stream})", arrivals[order], stamps[order])


class TransformTree:
    """Frames that are connected by poses; ``recording.tf`` returns it.

    The poses are, in this order of precedence: of ``/tf`` and ``/tf_static``; of other topics with TransformStamped;
    of OpenIGTLink TRANSFORM messages with a name such as ``ToolToBase``.  If several streams have a pair of frames, the
    first kind is used.  The time of a pose is the stamp in its message, or gateway time if a message of its pair of
    frames has none.

    Attributes:
        unit: unit of all translations: ``"m"``.
    """

    def __init__(self, edges: Iterable[Edge], mixed: Mapping[tuple[str, str], str] | None = None) -> None:
        self.unit = "m"
        self._mixed = dict(mixed or {})
        self._edges = {(edge.parent, edge.child): edge for edge in edges}
        self._clocks: dict[tuple[object, ...], OneClock] = {}

    def __repr__(self) -> str:
        return (
            f"<TransformTree: {counted(len(self._edges), 'pair')} of {', '.join(self.frames) or 'no frames'}, "
            f"{self.unit}>"
        )

    @classmethod
    def of(cls, source: Source, streams: Iterable[Stream]) -> TransformTree:
        """Read the frames of a recording."""
        samples: dict[tuple[str, str], _Samples] = {}
        streams = list(streams)
        mixed = _mixed_pairs(source, streams)
        for rank, stream in sorted(((_rank(stream), stream) for stream in streams), key=lambda each: each[0]):
            if rank == _NO_FRAMES:
                continue
            for pair, times, stamps, matrices, static in _poses_of(stream):
                if pair in mixed:
                    continue
                if pair not in samples:
                    samples[pair] = _Samples(rank, stream.key, static, [], [], [])
                if samples[pair].rank == rank:
                    samples[pair].times.append(times)
                    samples[pair].stamps.append(stamps)
                    samples[pair].matrices.append(matrices)
        edges = [each.edge(*pair) for pair, each in samples.items()]
        ranks = [each.rank for each in samples.values()]
        # a frame of /tf has one parent at a time; OpenIGTLink has a pose for each pair of frames
        whole = (
            replace(edge, segments=_segments(edge, [each for each, one in zip(edges, ranks, strict=True) if one == 0]))
            if rank == 0
            else edge
            for edge, rank in zip(edges, ranks, strict=True)
        )
        return cls(whole, mixed)

    @property
    def edges(self) -> tuple[Edge, ...]:
        """All pairs of frames with their poses, without those that several peers sent in turn."""
        return tuple(self._edges.values())

    @property
    def frames(self) -> tuple[str, ...]:
        """Names of all frames, sorted."""
        return tuple(sorted({name for pair in self._edges for name in pair}))

    def lookup(
        self,
        target: str,
        source: str,
        time: int | np.integer[Any] | Times | Stream,
        *,
        unit: str = "m",
        out_of_range: Literal["error", "nan"] = "error",
        clock: Literal["gateway", "source"] = "gateway",
        max_gap: float | timedelta | None = GAP_S,
    ) -> Array:
        """Return the pose of ``source`` in ``target``, which maps coordinates in ``source`` to those in ``target``.

        Between two samples, positions are interpolated linearly and rotations by slerp; chains of frames are
        multiplied.  The way from frame to frame is that of each time: a frame may have had several parents.

        Args:
            target: frame of the result.
            source: frame that is looked up.
            time: int64 UTC ns, one or an array of them; or a stream, at whose messages the frame is looked up.
            unit: unit of the translation: ``"m"``, ``"mm"`` …
            out_of_range: ``"error"`` raises for times at which a frame on the way is not known: before its first or
                after its last sample, or in a longer gap; ``"nan"`` gives matrices of NaN for them.
            clock: of ``time``, if that is an array: ``"gateway"``: gateway times.  Stamps that are not of this clock
                are corrected by the offset, which is measured, and a ``ClockWarning`` states it.  ``"source"``: stamps,
                of the sender of the frames.
            max_gap: largest time between two samples to interpolate between, in seconds or as ``timedelta``, where the
                pose is not the same in both; None: any.

        Returns:
            (4, 4) float64, or (N, 4, 4) for an array of N times.

        Raises:
            ConfigError: a frame is unknown, the frames are not connected, a time is out of range, or the frames on the
                way have stamps of two clocks, or none, for ``clock="source"``.

        Examples:
            >>> recording.tf.lookup("lwr_base", "suture_tool", recording["/star/cloud"], out_of_range="nan")
        """
        for name, value, expected in (
            ("out_of_range", out_of_range, ("error", "nan")),
            ("clock", clock, ("gateway", "source")),
        ):
            if value not in expected:
                raise ConfigError(f"{name}: found {value!r}, expected {one_of(str(value), expected)}")
        wanted: Times | StreamTimes
        if isinstance(time, Stream):
            wanted = time.stream_times
        else:
            wanted = np.atleast_1d(np.asarray(time))
            if wanted.dtype.kind not in "iu" or wanted.ndim != 1:
                raise ConfigError(
                    f"time: found {time!r:.80}, expected UTC ns: an integer, or an array (N,) of integers"
                )
            wanted = wanted.astype(np.int64)
        numerator, denominator = ratio(self.unit, unit)
        gap_ns = tolerance_ns(max_gap, "max_gap")
        ways = _Ways(self, wanted, clock, gap_ns)
        path = self._path(frame_id(target), frame_id(source))
        found, good = ways.along(path)
        if not good.all():
            self._detours(ways, frame_id(target), frame_id(source), found, good)
        if not good.all() and out_of_range == "error":
            raise ConfigError(ways.why_not(path, int(np.argmax(~good))))
        found[:, :3, 3] *= numerator
        found[:, :3, 3] /= denominator
        return found if isinstance(time, Stream) or np.ndim(time) else found[0]

    def _detours(self, ways: _Ways, target: str, source: str, found: Array, good: Array) -> None:
        """Look up the times that are not good on the ways that were there at these times."""
        edges = list(self._edges.values())
        rows = np.flatnonzero(~good)
        known = np.stack([ways.known(edge)[rows] for edge in edges])
        for pattern in np.unique(known, axis=1).T:
            allowed = {id(edge) for edge, is_known in zip(edges, pattern, strict=True) if is_known}
            path = self._way(target, source, allowed)
            if path:
                here = rows[(known == pattern[:, None]).all(axis=0)]
                poses, is_good = ways.along(path)
                found[here], good[here] = poses[here], is_good[here]

    def _path(self, target: str, source: str) -> list[tuple[Edge, bool]]:
        """The edges from ``target`` to ``source``, and whether each is passed from parent to child."""
        for name in (target, source):
            if name not in self._neighbours:
                self._check_mixed(target, source)
                raise ConfigError(f"frame: found {name!r}, expected {one_of(name, sorted(self.frames), LISTED)}")
        found = self._way(target, source)
        if found is None:
            self._check_mixed(target, source)
            raise ConfigError(f"frames: found no connection between {target!r} and {source!r}")
        return found

    def _check_mixed(self, target: str, source: str) -> None:
        """Raise SeveralSenders if two frames are connected by poses that several peers sent in turn."""
        nothing = np.zeros(0, np.int64)
        more = [Edge(*pair, nothing, np.zeros((0, 4, 4)), False, stream) for pair, stream in self._mixed.items()]
        tree = TransformTree([*self.edges, *more])
        known = target in tree._neighbours and source in tree._neighbours
        for edge, _ in tree._way(target, source) or () if known else ():
            if (edge.parent, edge.child) in self._mixed:
                raise SeveralSenders(
                    f"frame {edge.child!r} in {edge.parent!r}: found poses of several peers in turn, expected those of "
                    f"one, as in recording['{edge.stream}@LINK'].poses()"
                )

    def _way(self, target: str, source: str, allowed: set[int] | None = None) -> list[tuple[Edge, bool]] | None:
        """The shortest way on all edges, or on those whose identities are allowed; None without one."""
        ways: dict[str, list[tuple[Edge, bool]]] = {target: []}
        waiting = [target]
        for name in waiting:
            for edge, forward in self._neighbours[name]:
                other = edge.child if forward else edge.parent
                if other not in ways and (allowed is None or id(edge) in allowed):
                    ways[other] = [*ways[name], (edge, forward)]
                    waiting.append(other)
        return ways.get(source)

    def _clock_of(self, edges: Sequence[Edge], stream: StreamTimes | None) -> OneClock:
        """The clock of edges that are joined, with a stream or with gateway time; with a warning the first time."""
        key = (*map(id, edges), stream and stream.name)
        found = self._clocks.get(key)
        if found is None:
            own = [edge.stream_times for edge in edges]
            if stream is None:
                found = one_clock(own)
                if found.name != GATEWAY and own:
                    # three messages without age: gateway time itself
                    now = np.repeat(own[0].times[:1], 3)
                    found = one_clock([*own, StreamTimes("gateway time", now, now, is_clock=True)])
            else:
                found = one_clock([*own, stream])
            self._clocks[key] = found
            if found.notes:
                warn("; ".join(found.notes), ClockWarning, stacklevel=4)
        return found

    @cached_property
    def _neighbours(self) -> dict[str, list[tuple[Edge, bool]]]:
        found: dict[str, list[tuple[Edge, bool]]] = {}
        for edge in self._edges.values():
            found.setdefault(edge.parent, []).append((edge, True))
            found.setdefault(edge.child, []).append((edge, False))
        return found


class _Ways:
    """The poses of edges at some times.

    Args:
        tree: the frames.
        wanted: (N,) UTC ns on the clock of ``clock``, or a stream.
        clock, gap_ns: as of ``lookup``.
    """

    def __init__(self, tree: TransformTree, wanted: Times | StreamTimes, clock: str, gap_ns: int | None) -> None:
        self._tree, self._wanted, self._clock, self._gap_ns = tree, wanted, clock, gap_ns
        self._stream = wanted if isinstance(wanted, StreamTimes) else None
        self._count = len(wanted.times if isinstance(wanted, StreamTimes) else wanted)

    def along(self, path: Sequence[tuple[Edge, bool]]) -> tuple[Array, npt.NDArray[np.bool_]]:
        """The poses along a way (N, 4, 4), NaN where one is not known, and where they are known (N,)."""
        found = np.broadcast_to(np.eye(4), (self._count, 4, 4)).copy()
        good = np.ones(self._count, np.bool_)
        moving = [edge for edge, _ in path if not edge.static]
        for edge, forward in path:
            step, known = self._at(edge, moving)
            found = found @ (step if forward else inverse(step))
            good &= known
        found[~good] = np.nan
        return found, good

    def known(self, edge: Edge) -> npt.NDArray[np.bool_]:
        """The times (N,) at which an edge is known."""
        return self._at(edge, [edge])[1]

    def why_not(self, path: Sequence[tuple[Edge, bool]], row: int) -> str:
        """Return why a way is not known at a time."""
        moving = [edge for edge, _ in path if not edge.static]
        edge = next((each for each in moving if not self._at(each, moving)[1][row]), path[0][0])
        times, wanted, _ = self._joined(edge, moving)
        if not len(times):
            span = "no samples"
        elif times[0] <= wanted[row] <= times[-1]:
            span = f"and in no gap above {(self._gap_ns or 0) / NS_PER_S:g} s, nor with another parent: none there"
        else:
            span = f"{times[0]} to {times[-1]}"
        return (
            f"time: found {wanted[row]}, expected one within the samples of {edge.child!r} in {edge.parent!r}: {span}"
        )

    def _joined(self, edge: Edge, moving: Sequence[Edge]) -> tuple[Times, Times, Array]:
        """Times of the samples and wanted times on one clock, and the order of the samples."""
        everything = np.arange(len(edge.times))
        if self._clock == SOURCE and self._stream is None:
            clock = one_clock([each.stream_times for each in moving], SOURCE)
            if len({shift for each, shift in zip(moving, clock.shifts, strict=True) if len(each.times)}) > 1:
                raise ConfigError(f"clock: source: {'; '.join(clock.notes)}; expected one clock, or clock='gateway'")
            assert not isinstance(self._wanted, StreamTimes)
            return edge.times, self._wanted, everything
        clock = self._tree._clock_of(moving, self._stream)
        if self._stream is not None:
            wanted = clock.times(self._stream, len(moving))
        else:
            assert not isinstance(self._wanted, StreamTimes)
            wanted = self._wanted
        if clock.name == GATEWAY and len(edge.arrivals):
            order = np.argsort(edge.arrivals, kind="stable")
            return edge.arrivals[order], wanted, order
        shift_ns = clock.shifts[next(number for number, each in enumerate(moving) if each is edge)]
        return edge.times + shift_ns, wanted, everything

    def _at(self, edge: Edge, moving: Sequence[Edge]) -> tuple[Array, npt.NDArray[np.bool_]]:
        """The poses of an edge (N, 4, 4), and where they are known (N,)."""
        if edge.static and len(edge.times):
            poses = np.broadcast_to(edge.matrices[-1], (self._count, 4, 4))
            return poses, np.ones(self._count, np.bool_)
        found = np.full((self._count, 4, 4), np.nan)
        if not len(edge.times):
            return found, np.zeros(self._count, np.bool_)
        times, wanted, order = self._joined(edge, moving)
        matrices = edge.matrices[order]
        segments = edge.segments[order] if len(edge.segments) else None
        picks = pick(times, wanted, "interpolate", segments=segments)
        good = picks.good
        if self._gap_ns is not None:
            wide = good & (picks.share > 0) & (times[picks.after] - times[picks.before] > self._gap_ns)
            rows = np.flatnonzero(wide)
            # a pose that is published again unchanged is valid between
            same = (matrices[picks.before[rows]] == matrices[picks.after[rows]]).all(axis=(1, 2))
            good[rows[~same]] = False
        before, after, share = picks.before[good], picks.after[good], picks.share[good]
        found[good] = between_poses(matrices[before], matrices[after], share)
        return found, good


@dataclass(frozen=True, slots=True)
class _Samples:
    """What is known of a pair of frames."""

    rank: int
    stream: str
    static: bool
    times: list[Times]
    stamps: list[Times]
    matrices: list[Array]

    def edge(self, parent: str, child: str) -> Edge:
        arrivals, stamps = np.concatenate(self.times), np.concatenate(self.stamps)
        matrices = np.concatenate(self.matrices)
        stamped = bool(np.all(stamps > 0))
        times = stamps if stamped else arrivals
        order = np.argsort(times, kind="stable")
        times = times[order]
        # of equal stamps the last message is valid
        order = order[np.append(times[1:] != times[:-1], True)[: len(times)]]
        own = stamps if stamped else arrivals
        return Edge(parent, child, own[order], matrices[order], self.static, self.stream, arrivals[order], stamped)


def _segments(edge: Edge, others: Iterable[Edge]) -> Times:
    """Numbers of the poses of an edge (N,): a new one after a gap in which the frame had another parent."""
    breaks = np.zeros(len(edge.times), np.int64)
    gaps = np.flatnonzero(np.diff(edge.times) > GAP_NS)
    for other in others:
        if other.child == edge.child and other.parent != edge.parent and not other.static:
            first = np.searchsorted(other.times, edge.times[gaps], side="right")
            last = np.searchsorted(other.times, edge.times[gaps + 1], side="left")
            breaks[gaps[last > first] + 1] = 1
    return np.cumsum(breaks)


def _mixed_pairs(source: Source, streams: Iterable[Stream]) -> dict[tuple[str, str], str]:
    """Parent and child frame → stream, of the frames that several peers sent at one time: no movement of one thing."""
    found: dict[tuple[str, str], str] = {}
    for name, base_frame in source.shared_streams():
        kind, _, device = name.partition("/")
        pairs = {frames_of_name(device, base_frame)}
        if kind in ("TDATA", "QTDATA"):
            own = (each for each in streams if each.name == name and each.direction == "igtl_in")
            tools = (tool for stream in own for message in stream for tool in tools_of(message.content))
            pairs = {(parent or base_frame, child) for parent, child, _, _ in tools}
        found |= {(frame_id(parent), frame_id(child)): name for parent, child in pairs}
    return found


_NO_FRAMES = 3


def _rank(stream: Stream) -> int:
    """Precedence of a stream; _NO_FRAMES: it has no pairs of frames."""
    match stream.type:
        case TFMessage.TYPE:
            return 0
        case TransformStamped.TYPE:
            return 1
        case "TRANSFORM":
            return 2
    return _NO_FRAMES


#: Of a pair of frames: it, gateway times, stamps (0 = unset), poses, whether they are static.
_PairPoses = tuple[tuple[str, str], Times, Times, Array, bool]


def _poses_of(stream: Stream) -> list[_PairPoses]:
    """The poses of a stream in metres by parent and child."""
    if stream.type == TFMessage.TYPE:
        return _one_by_one(stream)
    try:
        poses = stream.poses().in_unit("m")
    except SeveralSenders:  # of one name: nothing states whose pose is wanted
        return []
    if poses.parent and poses.child:
        pair = (frame_id(poses.parent), frame_id(poses.child))
        return [(pair, *_finite(poses.times, poses.stamps, poses.matrices), False)]
    return _one_by_one(stream) if stream.type == TransformStamped.TYPE and len(poses) else []


def _one_by_one(stream: Stream) -> list[_PairPoses]:
    """As ``_poses_of``, for messages with poses of several frames."""
    static = stream.name.rpartition("/")[2] == _STATIC_TOPIC
    numerator, denominator = ratio(stream.unit, "m")
    found: dict[tuple[str, str], tuple[list[int], list[int], list[Array]]] = {}
    for block in stream.blocks_until_end() if static else stream.blocks():
        for row in range(len(block)):
            try:
                each = list(transforms_of(block.payload(row), stream.type))
            except GatewayError:
                continue
            for parent, child, stamp_ns, matrix in each:
                if parent and child:
                    times, stamps, matrices = found.setdefault((frame_id(parent), frame_id(child)), ([], [], []))
                    times.append(int(block.times[row]))
                    stamps.append(stamp_ns)
                    matrices.append(matrix)
    rows = []
    for pair, (times, stamps, matrices) in found.items():
        poses = np.array(matrices)
        poses[:, :3, 3] = poses[:, :3, 3] * numerator / denominator
        rows.append((pair, *_finite(np.array(times, np.int64), np.array(stamps, np.int64), poses), static))
    return rows


def _finite(times: Times, stamps: Times, matrices: Array) -> tuple[Times, Times, Array]:
    """The samples that are poses."""
    good = np.isfinite(matrices).all(axis=(1, 2))
    return times[good], stamps[good], matrices[good]
