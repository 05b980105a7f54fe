"""The most expensive valid messages of each type within their limits: one table for tests, attackers and measurements.

A row makes a message of ``number`` parts of a kind; ``most`` is the greatest number that is valid and converted, and
``refused`` one above it whose conversion is refused, where there is one.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from igtl_gateway.base.buffers import join
from igtl_gateway.convert.columns import MAX_ROWS
from igtl_gateway.convert.tracking import MAX_TOOLS
from igtl_gateway.convert.trajectories import MAX_POINTS
from igtl_gateway.wire import Item, Message, encode
from igtl_gateway.wire.bind import MAX_CHILDREN, Bind, BindChild
from igtl_gateway.wire.body import Body, Raw
from igtl_gateway.wire.capability import Capability
from igtl_gateway.wire.command import Command
from igtl_gateway.wire.elements import Elements
from igtl_gateway.wire.image import Image
from igtl_gateway.wire.message import MAX_ITEMS
from igtl_gateway.wire.metalists import ImageMetaList, LabelMetaList, VideoMetaList
from igtl_gateway.wire.ndarray import NdArray
from igtl_gateway.wire.point import Points
from igtl_gateway.wire.polydata import (
    CELL,
    MAX_ATTRIBUTES,
    NORMAL,
    SCALAR,
    U4,
    Attribute,
    Cells,
    PolyData,
)
from igtl_gateway.wire.sensor import Sensor
from igtl_gateway.wire.text import Status, String
from igtl_gateway.wire.tracking import QuaternionTrackingData, TrackingData
from igtl_gateway.wire.trajectory import Trajectories
from igtl_gateway.wire.transform import Transform

_POSE = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
_SHEARED = (1.0, 0.2, 0.0, 0.0, 1.0, 0.3, 0.1, 0.0, 1.0, 0.0, 0.0, 0.0)
_MIRRORED = (-1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
_ORIGIN = np.zeros((1, 3), ">f4")
_DEVICE = "Costly"


@dataclass(frozen=True, slots=True)
class Costly:
    """A kind of message; see the module."""

    name: str
    make: Callable[[int], Message]
    most: int
    refused: int = 0

    def data(self, number: int = 0) -> bytes:
        """The bytes of the message, by default of the most expensive one."""
        return join(encode(self.make(number or self.most)))


def _message(igtl_type: str, content: Body, items: tuple[Item, ...] = ()) -> Message:
    version = 2 if items or igtl_type == "COMMAND" else 1
    return Message(igtl_type, _DEVICE, content, header_version=version, metadata=items)


def _items(key: Callable[[int], str], value: bytes, encoding: int = 3) -> Callable[[int], Message]:
    def make(number: int) -> Message:
        items = tuple(Item(key(index), value, encoding) for index in range(number))
        return _message("TRANSFORM", Transform(_POSE), items)

    return make


def _elements(igtl_type: str, kind: type[Elements], name: str, **values: object) -> Callable[[int], Message]:
    def make(number: int) -> Message:
        elements = np.zeros(number, kind.DTYPE)
        elements[name] = [b"N%d" % index for index in range(number)]
        for field, value in values.items():
            elements[field] = value
        return _message(igtl_type, kind(elements))

    return make


def _bind(child: Callable[[int], tuple[str, str, Body]]) -> Callable[[int], Message]:
    def make(number: int) -> Message:
        children = []
        for index in range(number):
            igtl_type, name, content = child(index)
            children.append(BindChild(igtl_type, name, join(content.pack())))
        return _message("BIND", Bind(tuple(children)))

    return make


def _attributes(name: Callable[[int], str], kind: int = SCALAR, width: int = 1) -> Callable[[int], Message]:
    def make(number: int) -> Message:
        values = np.zeros((1, width))
        attributes = tuple(Attribute.of(kind, name(index), values) for index in range(number))
        return _message("POLYDATA", PolyData(_ORIGIN, attributes=attributes))

    return make


def _cells(section: str, flat: Callable[[int], tuple[int, np.ndarray]]) -> Callable[[int], Message]:
    def make(number: int) -> Message:
        cells: dict[str, Any] = {section: Cells(*flat(number))}
        return _message("POLYDATA", PolyData(_ORIGIN, **cells))

    return make


def _equal(width: int) -> Callable[[int], tuple[int, np.ndarray]]:
    def flat(number: int) -> tuple[int, np.ndarray]:
        data = np.zeros((number, width + 1), U4)
        data[:, 0] = width
        return number, data.reshape(-1)

    return flat


def _alternating(number: int) -> tuple[int, np.ndarray]:
    """Triangles and quadrangles in turns."""
    data = np.zeros((number // 2, 9), U4)
    data[:, 0], data[:, 4] = 3, 4
    return number // 2 * 2, data.reshape(-1)


def _growing(number: int) -> tuple[int, np.ndarray]:
    """Cells of 1, 2, 3, … points, about this number of words."""
    most = int(np.sqrt(2 * number))
    starts = np.cumsum(np.arange(1, most + 1) + 1) - np.arange(1, most + 1) - 1
    data = np.zeros(int(starts[-1]) + most + 1, U4)
    data[starts] = np.arange(1, most + 1)
    return most, data


def _one(number: int) -> tuple[int, np.ndarray]:
    data = np.zeros(number + 1, U4)
    data[0] = number
    return 1, data


def polydata_of_attributes(number: int) -> Message:
    """POLYDATA with this number of attributes of one name."""
    return _attributes(lambda index: "a")(number)


_TRIANGLE = PolyData(np.zeros((3, 3), ">f4"), polygons=Cells.of([[0, 1, 2]]))
_MATRIX = NdArray(11, (1,) * 255, bytes(8))

#: In the order of the types.
TABLE: tuple[Costly, ...] = (
    Costly("metadata, many names", _items("k{}".format, b"v"), MAX_ITEMS),
    Costly("metadata, one name", _items(lambda index: "k", b"v"), MAX_ITEMS),
    Costly("metadata, empty", _items(lambda index: "", b""), MAX_ITEMS),
    Costly("metadata, long", _items("k{}".format, b"\xff" * 60), MAX_ITEMS),
    Costly("metadata, frames", _items(lambda index: "ros.frame_id", b"f"), MAX_ITEMS),
    Costly("STRING", lambda number: _message("STRING", String(b"\xff" * number)), 65_535),
    Costly("STATUS", lambda number: _message("STATUS", Status(1, 0, "", "x" * number)), 2_000_000),
    Costly("CAPABILITY", lambda number: _message("CAPABILITY", Capability(("TRANSFORM",) * number)), MAX_ROWS, 65_535),
    Costly("POINT", _elements("POINT", Points, "name"), MAX_POINTS, 123_000),
    Costly("TDATA", _elements("TDATA", TrackingData, "name", matrix=_POSE), MAX_TOOLS, 230_000),
    Costly("TDATA, sheared", _elements("TDATA", TrackingData, "name", matrix=_SHEARED), MAX_TOOLS),
    Costly("TDATA, mirrored", _elements("TDATA", TrackingData, "name", matrix=_MIRRORED), MAX_TOOLS),
    Costly("QTDATA", _elements("QTDATA", QuaternionTrackingData, "name", quaternion=(0, 0, 0, 1)), MAX_TOOLS, 300_000),
    Costly("TRAJ", _elements("TRAJ", Trajectories, "name", type=3), MAX_ROWS, 100_000),
    Costly("IMGMETA", _elements("IMGMETA", ImageMetaList, "name"), MAX_ROWS, 60_000),
    Costly("LBMETA", _elements("LBMETA", LabelMetaList, "name"), MAX_ROWS, 100_000),
    Costly("VIDEOMETA", _elements("VIDEOMETA", VideoMetaList, "name", matrix=_POSE), MAX_ROWS, 50_000),
    Costly("SENSOR", lambda number: _message("SENSOR", Sensor(np.zeros(number))), 255),
    Costly("NDARRAY, dimensions", lambda number: _message("NDARRAY", NdArray(11, (1,) * number, bytes(8))), 255),
    Costly("NDARRAY", lambda number: _message("NDARRAY", NdArray(11, (number, 6), bytes(48 * number))), 65_535),
    Costly("COMMAND", lambda number: _message("COMMAND", Command.of(1, "Do", "<b/>" * number)), 4_000_000),
    Costly("IMAGE", lambda number: _message("IMAGE", Image((1_000, number, 1), 3, bytes(1_000 * number), 1)), 60_000),
    Costly("BIND of TRANSFORM", _bind(lambda index: ("TRANSFORM", f"b{index}", Transform(_POSE))), MAX_CHILDREN),
    Costly("BIND of one TRANSFORM", _bind(lambda index: ("TRANSFORM", "b", Transform(_POSE))), MAX_CHILDREN),
    Costly("BIND of NDARRAY", _bind(lambda index: ("NDARRAY", "n", _MATRIX)), MAX_CHILDREN),
    Costly("BIND of POLYDATA", _bind(lambda index: ("POLYDATA", "p", _TRIANGLE)), MAX_CHILDREN),
    Costly("BIND of unknown", _bind(lambda index: (f"T{index}", f"u{index}", Raw(b"x"))), MAX_CHILDREN),
    Costly("BIND of queries", _bind(lambda index: ("GET_STATUS", f"q{index}", Raw(b""))), MAX_CHILDREN),
    Costly("BIND of rubbish", _bind(lambda index: ("POLYDATA", "p", Raw(b"\xff" * 40))), MAX_CHILDREN),
    Costly(
        "BIND of TDATA",
        _bind(lambda index: ("TDATA", f"t{index}", _elements("", TrackingData, "name", matrix=_POSE)(4).content)),
        MAX_CHILDREN,
    ),
    Costly(
        "BIND of BIND",
        _bind(lambda index: ("BIND", "n", _bind(lambda _: ("TRANSFORM", f"b{index}", Transform(_POSE)))(1).content)),
        MAX_CHILDREN // 2,
    ),
    Costly("POLYDATA, attributes of one name", polydata_of_attributes, MAX_ATTRIBUTES),
    Costly("POLYDATA, long names", _attributes(lambda index: "a" * 250), MAX_ATTRIBUTES),
    Costly("POLYDATA, names that follow", _attributes(lambda index: "a" + "_" * (index % 250)), MAX_ATTRIBUTES),
    Costly("POLYDATA, colours", _attributes(lambda index: "RGB", SCALAR, 3), MAX_ATTRIBUTES),
    Costly("POLYDATA, normals", _attributes(lambda index: "N", NORMAL, 3), MAX_ATTRIBUTES),
    Costly("POLYDATA, attributes of cells", _attributes(lambda index: "a", SCALAR | CELL), MAX_ATTRIBUTES),
    Costly("POLYDATA, wide attributes", _attributes(lambda index: "", SCALAR, 255), MAX_ATTRIBUTES),
    Costly("POLYDATA, points", lambda number: _message("POLYDATA", PolyData(np.zeros((number, 3), ">f4"))), 1_000_000),
    Costly("POLYDATA, cells of 0", _cells("polygons", _equal(0)), 4_000_000),
    Costly("POLYDATA, cells of 1", _cells("vertices", _equal(1)), 2_000_000),
    Costly("POLYDATA, triangles", _cells("polygons", _equal(3)), 1_000_000),
    Costly("POLYDATA, triangles and quadrangles", _cells("polygons", _alternating), 1_000_000),
    Costly("POLYDATA, polygons of all sizes", _cells("polygons", _growing), 1_000_000),
    Costly("POLYDATA, strips of all sizes", _cells("triangle_strips", _growing), 1_000_000),
    Costly("POLYDATA, lines of all sizes", _cells("lines", _growing), 1_000_000),
    Costly("POLYDATA, one strip", _cells("triangle_strips", _one), 1_000_000),
    Costly("POLYDATA, one line", _cells("lines", _one), 1_000_000),
    Costly("POLYDATA, one polygon", _cells("polygons", _one), 1_000_000),
    Costly("unknown", lambda number: _message("MYTYPE", Raw(bytes(number))), 8 << 20),
)
