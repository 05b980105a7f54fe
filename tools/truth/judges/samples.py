"""What a reader found, as statements that can be true or false: this thing, at this time, was there."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, TypeGuard

import numpy as np

from tools.truth import world
from tools.truth.world import Array

#: A thing: its kind and number.
Thing = tuple[Any, ...]


@dataclass(frozen=True)
class Sample:
    """A statement of a result.

    Attributes:
        stream: as the result names it: a key, a topic, the name of a file, an entity.
        name: within it: of a tool, frame, joint or point; None: the result states none.
        kind: how the value is read: pose, place, picture, video, depth, cloud, joint, plan, static, text.
        value: lengths in mm by the unit that the result states.
        source_ns, stamp_ns, time_ns: UTC: stamp of the sender, stamp in the message, receipt; 0: not stated.
        frame: number of the row or frame in which it stands with others; -1: alone.
    """

    stream: str
    name: str | None
    kind: str
    value: Any
    source_ns: int = 0
    stamp_ns: int = 0
    time_ns: int = 0
    frame: int = -1


def moment_of(sample: Sample) -> tuple[Thing, float | None, float]:
    """What a value is of, when (s; None: always), and how far it is from every truth (mm)."""
    value = sample.value
    if sample.kind == "pose":
        thing, at, off = world.moment_of_pose(value)
        return ("pose", thing), at, off
    if sample.kind == "place":
        thing, at, off = world.moment(np.asarray(value, float))
        return ("pose", thing), at, off
    if sample.kind == "picture":
        thing, at, off = world.moment_of_picture(value)
        return ("picture", thing), at, off
    if sample.kind == "video":
        thing, at = world.moment_of_video(value)
        return ("picture", thing), at, 0.0
    if sample.kind == "depth":
        at, off = world.moment_of_depth(value)
        return ("depth", 0), at, off
    if sample.kind == "cloud":
        thing, at, off = world.moment_of_cloud(np.asarray(value, float))
        return ("cloud", thing), at, off
    if sample.kind == "joint":
        arm, number, at = world.moment_of_joint(value)
        return ("joint", arm, number), at, 0.0
    if sample.kind == "plan":
        return ("plan", sample.name), None, _off(value, world.PLAN.get(sample.name or ""))
    if sample.kind == "static":
        return ("static", 0), None, _off(value, world.CAMERA_IN_BASE)
    if sample.kind == "text":
        return ("text", 0), int(str(value).split()[1]) / 1000, 0.0
    raise AssertionError(sample.kind)


def _off(found: Any, wanted: Any) -> float:
    return float("inf") if wanted is None else float(np.abs(np.asarray(found, float) - np.asarray(wanted)).max())


def turned(x: float, y: float, z: float, w: float) -> Array:
    """The matrix (3, 3) of a quaternion, by its definition."""
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def posed(place_mm: Any, turn: Any) -> Array:
    """A pose of a position in mm and a quaternion x, y, z, w."""
    matrix = np.eye(4)
    matrix[:3, :3] = turned(*(float(each) for each in turn))
    matrix[:3, 3] = np.asarray(place_mm, float)
    return matrix


def nested(row: Mapping[str, Any]) -> dict[str, Any]:
    """A flat row as dictionaries in dictionaries: dots of its columns are levels."""
    found: dict[str, Any] = {}
    for column, value in row.items():
        *levels, last = column.split(".")
        place = found
        for level in levels:
            inner = place.setdefault(level, {})
            place = inner if isinstance(inner, dict) else place.setdefault(level + ".", {})
        place[last] = nested(value) if isinstance(value, dict) else value
    return found


#: Mm of a column whose name ends so.
_UNITS = {"_mm": 1.0, "_m": 1000.0}


def place_of(cells: Mapping[str, Any]) -> Array | None:
    """The position in x, y and z of a dictionary, mm; None if it has none or they are empty."""
    for end, scale in _UNITS.items():
        found = [cells.get(f"{axis}{end}") for axis in "xyz"]
        if all(map(_is_number, found)):
            return np.array(found, float) * scale
    return None


def _turn_of(cells: Any, names: tuple[str, ...]) -> list[float] | None:
    found = [cells.get(each) for each in names] if isinstance(cells, dict) else [None]
    numbers = [float(each) for each in found if _is_number(each)]
    return numbers if len(numbers) == len(names) else None


def _is_number(value: Any) -> TypeGuard[float]:
    return isinstance(value, (int, float)) and math.isfinite(value)


def of_row(row: Mapping[str, Any], stream: str, frame: int) -> Iterator[Sample]:
    """The samples of a row of a table, with the names that its columns or cells have."""
    cells = nested(row)
    times = {name: int(cells.get(name) or 0) for name in ("source_ns", "time_ns")}
    link = cells.get("link")
    stream = stream if link is None else f"{stream}#{link}"
    yield from _walk(cells, Sample(stream, "", "", None, **times, frame=frame), None, 0)


def _listed(value: Any) -> list[Any]:
    if isinstance(value, dict):  # columns .0, .1, …
        return [each for key, each in sorted(value.items(), key=lambda one: int(one[0]))] if _is_list(value) else []
    return list(value) if isinstance(value, (list, tuple, np.ndarray)) else []


def _is_list(value: Mapping[str, Any]) -> bool:
    return all(key.isdigit() for key in value)


def _walk(cells: dict[str, Any], base: Sample, name: str | None, stamp_ns: int) -> Iterator[Sample]:
    if "mesh_resource" in cells:  # a Marker: its pose is that of the frame
        return
    header = cells.get("header")
    if isinstance(header, dict):
        stamp_ns = int(header.get("stamp_ns") or 0)
    own = cells.get("child_frame_id") or cells.get("name")
    name = own if isinstance(own, str) else name

    def sample(kind: str, value: Any, named: str | None = name) -> Sample:
        return Sample(base.stream, named, kind, value, base.source_ns, stamp_ns, base.time_ns, base.frame)

    names, angles = _listed(cells.get("name")), _listed(cells.get("position"))
    if names and angles and isinstance(names[0], str):
        for each, angle in zip(names, angles, strict=False):
            if isinstance(each, str) and _is_number(angle):
                yield sample("joint", float(angle), each)
        return
    text = cells.get("string", cells.get("data"))
    if isinstance(text, str) and text.startswith("at "):
        yield sample("text", text)
        return
    place = place_of(cells)
    if place is not None:
        rows = [cells.get(f"r{row}{column}") for row in "123" for column in "123"]
        turn = _turn_of(cells, ("qx", "qy", "qz", "qw"))
        if all(isinstance(each, float) for each in rows):
            matrix = np.eye(4)
            matrix[:3, :3] = np.array(rows).reshape(3, 3)
            matrix[:3, 3] = place
            yield sample("pose", matrix)
            if turn is None or np.abs(turned(*turn) - matrix[:3, :3]).max() > 1e-3:
                yield sample("pose", np.full((4, 4), np.nan))  # the row contradicts itself
        return
    for position, turning in (("position", "orientation"), ("translation", "rotation")):
        inner = cells.get(position)
        if isinstance(inner, dict) and (place := place_of(inner)) is not None:
            turn = _turn_of(cells.get(turning), tuple("xyzw"))
            if turn is not None:
                # the static frame is the only pose that does not move
                yield sample("static", place) if name == "camera" else sample("pose", posed(place, turn))
            elif isinstance(name, str) and name in world.PLAN:
                yield sample("plan", place)
            return
    if (picture := _picture(cells)) is not None:
        yield sample(*picture)
        return
    if "points_mm" in cells and len(cells["points_mm"] or ()) == world.POINTS:
        yield sample("cloud", np.array(cells["points_mm"], float))
        return
    for key in ("points", "vertices"):  # of a surface; a plan has names
        found = [
            place_of(nested(each)) for each in _listed(cells.get(key)) if isinstance(each, dict) and "name" not in each
        ]
        if len(found) == world.POINTS and all(each is not None for each in found):
            yield sample("cloud", np.array(found))
            return
    for key, value in cells.items():
        if isinstance(value, dict) and not (value and _is_list(value)):
            yield from _walk(value, base, name, stamp_ns)
            continue
        for each in _listed(value) if key != "links" else ():
            if isinstance(each, dict):
                yield from _walk(nested(each), base, None, stamp_ns)


def _picture(cells: Mapping[str, Any]) -> tuple[str, Any] | None:
    """A picture of an IMAGE or sensor_msgs/Image in binary columns."""
    if isinstance(pixels := cells.get("pixels"), bytes):
        columns, rows = _listed(cells.get("dimensions"))[:2]
        return "picture", np.frombuffer(pixels, np.uint8).reshape(rows, columns)
    if isinstance(data := cells.get("data"), bytes) and "encoding" in cells:
        return ros_picture(cells["encoding"], cells["height"], cells["width"], data)
    return None


def ros_picture(encoding: str, rows: int, columns: int, data: Any) -> tuple[str, Any] | None:
    """The picture of a sensor_msgs/Image."""
    if encoding == "mono8":
        return "picture", np.frombuffer(bytes(data), np.uint8).reshape(rows, columns)
    if encoding == "16UC1":
        return "depth", np.frombuffer(bytes(data), "<u2").reshape(rows, columns)
    return None
