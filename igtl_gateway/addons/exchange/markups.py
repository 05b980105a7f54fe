"""Reads markups of 3D Slicer: JSON (``.mrk.json``) and comma-separated points (``.fcsv``), as RAS millimetres.

``.mrk.json``: one or more markups with control points, in LPS unless it states RAS.  ``.fcsv``: the columns that its
head names; the space is stated as a word, or as 0 (RAS) or 1 (LPS) in older versions.  Without it both are LPS, as 3D
Slicer takes them.  Points whose position is not defined are counted and left out.
"""

from __future__ import annotations

import csv
import math
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from igtl_gateway.addon import DamagedRecording, UnsupportedRecording
from igtl_gateway.addon.terminal import counted
from igtl_gateway.addon.untrusted import files, limits, parse_json

FCSV = b"# Markups fiducial file"
LINE, PLANE, ROI = "Line", "Plane", "ROI"
#: Kinds of markups, by the names of 3D Slicer.
KINDS = ("Fiducial", LINE, "Angle", "Curve", "ClosedCurve", PLANE, ROI)
_SCHEMA = re.compile(rb'"@schema"\s*:\s*"[^"]*markups-schema|"markups"\s*:\s*\[')
_FIRST_SCHEMA = re.compile(r"markups-schema-v1(?![0-9])")
#: Versions of ``.fcsv``: those of 3D Slicer, of which 4 has begun with them.
_FCSV_VERSIONS = ("4", "5")
_NUMBER = re.compile("[0-9]{1,18}")
_SPACES = {"LPS": -1.0, "RAS": 1.0, "1": -1.0, "0": 1.0}
_DEFINED = "defined"
_COLUMNS = ("id", "x", "y", "z", "ow", "ox", "oy", "oz", "vis", "sel", "lock", "label", "desc", "associatedNodeID")
#: Status of a point in the column after those that the head names: 2 and 3 have a position.
_PLACED = ("", "2", "3")
_WHITE = (255, 255, 255, 255)

Point = tuple[float, float, float]


@dataclass(slots=True)
class Markup:
    """A markup.

    Attributes:
        kind: one of KINDS.
        labels, points: of the control points with a position; RAS, millimetres.
        undefined: number of the others.
        rgba: colour of the points, bytes.
        has_space: whether the file states LPS or RAS.
        corners: of a plane (4) or a box (8), in the order of its faces; empty if the file has no size.
    """

    kind: str
    labels: list[str] = field(default_factory=list)
    points: list[Point] = field(default_factory=list)
    undefined: int = 0
    rgba: tuple[int, int, int, int] = _WHITE
    has_space: bool = True
    corners: list[Point] = field(default_factory=list)


def looks_like_markups(start: bytes) -> bool:
    """Return whether a file that begins with these bytes has markups."""
    return start.startswith(FCSV) or (start.lstrip()[:1] == b"{" and _SCHEMA.search(start) is not None)


def read_markups(path: Path) -> list[Markup]:
    """Read the file.  Raises DamagedRecording, UnsupportedRecording or LimitExceeded."""
    data = files.read_bytes(path)
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise DamagedRecording(f"{path}: byte {error.start}: found invalid UTF-8, expected text") from None
    return [_of_table(text, str(path))] if data.startswith(FCSV) else _of_json(text, str(path))


def _of_json(text: str, where: str) -> list[Markup]:
    limits.check_limit("count", text.count("{"), f"{where}: objects")
    document = parse_json(text, where)
    _check_schema(_fields(document, where).get("@schema"), where)
    found = _list(_fields(document, where).get("markups"), f"{where}: markups")
    limits.check_limit("fields", len(found), f"{where}: markups")
    lists = (each.get("controlPoints") for each in found if isinstance(each, dict))
    count = sum(len(each) for each in lists if isinstance(each, list))
    limits.check_limit("count", count, f"{where}: control points")
    markups = [
        _markup(_fields(each, f"{where}: markup {at}"), f"{where}: markup {at}") for at, each in enumerate(found)
    ]
    return markups


def _check_schema(found: Any, where: str) -> None:
    """Raise UnsupportedRecording for another version of the format; a file without one is taken as of the first."""
    if found is not None and not (isinstance(found, str) and _FIRST_SCHEMA.search(found)):
        raise UnsupportedRecording(f"{where}: @schema: found {_shown(found)}, expected markups-schema-v1")


def _markup(fields: dict[str, Any], where: str) -> Markup:
    kind = fields.get("type")
    if kind not in KINDS:
        raise UnsupportedRecording(f"{where}: type: found {_shown(kind)}, expected one of {', '.join(KINDS)}")
    sign = _sign(fields.get("coordinateSystem", "LPS"), f"{where}: coordinateSystem")
    unit = fields.get("coordinateUnits", "mm")
    if (unit[0] if isinstance(unit, list) and unit else unit) != "mm":
        raise UnsupportedRecording(f"{where}: coordinateUnits: found {_shown(unit)}, expected mm")
    rgba = _colour(fields.get("display"), f"{where}: display")
    markup = Markup(kind, rgba=rgba, has_space="coordinateSystem" in fields)
    for at, each in enumerate(_list(fields.get("controlPoints", []), f"{where}: controlPoints")):
        place = f"{where}: control point {at}"
        point = _fields(each, place)
        if point.get("positionStatus", _DEFINED) != _DEFINED:
            markup.undefined += 1
            continue
        markup.points.append(_ras(_numbers(point.get("position"), 3, f"{place}: position"), sign))
        markup.labels.append(_text(point.get("label", ""), f"{place}: label"))
    if kind in (PLANE, ROI) and "size" in fields:
        markup.corners = _corners(kind, fields, sign, where)
    return markup


