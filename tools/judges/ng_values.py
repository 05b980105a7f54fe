"""Values for the judge of openigtlink-ng: those of our messages as its words, and random ones by its schemas."""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from random import Random
from typing import Any

import numpy as np

from igtl_gateway.wire import Message
from igtl_gateway.wire.bind import Bind
from igtl_gateway.wire.body import Raw
from igtl_gateway.wire.capability import Capability
from igtl_gateway.wire.client_info import ClientInfo
from igtl_gateway.wire.colort import ENTRIES, MAPS, ColorTable
from igtl_gateway.wire.command import Command
from igtl_gateway.wire.elements import Elements
from igtl_gateway.wire.image import SCALARS, Image
from igtl_gateway.wire.metalists import ImageMetaList, LabelMetaList, VideoMetaList
from igtl_gateway.wire.ndarray import NDARRAY_SCALARS, NdArray
from igtl_gateway.wire.point import Points
from igtl_gateway.wire.polydata import PolyData
from igtl_gateway.wire.query import EmptyQuery, GetBind, QueryReply, StartBind, StartPolyData, StartTracking, StartVideo
from igtl_gateway.wire.sensor import Sensor
from igtl_gateway.wire.text import Status, String
from igtl_gateway.wire.tracking import QuaternionTrackingData, TrackingData
from igtl_gateway.wire.trajectory import Trajectories
from igtl_gateway.wire.transform import Position, Transform
from igtl_gateway.wire.video import Video
from tools.judges.programs.ng_words import FLOATS, INTEGERS, Field, floats, integer, integers, octets, text, written

Words = list[str]
Json = dict[str, Any]

# -- ours -------------------------------------------------------------------------------------------------------------


def words_of(message: Message) -> str:
    """The values of a message, header first, in the order of the wire."""
    words = [integer(message.header_version), _name(message.type), _name(message.device_name), integer(message.ticks)]
    words += [integer(message.message_id), f"n{len(message.metadata)}"]
    for item in message.metadata:
        words += [text(item.key), integer(item.encoding), octets(item.value)]
    return " ".join([*words, *OURS[type(message.content)](message.content)])


def _name(value: str) -> str:
    return text(value.partition("\0")[0])


def _elements(list_: Elements) -> Words:
    words = [f"n{len(list_.elements)}"]
    for row in list_.elements:
        words += (_element(row[name]) for name in list_.DTYPE.names or ())
    return words


def _element(value: Any) -> str:
    if isinstance(value, bytes):
        return text(value.partition(b"\0")[0])
    kind, size = value.dtype.kind, value.dtype.itemsize
    if kind == "f":
        return floats(value)
    if not value.shape:
        return integer(value)
    return octets(value.tobytes()) if size == 1 else integers(value)


def _wanted(query: GetBind | StartBind) -> Words:
    types, names = [kind for kind, _ in query.children], [name for _, name in query.children]
    table = _table(names)
    return [integer(len(types)), f"n{len(types)}", *map(_name, types), integer(len(table)), octets(table)]


def _table(names: Sequence[str]) -> bytes:
    table = b"".join(name.encode("utf-8", "surrogateescape") + b"\0" for name in names)
    return table + bytes(len(table) % 2)


def _bind(bind: Bind) -> Words:
    children = bind.children
    words = [integer(len(children)), f"n{len(children)}"]
    for child in children:
        words += [_name(child.type), integer(len(child.content))]
    table = _table([child.name for child in children])
    contents = b"".join(bytes(child.content) + bytes(len(child.content) % 2) for child in children)
    return [*words, integer(len(table)), octets(table), octets(contents)]


def _poly_data(data: PolyData) -> Words:
    sections = (data.vertices, data.lines, data.polygons, data.triangle_strips)
    words = [integer(len(data.points))]
    for section in sections:
        words += [integer(section.count), integer(4 * len(section.data))]
    words += [integer(len(data.attributes)), f"n{len(data.points)}"]
    words += (floats(value) for point in data.points for value in point)
    words += (octets(np.asarray(section.data, ">u4").tobytes()) for section in sections)
    words.append(f"n{len(data.attributes)}")
    for one in data.attributes:
        words += [integer(one.type), integer(one.components), integer(one.tuples)]
    numbers = b"".join(np.asarray(one.data, ">f4").tobytes() for one in data.attributes)
    return [*words, octets(_table([one.name for one in data.attributes]) + numbers)]


def _image(one: Image) -> Words:
    head = (one.image_version, one.num_components, one.scalar_type, one.endian, one.coordinate)
    sub = (integers(one.dimensions), floats(one.wire_matrix), integers(one.subvol_offset), integers(one.sub_size))
    return [*map(integer, head), *sub, octets(memoryview(one.pixels))]


def _video(one: Video) -> Words:
    sub = (integers(one.size), floats(one.wire_matrix), integers(one.subvol_offset), integers(one.sub_size))
    head = (integer(one.video_version), integer(one.endian), text(one.codec), integer(one.frame_type))
    return [*head, integer(one.coordinate), *sub, octets(memoryview(one.data))]


