"""A received message, with its content as arrays and strings."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from igtl_gateway.base.errors import ConversionError
from igtl_gateway.base.stamp import ticks_to_ns
from igtl_gateway.convert.poses import rotation_matrix, unit_quaternion
from igtl_gateway.wire import Message
from igtl_gateway.wire.body import Body, Raw
from igtl_gateway.wire.command import Command
from igtl_gateway.wire.fields import decode_text, visible
from igtl_gateway.wire.image import Image
from igtl_gateway.wire.ndarray import NdArray
from igtl_gateway.wire.point import Points
from igtl_gateway.wire.polydata import PolyData
from igtl_gateway.wire.query import split_query
from igtl_gateway.wire.registry import ALIASES, describe_content
from igtl_gateway.wire.sensor import Sensor, unit_text
from igtl_gateway.wire.text import Status, String
from igtl_gateway.wire.tracking import QuaternionTrackingData, TrackingData
from igtl_gateway.wire.transform import Position, Transform

Array = npt.NDArray[Any]


@dataclass(frozen=True, eq=False, repr=False)
class ReceivedMessage:
    """One message from a peer.

    The properties return the content as numbers and strings.  Lengths are in millimetres, as on the wire.  A property
    that the type does not have raises ConversionError.

    Attributes:
        wire: the whole message as `igtl_gateway.wire` decodes it; ``peer.send(message)`` sends it unchanged.
        link: number of the connection that it came from.
        received_ns: time of receipt, UTC nanoseconds of this host.

    Examples:
        >>> message = ReceivedMessage(Message("STRING", "Greeting", String.of("hello")), 1, 0)
        >>> message.type, message.device, message.text
        ('STRING', 'Greeting', 'hello')
    """

    wire: Message
    link: int
    received_ns: int

    @cached_property
    def type(self) -> str:
        """Message type, such as ``"TRANSFORM"``; QTRANS, which means the same as POSITION, is POSITION here."""
        name = visible(self.wire.type)
        return ALIASES.get(name, name)

    @cached_property
    def device(self) -> str:
        """Device name."""
        return visible(self.wire.device_name)

    @property
    def content(self) -> Body:
        """The content as an object of `igtl_gateway.wire`, with all of its fields."""
        return self.wire.content

    @property
    def is_empty(self) -> bool:
        """Whether the message has no content: the peer has none to send."""
        return isinstance(self.content, Raw) and not len(self.content.data)

    @property
    def source_ns(self) -> int:
        """The sender's time stamp, UTC nanoseconds; 0: unset."""
        return ticks_to_ns(self.wire.ticks)

    @property
    def header_version(self) -> int:
        """Header version, 1 or 2."""
        return self.wire.header_version

    @property
    def metadata(self) -> dict[str, str]:
        """Metadata of header version 2; the last value of a key applies."""
        return {visible(item.key): item.text for item in self.wire.metadata}

    @property
    def matrix(self) -> Array:
        """A pose as (4, 4) float64, millimetres: of TRANSFORM and POSITION.

        Of an IMAGE: voxel index (i, j, k, 1) → RAS, millimetres; index 0 is the centre of the first voxel.
        """
        match self.content:
            case Transform() as content:
                return _with_last_row(_columns(content.wire_matrix))
            case Position(position, quaternion):
                return _with_last_row(_pose(position, quaternion, f"{self}"))
            case Image() as content:
                return _with_last_row(_image_matrix(content))
            case _:
                raise self._lacks("matrix", "TRANSFORM, POSITION and IMAGE")

    @property
    def position(self) -> Array:
        """The position of a pose: (3,) float64, millimetres: of TRANSFORM and POSITION."""
        if isinstance(self.content, Transform | Position):
            return self.matrix[:3, 3].copy()
        raise self._lacks("position", "TRANSFORM and POSITION")

    @property
    def poses(self) -> dict[str, Array]:
        """The poses of all tools by name, each (4, 4) float64, millimetres: of TDATA and QTDATA."""
        match self.content:
            case TrackingData(elements):
                rows = [(row["name"], _columns(row["matrix"].astype(float))) for row in elements]
            case QuaternionTrackingData(elements):
                rows = [(row["name"], _pose(row["position"], row["quaternion"], f"{self}")) for row in elements]
            case _:
                raise self._lacks("poses", "TDATA and QTDATA")
        return {visible(decode_text(name)): _with_last_row(pose) for name, pose in rows}

    @property
    def positions(self) -> Array:
        """Points as (n, 3) float32, millimetres: of POINT and POLYDATA."""
        match self.content:
            case Points(elements):
                return elements["position"].astype(np.float32)
            case PolyData() as content:
                return content.points.astype(np.float32)
            case _:
                raise self._lacks("positions", "POINT and POLYDATA")

    @property
    def names(self) -> list[str]:
        """The names of the elements: of POINT, TDATA and QTDATA."""
        match self.content:
            case Points(elements) | TrackingData(elements) | QuaternionTrackingData(elements):
                return [visible(decode_text(name)) for name in elements["name"].tolist()]
            case _:
                raise self._lacks("names", "POINT, TDATA and QTDATA")

    @property
    def array(self) -> Array:
        """The numbers, a read-only view of the received bytes: of IMAGE, NDARRAY and SENSOR.

        The shape of an IMAGE is (k, j, i), or (k, j, i, components) if there are several.
        """
        match self.content:
            case Image() as content:
                return content.array[..., 0] if content.num_components == 1 else content.array
            case NdArray() as content:
                return content.array
            case Sensor(values):
                return values
            case _:
                raise self._lacks("array", "IMAGE, NDARRAY and SENSOR")

    @property
    def unit(self) -> str:
        """The unit of a SENSOR, such as ``"mm/s"``."""
        if isinstance(self.content, Sensor):
            return unit_text(self.content.unit)
        raise self._lacks("unit", "SENSOR")

    @property
    def text(self) -> str:
        """The text: of STRING, CLIENTINFO, STATUS, COMMAND and RTS_COMMAND."""
        match self.content:
            case String() | Command():
                return self.content.text
            case Status(message=text):
                return visible(text)
            case _:
                raise self._lacks("text", "STRING, CLIENTINFO, STATUS, COMMAND and RTS_COMMAND")

    @property
    def name(self) -> str:
        """The name of a COMMAND or RTS_COMMAND."""
        if isinstance(self.content, Command):
            return visible(self.content.name)
        raise self._lacks("name", "COMMAND and RTS_COMMAND")

    @property
    def query(self) -> tuple[str, str] | None:
        """Prefix and type of a query, such as ``("GET", "TRANSFORM")``; None for other messages."""
        return split_query(self.wire.type)

    def describe(self) -> dict[str, Any]:
        """Return the content as JSON values, as ``igtl-gateway decode`` shows it."""
        return describe_content(self.content)

    def __str__(self) -> str:
        return f"{self.type}/{self.device}"

    def __repr__(self) -> str:
        return f"ReceivedMessage({self}, link={self.link}, source_ns={self.source_ns}, content={self.content!r:.60})"

    def _lacks(self, what: str, types: str) -> ConversionError:
        found = "an empty message" if self.is_empty else f"a message without {what}"
        return ConversionError(f"{self}: found {found}, expected one of {types}")


