"""Data sets of LeRobot as its readers read them: tables by pyarrow, videos by PyAV, names by ``info.json``."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import av
import numpy as np
import pyarrow.parquet
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from igtl_gateway.base.versions import tomllib
from tools.truth.judges import ros
from tools.truth.judges.samples import Sample, posed

Frames = Iterator[tuple[Sample, list[Sample]]]

#: Streams of the pictures of the recipe of ``routes``.
_PICTURES = {"observation.images.us": "IMAGE/Image", "observation.images.camera": "/camera/image"}
#: Columns of a native table beside its numbers.
_NATIVE = ("entry", "time_ns", "stamp_ns", "received_ns", "episode_index", "usable")
_JOINT = re.compile(r"arm\d_joint\d")
_PARTS = ("x", "y", "z", "qx", "qy", "qz", "qw")


def by_pyarrow(folder: Path) -> Frames:
    """The frames of a set: its first picture, and all else that is in the row."""
    info = _info(folder)
    rows = _rows(folder)
    videos = {key: _frames(folder, key) for key, one in info["features"].items() if one["dtype"] == "video"}
    for number, row in enumerate(rows):
        pictures = {key: each[number] for key, each in videos.items()}
        yield from _framed(_values(info["features"], row, number, "video", pictures))


def by_samples(found: Sequence[Mapping[str, Any]], features: Mapping[str, Any]) -> Frames:
    """The same of samples, whose pictures are as recorded: RGB of grey."""
    for number, row in enumerate(found):
        pictures = {key: value[:, :, 0] for key, value in row.items() if key in _PICTURES}
        yield from _framed(_values(features, row, number, "picture", pictures))


def by_mcap(path: Path, folder: Path) -> tuple[Frames, int]:
    """The same of a session that was a set, by the stamps of its messages; and how many of them the set does not have.

    Args:
        path: of the session.
        folder: of the set.
    """
    times = [row["time_ns"] for row in _provenance(folder)]
    found: dict[int, list[Sample]] = {}
    decoders: dict[str, Any] = {}
    with path.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        for schema, channel, _, message in reader.iter_decoded_messages():
            kind, topic = schema.name.rpartition("/")[2] if schema else "", channel.topic
            if not topic.startswith("/observation"):
                continue
            if kind == "CompressedVideo":
                stamp = message.timestamp
                picture = _decoded(decoders, topic, message)
                samples = [Sample(_PICTURES[topic[1:].replace("/", ".")], "", "video", picture)]
            else:
                stamp = message.header.stamp
                samples = [one for one in ros.of_message(message, topic, kind) if _is_value(one)]
            at_ns = stamp.sec * 10**9 + stamp.nanosec
            found.setdefault(at_ns, []).extend(samples)
    frames = ([replace(one, stamp_ns=0, frame=at) for one in found[at]] for at in sorted(found))
    return (frame for samples in frames for frame in _framed(samples)), len(set(times) ^ set(found))


def by_stamps(folder: Path, clock: str) -> Iterator[Sample]:
    """The numbers and pictures of messages with the stamps that the frames state, and all rows of the native tables.

    Args:
        folder: of a set with stamps and native tables of ``observation.state``.
        clock: that the set states: "gateway" if its stamps are times of receipt.
    """
    info, recipe = _info(folder), tomllib.loads((folder / "meta" / "recipe.toml").read_text())
    streams: dict[str, list[str]] = {}
    for row in recipe["feature"]:
        streams.setdefault(row["name"], []).append(row.get("stream", ""))
    own = "time_ns" if clock == "gateway" else "source_ns"
    rows, labels = _rows(folder), info["features"]["stamp_ns"]["names"]
    tables = sorted((folder / "meta" / "native").glob("observation.state.*"), key=lambda one: int(one.suffix[1:]))
    places: list[tuple[str, list[str]]] = []
    has: set[tuple[int, int, str]] = set()  # row, stamp and name of each number that a message has
    for number, path in enumerate(tables):
        table = pyarrow.parquet.read_table(path)
        names = [name for name in table.column_names if name not in _NATIVE]
        places.append((streams["observation.state"][number], names))
        for row in table.to_pylist():
            own_names = [name for name in names if row[name] == row[name]]  # NaN: not in the message
            for one in _numbers(places[-1][0], own_names, [row[name] for name in own_names], -1):
                yield replace(one, source_ns=row["stamp_ns"], time_ns=row["received_ns"])
            stamp_ns = row["stamp_ns" if own == "source_ns" else "received_ns"]
            has.update((number, stamp_ns, name) for name in own_names)
    for number, row in enumerate(rows):
        stamps = dict(zip(labels, row["stamp_ns"], strict=True))
        at = 0
        for index, (stream, names) in enumerate(places):
            values = row["observation.state"][at : at + len(names)]
            at += len(names)
            stamp_ns = stamps[f"observation.state[{index}]"]
            # between two messages there is no stamp of its own
            if stamps.get(f"observation.state[{index}].after", stamp_ns) != stamp_ns:
                continue
            # what a message does not have is that of another one, by the rule
            cells = {name: cell for name, cell in zip(names, values, strict=True) if (index, stamp_ns, name) in has}
            for one in _numbers(stream, list(cells), list(cells.values()), number):
                yield replace(one, **{own: stamp_ns})
    for key, one in info["features"].items():
        for number, pixels in enumerate(_frames(folder, key) if one["dtype"] == "video" else ()):
            stamp_ns = rows[number]["stamp_ns"][labels.index(f"{key}[0]")]
            yield replace(Sample(_PICTURES[key], "", "video", pixels), **{own: stamp_ns})


def _info(folder: Path) -> Any:
    return json.loads((folder / "meta" / "info.json").read_text())


def _rows(folder: Path) -> list[dict[str, Any]]:
    paths = (folder / "data").rglob("*.parquet")
    rows = [row for path in paths for row in pyarrow.parquet.read_table(path).to_pylist()]
    return sorted(rows, key=lambda row: int(row["index"]))


def _provenance(folder: Path) -> list[dict[str, Any]]:
    paths = (folder / "meta").glob("provenance*.parquet")
    return [row for path in paths for row in pyarrow.parquet.read_table(path).to_pylist()]


def _decoded(decoders: dict[str, Any], topic: str, message: Any) -> Any:
    """The grey picture of a frame of a video."""
    if topic not in decoders:
        decoders[topic] = av.CodecContext.create(message.format, "r")
        decoders[topic].flags |= av.codec.context.Flags.low_delay
        decoders[topic].thread_count = 1
    [frame] = decoders[topic].decode(av.Packet(bytes(message.data)))
    return frame.to_ndarray(format="gray")


def _is_value(sample: Sample) -> bool:
    """The state has its poses as numbers, too."""
    return sample.kind != "joint" or bool(_JOINT.search(sample.name or ""))


def _framed(found: list[Sample]) -> Frames:
    pictures = [one for one in found if one.kind in ("video", "picture")] or found
    if pictures:
        yield pictures[0], [one for one in found if one is not pictures[0]]


def _values(
    features: Mapping[str, Any], row: Mapping[str, Any], number: int, kind: str, pictures: Mapping[str, Any]
) -> list[Sample]:
    """All that a row has, as samples."""
    found: list[Sample] = []
    for key, feature in features.items():
        if key in pictures:
            found.append(Sample(_PICTURES[key], "", kind, pictures[key], frame=number))
        elif feature["dtype"] == "float32" and key.startswith("observation"):
            found += _numbers(key, feature["names"], row[key], number)
        elif isinstance(row.get(key), str) and row[key].startswith("at "):
            found.append(Sample(key, "", "text", row[key], frame=number))
    return found


def _frames(folder: Path, key: str) -> list[Any]:
    """The pictures of a feature over all episodes, in their order."""
    found = []
    for path in sorted(one for one in (folder / "videos").rglob("*.mp4") if key in one.parts):
        with av.open(str(path)) as container:
            found += [frame.to_ndarray(format="gray") for frame in container.decode(video=0)]
    return found


def _numbers(key: str, names: Sequence[str], values: Sequence[float], number: int) -> Iterator[Sample]:
    """The poses and joints of a vector, by the names of its elements."""
    cells = dict(zip(names, values, strict=True))
    if len(cells) != len(names):
        yield Sample(key, "two elements of one name", "pose", np.full((4, 4), np.nan), frame=number)
    stems = dict.fromkeys(name.rpartition(".")[0] for name in names)
    for stem in stems:
        pose = [cells.get(f"{stem}.{part}" if stem else part) for part in _PARTS]
        if all(each is not None for each in pose):
            place = np.array(pose[:3], float) * 1000
            yield Sample(key, stem, "pose", posed(place, pose[3:]), frame=number)
    for name, value in cells.items():
        if joint := _JOINT.search(name):
            yield Sample(key, joint.group(0), "joint", value, frame=number)
