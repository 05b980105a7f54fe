"""Lags between streams of a recording: what moves in each of them, and how late one is."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from igtl_gateway.addon import NS_PER_S, ConfigError, DamagedRecording, GatewayError
from igtl_gateway.addon.messages import frames_of
from igtl_gateway.addon.processes import part_of
from igtl_gateway.addon.reading import Kind, RecordedMessage, Stream
from igtl_gateway.addon.ros import (
    CompressedImage,
    CompressedVideo,
    Marker,
    PointCloud2,
    PointList,
    PointStamped,
    TFMessage,
    Volume,
)
from igtl_gateway.addon.ros import Image as RosImage
from igtl_gateway.addon.streams import NAME_FIELDS, by_name, completed
from igtl_gateway.addon.terminal import count_text, counted
from igtl_gateway.addons.sync.defaults import CUT_OFF_HZ
from igtl_gateway.addons.sync.lag import Lag, measure_lag, measure_together
from igtl_gateway.addons.sync.plus import line_height
from igtl_gateway.addons.sync.probe import LEAST_SAMPLES
from igtl_gateway.addons.sync.signal import LARGEST, Signal, moves

Array = npt.NDArray[Any]

#: Types with several poses, of which ``frame`` chooses one.
TRACKING = frozenset({"TDATA", "QTDATA"})
POSES_BY_NAME = TRACKING | {TFMessage.TYPE}

#: Rows and columns of the picture that the movement in images is found in.
_THUMBNAIL = 32
_COMPONENTS = 3
#: A rotation by 1 rad counts as much as a translation by this: about the length of a tool.
_TOOL_M = 0.1
#: Fields of messages that count or name something, and the most numbers of one message that are compared.
_NOT_MOVING = frozenset({"header", "stamp", "unit", "id", "status", "layout", "encoding"})
_MOST_NUMBERS = 64
#: Types with encoded pictures: decoding them takes long, so they are measured where they are named.
_ENCODED = frozenset({"VIDEO", CompressedImage.TYPE, CompressedVideo.TYPE})
#: Numbers of joints, of which the first that a topic has moves; the longest time between two values of a joint.
_OF_JOINTS = ("position", "velocity", "effort")
_LONGEST_NS = NS_PER_S
#: Streams that are measured without being named.
_MOST_STREAMS = 100


def lag(
    fixed: Stream | Sequence[Stream],
    moving: Stream | Sequence[Stream],
    *,
    max_lag_s: float | None = None,
    cut_off_hz: float = CUT_OFF_HZ,
    frame: str = "",
    line: bool = False,
) -> Lag:
    """Return how late the stamps of ``moving`` are relative to those of ``fixed``, from what moves in both.

    The stamps are those of the senders (``Stream.stamps``), or gateway times for a stream in which a message has none.

    Several pairs of streams of the same two clocks have one lag: ``lag([jaw, insertion], [seen_jaw, seen_insertion])``.
    A periodic movement offers lags a period apart, one that is not periodic chooses, and both refine.

    Args:
        fixed, moving: streams with poses, images, point clouds, joint states or other numbers; or as many of each.
        max_lag_s: search range to both sides, s; None: 1 s.  A range that is given states that the lag is in it.
        cut_off_hz: highest cut-off of the low-pass for both signals, Hz.
        frame: tool or child frame, for streams with several poses.
        line: follow the bright line in images, as PLUS does in a water tank.

    Returns:
        The lag with its interval, or the reason why the data give no lag (``Lag.verdict``).

    Raises:
        ConfigError: a stream has nothing that could move, there are not as many of each, or a number is out of range.

    Example:
        >>> found = igtl_gateway.lag(recording["TRANSFORM/Probe"], recording["IMAGE/Video"])  # doctest: +SKIP
        >>> found.lag_s, found.low_s, found.high_s  # doctest: +SKIP
    """
    for name, value in (("max_lag_s", max_lag_s), ("cut_off_hz", cut_off_hz)):
        if value is not None and not 0 < value < math.inf:
            raise ConfigError(f"{name}: found {value:g}, expected more than 0")
    one, other = ([each] if isinstance(each, Stream) else list(each) for each in (fixed, moving))
    if len(one) != len(other) or not one:
        raise ConfigError(
            f"found {len(one)} fixed and {counted(len(other), 'moving stream')}, expected as many of each"
        )
    pairs = [
        (movement(first, frame=frame, line=line), movement(second, frame=frame, line=line))
        for first, second in zip(one, other, strict=True)
    ]
    if len(pairs) == 1:
        return measure_lag(*pairs[0], max_lag_s=max_lag_s, cut_off_hz=cut_off_hz)
    return measure_together(pairs, max_lag_s=max_lag_s, cut_off_hz=cut_off_hz)


def movement(
    stream: Stream, *, frame: str = "", line: bool = False, arrival: bool = False, at: Array | None = None
) -> Signal:
    """Return what moves in a stream, at its stamps (``Stream.stamps``), or at gateway times if a message has none.

    Of poses it is the translation (and the rotation, times 0.1 m); of images their first principal components, or the
    height of a bright line; of point clouds the centroid; of joint states, sensors and arrays the numbers.

    Args:
        stream: the stream.
        frame: as of ``Stream.poses``.
        line: follow the bright line in images.
        arrival: at gateway times instead of the sender's stamps.
        at: (N,) int64, times of the messages, UTC ns, instead of both.

    Raises:
        ConfigError: it has nothing that could move.
    """
    for types, read in _READERS:
        if types & {stream.type}:
            values, unit = read(stream, line)
            rows, stamps = np.arange(len(stream.times)), stream.stamps
            break
    else:
        rows, stamps, values, unit = _of_poses(stream, frame)
    if at is not None:
        return Signal.of(at[rows], values, stream.key, unit)
    is_stamped = not arrival and len(stream) > 0 and bool(np.all(stamps))
    times = stamps if is_stamped else stream.times[rows]
    return Signal.of(times, values, stream.key, unit, is_stamped=is_stamped)


def movements(
    recordings: Iterable[Mapping[str, Stream]],
    *,
    frame: str = "",
    line: bool = False,
) -> tuple[list[Signal], dict[str, str]]:
    """Return what moves in each input stream that has something that could move; unreadable streams → why.

    The first one is the reference of the others: of the streams that move and turn round, that with most samples.
    Encoded pictures are left out.

    Of more than 100 streams, those with too few samples are left out.

    Raises:
        GatewayError: more than 100 are left.
    """
    found, unreadable = [], {}
    every = (stream for each in recordings for stream in each.values())
    inputs = [each for each in every if Kind(each.direction).is_input and each.type not in _ENCODED]
    if len(inputs) > _MOST_STREAMS:
        inputs = [stream for stream in inputs if stream.count >= LEAST_SAMPLES]
    if len(inputs) > _MOST_STREAMS:
        raise GatewayError(
            f"found {count_text(len(inputs), 'input stream')}, expected up to {_MOST_STREAMS}, or their names"
        )
    for stream in inputs:
        try:
            found.append(movement(stream, frame=frame, line=line))
        except ConfigError:  # nothing that could move
            continue
        except GatewayError as error:
            unreadable[stream.key] = str(error).removeprefix(f"{stream.key}: ")
    return sorted(found, key=lambda signal: (not moves(signal), -len(signal.times_ns))), unreadable


def too_few(signals: Sequence[Signal], unreadable: Mapping[str, str], path: Path) -> GatewayError:
    """Return the error for fewer than two signals of a file: DamagedRecording if a stream is unreadable."""
    streams = counted(len(signals), "stream")
    text = f"{path}: found {streams} in which something could move, expected two"
    if not unreadable:
        return GatewayError(text)
    return DamagedRecording(f"{text}; unreadable: {'; '.join(f'{key} ({why})' for key, why in unreadable.items())}")


def _of_poses(stream: Stream, frame: str) -> tuple[Array, Array, Array, str]:
    """Indices of the messages, their stamps, and the poses or the numbers in them."""
    try:
        poses = stream.poses(frame).in_unit("m")
    except ConfigError:
        if frame or stream.type in POSES_BY_NAME:
            raise
        return np.arange(len(stream.times)), stream.stamps, _of_numbers(stream), ""
    turned = _rotation_vectors(poses.matrices[:, :3, :3]) * _TOOL_M
    # of several frames, each has the stamp of its own header
    stamps = poses.stamps if frame and np.any(poses.stamps) else stream.stamps[poses.rows]
    return poses.rows, stamps, np.concatenate([poses.positions, turned], axis=1), "m"


def tools(message: RecordedMessage) -> list[str]:
    """Return the names of the tools in tracking data."""
    names = [bytes(element["name"]).partition(b"\0")[0] for element in message.content.elements]
    return [frames_of(name.decode("utf-8", "surrogateescape"), "")[1] for name in names]


def _rotation_vectors(rotations: Array) -> Array:
    """Return rotation vectors (N, 3) in rad, relative to the rotation in the middle of the stream."""
    turned = np.einsum("ij,njk->nik", rotations[len(rotations) // 2].T, rotations) if len(rotations) else rotations
    axes = np.stack(
        [turned[:, 2, 1] - turned[:, 1, 2], turned[:, 0, 2] - turned[:, 2, 0], turned[:, 1, 0] - turned[:, 0, 1]], 1
    )
    sines = np.linalg.norm(axes, axis=1) / 2
    angles = np.arctan2(sines, (np.trace(turned, axis1=1, axis2=2) - 1) / 2)
    return np.asarray(axes / 2 * (angles / np.maximum(sines, 1e-12))[:, np.newaxis])


def _of_images(stream: Stream, line: bool) -> tuple[Array, str]:
    """The first principal components of small grey pictures, or the height of the bright line."""
    pictures = (_grey(view.array) for view in stream.images())
    if line:
        return np.array([line_height(picture) for picture in pictures]), "px"
    return picture_components(pictures), ""


def _of_encoded(stream: Stream, line: bool) -> tuple[Array, str]:
    """The same of encoded pictures, which the add-on ``lerobot`` decodes; NaN where there is none."""
    pictures = part_of("lerobot", "pictures:Pictures")(stream)
    grey = (pictures.rgb(index).mean(axis=2) for index in pictures.usable.tolist())
    values = np.array([line_height(each) for each in grey]) if line else picture_components(grey)
    found = np.full((len(stream), *values.shape[1:]), np.nan)
    found[pictures.usable] = values
    return found, "px" if line else ""


def picture_components(pictures: Iterable[Array]) -> Array:
    """Return the first principal components (N, up to 3) of small versions of grey pictures (rows, columns).

    NaN for a picture with values that are not finite, and for one of another size than the first one.
    """
    small = [_thumbnail(picture) for picture in pictures]
    if not small:
        return np.zeros((0, 1))
    size = small[0].size
    good = np.array([each.size == size and bool((np.abs(each) < LARGEST).all()) for each in small])
    found = np.full((len(small), min(_COMPONENTS, size)), np.nan)
    if not good.any():
        return found
    kept = np.array([each for each, is_good in zip(small, good.tolist(), strict=True) if is_good])
    # of the smaller of the two products: a second of video, or an hour
    left, sizes, _ = np.linalg.svd(kept - kept.mean(axis=0), full_matrices=False)
    components = left[:, :_COMPONENTS] * sizes[:_COMPONENTS]
    found = found[:, : components.shape[1]]
    found[good] = components
    return found


def _grey(array: Array) -> Array:
    """The middle slice, as the mean of its components: (rows, columns)."""
    plane = array[array.shape[0] // 2]
    return np.asarray(plane.mean(axis=2) if plane.ndim == 3 else plane)


def _thumbnail(picture: Array) -> Array:
    """The means of the parts of a picture, one after the other."""
    rows, columns = (np.linspace(0, size, min(size, _THUMBNAIL) + 1).astype(int)[:-1] for size in picture.shape)
    sums = np.add.reduceat(np.add.reduceat(picture.astype(np.float64), rows, axis=0), columns, axis=1)
    counts = np.diff([*rows, picture.shape[0]])[:, np.newaxis] * np.diff([*columns, picture.shape[1]])
    return np.asarray((sums / counts).ravel())


def _of_clouds(stream: Stream, _line: bool) -> tuple[Array, str]:
    """The centroids; NaN for a cloud without points."""
    clouds = stream.points()
    centroids = np.full((len(clouds), 3), np.nan)
    for index, cloud in enumerate(clouds):
        known = cloud.xyz[np.isfinite(cloud.xyz).all(axis=1)]
        if len(known):
            centroids[index] = known.mean(axis=0, dtype=np.float64)
    return centroids, stream.unit


def _of_numbers(stream: Stream) -> Array:
    """The numbers in the messages, as many as the first message has; NaN for one that has others.

    Of joints those of each name, whatever their order is, and whether or not all are in each message.
    """
    messages = [message.content for message in stream.messages()]
    for field in _OF_JOINTS:
        if (values := _of_names(messages, field, stream)) is not None:
            return values
    rows = [_numbers(content) for content in messages]
    size = len(rows[0]) if rows else 0
    if rows and not size:
        raise ConfigError(f"{stream.key}: found {stream.type}, expected poses, images, points or numbers")
    return np.array([row if len(row) == size else [np.nan] * size for row in rows]).reshape(len(rows), size)


def _of_names(messages: Sequence[Any], field: str, stream: Stream) -> Array | None:
    """A field of messages by the names in them (N, K), K up to ``_MOST_NUMBERS``; None without names or numbers."""
    name = next((each for each in NAME_FIELDS if messages and hasattr(messages[0], each)), "")
    lists = [getattr(content, name, None) for content in messages] if name else []
    if not any(isinstance(each, list) and each and isinstance(each[0], str) for each in lists):
        return None
    found = by_name(lists, [getattr(content, field, None) for content in messages])
    if found is None:
        return None
    times = stream.stamps if np.all(stream.stamps > 0) else stream.times
    return completed(found, times, "interpolate", _LONGEST_NS)[:, :_MOST_NUMBERS]


def _numbers(content: Any) -> list[float]:
    """The numbers in the fields of a message, without its header; of joints only the positions."""
    names = [name for name in getattr(content, "__dataclass_fields__", ()) if name not in _NOT_MOVING]
    if len(getattr(content, "position", ())):
        names = ["position"]
    found: list[float] = []
    for name in names:
        value = np.asarray(getattr(content, name))
        if value.dtype.kind in "fiu" and len(found) + value.size <= _MOST_NUMBERS:
            found += value.astype(np.float64).ravel().tolist()
    return found


#: Types → what moves in them; other types have poses or numbers.
_READERS: tuple[tuple[frozenset[str], Callable[[Stream, bool], tuple[Array, str]]], ...] = (
    (frozenset({"IMAGE", RosImage.TYPE, Volume.TYPE}), _of_images),
    (_ENCODED, _of_encoded),
    (frozenset({"POINT", "POLYDATA", PointCloud2.TYPE, PointList.TYPE, Marker.TYPE, PointStamped.TYPE}), _of_clouds),
)