def _columns(twelve: Any) -> Array:
    return np.asarray(twelve, np.float64).reshape(4, 3).T


def _pose(position: Any, quaternion: Any, place: str) -> Array:
    turn = unit_quaternion([float(value) for value in quaternion], place)
    return np.column_stack((np.array(rotation_matrix(turn)), np.asarray(position, np.float64)))


def _image_matrix(image: Image) -> Array:
    pose = _columns(image.wire_matrix).copy()
    if image.is_lps:
        pose[:2] *= -1.0
    # the wire has the centre of the volume
    first = np.array(image.subvol_offset) - (np.array(image.dimensions) - 1) / 2
    pose[:, 3] += pose[:, :3] @ first
    return pose


def _with_last_row(pose: Array) -> Array:
    matrix = np.eye(4)
    matrix[:3] = pose
    return matrix


#: Whether a message is meant.
Selects = Callable[[ReceivedMessage], bool]


def items_of(metadata: Mapping[str, str]) -> list[tuple[str, str]]:
    """Return metadata as pairs of strings.  Raises ConversionError."""
    for key, value in metadata.items():
        if not (isinstance(key, str) and isinstance(value, str)):
            raise ConversionError(f"metadata: found {key!r}: {value!r}, expected strings")
    return list(metadata.items())
