"""Settings as parameters of the node: another node lists, describes, gets and sets them by the services of rclpy."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import pytest

from igtl_gateway.app.setting_values import config_of, declared, settled
from igtl_gateway.base.errors import ConfigError
from igtl_gateway.config.setting import Setting
from igtl_gateway.config.settings import all_settings, parameters
from igtl_gateway.edges.ros.host import NodeHost
from igtl_gateway.edges.ros.middleware import import_rclpy, interface_class
from igtl_gateway.edges.ros.parameters import description, overrides
from tests.cli.test_settings import mistakes, told
from tests.tables import table
from tests.timing import WAIT_S

pytest.importorskip("rclpy", reason='needs ROS 2: pip install "igtl-gateway[ros]", or source an installation')

FILE = """
/**:
  ros__parameters:
    stall_s: 5
    deny_in: []
    queue_mib: 7
    queue_messages: 7
/or1/gw:
  ros__parameters:
    queue_messages: 8
    listen: ["127.0.0.1:0", "tls://:2"]
    max_age_s: 0.5
"""
KINDS = {bool: 1, int: 2, float: 3, str: 4, tuple: 9}


class Other:
    """Another node, which calls the services of parameters."""

    def __init__(self) -> None:
        rclpy = import_rclpy()
        self._context = rclpy.context.Context()
        self._context.init(args=[])
        self._node = rclpy.node.Node("other", context=self._context)
        self._executor = rclpy.executors.SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._parameter = rclpy.parameter.Parameter
        self._clients: dict[str, Any] = {}

    def call(self, name: str, kind: str, **request: Any) -> Any:
        service = interface_class(f"rcl_interfaces/srv/{kind}")
        if name not in self._clients:
            self._clients[name] = self._node.create_client(service, f"/or1/gw/{name}")
            assert self._clients[name].wait_for_service(WAIT_S)
        future = self._clients[name].call_async(service.Request(**request))
        self._executor.spin_until_future_complete(future, WAIT_S)
        return future.result()

    def set(self, name: str, value: Any) -> tuple[bool, str]:
        parameter = self._parameter(name, value=value)
        answer = self.call("set_parameters", "SetParameters", parameters=[parameter.to_parameter_msg()])
        (result,) = answer.results
        return result.successful, result.reason

    def get(self, name: str) -> Any:
        (value,) = self.call("get_parameters", "GetParameters", names=[name]).values
        return self._parameter.from_parameter_msg(
            interface_class("rcl_interfaces/msg/Parameter")(name=name, value=value)
        )

    def close(self) -> None:
        self._executor.shutdown()
        self._node.destroy_node()
        self._context.try_shutdown()


class Changes:
    """What a bridge would do with the settings that change."""

    def __init__(self) -> None:
        self.seen: list[Mapping[str, object]] = []

    def __call__(self, changes: Mapping[str, object]) -> None:
        if changes.get("max_age_s") == 13.0:
            raise ConfigError("not this one")
        self.seen.append(changes)


@pytest.fixture(scope="module")
def host(tmp_path_factory: pytest.TempPathFactory) -> Iterator[NodeHost]:
    folder = tmp_path_factory.mktemp("parameters")
    path = folder / "gw.yaml"
    path.write_text(FILE)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("ROS_LOG_DIR", str(folder))
        arguments = f"--ros-args -r __ns:=/or1 -r __node:=gw --params-file {path}"
        arguments += " -p queue_mib:=8 -p to_ros:=['P=+slices']"
        made = NodeHost("igtl_gateway", arguments=arguments.split())
        made.start(lambda error: pytest.fail(str(error)))
        values = settled({"stall_s": 6.0}, made.overrides())
        made.declare(declared(values, config_of(values)))
        yield made
        made.stop()


@pytest.fixture(scope="module")
def other(host: NodeHost) -> Iterator[Other]:
    node = Other()
    yield node
    node.close()


def test_a_file_and_arguments_set_parameters_as_for_every_node(host: NodeHost, other: Other) -> None:
    assert overrides(host.node) == {}  # all are declared
    assert other.get("queue_mib").value == 8  # -p after the file
    assert other.get("queue_messages").value == 8  # the node's own section
    assert other.get("listen").value == ["127.0.0.1:0", "tls://:2"]
    assert other.get("stall_s").value == 6.0  # the command line before the file
    assert other.get("to_ros").value == ['{"device": "P", "kinds": ["+slices"]}']


def test_all_settings_are_declared_with_their_descriptors(other: Other) -> None:
    names = list(parameters())
    listed = other.call("list_parameters", "ListParameters", prefixes=[], depth=0).result.names
    assert set(names) <= set(listed)
    found = other.call("describe_parameters", "DescribeParameters", names=names).descriptors
    for row, descriptor in zip(parameters().values(), found, strict=True):
        assert (descriptor.name, descriptor.type) == (row.name, KINDS[type(row.default)])
        assert descriptor.read_only is not row.changes
        assert descriptor.description == description(row)
        assert not row.unit or row.is_list or f"unit: {row.unit}" in descriptor.additional_constraints
        ranges = [*descriptor.integer_range, *descriptor.floating_point_range]
        expected = [(row.least, row.most)] if row.least is not None else []
        assert [(each.from_value, each.to_value) for each in ranges] == expected


def test_descriptions_name_parameters_and_no_options() -> None:
    assert "--" not in " ".join(description(row) for row in all_settings() if row.parameter)


def test_an_empty_list_is_a_list_of_strings(other: Other) -> None:
    value = other.get("allow")
    assert (value.type_.value, value.value) == (9, [])


CASES = [(row, value) for row in all_settings() if row.parameter for value in mistakes(row)]


@table(("row", "value"), CASES, ids=[f"{row.name}={value}" for row, value in CASES])
def test_a_mistake_has_the_message_that_it_has_everywhere(other: Other, row: Setting, value: Any) -> None:
    assert other.set(row.name, value) == (False, f"{row.name}: {told(row, value)}")


def test_what_cannot_change_is_read_only_as_in_every_node(other: Other) -> None:
    assert other.set("stall_s", 7.0) == (False, "Trying to set a read-only parameter: stall_s.")
    refused, reason = other.set("deny", ["A"])
    assert not refused and reason.startswith("deny: unknown setting, expected one of config, listen")


def test_changes_reach_the_bridge_and_it_may_refuse_them(host: NodeHost, other: Other) -> None:
    assert other.set("kinds", ["+slices"]) == (True, "")  # without a bridge: for the next one
    assert host.changed_values()["kinds"] == ("+slices",)
    host.on_change = changes = Changes()
    assert other.set("deny_in", ["COMMAND", "GET_*"]) == (True, "")
    assert other.set("max_age_s", 2) == (True, "")  # an integer for a number
    assert other.get("max_age_s").value == 2.0
    assert other.set("deny_in", []) == (True, "")
    assert other.set("max_age_s", 13.0) == (False, "not this one")
    assert other.get("max_age_s").value == 2.0
    assert changes.seen == [{"deny_in": ("COMMAND", "GET_*")}, {"max_age_s": 2.0}, {"deny_in": ()}]
    host.on_change = None


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ("--ros-args --no-such-flag", "--ros-args: found --no-such-flag"),
        ("--ros-args -r a", "--ros-args: Couldn't parse remap rule"),
    ],
)
def test_arguments_that_ros_does_not_know(arguments: str, words: str) -> None:
    with pytest.raises(ConfigError) as error:
        NodeHost("gw", arguments=arguments.split()).start(lambda error: None)
    assert str(error.value).startswith(words) and "\n" not in str(error.value)
