"""The edge and zenoh-ros2-sdk, another implementation of the format, where that is installed."""

from __future__ import annotations

from contextlib import ExitStack
from typing import Any

import pytest

from igtl_gateway.addons.zenoh.own_node import TypeHashes
from igtl_gateway.base.qos import Qos
from igtl_gateway.convert.rosmsg import String
from tests.addons.zenoh.routers import router
from tests.addons.zenoh.test_edge import DOMAIN, Side, port, sides, started, text, until

sdk = pytest.importorskip("zenoh_ros2_sdk", reason="pip install zenoh-ros2-sdk, another implementation of the format")

__all__ = ["port", "sides"]

TRIGGER = "std_srvs/srv/Trigger"


def test_messages_calls_and_graph(port: int, sides: ExitStack, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ZENOH_CONFIG_OVERRIDE", 'mode="client"')
    hashes = TypeHashes()
    where: dict[str, Any] = {"domain_id": DOMAIN, "router_ip": "127.0.0.1", "router_port": port}
    definition = {"msg_definition": "string data\n", "type_hash": hashes.of(String.TYPE)}
    with router(port):
        side: Side = started(sides, port, ("/chatter",))

        def answer(_request: Any, response: Any) -> Any:
            response.success, response.message = True, "done"
            return response

        assert side.edge.serve("/save", TRIGGER, answer)
        side.edge.advertise("/reply", String.TYPE, Qos(5))
        got: list[str] = []
        subscriber = sdk.ROS2Subscriber(
            "/reply", String.TYPE, lambda message: got.append(message.data), **definition, **where
        )
        publisher = sdk.ROS2Publisher("/chatter", String.TYPE, **definition, **where)
        side.wait_code("ros_subscribed")
        until(lambda: side.edge.has_subscriber("/reply") and side.edge.subscriber_count("/reply") == 1)
        nodes = {(each.topic, each.publishes) for each in side.edge.endpoints()}
        assert nodes == {("/chatter", True), ("/reply", False)}
        until(lambda: bool(publisher.publish(data="grüß Gott")) or bool(side.messages))
        assert side.messages[0][:3] == ("/chatter", String.TYPE, text("grüß Gott"))
        assert side.edge.publish("/reply", String.TYPE, text("servus"), Qos(5)) == ""
        until(lambda: got == ["servus"])
        topics = dict(sdk.get_topic_names_and_types(**where))
        assert topics["/reply"] == [String.TYPE]
        client = sdk.ROS2ServiceClient(
            "/save",
            TRIGGER,
            request_definition="uint8 structure_needs_at_least_one_member\n",
            response_definition="bool success\nstring message\n",
            type_hash=hashes.of(TRIGGER),
            **where,
        )
        reply = client.call(structure_needs_at_least_one_member=0)
        assert (reply.success, reply.message) == (True, "done")
        for each in (client, publisher, subscriber):
            each.close()
        sdk.ZenohSession.get_instance().close()
