"""POLYDATA ⇄ igtl_msgs/PolyData: all points, cells and attributes, as they are.

Of the attributes nothing is left out, the tail that the C++ library appends included: what it means is for
readers who know that library, and the way back needs it.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from igtl_gateway.convert import igtl_msgs, surfaces
from igtl_gateway.convert.columns import fit_texts
from igtl_gateway.convert.context import ConvertedMessage, ToIgtlContext, ToRosContext
from igtl_gateway.convert.rosmsg import Header
from igtl_gateway.convert.scaling import all_finite, into_igtl, into_ros
from igtl_gateway.convert.units import ieee_754
from igtl_gateway.errors import ConversionError, MalformedBody
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

#: Point attributes that a PointCloud2 has fields for: their type is told by their name there.
_CLOUD_ATTRIBUTES = (SCALAR, NORMAL, RGBA)


def exceeds_standard(content: PolyData) -> bool:
    """Whether neither a point cloud nor a mesh of ROS can represent it.

    A cloud holds points, each its own vertex or not, and attributes of every point; a mesh holds triangles alone.
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
    """No cells, or every point once and in order: in one cell, or in one each."""
    if not vertices.count or vertices.is_all(count):
        return True
    if vertices.count != count:
        return False
    table = vertices.table
    return table is not None and table.shape[1] == 1 and bool((table[:, 0] == np.arange(count)).all())


@ieee_754
def polydata_to_ros(content: PolyData, to: ToRosContext) -> igtl_msgs.PolyData:
    """Points in metres, cells and attributes as numbers in a row."""
    vertices, lines, polygons, strips = (cells.data.astype("<u4") for cells in content.cells)
    return igtl_msgs.PolyData(
        Header(to.stamp_ns, to.frame_id),
        into_ros(to.lengths, content.points, np.empty(content.points.shape)),
        vertices,
        lines,
        polygons,
        strips,
        tuple(
            igtl_msgs.PolyDataAttribute(
                visible(attribute.name), attribute.type, attribute.components, attribute.data.astype("<f4")
            )
            for attribute in content.attributes
        ),
        to.metadata,
    )


@ieee_754
def polydata_to_igtl(message: igtl_msgs.PolyData, to: ToIgtlContext) -> ConvertedMessage:
    """The inverse; names that do not fit are cut, with a warning.

    Raises ConversionError for cells that contradict themselves or name points that are not there, and for
    coordinates that are not finite.
    """
    if len(message.attributes) > MAX_ATTRIBUTES:
        raise ConversionError(
            f"{message.TYPE}: found {len(message.attributes)} attributes, expected at most {MAX_ATTRIBUTES}"
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
    """A row of counts and indices, checked."""
    row = np.ascontiguousarray(getattr(message, name), U4)
    try:
        return Cells.unpack(f"{message.TYPE}, {name}", _count(row), row.view(np.uint8).data, len(message.points))
    except MalformedBody as error:
        raise ConversionError(str(error)) from None


def _count(row: Array) -> int:
    """How many cells a row has; where it ends inside one, that one is counted too."""
    if not len(row):
        return 0
    step = int(row[0]) + 1
    if len(row) % step == 0 and bool((row[::step] == step - 1).all()):
        return len(row) // step
    # a memoryview of native words: only the counts become Python numbers, not every index
    words, position, count = row.astype(np.uint32).data, 0, 0
    while position < len(words):
        position += words[position] + 1
        count += 1
    return count


def _attribute(attribute: igtl_msgs.PolyDataAttribute, message: igtl_msgs.PolyData, to: ToIgtlContext) -> Attribute:
    count, components = len(attribute.values), attribute.components
    if count % components if components else count:
        raise ConversionError(
            f"{message.TYPE}, attribute {attribute.name!r}: found {count} values, expected a multiple of {components}"
        )
    (name,) = fit_texts((attribute.name,), MAX_ATTRIBUTE_NAME, "name of an attribute", to)
    return Attribute(attribute.type, name, components, attribute.values.astype(F4))
