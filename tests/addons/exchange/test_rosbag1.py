"""ROS 1 bags: written by rosbags, read by us, decoded by rosbags again."""

from __future__ import annotations

import struct
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap_ros2._dynamic import generate_dynamic
from mcap_ros2._vendor.rosidl_adapter.parser import InvalidResourceName
from rosbags.rosbag1 import Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from igtl_gateway.addons.exchange.rosbag1 import Rosbag1
from igtl_gateway.addons.exchange.rostypes import names_not_allowed
from igtl_gateway.base.errors import DamagedRecording
from igtl_gateway.base.qos import Qos
from igtl_gateway.base.untrusted.definitions import parse_definition
from igtl_gateway.gateway.log.entry import Kind
from tests.foreign_bags import grid_map, humanoid, turtles
from tests.integration.hostile_files.bags import bag1
from tests.tables import table

ROS1 = get_typestore(Stores.ROS1_NOETIC)
ROS2 = get_typestore(Stores.ROS2_JAZZY)
PROBE = get_types_from_msg("Header header\ntime taken\nduration[] waits\nfloat32 depth\nstring name\n", "lab/msg/Probe")
ROS1.register(PROBE)

RULE = "=" * 80 + "\n"
EMPTY = f"{RULE}MSG: std_msgs/Empty\n"
HEADER_TEXT = f"{RULE}MSG: std_msgs/Header\nuint32 seq\ntime stamp\nstring frame_id\n"
HEADER = "std_msgs/msg/Header"
TIME = "builtin_interfaces/msg/Time"


def header(seq: int, stamp: int, frame: str) -> Any:
    return ROS1.types[HEADER](seq=seq, stamp=ROS1.types[TIME](sec=stamp, nanosec=5), frame_id=frame)


def bag(path: Path, compression: str = "") -> Path:
    """Two topics with types of ROS 2, one renamed type, one of its own; times that are equal and out of order."""
    writer = Writer(path)
    if compression:
        writer.set_compression(Writer.CompressionFormat[compression])
    with writer:
        point = writer.add_connection("/point", "geometry_msgs/msg/PointStamped", typestore=ROS1, latching=1)
        probe = writer.add_connection("probe", "lab/msg/Probe", typestore=ROS1)
        camera = writer.add_connection("/camera", "sensor_msgs/msg/CameraInfo", typestore=ROS1)
        for index in range(3):
            place = ROS1.types["geometry_msgs/msg/Point"](x=float(index), y=2.0, z=3.0)
            made = ROS1.types["geometry_msgs/msg/PointStamped"](header=header(7, 100 + index, "map"), point=place)
            writer.write(point, 1000 + index // 2, ROS1.serialize_ros1(made, point.msgtype))
        waits = [ROS1.types["builtin_interfaces/msg/Duration"](sec=1, nanosec=2)]
        taken = ROS1.types[TIME](sec=9, nanosec=8)
        made = ROS1.types["lab/msg/Probe"](header=header(8, 7, "f"), taken=taken, waits=waits, depth=1.5, name="näme")
        writer.write(probe, 900, ROS1.serialize_ros1(made, probe.msgtype))
        zone = ROS1.types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
        made = ROS1.types["sensor_msgs/msg/CameraInfo"](
            header(9, 7, "c"), 2, 3, "plumb_bob", np.array([1.0, 2.0]), np.ones(9), np.ones(9), np.ones(12), 0, 0, zone
        )
        writer.write(camera, 2000, ROS1.serialize_ros1(made, camera.msgtype))
    return path


@pytest.mark.parametrize("compression", ["", "BZ2", "LZ4"])
def test_messages_become_those_of_ros_2(tmp_path: Path, compression: str) -> None:
    with closing(Rosbag1(bag(tmp_path / "some.bag", compression))) as source:
        items = list(source.items())
        told = source.definition_of("lab/msg/Probe")
        assert source.qos_of("/point", "geometry_msgs/msg/PointStamped") == Qos(latched=True)
        assert source.qos_of("/probe", "lab/msg/Probe") is None
    assert [(item.channel, item.time_ns) for item in items] == [
        ("/probe", 900),
        ("/point", 1000),
        ("/point", 1000),
        ("/point", 1001),
        ("/camera", 2000),
    ]
    assert {item.kind for item in items} == {Kind.ROS_IN}
    assert all(row.good and row.taken == row.declared for row in source.rows)
    points = [ROS2.deserialize_cdr(bytes(item.payload), item.type) for item in items[1:4]]
    assert [(point.point.x, point.header.stamp.sec) for point in points] == [(0.0, 100), (1.0, 101), (2.0, 102)]  # type: ignore[attr-defined]
    camera = ROS2.deserialize_cdr(bytes(items[4].payload), items[4].type)
    assert list(camera.d) == [1.0, 2.0]  # type: ignore[attr-defined]  # D in ROS 1
    assert told
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(told.data.decode(), "lab/msg/Probe"))
    assert store.hash_rihs01("lab/msg/Probe") == told.type_hash
    probe = store.deserialize_cdr(bytes(items[0].payload), "lab/msg/Probe")
    assert (probe.name, probe.depth, probe.taken.sec, probe.waits[0].nanosec) == ("näme", 1.5, 9, 2)  # type: ignore[attr-defined]
    assert probe.header.frame_id == "f"  # type: ignore[attr-defined]


