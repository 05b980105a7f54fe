"""The table of conversions holds together."""

from __future__ import annotations

import pytest
from rosbags.typesys import Stores, get_typestore

from igtl_gateway.convert.table import TO_IGTL, TO_ROS, IgtlRow, RosRow, row_to_igtl, rows_to_ros
from igtl_gateway.wire.registry import BODIES

STORE = get_typestore(Stores.ROS2_JAZZY)


@pytest.mark.parametrize("row", TO_ROS, ids=lambda row: f"{row.igtl_types[0]}-{row.kind}")
def test_rows_to_ros_name_what_exists(row: RosRow) -> None:
    assert row.message.TYPE in STORE.types
    assert all(BODIES[name] is row.content for name in row.igtl_types)
    assert row.kind.isidentifier()
    for name in row.igtl_types:
        assert row in rows_to_ros(name)


@pytest.mark.parametrize("row", TO_IGTL, ids=lambda row: f"{row.message.TYPE}-{row.igtl_type}")
def test_rows_to_igtl_name_what_exists(row: IgtlRow) -> None:
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
    assert row_to_igtl("sensor_msgs/msg/Joy") is None
    assert row_to_igtl("std_msgs/msg/String", "IMAGE") is None


def test_no_row_claims_to_lose_nothing_without_proof() -> None:
    """``lossy == ""`` promises an exact round trip: who adds such a row adds its proof here."""
    rows: list[RosRow | IgtlRow] = [*TO_ROS, *TO_IGTL]
    assert [row for row in rows if not row.lossy] == []
