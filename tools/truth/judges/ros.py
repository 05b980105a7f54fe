"""Messages of ROS as rosbags, mcap-ros2-support and rclpy give them: objects with the fields of the definition."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from tools.truth import world
from tools.truth.judges.samples import Sample, posed, ros_picture


def of_message(message: Any, topic: str, kind: str, source_ns: int = 0, time_ns: int = 0) -> Iterator[Sample]:
    """The samples of a message of a topic; ``kind`` is its type without its package."""
    stamp_ns = _stamp(message)

    def sample(of: str, value: Any, name: str | None = "", stamp: int = stamp_ns) -> Sample:
        return Sample(topic, name, of, value, source_ns, stamp, time_ns)

    if kind == "PoseStamped":
        yield sample("pose", _pose(message.pose))
    elif kind == "TransformStamped":
        yield sample("pose", _transform(message.transform), message.child_frame_id)
    elif kind == "TFMessage":
        for each in message.transforms:
            static = each.child_frame_id == "camera"
            value = _transform(each.transform)
            yield sample(
                "static" if static else "pose", value[:3, 3] if static else value, each.child_frame_id, _stamp(each)
            )
    elif kind == "PoseArray":
        for each in message.poses:
            yield sample("pose", _pose(each), None)
    elif kind == "TrackingData":
        for each in message.tools:
            yield sample("pose", _pose(each.pose), each.name)
    elif kind == "JointState":
        for name, angle in zip(message.name, message.position, strict=True):
            yield sample("joint", float(angle), name)
    elif kind == "Image":
        found = ros_picture(message.encoding, message.height, message.width, message.data)
        if found:
            yield sample(*found)
    elif kind == "PointCloud2":
        points = _points(message)
        if len(points) == world.POINTS:
            yield sample("cloud", points)
    elif kind == "PointList":
        for each in message.points:
            yield sample("plan", [each.position.x * 1000, each.position.y * 1000, each.position.z * 1000], each.name)
    elif kind in ("Mesh", "PolyData"):
        vertices = message.vertices if kind == "Mesh" else message.points
        if len(vertices) == world.POINTS:
            yield sample("cloud", np.array([[one.x, one.y, one.z] for one in vertices]) * 1000)
    elif kind == "String" and message.data.startswith("at "):
        yield sample("text", message.data)


def _stamp(message: Any) -> int:
    header = getattr(message, "header", None)
    return header.stamp.sec * 10**9 + header.stamp.nanosec if header is not None else 0


def _pose(pose: Any) -> Any:
    place, turn = pose.position, pose.orientation
    return posed([place.x * 1000, place.y * 1000, place.z * 1000], (turn.x, turn.y, turn.z, turn.w))


def _transform(transform: Any) -> Any:
    place, turn = transform.translation, transform.rotation
    return posed([place.x * 1000, place.y * 1000, place.z * 1000], (turn.x, turn.y, turn.z, turn.w))


def _points(message: Any) -> Any:
    at = {each.name: each.offset for each in message.fields}
    layout = np.dtype(
        {
            "names": list("xyz"),
            "formats": ["<f4"] * 3,
            "offsets": [at[axis] for axis in "xyz"],
            "itemsize": message.point_step,
        }
    )
    values = np.frombuffer(bytes(message.data), layout)
    return np.stack([values[axis] for axis in "xyz"], 1).astype(float) * 1000


def by_rosbags(folder: Path) -> Iterator[Sample]:
    """A bag by rosbags, with the definitions that are in it."""
    with Reader(folder) as bag:
        store = get_typestore(Stores.EMPTY)
        for connection in bag.connections:
            store.register(get_types_from_msg(connection.msgdef.data, connection.msgtype))
        for connection, time_ns, data in bag.messages():
            message = store.deserialize_cdr(data, connection.msgtype)
            yield from of_message(message, connection.topic, connection.msgtype.rpartition("/")[2], 0, time_ns)


def by_mcap(folder: Path) -> Iterator[Sample]:
    """The same by the readers of MCAP, which also know when a message was published."""
    for path in sorted(folder.glob("*.mcap")):
        with path.open("rb") as stream:
            reader = make_reader(stream, decoder_factories=[DecoderFactory()])
            for schema, channel, message, decoded in reader.iter_decoded_messages():
                kind = schema.name.rpartition("/")[2] if schema else ""
                source_ns = message.publish_time if message.publish_time != message.log_time else 0
                yield from of_message(decoded, channel.topic, kind, source_ns, message.log_time)