def _position(one: Position) -> Words:
    rotation = {"all": one.quaternion, "quaternion3": one.quaternion[:3], "position_only": ()}[one.form]
    return [floats(one.position), floats(rotation)]


OURS: dict[type[Any], Callable[[Any], Words]] = {
    Raw: lambda one: [octets(memoryview(one.data))] if len(one.data) else [],
    Transform: lambda one: [floats(one.wire_matrix)],
    Position: _position,
    String: lambda one: [integer(one.encoding), octets(one.data)],
    ClientInfo: lambda one: [integer(one.encoding), octets(one.data)],
    Status: lambda one: [integer(one.code), integer(one.subcode), _name(one.error_name), text(one.message)],
    Sensor: lambda one: [
        *map(integer, (len(one.values), one.status, one.unit)),
        floats(one.values),
    ],
    NdArray: lambda one: [
        *map(integer, (one.scalar_type, len(one.size))),
        integers(one.size),
        octets(memoryview(one.data)),
    ],
    ColorTable: lambda one: [integer(one.index_type), integer(one.map_type), octets(memoryview(one.table))],
    Capability: lambda one: [f"n{len(one.types)}", *map(_name, one.types)],
    Command: lambda one: [
        integer(one.command_id), _name(one.name), integer(one.encoding), integer(len(one.data)), octets(one.data),
    ],
    Image: _image,
    Video: _video,
    PolyData: _poly_data,
    Bind: _bind,
    EmptyQuery: lambda one: [octets(one.data)] if len(one.data) else [],
    QueryReply: lambda one: [integer(one.status)] if one.has_body else [],
    StartTracking: lambda one: [integer(one.resolution), _name(one.coordinate_name)],
    StartVideo: lambda one: [text(one.codec), integer(one.resolution)],
    StartPolyData: lambda one: [] if one.resolution_ns is None else [integer(one.resolution_ns)],
    GetBind: _wanted,
    StartBind: lambda one: [integer(one.resolution_ns), *_wanted(one)],
    **dict.fromkeys(
        (Points, Trajectories, TrackingData, QuaternionTrackingData, ImageMetaList, LabelMetaList, VideoMetaList),
        _elements,
    ),
}  # fmt: skip

# -- theirs -----------------------------------------------------------------------------------------------------------

_BITS = {kind: int(kind.lstrip("uint")) for kind in INTEGERS}


def random_words(rng: Random, kind: str, fields: Sequence[Field], *, is_new: bool) -> str:
    """The values of a message of one type by its schema, over the ranges of the fields, that its rules accept.

    Args:
        is_new: header version 2, with a message id and metadata.
    """
    items: Words = []
    count = rng.randrange(4) if is_new else 0
    for _ in range(count):
        items += [octets(_ascii(rng, 12)), integer(_integer(rng, "uint16")), octets(rng.randbytes(rng.randrange(13)))]
    ticks = integer(max(_integer(rng, "uint64"), 1))
    head = [integer(1 + is_new), octets(kind.encode()), octets(_ascii(rng, 20)), ticks]
    head += [integer(_integer(rng, "uint32") * is_new), f"n{count}", *items]
    return " ".join([*head, *written(fields, random_values(rng, kind, fields))])


def random_values(rng: Random, kind: str, fields: Sequence[Field]) -> Json:
    counts = {field["count"] for field in fields if isinstance(field.get("count"), str)}
    values: Json = {}
    for field in fields:
        name = field["name"]
        values[name] = rng.randrange(5) if name in counts else _value(rng, field, values)
    if kind in RULES:
        RULES[kind](rng, values)
    return values


def _value(rng: Random, field: Field, values: Json) -> Any:
    kind = field["type"]
    if kind in INTEGERS:
        return _integer(rng, kind)
    if kind in FLOATS:
        return _float(rng, kind)
    if kind == "array":
        count = field.get("count", 5)
        count = values[count] if isinstance(count, str) else count if "count" in field else rng.randrange(count)
        element = field["element_type"]
        if element == "uint8":
            return rng.randbytes(count)
        if isinstance(element, str):
            return [_value(rng, {"type": element}, values) for _ in range(count)]
        if element["type"] == "struct":
            return [{each["name"]: _value(rng, each, {}) for each in element["fields"]} for _ in range(count)]
        return [_value(rng, element, values) for _ in range(count)]
    if field.get("encoding") == "binary":
        return rng.randbytes(rng.randrange(40))
    return _ascii(rng, field.get("size_bytes", 30), is_whole=not field.get("null_padded", True)).decode()


def _integer(rng: Random, kind: str) -> int:
    bits, is_signed = _BITS[kind], kind[0] != "u"
    low, high = (-(1 << bits - 1), (1 << bits - 1) - 1) if is_signed else (0, (1 << bits) - 1)
    return rng.choice((low, high, 0, 1, rng.randint(low, high), rng.randint(low, high)))


