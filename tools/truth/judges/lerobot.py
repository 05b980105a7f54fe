"""Data sets of LeRobot as its readers read them: tables by pyarrow, videos by PyAV, names by ``info.json``."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import av
import numpy as np
import pyarrow.parquet

from tools.truth.judges.samples import Sample, posed

#: Streams of the pictures of the recipe of ``routes``.
_PICTURES = {"observation.images.us": "IMAGE/Image", "observation.images.camera": "/camera/image"}
_PARTS = ("x", "y", "z", "qx", "qy", "qz", "qw")


def by_pyarrow(folder: Path) -> Iterator[tuple[Sample, list[Sample]]]:
    """The frames of a set: its first picture, and all else that is in the row."""
    info = json.loads((folder / "meta" / "info.json").read_text())
    rows = [
        row
        for path in sorted((folder / "data").rglob("*.parquet"))
        for row in pyarrow.parquet.read_table(path).to_pylist()
    ]
    rows.sort(key=lambda row: row["index"])
    times = {}
    for row in pyarrow.parquet.read_table(folder / "meta" / "provenance.parquet").to_pylist():
        times[row["index"]] = row["time_ns"]
    videos = {key: _frames(folder, key) for key, one in info["features"].items() if one["dtype"] == "video"}
    for number, row in enumerate(rows):
        found: list[Sample] = []
        for key, feature in info["features"].items():
            if key in videos:
                found.append(Sample(_PICTURES[key], "", "video", videos[key][number], frame=number))
            elif isinstance(row.get(key), list) and key.startswith("observation"):
                found += _numbers(key, feature["names"], row[key], number)
            elif isinstance(row.get(key), str) and row[key].startswith("at "):
                found.append(Sample(key, "", "text", row[key], frame=number))
        pictures = [one for one in found if one.kind == "video"] or found
        if pictures:
            yield pictures[0], [one for one in found if one is not pictures[0]]


def _frames(folder: Path, key: str) -> list[Any]:
    """The pictures of a feature over all episodes, in their order."""
    found = []
    for path in sorted(one for one in (folder / "videos").rglob("*.mp4") if key in one.parts):
        with av.open(str(path)) as container:
            found += [frame.to_ndarray(format="gray") for frame in container.decode(video=0)]
    return found


def _numbers(key: str, names: list[str], values: list[float], number: int) -> Iterator[Sample]:
    """The poses and joints of a vector, by the names of its elements."""
    cells = dict(zip(names, values, strict=True))
    if len(cells) != len(names):
        yield Sample(key, "two elements of one name", "pose", np.full((4, 4), np.nan), frame=number)
    stems = dict.fromkeys(name.rpartition(".")[0] for name in names)
    for stem in stems:
        pose = [cells.get(f"{stem}.{part}") for part in _PARTS]
        if all(each is not None for each in pose):
            place = np.array(pose[:3], float) * 1000
            yield Sample(key, stem, "pose", posed(place, pose[3:]), frame=number)
    for name, value in cells.items():
        if joint := re.search(r"arm\d_joint\d", name):
            yield Sample(key, joint.group(0), "joint", value, frame=number)
