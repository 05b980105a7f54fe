"""Recordings for the programs of these tests, made with the typestore of rosbags."""

from __future__ import annotations

import json
import math
import random
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.typesys import Stores, get_typestore

from igtl_gateway.addon import __version__
from igtl_gateway.addon.reading import Entry, Kind, Qos, SessionFile
from igtl_gateway.addon.settings import Config
from igtl_gateway.addon.writing import SessionWriter
from igtl_gateway.addons.resim.engine import Program, ResimOptions, run

START_NS = 1_700_000_000_000_000_000
MS = 1_000_000
_TYPES = get_typestore(Stores.ROS2_JAZZY)
Row = tuple[int, str, str, Any]
"""Session time in ns since the start, topic, type, message."""


TF = "tf2_msgs/msg/TFMessage"


def message(type_: str, **fields: Any) -> Any:
    """A message of rosbags."""
    return _TYPES.types[type_](**fields)


def cdr(type_: str, content: Any) -> bytes:
    """A message as CDR."""
    return bytes(_TYPES.serialize_cdr(content, type_))


def write(path: Path, rows: Iterable[Row], *, qos: Mapping[str, Qos] = {}, kind: Kind = Kind.ROS_OUT) -> Path:
    """Write a session with ROS messages."""
    rows = list(rows)
    return write_both(path, *([], rows) if kind is Kind.ROS_IN else (rows, []), qos=qos)


def write_both(path: Path, sent: Iterable[Row], received: Iterable[Row], *, qos: Mapping[str, Qos] = {}) -> Path:
    """Write a session with ROS messages that the gateway ``sent``, and that it ``received`` from others."""
    facts = {"config": json.dumps(Config().to_dict()), "igtl_gateway_version": __version__}
    writer = SessionWriter(path, facts, qos_of=lambda topic, _type: qos.get(topic), overwrite=True)
    rows = [*((Kind.ROS_OUT, row) for row in sent), *((Kind.ROS_IN, row) for row in received)]
    last_ns = 0
    for number, (kind, (ns, topic, type_, content)) in enumerate(sorted(rows, key=lambda each: each[1][0]), 1):
        last_ns = max(last_ns + 1, START_NS + ns)
        writer.write(Entry(number, last_ns, kind, topic, type_, (cdr(type_, content),)))
    writer.close({})
    return path


def live(path: Path, count: int, command: list[str], lead_ms: int) -> Path:
    """Write a session with poses, and with what a program published that began this much earlier."""
    source = write(path, poses(count))
    result = run(source, [Program(tuple(command))], ResimOptions(runs=1, lead_ns=lead_ms * MS), path.parent)
    assert not result.fault, result.fault
    with SessionFile.open(result.runs[0].outputs) as file:
        found = [
            (each.stamp_ns - START_NS, each.channel, each.type, _TYPES.deserialize_cdr(each.data(), each.type))
            for each in file.entries()
            if each.channel in ("/sample", "/plan")
        ]
    return write_both(path, poses(count), found)


def texts(count: int, topic: str = "/in", *, seed: int = 1) -> list[Row]:
    """Strings at random times, 20 ms apart on average, and a second later the end of the session."""
    chance, ns, rows = random.Random(seed), 0, []
    for number in range(count):
        ns += chance.randint(1 * MS, 40 * MS)
        rows.append((ns, topic, "std_msgs/msg/String", message("std_msgs/msg/String", data=f"m{number}")))
    return [*rows, (ns + 1000 * MS, "/end", "std_msgs/msg/String", message("std_msgs/msg/String", data="end"))]


def stamp(ns: int) -> Any:
    return message("builtin_interfaces/msg/Time", sec=(START_NS + ns) // 10**9, nanosec=(START_NS + ns) % 10**9)


def header(ns: int, frame: str) -> Any:
    return message("std_msgs/msg/Header", stamp=stamp(ns), frame_id=frame)


def poses(count: int, topic: str = "/pose", *, period_ns: int = 10 * MS) -> list[Row]:
    """A tool that moves on a circle."""
    rows = []
    for number in range(count):
        ns, angle = number * period_ns, number / 50
        position = message("geometry_msgs/msg/Vector3", x=math.cos(angle), y=math.sin(angle), z=0.1)
        rotation = message("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=math.sin(angle / 2), w=math.cos(angle / 2))
        transform = message("geometry_msgs/msg/Transform", translation=position, rotation=rotation)
        content = message(
            "geometry_msgs/msg/TransformStamped",
            header=header(ns, "base"), child_frame_id="tool", transform=transform,
        )  # fmt: skip
        rows.append((ns, topic, "geometry_msgs/msg/TransformStamped", content))
    return rows


def transforms(*each: Any) -> Any:
    return message(TF, transforms=list(each))


def images(count: int, topic: str = "/image", *, period_ns: int = 50 * MS) -> list[Row]:
    """Small pictures, each 3 ms after a pose."""
    rows = []
    for number in range(count):
        ns = number * period_ns + 3 * MS
        data = np.full(12, number, np.uint8)
        content = message(
            "sensor_msgs/msg/Image",
            header=header(ns, "camera"), height=3, width=4, encoding="mono8", is_bigendian=0, step=4, data=data,
        )  # fmt: skip
        rows.append((ns, topic, "sensor_msgs/msg/Image", content))
    return rows