def test_tf_has_another_name_and_lost_fields_are_named(tmp_path: Path) -> None:
    store = get_typestore(Stores.ROS1_NOETIC)
    store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms\n", "tf/msg/tfMessage"))
    store.fielddefs.pop("geometry_msgs/msg/Twist")
    store.types.pop("geometry_msgs/msg/Twist")
    store.register(
        get_types_from_msg(
            "geometry_msgs/Vector3 linear\ngeometry_msgs/Vector3 angular\nint8 gear\n", "geometry_msgs/msg/Twist"
        )
    )
    vector = store.types["geometry_msgs/msg/Vector3"]
    with Writer(tmp_path / "some.bag") as writer:
        tf = writer.add_connection("/tf", "tf/msg/tfMessage", typestore=store)
        pose = store.types["geometry_msgs/msg/Transform"](
            vector(1.0, 2.0, 3.0), store.types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
        )
        stamped = store.types["geometry_msgs/msg/TransformStamped"](header(1, 7, "map"), "tool", pose)
        writer.write(tf, 5, store.serialize_ros1(store.types["tf/msg/tfMessage"]([stamped]), tf.msgtype))
        twist = writer.add_connection("/speed", "geometry_msgs/msg/Twist", typestore=store)
        made = store.types["geometry_msgs/msg/Twist"](vector(1.0, 2.0, 3.0), vector(4.0, 5.0, 6.0), 3)
        writer.write(twist, 6, store.serialize_ros1(made, twist.msgtype))
    with closing(Rosbag1(tmp_path / "some.bag")) as source:
        frames, speed = source.items()
        assert source.notes == ["geometry_msgs/msg/Twist: ROS 2 has no counterpart of geometry_msgs/msg/Twist.gear"]
    assert frames.type == "tf2_msgs/msg/TFMessage"
    (one,) = ROS2.deserialize_cdr(bytes(frames.payload), frames.type).transforms  # type: ignore[attr-defined]
    assert (one.header.frame_id, one.child_frame_id, one.transform.translation.y) == ("map", "tool", 2.0)
    assert ROS2.deserialize_cdr(bytes(speed.payload), speed.type).angular.z == 6.0  # type: ignore[attr-defined]


def test_a_damaged_chunk_ends_it_with_one_error(tmp_path: Path) -> None:
    path = bag(tmp_path / "some.bag", "BZ2")
    data = bytearray(path.read_bytes())
    start = data.index(b"BZh")
    data[start + 20 : start + 60] = bytes(40)
    path.write_bytes(data)
    with closing(Rosbag1(path)) as source, pytest.raises(DamagedRecording, match=r"some\.bag"):
        list(source.items())


def test_a_bag_that_was_cut_off_is_refused(tmp_path: Path) -> None:
    path = bag(tmp_path / "some.bag")
    path.write_bytes(path.read_bytes()[:5000])
    with pytest.raises(DamagedRecording, match=r"some\.bag"):
        Rosbag1(path)


@pytest.mark.parametrize(
    ("write", "counts"),
    [
        (humanoid, {"/tf": 320, "/clusters/output00": 1}),
        (grid_map, {"/grid_map": 1}),
        (turtles, {"/tf": 268, "/tf_static": 1, "/rosout": 10, "/turtle1/pose": 134}),
    ],
)
def test_bags_of_robots_come_whole(tmp_path: Path, write: Callable[[Path], Path], counts: dict[str, int]) -> None:
    with closing(Rosbag1(write(tmp_path / "some.bag"))) as source:
        assert sum(1 for _ in source.items()) == sum(row.taken for row in source.rows)
    assert all(row.good and not row.left_out for row in source.rows)
    assert counts.items() <= {row.stream: row.taken for row in source.rows}.items()


