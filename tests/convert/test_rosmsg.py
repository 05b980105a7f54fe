"""ROS messages: byte for byte what an independent serialiser writes, and nothing but ConversionError for garbage."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from rosbags.typesys import Stores, get_typestore

from igtl_gateway.base.errors import ConversionError
from igtl_gateway.base.stamp import ns_to_ros
from igtl_gateway.convert import rosmsg
from igtl_gateway.convert.rosmsg import RosMessage
from tests import strategies
from tests.tables import table

STORE = get_typestore(Stores.ROS2_JAZZY)
CLASSES: list[type[RosMessage]] = [
    kind for kind in vars(rosmsg).values() if isinstance(kind, type) and isinstance(getattr(kind, "TYPE", None), str)
]
TYPES = {kind.TYPE: kind for kind in CLASSES}


def make(kind: str, /, **fields: Any) -> Any:
    return STORE.types[kind](**fields)


def header(value: rosmsg.Header) -> Any:
    sec, nanosec = ns_to_ros(value.stamp_ns)
    return make("std_msgs/msg/Header", stamp=make("builtin_interfaces/msg/Time", sec=sec, nanosec=nanosec),
                frame_id=value.frame_id)  # fmt: skip


def point(values: Any) -> Any:
    return make("geometry_msgs/msg/Point", **dict(zip("xyz", map(float, values), strict=True)))


def vector(values: Any) -> Any:
    return make("geometry_msgs/msg/Vector3", **dict(zip("xyz", map(float, values), strict=True)))


def quaternion(values: Any) -> Any:
    return make("geometry_msgs/msg/Quaternion", **dict(zip("xyzw", map(float, values), strict=True)))


def colour(values: Any) -> Any:
    return make("std_msgs/msg/ColorRGBA", **dict(zip("rgba", map(float, values), strict=True)))


def octets(data: Any) -> Any:
    return np.frombuffer(data, np.uint8)


def theirs(message: Any) -> Any:
    """The same message as an object of rosbags."""
    match message:
        case rosmsg.String():
            return make(message.TYPE, data=message.data)
        case rosmsg.TransformStamped():
            transform = make("geometry_msgs/msg/Transform", translation=vector(message.translation),
                             rotation=quaternion(message.rotation))  # fmt: skip
            return make(message.TYPE, header=header(message.header), child_frame_id=message.child_frame_id,
                        transform=transform)  # fmt: skip
        case rosmsg.PointStamped():
            return make(message.TYPE, header=header(message.header), point=point(message.point))
        case rosmsg.Image():
            return make(message.TYPE, header=header(message.header), height=message.height, width=message.width,
                        encoding=message.encoding, is_bigendian=message.is_bigendian, step=message.step,
                        data=octets(message.data))  # fmt: skip
        case rosmsg.PointCloud2():
            fields = [
                make("sensor_msgs/msg/PointField", name=f.name, offset=f.offset, datatype=f.datatype, count=f.count)
                for f in message.fields
            ]
            return make(message.TYPE, header=header(message.header), height=message.height, width=message.width,
                        fields=fields, is_bigendian=message.is_bigendian, point_step=message.point_step,
                        row_step=message.row_step, data=octets(message.data), is_dense=message.is_dense)  # fmt: skip
        case rosmsg.Mesh():
            triangles = [
                make("shape_msgs/msg/MeshTriangle", vertex_indices=row.astype(np.uint32)) for row in message.triangles
            ]
            return make(message.TYPE, triangles=triangles, vertices=[point(row) for row in message.vertices])
        case rosmsg.DiagnosticStatus():
            values = [make("diagnostic_msgs/msg/KeyValue", key=key, value=value) for key, value in message.values]
            return make(message.TYPE, level=message.level, name=message.name, message=message.message,
                        hardware_id=message.hardware_id, values=values)  # fmt: skip
        case rosmsg.Marker():
            pose = make("geometry_msgs/msg/Pose", position=point(message.position),
                        orientation=quaternion(message.orientation))  # fmt: skip
            empty = header(rosmsg.Header())
            return make(
                message.TYPE, header=header(message.header), ns=message.ns, id=message.id, type=message.type,
                action=message.action, pose=pose, scale=vector(message.scale), color=colour(message.color),
                lifetime=make("builtin_interfaces/msg/Duration", sec=0, nanosec=0), frame_locked=False,
                points=[point(row) for row in message.points], colors=[colour(row) for row in message.colors],
                texture_resource="", texture=make("sensor_msgs/msg/CompressedImage", header=empty, format="",
                                                  data=octets(b"")),
                uv_coordinates=[], text=message.text, mesh_resource="",
                mesh_file=make("visualization_msgs/msg/MeshFile", filename="", data=octets(b"")),
                mesh_use_embedded_materials=False,
            )  # fmt: skip
    raise AssertionError(message)


def test_every_type_has_a_strategy() -> None:
    assert TYPES.keys() == strategies.ros_messages().keys()


@table("name", sorted(TYPES))
def test_bytes_are_those_of_rosbags(name: str) -> None:
    @given(strategies.ros_messages(strategies.finite64)[name])
    def run(message: RosMessage) -> None:
        assert message.pack() == bytes(STORE.serialize_cdr(theirs(message), name))

    run()


@pytest.mark.slow
@table("little", [True, False], ids=["little", "big"])
@table("name", sorted(TYPES))
def test_reading_both_byte_orders(name: str, little: bool) -> None:
    @given(strategies.ros_messages(strategies.finite64)[name])
    def run(message: RosMessage) -> None:
        data = bytes(STORE.serialize_cdr(theirs(message), name, little_endian=little))
        assert TYPES[name].unpack(data).pack() == message.pack()

    run()


@table("name", sorted(TYPES))
def test_garbage_raises_only_conversion_errors(name: str) -> None:
    @given(strategies.packed(name))
    def run(data: bytes) -> None:
        try:
            message = TYPES[name].unpack(data)
        except ConversionError:
            return
        message.pack()

    run()


@pytest.mark.ros
@table("name", sorted(TYPES))
def test_what_rclpy_serialises_is_read(name: str) -> None:
    """Its padding is not zero, so the values count, not the bytes."""
    serialization = pytest.importorskip("rclpy.serialization")
    package, _, last = name.partition("/msg/")
    kind = getattr(pytest.importorskip(f"{package}.msg"), last)

    @given(strategies.ros_messages(strategies.finite64)[name])
    def run(message: RosMessage) -> None:
        native = serialization.deserialize_message(message.pack(), kind)
        assert TYPES[name].unpack(serialization.serialize_message(native)).pack() == message.pack()

    run()


def test_arrays_are_views_on_what_was_received() -> None:
    data = rosmsg.Mesh(np.zeros((2, 3), np.uint32), np.zeros((3, 3))).pack()
    received = np.frombuffer(data, np.uint8)
    mesh = rosmsg.Mesh.unpack(data)
    assert np.shares_memory(mesh.vertices, received)
    assert np.shares_memory(mesh.triangles, received)
    data = rosmsg.Image(rosmsg.Header(), 1, 3, "mono8", 0, 3, b"abc").pack()
    image = rosmsg.Image.unpack(data)
    assert np.shares_memory(np.frombuffer(image.data, np.uint8), np.frombuffer(data, np.uint8))