def _corners(kind: str, fields: dict[str, Any], sign: float, where: str) -> list[Point]:
    """Return the corners of a box or a plane around its centre, along the columns of ``orientation``; none for others.

    Raises DamagedRecording.
    """
    bounds = fields.get("planeBounds", [])
    if bounds and (low := _numbers(bounds, 4, f"{where}: planeBounds")) and (low[0] + low[1] or low[2] + low[3]):
        return []
    size = _numbers(fields["size"], 3, f"{where}: size")
    centre = _numbers(fields.get("center"), 3, f"{where}: center")
    axes = _numbers(fields.get("orientation", [1, 0, 0, 0, 1, 0, 0, 0, 1]), 9, f"{where}: orientation")
    corners = []
    for k in (-0.5, 0.5) if kind == ROI else (0.0,):
        for i, j in ((-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5)):
            steps = (i * size[0], j * size[1], k * size[2])
            at = [
                middle + sum(axes[3 * row + axis] * step for axis, step in enumerate(steps))
                for row, middle in enumerate(centre)
            ]
            corners.append(_ras(at, sign))
    return corners


def _of_table(text: str, where: str) -> Markup:
    """Return the points of an ``.fcsv``."""
    lines = text.splitlines()
    limits.check_limit("count", len(lines), f"{where}: lines")
    limits.check_limit("document", max(map(len, lines)), f"{where}: characters of a line")
    head = [line.lstrip("# ").partition("=") for line in lines if line.startswith("#")]
    facts = {key.strip(): value.strip() for key, equals, value in head if equals}
    version = next((text for key, text in facts.items() if key.lower() == "markups fiducial file version"), "4")
    if not (number := _NUMBER.search(version)) or number[0] not in _FCSV_VERSIONS:
        raise UnsupportedRecording(f"{where}: version: found {_shown(version)}, expected 4 or 5")
    sign = _sign(facts.get("CoordinateSystem", "LPS"), f"{where}: CoordinateSystem")
    columns = [name.strip() for name in facts.get("columns", "").split(",") if name.strip()]
    columns = columns or list(_COLUMNS)
    if not {"x", "y", "z"} <= set(columns):
        raise DamagedRecording(f"{where}: columns: found {', '.join(columns)[:60]}, expected x, y and z")
    markup = Markup("Fiducial", has_space="CoordinateSystem" in facts)
    rows = ((at, line) for at, line in enumerate(lines, 1) if line.strip() and not line.startswith("#"))
    for at, line in rows:
        row = next(csv.reader([line]), [])
        cells = dict(zip(columns, row, strict=False))
        place = f"{where}: line {at}"
        extra = row[len(columns) :]
        if extra and extra[0] not in _PLACED:
            markup.undefined += 1
            continue
        try:
            position = [float(cells[name]) for name in ("x", "y", "z")]
        except (KeyError, ValueError):
            raise DamagedRecording(f"{place}: found {line[:60]!r}, expected numbers for x, y and z") from None
        markup.points.append(_ras(_finite(position, place), sign))
        markup.labels.append(cells.get("label", ""))
    return markup


def _sign(found: Any, where: str) -> float:
    sign = _SPACES.get(str(found) if isinstance(found, (str, int)) else "")
    if sign is None:
        raise UnsupportedRecording(f"{where}: found {_shown(found)}, expected LPS or RAS")
    return sign


def _ras(position: list[float], sign: float) -> Point:
    return position[0] * sign + 0.0, position[1] * sign + 0.0, position[2]


def _colour(display: Any, where: str) -> tuple[int, int, int, int]:
    """Return the colour of selected points, as new points are, with their opacity; white without."""
    if display is None:
        return _WHITE
    fields = _fields(display, where)
    values = [
        *_numbers(fields.get("selectedColor", [1, 1, 1]), 3, f"{where}: selectedColor"),
        *_numbers([fields.get("opacity", 1)], 1, f"{where}: opacity"),
    ]
    red, green, blue, alpha = (round(255 * min(max(value, 0.0), 1.0)) for value in values)
    return red, green, blue, alpha


def _numbers(found: Any, count: int, where: str) -> list[float]:
    if not isinstance(found, list) or len(found) != count:
        raise DamagedRecording(f"{where}: found {_shown(found)}, expected {counted(count, 'number')}")
    if any(isinstance(value, bool) or not isinstance(value, (int, float)) for value in found):
        raise DamagedRecording(f"{where}: found {_shown(found)}, expected {counted(count, 'number')}")
    return _finite([float(value) for value in found], where)


def _finite(values: list[float], where: str) -> list[float]:
    if not all(math.isfinite(value) and abs(value) < 3e38 for value in values):
        raise DamagedRecording(f"{where}: found {_shown(values)}, expected finite numbers")
    return values


def _fields(found: Any, where: str) -> dict[str, Any]:
    if not isinstance(found, dict):
        raise DamagedRecording(f"{where}: found {_shown(found)}, expected an object of JSON")
    return found


def _list(found: Any, where: str) -> list[Any]:
    if not isinstance(found, list):
        raise DamagedRecording(f"{where}: found {_shown(found)}, expected a list")
    return found


def _text(found: Any, where: str) -> str:
    if not isinstance(found, str):
        raise DamagedRecording(f"{where}: found {_shown(found)}, expected text")
    return found.encode("utf-8", "replace").decode()  # JSON may hold half of a letter


def _shown(found: Any) -> str:
    return "nothing" if found is None else repr(found)[:60]
