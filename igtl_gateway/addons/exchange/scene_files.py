"""Files of a scene of 3D Slicer that are text: sequences of poses, tables, and a small model of axes."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[Any]

_HEAD = """ObjectType = Image
NDims = 3
AnatomicalOrientation = RAI
BinaryData = True
CompressedData = False
DimSize = 0 0 {count}
ElementSpacing = 1 1 1
Offset = 0 0 0
TransformMatrix = 1 0 0 0 1 0 0 0 1
ElementType = MET_UCHAR
Kinds = domain domain list
"""
_IDENTITY = "1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1"


def pose_file(name: str, ms: npt.NDArray[np.int64], matrices: Array) -> bytes:
    """Return a sequence of poses (``.seq.mha``); before a first one that is later than 0 there is an invalid one.

    Args:
        name: of the transform; its reader drops names with ``Status``.
        ms: (N,) indexes in ms, ascending.
        matrices: (N, 4, 4), mm.
    """
    rows = [" ".join(map("%.17g".__mod__, row)) for row in matrices.reshape(-1, 16).tolist()]
    frames = [(index, text, "OK") for index, text in zip(ms.tolist(), rows, strict=True)]
    if frames and frames[0][0] > 0:
        frames.insert(0, (0, _IDENTITY, "INVALID"))
    lines = [_HEAD.format(count=len(frames))]
    for number, (index, text, status) in enumerate(frames):
        at = f"Seq_Frame{number:04}_"
        lines.append(
            f"{at}{name}Transform = {text}\n{at}{name}TransformStatus = {status}\n"
            f"{at}Timestamp = {index // 1000}.{index % 1000:03}\n"
        )
    lines.append("ElementDataFile = LOCAL\n")
    return "".join(lines).encode()


def table_files(columns: Mapping[str, Sequence[Any]]) -> tuple[bytes, bytes]:
    """Return a table as tab-separated values, and the types of its columns: double, or string."""
    names = [_cell(name) for name in columns]
    kinds = ["string" if any(isinstance(each, str) for each in column) else "double" for column in columns.values()]
    rows = zip(*columns.values(), strict=True)
    data = "\n".join(["\t".join(names), *("\t".join(map(_cell, row)) for row in rows), ""])
    schema = "\n".join(["columnName\ttype", *(f"{name}\t{kind}" for name, kind in zip(names, kinds, strict=True)), ""])
    return data.encode("utf-8", "replace"), schema.encode("utf-8", "replace")


def _cell(value: object) -> str:
    if isinstance(value, float):
        return "nan" if math.isnan(value) else f"{value:.17g}"
    return " ".join(str(value).replace('"', "'").split())


def axes_file(size: float) -> bytes:
    """Return a model of three axes of a length in mm: x red, y green, z blue."""
    points = np.zeros((6, 3), ">f4")
    points[1, 0] = points[3, 1] = points[5, 2] = size
    lines = np.array([[2, 0, 1], [2, 2, 3], [2, 4, 5]], ">i4")
    colours = np.repeat(np.array([[230, 60, 50], [60, 190, 70], [60, 100, 230]], np.uint8), 2, axis=0)
    return b"".join(
        (
            b"# vtk DataFile Version 3.0\naxes, millimetres, SPACE=RAS\nBINARY\nDATASET POLYDATA\nPOINTS 6 float\n",
            points.tobytes(),
            b"\nLINES 3 9\n",
            lines.tobytes(),
            b"\nPOINT_DATA 6\nCOLOR_SCALARS colours 3\n",
            colours.tobytes(),
            b"\n",
        )
    )
