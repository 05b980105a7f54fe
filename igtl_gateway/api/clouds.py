"""Point clouds, point lists and surfaces as coordinates."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any, overload

import numpy as np
import numpy.typing as npt

from igtl_gateway.api.display import as_array, html_line, shape_text
from igtl_gateway.api.images import find_row
from igtl_gateway.api.source import Source
from igtl_gateway.base.errors import ConfigError, MalformedBody
from igtl_gateway.convert.clouds import CloudColumns
from igtl_gateway.convert.igtl_msgs import PointList
from igtl_gateway.convert.rosmsg import Marker, PointCloud2, PointStamped
from igtl_gateway.gateway.acceptance import Acceptance
from igtl_gateway.gateway.log.entry import Kind
from igtl_gateway.record.sessionfile.bulk import MessageBlock
from igtl_gateway.record.sessionfile.channels import ChannelSummary
from igtl_gateway.wire.body import Body
from igtl_gateway.wire.fields import decode_text
from igtl_gateway.wire.point import Points
from igtl_gateway.wire.polydata import CELL, PolyData

Array = npt.NDArray[Any]


@dataclass(frozen=True, slots=True, eq=False)
class Cloud:
    """The points of one message; for numpy their ``xyz``.

    Attributes:
        xyz: (N, 3), float32 or float64 as recorded; holes of an organised cloud are NaN.
        unit: unit of the coordinates.
        time: gateway time, UTC ns.
        source_time: the sender's stamp, UTC ns; 0 = unset.
        frame: ROS frame; ``""`` for OpenIGTLink.
        names: names of the points of POINT and PointList; empty for others.
        fields: further numbers of each point: fields of PointCloud2, attributes of POLYDATA; name → (N,) or (N, k).
    """

    xyz: Array
    unit: str
    time: int
    source_time: int
    frame: str = ""
    names: tuple[str, ...] = ()
    fields: dict[str, Array] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.xyz)

    def __array__(self, dtype: npt.DTypeLike | None = None, copy: bool | None = None) -> Array:
        return as_array(self.xyz, dtype, copy)

    def __repr__(self) -> str:
        frame = f", {self.frame}" if self.frame else ""
        fields = f", fields {', '.join(self.fields)}" if self.fields else ""
        return f"<Cloud: {shape_text(self.xyz)}, {self.unit}{frame}{fields}>"

    def _repr_html_(self) -> str:
        return html_line(repr(self))


_Parts = tuple[Array, str, tuple[str, ...], dict[str, Array]]


class Clouds(Sequence[Cloud]):
    """The clouds of a stream; each one is decoded when it is used.

    Raises WireError, ConversionError or DamagedRecording for a damaged message, when it is used.
    """

    def __init__(self, source: Source, channel: ChannelSummary, unit: str, blocks: list[MessageBlock]) -> None:
        is_igtl = channel.kind in (Kind.IGTL_IN, Kind.IGTL_OUT)
        read: Callable[[memoryview], _Parts] | None = None
        if not is_igtl:
            read = _ROS.get(channel.type)
        elif of_wire := _WIRE.get(channel.entry_type):
            read = partial(_of_wire, of_wire, source.acceptance)
        if read is None:
            raise ConfigError(
                f"{channel.stream}: found type {channel.entry_type}, expected one of {', '.join((*_WIRE, *_ROS))}"
            )
        self._read, self._unit, self._blocks = read, unit, blocks
        self._name = channel.stream or channel.topic
        self._ends = np.cumsum([len(block) for block in blocks], dtype=np.int64)

    def __repr__(self) -> str:
        return f"<Clouds: {len(self):,} of {self._name}>"

    def _repr_html_(self) -> str:
        return html_line(repr(self))

    def __len__(self) -> int:
        return int(self._ends[-1]) if len(self._ends) else 0

    @overload
    def __getitem__(self, index: int) -> Cloud: ...
    @overload
    def __getitem__(self, index: slice) -> list[Cloud]: ...
    def __getitem__(self, index: int | slice) -> Cloud | list[Cloud]:
        if isinstance(index, slice):
            return [self[each] for each in range(*index.indices(len(self)))]
        block, row = find_row(self._blocks, self._ends, index)
        xyz, frame, names, fields = self._read(block.payload(row))
        return Cloud(xyz, self._unit, int(block.times[row]), int(block.source_times[row]), frame, names, fields)


def _of_wire(read: Callable[[Body], _Parts], acceptance: Acceptance, payload: memoryview) -> _Parts:
    return read(acceptance.message(payload).content)


def _points(content: Body) -> _Parts:
    if not isinstance(content, Points):
        raise MalformedBody("POINT", "an empty body", "points")
    elements = content.elements
    names = tuple(decode_text(bytes(name)) for name in elements["name"])
    fields = {"rgba": elements["rgba"], "diameter": elements["diameter"].astype(np.float32)}
    return elements["position"].astype(np.float32), "", names, fields


def _polydata(content: Body) -> _Parts:
    if not isinstance(content, PolyData):
        raise MalformedBody("POLYDATA", "an empty body", "points")
    count = len(content.points)
    fields = {
        attribute.name: attribute.values.astype(np.float32)
        for attribute in content.attributes
        if attribute.tuples == count and not attribute.type & CELL
    }
    return content.points.astype(np.float32), "", (), fields


def _cloud(payload: memoryview) -> _Parts:
    message = PointCloud2.unpack(payload)
    columns = CloudColumns.of(message)
    fields = {name: columns[name] for name in columns.fields if name not in ("x", "y", "z")}
    xyz = columns.positions
    return xyz[0] if len(xyz) == 1 else np.stack(xyz, axis=-1), message.header.frame_id, (), fields


def _list(payload: memoryview) -> _Parts:
    message = PointList.unpack(payload)
    xyz = np.array([point.position for point in message.points]).reshape(-1, 3)
    fields = {
        "rgba": np.array([point.rgba for point in message.points], np.uint8).reshape(-1, 4),
        "diameter": np.array([point.diameter for point in message.points]),
    }
    return xyz, message.header.frame_id, tuple(point.name for point in message.points), fields


def _marker(payload: memoryview) -> _Parts:
    message = Marker.unpack(payload)
    return np.asarray(message.points), message.header.frame_id, (), {}


def _point(payload: memoryview) -> _Parts:
    message = PointStamped.unpack(payload)
    return np.array([message.point]), message.header.frame_id, (), {}


_WIRE: dict[str, Callable[[Body], _Parts]] = {"POINT": _points, "POLYDATA": _polydata}
_ROS: dict[str, Callable[[memoryview], _Parts]] = {
    PointCloud2.TYPE: _cloud,
    PointList.TYPE: _list,
    Marker.TYPE: _marker,
    PointStamped.TYPE: _point,
}
