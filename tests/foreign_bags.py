"""Bags as robots have them: by programs and versions other than the one that the tests use most.

Names, types, connections, storage and metadata are those of published bags; the messages are made here.  ROS 1 is
written by rosbags; rosbag2 by its tables and records, as each version of it did.
"""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
from rosbags.rosbag1 import Writer as Bag1Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

ROS1 = get_typestore(Stores.ROS1_NOETIC)
ROS2 = get_typestore(Stores.ROS2_JAZZY)

_TF = "geometry_msgs/TransformStamped[] transforms\n"
_GRID_MAP_INFO = "Header header\nfloat64 resolution\nfloat64 length_x\nfloat64 length_y\ngeometry_msgs/Pose pose\n"
_GRID_MAP = (
    "grid_map_msgs/GridMapInfo info\nstring[] layers\nstring[] basic_layers\nstd_msgs/Float32MultiArray[] data\n"
    "uint16 outer_start_index\nuint16 inner_start_index\n"
)
for _name, _text in (
    ("tf/msg/tfMessage", _TF),
    ("tf2_msgs/msg/TFMessage", _TF),
    ("turtlesim/msg/Pose", "float32 x\nfloat32 y\nfloat32 theta\nfloat32 linear_velocity\nfloat32 angular_velocity\n"),
    ("turtlesim/msg/Color", "uint8 r\nuint8 g\nuint8 b\n"),
    ("grid_map_msgs/msg/GridMapInfo", _GRID_MAP_INFO),
    ("grid_map_msgs/msg/GridMap", _GRID_MAP),
):
    ROS1.register(get_types_from_msg(_text, _name))

_BASIC = "bool bool_value\nbyte byte_value\nchar char_value\nfloat32 float32_value\nint64 int64_value\n"
_ARRAYS = "bool[3] bool_values\nfloat64[3] float64_values\nstring[3] string_values\n"
for _name, _text in (("test_msgs/msg/BasicTypes", _BASIC), ("test_msgs/msg/Arrays", _ARRAYS)):
    ROS2.register(get_types_from_msg(_text, _name))

START_NS = 1_586_406_456_763_032_325


def _ros1(kind: str, **values: Any) -> Any:
    return ROS1.types[kind](**values)


def _header(number: int, frame: str) -> Any:
    stamp = _ros1("builtin_interfaces/msg/Time", sec=1_400_000_000 + number, nanosec=5)
    return _ros1("std_msgs/msg/Header", seq=number, stamp=stamp, frame_id=frame)


def _transforms(kind: str, number: int, names: list[str]) -> Any:
    vector = _ros1("geometry_msgs/msg/Vector3", x=float(number), y=-1.5, z=0.25)
    turn = _ros1("geometry_msgs/msg/Quaternion", x=0.0, y=0.6, z=0.0, w=0.8)
    moved = _ros1("geometry_msgs/msg/Transform", translation=vector, rotation=turn)
    made = [
        _ros1(
            "geometry_msgs/msg/TransformStamped", header=_header(number, "world"), child_frame_id=name, transform=moved
        )
        for name in names
    ]
    return _ros1(kind, transforms=made)


def turtles(path: Path) -> Path:
    """Turtlesim, packed with bz2, by a program that states no callers: tf by its name of ROS 1, types of its own."""
    writer = Bag1Writer(path)
    writer.set_compression(Bag1Writer.CompressionFormat.BZ2)
    zero = _ros1("geometry_msgs/msg/Vector3", x=1.0, y=0.0, z=0.0)
    line = _ros1(
        "rosgraph_msgs/msg/Log",
        header=_header(0, ""),
        level=2,
        name="/turtlesim",
        msg="Spawning turtle",
        file="turtle_frame.cpp",
        function="spawn",
        line=172,
        topics=["/rosout"],
    )
    pose = _ros1("turtlesim/msg/Pose", x=5.5, y=5.5, theta=0.5, linear_velocity=0.0, angular_velocity=0.0)
    streams: list[tuple[str, Any, int]] = [
        ("/rosout", line, 10),
        ("/turtle1/color_sensor", _ros1("turtlesim/msg/Color", r=69, g=86, b=255), 135),
        ("/tf_static", _transforms("tf2_msgs/msg/TFMessage", 0, ["map"]), 1),
        ("/turtle1/pose", pose, 134),
        ("/tf", _transforms("tf/msg/tfMessage", 1, ["turtle1"]), 268),
        ("/turtle1/cmd_vel", _ros1("geometry_msgs/msg/Twist", linear=zero, angular=zero), 35),
    ]
    with writer:
        for topic, message, count in streams:
            kind = message.__msgtype__
            one = writer.add_connection(topic, kind, typestore=ROS1)
            for index in range(count):
                writer.write(one, START_NS + index * 16_000_000, ROS1.serialize_ros1(message, kind))
    return path


