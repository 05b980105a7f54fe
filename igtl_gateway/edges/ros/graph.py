"""The ROS graph as discovery shows it: who publishes and subscribes, with which quality of service."""

from __future__ import annotations

from collections import Counter
from typing import Any

from igtl_gateway.base.qos import Endpoint, Qos, incompatible
from igtl_gateway.edges.interface import Publication
from igtl_gateway.edges.ros.middleware import qos_of
from igtl_gateway.edges.ros.node import RosNode
from igtl_gateway.edges.ros.topics import Topics

#: The vendor of Fast DDS in RTPS.
FAST_DDS = (0x01, 0x0F)


class Graph:
    """Questions to the graph, about the other nodes; each answer is as far as discovery has come."""

    def __init__(self, node: RosNode, topics: Topics) -> None:
        self._node = node
        self._topics = topics

    def publications(self) -> list[Publication]:
        """The topics that others publish."""
        with self._node.lock:
            if not self._node.is_running:
                return []
            node = self._node.handle
            own = Counter(publisher.topic_name for publisher in node.publishers)
            return [
                Publication(name, type_name, count)
                for topic, types in node.get_topic_names_and_types()
                if (count := node.count_publishers(topic) - own[topic]) > 0
                and (name := self._node.names.in_gateway(topic)) is not None
                for type_name in types
            ]

    def endpoints(self) -> list[Endpoint]:
        """Publishers and subscriptions of all topics, without those of our own node."""
        with self._node.lock:
            if not self._node.is_running:
                return []
            node = self._node.handle
            own = (node.get_name(), node.get_namespace())
            return [
                Endpoint(
                    topic,
                    info.topic_type,
                    f"{info.node_namespace.rstrip('/')}/{info.node_name}",
                    publishes,
                    qos_of(self._node.rclpy, info.qos_profile),
                )
                for topic, _ in node.get_topic_names_and_types()
                for publishes, infos in (
                    (True, node.get_publishers_info_by_topic(topic)),
                    (False, node.get_subscriptions_info_by_topic(topic)),
                )
                for info in infos
                if (info.node_name, info.node_namespace) != own
            ]

    def subscriptions_of(self, topic: str) -> int:
        """The number of other subscriptions to a topic; 0 where the node does not run."""
        if not self._node.is_running:
            return 0
        in_graph = self._node.names.in_graph(topic)
        own = len(self._topics.subscriptions_at(in_graph))
        return int(self._node.host.node.count_subscribers(in_graph)) - own

    def has_foreign_subscription(self, topic: str) -> bool:
        """Whether a subscription is of another vendor's DDS than ours (DDSI-RTPS 2.5, 9.3.1.5: GUIDs begin with it)."""
        infos = self._node.host.node.get_subscriptions_info_by_topic(self._node.names.in_graph(topic))
        return any(tuple(info.endpoint_gid[:2]) != FAST_DDS for info in infos)

    def readers_of(self, topic: str, offered: Qos) -> set[bytes]:
        """The identifiers of the subscriptions that a publisher with this QoS can reach."""
        infos = self._node.host.node.get_subscriptions_info_by_topic(self._node.names.in_graph(topic))
        fits = (info for info in infos if not incompatible(offered, qos_of(self._node.rclpy, info.qos_profile)))
        return {bytes(info.endpoint_gid) for info in fits}

    def matching_qos(self, topic: str, wanted: Qos) -> Qos:
        """The QoS that every present publisher satisfies, by the rule of foxglove_bridge and rosbag2."""
        node: Any = self._node.handle
        topic = self._node.names.in_graph(topic)
        mine = sum(publisher.topic_name == topic for publisher in node.publishers)
        offered = []
        for info in node.get_publishers_info_by_topic(topic):
            if mine and (info.node_name, info.node_namespace) == (node.get_name(), node.get_namespace()):
                mine -= 1
            else:
                offered.append(qos_of(self._node.rclpy, info.qos_profile))
        return Qos(
            depth=wanted.depth,
            reliable=wanted.reliable and all(qos.reliable for qos in offered),
            latched=bool(offered) and all(qos.latched for qos in offered),
        )