@pytest.mark.parametrize(
    ("definition", "before"),
    [
        (f"std_msgs/Empty[] e\n{EMPTY}", b""),
        (f"Header h\ntime t\nduration[] d\nstd_msgs/Empty[] e\n{HEADER_TEXT}{EMPTY}", bytes(28)),
        # other fields than those of ROS 2: the message is built from objects
        (f"lab/B b\n{RULE}MSG: lab/B\nHeader h\nstd_msgs/Empty[] e\n{HEADER_TEXT}{EMPTY}", bytes(16)),
    ],
)
def test_an_array_of_messages_without_bytes_is_counted(tmp_path: Path, definition: str, before: bytes) -> None:
    """4.8 kB state 2^32 - 1 elements: refused before the first is read, and the same bag with 3 of them is read."""
    path = tmp_path / "empty.bag"
    for count, taken in (((1 << 32) - 1, 0), (3, 1)):
        path.write_bytes(bag1(kind="lab/Thing", definition=definition, message=before + struct.pack("<I", count)))
        with closing(Rosbag1(path)) as source:
            assert len(list(source.items())) == taken
            (row,) = source.rows
            assert (row.taken, row.declared) == (taken, 1)
            assert ("LimitExceeded" in row.why) == (not taken)


def own_bag(path: Path, definition: str, *values: dict[str, Any]) -> Path:
    """A bag with messages of one own type, which has times and durations as ROS 1 has them."""
    store = get_typestore(Stores.ROS1_NOETIC)
    store.register(get_types_from_msg(definition, "lab/msg/Odd"))
    with Writer(path) as writer:
        odd = writer.add_connection("/odd", "lab/msg/Odd", typestore=store)
        for number, fields in enumerate(values, 1):
            writer.write(odd, number, store.serialize_ros1(store.types["lab/msg/Odd"](**fields), odd.msgtype))
    return path


def test_times_beyond_2038_are_missing_and_durations_keep_their_sign(tmp_path: Path) -> None:
    """ROS 1 counts seconds of a time in 32 bits without a sign; ROS 2 with one.  Durations have one in both.

    rosbags writes the bits of these times, as times with a sign.
    """
    made = [
        {"header": header(1, seconds, "f"), "wait": ROS1.types["builtin_interfaces/msg/Duration"](wait, 500_000_000),
         "times": [ROS1.types[TIME](later, 0)]}
        for seconds, wait, later in ((2**31 - 1, -2, 0), (-(2**31), 1, 0), (7, -(2**31), -1), (0, 0, 2**31 - 1))
    ]  # fmt: skip
    path = own_bag(tmp_path / "a.bag", f"std_msgs/Header header\nduration wait\ntime[] times\n{HEADER_TEXT}", *made)
    with closing(Rosbag1(path)) as source:
        items = list(source.items())
        told = source.definition_of("lab/msg/Odd")
    assert [item.time_ns for item in items] == [1, 4]
    (row,) = source.rows
    assert (row.good, row.declared, row.taken) == (False, 4, 2)
    assert "found a time of 4294967295 s" in row.why and "2038" in row.why
    assert told
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(told.data.decode(), "lab/msg/Odd"))
    first: Any = store.deserialize_cdr(bytes(items[0].payload), "lab/msg/Odd")
    assert (first.header.stamp.sec, first.wait.sec, first.wait.nanosec) == (2**31 - 1, -2, 500_000_000)


NAMES = {
    "uint8 Kp\nuint8 kp_2\n": "Odd.Kp",
    "uint8 a_\nuint8 b__c\n": "Odd.a_, Odd.b__c",
    "uint8 fast=1\nuint8 x\n": "Odd.fast",
    f"Lab/low p\nuint8 x\n{RULE}MSG: Lab/low\nuint8 y\n": "Lab/msg/low",
    "uint8 kp\nuint8 A_B2=3\n": "",
}


@table(("definition", "names"), NAMES.items(), ids=NAMES)
def test_names_that_ros_2_does_not_allow_are_said(definition: str, names: str, tmp_path: Path) -> None:
    """The reader of mcap-ros2-support, which has the parser of rosidl, refuses exactly these."""
    text = definition
    found = names_not_allowed(parse_definition(definition, "lab/msg/Odd"), "lab/msg/Odd")
    if "fast" not in definition and "Lab" not in definition:  # rosbags writes no such bag
        with closing(Rosbag1(own_bag(tmp_path / "a.bag", definition))) as source:
            told = source.definition_of("lab/msg/Odd")
            assert source.notes == ([f"lab/msg/Odd: {found}"] if names else [])
        assert told
        text = told.data.decode()
    assert found.partition(": some")[0] == (f"ROS 2 does not allow {names}" if names else "")
    try:
        generate_dynamic("lab/msg/Odd", text)
    except (NameError, InvalidResourceName):
        assert names
    else:
        assert not names