def humanoid(path: Path) -> Path:
    """One topic from many programs, with both names of its type, in some chunks; a cloud with colours."""
    writer = Bag1Writer(path)
    writer.chunk_threshold = 20_000
    cloud = _ros1(
        "sensor_msgs/msg/PointCloud2",
        header=_header(3, "camera"),
        height=1,
        width=1000,
        fields=[
            _ros1("sensor_msgs/msg/PointField", name=name, offset=offset, datatype=7, count=1)
            for name, offset in (("x", 0), ("y", 4), ("z", 8), ("rgb", 16))
        ],
        is_bigendian=False,
        point_step=32,
        row_step=32_000,
        data=np.arange(32_000, dtype=np.uint8),
        is_dense=True,
    )
    callers = [("/state_publisher", 89), ("/footcoords", 143), ("/multisense_driver", 53), ("/multisense_laser", 2)]
    with writer:
        for caller, count in callers:
            one = writer.add_connection("/tf", "tf2_msgs/msg/TFMessage", typestore=ROS1, callerid=caller, latching=0)
            for index in range(count):
                made = _transforms("tf2_msgs/msg/TFMessage", index, [f"link{joint}" for joint in range(5)])
                writer.write(one, START_NS + index * 7_000_000, ROS1.serialize_ros1(made, one.msgtype))
        old = writer.add_connection("/tf", "tf/msg/tfMessage", typestore=ROS1, callerid="/odometry", latching=0)
        for index in range(33):
            made = _transforms("tf/msg/tfMessage", index, ["odom"])
            writer.write(old, START_NS + index * 20_000_000, ROS1.serialize_ros1(made, old.msgtype))
        seen = writer.add_connection("/clusters/output00", cloud.__msgtype__, typestore=ROS1, callerid="/clusters")
        writer.write(seen, START_NS + 10**9, ROS1.serialize_ros1(cloud, seen.msgtype))
    return path


