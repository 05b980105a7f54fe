"""The compiled packages in other programs: rclpy over DDS between processes."""

from __future__ import annotations

import importlib
import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from igtl_gateway.convert.interfaces import PACKAGES, interface_files
from tests.tables import table
from tests.timing import WAIT_S

pytest.importorskip("ros_wheels_bootstrapper", reason="the packages are compiled for the ROS wheels only")
pytestmark = pytest.mark.ros

NODE = Path(__file__).with_name("typed_node.py")
#: Far longer than any expected delay.
TYPES = [
    f"{package}/msg/{path.stem}" for package in PACKAGES for path in interface_files(package) if "msg" in path.parts
]
JAZZY_HASHES = {
    "tf2_msgs/msg/TFMessage": "RIHS01_e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087",
}
STORE = get_typestore(Stores.ROS2_JAZZY)
for package in PACKAGES:
    for path in interface_files(package):
        if path.suffix == ".msg" and f"{package}/msg/{path.stem}" not in STORE.fielddefs:
            STORE.register(get_types_from_msg(path.read_text("utf-8"), f"{package}/msg/{path.stem}"))


def sample(type_name: str, number: Iterator[int]) -> Any:
    """Return a message whose values are all different."""

    def value(description: Any) -> Any:
        match description:
            case (Nodetype.NAME, name):
                return sample(name, number)
            case (Nodetype.BASE, ("string", _)):
                return f"text {next(number)} µ"
            case (Nodetype.BASE, ("bool", _)):
                return True
            case (Nodetype.BASE, (str(base), _)):
                return next(number) % 100 + (0.5 if base.startswith("float") else 0)
            case (Nodetype.ARRAY, (item, length)):
                return several(item, length)
            case (Nodetype.SEQUENCE, (item, _)):
                return several(item, 2)
        raise AssertionError(description)

    def several(item: Any, length: int) -> Any:
        values = [value(item) for _ in range(length)]
        is_number = item[0] is Nodetype.BASE and item[1][0] != "string"
        return np.array(values, item[1][0]) if is_number else values

    _, described = STORE.fielddefs[type_name]
    return STORE.types[type_name](**{name: value(description) for name, description in described})


def plain(value: Any) -> Any:
    """Convert messages of rosbags like ``typed_node.plain``."""
    if hasattr(value, "__msgtype__"):
        return {name: plain(getattr(value, name)) for name, _ in STORE.fielddefs[value.__msgtype__][1]}
    if isinstance(value, np.ndarray):
        return value.tolist()
    return [plain(item) for item in value] if isinstance(value, list) else value


SAMPLES = {name: sample(name, count(1)) for name in TYPES}


def topic(type_name: str) -> str:
    return "/" + type_name.replace("/", "_")


class Here:
    """The node of this process: it sends and receives bytes, without message classes."""

    def __init__(self) -> None:
        import rclpy
        from rclpy.executors import SingleThreadedExecutor
        from rclpy.qos import QoSProfile

        self.context = rclpy.Context()
        rclpy.init(context=self.context)
        self.node = rclpy.create_node("bytes_node", context=self.context)
        self.executor = SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.node)
        self.publishers = {}
        self.back: dict[str, bytes] = {}
        for name in TYPES:
            package, _, short = name.split("/")
            message_class = getattr(importlib.import_module(f"{package}.msg"), short)
            self.publishers[name] = self.node.create_publisher(
                message_class, topic(name) + "/there", QoSProfile(depth=1)
            )
            self.node.create_subscription(
                message_class,
                topic(name) + "/back",
                lambda cdr, name=name: self.back.__setitem__(name, cdr),
                QoSProfile(depth=10),
                raw=True,
            )

    def until(self, condition: Callable[[], bool]) -> None:
        """Process callbacks until the condition holds."""
        clock = self.node.get_clock()
        begin = clock.now()
        while not condition():
            assert (clock.now() - begin).nanoseconds < WAIT_S * 1e9, "this did not happen"
            self.executor.spin_once(timeout_sec=0.1)

    def close(self) -> None:
        self.executor.shutdown()
        self.node.destroy_node()
        self.context.try_shutdown()


@pytest.fixture(scope="module")
def there() -> Iterator[subprocess.Popen[str]]:
    """The other program, after its start."""
    environment = os.environ | {"PYTHONUNBUFFERED": "1"}
    command = [sys.executable, str(NODE), *TYPES]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment
    ) as process:
        yield process
        assert process.stdin
        process.stdin.close()
        assert process.wait(WAIT_S) == 0


@pytest.fixture(scope="module")
def here(there: subprocess.Popen[str]) -> Iterator[Here]:
    here = Here()
    yield here
    here.close()


@pytest.fixture(scope="module")
def decoded(here: Here, there: subprocess.Popen[str]) -> dict[str, Any]:
    """Type → the values that the other program decoded, after a round trip of one message of each type."""
    here.until(lambda: all(publisher.get_subscription_count() for publisher in here.publishers.values()))
    here.until(lambda: all(here.node.count_publishers(topic(name) + "/back") for name in TYPES))

    def all_back() -> bool:
        """Return whether all are back; send the others again, because discovery might have been too late."""
        missing = [name for name in TYPES if name not in here.back]
        for name in missing:
            here.publishers[name].publish(bytes(STORE.serialize_cdr(SAMPLES[name], name)))
        for _ in missing:
            here.executor.spin_once(timeout_sec=0.02)
        return not missing

    here.until(all_back)
    assert there.stdout
    decoded: dict[str, Any] = {}
    while len(decoded) < len(TYPES):
        name, values = json.loads(there.stdout.readline())
        decoded[name] = values
    return decoded


@table("name", TYPES)
def test_another_program_reads_and_writes_equal_values(name: str, here: Here, decoded: dict[str, Any]) -> None:
    assert decoded[name] == plain(SAMPLES[name])
    assert plain(STORE.deserialize_cdr(here.back[name], name)) == plain(SAMPLES[name])


@table("name", TYPES)
def test_the_graph_has_the_type_hash_of_the_definition(name: str, here: Here, decoded: dict[str, Any]) -> None:
    (endpoint,) = here.node.get_publishers_info_by_topic(topic(name) + "/back")
    assert endpoint.topic_type == name
    type_hash = endpoint.topic_type_hash
    assert f"RIHS{type_hash.version:02}_{bytes(type_hash.value).hex()}" == JAZZY_HASHES.get(
        name, STORE.hash_rihs01(name)
    )


def test_a_service_of_another_program_can_be_called(here: Here, there: subprocess.Popen[str]) -> None:
    from igtl_msgs.msg import MetadataItem
    from igtl_msgs.srv import SendCommand

    items = [MetadataItem(key="k", encoding=3, value="v")]
    request = SendCommand.Request(
        device_name="Robot", name="move", content="<a/>", metadata=items, link=4_000_000_000, timeout=1.5
    )
    client = here.node.create_client(SendCommand, "send_command")
    here.until(client.service_is_ready)
    future = client.call_async(request)
    here.until(future.done)
    response = future.result()
    assert (response.status, response.link, response.metadata) == (1, 4_000_000_000, items)
    assert json.loads(response.content) == {
        "device_name": "Robot",
        "name": "move",
        "content": "<a/>",
        "metadata": [{"key": "k", "encoding": 3, "value": "v"}],
        "link": 4_000_000_000,
        "timeout": 1.5,
    }
