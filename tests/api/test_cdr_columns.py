"""Columns of ROS messages against rosbags, one message at a time."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore

from igtl_gateway.api.cdr_columns import NotColumns, ros_columns, unit_text
from igtl_gateway.api.columns import name_ros_fields
from igtl_gateway.base.untrusted.decoding import MessageDecoder
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.record.sessionfile.bulk import MessageBlock, block_of
from igtl_gateway.record.sessionfile.reader import SessionFile
from tests.places import FIXTURES

STORE = get_typestore(Stores.ROS2_JAZZY)


def flat(place: str, value: Any) -> dict[str, Any]:
    if not isinstance(value, dict):
        return {place: value}
    return {
        key: each for name, inner in value.items() for key, each in flat(f"{place}.{name}".strip("."), inner).items()
    }


def value_of(column: Any, row: int) -> Any:
    if column.is_text:
        return column.text(row)
    if column.offsets is None:
        return column.values[row]
    values = column.values[column.offsets[row] : column.offsets[row + 1]]
    if values.dtype.names:
        return [dict(zip(values.dtype.names, each, strict=True)) for each in values.tolist()]
    return values


def is_equal(found: Any, expected: Any) -> bool:
    if isinstance(expected, list) and expected and isinstance(expected[0], dict):
        names = [list(each) for each in expected]
        return [list(each) for each in found] == names and all(
            np.array_equal(one[name], two[name], equal_nan=True)
            for one, two in zip(found, expected, strict=True)
            for name in two
        )
    return np.array_equal(found, expected, equal_nan=not isinstance(expected, str | list))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["star", "every-type", "lego"])
def test_columns_are_the_fields_that_rosbags_decodes(name: str) -> None:
    compared = set()
    with SessionFile.open(FIXTURES / f"{name}.mcap") as file:
        decoder = MessageDecoder(lambda ros_type: file.definitions.get(ros_type, ""))
        for channel in file.channels:
            if channel.kind not in (Kind.ROS_IN, Kind.ROS_OUT) or not channel.count:
                continue
            store = decoder.store(channel.type)
            for block in file.blocks(channel):
                try:
                    columns = ros_columns(block, store.fielddefs, channel.type)
                except NotColumns:
                    continue
                compared.add(channel.type)
                for row in range(0, len(block), 1 + len(block) // 20):
                    message = decoder.decode(channel.type, bytes(block.payload(row)))
                    fields = flat("", name_ros_fields(store, message))
                    assert [column.name for column in columns] == list(fields)
                    for column in columns:
                        assert is_equal(value_of(column, row), fields[column.name]), column.name
    assert "geometry_msgs/msg/TransformStamped" in compared


def block(ros_type: str, *messages: Any) -> MessageBlock:
    data = [bytes(STORE.serialize_cdr(message, ros_type)) for message in messages]
    return block_of(
        [Entry(number, number, Kind.ROS_IN, "/a", ros_type, (each,)) for number, each in enumerate(data, 1)]
    )


def camera_info(frame: str, d: list[float]) -> Any:
    types = STORE.types
    header = types["std_msgs/msg/Header"](types["builtin_interfaces/msg/Time"](1, 2), frame)
    roi = types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, True)
    matrix = np.arange(12.0)
    return types["sensor_msgs/msg/CameraInfo"](
        header, 3, 4, "plumb", np.array(d), matrix[:9], matrix[:9], matrix, 1, 2, roi
    )


def test_strings_and_sequences_may_have_any_length() -> None:
    ros_type = "sensor_msgs/msg/CameraInfo"
    given = [camera_info("a", []), camera_info("äöü", [1.0]), camera_info("", [1.0, 2.0, 3.0])]
    columns = {column.name: column for column in ros_columns(block(ros_type, *given), STORE.fielddefs, ros_type)}
    assert columns["header.frame_id"].texts() == ["a", "äöü", ""]
    assert [value_of(columns["d"], row).tolist() for row in range(3)] == [[], [1.0], [1.0, 2.0, 3.0]]
    assert columns["k"].values.tolist() == [list(range(9))] * 3
    assert columns["header.stamp_ns"].values.tolist() == [1_000_000_002] * 3
    assert columns["roi.do_rectify"].values.tolist() == [True] * 3


def test_units_are_those_of_the_definitions() -> None:
    twist = STORE.types["geometry_msgs/msg/Twist"]
    vector = STORE.types["geometry_msgs/msg/Vector3"]
    given = block("geometry_msgs/msg/Twist", twist(vector(1.0, 2.0, 3.0), vector(4.0, 5.0, 6.0)))
    columns = ros_columns(given, STORE.fielddefs, "geometry_msgs/msg/Twist")
    assert [(column.name, column.unit) for column in columns[::3]] == [
        ("linear.x_m_s", "m/s"),
        ("angular.x_rad_s", "rad/s"),
    ]
    assert unit_text("Nm") == "N m"


def test_what_does_not_fit_is_for_the_decoder_of_single_messages() -> None:
    text = STORE.types["std_msgs/msg/String"]
    good = block("std_msgs/msg/String", text("abc"), text("abcdef"))
    cut = MessageBlock(good.data, good.begins, good.ends - 2, good.numbers, good.times, good.source_times)
    with pytest.raises(NotColumns):
        ros_columns(cut, STORE.fielddefs, "std_msgs/msg/String")
    not_utf8 = good.data.copy()
    not_utf8[int(good.begins[0]) + 8] = 0xFF
    with pytest.raises(NotColumns):
        ros_columns(
            MessageBlock(not_utf8, good.begins, good.ends, good.numbers, good.times, good.source_times),
            STORE.fielddefs,
            "std_msgs/msg/String",
        )
    with pytest.raises(NotColumns):
        ros_columns(good, STORE.fielddefs, "sensor_msgs/msg/PointCloud2")


@pytest.mark.parametrize("data", [b"\0\0\0\0", b"\2\0\0\0ab", b"\3\0\0\0a\0"])
def test_a_string_without_its_end_is_decoded_alone(data: bytes) -> None:
    """rosbags refuses it."""
    ros_type = "std_msgs/msg/String"
    given = block_of([Entry(1, 1, Kind.ROS_IN, "/a", ros_type, (b"\0\1\0\0" + data,))])
    with pytest.raises(NotColumns):
        ros_columns(given, STORE.fielddefs, ros_type)
