"""sawOpenIGTLink of cisst, the OpenIGTLink server of the dVRK, between whose arm and ROS the gateway stands.

``python tools/judges/cisst.py --program PATH --unchanged PATH``: ``programs/cisst``, built twice over cisst.
Writes docs/evidence/real-programs/cisst.jsonl; exit code 1 if anything differs.

Strategy: the arm computes what it sends from the number of the message, which its stamp or its text has, and this judge
does so, too; a rclpy node on the topics of CRTK must have all of them, in order and without a gap.  Commands of that
node come back as the arm prints them.  The options are those of docs/how-to/dvrk.md.  As it is, sawOpenIGTLink closes
the link of a client that is silent for 10 ms, so that the first program has one line of it changed.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[2]))

from igtl_gateway.convert.crtk import BY_NAME
from tests.integration.bridge import TIMEOUT_S, Bridge, Program, RosClient, free_port, gateway
from tests.integration.test_ros_types import IN, OUT
from tools.judges import results
from tools.judges.plus import turned
from tools.judges.results import BOTH, CANNOT, DIFFERS, EXACT, FAILS, TO_IGTL, TO_ROS, Row

Json = dict[str, Any]
ARM = "PSM1"
MESSAGES, COMMANDS, EVENTS = 50, 20, 10
BEGIN_S, PER_S, JOINTS, INVALID = 1_700_000_000, 4, range(3), 5
CLOSE = 1e-6  # of float32
SILENT = (
    "closed after 10 ms, events and commands are lost: it takes a time-out for the end, as OpenIGTLink 3.1 reports 0 "
    "bytes for both; its fault.  The gateway connects again, and misses no state"
)
FIXTURE = results.ROOT / "fixtures" / "crtk.mcap"


# ── what the arm sends ─────────────────────────────────────────────────────────────────────────────────────────────


def pose(number: int) -> Any:
    """In metres."""
    return turned(0.05 * number, (0.001 * number, -0.25, 0.5 + 0.002 * number))


def place(at: Json, turn: Json) -> Any:
    """The matrix of a ROS pose."""
    x, y, z, w = (turn[axis] for axis in "xyzw")
    full = np.eye(4)
    full[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    full[:3, 3] = [at[axis] for axis in "xyz"]
    return full


def close(found: Any, wanted: Any) -> bool:
    return np.shape(found) == np.shape(wanted) and bool(np.all(np.abs(np.subtract(found, wanted)) < CLOSE))


def six(message: Json, first: str, second: str) -> list[float]:
    return [message[part][axis] for part in (first, second) for axis in "xyz"]


def is_pose(message: Json, number: int) -> bool:
    return close(place(message["pose"]["position"], message["pose"]["orientation"]), pose(number))


def is_measured(message: Json, number: int) -> bool:
    wanted = {
        "position": [0.1 * number + joint for joint in JOINTS],
        "velocity": [-0.2 * number + joint for joint in JOINTS],
        "effort": [0.3 * number - joint for joint in JOINTS],
    }
    return all(close(message[name], values) for name, values in wanted.items())


def is_setpoint(message: Json, number: int) -> bool:
    positions = [0.1 * number + joint for joint in JOINTS]
    return close(message["position"], positions) and message["velocity"] == message["effort"] == []


def is_twist(message: Json, number: int) -> bool:
    wanted = [0.01 * number, 0.02 * number, 0.03 * number, 0.1 * number, -0.2 * number, 0.3 * number]
    return close(six(message["twist"], "linear", "angular"), wanted)


def is_wrench(message: Json, number: int) -> bool:
    return close(six(message["wrench"], "force", "torque"), [0.25 * number + i for i in range(6)])


def is_button(message: Json, number: int) -> bool:
    return bool(message["buttons"] == [(1, 0, 2)[number % 3]])


def is_tip(message: Json, number: int) -> bool:
    return close([1000 * message["point"][axis] for axis in "xyz"], [number, -7.5, 100.25])


def is_text(message: Json, number: int) -> bool:
    return True  # the number is what it has


def by_stamp(message: Json) -> int:
    at = message["header"]["stamp"]
    return int((at["sec"] - BEGIN_S) * PER_S + at["nanosec"] * PER_S // 1_000_000_000)


def by_text(message: Json) -> int:
    return int(message["data"].split()[1])


def by_point(message: Json) -> int:
    return round(1000 * message["point"]["x"])


@dataclass(frozen=True)
class State:
    """What the arm sends.

    Attributes:
        type, topic, ros_type: in OpenIGTLink, and where and as what the node has it.
        number: that of a message.
        is_right: whether a message is what the arm has sent under a number.
        count: of messages to compare.
        invalid: each message with a multiple of this number is not valid, and sent by no one.
    """

    type: str
    topic: str
    ros_type: str
    number: Callable[[Json], int]
    is_right: Callable[[Json, int], bool]
    count: int = MESSAGES
    invalid: int = 0

    @property
    def what(self) -> str:
        return f"{self.type} {self.topic.removeprefix('/').removeprefix(IN.removeprefix('/'))}"


def crtk(name: str, is_right: Callable[[Json, int], bool], **others: Any) -> State:
    row = BY_NAME[name]
    by = by_text if row.igtl_type == "STRING" else by_stamp
    return State(row.igtl_type, f"/{ARM}/{name}", row.ros_type, by, is_right, **others)


STATES = (
    crtk("measured_cp", is_pose),
    crtk("setpoint_cp", is_pose, invalid=INVALID),
    crtk("measured_js", is_measured),
    crtk("setpoint_js", is_setpoint),
    crtk("measured_cv", is_twist),
    crtk("measured_cf", is_wrench),
    crtk("status", is_text, count=EVENTS),
    crtk("warning", is_text, count=EVENTS),
    crtk("error", is_text, count=EVENTS),
    crtk("clutch", is_button, count=EVENTS),
    State("POINT", f"{IN}Tip/point", "geometry_msgs/msg/PointStamped", by_point, is_tip),
    State("STRING", f"{IN}Note/string", "std_msgs/msg/String", by_text, is_text),
)


# ── commands ───────────────────────────────────────────────────────────────────────────────────────────────────────


def pose_command(number: int) -> Json:
    half = 0.05 * number / 2
    turn = {axis: float(np.sin(half)) * part / 3 for axis, part in zip("xyz", (1, 2, 2), strict=True)}
    at = dict(zip("xyz", map(float, pose(number)[:3, 3]), strict=True))
    return {"header": now(), "pose": {"position": at, "orientation": {**turn, "w": float(np.cos(half))}}}


def now() -> Json:
    """The header of a command: without a stamp CRTK takes it for not valid."""
    seconds, nanoseconds = divmod(time.time_ns(), 1_000_000_000)
    return {"stamp": {"sec": seconds, "nanosec": nanoseconds}, "frame_id": "base"}


def numbers_of_pose(number: int) -> list[float]:
    return [*pose(number)[:3, :3].ravel(), *pose(number)[:3, 3]]


def joints(number: int) -> list[float]:
    return [0.125 * number + joint for joint in JOINTS]


def force(number: int) -> list[float]:
    return [0.5 * number - i for i in range(6)]


def joint_command(number: int) -> Json:
    return {"header": now(), "name": ["a", "b", "c"], "position": joints(number)}


def force_command(number: int) -> Json:
    parts = {
        part: dict(zip("xyz", force(number)[at : at + 3], strict=True)) for part, at in (("force", 0), ("torque", 3))
    }
    return {"header": now(), "wrench": parts}


@dataclass(frozen=True)
class Command:
    """What the node sends.

    Attributes:
        name: the command as the arm prints it.
        device: of it in OpenIGTLink.
        fields, wanted: the ROS message with a number, and what the arm prints of it.
    """

    type: str
    topic: str
    ros_type: str
    name: str
    device: str
    fields: Callable[[int], Json]
    wanted: Callable[[int], Any]


def command(name: str, fields: Callable[[int], Json], wanted: Callable[[int], Any]) -> Command:
    row = BY_NAME[name]
    return Command(row.igtl_type, f"/{ARM}/{name}", row.ros_type, name, f"{ARM}/{name}", fields, wanted)


COMMANDED = (
    *(command(name, pose_command, numbers_of_pose) for name in ("servo_cp", "move_cp")),
    *(command(name, joint_command, joints) for name in ("servo_jp", "servo_jr", "move_jp", "move_jr")),
    command("servo_cf", force_command, force),
    command("state_command", lambda number: {"header": now(), "string": f"pause {number}"}, "pause {}".format),
    Command(
        "POINT",
        f"{OUT}Aim",
        "geometry_msgs/msg/PointStamped",
        "aim",
        "Aim",
        lambda number: {"header": now(), "point": {"x": number / 1000, "y": -0.0075, "z": 0.10025}},
        lambda number: [float(number), -7.5, 100.25],
    ),
    Command(
        "STRING",
        f"{OUT}Label",
        "std_msgs/msg/String",
        "label",
        "Label",
        lambda number: {"data": f"label {number}"},
        "label {}".format,
    ),
)
#: Of CRTK, but sawOpenIGTLink has neither a sender nor a receiver.
WITHOUT = (("operating_state", TO_ROS), ("hold", TO_IGTL), ("free", TO_IGTL))


# ── the bridge between ROS and cisst ───────────────────────────────────────────────────────────────────────────────


class Arm(Program):
    """The program, whose lines are commands that it received."""

    def __init__(self, program: Path, port: int) -> None:
        unknown = [one.name for one in COMMANDED if one.name.encode() not in program.read_bytes()]
        assert not unknown, f"{program}: found no {', '.join(unknown)}; build it again from programs/cisst"
        super().__init__([str(program), str(port)], stdin=subprocess.PIPE)

    def commanded(self, name: str) -> list[Any]:
        found = [json.loads(line) for line in list(self.lines) if line.startswith("{")]
        return [each.get("values", each.get("text")) for each in found if each["command"] == name]

    def has(self, name: str, count: int) -> bool:
        return len(self.commanded(name)) >= count


@contextmanager
def world(program: Path, *words: str) -> Iterator[tuple[RosClient, Arm, Bridge]]:
    """The bridge between a rclpy node and the arm, with the options of docs/how-to/dvrk.md."""
    with ExitStack() as stack:
        listened = {each.topic: each.ros_type for each in STATES}
        said = {each.topic: each.ros_type for each in COMMANDED}
        node = stack.enter_context(RosClient("judge", subscribe=listened, advertise=said))
        port = free_port()
        arm = stack.enter_context(closing(Arm(program, port)))
        allowed = [f"--allow-in={each.topic[1:]}" for each in STATES if each.topic.startswith(f"/{ARM}/")]
        allowed += [f"--allow-out={each.device}" for each in COMMANDED if each.topic.startswith(f"/{ARM}/")]
        bridge = Bridge("--connect", f"127.0.0.1:{port}", "--profile", "crtk", *allowed, *words)
        stack.callback(bridge.close)
        stack.callback(bridge.end)
        bridge.wait_code("link_up")
        node.wait_readers(*said)
        yield node, arm, bridge


def judge(program: Path, folder: Path) -> list[Row]:
    recording = folder / "cisst.mcap"
    with world(program, "--record", str(recording)) as (node, arm, _):
        rows = [_tried(each.what, TO_ROS, _sent, node, each) for each in STATES]
        rows += [_tried(f"{each.type} {each.device}", TO_IGTL, _got, node, arm, each) for each in COMMANDED]
    for name, direction in WITHOUT:
        rows.append(
            Row(f"{BY_NAME[name].igtl_type} {ARM}/{name}", direction, CANNOT, 1, "sawOpenIGTLink leaves it out")
        )
    for path in (recording, FIXTURE):
        rows.append(_tried(f"replay of {path.name} to its server", TO_IGTL, _replayed, program, path))
    return rows


def unchanged(program: Path) -> Iterator[Row]:
    """What the arm sends at each beginning of a link, before it closes it."""
    with world(program) as (node, _, bridge):
        for each in STATES:
            if each.count == MESSAGES:
                yield _tried(f"{each.what}, unchanged", TO_ROS, _sent, node, each, "unchanged")
        closed = sum(event.get("code") == "link_down" for event in bridge.events)
    if closed > 1:
        yield Row("links of silent clients, unchanged", BOTH, DIFFERS, closed, SILENT)


def _tried(what: str, direction: str, run: Callable[..., Row], *given: Any) -> Row:
    try:
        return run(*given)
    except (AssertionError, KeyError, ValueError) as error:
        return Row(what, direction, FAILS, 1, " ".join(f"{type(error).__name__} {error}".split())[:300])


def _sent(node: RosClient, state: State, kind: str = "") -> Row:
    """Equal messages, each after the one before it."""
    node.wait_until(lambda: node.waiting(state.topic) >= state.count, f"{state.count} of {state.topic}")
    messages = node.received(state.topic)[: state.count]
    numbers = [state.number(message) for message in messages]
    there = [n for n in range(numbers[0], numbers[-1] + 1) if not state.invalid or n % state.invalid]
    assert numbers == there, f"found the numbers {numbers}"
    for message, number in zip(messages, numbers, strict=True):
        assert state.is_right(message, number), f"message {number}: {message}"
    return Row(", ".join(filter(None, (state.what, kind))), TO_ROS, EXACT, len(messages))


def _got(node: RosClient, arm: Arm, one: Command) -> Row:
    """One command after the other, each of which arrives once."""
    for number in range(1, COMMANDS + 1):
        node.publish(one.topic, one.fields(number))
        arm.wait_until(partial(arm.has, one.name, number), f"{one.name} {number}")
    for number, found in enumerate(arm.commanded(one.name), 1):
        wanted = one.wanted(number)
        assert found == wanted if isinstance(wanted, str) else close(found, wanted), f"{found}, expected {wanted}"
    assert len(arm.commanded(one.name)) == COMMANDS
    return Row(f"{one.type} {one.device}", TO_IGTL, EXACT, COMMANDS)


def _replayed(program: Path, path: Path) -> Row:
    """All of a recording as fast as possible; then the arm still answers, to a bridge."""
    port = free_port()
    with closing(Arm(program, port)) as arm:
        words = ("--to", "igtl", "--connect", f"127.0.0.1:{port}", "--as-fast-as-possible")
        with closing(gateway("replay", str(path), *words)) as sender:
            assert sender.process.wait(4 * int(TIMEOUT_S)) == 0, sender.said()
        assert arm.process.poll() is None, "it ended"
        with closing(Bridge("--no-ros", "--connect", f"127.0.0.1:{port}", "--profile", "crtk")) as bridge:
            bridge.wait_code("stream")
    return Row(f"replay of {path.name} to its server: it lives, and sends", TO_IGTL, EXACT)


def main(args: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--program", type=Path, required=True, help="crtk_arm, over sawOpenIGTLink with the changed condition"
    )
    parser.add_argument("--unchanged", type=Path, required=True, help="the same, of sawOpenIGTLink as it is")
    parser.add_argument(
        "--version",
        default="1.3.0 (0d10f7b, one condition changed, and unchanged), cisst 1.4.0 (fe84bf08)",
        help="(default: %(default)s)",
    )
    options = parser.parse_args(args)
    with tempfile.TemporaryDirectory() as name:
        rows = [*judge(options.program.resolve(), Path(name)), *unchanged(options.unchanged.resolve())]
    return results.write("cisst", "cisst: sawOpenIGTLink", options.version, "server, with an arm of CRTK", rows)


if __name__ == "__main__":
    sys.exit(main())