def grid_map(path: Path) -> Path:
    """One message of a type with types of its own and arrays in arrays."""
    dimension = _ros1("std_msgs/msg/MultiArrayDimension", label="column_index", size=50, stride=2500)
    layout = _ros1("std_msgs/msg/MultiArrayLayout", dim=[dimension, dimension], data_offset=0)
    layer = _ros1("std_msgs/msg/Float32MultiArray", layout=layout, data=np.arange(2500, dtype=np.float32))
    place = _ros1("geometry_msgs/msg/Point", x=0.0, y=0.0, z=0.0)
    turn = _ros1("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0)
    info = _ros1(
        "grid_map_msgs/msg/GridMapInfo",
        header=_header(1, "map"),
        resolution=0.02,
        length_x=1.0,
        length_y=1.0,
        pose=_ros1("geometry_msgs/msg/Pose", position=place, orientation=turn),
    )
    message = _ros1(
        "grid_map_msgs/msg/GridMap",
        info=info,
        layers=["elevation", "variance"],
        basic_layers=["elevation"],
        data=[layer, layer],
        outer_start_index=0,
        inner_start_index=0,
    )
    with Bag1Writer(path) as writer:
        one = writer.add_connection("/grid_map", message.__msgtype__, typestore=ROS1)
        writer.write(one, START_NS, ROS1.serialize_ros1(message, one.msgtype))
    return path


# -- rosbag2 ----------------------------------------------------------------------------------------------------------


def _qos(depth: int, durability: int, deadline: tuple[int, int]) -> str:
    never = f"\n    sec: {deadline[0]}\n    nsec: {deadline[1]}"
    return (
        f"- history: 3\n  depth: {depth}\n  reliability: 1\n  durability: {durability}\n  deadline:{never}\n"
        f"  lifespan:{never}\n  liveliness: 1\n  liveliness_lease_duration:{never}\n"
        "  avoid_ros_namespace_conventions: false"
    )


def _cdr(kind: str, **values: Any) -> bytes:
    return bytes(ROS2.serialize_cdr(ROS2.types[kind](**values), kind))


def _metadata(
    version: int,
    storage: str,
    file: str,
    streams: Sequence[tuple[str, str, str | None, int]],
    span_ns: int,
    **more: Any,
) -> str:
    """The text of ``metadata.yaml``: topic, type, quality of service and count of the streams.  JSON is YAML."""
    topics = []
    for topic, kind, qos, count in streams:
        told = {"name": topic, "type": kind, "serialization_format": "cdr"}
        if qos is not None:
            told["offered_qos_profiles"] = qos
        topics.append({"topic_metadata": told, "message_count": count})
    facts = {
        "version": version,
        "storage_identifier": storage,
        "relative_file_paths": [file],
        "duration": {"nanoseconds": span_ns},
        "starting_time": {"nanoseconds_since_epoch": START_NS},
        "message_count": sum(count for *_, count in streams),
        "topics_with_message_count": topics,
        **more,
    }
    return json.dumps({"rosbag2_bagfile_information": facts}, indent=1)


_TOPICS = (
    "CREATE TABLE topics(id INTEGER PRIMARY KEY,name TEXT NOT NULL,type TEXT NOT NULL,"
    "serialization_format TEXT NOT NULL"
)
_MESSAGES = (
    "CREATE TABLE messages(id INTEGER PRIMARY KEY,topic_id INTEGER NOT NULL,timestamp INTEGER NOT NULL, "
    "data BLOB NOT NULL)",
    "CREATE INDEX timestamp_idx ON messages (timestamp ASC)",
)


def dashing(folder: Path) -> Path:
    """Metadata of version 2, as in 2020: sqlite3 without quality of service, and the folder's name in the file's."""
    folder.mkdir()
    header = ROS2.types["std_msgs/msg/Header"](ROS2.types["builtin_interfaces/msg/Time"](1, 2), "base")
    point = ROS2.types["geometry_msgs/msg/Point"](1.0, 2.0, 3.0)
    turn = ROS2.types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
    pose = ROS2.types["geometry_msgs/msg/Pose"](point, turn)
    vector = ROS2.types["geometry_msgs/msg/Vector3"](0.0, 0.1, 0.2)
    nine = np.zeros(9)
    imu = _cdr(
        "sensor_msgs/msg/Imu", header=header, orientation=turn, orientation_covariance=nine, angular_velocity=vector,
        angular_velocity_covariance=nine, linear_acceleration=vector, linear_acceleration_covariance=nine,
    )  # fmt: skip
    log, changes, stamped = (
        "rcl_interfaces/msg/Log",
        "rcl_interfaces/msg/ParameterEvent",
        "geometry_msgs/msg/PoseStamped",
    )
    streams = [
        ("/rosout", log, 0, b""),
        ("/pose", stamped, 156, _cdr(stamped, header=header, pose=pose)),
        ("/parameter_events", changes, 0, b""),
        ("/imu", "sensor_msgs/msg/Imu", 156, imu),
    ]
    with sqlite3.connect(folder / "some_0.db3") as base:
        for statement in (f"{_TOPICS})", *_MESSAGES):
            base.execute(statement)
        for number, (topic, kind, count, data) in enumerate(streams, 1):
            base.execute("INSERT INTO topics VALUES (?, ?, ?, 'cdr')", (number, topic, kind))
            for index in range(count):
                row = (number, START_NS + index * 40_000_000, data)
                base.execute("INSERT INTO messages(topic_id, timestamp, data) VALUES (?, ?, ?)", row)
    base.close()
    told = [(topic, kind, None, count) for topic, kind, count, _ in streams]
    text = _metadata(2, "sqlite3", f"{folder.name}/some_0.db3", told, 155 * 40_000_000)
    (folder / "metadata.yaml").write_text(text, "utf-8")
    return folder


def _basic_and_arrays() -> list[tuple[str, str, str, str, list[bytes]]]:
    """Topic, type, definition, quality of service and messages, as rosbag2's own tests have them."""
    basic = _cdr(
        "test_msgs/msg/BasicTypes", bool_value=True, byte_value=1, char_value=2, float32_value=1.5, int64_value=-3
    )
    arrays = _cdr(
        "test_msgs/msg/Arrays",
        bool_values=np.array([True, False, True]),
        float64_values=np.array([1.0, -2.0, 0.5]),
        string_values=["", "a", "two words"],
    )
    return [
        ("/test_topic", "test_msgs/msg/BasicTypes", _BASIC, _qos(3, 1, (0, 0)), [basic] * 3),
        ("/array_topic", "test_msgs/msg/Arrays", _ARRAYS, _qos(4, 1, (0, 0)), [arrays] * 4),
    ]


def _of_version_7(folder: Path, storage: str, file: str) -> Path:
    streams = [(topic, kind, qos, len(messages)) for topic, kind, _, qos, messages in _basic_and_arrays()]
    one = {
        "path": file,
        "starting_time": {"nanoseconds_since_epoch": START_NS},
        "duration": {"nanoseconds": 151_137_181},
        "message_count": 7,
    }
    more: dict[str, Any] = {"compression_format": "", "compression_mode": "", "files": [one], "custom_data": None}
    (folder / "metadata.yaml").write_text(_metadata(7, storage, file, streams, 151_137_181, **more), "utf-8")
    return folder


def cdr_sqlite3(folder: Path) -> Path:
    """Metadata of version 7 beside sqlite3, whose tables have schema, metadata and definitions; no hashes of types."""
    folder.mkdir()
    with sqlite3.connect(folder / "cdr_test_0.db3") as base:
        for statement in (
            "CREATE TABLE schema(schema_version INTEGER PRIMARY KEY,ros_distro TEXT NOT NULL)",
            "CREATE TABLE metadata(id INTEGER PRIMARY KEY,metadata_version INTEGER NOT NULL,metadata TEXT NOT NULL)",
            f"{_TOPICS},offered_qos_profiles TEXT NOT NULL,type_description_hash TEXT NOT NULL)",
            "CREATE TABLE message_definitions(id INTEGER PRIMARY KEY,topic_type TEXT NOT NULL,encoding TEXT NOT NULL,"
            "encoded_message_definition TEXT NOT NULL,type_description_hash TEXT NOT NULL)",
            *_MESSAGES,
        ):
            base.execute(statement)
        base.execute("INSERT INTO schema VALUES (4, 'rolling')")
        for number, (topic, kind, text, qos, messages) in enumerate(_basic_and_arrays(), 1):
            base.execute("INSERT INTO topics VALUES (?, ?, ?, 'cdr', ?, '')", (number, topic, kind, qos))
            base.execute("INSERT INTO message_definitions VALUES (?, ?, 'ros2msg', ?, '')", (number, kind, text))
            for index, data in enumerate(messages):
                row = (number, START_NS + index * 50_000_000 + number, data)
                base.execute("INSERT INTO messages(topic_id, timestamp, data) VALUES (?, ?, ?)", row)
    base.close()
    return _of_version_7(folder, "sqlite3", "cdr_test_0.db3")


def cdr_mcap(folder: Path) -> Path:
    """The same in MCAP, not compressed."""
    folder.mkdir()
    writer = McapWriter(str(folder / "cdr_test_0.mcap"), compression=CompressionType.NONE)
    writer.start("ros2", "libmcap 0.8.0")
    for topic, kind, text, qos, messages in _basic_and_arrays():
        schema = writer.register_schema(kind, "ros2msg", text.encode())
        channel = writer.register_channel(topic, "cdr", schema, {"offered_qos_profiles": qos, "topic_type_hash": ""})
        for index, data in enumerate(messages):
            stamp = START_NS + index * 50_000_000 + channel
            writer.add_message(channel, stamp, data, stamp)
    writer.finish()  # type: ignore[no-untyped-call]
    return _of_version_7(folder, "mcap", "cdr_test_0.mcap")


def talker(folder: Path) -> Path:
    """Metadata of version 4, without the files' own: MCAP by another program, made from an older recording."""
    folder.mkdir()
    header = {"stamp": ROS2.types["builtin_interfaces/msg/Time"](1, 2), "level": 20, "name": "talker", "msg": "hello"}
    log = _cdr("rcl_interfaces/msg/Log", **header, file="", function="", line=1)
    never = (2147483647, 4294967295)
    streams = [
        ("/topic", "std_msgs/msg/String", _qos(0, 2, never), [_cdr("std_msgs/msg/String", data="Hello World")] * 10),
        ("/rosout", "rcl_interfaces/msg/Log", _qos(0, 1, never), [log] * 10),
        ("/parameter_events", "rcl_interfaces/msg/ParameterEvent", _qos(0, 2, never), []),
    ]
    writer = McapWriter(str(folder / "talker.mcap"))
    writer.start("ros2", "mcap go #(devel)")
    for topic, kind, qos, messages in streams:
        definition, _ = ROS2.generate_msgdef(kind, ros_version=2)
        schema = writer.register_schema(kind, "ros2msg", definition.encode())
        channel = writer.register_channel(topic, "cdr", schema, {"offered_qos_profiles": qos})
        for index, data in enumerate(messages):
            writer.add_message(channel, START_NS + index * 500_000_000, data, START_NS + index * 500_000_000)
    writer.finish()  # type: ignore[no-untyped-call]
    told = [(topic, kind, qos, len(messages)) for topic, kind, qos, messages in streams]
    more = {"compression_format": "", "compression_mode": ""}
    text = _metadata(4, "mcap", "talker.mcap", told, 4_500_000_000, **more)
    (folder / "metadata.yaml").write_text(text, "utf-8")
    return folder


def topics_and_services(path: Path) -> Path:
    """MCAP alone, with the events of services, and rosbag2's metadata in it, at both ends."""
    event = "example_interfaces/srv/AddTwoInts_Event"
    quality = {"offered_qos_profiles": _qos(0, 1, (9223372036, 854775807))}
    header = {"stamp": ROS2.types["builtin_interfaces/msg/Time"](1, 2), "node": "/talker"}
    empty: dict[str, Any] = {key: [] for key in ("new_parameters", "changed_parameters", "deleted_parameters")}
    changes = _cdr("rcl_interfaces/msg/ParameterEvent", **header, **empty)
    streams = [
        ("/rosout", "rcl_interfaces/msg/Log", b"", 0),
        ("/parameter_events", "rcl_interfaces/msg/ParameterEvent", changes, 7),
        ("/add_two_ints2/_service_event", event, b"", 0),
        ("/add_two_ints/_service_event", event, b"\0\1\0\0" + bytes(60), 6),
    ]
    writer = McapWriter(str(path), compression=CompressionType.NONE)
    writer.start("ros2", "libmcap 1.1.0")
    writer.add_metadata("rosbag2", {"serialized_metadata": "version: 8"})
    for topic, kind, data, count in streams:
        text = "int64 a\nint64 b\n---\nint64 sum\n" if kind == event else ROS2.generate_msgdef(kind, ros_version=2)[0]
        schema = writer.register_schema(kind, "ros2msg", text.encode())
        channel = writer.register_channel(topic, "cdr", schema, quality)
        for index in range(count):
            writer.add_message(channel, START_NS + index * 200_000_000, data, START_NS + index * 200_000_000)
    writer.add_metadata("rosbag2", {"serialized_metadata": "version: 8\nmessage_count: 13"})
    writer.finish()  # type: ignore[no-untyped-call]
    return path
