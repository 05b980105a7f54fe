"""The examples of the OpenIGTLink library: their programs as servers and clients of the gateway.

``python tools/judges/examples.py --programs DIR --images DIR``: the folder of the example programs, and that of the
images that the image example sends.  A program that is not there is left out.  Writes
docs/evidence/real-programs/examples.jsonl; exit code 1 if anything differs.

Strategy: what each example sends is known from its text, and written here as numbers; a rclpy node at the gateway's
other side must have received it, from the first message on.  What the receiving examples get is what they print.
"""

from __future__ import annotations

import argparse
import math
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[2]))

from tests.integration.bridge import TIMEOUT_S, Bridge, RosClient, free_port
from tests.integration.test_ros_types import ADVERTISED, IMAGE, IN, OUT, OUTGOING, QUERY, rows_of_the_command_line
from tools.judges import results
from tools.judges.peers import debian
from tools.judges.results import CANNOT, EXACT, FAILS, TO_IGTL, TO_ROS, Row

TRANSFORM, STRING, STATUS = (
    "geometry_msgs/msg/TransformStamped",
    "std_msgs/msg/String",
    "diagnostic_msgs/msg/DiagnosticStatus",
)
TRACKING, POINTS, PATHS = "igtl_msgs/msg/TrackingData", "igtl_msgs/msg/PointList", "igtl_msgs/msg/TrajectoryList"
POLYDATA = "igtl_msgs/msg/PolyData"
MESSAGES = 10
WORDS = ("OpenIGTLink", "Network", "Communication", "Protocol", "Image Guided Therapy")
CLOSE = 1e-6  # of float32, which the examples compute with
Message = dict[str, Any]


@dataclass(frozen=True)
class Example:
    """A program of the examples that sends.

    Attributes:
        words: its arguments; ``{port}`` and ``{images}`` are filled in.
        type: what it sends.
        topic, ros_type: what the node receives of it.
        wanted: how the message with this number differs from what the example sends, or "".
        count: the number of messages to compare.
        asked: a query without which it sends nothing.
    """

    name: str
    words: str
    type: str
    topic: str
    ros_type: str
    wanted: Callable[[Message, int], str]
    count: int = MESSAGES
    asked: Message | None = None

    @property
    def is_server(self) -> bool:
        return "Server" in self.name


def pose(place: Message, turn: Message, phi: float, theta: float) -> str:
    """A point on a circle, and a turning quaternion that the library normalises."""
    at = (50 * math.cos(phi), 50 * math.sin(phi), 50 * math.cos(phi))
    found = [place[axis] * 1000 for axis in "xyz"]
    length = math.hypot(0.6666666666, 0.577350269189626)
    wanted = (
        0.0,
        0.6666666666 * math.cos(theta) / length,
        0.577350269189626 / length,
        0.6666666666 * math.sin(theta) / length,
    )
    turned = [turn[axis] for axis in "xyzw"]
    sign = math.copysign(1, sum(a * b for a, b in zip(turned, wanted, strict=True)))
    off = max(abs(a - b) for a, b in zip(found, at, strict=True)) / 50
    off = max(off, *(abs(a - sign * b) for a, b in zip(turned, wanted, strict=True)))
    return "" if off < CLOSE else f"{found} {turned}, expected {at} {wanted}"


def equal(found: Any, wanted: Any) -> str:
    return "" if found == wanted else f"{found}, expected {wanted}"


def of_tracker(message: Message, number: int) -> str:
    transform = message["transform"]
    return pose(transform["translation"], transform["rotation"], 0.2 * number, 0.1 * number)


def of_string(message: Message, number: int) -> str:
    return equal(message["data"], WORDS[number % len(WORDS)])


def of_status(message: Message, number: int) -> str:
    values = {each["key"]: each["value"] for each in message["values"]}
    found = (message["message"], values.get("code"), values.get("subcode"), values.get("error_name"))
    return equal(found, ("This is a test to send status message.", "1", "128", "OK!"))


def of_image(images: Path) -> Callable[[Message, int], str]:
    def wanted(message: Message, number: int) -> str:
        pixels = (images / f"igtlTestImage{number % 5 + 1}.raw").read_bytes()
        size = (message["width"], message["height"], message["encoding"])
        return equal(size, (256, 256, "mono8")) or "other pixels" * (message["data"]["hex"] != pixels.hex())

    return wanted


def of_points(message: Message, number: int) -> str:
    found = [
        (each["name"], each["group"], [round(each["position"][axis] * 1000, 6) for axis in "xyz"], each["owner"])
        for each in message["points"]
    ]
    return equal(
        found, [(f"POINT_{n}", "GROUP_0", [10.0 + 30 * n, 20.0 + 30 * n, 30.0 + 30 * n], "IMAGE_0") for n in range(3)]
    )


