"""POLYDATA ⇄ igtl_msgs/PolyData: all points, cells and attributes, unchanged.

The C++ library writes nine components for most attributes, of which the first are valid, in one row: the ROS message
has these.  Peers on that library get nine again, by their profile.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from igtl_gateway.base.errors import ConversionError, MalformedBody
from igtl_gateway.base.quantities import counted
from igtl_gateway.convert import igtl_msgs, surfaces
from igtl_gateway.convert.columns import fit_texts
from igtl_gateway.convert.context import ConvertedMessage, ToIgtlContext, ToRosContext
from igtl_gateway.convert.rosmsg import Header
from igtl_gateway.convert.scaling import all_finite, into_igtl, into_ros
from igtl_gateway.convert.units import ieee_754
from igtl_gateway.wire.fields import visible
from igtl_gateway.wire.polydata import (
    F4,
    MAX_ATTRIBUTE_NAME,
    MAX_ATTRIBUTES,
    NORMAL,
    RGBA,
    SCALAR,
    U4,
    Attribute,
    Cells,
    PolyData,
)

Array = npt.NDArray[Any]

_SECTIONS = ("vertices", "lines", "polygons", "triangle_strips")
_TRIANGLE = 3

#: Types of point attributes that PointCloud2 can represent: the name of a field implies its type.
_CLOUD_ATTRIBUTES = (SCALAR, NORMAL, RGBA)


def exceeds_standard(content: PolyData) -> bool:
    """Return whether neither PointCloud2 nor Mesh can represent the content.

    A cloud can hold points, with or without vertex cells, and attributes of all points; a mesh only triangles.
    """
    if surfaces.is_point_cloud(content):
        return not _is_all_points(content.vertices, len(content.points)) or any(
            attribute.type not in _CLOUD_ATTRIBUTES or attribute.tuples != len(content.points)
            for attribute in content.attributes
        )
    return bool(
        content.polygons.width != _TRIANGLE
        or content.triangle_strips.count
        or content.lines.count
        or content.vertices.count
        or content.attributes
    )


def _is_all_points(vertices: Cells, count: int) -> bool:
    """Return whether there are no cells, or the cells list each point once in order: in one cell or one per point."""
    if not vertices.count or vertices.is_all(count):
        return True
    if vertices.count != count:
        return False
    table = vertices.table
    return table is not None and table.shape[1] == 1 and bool((table[:, 0] == np.arange(count)).all())


#: Attributes that a warning names.
_MOST_NAMES = 3


@ieee_754
def polydata_to_ros(content: PolyData, to: ToRosContext) -> igtl_msgs.PolyData:
    """Convert to PolyData: points in metres, cells and attributes as flat arrays."""
    if unclear := [visible(each.name) for each in content.attributes if each.may_have_more]:
        names = ", ".join(map(repr, unclear[:_MOST_NAMES])) + (" …" if len(unclear) > _MOST_NAMES else "")
        to.warnings.append(
            (
                "cell_scalars",
                f"scalars of cells {names}: found 9 components, which the C++ library writes for any number; "
                "one value a cell is read",
            )
        )
    vertices, lines, polygons, strips = (cells.data.astype("<u4") for cells in content.cells)
    return igtl_msgs.PolyData(
        Header(to.stamp_ns, to.frame_id),
        into_ros(to.lengths, content.points, np.empty(content.points.shape)),
        vertices,
        lines,
        polygons,
        strips,
        tuple(map(_attribute_to_ros, content.attributes)),
        to.metadata,
    )


def _attribute_to_ros(attribute: Attribute) -> igtl_msgs.PolyDataAttribute:
    """Return the values that an attribute has, without the tail that the C++ library appends."""
    values = attribute.values
    components = values.shape[1]
    return igtl_msgs.PolyDataAttribute(
        visible(attribute.name), attribute.type, components, np.ascontiguousarray(values, "<f4").reshape(-1)
    )


@ieee_754
def polydata_to_igtl(message: igtl_msgs.PolyData, to: ToIgtlContext) -> ConvertedMessage:
    """Convert to POLYDATA; names that are too long are cut, with a warning.

    Raises ConversionError for inconsistent cells, for point indices out of range, and for NaN and infinite coordinates.
    """
    if len(message.attributes) > MAX_ATTRIBUTES:
        raise ConversionError(
            f"{message.TYPE}: found {counted(len(message.attributes), 'attribute')}, expected at most {MAX_ATTRIBUTES}"
        )
    points = into_igtl(to.lengths, message.points, np.empty(message.points.shape, F4))
    if not all_finite(points):
        raise ConversionError(
            f"{message.TYPE}: found a coordinate that is not finite (as float32), expected finite numbers"
        )
    vertices, lines, polygons, strips = (_cells(name, message) for name in _SECTIONS)
    attributes = tuple(_attribute(attribute, message, to) for attribute in message.attributes)
    content = PolyData(points, vertices, lines, polygons, strips, attributes)
    return ConvertedMessage(content, message.header.stamp_ns, message.header.frame_id, metadata=message.metadata)


def _cells(name: str, message: igtl_msgs.PolyData) -> Cells:
    """Return the cells of a flat array of counts and indices.  Raises ConversionError if it is inconsistent."""
    row = np.ascontiguousarray(getattr(message, name), U4)
    try:
        return Cells.unpack(f"{message.TYPE}, {name}", _count(row), row.view(np.uint8).data, len(message.points))
    except MalformedBody as error:
        raise ConversionError(str(error)) from None


def _count(row: Array) -> int:
    """Return the number of cells of a flat array, including a truncated last cell."""
    if not len(row):
        return 0
    step = int(row[0]) + 1
    if len(row) % step == 0 and bool((row[::step] == step - 1).all()):
        return len(row) // step
    # a memoryview of native words: only the counts become Python numbers, not the indices
    words, position, count = row.astype(np.uint32).data, 0, 0
    while position < len(words):
        position += words[position] + 1
        count += 1
    return count


def _attribute(attribute: igtl_msgs.PolyDataAttribute, message: igtl_msgs.PolyData, to: ToIgtlContext) -> Attribute:
    count, components = len(attribute.values), attribute.components
    if count % components if components else count:
        raise ConversionError(
            f"{message.TYPE}, attribute {attribute.name!r}: found {counted(count, 'value')}, expected a multiple of "
            f"{components}"
        )
    (name,) = fit_texts((attribute.name,), MAX_ATTRIBUTE_NAME, "name of an attribute", to)
    return Attribute(attribute.type, name, components, attribute.values.astype(F4))
