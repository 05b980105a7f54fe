"""The rules for ROS messages: a walk over the fields of the definition of the type.

Types of ROS 2 Jazzy and of the packages of this project are known; all others are removed.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from functools import cache
from typing import Any

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.serde import SerdeError
from rosbags.typesys import Stores
from rosbags.typesys.base import TypesysError, normalize_fieldname

from igtl_gateway.addon import ConversionError, GatewayError, ns_to_ros, ros_to_ns
from igtl_gateway.addon.igtl import BODIES, SCALARS, parse_unit
from igtl_gateway.addon.messages import DEFINED_PACKAGES, interface_files, pixel_layout
from igtl_gateway.addon.untrusted import ElementCounter, Types, new_store, register_types
from igtl_gateway.addon.untrusted import ros_definitions as definitions
from igtl_gateway.addons.deidentify.context import Context, Removed
from igtl_gateway.addons.deidentify.messages import MessageCleaner

TIME = "builtin_interfaces/msg/Time"
_EIGHT_BITS = frozenset({"uint8", "int8", "byte", "char", "octet"})
_SEVERAL = (Nodetype.ARRAY, Nodetype.SEQUENCE)
_STAMP_BYTES = 8
_U32 = struct.Struct("<I")
#: CDR begins with these bytes; offsets are aligned from their end on.
_ENCAPSULATION = b"\0\1\0\0"
#: Types with positions on the earth, and types that carry any bytes.
_PLACES = frozenset({"sensor_msgs/msg/NavSatFix", "geographic_msgs/msg/GeoPoint"})
_ANY_BYTES = frozenset({"igtl_msgs/msg/RawMessage"})
_ITEM = "igtl_msgs/msg/MetadataItem"
_IMAGE, _COMPRESSED, _VOLUME = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage", "igtl_msgs/msg/Volume"
_VIDEO, _FOXGLOVE = "igtl_msgs/msg/VideoFrame", "foxglove_msgs/msg/CompressedVideo"
_CHILD, _ARRAY = "igtl_msgs/msg/BoundMessage", "igtl_msgs/msg/NdArray"

#: Fields of names: in every type, and in one type.
_NAMES = frozenset({"frame_id", "child_frame_id", "device_name", "owner", "coordinate_name", "joint_names"})
_NAMES_OF = {
    "sensor_msgs/msg/JointState": "name", "sensor_msgs/msg/MultiDOFJointState": "joint_names",
    "igtl_msgs/msg/ImageMeta": "name", "igtl_msgs/msg/LabelMeta": "name", "igtl_msgs/msg/VideoMeta": "name",
    "igtl_msgs/msg/LabeledPoint": "name", "igtl_msgs/msg/Trajectory": "name", "igtl_msgs/msg/TrackedTool": "name",
    "igtl_msgs/msg/PolyDataAttribute": "name", "igtl_msgs/msg/Command": "name", "igtl_msgs/msg/CommandReply": "name",
    _CHILD: "name",
}  # fmt: skip
#: Strings that stay if they are one of the words of their field.
_FIELDS_OF_CLOUDS = frozenset("x y z rgb rgba intensity i normal_x normal_y normal_z curvature ring time label".split())
_WORDS = {
    ("sensor_msgs/msg/PointField", "name"): _FIELDS_OF_CLOUDS,
    (_VIDEO, "codec"): frozenset("I420 H264 VP90 X265 O265 AV10".split()),
    ("igtl_msgs/msg/Query", "codec"): frozenset("I420 H264 VP90 X265 O265 AV10".split()),
    (_FOXGLOVE, "format"): frozenset("h264 h265 vp9 av1".split()),
    ("igtl_msgs/msg/Query", "type"): frozenset(BODIES),
    ("igtl_msgs/msg/Metadata", "type"): frozenset(BODIES),
    ("igtl_msgs/msg/Capability", "types"): frozenset(BODIES),
    (_CHILD, "type"): frozenset(BODIES),
}
#: Fields with arrays of 8-bit numbers that are not text.
_DATA = frozenset({
    (_IMAGE, "data"), (_COMPRESSED, "data"), (_VOLUME, "data"), (_VIDEO, "data"), (_FOXGLOVE, "data"),
    (_CHILD, "content"), (_ARRAY, "data"), ("igtl_msgs/msg/ColorTable", "table"),
    ("sensor_msgs/msg/PointCloud2", "data"), ("nav_msgs/msg/OccupancyGrid", "data"),
    *((f"igtl_msgs/msg/{name}", "rgba") for name in ("LabelMeta", "LabeledPoint", "Trajectory")),
})  # fmt: skip


class RosLayout:
    """Where the stamps and the numbers are in messages of some types of ROS.

    These are the types whose fields are, one after the other, times and strings, and then numbers of 64 bits.

    Args:
        fields: definitions, as rosbags has them.
    """

    def __init__(self, fields: Mapping[str, Any]) -> None:
        self._fields = fields
        self._known: dict[str, tuple[tuple[str, ...], int] | None] = {}

    def places(self, ros_type: str, data: bytes) -> tuple[list[int], int] | None:
        """Return the offsets of the stamps and of the first number; None for another type, and for other bytes."""
        if ros_type not in self._known:
            self._known[ros_type] = self._flat(ros_type)
        known = self._known[ros_type]
        if known is None or not data.startswith(_ENCAPSULATION):
            return None
        texts, numbers = known
        stamps, at = [], len(_ENCAPSULATION)
        for each in texts:
            at += -at % 4
            if each == TIME:
                stamps.append(at)
                at += _STAMP_BYTES
            elif at + _U32.size > len(data):
                return None
            else:
                at += _U32.size + _U32.unpack_from(data, at)[0]
        at += -(at - len(_ENCAPSULATION)) % 8
        return (stamps, at) if at + 8 * numbers == len(data) else None

    def _flat(self, ros_type: str) -> tuple[tuple[str, ...], int] | None:
        texts: list[str] = []
        numbers = 0
        for each in self._leaves(ros_type):
            if each == "float64":
                numbers += 1
            elif numbers or each not in (TIME, "string"):
                return None
            else:
                texts.append(each)
        return (tuple(texts), numbers) if numbers else None

    def _leaves(self, ros_type: str) -> list[str]:
        """The fields of a type with those of its parts; ``""`` for what has another layout."""
        if ros_type == TIME:
            return [TIME]
        found: list[str] = []
        fields: Any = self._fields[ros_type][1] if ros_type in self._fields else [("", (None, ""))]
        for _, (kind, inner) in fields:
            if kind == Nodetype.NAME:
                found += self._leaves(inner)
            elif kind == Nodetype.BASE:
                found.append(inner[0])
            elif kind == Nodetype.ARRAY and inner[0] == (Nodetype.BASE, ("float64", 0)):
                found += ["float64"] * int(inner[1])
            else:
                found.append("")
        return found


class RosCleaner:
    """Changes ROS messages by the rules of a context.

    Args:
        context: the rules.
        messages: for contents of OpenIGTLink in ROS messages.
        recorded: definitions of the recording, for types that the profile keeps.
    """

    def __init__(self, context: Context, messages: MessageCleaner, recorded: Mapping[str, str]) -> None:
        self._context, self._messages, self._recorded = context, messages, recorded
        self._store = new_store(Stores.ROS2_JAZZY)
        for types in _own_types():
            register_types(self._store, types)
        self._counters: dict[str, ElementCounter] = {}
        #: Where stamps and numbers are in messages.
        self.layout = RosLayout(self._store.fielddefs)

    def clean(self, ros_type: str, data: bytes, stream: str) -> bytes:
        """Return the message without identity.  Raises Removed."""
        if ros_type in _PLACES:
            raise Removed("place")
        if not self._is_known(ros_type):
            if not self._context.keeps_type(ros_type):
                raise Removed("type")
            self._context.report.add("kept type")
            return data
        try:
            if ros_type not in self._counters:
                self._counters[ros_type] = ElementCounter(self._store.fielddefs, ros_type)
            self._counters[ros_type].check(data)
            message = self._store.deserialize_cdr(data, ros_type)
            if ros_type == _ITEM and not self._keeps_item(message):
                raise Removed("metadata")
            self._message(message, ros_type, stream)
            return bytes(self._store.serialize_cdr(message, ros_type))
        except (SerdeError, ConversionError, ValueError, IndexError, TypeError, KeyError, OverflowError):
            raise Removed("damaged") from None

    def _is_known(self, ros_type: str) -> bool:
        if ros_type in self._store.fielddefs and ros_type not in _ANY_BYTES:
            return True
        text = self._recorded.get(ros_type, "")
        if not text or not self._context.keeps_type(ros_type):
            return False
        try:
            types = definitions.parse_definition(text, ros_type)
            register_types(
                self._store, {name: each for name, each in types.items() if name not in self._store.fielddefs}
            )
        except GatewayError:
            return False
        return ros_type not in _ANY_BYTES

    def _message(self, message: Any, name: str, stream: str) -> None:
        """Change a message in place."""
        special = _SPECIAL.get(name)
        if special:
            special(self, message, stream)
        fields: Any = self._store.fielddefs[name][1]
        for field, (kind, inner) in fields:
            attribute = normalize_fieldname(field)
            value = getattr(message, attribute)
            (kind_of_each, each), _ = inner if kind in _SEVERAL else ((kind, inner), 0)
            if kind_of_each == Nodetype.NAME:
                if kind in _SEVERAL:
                    kept = [one for one in value if each != _ITEM or self._keeps_item(one)]
                    for one in kept:
                        self._part(one, each, stream)
                    if kind == Nodetype.SEQUENCE:
                        setattr(message, attribute, kept)
                else:
                    self._part(value, each, stream)
            elif each[0] == "string":
                new = [self._string(name, field, one, stream) for one in value] if kind in _SEVERAL else self._string(
                    name, field, value, stream
                )  # fmt: skip
                setattr(message, attribute, new)
            elif kind in _SEVERAL and each[0] in _EIGHT_BITS and len(value) and (name, field) not in _DATA:
                if not self._context.keeps_type(name):
                    raise Removed("bytes")

    def _part(self, value: Any, name: str, stream: str) -> None:
        if name == TIME:
            value.sec, value.nanosec = ns_to_ros(self._context.times.ns(ros_to_ns(value.sec, value.nanosec)))
        elif name in _PLACES:
            raise Removed("place")
        elif name in _ANY_BYTES:
            raise Removed("type")
        else:
            self._message(value, name, stream)

    def _keeps_item(self, item: Any) -> bool:
        keeps = self._context.keeps_key(item.key)
        self._context.report.add("metadata", not keeps)
        return keeps

    def _string(self, name: str, field: str, text: str, stream: str) -> str:
        context = self._context
        if name == _ITEM:
            return text
        if field in _NAMES or _NAMES_OF.get(name) == field:
            return context.names.name(text)
        if field == "patient_name":
            return context.patient_name(text)
        if field == "patient_id":
            return context.patient_id(text)
        if field == "unit_text" and _is_unit(text):
            return text
        if text in _WORDS.get((name, field), ()) or (name, field) in _CHECKED:
            return text
        return context.text(text, stream)

    def _image(self, message: Any, stream: str) -> None:
        try:
            scalar, components, _ = pixel_layout(message.encoding)
        except ConversionError:
            if message.encoding:
                raise Removed("pixels") from None
            return
        dtype = np.dtype(SCALARS[scalar]).newbyteorder(">" if message.is_bigendian else "<")
        row = message.width * components * dtype.itemsize
        data = np.asarray(message.data, np.uint8)
        if message.step < row or len(data) != message.step * message.height:
            raise Removed("damaged")
        rows = data.reshape(message.height, message.step)[:, :row]  # what follows a row is no picture
        if message.step > row:
            self._context.report.add("padding")
        pixels = np.ascontiguousarray(rows).view(dtype).reshape(message.height, message.width, components)
        masked = self._context.pixels.plain(pixels, stream, (message.height, message.width))
        new = np.zeros((message.height, message.step), np.uint8)
        new[:, :row] = rows if masked is None else np.frombuffer(masked, np.uint8).reshape(message.height, row)
        message.data = new.reshape(-1)

    def _compressed(self, message: Any, stream: str) -> None:
        words = message.format.lower().replace(";", " ").split()
        form, message.format = message.format, next((word for word in words if word in _FORMATS), "")
        if not len(message.data):
            return
        new = self._context.pixels.compressed(form, message.data.tobytes(), stream)
        if new is None:
            raise Removed("pixels")
        message.data = np.frombuffer(new, np.uint8)

    def _video(self, message: Any, stream: str) -> None:
        new = self._context.pixels.video(
            message.codec if hasattr(message, "codec") else message.format, message.data.tobytes(), stream, is_key=False
        )
        if new is None:
            raise Removed("pixels")
        message.data = np.frombuffer(new, np.uint8)

    def _volume(self, message: Any, stream: str) -> None:
        if message.scalar_type not in SCALARS:
            raise Removed("damaged")
        columns, rows, slices = (int(each) for each in message.size)
        dtype = np.dtype(SCALARS[message.scalar_type]).newbyteorder(">" if message.is_bigendian else "<")
        data = np.ascontiguousarray(message.data, np.uint8).view(dtype)
        pixels = data.reshape(slices, rows, columns, message.components)
        masked = self._context.pixels.plain(pixels, stream, (rows, columns))
        if masked is not None:
            message.data = np.frombuffer(masked, np.uint8)

    def _child(self, message: Any, stream: str) -> None:
        message.content = np.frombuffer(
            self._messages.content(message.type, np.asarray(message.content, np.uint8).tobytes(), stream), np.uint8
        )

    def _array(self, message: Any, _: str) -> None:
        if message.scalar_type in (2, 3) and not self._context.keeps_type(_ARRAY):
            raise Removed("bytes")


def bare_definition(text: str, ros_type: str) -> str:
    """Return a definition without its comments; ``""`` for one in IDL that cannot be read."""
    if not definitions.is_idl(text):
        return "\n".join(line.partition("#")[0].rstrip() for line in text.splitlines())
    try:
        return definitions.definition_text(definitions.parse_definition(text, ros_type), ros_type)
    except (GatewayError, TypesysError):
        return ""


@cache
def _own_types() -> tuple[Types, ...]:
    """Return the types of the packages of this project, which ROS 2 Jazzy does not have."""
    known = new_store(Stores.ROS2_JAZZY).fielddefs
    files = ((f"{package}/msg/{path.stem}", path) for package in DEFINED_PACKAGES for path in interface_files(package))
    return tuple(
        definitions.parse_definition(path.read_text("utf-8"), name)
        for name, path in files
        if path.suffix == ".msg" and name not in known
    )


def _is_unit(text: str) -> bool:
    try:
        return bool(parse_unit(text))
    except ValueError:
        return False


_FORMATS = frozenset("jpeg jpg png h264 h265 vp9 av1".split())
_SPECIAL = {
    _IMAGE: RosCleaner._image,
    _COMPRESSED: RosCleaner._compressed,
    _VIDEO: RosCleaner._video,
    _FOXGLOVE: RosCleaner._video,
    _VOLUME: RosCleaner._volume,
    _CHILD: RosCleaner._child,
    _ARRAY: RosCleaner._array,
}
#: Strings that the functions of ``_SPECIAL`` have checked.
_CHECKED = frozenset({(_IMAGE, "encoding"), (_COMPRESSED, "format")})
