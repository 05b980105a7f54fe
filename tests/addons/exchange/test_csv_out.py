"""CSV tables: columns with units, all columns of all messages, foreign text, and what is no table."""

from __future__ import annotations

import csv
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.writer import Writer
from rosbags.typesys import Stores, get_typestore

from igtl_gateway.addons.exchange.account import ExportAccount
from igtl_gateway.addons.exchange.targets import export_to
from igtl_gateway.base.buffers import join
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.record.sessionfile.writer import SessionWriter
from igtl_gateway.wire import Message, encode
from igtl_gateway.wire.body import Body
from igtl_gateway.wire.text import String
from igtl_gateway.wire.tracking import QTRACKING_DTYPE, TRACKING_DTYPE, QuaternionTrackingData, TrackingData
from igtl_gateway.wire.transform import Position, Transform

ROS2 = get_typestore(Stores.ROS2_JAZZY)
NS_PER_S = 10**9


def peer(device: str, kind: str, content: Body, version: int = 1) -> Entry:
    data = join(encode(Message(kind, device, content, header_version=version)))
    return Entry(0, 0, Kind.IGTL_OUT, f"{kind}/{device}", kind, (data,), (version,))


def topic(name: str, ros_type: str, message: Any) -> Entry:
    return Entry(0, 0, Kind.ROS_IN, name, ros_type, (bytes(ROS2.serialize_cdr(message, ros_type)),))


def ros(name: str, **fields: Any) -> Any:
    return ROS2.types[name](**fields)


def exported(tmp_path: Path, to: str, *given: Entry) -> tuple[dict[str, list[dict[str, str]]], ExportAccount]:
    """The tables of a session with these entries, by name of the file."""
    path = tmp_path / "some.mcap"
    writer = SessionWriter(path, {})
    for number, entry in enumerate(given, 1):
        writer.write(
            Entry(number, number, entry.kind, entry.channel, entry.type, entry.payload, entry.links, entry.source_ns)
        )
    writer.close({})
    with SessionFile.open(path) as file:
        account = export_to(to, file, tmp_path / "out", ())
    tables = {}
    for made in sorted((tmp_path / "out").iterdir()):
        with made.open(encoding="utf-8", newline="") as stream:
            tables[made.stem.partition(".")[2]] = list(csv.DictReader(stream, strict=True))
    return tables, account


def numbers(row: dict[str, str], *names: str) -> list[float]:
    return [float(row[name]) for name in names]


def test_poses_of_openigtlink_are_in_millimetres(tmp_path: Path) -> None:
    turned = Transform((0, 1, 0, -1, 0, 0, 0, 0, 1, 10.0, 20.0, 30.0))
    tools = TrackingData(np.array([(b"Probe", 2, 0, turned.wire_matrix)], TRACKING_DTYPE))
    probe = (b"Probe", 2, 0, (1.0, 2.0, 3.0), (0.5, 0.5, 0.5, 0.5))
    positions = QuaternionTrackingData(np.array([probe], QTRACKING_DTYPE))
    tables, _ = exported(
        tmp_path,
        "csv",
        peer("AToB", "TRANSFORM", turned),
        peer("P", "POSITION", Position((1.0, 2.0, 3.0), (0.5, 0.5, 0.5, 0.5))),
        peer("T", "TDATA", tools),
        peer("Q", "QTDATA", positions),
    )
    (pose,) = tables["TRANSFORM_AToB"]
    root = 0.5**0.5
    assert numbers(pose, "x_mm", "y_mm", "z_mm") == [10, 20, 30]
    assert numbers(pose, "qx", "qy", "qz", "qw") == pytest.approx([0, 0, root, root])
    assert numbers(pose, "r11", "r12", "r13", "r21", "r22", "r23", "r31", "r32", "r33") == [0, -1, 0, 1, 0, 0, 0, 0, 1]
    (tool,) = tables["TDATA_T"]
    assert numbers(tool, "elements.x_mm", "elements.y_mm", "elements.z_mm") == [10, 20, 30]
    assert numbers(tool, "elements.r12", "elements.r21") == [-1, 1]
    (position,) = tables["POSITION_P"]
    assert numbers(position, "position.x_mm", "position.y_mm", "position.z_mm", "quaternion.w") == [1, 2, 3, 0.5]
    (element,) = tables["QTDATA_Q"]
    assert numbers(element, "elements.position.z_mm", "elements.quaternion.w") == [3, 0.5]


