"""rclcpp at the gateway: a C++ node with every type both ways, components in one process, loaned messages.

``python tools/judges/rclcpp.py --prefix DIR …``: folders with ``include/PACKAGE``, ``lib`` and ``share`` of rclcpp,
rclcpp_components and the messages of the gateway, as an installed ROS 2 has.  The node needs nlohmann's json.hpp.
Writes docs/evidence/real-programs/rclcpp.jsonl; exit code 1 if anything differs.

Strategy: the node is a foreign one for ``ros_types``.  The components send to each other and to the bridge; what the
peer and the other component received, and what a peer sent to them, is counted and compared.
"""

from __future__ import annotations

import argparse
import struct
import sys
import tempfile
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2]))

from tests.integration.bridge import Bridge, Program, RawPeer, RosClient, Wire, environment
from tests.integration.test_ros_types import STRING_TYPE, packed
from tools.judges import cpp, results, ros_types
from tools.judges.results import EXACT, FAILS, TO_IGTL, TO_ROS, Row

MESSAGES = 20
CONTAINER, LOAD = "/judge_container", "composition_interfaces/srv/LoadNode"
REPORT = "/judge/report"
COMPONENTS = ("Listener", "Talker")
LINKED = (
    *cpp.LIBRARIES,
    "class_loader",
    "ament_index_cpp",
    "geometry_msgs__rosidl_typesupport_cpp",
    "sensor_msgs__rosidl_typesupport_cpp",
)


def components(folder: Path, prefixes: Sequence[Path]) -> list[Row]:
    """Two components in one container, and the bridge between them and a peer."""
    library = cpp.compiled("components.cpp", folder, prefixes, LINKED)
    index = folder / "share" / "ament_index" / "resource_index"
    for kind, text in (
        ("packages", ""),
        ("rclcpp_components", "".join(f"judge::{name};{library}\n" for name in COMPONENTS)),
    ):
        (index / kind).mkdir(parents=True, exist_ok=True)
        (index / kind / "judge").write_text(text)
    there = cpp.environment([folder, *prefixes])
    with ExitStack() as stack:
        bridge = Bridge("--no-cautious")
        stack.callback(bridge.close)
        stack.callback(bridge.end)
        peer = stack.enter_context(RawPeer(bridge.port))
        bridge.wait_code("link_up")
        command = [str(cpp.executable("rclcpp_components", "component_container", prefixes))]
        container = Program([*command, "--ros-args", "-r", f"__node:={CONTAINER[1:]}"], environment(**there))
        stack.callback(container.close)
        loader = stack.enter_context(
            RosClient("loader", PYTHONPATH=there["PYTHONPATH"], LD_LIBRARY_PATH=there["LD_LIBRARY_PATH"])
        )
        loader.subscribe(REPORT, STRING_TYPE, latched=True)
        for name in COMPONENTS:
            alone = [{"name": "use_intra_process_comms", "value": {"type": 1, "bool_value": True}}]
            fields = {"package_name": "judge", "plugin_name": f"judge::{name}", "extra_arguments": alone}
            loader.call(f"{CONTAINER}/_container/load_node", LOAD, fields)
            answer = loader.receive(f"{CONTAINER}/_container/load_node")
            assert answer["success"], answer
        return [*_sent(peer), *_between(loader), _received(peer, loader)]


def _sent(peer: RawPeer) -> list[Row]:
    """What the peer has of the components."""
    wanted: dict[str, tuple[str, str, Callable[[int], bytes]]] = {
        "Pose": ("TRANSFORM", "PoseStamped, borrowed; of the local allocator, as its type has a string", transform),
        "Image": ("IMAGE", "Image, a unique pointer", lambda n: bytes([n]) * 4096),
        "Text": ("STRING", "String, a unique pointer", lambda n: f"text {n}".encode()),
    }
    got: dict[str, list[Wire]] = {device: [] for device in wanted}
    while any(len(each) < MESSAGES for each in got.values()):
        wire = peer.receive()
        got.get(wire.device, []).append(wire)
    rows = []
    for device, (kind, what, end) in wanted.items():
        right = [
            each.type == kind and each.crc_ok and each.body.endswith(end(n)) for n, each in enumerate(got[device], 1)
        ]
        text = "" if all(right) else f"{right.count(False)} have another content"
        rows.append(Row(f"{kind} of a component: {what}", TO_IGTL, FAILS if text else EXACT, MESSAGES, text))
    return rows


def transform(millimetres: int) -> bytes:
    """A TRANSFORM's body: no rotation, and a place on the x axis."""
    return struct.pack(">12f", 1, 0, 0, 0, 1, 0, 0, 0, 1, millimetres, 0, 0)


def reported(loader: RosClient) -> list[str]:
    """What the components have reported so far."""
    return [each["data"] for each in loader.received(REPORT)]


def message(report: str) -> str:
    """The message that a report is of: ``image 3 same`` is of ``image 3``."""
    return " ".join(report.split()[:2])


def _has(loader: RosClient, what: str) -> bool:
    return what in reported(loader)


def _between(loader: RosClient) -> list[Row]:
    """What the other component has, and whether it is the very message."""
    wanted = {f"{kind} {number}" for kind in ("pose", "image", "text") for number in range(1, MESSAGES + 1)}
    loader.wait_until(lambda: wanted <= {*map(message, reported(loader))}, "messages between components")
    same = sum(each.endswith(" same") for each in reported(loader))
    text = "" if same == MESSAGES else f"{same} of {MESSAGES} images were the very message"
    row = Row("intra-process, beside the bridge: the image is the very message", results.BOTH, EXACT, MESSAGES)
    return [row if not text else Row(row.what, row.direction, FAILS, MESSAGES, text)]


def _received(peer: RawPeer, loader: RosClient) -> Row:
    """What a component has of the peer."""
    for number in range(1, MESSAGES + 1):  # one after the other: the component keeps the last ten
        peer.send(packed("TRANSFORM", "ToolToBase", transform(number)))
        loader.wait_until(partial(_has, loader, f"in {number}"), f"pose {number}")
    return Row("TRANSFORM to a component, a unique pointer", TO_ROS, EXACT, MESSAGES)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--prefix", type=Path, action="append", required=True, help="folder of packages (repeatable)")
    prefixes = parser.parse_args().prefix
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        program = cpp.compiled("typed_node.cpp", folder, prefixes)
        there = cpp.environment(prefixes)
        libraries, packages = there["LD_LIBRARY_PATH"], there["AMENT_PREFIX_PATH"]
        node = RosClient("typed", program=[str(program)], LD_LIBRARY_PATH=libraries, AMENT_PREFIX_PATH=packages)
        rows = results.summed([*ros_types.judge(node), *components(folder, prefixes)])
    return results.write("rclcpp", "rclcpp", cpp.version_of("rclcpp", prefixes), "C++ node, components", rows)


if __name__ == "__main__":
    sys.exit(main())
