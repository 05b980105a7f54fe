"""The node's logic between the gateway's real conversions: from the message of the navigation to its answer."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import pytest
from hover_node import hover

from igtl_gateway.convert.rosmsg import Header, TransformStamped
from igtl_gateway.wire import Message
from igtl_gateway.wire.transform import Transform

STAR = Path(__file__).parents[2] / "fixtures" / "star.mcap"

IDENTITY = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
#: Position in millimetres, the unit of OpenIGTLink.
TARGET = Message("TRANSFORM", "TargetToBase", Transform((*IDENTITY, 100.0, 200.0, 300.0)))


def test_a_target_is_answered_with_a_pose_above_it(igtl_gateway):
    gateway = igtl_gateway()
    (heard,) = gateway.from_peer(TARGET).ros("/igtl/in/TargetToBase/transform")
    target = heard.message
    assert (target.header.frame_id, target.translation) == ("Base", (0.1, 0.2, 0.3))

    answer = hover(as_node_sees_it(target))
    x, y, z = answer.transform.translation.x, answer.transform.translation.y, answer.transform.translation.z
    said = TransformStamped(Header(target.header.stamp_ns, "Base"), answer.child_frame_id, (x, y, z), target.rotation)
    (sent,) = gateway.from_ros("/igtl/out/HoverToBase", said).igtl("TRANSFORM/*")
    assert sent.message.content.wire_matrix == pytest.approx((*IDENTITY, 100.0, 200.0, 350.0))


def test_the_same_with_real_ros_messages(igtl_gateway):
    """With ROS 2 installed: the message classes of ROS, without a node, a graph or a wait."""
    serialization = pytest.importorskip("rclpy.serialization")
    kind = pytest.importorskip("geometry_msgs.msg").TransformStamped
    gateway = igtl_gateway()
    (heard,) = gateway.from_peer(TARGET).ros("/igtl/in/TargetToBase/transform")
    answer = hover(serialization.deserialize_message(heard.cdr, kind))
    cdr = serialization.serialize_message(answer)
    (sent,) = gateway.from_ros("/igtl/out/HoverToBase", cdr, "geometry_msgs/msg/TransformStamped").igtl()
    assert sent.message.content.wire_matrix == pytest.approx((*IDENTITY, 100.0, 200.0, 350.0))


def test_a_new_version_of_the_gateway_gives_the_same_result(igtl_gateway, assert_session_equal):
    """The installed gateway computes the outputs of a recording again."""
    gateway = igtl_gateway(STAR)  # with the configuration of the recording
    gateway.play(STAR)
    assert_session_equal(STAR, gateway, tolerance_mm=0.001, tolerance_deg=0.001)


def as_node_sees_it(target):
    """Return an object with the fields of geometry_msgs/msg/TransformStamped that the node uses."""
    x, y, z = target.translation
    translation = SimpleNamespace(x=x, y=y, z=z)
    return SimpleNamespace(child_frame_id=target.child_frame_id, transform=SimpleNamespace(translation=translation))
