"""Every row of the conversion table over Zenoh: the tests of ``test_ros_types`` with a foreign node without ROS.

The bridge runs in a Python in which ROS cannot be imported.  The node is plain Zenoh with the CDR of rosbags.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from igtl_gateway.convert.interfaces import SHARES
from tests.addons.zenoh.routers import router
from tests.integration.bridge import Bridge, RawPeer, RosClient, free_port, gateway
from tests.integration.test_ros_types import (  # noqa: F401 (tests and fixtures, which run here with another world)
    ADVERTISED,
    LINKS_TOPIC,
    SUBSCRIBED,
    TF,
    World,
    peer,
    rows_of_the_command_line,
    test_a_command_of_a_peer_is_answered_by_a_node,
    test_a_command_of_the_node_by_topic,
    test_a_command_that_nobody_answers_is_given_up,
    test_a_type_that_nobody_knows_is_heard_as_it_is,
    test_children_of_a_bind_go_their_own_ways,
    test_frames_go_out_with_their_chain_composed,
    test_frames_of_a_video_tell_the_size_of_their_key_frame,
    test_metadata_goes_out_to_who_has_shown_header_version_2,
    test_metadata_of_a_standard_message_is_heard_beside_it,
    test_queries_are_heard,
    test_queries_of_the_node_reach_peers,
    test_raw_messages_of_the_node_go_out_as_they_are,
    test_the_second_slice_comes_behind_the_first,
    test_the_service_sends_a_command_and_tells_its_reply,
    test_what_a_peer_sends_is_what_the_node_hears,
    test_what_the_node_publishes_is_what_peers_get,
    test_who_is_connected_is_heard,
)

HERE = Path(__file__).parent
#: The imitation of Windows has no ROS, either.
SITE = "as_windows" if os.environ.get("IGTL_GATEWAY_ALL_AS_WINDOWS") else "without_ros"
WITHOUT_ROS = os.pathsep.join([str(HERE / SITE), str(HERE.parents[1])])


@pytest.fixture(scope="module")
def world() -> Iterator[World]:
    zenoh_port, port = free_port(), free_port()
    endpoint = f"tcp/127.0.0.1:{zenoh_port}"
    there = (
        "--ros",
        f"zenoh:{endpoint}",
        "--listen",
        f"127.0.0.1:{port}",
        "--peer",
        f"127.0.0.1:{port}=slicer",
        *("--tf-out", "tool:base", "--tf-out", "Base:Room"),
    )
    program = ["zenoh_client.py", endpoint, *map(str, SHARES)]
    with router(zenoh_port), RosClient("types", program=program, subscribe=SUBSCRIBED, advertise=ADVERTISED) as ros:
        ros.subscribe(LINKS_TOPIC, "igtl_msgs/msg/LinkStatusList", latched=True)
        ros.advertise("/tf_static", TF, latched=True)
        bridge = Bridge("--no-cautious", *rows_of_the_command_line(), *there, PYTHONPATH=WITHOUT_ROS)
        try:
            with RawPeer(bridge.port) as talker, RawPeer(bridge.port) as listener, RawPeer(port) as slicer:
                bridge.wait_code("link_up", 3)
                ros.wait_readers(*ADVERTISED.keys() - {"/tf"}, "/tf_static")
                ros.wait_readers("/tf", count=2)  # the node itself subscribes, too
                yield World(bridge, ros, talker, listener, slicer, None)
        finally:
            told = bridge.end()
            bridge.close()
    assert (told.code, told.err) == (0, "")
    assert not [event for event in bridge.events if event.get("level") in ("warn", "error")]
    assert bridge.events[-1]["event"] == "stopped"


@pytest.mark.slow
def test_ros_cannot_be_imported_there() -> None:
    tried = gateway("bridge", "--listen", "127.0.0.1:0", PYTHONPATH=WITHOUT_ROS).end(None)
    assert (tried.code, tried.out) == (1, "")
    assert tried.err.startswith("igtl-gateway bridge: rclpy is not installed here")