def test_numbers_of_ros_have_the_unit_of_their_field(tmp_path: Path) -> None:
    vector = ROS2.types["geometry_msgs/msg/Vector3"]
    time = ros("builtin_interfaces/msg/Time", sec=3, nanosec=4)
    header = ros("std_msgs/msg/Header", stamp=time, frame_id="here")
    rotation = ros("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0)
    covariance = np.zeros(9)
    corner = ros("geometry_msgs/msg/Point32", x=1.0, y=2.0, z=3.0)
    tables, _ = exported(
        tmp_path,
        "csv",
        topic(
            "/speed",
            "geometry_msgs/msg/TwistStamped",
            ros(
                "geometry_msgs/msg/TwistStamped",
                header=header,
                twist=ros("geometry_msgs/msg/Twist", linear=vector(1.0, 2.0, 3.0), angular=vector(4.0, 5.0, 6.0)),
            ),
        ),
        topic(
            "/wrench",
            "geometry_msgs/msg/Wrench",
            ros("geometry_msgs/msg/Wrench", force=vector(1.0, 0.0, 0.0), torque=vector(2.0, 0.0, 0.0)),
        ),
        topic(
            "/imu",
            "sensor_msgs/msg/Imu",
            ros(
                "sensor_msgs/msg/Imu",
                header=header,
                orientation=rotation,
                orientation_covariance=covariance,
                angular_velocity=vector(1.0, 0.0, 0.0),
                angular_velocity_covariance=covariance,
                linear_acceleration=vector(2.0, 0.0, 0.0),
                linear_acceleration_covariance=covariance,
            ),
        ),
        topic("/arrow", "geometry_msgs/msg/Vector3", vector(1.0, 0.0, 0.0)),
        topic("/polygon", "geometry_msgs/msg/Polygon", ros("geometry_msgs/msg/Polygon", points=[corner])),
    )  # fmt: skip
    (speed,) = tables["speed"]
    assert numbers(speed, "twist.linear.z_m_s", "twist.angular.x_rad_s") == [3, 4]
    assert speed["header.stamp_ns"] == str(3 * NS_PER_S + 4)
    assert speed["header.frame_id"] == "here"
    assert numbers(tables["wrench"][0], "force.x_N", "torque.x_Nm") == [1, 2]
    assert numbers(tables["imu"][0], "orientation.w", "angular_velocity.x_rad_s", "linear_acceleration.x_m_s2") == [
        1,
        1,
        2,
    ]
    assert tables["arrow"][0]["x"] == "1.0"  # the message does not define what the arrow shows
    assert numbers(tables["polygon"][0], "points.x_m") == [1]


def test_a_table_has_the_columns_of_all_its_messages(tmp_path: Path) -> None:
    name = "std_msgs/msg/Float64MultiArray"
    layout = ros("std_msgs/msg/MultiArrayLayout", dim=[], data_offset=0)
    rows = [topic("/row", name, ros(name, layout=layout, data=np.arange(count, dtype=float))) for count in (1, 3, 2)]
    tables, account = exported(tmp_path, "csv", *rows)
    assert [[row[f"data.{index}"] for index in range(3)] for row in tables["row"]] == [
        ["0.0", "", ""],
        ["0.0", "1.0", "2.0"],
        ["0.0", "1.0", ""],
    ]
    assert [(row.declared, row.taken, row.why) for row in account.rows] == [(3, 3, "")]


def test_a_long_message_costs_itself_only(tmp_path: Path) -> None:
    name = "std_msgs/msg/Float64MultiArray"
    layout = ros("std_msgs/msg/MultiArrayLayout", dim=[], data_offset=0)
    rows = [topic("/row", name, ros(name, layout=layout, data=np.arange(count, dtype=float))) for count in (65, 2, 66)]
    tables, account = exported(tmp_path, "csv", *rows)
    assert len(tables["row"]) == 1
    (row,) = account.rows
    assert (row.declared, row.taken, row.left_out, row.failed) == (3, 1, 2, 0)


def test_distinct_messages_after_one_input_are_all_there(tmp_path: Path) -> None:
    same = [peer("Said", "STRING", String.of("a"), version) for version in (1, 2)]
    other = [peer("Said", "STRING", String.of("b"), version) for version in (1, 2, 2)]
    tables, account = exported(tmp_path, "csv", *same, *other)
    assert [row["string"] for row in tables["STRING_Said"]] == ["a", "b"]
    (row,) = account.rows
    assert (row.declared, row.taken, row.left_out) == (5, 2, 3)
    assert row.why == "the same message in another header version"
    assert row.good


@pytest.mark.parametrize("text", ["=1+1", "+1", "-1", "@SUM(A1)", "\t=1", "\r=1"])
def test_formulas_are_kept_and_told(tmp_path: Path, text: str) -> None:
    tables, account = exported(
        tmp_path, "csv", peer("Said", "STRING", String.of(text)), peer("S", "STRING", String.of("a"))
    )
    assert tables["STRING_Said"][0]["string"] == text
    assert account.notes == [
        "text cells that begin with = + - or @: 1; "
        "spreadsheet programs interpret them as formulas; import these columns as text"
    ]


def test_any_text_is_one_cell(tmp_path: Path) -> None:
    text = 'one, "two"\r\nthree;\x1b[2J\tähm\u2028\U0001f600' + "x" * 60_000
    tables, _ = exported(tmp_path, "csv", peer("Said", "STRING", String.of(text)))
    assert [row["string"] for row in tables["STRING_Said"]] == [text]


def test_what_cannot_be_decoded_is_counted_with_its_reason(tmp_path: Path) -> None:
    good = topic("/said", "std_msgs/msg/String", ros("std_msgs/msg/String", data="a"))
    lies = b"\0\1\0\0" + (0xFFFFFFF0).to_bytes(4, "little") + b"a\0"
    bad = [Entry(0, 0, Kind.ROS_IN, "/said", "std_msgs/msg/String", (data,)) for data in (b"", b"\0", lies, lies[:8])]
    tables, account = exported(tmp_path, "csv", *bad, good)
    assert [row["data"] for row in tables["said"]] == ["a"]
    (row,) = account.rows
    assert (row.declared, row.taken, row.left_out, row.failed) == (5, 1, 4, 4)
    assert "cannot be decoded" in row.why
    assert not row.good


def test_a_field_does_not_take_the_place_of_the_entry(tmp_path: Path) -> None:
    path = tmp_path / "foreign.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        schema = writer.register_schema("a/msg/T", "ros2msg", b"uint32 entry\nuint32 item\nuint32 time_ns")
        channel = writer.register_channel("/t", "cdr", schema)
        writer.add_message(channel, 5, b"\0\1\0\0" + struct.pack("<III", 7, 8, 9), 5)
        writer.finish()  # type: ignore[no-untyped-call]
    with SessionFile.open(path) as file:
        export_to("csv", file, tmp_path / "out", ())
    (made,) = (tmp_path / "out").iterdir()
    assert made.read_text().splitlines() == ["entry,time_ns,source_ns,entry_,item_,time_ns_", "1,5,,7,8,9"]


def test_what_every_row_repeats_is_bounded(tmp_path: Path) -> None:
    status, text = ROS2.types["diagnostic_msgs/msg/DiagnosticStatus"], "x" * 100_000
    value = ros("diagnostic_msgs/msg/KeyValue", key="a", value="b")
    given = [
        topic("/s", status.__msgtype__, status(level=0, name="", message=text, hardware_id="", values=[value] * count))
        for count in (1, 1_000)
    ]
    tables, account = exported(tmp_path, "csv", *given)
    assert len(tables["s"]) == 1
    (row,) = account.rows
    assert (row.taken, row.left_out, row.failed) == (1, 1, 0)
    assert "--limit ratio" in row.why
