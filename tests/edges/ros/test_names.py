"""Names of topics in the gateway and in the graph: namespaces and remapping, as rcl has them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import pytest

from igtl_gateway.edges.ros.middleware import import_rclpy
from igtl_gateway.edges.ros.names import GraphNames, remapped

pytest.importorskip("rclpy", reason='needs ROS 2: pip install "igtl-gateway[ros]", or source an installation')


@contextmanager
def names(*arguments: str) -> Iterator[GraphNames]:
    rclpy, given = import_rclpy(), ["--ros-args", *arguments]
    context = rclpy.context.Context()
    context.init(args=given)
    node: Any = rclpy.node.Node("gw", context=context, enable_rosout=False, start_parameter_services=False)
    try:
        yield GraphNames(node, given)
    finally:
        node.destroy_node()
        context.try_shutdown()


def check(found: GraphNames, pairs: dict[str, str]) -> None:
    """Each name in the gateway has its name in the graph, and the other way round."""
    assert {name: found.in_graph(name) for name in pairs} == pairs
    assert {found.in_gateway(in_graph): in_graph for in_graph in pairs.values()} == pairs


def test_without_arguments_a_topic_has_one_name() -> None:
    with names() as found:
        check(found, {name: name for name in ("/tf", "/igtl/in/Probe/transform", "/camera/image")})
        assert found.full("chatter") == "/chatter"


def test_in_a_namespace_our_topics_move_and_the_others_stay() -> None:
    with names("-r", "__ns:=/or1") as found:
        check(found, {"/igtl/out/Tool": "/or1/igtl/out/Tool", "/tf": "/tf", "/camera/image": "/camera/image"})
        assert found.in_gateway("/igtl/out/Tool") is None  # of a bridge without a namespace
        assert found.in_gateway("/or2/igtl/out/Tool") == "/or2/igtl/out/Tool"
        assert found.full("chatter") == "/or1/chatter"


def test_remapping() -> None:
    rules = ("-r", "/tf:=tf", "-r", "igtl/out/Tool:=/tool", "--remap", "gw:/camera/image:=/image", "-r", "x:/a:=/b")
    with names("-r", "__ns:=/or1", *rules) as found:
        check(found, {"/tf": "/or1/tf", "/igtl/out/Tool": "/tool", "/camera/image": "/image", "/a": "/a"})
        assert found.in_gateway("/tf") is None
        assert found.in_gateway("/or1/igtl/out/Tool") is None


def test_two_topics_that_change_places() -> None:
    with names("-r", "/a:=/b", "-r", "/b:=/a") as found:
        check(found, {"/a": "/b", "/b": "/a"})


@pytest.mark.parametrize(
    ("words", "left"),
    [
        ("--ros-args -r a:=b -p c:=d --remap /e:=/f", ["a", "/e"]),
        ("-r __node:=n -r __ns:=/x -r node:a:=b", ["a"]),
        ("-r rostopic:///a:=/b -r rosservice:///c:=/d -r", ["/a"]),
    ],
)
def test_the_left_sides_of_rules(words: str, left: Sequence[str]) -> None:
    assert list(remapped(words.split())) == left