def _float(rng: Random, kind: str) -> float:
    layout, bits = (">f", 32) if kind == "float32" else (">d", 64)
    if rng.random() < 0.5:
        return float(np.float32(rng.uniform(-1e4, 1e4)))
    (value,) = struct.unpack(layout, rng.getrandbits(bits).to_bytes(bits // 8, "big"))
    return float(value)


def _ascii(rng: Random, size: int, *, is_whole: bool = False) -> bytes:
    return bytes(rng.randint(0x20, 0x7E) for _ in range(size if is_whole else rng.randint(0, size)))


def _an_image(rng: Random, values: Json) -> None:
    scalar, components = rng.choice(sorted(SCALARS)), rng.choice((1, 2, 3, 4, 255))
    size = [rng.randrange(7) for _ in range(3)]
    offset = [rng.randint(0, each) for each in size]
    part = [rng.randint(0, each - at) for each, at in zip(size, offset, strict=True)]
    pixels = int(np.prod(part)) * components * np.dtype(SCALARS[scalar]).itemsize
    values |= {"num_components": components, "scalar_type": scalar, "endian": rng.choice((1, 1, 2, 2, 3))}
    values |= {"coord": rng.choice((1, 2)), "size": size, "subvol_offset": offset, "subvol_size": part}
    values["pixels"] = rng.randbytes(pixels)


def _an_array(rng: Random, values: Json) -> None:
    scalar = rng.choice(sorted(NDARRAY_SCALARS))
    size = [rng.randrange(1, 6) for _ in range(rng.randint(1, 4))]
    values |= {"scalar_type": scalar, "dim": len(size), "size": size}
    values["data"] = rng.randbytes(int(np.prod(size)) * np.dtype(NDARRAY_SCALARS[scalar]).itemsize)


def _a_table(rng: Random, values: Json) -> None:
    index, kind = rng.choice((3, 3, 3, 3, 3, 3, 3, 5)), rng.choice(sorted(MAPS))
    dtype, count = MAPS[kind]
    values |= {"index_type": index, "map_type": kind}
    values["table"] = rng.randbytes(ENTRIES[index] * count * np.dtype(dtype).itemsize)


def _names(rng: Random, count: int) -> bytes:
    table = b"".join(_ascii(rng, 20) + b"\0" for _ in range(count))
    return table + bytes(len(table) % 2)


def _a_bind(rng: Random, values: Json) -> None:
    count = rng.randrange(5)
    contents = [rng.randbytes(rng.randrange(40)) for _ in range(count)]
    kinds = [rng.choice(("TRANSFORM", "STATUS", "CUSTOM", "")) for _ in range(count)]
    entries = [{"type_id": kind, "body_size": len(data)} for kind, data in zip(kinds, contents, strict=True)]
    table = _names(rng, count)
    values |= {"ncmessages": count, "header_entries": entries, "nametable_size": len(table), "name_table": table}
    values["bodies"] = b"".join(data + bytes(len(data) % 2) for data in contents)


def _a_request(rng: Random, values: Json) -> None:
    table = _names(rng, values["ncmessages"])
    values |= {"nametable_size": len(table), "name_table": table}


def _a_surface(rng: Random, values: Json) -> None:
    points = rng.randrange(6)
    values["npoints"] = points
    values["points"] = [{axis: _float(rng, "float32") for axis in "xyz"} for _ in range(points)]
    for name in ("vertices", "lines", "polygons", "triangle_strips"):
        cells = [
            [rng.randrange(points) for _ in range(rng.randrange(5) if points else 0)] for _ in range(rng.randrange(4))
        ]
        data = np.array([word for cell in cells for word in (len(cell), *cell)], ">u4").tobytes()
        values |= {f"n{name}": len(cells), f"size_{name}": len(data), name: data}
    heads = [
        {"type": rng.choice((0, 1, 2, 3, 4, 5, 0x10, 0x11, 0x12, 0x13, 0x14, 0x15)), "ncomponents": c, "n": n}
        for c, n in ((rng.choice((1, 2, 3, 4, 9)), rng.randrange(6)) for _ in range(rng.randrange(4)))
    ]
    numbers = sum(head["ncomponents"] * head["n"] for head in heads)
    values |= {"nattributes": len(heads), "attribute_headers": heads}
    values["attribute_data"] = _names(rng, len(heads)) + rng.randbytes(4 * numbers)


def _a_position(rng: Random, values: Json) -> None:
    values["quaternion"] = [_float(rng, "float32") for _ in range(rng.choice((0, 3, 4, 4)))]


#: What holds between the fields of a type, beyond counts.
RULES: dict[str, Callable[[Random, Json], None]] = {
    "IMAGE": _an_image,
    "NDARRAY": _an_array,
    "COLORT": _a_table,
    "COLORTABLE": _a_table,
    "BIND": _a_bind,
    "GET_BIND": _a_request,
    "STT_BIND": _a_request,
    "POLYDATA": _a_surface,
    "POSITION": _a_position,
}
