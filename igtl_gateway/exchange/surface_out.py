"""Export to PLY or legacy VTK: one binary file per message of POLYDATA, PointCloud2, Mesh, Marker, igtl_msgs/PolyData.

Whatever the message, it is first what the gateway would send as POLYDATA: points in millimetres.  PLY (little-endian)
has points, colours, normals and polygons; VTK (big-endian, as its format asks) has lines, strips and all attributes
of points and cells besides.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from igtl_gateway.convert import igtl_msgs
from igtl_gateway.convert.clouds import cloud_to_polydata, colour_field
from igtl_gateway.convert.context import Outgoing, ToIgtl
from igtl_gateway.convert.polydata import polydata_to_igtl
from igtl_gateway.convert.rosmsg import Marker, Mesh, PointCloud2
from igtl_gateway.convert.surfaces import marker_to_igtl, mesh_to_igtl
from igtl_gateway.errors import ConversionError
from igtl_gateway.exchange.recording import Account, Recording, one_file_each
from igtl_gateway.session.entry import Entry
from igtl_gateway.wire import decode
from igtl_gateway.wire.polydata import CELL, NORMAL, Attribute, PolyData

Array = npt.NDArray[Any]

_TO_POLYDATA: dict[str, Callable[[bytes, ToIgtl], Outgoing]] = {
    PointCloud2.TYPE: lambda data, to: cloud_to_polydata(PointCloud2.unpack(data), to),
    Mesh.TYPE: lambda data, to: mesh_to_igtl(Mesh.unpack(data), to),
    Marker.TYPE: lambda data, to: marker_to_igtl(Marker.unpack(data), to),
    igtl_msgs.PolyData.TYPE: lambda data, to: polydata_to_igtl(igtl_msgs.PolyData.unpack(data), to),
}
_READ = frozenset({"POLYDATA", *_TO_POLYDATA})


def export_ply(recording: Recording, out: Path, globs: Sequence[str]) -> Account:
    """Write the folder ``out``.  Raises UnsupportedRecording where it is not empty; OSError."""
    return one_file_each(recording, out, globs, _READ, "ply", _polydata, lambda content: (ply(content),))


def export_vtk(recording: Recording, out: Path, globs: Sequence[str]) -> Account:
    """As ``export_ply``."""
    return one_file_each(recording, out, globs, _READ, "vtk", _polydata, lambda content: (vtk(content),))


def _polydata(entry: Entry) -> PolyData:
    if entry.type in _TO_POLYDATA:
        content = _TO_POLYDATA[entry.type](entry.data(), ToIgtl()).content
    else:
        content = decode(entry.data()).content
    if not isinstance(content, PolyData):
        raise ConversionError(f"{entry.channel}: found {type(content).__name__}, expected POLYDATA")
    return content


def ply(content: PolyData) -> bytes:
    """A PLY file, binary little-endian: vertices with normals and colours, faces."""
    count = len(content.points)
    columns: list[tuple[str, str, Array]] = [
        (name, "float", content.points[:, axis].astype("<f4")) for axis, name in enumerate("xyz")
    ]
    for attribute in content.attributes:
        if attribute.type & CELL or attribute.tuples != count:
            continue
        values = attribute.values
        if attribute.type == NORMAL and values.shape[1] == 3:
            columns += [(f"n{name}", "float", values[:, axis].astype("<f4")) for axis, name in enumerate("xyz")]
        elif colour_field(attribute) and not any(name == "red" for name, _, _ in columns):
            colours = np.clip(np.rint(values * 255.0), 0, 255).astype("u1")
            names = ("red", "green", "blue", "alpha")[: colours.shape[1]]
            columns += [(name, "uchar", colours[:, axis]) for axis, name in enumerate(names)]
    vertices = np.empty(count, [(name, values.dtype) for name, _, values in columns])
    for name, _, values in columns:
        vertices[name] = values
    faces = content.polygons
    head = [
        "ply",
        "format binary_little_endian 1.0",
        "comment igtl-gateway, millimetres",
        f"element vertex {count}",
        *(f"property {kind} {name}" for name, kind, _ in columns),
        f"element face {faces.count}",
        "property list uint int vertex_indices",
        "end_header",
        "",
    ]
    return "\n".join(head).encode() + vertices.tobytes() + faces.data.astype("<u4").tobytes()


def vtk(content: PolyData) -> bytes:
    """A legacy VTK file, version 3.0, binary (big-endian)."""
    count = len(content.points)
    head = f"# vtk DataFile Version 3.0\nigtl-gateway, millimetres\nBINARY\nDATASET POLYDATA\nPOINTS {count} float\n"
    parts = [head.encode(), content.points.astype(">f4").tobytes(), b"\n"]
    for name, cells in zip(("VERTICES", "LINES", "POLYGONS", "TRIANGLE_STRIPS"), content.cells, strict=True):
        if cells.count:
            parts += [f"{name} {cells.count} {len(cells.data)}\n".encode(), cells.data.astype(">i4").tobytes(), b"\n"]
    of_points = [one for one in content.attributes if not one.type & CELL and one.tuples == count]
    cell_count = sum(cells.count for cells in content.cells)
    of_cells = [one for one in content.attributes if one.type & CELL and one.tuples == cell_count]
    parts += _fields(f"POINT_DATA {count}", of_points) + _fields(f"CELL_DATA {cell_count}", of_cells)
    return b"".join(parts)


def _fields(head: str, attributes: list[Attribute]) -> list[bytes]:
    if not attributes:
        return []
    parts = [f"{head}\nFIELD attributes {len(attributes)}\n".encode()]
    for number, attribute in enumerate(attributes):
        values = attribute.values
        name = "".join(letter if letter.isascii() and letter.isalnum() else "_" for letter in attribute.name)
        parts.append(f"{name or f'attribute{number}'} {values.shape[1]} {values.shape[0]} float\n".encode())
        parts += [values.astype(">f4").tobytes(), b"\n"]
    return parts
