"""The table of conversions holds together."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from igtl_gateway.convert.context import ToIgtlContext, ToRosContext
from igtl_gateway.convert.interfaces import definition_folder
from igtl_gateway.convert.table import TO_IGTL, TO_ROS, ConversionToIgtl, ConversionToRos, row_to_igtl, rows_to_ros
from igtl_gateway.wire.registry import BODIES
from tests import strategies
from tests.tables import table

STORE = get_typestore(Stores.ROS2_JAZZY)
for _package in ("igtl_msgs", "foxglove_msgs", "crtk_msgs"):
    for _path in sorted(definition_folder(_package).glob("msg/*.msg")):
        STORE.register(get_types_from_msg(_path.read_text("utf-8"), f"{_package}/msg/{_path.stem}"))


@table("row", TO_ROS, ids=lambda row: f"{row.igtl_types[0]}-{row.kind}")
def test_rows_to_ros_name_what_exists(row: ConversionToRos) -> None:
    assert row.message.TYPE in STORE.types
    contents = row.content if isinstance(row.content, tuple) else (row.content,)
    assert {BODIES[name] for name in row.igtl_types} == set(contents)
    assert row.kind.isidentifier()
    for name in row.igtl_types:
        assert row in rows_to_ros(name)


@table("row", TO_IGTL, ids=lambda row: f"{row.message.TYPE}-{row.igtl_type}")
def test_rows_to_igtl_name_what_exists(row: ConversionToIgtl) -> None:
    assert row.message.TYPE in STORE.types
    assert row.igtl_type in BODIES
    assert row_to_igtl(row.message.TYPE, row.igtl_type) is row


def test_each_pair_of_types_has_one_row_and_each_ros_type_a_default() -> None:
    pairs = [(row.message.TYPE, row.igtl_type) for row in TO_IGTL]
    assert len(set(pairs)) == len(pairs)
    for row in TO_IGTL:
        first = next(other for other in TO_IGTL if other.message is row.message)
        assert row_to_igtl(row.message.TYPE) is first


def test_a_topic_has_one_type() -> None:
    kinds: dict[str, str] = {}
    for row in TO_ROS:
        assert kinds.setdefault(row.kind, row.message.TYPE) == row.message.TYPE, row.kind


def test_there_is_no_row_for_the_unknown() -> None:
    assert rows_to_ros("MYSTERY") == ()
    assert row_to_igtl("sensor_msgs/msg/Imu") is None
    assert row_to_igtl("std_msgs/msg/String", "IMAGE") is None


@given(st.data())
@pytest.mark.parametrize(
    "row", [row for row in TO_ROS if not row.lossy], ids=lambda row: f"{row.igtl_types[0]}-{row.kind}"
)
def test_a_row_without_loss_gives_back_what_it_got(row: ConversionToRos, data: st.DataObject) -> None:
    """``lossy == ""`` promises an exact round trip of whatever can be received."""
    for igtl_type in row.igtl_types:
        content = data.draw(strategies.bodies()[igtl_type])
        message: Any = row.convert(content, ToRosContext("device", 0, "frame", "child", igtl_type=igtl_type))
        back = row_to_igtl(row.message.TYPE)
        assert back is not None
        assert back.convert(row.message.unpack(message.pack()), ToIgtlContext()).content == content


def test_no_row_to_igtl_claims_to_lose_nothing_without_proof() -> None:
    """As above, the other way round; so far there is no such row."""
    assert [row for row in TO_IGTL if not row.lossy] == []
