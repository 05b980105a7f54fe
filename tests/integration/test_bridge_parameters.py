"""The node of a bridge inside a program: its arguments, and its parameters, which change with the settings."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

import igtl_gateway
from igtl_gateway import Bridge
from igtl_gateway.base.errors import ConfigError
from igtl_gateway.edges.ros.host import NodeHost
from tests import domains
from tests.integration.bridge import RosClient

pytestmark = pytest.mark.ros

LOCAL = ["127.0.0.1:0"]
NODE = "/or1/gw"
NAME = ["-r", "__ns:=/or1", "-r", "__node:=gw"]
EVENTS = "/parameter_events"
STRINGS = 9  # rcl_interfaces/msg/ParameterType


@pytest.mark.slow
def test_parameters_and_settings_change_together(tmp_path: Path) -> None:
    file, out = tmp_path / "gw.yaml", tmp_path / "out.mcap"
    file.write_text('/**:\n  ros__parameters:\n    deny_in: ["SENSOR"]\n    max_age_s: 2.5\n', "utf-8")
    arguments = [*NAME, "--params-file", str(file)]
    with (
        RosClient("other", domain=domains.OWN) as other,
        Bridge(listen=LOCAL, record=out, deny_out=["IMAGE"], ros_args=arguments) as bridge,
    ):

        def call(service: str, kind: str, fields: dict[str, Any]) -> dict[str, Any]:
            other.call(f"{NODE}/{service}", f"rcl_interfaces/srv/{kind}", fields)
            answer: dict[str, Any] = other.receive(f"{NODE}/{service}")
            return answer

        def shown() -> tuple[list[str], list[str], float]:
            names = ["deny_in", "deny_out", "max_age_s"]
            denied, hidden, age = call("get_parameters", "GetParameters", {"names": names})["values"]
            return denied["string_array_value"], hidden["string_array_value"], age["double_value"]

        assert shown() == (["SENSOR"], ["IMAGE"], 2.5)
        other.subscribe(EVENTS, "rcl_interfaces/msg/ParameterEvent")
        # the bridge discovers endpoints in their order: when it answers a later client, it knows the subscriber
        call("list_parameters", "ListParameters", {"prefixes": ["deny_in"], "depth": 1})
        bridge.change(deny_in=["STRING"], active=False, max_age_s=2.5)  # that is what it is: no event
        (event,) = [other.receive(EVENTS)]
        assert (event["node"], [each["name"] for each in event["changed_parameters"]]) == (NODE, ["deny_in"])
        assert shown() == (["STRING"], ["IMAGE"], 2.5)

        with pytest.raises(ConfigError, match="max_age_s: found -1"):
            bridge.change(deny_in=[], max_age_s=-1)
        assert shown() == (["STRING"], ["IMAGE"], 2.5)

        value = {"type": STRINGS, "string_array_value": ["COMMAND"]}
        answer = call("set_parameters", "SetParameters", {"parameters": [{"name": "deny_in", "value": value}]})
        assert answer["results"] == [{"successful": True, "reason": ""}]
        assert other.receive(EVENTS)["changed_parameters"][0]["name"] == "deny_in"
        bridge.change(deny_in=[], deny_out=[])
        assert len(other.receive(EVENTS)["changed_parameters"]) == 2
        assert shown() == ([], [], 2.5)
        assert other.received(EVENTS) == []
    with igtl_gateway.open(out) as recording:
        changes = [note.text for note in recording.notes if note.code == "setting"]
    assert [text.partition(" to ")[0] for text in changes] == [
        'changed: deny_in from ["SENSOR"]',
        'changed: deny_in from ["STRING"]',
        'changed: deny_in from ["COMMAND"]',
    ]
    assert igtl_gateway.verify(out).good


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["-p", "queue_mib:=0"], r"^parameter queue_mib: found 0, expected 1 to"),
        (["-p", "lisen:=[]"], r"^parameter lisen: unknown setting, expected one of"),
        (["--no-such-flag"], r"^ros_args: found --no-such-flag, expected arguments of ROS 2"),
    ],
)
def test_wrong_arguments_start_nothing(arguments: list[str], text: str) -> None:
    bridge = Bridge(listen=LOCAL, ros_args=arguments)
    with pytest.raises(ConfigError, match=text):
        bridge.start()
    assert bridge.addresses == ()
    bridge.stop()


def test_two_bridges_in_two_namespaces_share_no_status_name() -> None:
    topic = "/diagnostics"
    with (
        RosClient("other", domain=domains.OWN) as other,
        Bridge(listen=LOCAL, ros_args=["-r", "__ns:=/or1"]),
        Bridge(listen=LOCAL, ros_args=["-r", "__ns:=/or2"]),
    ):
        other.subscribe(topic, "diagnostic_msgs/msg/DiagnosticArray")
        names: dict[str, set[str]] = {}
        while len(names) < 2:
            for status in other.receive(topic)["status"]:
                node, _, what = status["name"].partition(": ")
                names.setdefault(node, set()).add(what)
    assert names == {f"or{number}/igtl_gateway": {"recorder"} for number in (1, 2)}


@pytest.mark.parametrize(
    ("arguments", "shares"),
    [
        ([], False),
        (["-r", "__ns:=/or1"], True),
        (["-r", "__ns:=/or1", "-r", "/tf:=tf"], False),
        (["-r", "__ns:=/or1", "-r", "/tf:=/or1/tf"], False),
    ],
)
def test_a_bridge_knows_whether_it_shares_tf(arguments: list[str], shares: bool) -> None:
    host = NodeHost("igtl_gateway", arguments=arguments)
    host.start(lambda error: None)
    try:
        assert host.shares_tf is shares
    finally:
        host.stop()
