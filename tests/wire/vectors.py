"""The C library's own test messages, made field by field from the values that its tests assert.

``data/vectors.json`` has these values, and the SHA-256 of each message as the library's test contains it.  What is made
here has the same SHA-256, so it is the library's message, without a copy of its source.  The pictures of ``image``
and ``bind`` are the exception: their pixels are our own, so these two have no SHA-256.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from tests.wire.handmade import crc64, field

VALUES = Path(__file__).parents[1] / "data" / "vectors.json"


@dataclass(frozen=True, slots=True)
class Vector:
    """A message and what it means.

    Attributes:
        name: as the library calls its test.
        data: the bytes of the message.
        sha256: of the library's message; ``None`` where the pixels are our own.
        facts: type, header version, device name, fraction of the stamp, and ``expected``: the content.
    """

    name: str
    data: bytes
    sha256: str | None
    facts: dict[str, Any]


@cache
def vectors() -> tuple[Vector, ...]:
    """All vectors; they are not to be changed."""
    rows = json.loads(VALUES.read_text("utf-8"))
    return tuple(Vector(row["name"], _message(row), row["sha256"], row) for row in rows)


def _message(row: dict[str, Any]) -> bytes:
    body = _CONTENTS[row["type"]](row["expected"])
    if row["header_version"] == 2:
        items = [(item["key"].encode(), item["encoding"], item["value"].encode()) for item in row["metadata"]]
        index = b"".join(struct.pack(">HHI", len(key), encoding, len(value)) for key, encoding, value in items)
        head, data = struct.pack(">H", len(items)) + index, b"".join(key + value for key, _, value in items)
        body = struct.pack(">HHII", 12, len(head), len(data), row["message_id"]) + body + head + data
    header = struct.pack(">H", row["header_version"]) + _text(row["type"], 12) + _text(row["device_name"], 20)
    return header + struct.pack(">QQQ", row["frac"], len(body), crc64(body)) + body


def _text(value: str, width: int) -> bytes:
    return field(value.encode(), width)


def _floats(values: list[float]) -> bytes:
    return struct.pack(f">{len(values)}f", *values)


def _matrix(rows: list[list[float]]) -> bytes:
    """The upper three rows, column by column."""
    return _floats([rows[row][column] for column in range(4) for row in range(3)])


def _u16s(values: list[int]) -> bytes:
    return struct.pack(f">{len(values)}H", *values)


def _image(content: dict[str, Any]) -> bytes:
    head = [content[key] for key in ("num_components", "scalar_type", "endian", "coordinate")]
    size, first, part = (_u16s(content[key]) for key in ("dimensions", "subvol_offset", "subvol_size"))
    pixels = bytes(index % 251 for index in range(content["data_size"]))
    return struct.pack(">H4B", 1, *head) + size + _floats(content["wire_matrix"]) + first + part + pixels


def _sensor(content: dict[str, Any]) -> bytes:
    head = bytes([content["length"], content["status"]]) + bytes.fromhex(content["unit"])
    return head + struct.pack(f">{content['length']}d", *content["values"])


def _bind(content: dict[str, Any]) -> bytes:
    made = [_CONTENTS[child["type"]](child["content"]) for child in content["children"]]
    pairs = list(zip(content["children"], made, strict=True))
    head = b"".join(_text(child["type"], 12) + struct.pack(">Q", len(data)) for child, data in pairs)
    names = b"".join(child["name"].encode() + b"\0" for child, _ in pairs)
    padded = names + bytes(len(names) % 2)
    return _u16s([len(pairs)]) + head + _u16s([len(padded)]) + padded + b"".join(d + bytes(len(d) % 2) for d in made)


def _polydata(content: dict[str, Any]) -> bytes:
    kinds = [content[key] for key in ("vertices", "lines", "polygons", "triangle_strips")]
    cells = [b"".join(struct.pack(f">{len(one) + 1}I", len(one), *one) for one in kind) for kind in kinds]
    counts = [word for kind, data in zip(kinds, cells, strict=True) for word in (len(kind), len(data))]
    attributes = content["attributes"]
    head = struct.pack(">10I", content["num_points"], *counts, len(attributes))
    points = b"".join(map(_floats, content["points"]))
    table = b"".join(struct.pack(">BBI", one["type"], one["ncomponents"], one["n"]) for one in attributes)
    names = b"".join(one["name"].encode() + b"\0" for one in attributes)
    values = b"".join(_floats(one["data"]) for one in attributes)
    return head + points + b"".join(cells) + table + names + bytes(len(names) % 2) + values


def _elements(element: Callable[[dict[str, Any]], bytes]) -> Callable[[dict[str, Any]], bytes]:
    return lambda content: b"".join(map(element, content["elements"]))


def _image_meta(one: dict[str, Any]) -> bytes:
    texts = _text(one["name"], 64) + _text(one["device_name"], 20) + _text(one["modality"], 32)
    patient = _text(one["patient_name"], 64) + _text(one["patient_id"], 64)
    return texts + patient + struct.pack(">Q3HBB", one["timestamp_raw"], *one["size"], one["scalar_type"], 0)


def _label(one: dict[str, Any]) -> bytes:
    label = struct.pack(">BB4B3H", one["label"], 0, *one["rgba"], *one["size"])
    return _text(one["name"], 64) + _text(one["device_name"], 20) + label + _text(one["owner"], 20)


def _point(one: dict[str, Any]) -> bytes:
    place = bytes(one["rgba"]) + _floats([*one["position"], one["diameter"]])
    return _text(one["name"], 64) + _text(one["group"], 32) + place + _text(one["owner"], 20)


def _trajectory(one: dict[str, Any]) -> bytes:
    line = bytes([one["type"], 0, *one["rgba"]]) + _floats([*one["entry"], *one["target"], one["diameter"]])
    return _text(one["name"], 64) + _text(one["group"], 32) + line + _text(one["owner"], 20)


def _video_meta(one: dict[str, Any]) -> bytes:
    texts = b"".join(_text(one[key], 64) for key in ("name", "device_name", "patient_name", "patient_id"))
    lens = struct.pack(">hd3H", one["zoom_level"], one["focal_length"], *one["size"])
    return texts + lens + _floats(one["wire_matrix"]) + bytes([one["scalar_type"], 0])


def _color_table(content: dict[str, Any]) -> bytes:
    return bytes([content["index_type"], content["map_type"], *content["table"]])


def _command(content: dict[str, Any]) -> bytes:
    text = str(content["command"]).encode()
    name = _text(content["command_name"], 128)
    return struct.pack(">I", content["command_id"]) + name + struct.pack(">HI", content["encoding"], len(text)) + text


def _nd_array(content: dict[str, Any]) -> bytes:
    size, data = content["size"], content["data"]
    return bytes([content["scalar_type"], len(size)]) + _u16s(size) + struct.pack(f">{len(data)}d", *data)


def _status(content: dict[str, Any]) -> bytes:
    head = struct.pack(">Hq", content["code"], content["subcode"]) + _text(content["error_name"], 20)
    return head + str(content["status_string"]).encode() + b"\0"


def _string(content: dict[str, Any]) -> bytes:
    text = str(content["string"]).encode()
    return _u16s([content["encoding"], len(text)]) + text


_CONTENTS: dict[str, Callable[[dict[str, Any]], bytes]] = {
    "BIND": _bind,
    "CAPABILITY": lambda content: b"".join(_text(kind, 12) for kind in content["types"]),
    "COLORT": _color_table,
    "COLORTABLE": _color_table,
    "COMMAND": _command,
    "IMAGE": _image,
    "IMGMETA": _elements(_image_meta),
    "LBMETA": _elements(_label),
    "NDARRAY": _nd_array,
    "POINT": _elements(_point),
    "POLYDATA": _polydata,
    "POSITION": lambda content: _floats(content["position"] + content["quaternion"]),
    "SENSOR": _sensor,
    "STATUS": _status,
    "STRING": _string,
    "TDATA": _elements(lambda one: _text(one["name"], 20) + bytes([one["type"], 0]) + _matrix(one["matrix"])),
    "TRAJ": _elements(_trajectory),
    "TRANSFORM": lambda content: _matrix(content["matrix"]),
    "VIDEOMETA": _elements(_video_meta),
}
