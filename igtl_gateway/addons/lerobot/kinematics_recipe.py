"""A recipe for videos with tables of kinematics, as TOML: each error has file, place, value found and value expected.

``examples/kinematics.toml`` has all keys.  The begin of the session is the first time of ``zero = "utc"``, or else that
of ``import --epoch``.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import MISSING, dataclass, fields
from pathlib import Path, PurePosixPath
from typing import Any, TypeVar

from igtl_gateway.addon import ConfigError, one_of
from igtl_gateway.addon.settings import read_toml
from igtl_gateway.addon.terminal import count_text, counted

Column = str | int
Columns = tuple[Column, ...]

#: Unit of time → ns; unit of a length → m; unit of a joint → rad or m.
TIMES = {"s": 1_000_000_000, "ms": 1_000_000, "us": 1000, "ns": 1}
LENGTHS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6}
JOINTS = {"rad": 1.0, "deg": math.pi / 180, **LENGTHS}
SEPARATORS = {",": ",", ";": ";", "tab": "\t", "space": " "}
ORDERS = ("xyzw", "wxyz")
VIDEOS, TEXTS, HDF5S = (".mp4", ".m4v", ".mov"), (".csv", ".txt", ".tsv"), (".h5", ".hdf5")
BEGIN, UTC = "begin", "utc"
_TOPIC = re.compile(r"(/[A-Za-z_][A-Za-z0-9_]*)+")
_MOST_TEXT, _MOST_COLUMNS, _MOST_S, _MOST_HZ = 255, 1000, 1e9, 1e5


@dataclass(frozen=True, slots=True)
class VideoRow:
    """``[[video]]``; ``time`` and ``unit`` belong to ``times``, whose times count from where those of the tables do."""

    file: str
    name: str
    frame: str = ""
    start: float = 0.0
    times: str = ""
    time: Column = ""
    unit: str = "s"


@dataclass(frozen=True, slots=True)
class PoseRow:
    """``[[table.pose]]``: columns of a position, and of a quaternion or of a matrix row by row."""

    name: str
    position: Columns
    unit: str
    quaternion: Columns = ()
    order: str = "xyzw"
    rotation: Columns = ()
    frame: str = ""


@dataclass(frozen=True, slots=True)
class JointsRow:
    """``[[table.joints]]``."""

    name: str
    position: Columns
    velocity: Columns = ()
    effort: Columns = ()
    names: tuple[str, ...] = ()
    unit: str = "rad"


@dataclass(frozen=True, slots=True)
class TableRow:
    """``[[table]]``."""

    file: str
    time: Column = ""
    unit: str = "s"
    zero: str = BEGIN
    rate: float = 0.0
    start: float = 0.0
    separator: str = ","
    header: bool = True
    pose: tuple[PoseRow, ...] = ()
    joints: tuple[JointsRow, ...] = ()

    def places(self, place: str) -> dict[Column, str]:
        """Return each column → where it is named first; ``place``: of the table."""
        named: list[tuple[str, Columns]] = [(f"{place}.time", (self.time,) if self.time else ())]
        for index, pose in enumerate(self.pose):
            of_pose = {"position": pose.position, "quaternion": pose.quaternion, "rotation": pose.rotation}
            named += [(f"{place}.pose[{index}].{name}", columns) for name, columns in of_pose.items()]
        for index, joints in enumerate(self.joints):
            of_joints = {"position": joints.position, "velocity": joints.velocity, "effort": joints.effort}
            named += [(f"{place}.joints[{index}].{name}", columns) for name, columns in of_joints.items()]
        places: dict[Column, str] = {}
        for where, columns in named:
            for column in columns:
                places.setdefault(column, where)
        return places


@dataclass(frozen=True, slots=True)
class KinematicsRecipe:
    """A recipe; files are below ``folder``."""

    folder: Path
    video: tuple[VideoRow, ...]
    table: tuple[TableRow, ...]

    def path(self, file: str) -> Path:
        """Return the path of a file of the recipe."""
        return self.folder / file


def is_hdf5(file: str) -> bool:
    """Return whether a file of a recipe is HDF5, by its name."""
    return PurePosixPath(file).suffix.lower() in HDF5S


Check = tuple[Callable[[Any], bool], str]
Row = TypeVar("Row", VideoRow, TableRow, PoseRow, JointsRow)


def _is_text(value: Any) -> bool:
    return isinstance(value, str) and 1 <= len(value) <= _MOST_TEXT and value.isprintable()


def _is_column(value: Any) -> bool:
    return _is_text(value) or (type(value) is int and 1 <= value <= 1_000_000)


def _file(suffixes: tuple[str, ...]) -> Check:
    def is_good(value: Any) -> bool:
        if not _is_text(value) or "\\" in value or ":" in value:
            return False
        path = PurePosixPath(value)
        return not path.is_absolute() and ".." not in path.parts and path.suffix.lower() in suffixes

    return is_good, f"a file in or below the folder of the recipe, {', '.join(suffixes)}"


def _columns(count: int = 0) -> Check:
    def is_good(value: Any) -> bool:
        is_list = isinstance(value, list) and all(map(_is_column, value))
        return is_list and (len(value) == count if count else 1 <= len(value) <= _MOST_COLUMNS)

    return is_good, f"{count_text(count, 'column') if count else 'columns'}, by name or by number from 1 on"


def _choice(values: Any) -> Check:
    return lambda value: isinstance(value, str) and value in values, f"one of {', '.join(values)}"


def _number(least: float, most: float) -> Check:
    def is_good(value: Any) -> bool:
        return type(value) in (int, float) and math.isfinite(value) and least <= value <= most

    return is_good, f"a number from {least:g} to {most:g}"


_NAME: Check = (
    lambda value: _is_text(value) and _TOPIC.fullmatch(value) is not None, "a topic such as /PSM1/measured_cp"
)  # fmt: skip
_COLUMN: Check = (_is_column, "a column, by name or by number from 1 on")
_TEXT: Check = (_is_text, f"a string of 1 to {_MOST_TEXT} characters")
_ROWS: Check = (lambda value: isinstance(value, list) and all(isinstance(each, dict) for each in value), "tables")
_VIDEO: dict[str, Check] = {
    "file": _file(VIDEOS),
    "name": _NAME,
    "frame": _TEXT,
    "start": _number(-_MOST_S, _MOST_S),
    "times": _file(TEXTS + HDF5S),
    "time": _COLUMN,
    "unit": _choice(TIMES),
}
_TABLE: dict[str, Check] = {
    "file": _file(TEXTS + HDF5S),
    "time": _COLUMN,
    "unit": _choice(TIMES),
    "zero": _choice((BEGIN, UTC)),
    "rate": _number(1e-3, _MOST_HZ),
    "start": _number(-_MOST_S, _MOST_S),
    "separator": _choice(SEPARATORS),
    "header": (lambda value: type(value) is bool, "true or false"),
    "pose": _ROWS,
    "joints": _ROWS,
}
_POSE: dict[str, Check] = {
    "name": _NAME,
    "frame": _TEXT,
    "position": _columns(3),
    "unit": _choice(LENGTHS),
    "quaternion": _columns(4),
    "order": _choice(ORDERS),
    "rotation": _columns(9),
}
_JOINTS: dict[str, Check] = {
    "name": _NAME,
    "position": _columns(),
    "velocity": _columns(),
    "effort": _columns(),
    "names": (
        lambda value: isinstance(value, list) and all(map(_is_text, value)) and len(set(value)) == len(value),
        'different strings, such as ["yaw", "pitch"]',
    ),
    "unit": _choice(JOINTS),
}


def read_kinematics_recipe(path: Path) -> KinematicsRecipe:
    """Read and check a recipe.  Raises ConfigError with file, place, value found and value expected."""
    document = read_toml(path)
    try:
        for name in document:
            if name not in ("video", "table"):
                raise ConfigError(f"{name}: unknown table, expected {one_of(name, ('video', 'table'))}")
        videos = tuple(_of(VideoRow, row, _VIDEO, place) for place, row in _rows(document, "video"))
        tables = tuple(_table(row, place) for place, row in _rows(document, "table"))
        _check(videos, tables, path.parent)
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from None
    return KinematicsRecipe(path.parent, videos, tables)


def _rows(document: Mapping[str, Any], name: str) -> Iterator[tuple[str, Mapping[str, Any]]]:
    rows = document.get(name, [])
    if not isinstance(rows, list) or not all(isinstance(each, dict) for each in rows):
        raise _wrong(name, rows, f"tables [[{name}]]")
    return ((f"{name}[{number}]", row) for number, row in enumerate(rows))


def _table(row: Mapping[str, Any], place: str) -> TableRow:
    found = _of(TableRow, row, _TABLE, place)
    poses = tuple(_of(PoseRow, each, _POSE, f"{place}.pose[{number}]") for number, each in enumerate(found.pose))
    joints = tuple(
        _of(JointsRow, each, _JOINTS, f"{place}.joints[{number}]") for number, each in enumerate(found.joints)
    )
    values = {name: getattr(found, name) for name in ("file", "time", "unit", "zero", "rate", "start", "separator")}
    return TableRow(**values, header=found.header, pose=poses, joints=joints)


def _wrong(place: str, found: Any, expected: str) -> ConfigError:
    text = repr(found)
    return ConfigError(f"{place}: found {text if len(text) <= 60 else text[:60] + '…'}, expected {expected}")


def _of(kind: type[Row], value: Any, checks: Mapping[str, Check], place: str) -> Row:
    """Return a row of a table with checked values."""
    settings = dict(value)
    for name, found in settings.items():
        if name not in checks:
            raise ConfigError(f"{place}.{name}: unknown key, expected {one_of(name, checks)}")
        is_good, expected = checks[name]
        if not is_good(found):
            raise _wrong(f"{place}.{name}", found, expected)
        if isinstance(found, list):
            settings[name] = tuple(found)
    for field in fields(kind):
        if field.default is MISSING and field.name not in settings:
            raise ConfigError(f"{place}: found no {field.name}, expected {checks[field.name][1]}")
    return kind(**settings)


def _check(videos: tuple[VideoRow, ...], tables: tuple[TableRow, ...], folder: Path) -> None:
    names: dict[str, str] = {}
    files = [(f"video[{number}].file", each.file) for number, each in enumerate(videos)]
    for number, video in enumerate(videos):
        place = f"video[{number}]"
        if bool(video.times) != bool(video.time) or (video.times and video.start):
            raise ConfigError(f"{place}: expected times and time together, without start")
        files += [(f"{place}.times", video.times)] if video.times else []
        _check_name(names, video.name, place)
    for number, table in enumerate(tables):
        place = f"table[{number}]"
        files.append((f"{place}.file", table.file))
        if bool(table.time) == bool(table.rate):
            raise ConfigError(f"{place}: found {'both' if table.rate else 'neither'}, expected time or rate")
        if table.rate and (table.zero == UTC or table.unit != "s"):
            raise ConfigError(f"{place}: found zero or unit with rate, expected them with time")
        if table.time and table.start:
            raise ConfigError(f"{place}.start: found it with time, expected it with rate")
        if is_hdf5(table.file) and (not table.header or table.separator != ","):
            raise ConfigError(f"{place}: found header or separator with HDF5, expected them with text")
        if is_hdf5(table.file) and not (table.time or table.pose or table.joints):
            raise ConfigError(f"{place}: found no column of {table.file}, expected pose or joints")
        for index, pose in enumerate(table.pose):
            _check_name(names, pose.name, f"{place}.pose[{index}]")
            if bool(pose.quaternion) == bool(pose.rotation):
                both = "both" if pose.rotation else "neither"
                raise ConfigError(f"{place}.pose[{index}]: found {both}, expected quaternion or rotation")
        for index, joints in enumerate(table.joints):
            _check_name(names, joints.name, f"{place}.joints[{index}]")
            _check_joints(joints, f"{place}.joints[{index}]")
    if not names:
        raise ConfigError("found no stream, expected [[video]], [[table.pose]] or [[table.joints]]")
    for place, file in files:
        if not (folder / file).resolve().is_relative_to(folder.resolve()):
            raise _wrong(place, file, "a file in or below the folder of the recipe")
        if not (folder / file).is_file():
            raise _wrong(place, file, "a file that is there")


def _check_name(names: dict[str, str], name: str, place: str) -> None:
    if name in names:
        raise ConfigError(f"{place}.name: found {name} as in {names[name]}, expected a name of its own")
    names[name] = place


def _check_joints(row: JointsRow, place: str) -> None:
    for name in ("velocity", "effort", "names"):
        found: tuple[Any, ...] = getattr(row, name)
        if found and len(found) != len(row.position):
            raise ConfigError(f"{place}.{name}: found {counted(len(found), 'value')}, expected {len(row.position)}")
    if not row.names and len(set(map(str, row.position))) < len(row.position):
        raise _wrong(f"{place}.position", list(row.position), "different columns, or names")
