"""Export to PLY or legacy VTK: one binary file per message of POLYDATA, PointCloud2, Mesh, Marker, igtl_msgs/PolyData.

Each message is first converted to the POLYDATA that the gateway would send: points in millimetres, with the signs that
they have there, which is RAS for patients; the title and the comment state it for 3D Slicer.  PLY
(little-endian) contains points, colours, normals and polygons.  VTK (big-endian, as its format requires) contains also
lines, strips and all attributes of points and cells.  The account counts what a format cannot represent: points
without finite coordinates, cells, and attributes whose number of values is not that of the points or, for attributes
of cells, that of the cells.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from igtl_gateway.addon import ConversionError, FreeNames, ros
from igtl_gateway.addon.igtl import CELL, NORMAL, Attribute, Cells, PolyData
from igtl_gateway.addon.messages import (
    ConvertedMessage,
    LengthUnits,
    ToIgtlContext,
    cloud_to_polydata,
    colour_bytes,
    colour_field,
    ieee_754,
    into_ros,
    marker_to_igtl,
    mesh_to_igtl,
    millimetres,
    polydata_to_igtl,
)
from igtl_gateway.addon.reading import Entry, recorded_acceptance, recorded_units
from igtl_gateway.addon.ros import Marker, Mesh, PointCloud2
from igtl_gateway.addon.settings import DEFAULT_ACCEPTANCE, Acceptance
from igtl_gateway.addon.terminal import count_text
from igtl_gateway.addons.exchange.account import ExportAccount
from igtl_gateway.addons.exchange.folder import export_one_file_each
from igtl_gateway.addons.exchange.selection import Recording

Array = npt.NDArray[Any]

_TO_POLYDATA: dict[str, Callable[[bytes, ToIgtlContext], ConvertedMessage]] = {
    Mesh.TYPE: lambda data, to: mesh_to_igtl(Mesh.unpack(data), to),
    Marker.TYPE: lambda data, to: marker_to_igtl(Marker.unpack(data), to),
    ros.PolyData.TYPE: lambda data, to: polydata_to_igtl(ros.PolyData.unpack(data), to),
}
_READ = frozenset({"POLYDATA", PointCloud2.TYPE, *_TO_POLYDATA})
_SECTIONS = ("vertex cells", "lines", "polygons", "triangle strips")
_POLYGONS = 2
#: 3D Slicer takes points for LPS, and turns them by 180°, where a file does not state their space.
_TITLE = "igtl-gateway, millimetres, SPACE=RAS"
_MOST_OF_A_BYTE = 255
#: Type and components of an attribute → its section in a VTK file; other sections mean no more than a field.
_SECTION_OF = {(NORMAL, 3): "NORMALS"}
#: Number of notes on changes by conversions: an untrusted file could cause a different one for each message.
_MAX_NOTES = 20


@dataclass(frozen=True, slots=True)
class ExportSurface:
    """A message as POLYDATA.

    Attributes:
        content: points in millimetres, cells, attributes.
        holes: number of points of the message without finite coordinates, which are not in ``content``.
        warnings: changes by the conversion, for people.
    """

    content: PolyData
    holes: int = 0
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class WrittenFile:
    """The bytes of a file, and the account of the parts of its message.

    Attributes:
        data: the bytes.
        parts: kind of parts, number, and the reason why they are left out; ``""`` if they are written.
    """

    data: bytes
    parts: tuple[tuple[str, int, str], ...]


def export_ply(recording: Recording, out: Path, globs: Sequence[str]) -> ExportAccount:
    """Write the directory ``out``.  Raises UnsupportedRecording if it is not empty; OSError."""
    return export_one_file_each(recording, out, globs, _READ, "ply", _reader(recording, ply), _data, _count)


def export_vtk(recording: Recording, out: Path, globs: Sequence[str]) -> ExportAccount:
    """Write the directory ``out``.  Raises the errors of ``export_ply``."""
    return export_one_file_each(recording, out, globs, _READ, "vtk", _reader(recording, vtk), _data, _count)


@ieee_754
def export_surface_of(entry: Entry, unit: str, acceptance: Acceptance = DEFAULT_ACCEPTANCE) -> ExportSurface:
    """Return the surface or cloud of a message with lengths in ``unit``.

    Raises WireError or ConversionError if it contains none.
    """
    to, holes = ToIgtlContext(LengthUnits(unit, "mm")), 0
    if entry.type == PointCloud2.TYPE:
        message = PointCloud2.unpack(entry.data())
        content = cloud_to_polydata(message, to).content
        holes = message.width * message.height - len(content.points) if isinstance(content, PolyData) else 0
    elif entry.type in _TO_POLYDATA:
        content = _TO_POLYDATA[entry.type](entry.data(), to).content
    else:
        content = acceptance.message(entry.data()).content
        if isinstance(content, PolyData):
            scaled = into_ros(millimetres(unit), content.points, np.empty(content.points.shape, np.float32))
            content = replace(content, points=scaled)
    if not isinstance(content, PolyData):
        raise ConversionError(f"{entry.channel}: found {type(content).__name__}, expected POLYDATA")
    return ExportSurface(content, holes, tuple(text for _, text in to.warnings))


def _reader(
    recording: Recording, write: Callable[[PolyData], WrittenFile]
) -> Callable[[Entry], tuple[ExportSurface, WrittenFile]]:
    units, accepted = recorded_units(recording), recorded_acceptance(recording)

    def read(entry: Entry) -> tuple[ExportSurface, WrittenFile]:
        surface = export_surface_of(entry, units.of(entry.kind, entry.channel, entry.type, entry.links), accepted)
        return surface, write(surface.content)

    return read


def _data(file: tuple[ExportSurface, WrittenFile]) -> tuple[bytes]:
    return (file[1].data,)


def _count(file: tuple[ExportSurface, WrittenFile], entry: Entry, account: ExportAccount) -> None:
    surface, written = file
    holes = (("points", surface.holes, "no finite coordinates"),) if surface.holes else ()
    for unit, number, why in (("points", len(surface.content.points), ""), *holes, *written.parts):
        if not number:
            continue
        row = account.part(entry, unit)
        row.declared += number
        if why:
            row.leave_out(why, number)
        else:
            row.taken += number
    for warning in surface.warnings:
        note = f"{entry.channel}: {warning}"
        if note not in account.notes and len(account.notes) < _MAX_NOTES:
            account.notes.append(note)


def ply(content: PolyData) -> WrittenFile:
    """Build a PLY file, binary little-endian: vertices with normals and colours, faces."""
    count = len(content.points)
    columns: dict[str, tuple[str, Array]] = {
        name: ("float", content.points[:, axis].astype("<f4")) for axis, name in enumerate("xyz")
    }
    parts = [
        (unit, cells.count, "" if index == _POLYGONS else "PLY has no cells of this kind")
        for index, (unit, cells) in enumerate(zip(_SECTIONS, content.cells, strict=True))
    ]
    for attribute in content.attributes:
        values, why = attribute.values, _misfit(attribute, content)
        if why:
            pass
        elif attribute.type == NORMAL and values.shape[1] == 3 and "nx" not in columns:
            columns |= {f"n{name}": ("float", values[:, axis].astype("<f4")) for axis, name in enumerate("xyz")}
        elif not attribute.type & CELL and colour_field(attribute) and "red" not in columns:
            colours = colour_bytes(values)
            names = ("red", "green", "blue", "alpha")[: colours.shape[1]]
            columns |= {name: ("uint8", colours[:, axis]) for axis, name in enumerate(names)}
        else:
            why = "PLY has only one set of colours and normals of points"
        parts.append(("attributes", 1, why))
    vertices = np.empty(count, [(name, values.dtype) for name, (_, values) in columns.items()])
    for name, (_, values) in columns.items():
        vertices[name] = values
    faces = content.polygons
    indices = faces.data.astype("<u4")
    # MeshLab refuses counts that are not of one byte
    small = not faces.count or int(indices[faces.starts()].max()) <= _MOST_OF_A_BYTE
    head = [
        "ply",
        "format binary_little_endian 1.0",
        f"comment {_TITLE}",
        f"element vertex {count}",
        *(f"property {kind} {name}" for name, (kind, _) in columns.items()),
        f"element face {faces.count}",
        f"property list {'uchar' if small else 'uint'} int vertex_indices",
        "end_header",
        "",
    ]
    data = "\n".join(head).encode() + vertices.tobytes() + (_small_counts(faces) if small else indices.tobytes())
    return WrittenFile(data, tuple(parts))


def _small_counts(faces: Cells) -> bytes:
    """The counts of the faces as one byte each, and their indices as four bytes."""
    data = faces.data.astype("<u4").view(np.uint8)
    kept = np.ones(len(data), np.bool_)
    for byte in (1, 2, 3):
        kept[4 * faces.starts() + byte] = False
    return data[kept].tobytes()


def vtk(content: PolyData) -> WrittenFile:
    """Build a legacy VTK file, version 3.0, binary (big-endian)."""
    head = f"# vtk DataFile Version 3.0\n{_TITLE}\nBINARY\nDATASET POLYDATA\n"
    data = [f"{head}POINTS {len(content.points)} float\n".encode(), content.points.astype(">f4").tobytes(), b"\n"]
    for name, cells in zip(("VERTICES", "LINES", "POLYGONS", "TRIANGLE_STRIPS"), content.cells, strict=True):
        if cells.count:
            data += [f"{name} {cells.count} {len(cells.data)}\n".encode(), cells.data.astype(">i4").tobytes(), b"\n"]
    parts = [(unit, cells.count, "") for unit, cells in zip(_SECTIONS, content.cells, strict=True)]
    written: dict[int, list[Attribute]] = {0: [], CELL: []}
    for attribute in content.attributes:
        why = _misfit(attribute, content)
        parts.append(("attributes", 1, why))
        if not why:
            written[attribute.type & CELL].append(attribute)
    data += _fields(f"POINT_DATA {len(content.points)}", written[0])
    data += _fields(f"CELL_DATA {sum(cells.count for cells in content.cells)}", written[CELL])
    return WrittenFile(b"".join(data), tuple(parts))


def _misfit(attribute: Attribute, content: PolyData) -> str:
    """Return why an attribute does not fit its points or cells; ``""`` if it does."""
    of_cells = bool(attribute.type & CELL)
    count = sum(cells.count for cells in content.cells) if of_cells else len(content.points)
    if not attribute.components:
        return "attributes without components"
    if attribute.tuples != count:
        things = "cells" if of_cells else "points"
        return f"{count_text(attribute.tuples, 'value')} for {count:,} {things}"
    return "" if count else "no points or cells for these attributes"


def _fields(head: str, attributes: list[Attribute]) -> Iterator[bytes]:
    """Yield the attributes of points or cells.

    The first normals have a section of their own, so that a program uses them as such, and the first colours are there
    as bytes, too, for its screen.  All others are fields, with the values as they are.
    """
    if not attributes:
        return
    yield f"{head}\n".encode()
    names = FreeNames()  # VTK requires unique names
    named = [(names.take(each.name or f"attribute{number}"), each) for number, each in enumerate(attributes)]
    if colours := next((each for each in attributes if colour_field(each)), None):
        values = colour_bytes(colours.values)
        yield f"COLOR_SCALARS {_encoded(names.take('colours'))} {values.shape[1]}\n".encode()
        yield values.tobytes() + b"\n"
    fields = []
    taken: set[str] = set()
    for name, each in named:
        section = _SECTION_OF.get((each.type & ~CELL, each.components), "")
        if not section or section in taken:
            fields.append((name, each))
            continue
        taken.add(section)
        yield f"{section} {_encoded(name)} float\n".encode()
        yield each.values.astype(">f4").tobytes() + b"\n"
    if fields:
        yield f"FIELD attributes {len(fields)}\n".encode()
    for name, each in fields:
        yield f"{_encoded(name)} {each.values.shape[1]} {each.values.shape[0]} float\n".encode()
        yield each.values.astype(">f4").tobytes() + b"\n"


def _encoded(name: str) -> str:
    """Return a name as VTK's own writer encodes it: blanks, quotes, per cent and non-ASCII bytes as ``%XX``."""
    return "".join(
        chr(byte) if 32 < byte < 127 and byte not in b'"%' else f"%{byte:02X}"
        for byte in name.encode("utf-8", "surrogateescape")
    )
