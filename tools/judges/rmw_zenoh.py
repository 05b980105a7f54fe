"""rmw_zenoh_cpp, the Zenoh middleware of ROS 2, as a foreign ROS 2 node at ``bridge --ros zenoh``.

``python tools/judges/rmw_zenoh.py --prefix DIR``: a folder with ``lib/librmw_zenoh_cpp.so`` and ``share`` of a
rmw_zenoh_cpp for the rclpy of this Python.  Writes docs/evidence/real-programs/rmw-zenoh.jsonl, or another file with
``--name``; exit code 1 if anything differs.

Strategy: the node is that of ``ros_types``, rclpy with this middleware: rcl of the ROS wheels is linked to Fast DDS, so
the library is loaded before it.  The router is one of Zenoh in this process.  Every type passes both ways, large images
and late joiners, too; then a node calls a service of the bridge, and sees it in the graph.  The recording is verified.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from importlib import metadata
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[2]))

from tests.addons.zenoh.routers import free_port, router
from tests.integration import bridge
from tests.integration.bridge import TIMEOUT_S, RosClient, gateway
from tests.integration.test_ros_types import (
    LINKS_TOPIC,
    World,
    test_the_service_sends_a_command_and_tells_its_reply,
)
from tests.integration.test_zenoh_types import WITHOUT_ROS
from tools.judges import cpp, results, ros_types
from tools.judges.results import BOTH, EXACT, FAILS, TO_IGTL, Row
from tools.judges.ros_types import Trial

LIBRARY, RMW = "librmw_zenoh_cpp.so", "rmw_zenoh_cpp"
BRIDGE = "/igtl_gateway"
DROPPED = (
    "the first one is lost, the next one is exact. Zenoh drops what waits too long on a busy machine; rmw_zenoh wants"
    " that on all topics but those that keep all"
)
#: Waits for a node, then prints the names of all nodes, the topics with their types, and the services.
GRAPH = """
import json, sys, time, rclpy
rclpy.init()
node = rclpy.create_node("looks")
deadline = time.monotonic() + 20
def names():
    return [space.rstrip("/") + "/" + name for name, space in node.get_node_names_and_namespaces()]
while sys.argv[1] not in names() and time.monotonic() < deadline:
    time.sleep(0.05)
print(json.dumps([names(), dict(node.get_topic_names_and_types()), dict(node.get_service_names_and_types())]))
"""


def environment(prefix: Path, port: int) -> dict[str, str]:
    """Of a program of ROS 2 with this middleware, a peer with a router on a port of loopback."""
    loaded = cpp.environment([prefix])
    return {
        **loaded,
        "LD_PRELOAD": str(prefix / "lib" / LIBRARY),
        "RMW_IMPLEMENTATION": RMW,
        "ZENOH_CONFIG_OVERRIDE": f'connect/endpoints=["tcp/127.0.0.1:{port}"]',
        "RUST_LOG": "zenoh=error",
    }


def _service(there: World) -> str:
    there.ros.subscribe(LINKS_TOPIC, "igtl_msgs/msg/LinkStatusList", latched=True)
    test_the_service_sends_a_command_and_tells_its_reply(there, there.talker, {"Status": "SUCCESS"}, 1, "")
    return ""


def seen(environ: dict[str, str]) -> Trial:
    """What another node sees of the bridge in the graph."""

    def run(_there: World) -> str:
        asked = [sys.executable, "-c", GRAPH, BRIDGE]
        env = bridge.environment(**environ)
        told = subprocess.run(asked, env=env, capture_output=True, text=True, timeout=TIMEOUT_S, check=False).stdout
        nodes, topics, services = json.loads(told.partition("\n")[0])  # the middleware has its own lines behind it
        assert BRIDGE in nodes and f"{BRIDGE}/send_command" in services, told[:300]
        assert topics.get(LINKS_TOPIC) == ["igtl_msgs/msg/LinkStatusList"], str(topics)[:300]
        return ""

    return Row("the bridge in the graph: node, topics with types, services", BOTH, EXACT), run


def verified(recording: Path) -> Row:
    """The recording of all that has passed."""
    ended = gateway("verify", str(recording), PYTHONPATH=WITHOUT_ROS).end(None)
    what = "the recording of all of them, verified"
    return Row(what, BOTH, FAILS if ended.code else EXACT, text=ended.err.strip()[-200:] if ended.code else "")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--prefix", type=Path, required=True, metavar="DIR", help=f"with lib/{LIBRARY} and share")
    parser.add_argument("--name", default="rmw-zenoh", help="of the file with the results (default: %(default)s)")
    options = parser.parse_args()
    prefix = options.prefix.resolve()
    if not (prefix / "lib" / LIBRARY).is_file():
        parser.error(f"--prefix: found no lib/{LIBRARY} in {prefix}, expected that of rmw_zenoh_cpp")
    port = free_port()
    with tempfile.TemporaryDirectory() as folder, router(port):
        recording = Path(folder) / "session.mcap"
        environ: dict[str, Any] = environment(prefix, port)
        node = RosClient("judge", **environ)
        there = ("--ros", f"zenoh:tcp/127.0.0.1:{port}", "--record", str(recording))
        called = Row("service ~/send_command of the bridge, called by a node", TO_IGTL, EXACT), _service
        rows = ros_types.judge(node, *there, more=(called, seen(environ)), lost_first=DROPPED)
        rows.append(verified(recording))
    program = f"{RMW} with rclpy {metadata.version('rclpy')}"
    return results.write(options.name, program, cpp.version_of(RMW, [prefix]), "ROS 2 node", results.summed(rows))


if __name__ == "__main__":
    sys.exit(main())
