"""The topics of the gateway in a given ROS graph."""

from __future__ import annotations

from igtl_gateway.base.qos import Endpoint, Qos
from igtl_gateway.config.configuration import Config, ToIgtlRow
from igtl_gateway.doctor import Observer
from igtl_gateway.doctor.graph import Graph
from igtl_gateway.doctor.rules import judge
from igtl_gateway.gateway import Gateway

POSE, STRING = "geometry_msgs/msg/TransformStamped", "std_msgs/msg/String"
PROBE, OUT = "/igtl/in/Probe/transform", "/igtl/out/Target"


def graph(*endpoints: tuple[str, str, bool, Qos], config: Config | None = None) -> Graph:
    made = [
        Endpoint(topic, kind, f"/{'from' if publishes else 'to'}_{number}", publishes, qos)
        for number, (topic, kind, publishes, qos) in enumerate(endpoints)
    ]
    return Graph.of(Gateway(config or Config()), {}, made)


def found(made: Graph, config: Config | None = None) -> list[str]:
    seen = Observer(config or Config())
    seen.graph = made
    return [one.rule.id.removeprefix("IGTL-") for one in judge(seen) if one.rule.id[6] == "6"]


def test_a_subscriber_with_an_incompatible_qos() -> None:
    (clash,) = graph((PROBE, POSE, False, Qos(latched=True))).clashes()
    assert (clash.topic, clash.publisher, clash.subscriber) == (PROBE, "the gateway", "/to_0")
    assert clash.why == "durability (volatile offered, transient local requested)"
    assert list(graph((PROBE, POSE, False, Qos(reliable=False))).clashes()) == []


def test_a_subscriber_of_another_type() -> None:
    (clash,) = graph((PROBE, STRING, False, Qos())).clashes()
    assert clash.why == f"{POSE} published, {STRING} expected"


def test_the_endpoints_of_a_running_bridge_count() -> None:
    there = (PROBE, POSE, True, Qos(latched=True))
    assert list(graph(there, (PROBE, POSE, False, Qos(latched=True))).clashes()) == []
    (clash,) = graph((PROBE, POSE, True, Qos(reliable=False)), (PROBE, POSE, False, Qos())).clashes()
    assert (clash.publisher, clash.why) == ("/from_0", "reliability (best effort offered, reliable requested)")


def test_topics_with_and_without_a_conversion() -> None:
    best_effort = Qos(reliable=False)
    assert found(graph((OUT, POSE, True, best_effort))) == [], "the bridge adapts"
    assert found(graph((OUT, "nav_msgs/msg/Odometry", True, Qos()))) == ["W604", "I605"]
    assert found(graph((OUT, POSE, True, best_effort), (OUT, POSE, False, Qos()))) == ["E601"]


def test_other_topics_are_ignored() -> None:
    made = graph(("/camera", STRING, True, Qos(reliable=False)), ("/camera", STRING, False, Qos()))
    assert (made.endpoints, found(made)) == ([], ["I605"])
    assert found(graph((PROBE, POSE, False, Qos()))) == ["I605"]


def test_no_subscriber() -> None:
    gateway = Gateway(Config())
    made = Graph.of(gateway, {"/igtl/links": "igtl_msgs/msg/LinkStatusList"}, [])
    assert (made.without_subscriber(), found(made)) == (["/igtl/links"], ["I603", "I605"])


def test_a_configured_topic_that_no_node_publishes() -> None:
    config = Config(to_igtl=(ToIgtlRow(topic="/tol"),))
    rules = found(graph(("/tool", POSE, True, Qos()), config=config), config)
    assert "W607" in rules
    assert "W607" not in found(graph(("/tol", POSE, True, Qos()), config=config), config)