def of_paths(name: str) -> Callable[[Message, int], str]:
    """The client sets the target of its second path twice, and none of its third."""
    targets = {"Client": [[20, 20, 40], [10, 40, 20], [0, 0, 0]], "Server": [[20, 20, 40], [20, 30, 10], [10, 40, 20]]}
    wanted = [[[10 + 30 * n, 20 + 30 * n, 30 + 30 * n], target] for n, target in enumerate(targets[name])]

    def differs(message: Message, number: int) -> str:
        ends = [[each[end] for end in ("entry", "target")] for each in message["trajectories"]]
        return equal([[[round(at[axis] * 1000, 6) for axis in "xyz"] for at in each] for each in ends], wanted)

    return differs


def of_tracking(message: Message, number: int) -> str:
    steps = ((0.1, 0.2), (0.2, 0.1), (0.3, 0.05))
    wanted = [("Channel 0", 1), ("Channel 1", 2), ("Channel 2", 4)]
    return equal([(tool["name"], tool["type"]) for tool in message["tools"]], wanted) or next(
        filter(
            None,
            (
                pose(tool["pose"]["position"], tool["pose"]["orientation"], phi * number, theta * number)
                for tool, (phi, theta) in zip(message["tools"], steps, strict=True)
            ),
        ),
        "",
    )


def of_surface(message: Message, number: int) -> str:
    corners = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]]
    found = [[round(point[axis] * 1000, 6) for axis in "xyz"] for point in message["points"]]
    return equal(found, corners) or equal(
        [list(each["values"]) for each in message["attributes"]], [list(map(float, range(8)))]
    )


def examples(images: Path) -> Iterator[Example]:
    for side, words in (("Client", "127.0.0.1 {port}"), ("Server", "{port}")):
        yield Example(f"Tracker{side}", f"{words} 50", "TRANSFORM", f"{IN}Tracker/transform", TRANSFORM, of_tracker)
        yield Example(f"String{side}", f"{words} 50", "STRING", f"{IN}StringMessage/string", STRING, of_string)
        yield Example(f"Status{side}", words, "STATUS", f"{IN}Device/status", STATUS, of_status, 3)
        image = of_image(images)
        yield Example(f"Imager{side}", f"{words} 20 {{images}}", "IMAGE", f"{IN}ImagerClient/image", IMAGE, image)
        yield Example(f"Point{side}", words, "POINT", f"{IN}PointSender/landmarks", POINTS, of_points, 1)
        yield Example(
            f"Trajectory{side}", words, "TRAJ", f"{IN}TrajectorySender/trajectories", PATHS, of_paths(side), 1
        )
    asked = {"kind": 2, "type": "TDATA", "device_name": "Tracker", "resolution": 50, "coordinate_name": "Patient"}
    yield Example("TrackingDataServer", "{port}", "TDATA", f"{IN}Tracker/tracking", TRACKING, of_tracking, asked=asked)
    asked = {"kind": 1, "type": "POLYDATA", "device_name": "Cube"}
    yield Example("PolyDataServer", "{port}", "POLYDATA", f"{IN}Cube/polydata", POLYDATA, of_surface, 1, asked)


def judge(programs: Path, images: Path) -> list[Row]:
    rows = []
    for each in examples(images):
        if (programs / each.name).exists():
            rows.append(_sends(programs, images, each))
            print(rows[-1], flush=True)  # the others take their time
    for name in ("ReceiveClient", "ReceiveServer"):
        if (programs / name).exists():
            rows += _receives(programs, name)
    return [*rows, *(_asks(programs, name) for name in ASKING if (programs / name).exists())]


def _started(stack: ExitStack, command: Sequence[str], output: Any) -> None:
    process = stack.enter_context(subprocess.Popen(command, stdout=output, stderr=subprocess.STDOUT))
    stack.callback(process.kill)


def _sends(programs: Path, images: Path, example: Example) -> Row:
    failed = Row(f"{example.type} of {example.name}", TO_ROS, FAILS)
    with ExitStack() as stack:
        question = f"{OUT}Question"
        node = stack.enter_context(
            RosClient("judge", subscribe={example.topic: example.ros_type}, advertise={question: QUERY})
        )
        port = free_port()
        command = [str(programs / example.name), *example.words.format(port=port, images=images).split()]
        if example.is_server:
            _started(stack, command, subprocess.DEVNULL)
        where = ["--connect"] if example.is_server else ["--listen"]
        bridge = Bridge("--no-cautious", *where, f"127.0.0.1:{port}", listen=False)
        stack.callback(bridge.close)
        stack.callback(bridge.end)
        if not example.is_server:
            _started(stack, command, subprocess.DEVNULL)
        try:
            bridge.wait_code("link_up")
            if example.asked:
                node.wait_readers(question)
                node.publish(question, example.asked)
            for number in range(example.count):
                text = example.wanted(node.receive(example.topic), number)
                if text:
                    return Row(failed.what, TO_ROS, FAILS, number + 1, f"message {number + 1}: {text}"[:400])
        except (AssertionError, KeyError) as error:
            return Row(failed.what, TO_ROS, FAILS, 1, " ".join(f"{type(error).__name__} {error}".split())[:300])
    return Row(failed.what, TO_ROS, EXACT, example.count)


