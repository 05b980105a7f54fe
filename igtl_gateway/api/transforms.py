"""The frames of a recording: all their poses over time, and interpolated look-ups."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from igtl_gateway.api.poses import between_poses, inverse, ratio
from igtl_gateway.api.posing import transforms_of
from igtl_gateway.api.source import Source
from igtl_gateway.api.stream import Stream
from igtl_gateway.base.errors import ConfigError, GatewayError
from igtl_gateway.convert.common_msgs import TFMessage
from igtl_gateway.convert.frames import frame_id
from igtl_gateway.convert.rosmsg import TransformStamped

Array = npt.NDArray[Any]
Times = npt.NDArray[np.int64]

_STATIC_TOPIC = "tf_static"


@dataclass(frozen=True, slots=True, eq=False)
class Edge:
    """The poses of a frame in its parent.

    Attributes:
        parent, child: frames.
        times: (N,) int64, stamps in UTC ns, strictly increasing.
        matrices: (N, 4, 4) float64, in the unit of the tree.
        static: the last pose is valid at all times.
        stream: key of the stream that the poses are from.
    """

    parent: str
    child: str
    times: Times
    matrices: Array
    static: bool
    stream: str

    def __repr__(self) -> str:
        static = ", static" if self.static else ""
        return f"<Edge: {self.child} in {self.parent}, {len(self.times):,} poses of {self.stream}{static}>"


class TransformTree:
    """Frames that are connected by poses; ``recording.tf`` returns it.

    The poses are, in this order of precedence: of ``/tf`` and ``/tf_static``; of other topics with TransformStamped;
    of OpenIGTLink TRANSFORM messages with a name such as ``ToolToBase``.  If several streams have a pair of frames, the
    first kind is used.  The time of a pose is the stamp in its message, or gateway time if that is unset.

    Attributes:
        unit: unit of all translations: ``"m"``.
    """

    def __init__(self, edges: Iterable[Edge]) -> None:
        self.unit = "m"
        self._edges = {(edge.parent, edge.child): edge for edge in edges}

    def __repr__(self) -> str:
        return f"<TransformTree: {len(self._edges)} pairs of {', '.join(self.frames) or 'no frames'}, {self.unit}>"

    @classmethod
    def of(cls, source: Source, streams: Iterable[Stream]) -> TransformTree:
        """Read the frames of a recording."""
        samples: dict[tuple[str, str], _Samples] = {}
        for rank, stream in sorted(((_rank(stream), stream) for stream in streams), key=lambda each: each[0]):
            if rank == _NO_FRAMES:
                continue
            for pair, times, matrices, static in _poses_of(stream):
                if pair not in samples:
                    samples[pair] = _Samples(rank, stream.key, static, [], [])
                if samples[pair].rank == rank:
                    samples[pair].times.append(times)
                    samples[pair].matrices.append(matrices)
        return cls(each.edge(*pair) for pair, each in samples.items())

    @property
    def edges(self) -> tuple[Edge, ...]:
        """All pairs of frames with their poses."""
        return tuple(self._edges.values())

    @property
    def frames(self) -> tuple[str, ...]:
        """Names of all frames, sorted."""
        return tuple(sorted({name for pair in self._edges for name in pair}))

    def lookup(
        self,
        target: str,
        source: str,
        time: int | np.integer[Any] | Times,
        *,
        unit: str = "m",
        out_of_range: Literal["error", "nan"] = "error",
    ) -> Array:
        """Return the pose of ``source`` in ``target``, which maps coordinates in ``source`` to those in ``target``.

        Between two samples, positions are interpolated linearly and rotations by slerp; chains of frames are
        multiplied.

        Args:
            target: frame of the result.
            source: frame that is looked up.
            time: int64 UTC ns, one or an array of them.
            unit: unit of the translation: ``"m"``, ``"mm"`` …
            out_of_range: ``"error"`` raises for times before the first or after the last sample of a frame on the way;
                ``"nan"`` gives matrices of NaN for them.  Poses are never extrapolated.

        Returns:
            (4, 4) float64, or (N, 4, 4) for an array of N times.

        Raises:
            ConfigError: a frame is unknown, the frames are not connected, or a time is out of range.

        Examples:
            >>> recording.tf.lookup("lwr_base", "suture_tool", recording["/star/cloud"].times, out_of_range="nan")
        """
        if out_of_range not in ("error", "nan"):
            raise ConfigError(f"out_of_range: found {out_of_range!r}, expected 'error' or 'nan'")
        times = np.atleast_1d(np.asarray(time))
        if times.dtype.kind not in "iu" or times.ndim != 1:
            raise ConfigError(f"time: found {time!r:.80}, expected UTC ns: an integer, or an array (N,) of integers")
        numerator, denominator = ratio(self.unit, unit)
        found = np.broadcast_to(np.eye(4), (len(times), 4, 4)).copy()
        for edge, forward in self._path(frame_id(target), frame_id(source)):
            step = _at(edge, times.astype(np.int64), out_of_range == "nan")
            found = found @ (step if forward else inverse(step))
        found[:, :3, 3] *= numerator
        found[:, :3, 3] /= denominator
        return found if np.ndim(time) else found[0]

    def _path(self, target: str, source: str) -> list[tuple[Edge, bool]]:
        """The edges from ``target`` to ``source``, and whether each is passed from parent to child."""
        for name in (target, source):
            if name not in self._neighbours:
                known = ", ".join(self.frames[:10]) or "none"
                raise ConfigError(f"frame: found {name!r}, expected one of the recording: {known}")
        ways: dict[str, list[tuple[Edge, bool]]] = {target: []}
        waiting = [target]
        for name in waiting:
            for edge, forward in self._neighbours[name]:
                other = edge.child if forward else edge.parent
                if other not in ways:
                    ways[other] = [*ways[name], (edge, forward)]
                    waiting.append(other)
        if source not in ways:
            raise ConfigError(f"frames: found no connection between {target!r} and {source!r}")
        return ways[source]

    @cached_property
    def _neighbours(self) -> dict[str, list[tuple[Edge, bool]]]:
        found: dict[str, list[tuple[Edge, bool]]] = {}
        for edge in self._edges.values():
            found.setdefault(edge.parent, []).append((edge, True))
            found.setdefault(edge.child, []).append((edge, False))
        return found


@dataclass(frozen=True, slots=True)
class _Samples:
    """What is known of a pair of frames."""

    rank: int
    stream: str
    static: bool
    times: list[Times]
    matrices: list[Array]

    def edge(self, parent: str, child: str) -> Edge:
        times, matrices = np.concatenate(self.times), np.concatenate(self.matrices)
        order = np.argsort(times, kind="stable")
        times, matrices = times[order], matrices[order]
        # of equal stamps the last message is valid
        last = np.append(times[1:] != times[:-1], True)
        return Edge(parent, child, times[last], matrices[last], self.static, self.stream)


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


def _poses_of(stream: Stream) -> list[tuple[tuple[str, str], Times, Array, bool]]:
    """The poses of a stream in metres by parent and child."""
    if stream.type == TFMessage.TYPE:
        return _one_by_one(stream)
    poses = stream.poses().in_unit("m")
    if poses.parent and poses.child:
        times = np.where(poses.stamps != 0, poses.stamps, poses.times)
        return [((frame_id(poses.parent), frame_id(poses.child)), *_finite(times, poses.matrices), False)]
    return _one_by_one(stream) if stream.type == TransformStamped.TYPE and len(poses) else []


def _one_by_one(stream: Stream) -> list[tuple[tuple[str, str], Times, Array, bool]]:
    """As ``_poses_of``, for messages with poses of several frames."""
    static = stream.name.rpartition("/")[2] == _STATIC_TOPIC
    numerator, denominator = ratio(stream.unit, "m")
    found: dict[tuple[str, str], tuple[list[int], list[Array]]] = {}
    for block in stream.blocks_until_end() if static else stream.blocks():
        for row in range(len(block)):
            try:
                each = list(transforms_of(block.payload(row), stream.type))
            except GatewayError:
                continue
            for parent, child, stamp_ns, matrix in each:
                if parent and child:
                    times, matrices = found.setdefault((frame_id(parent), frame_id(child)), ([], []))
                    times.append(stamp_ns or int(block.times[row]))
                    matrices.append(matrix)
    rows = []
    for pair, (times, matrices) in found.items():
        poses = np.array(matrices)
        poses[:, :3, 3] = poses[:, :3, 3] * numerator / denominator
        rows.append((pair, *_finite(np.array(times, np.int64), poses), static))
    return rows


def _finite(times: Times, matrices: Array) -> tuple[Times, Array]:
    """The samples that are poses."""
    good = np.isfinite(matrices).all(axis=(1, 2))
    return times[good], matrices[good]


def _at(edge: Edge, times: Times, nan: bool) -> Array:
    """The poses of an edge at some times.  Raises ConfigError for times out of range, unless they give NaN."""
    if edge.static and len(edge.times):
        return np.broadcast_to(edge.matrices[-1], (len(times), 4, 4))
    count = len(edge.times)
    good = (times >= edge.times[0]) & (times <= edge.times[-1]) if count else np.zeros(len(times), np.bool_)
    if not good.all() and not nan:
        span = f"{edge.times[0]} to {edge.times[-1]}" if count else "no samples"
        raise ConfigError(
            f"time: found {times[~good][0]}, expected one within the samples of {edge.child!r} in {edge.parent!r}: "
            f"{span}"
        )
    found = np.full((len(times), 4, 4), np.nan)
    inside = times[good]
    after = np.clip(np.searchsorted(edge.times, inside), 1, max(count - 1, 1))
    if count == 1:
        found[good] = edge.matrices[0]
    elif len(inside):
        start, end = edge.times[after - 1], edge.times[after]
        found[good] = between_poses(edge.matrices[after - 1], edge.matrices[after], (inside - start) / (end - start))
    return found
