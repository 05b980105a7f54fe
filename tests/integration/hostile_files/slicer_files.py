"""Hostile transforms (.h5, .tfm, .mat, .txt) and markups (.mrk.json, .fcsv) of 3D Slicer."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable
from functools import partial
from random import Random
from typing import Any

from tests.integration.hostile_files.case import ESCAPE, FORGED, MIB, NAUGHTY, Danger, Hostile, file
from tools.import_mutations import Bend
from tools.slicer_mutations import hdf5

Data = Callable[[], bytes]

_AFFINE = "AffineTransform_double_3_3"
_NUMBERS = "1 0 0 0 1 0 0 0 1 5 6 7"


# --- transforms ------------------------------------------------------------------------------------------------------


def tfm(
    name: str = _AFFINE, numbers: str = _NUMBERS, fixed: str = "0 0 0", head: str = "V1.0", more: str = ""
) -> bytes:
    """A transform as lines."""
    lines = [f"#Insight Transform File {head}", "#Transform 0", f"Transform: {name}", f"Parameters: {numbers}"]
    return "\n".join([*lines, f"FixedParameters: {fixed}", more]).encode("utf-8", "surrogateescape")


def mat(
    name: bytes = _AFFINE.encode() + b"\0",
    kind: int = 0,
    rows: int = 12,
    columns: int = 1,
    imaginary: int = 0,
    length: int | None = None,
    values: bytes = struct.pack("<12d", *map(float, _NUMBERS.split())),
    fixed: bool = True,
) -> bytes:
    """A transform as two matrices of MATLAB level 4."""
    named = len(name) if length is None else length
    first = struct.pack("<5I", kind, rows, columns, imaginary, named) + name + values
    second = struct.pack("<5I", 0, 3, 1, 0, 6) + b"fixed\0" + struct.pack("<3d", 0, 0, 0)
    return first + (second if fixed else b"")


def h5(at: int | None = None, data: bytes = b"", signature: bytes = b"", after: int = 0) -> bytes:
    """A transform as HDF5; ``data`` replaces bytes at a place, or behind an object of a signature."""
    made = bytearray(hdf5(Bend(Random(1), 0.0)))
    if signature:
        at = made.index(signature) + len(signature) + after
    if at is not None:
        made[at : at + len(data)] = data
    return bytes(made)


_GOOD_H5 = h5()
_ROOT = 36  # place of the address of the root group
_ONES = b"\xff" * 8


def _circle() -> bytes:
    """A root whose group is the root."""
    made = bytearray(_GOOD_H5)
    root = made[_ROOT : _ROOT + 8]
    at = made.rindex(b"TransformGroup") + len("TransformGroup")
    made[at : at + 8] = root
    return bytes(made)


_TRANSFORMS: tuple[tuple[str, str, Danger, str, Data], ...] = (
    ("good", ".h5", Danger.SHAPE, "a transform as ITK writes it", h5),
    *(
        (
            f"cut-{tenth}0",
            ".h5",
            Danger.LIE,
            f"a transform cut at {tenth}0 %",
            partial(lambda n: _GOOD_H5[: len(_GOOD_H5) * n // 10], tenth),
        )
        for tenth in range(1, 10)
    ),
    ("garbage", ".h5", Danger.SHAPE, "noise behind the signature", lambda: _GOOD_H5[:8] + b"\xff" * 300),
    ("zeros", ".h5", Danger.BOMB, "64 MiB of zeros behind the signature", lambda: _GOOD_H5[:8] + bytes(64 * MIB)),
    *(
        (
            f"version-{version}",
            ".h5",
            Danger.SHAPE,
            f"a superblock of version {version}",
            partial(h5, 8, bytes([version])),
        )
        for version in (0, 1, 4, 255)
    ),
    ("widths", ".h5", Danger.SHAPE, "addresses of 4 bytes", lambda: h5(9, b"\x04\x04")),
    ("root-far", ".h5", Danger.LIE, "a root behind the end", lambda: h5(_ROOT, _ONES)),
    ("root-self", ".h5", Danger.LIE, "a root that is the superblock", lambda: h5(_ROOT, bytes(8))),
    ("header-4g", ".h5", Danger.LIE, "a header of 4 GiB", lambda: h5(signature=b"OHDR\x02\x02", data=b"\xff" * 4)),
    ("header-0", ".h5", Danger.LIE, "a header of nothing", lambda: h5(signature=b"OHDR\x02\x02", data=bytes(4))),
    ("header-flags", ".h5", Danger.SHAPE, "a header with all flags", lambda: h5(signature=b"OHDR\x02", data=b"\xff")),
    ("group-circle", ".h5", Danger.LIE, "a group that contains itself", _circle),
    (
        "count-huge",
        ".h5",
        Danger.LIE,
        "2^63 numbers",
        lambda: h5(signature=b"\x02\x01\x00\x01", data=b"\xff" * 7 + b"\x7f"),
    ),
    (
        "kind",
        ".h5",
        Danger.SHAPE,
        "numbers of an unknown class",
        lambda: h5(signature=b"\x11\x20\x3f\x00", data=b"\xff" * 8),
    ),
    (
        "name",
        ".h5",
        Danger.SHAPE,
        "an unknown transform",
        lambda: _GOOD_H5.replace(b"Transform_double_3_3", b"Warp_double_3_3".ljust(20, b"\0")),
    ),
    (
        "naughty",
        ".h5",
        Danger.TERMINAL,
        "escape sequences in the name",
        lambda: _GOOD_H5.replace(b"Transform_double_3_3", NAUGHTY.encode()[:20].ljust(20, b"!")),
    ),
    ("good", ".tfm", Danger.SHAPE, "a transform as lines", tfm),
    ("good", ".txt", Danger.SHAPE, "the same as .txt", tfm),
    ("alone", ".tfm", Danger.LIE, "a first line alone", lambda: b"#Insight Transform File V1.0\n"),
    *(
        (
            f"cut-{tenth}0",
            ".tfm",
            Danger.LIE,
            f"cut at {tenth}0 %",
            partial(lambda n: tfm()[: len(tfm()) * n // 10], tenth),
        )
        for tenth in (1, 3, 5, 7, 9)
    ),
    ("version", ".tfm", Danger.SHAPE, "another version", lambda: tfm(head="V9.9")),
    ("unknown", ".tfm", Danger.SHAPE, "an unknown transform", lambda: tfm("WarpTransform_double_3_3")),
    ("spline", ".tfm", Danger.SHAPE, "a B-spline", lambda: tfm("BSplineTransform_double_3_3", "0 " * 500)),
    (
        "plane",
        ".tfm",
        Danger.SHAPE,
        "a transform of the plane",
        lambda: tfm("AffineTransform_double_2_2", "1 0 0 1 5 6", "0 0"),
    ),
    ("composite", ".tfm", Danger.SHAPE, "a composite of nothing", lambda: tfm("CompositeTransform_double_3_3", "", "")),
    *(
        (f"numbers-{name}", ".tfm", Danger.SHAPE, f"numbers: {what}", partial(tfm, _AFFINE, text))
        for name, what, text in (
            ("none", "none", ""),
            ("few", "11", _NUMBERS[:-2]),
            ("more", "13", f"{_NUMBERS} 1"),
            ("nan", "NaN", _NUMBERS.replace("1", "nan")),
            ("infinite", "infinite", _NUMBERS.replace("1", "inf")),
            ("beyond", "beyond float64", _NUMBERS.replace("5", "1e400")),
            ("large", "beyond float32", _NUMBERS.replace("5", "1e300")),
            ("words", "words", "a b c"),
            ("singular", "a matrix that has no inverse", "0 0 0 0 0 0 0 0 0 5 6 7"),
        )
    ),
    ("fixed", ".tfm", Danger.SHAPE, "a centre of NaN", lambda: tfm(fixed="nan nan nan")),
    ("no-text", ".tfm", Danger.SHAPE, "no text", lambda: tfm(more="\udcff\udcfe")),
    ("twice", ".tfm", Danger.SHAPE, "numbers twice", lambda: tfm(more=f"Parameters: {_NUMBERS}")),
    ("line", ".tfm", Danger.BOMB, "a line of 16 MiB", lambda: tfm(numbers="1 " * 8 * MIB)),
    (
        "digits",
        ".tfm",
        Danger.BOMB,
        "a number of 4,000,000 digits",
        lambda: tfm(numbers="9" * 4_000_000 + _NUMBERS[1:]),
    ),
    ("lines", ".tfm", Danger.BOMB, "a million lines", lambda: tfm(more="#\n" * 1_000_000)),
    (
        "several",
        ".tfm",
        Danger.BOMB,
        "100,000 transforms",
        lambda: tfm(more=tfm().decode().partition("\n")[2] * 100_000),
    ),
    ("name", ".tfm", Danger.TERMINAL, "escape sequences in the name", lambda: tfm(f"{ESCAPE}_double_3_3")),
    ("numbers", ".tfm", Danger.TERMINAL, "the same in the numbers", lambda: tfm(numbers=f"{ESCAPE} {FORGED}\u202e")),
    ("key", ".tfm", Danger.TERMINAL, "the same in a key", lambda: tfm(more=f"{FORGED}{ESCAPE}: 1")),
    ("good", ".mat", Danger.SHAPE, "a transform as MATLAB", mat),
    *(
        (
            f"cut-{tenth}0",
            ".mat",
            Danger.LIE,
            f"cut at {tenth}0 %",
            partial(lambda n: mat()[: len(mat()) * n // 10], tenth),
        )
        for tenth in (1, 3, 5, 7, 9)
    ),
    ("rows", ".mat", Danger.LIE, "2^32 − 1 rows", lambda: mat(rows=0xFFFFFFFF)),
    ("rows-columns", ".mat", Danger.LIE, "2^31 rows and columns", lambda: mat(rows=1 << 31, columns=1 << 31)),
    ("no-columns", ".mat", Danger.LIE, "no columns", lambda: mat(columns=0)),
    ("name-long", ".mat", Danger.LIE, "a name of 4 GiB", lambda: mat(length=0xFFFFFFFF)),
    ("name-none", ".mat", Danger.LIE, "no name", lambda: mat(b"", length=0)),
    ("imaginary", ".mat", Danger.SHAPE, "complex numbers", lambda: mat(imaginary=1)),
    ("order", ".mat", Danger.SHAPE, "big-endian numbers", lambda: mat(kind=1000)),
    ("kind", ".mat", Danger.SHAPE, "numbers of an unknown type", lambda: mat(kind=0x7FFFFFFF)),
    ("texts", ".mat", Danger.SHAPE, "letters", lambda: mat(kind=51)),
    ("no-fixed", ".mat", Danger.LIE, "without its second matrix", lambda: mat(fixed=False)),
    ("nan", ".mat", Danger.SHAPE, "NaN", lambda: mat(values=struct.pack("<12d", *[float("nan")] * 12))),
    ("zeros", ".mat", Danger.BOMB, "64 MiB of zeros behind", lambda: mat() + bytes(64 * MIB)),
    ("name", ".mat", Danger.TERMINAL, "escape sequences in the name", lambda: mat(f"{ESCAPE}_double_3_3\0".encode())),
)


# --- markups ---------------------------------------------------------------------------------------------------------


def markups(*points: object, version: str = "1.0.3", **values: object) -> bytes:
    """Markups with these control points."""
    given = {"type": "Fiducial", "coordinateSystem": "LPS", "coordinateUnits": "mm", "controlPoints": list(points)}
    schema = f"https://example.org/markups-schema-v{version}.json#"
    return json.dumps({"@schema": schema, "markups": [given | values]}).encode()


def point(*position: object, **values: object) -> dict[str, object]:
    """A control point."""
    return {"label": "F", "position": list(position), **values}


def _schema(rest: str) -> bytes:
    return f'{{"@schema": "markups-schema-v1.0.3.json#", "markups": {rest}'.encode("utf-8", "surrogateescape")


_COLUMNS = "id,x,y,z,ow,ox,oy,oz,vis,sel,lock,label,desc,associatedNodeID"


def fcsv(*rows: str, space: str = "LPS", columns: str = _COLUMNS, version: str = "5.3") -> bytes:
    """Points as a table."""
    head = (f"# Markups fiducial file version = {version}", f"# CoordinateSystem = {space}", f"# columns = {columns}")
    return "\n".join([*head, *rows]).encode("utf-8", "surrogateescape")


_ROW = "1,1,2,3,0,0,0,1,1,1,0,F-1,,,2,0"
_JSON, _CSV = ".mrk.json", ".fcsv"
_PLANE: dict[str, Any] = {
    "type": "Plane",
    "center": [0, 0, 0],
    "orientation": [1, 0, 0, 0, 1, 0, 0, 0, 1],
    "size": [1, 1, 0],
}

_MARKUPS: tuple[tuple[str, str, Danger, str, Data], ...] = (
    ("good", _JSON, Danger.SHAPE, "points as 3D Slicer writes them", lambda: markups(point(1, 2, 3))),
    *(
        (
            f"cut-{tenth}0",
            _JSON,
            Danger.LIE,
            f"cut at {tenth}0 %",
            partial(lambda n: markups(point(1, 2, 3))[: 25 * n], tenth),
        )
        for tenth in range(2, 10)
    ),
    ("points", _JSON, Danger.BOMB, "300,000 points", lambda: markups(*[point(1, 2, 3)] * 300_000)),
    (
        "many",
        _JSON,
        Danger.BOMB,
        "100,000 markups",
        lambda: _schema("[" + ",".join(['{"type":"Line"}'] * 100_000) + "]}"),
    ),
    ("deep", _JSON, Danger.BOMB, "100,000 lists in each other", lambda: _schema("[" * 100_000)),
    ("deep-objects", _JSON, Danger.BOMB, "100,000 objects in each other", lambda: _schema('{"a":' * 100_000)),
    (
        "keys",
        _JSON,
        Danger.BOMB,
        "500,000 keys",
        lambda: _schema("[{" + ",".join(f'"k{n}":0' for n in range(500_000)) + "}]}"),
    ),
    ("label-long", _JSON, Danger.BOMB, "a label of 32 MiB", lambda: markups(point(1, 2, 3, label="a" * 32 * MIB))),
    (
        "digits",
        _JSON,
        Danger.BOMB,
        "a number of a million digits",
        lambda: _schema('[{"type":"Fiducial","controlPoints":[{"position":[' + "9" * 1_000_000 + ",2,3]}]}]}"),
    ),
    ("version", _JSON, Danger.SHAPE, "another version", lambda: markups(point(1, 2, 3), version="99.0.0")),
    *(
        (
            f"position-{name}",
            _JSON,
            Danger.SHAPE,
            f"a position of {what}",
            partial(lambda values: markups(point(*values)), values),
        )
        for name, what, values in (
            ("two", "2 numbers", (1, 2)),
            ("words", "words", ("a", "b", "c")),
            ("nan", "NaN", (1, 2, float("nan"))),
            ("infinite", "infinity", (1, 2, float("inf"))),
            ("large", "1e300 mm", (1, 2, 1e300)),
            ("truths", "truth values", (True, False, True)),
            ("lists", "lists", ([1], [2], [3])),
        )
    ),
    *(
        (
            f"{key}-{name}",
            _JSON,
            Danger.SHAPE,
            f"{key}: {what}",
            partial(lambda key, found: markups(point(1, 2, 3), **{key: found}), key, found),
        )
        for key, name, what, found in (
            ("type", "star", "Star", "Star"),
            ("type", "none", "null", None),
            ("type", "list", "a list", ["Fiducial"]),
            ("coordinateSystem", "odd", "XYZ", "XYZ"),
            ("coordinateSystem", "number", "7", 7),
            ("coordinateUnits", "metre", "m", "m"),
            ("coordinateUnits", "list", "an empty list", []),
            ("controlPoints", "none", "null", None),
            ("controlPoints", "object", "an object", {}),
            ("display", "word", "a word", "red"),
            ("display", "colour", "a colour of words", {"color": ["a", "b", "c"], "selectedColor": 7}),
        )
    ),
    *(
        (
            f"plane-{name}",
            _JSON,
            Danger.SHAPE,
            f"a plane with {what}",
            partial(lambda more: markups(point(1, 2, 3), **(_PLANE | more)), more),
        )
        for name, what, more in (
            ("size", "a size of words", {"size": "a"}),
            ("axes", "axes of 8 numbers", {"orientation": [1] * 8}),
            ("nan", "a centre of NaN", {"center": [float("nan")] * 3}),
            ("large", "a size of 1e300", {"size": [1e300, 1, 1]}),
            ("bounds", "bounds of words", {"planeBounds": ["a", "b", "c", "d"]}),
        )
    ),
    ("list", _JSON, Danger.SHAPE, "no object", lambda: b'["markups-schema", {"markups": []}]'),
    ("none", _JSON, Danger.SHAPE, "no markups", lambda: _schema("[]}")),
    ("object", _JSON, Danger.SHAPE, "an object instead of a list", lambda: _schema("{}}")),
    ("twice", _JSON, Danger.SHAPE, "a key twice", lambda: _schema('[], "markups": [{"type": "Fiducial"}]}')),
    ("no-text", _JSON, Danger.SHAPE, "no text", lambda: _schema("[\udcff\udcfe]}")),
    ("label", _JSON, Danger.TERMINAL, "escape sequences in a label", lambda: markups(point(1, 2, 3, label=NAUGHTY))),
    ("type", _JSON, Danger.TERMINAL, "the same in the type", lambda: markups(type=NAUGHTY)),
    ("unit", _JSON, Danger.TERMINAL, "the same in the unit", lambda: markups(coordinateUnits=NAUGHTY)),
    ("space", _JSON, Danger.TERMINAL, "the same in the space", lambda: markups(coordinateSystem=NAUGHTY)),
    ("surrogate", _JSON, Danger.TERMINAL, "half of a letter", lambda: markups(point(1, 2, 3, label="\ud800"))),
    ("good", _CSV, Danger.SHAPE, "points as a table", lambda: fcsv(_ROW)),
    *(
        (
            f"cut-{tenth}0",
            _CSV,
            Danger.LIE,
            f"cut at {tenth}0 %",
            partial(lambda n: fcsv(_ROW)[: len(fcsv(_ROW)) * n // 10], tenth),
        )
        for tenth in (2, 4, 6, 8, 9)
    ),
    ("rows", _CSV, Danger.BOMB, "300,000 rows", lambda: fcsv(*[_ROW] * 300_000)),
    ("line", _CSV, Danger.BOMB, "a line of 16 MiB", lambda: fcsv("1," * 8 * MIB)),
    ("label-long", _CSV, Danger.BOMB, "a label of 16 MiB", lambda: fcsv(_ROW.replace("F-1", "a" * 16 * MIB))),
    ("heads", _CSV, Danger.BOMB, "a million lines of the head", lambda: fcsv("# a = b\n" * 1_000_000)),
    *(
        (f"version-{version}", _CSV, Danger.SHAPE, f"version {version}", partial(fcsv, _ROW, version=version))
        for version in ("3.6", "4.10", "99", "x")
    ),
    *(
        (f"space-{name}", _CSV, Danger.SHAPE, f"the space {name}", partial(fcsv, _ROW, space=space))
        for name, space in (("2", "2"), ("ijk", "IJK"), ("none", ""))
    ),
    ("columns", _CSV, Danger.SHAPE, "without a column x", lambda: fcsv(_ROW, columns="id,a,b,c")),
    ("columns-twice", _CSV, Danger.SHAPE, "a column twice", lambda: fcsv(_ROW, columns="x,x,y,z,label,label")),
    ("columns-none", _CSV, Danger.SHAPE, "no columns", lambda: fcsv(_ROW, columns="")),
    *(
        (f"row-{name}", _CSV, Danger.SHAPE, f"a row {what}", partial(fcsv, row))
        for name, what, row in (
            ("short", "of 2 cells", "1,1"),
            ("nan", "of NaN", _ROW.replace("2,3", "nan,3")),
            ("large", "of 1e300 mm", _ROW.replace("2,3", "1e300,3")),
            ("words", "of words", _ROW.replace("2,3", "a,b")),
            ("quotes", "with an open quote", _ROW.replace("F-1", '"F')),
            ("zeros", "with zeros", _ROW.replace("F-1", "\0")),
            ("status", "with an unknown status", _ROW.replace(",,,2,", ",,,9,")),
        )
    ),
    ("no-text", _CSV, Danger.SHAPE, "no text", lambda: fcsv("\udcff\udcfe")),
    ("label", _CSV, Danger.TERMINAL, "escape sequences in a label", lambda: fcsv(_ROW.replace("F-1", f'"{NAUGHTY}"'))),
    ("row", _CSV, Danger.TERMINAL, "the same in a number", lambda: fcsv(f"1,{ESCAPE},{FORGED}\u202e,3")),
    ("head", _CSV, Danger.TERMINAL, "the same in the head", lambda: fcsv(_ROW, columns=f"a{ESCAPE},{FORGED}\u202e")),
)


CASES: tuple[Hostile, ...] = (
    *(
        Hostile(
            f"{kind}{suffix.replace('.', '-')}-{name}", "file of 3D Slicer", danger, what, file(f"{name}{suffix}", data)
        )
        for kind, table in (("transform", _TRANSFORMS), ("markups", _MARKUPS))
        for name, suffix, danger, what, data in table
    ),
    Hostile(
        "slicer-file-name",
        "file of 3D Slicer",
        Danger.TERMINAL,
        "escape sequences in the name of the file",
        file(f"a{ESCAPE}\n{FORGED}.tfm".replace("/", ""), tfm),
    ),
)