#: What the receiving examples print of a message whose CRC is right.
PRINTED: dict[str, Callable[[Any], list[str]]] = {
    "STRING": lambda content: [f"String: {content['string']}"],
    "STATUS": lambda content: [f" Code      : {content['code']}", f" Status    : {content['status_string']}"],
    "POINT": lambda content: [f" Position  : ( {three(each['position'])} )" for each in content["elements"]],
    "TDATA": lambda content: [f" Name       : {each['name']}" for each in content["elements"]],
    "TRAJ": lambda content: [f" Entry Pt  : ( {three(each['entry'])} )" for each in content["elements"]],
    "IMAGE": lambda content: [f"Dimensions            : ({', '.join(map(str, content['dimensions']))})"],
}


def three(values: Sequence[float]) -> str:
    return ", ".join(f"{value:.6f}" for value in values)


def _receives(programs: Path, name: str) -> list[Row]:
    """Everything that we send of the types that it knows."""
    rows = []
    with ExitStack() as stack:
        node = stack.enter_context(RosClient("judge", advertise=ADVERTISED))
        output = stack.enter_context(tempfile.NamedTemporaryFile())
        port = free_port()
        is_server = "Server" in name
        command = [str(programs / name), *([] if is_server else ["127.0.0.1"]), str(port)]
        if is_server:
            _started(stack, command, output)
        where = ["--connect"] if is_server else ["--listen"]
        bridge = Bridge("--no-cautious", *rows_of_the_command_line(), *where, f"127.0.0.1:{port}", listen=False)
        stack.callback(bridge.close)
        stack.callback(bridge.end)
        if not is_server:
            _started(stack, command, output)
        bridge.wait_code("link_up")
        node.wait_readers(*ADVERTISED.keys() - {"/tf"})  # which the bridge does not send without being asked
        for one in OUTGOING:
            if one.type in PRINTED:
                begin = Path(output.name).stat().st_size
                node.publish(one.topic, one.fields)
                rows.append(_printed(Path(output.name), begin, name, one))
    return results.summed(rows)


#: The examples that ask: arguments, the device that we have of their type, and a line that they print of it.
ASKING = {
    "TrackingDataClient": (("50",), "Tools", " Name       : Tip"),
    "QuaternionTrackingDataClient": (("50",), "QTools", " Name       : Tip"),
    "PolyDataClient": ((), "Liver", "  point[3] = (0, 10, 8.5)"),
    "LabelMetaClient": ((), "Regions", " Name       : Liver"),
    "ImageMetaClient": ((), "Shelf", " PatientID  : P-1"),
}


def _asks(programs: Path, name: str) -> Row:
    """An example that ends when anything precedes its answer, at a bridge that has latched messages of other types."""
    words, device, line = ASKING[name]
    asked = next(one for one in OUTGOING if one.device == device)
    published = [asked, *(one for one in OUTGOING if one.type not in ("TDATA", "QTDATA", asked.type))]
    row = Row(f"{asked.type} that {name} asks for", TO_IGTL, EXACT)
    with ExitStack() as stack:
        node = stack.enter_context(RosClient("judge", advertise={one.topic: one.ros_type for one in published}))
        output = stack.enter_context(tempfile.NamedTemporaryFile())
        bridge = Bridge("--no-cautious", *rows_of_the_command_line())
        stack.callback(bridge.close)
        stack.callback(bridge.end)
        node.wait_readers(*(one.topic for one in published))
        for one in published:
            node.publish(one.topic, one.fields)
        bridge.wait_code("stream", len(published))
        _started(stack, [str(programs / name), "127.0.0.1", str(bridge.port), *words], output)
        deadline = time.monotonic() + TIMEOUT_S
        while (text := Path(output.name).read_text(errors="replace")).find(line) < 0:
            if time.monotonic() > deadline:
                return replace(row, result=FAILS, text=f"not printed: {line!r}, but {text[:200]!r}")
            if words:  # it asks for a stream
                node.publish(asked.topic, asked.fields)
            time.sleep(0.05)
    return row


def _printed(output: Path, begin: int, name: str, one: Any) -> Row:
    wanted, deadline = PRINTED[one.type](one.content), time.monotonic() + TIMEOUT_S
    missing = wanted
    while missing and time.monotonic() < deadline:
        text = output.read_bytes()[begin:].decode(errors="replace")
        missing = [each for each in wanted if each not in text]
        if f"Receiving : {one.type}" in text:
            return Row(f"{one.type} to {name}", TO_IGTL, CANNOT, 1, "it skips this type")
        time.sleep(0.02)
    what = f"{one.type} to {name}"
    if missing:
        return Row(what, TO_IGTL, FAILS, 1, f"{one.device}: not printed: {missing}"[:300])
    return Row(what, TO_IGTL, EXACT)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--programs", type=Path, required=True, help="folder of the example programs")
    parser.add_argument("--images", type=Path, required=True, help="folder of the images that ImagerServer sends")
    parser.add_argument("--version", help="of the library that they were built on (default: Debian's)")
    options = parser.parse_args()
    version = options.version or debian("libopenigtlink1.11")
    rows = judge(options.programs, options.images)
    return results.write(
        "examples", "Examples of OpenIGTLink", f"on the library {version}", "servers and clients", rows
    )


if __name__ == "__main__":
    sys.exit(main())
