"""OpenIGTLinkIO, of which 3D Slicer's connector is made, as client and as server of the gateway; and under replays.

``python tools/judges/openigtlinkio.py --program PATH``: a program on igtlioLogic and igtlioConnector that takes JSON
lines: ``{"op": "client" | "server", "port"}``, ``{"op": "send", "type", "name", …}``, ``{"op": "command", …}`` and
prints what it receives as ``{"ev": "recv", "type", "name", …}``.  Writes
docs/evidence/real-programs/openigtlinkio.jsonl; exit code 1 if anything fails.

Strategy: the messages are those of ``ros_types``, as far as OpenIGTLinkIO has a device of their type.  It sends no
stamps: those are not compared.  Replays of the fixtures go to a client each, which must be alive afterwards.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[2]))

from igtl_gateway.wire import decode
from igtl_gateway.wire.registry import describe_content
from tests.integration.bridge import Bridge, Program, RosClient, free_port, gateway
from tests.integration.test_ros_types import (
    ADVERTISED,
    CASES,
    OUTGOING,
    SERVICE,
    SUBSCRIBED,
    Case,
    Sent,
    children,
    packed,
    rows_of_the_command_line,
)
from tools.judges import results
from tools.judges.results import BOTH, CANNOT, DIFFERS, EXACT, FAILS, TO_IGTL, TO_ROS, Row

Json = dict[str, Any]
HEAD_BYTES = 72  # of the content of an IMAGE
#: The scalar types of IMAGE → those of VTK.
VTK_SCALARS = {3: 3, 4: 4, 5: 5, 6: 6, 7: 7, 10: 10, 11: 11}
SUBCODE = "the subcode is the code: its fault"
FIXTURES = results.ROOT / "fixtures"


class Connector(Program):
    """The program, by its lines."""

    def __init__(self, program: Path, folder: Path) -> None:
        self.events: list[Json] = []
        super().__init__([str(program), str(folder)], stdin=subprocess.PIPE)

    def take(self, line: str) -> None:
        self.events.append(json.loads(line))

    def do(self, op: str, **fields: Any) -> None:
        assert self.process.stdin is not None
        self.process.stdin.write(json.dumps({"op": op, **fields}).encode() + b"\n")
        self.process.stdin.flush()

    def event(self, kind: str, **fields: Any) -> Json:
        """The first event with these fields; it is not found again."""

        def found() -> int | None:
            wanted = {"ev": kind, **fields}.items()
            return next((n for n, event in enumerate(self.events) if wanted <= {**event}.items()), None)

        def is_there() -> bool:
            return found() is not None

        self.wait_until(is_there, f"{kind} {fields}")
        place = found()
        assert place is not None
        return self.events.pop(place)


@dataclass(frozen=True)
class Place:
    node: RosClient
    peer: Connector
    bridge: Bridge
    folder: Path


@contextmanager
def world(program: Path, is_server: bool) -> Iterator[Place]:
    """The bridge between a rclpy node and the program."""
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        node = stack.enter_context(RosClient("judge", subscribe=SUBSCRIBED, advertise=ADVERTISED))
        peer = Connector(program, folder)
        stack.callback(peer.close)
        port = free_port()
        if is_server:
            peer.do("server", port=port)
        words = ["--connect", f"127.0.0.1:{port}"] if is_server else []
        bridge = Bridge("--no-cautious", *rows_of_the_command_line(), *words)
        stack.callback(bridge.close)
        stack.callback(bridge.end)
        if not is_server:
            peer.do("client", port=bridge.port)
        bridge.wait_code("link_up")
        peer.event("connected")
        node.wait_readers(*ADVERTISED)
        yield Place(node, peer, bridge, folder)


def judge(program: Path) -> list[Row]:
    rows = []
    for is_server in (False, True):
        with world(program, is_server) as place:
            rows += [_tried(case.type, TO_ROS, _in, place, case) for case in CASES if case.type in SENT]
            rows += [_tried(one.type, TO_IGTL, _out, place, one) for one in OUTGOING if one.type in SHOWN]
            rows.append(_tried("COMMAND and its reply", BOTH, _command, place, None))
    return results.summed(rows)


def _tried(what: str, direction: str, run: Callable[[Any, Any], Row], place: Any, one: Any) -> Row:
    try:
        return run(place, one)
    except (AssertionError, TimeoutError, KeyError, BrokenPipeError) as error:
        text = " ".join(f"{one}: {type(error).__name__} {error}".split())
        return Row(what, direction, FAILS, 1, text[:300])


# ── what it sends ──────────────────────────────────────────────────────────────────────────────────────────────────


def matrix(rows: Sequence[Sequence[float]]) -> list[float]:
    return [float(each) for row in rows for each in row]


def corner(wire: Sequence[float], size: Sequence[int]) -> list[float]:
    """The place of the first voxel, as VTK has it, of a matrix about the centre, as the wire has it."""
    axes = np.array(wire[:9]).reshape(3, 3).T
    full = np.eye(4)
    full[:3, :3] = axes
    full[:3, 3] = np.array(wire[9:]) - axes @ (np.array(size) - 1) / 2
    return [float(each) for each in full.ravel()]


def spacing(wire: Sequence[float]) -> list[float]:
    return [float(np.linalg.norm(wire[3 * axis : 3 * axis + 3])) for axis in range(3)]


def of_image(content: Json, case: Case, folder: Path) -> Json:
    raw = folder / f"{case.device}.pixels"
    raw.write_bytes(case.content[HEAD_BYTES:])
    wire, size = content["wire_matrix"], content["dimensions"]
    return {
        "dims": size,
        "spacing": spacing(wire),
        "scalar": VTK_SCALARS[content["scalar_type"]],
        "comp": content["num_components"],
        "matrix": corner(wire, size),
        "raw": str(raw),
    }


def of_polydata(content: Json, case: Case, folder: Path) -> Json:
    lines = ["# vtk DataFile Version 3.0", case.device, "ASCII", "DATASET POLYDATA"]
    lines += [f"POINTS {len(content['points'])} float", *(" ".join(map(str, each)) for each in content["points"])]
    for name in ("vertices", "lines", "polygons", "triangle_strips"):
        if cells := content[name]:
            lines += [f"{name.upper()} {len(cells)} {sum(len(each) + 1 for each in cells)}"]
            lines += [" ".join(map(str, [len(each), *each])) for each in cells]
    lines += [f"POINT_DATA {len(content['points'])}"]
    for each in content["attributes"]:
        lines += [f"SCALARS {each['name']} float 1", "LOOKUP_TABLE default", *map(str, each["data"])]
    path = folder / f"{case.device}.vtk"
    path.write_text("\n".join(lines) + "\n")
    return {"file": str(path)}


def of_points(content: Json, _case: Case, _folder: Path) -> Json:
    keys = {"pos": "position", "radius": "diameter"}
    names = ("name", "group", "rgba", "owner")
    pts = [{name: each[keys.get(name, name)] for name in (*names, *keys)} for each in content["elements"]]
    return {"pts": pts}


def of_status(content: Json, _case: Case, _folder: Path) -> Json:
    names = {"code": "code", "sub": "subcode", "err": "error_name", "msg": "status_string"}
    return {name: content[key] for name, key in names.items()}


def of_tools(content: Json, _case: Case, _folder: Path) -> Json:
    return {"tools": [{**each, "matrix": matrix(each["matrix"])} for each in content["elements"]]}


#: Type → the fields that the program sends of a content.
SENT: dict[str, Callable[[Json, Case, Path], Json]] = {
    "TRANSFORM": lambda content, _case, _folder: {"matrix": matrix(content["matrix"])},
    "STRING": lambda content, _case, _folder: {"string": content["string"], "encoding": content["encoding"]},
    "STATUS": of_status,
    "IMAGE": of_image,
    "POINT": of_points,
    "POLYDATA": of_polydata,
    "TDATA": of_tools,
}


def _in(place: Place, case: Case) -> Row:
    if case.metadata is not None:
        return Row(case.type, TO_ROS, CANNOT, 1, "metadata of the case: it sends its own")
    content = describe_content(decode(packed(case.type, case.device, case.content)).content)
    fields = SENT[case.type](content, case, place.folder)
    place.peer.do("send", type=case.type, name=case.device, mrml=False, **fields)
    text = ""
    for kind, (_, expected) in case.heard.items():
        received = place.node.receive(case.topic(kind))
        while kind == "tf" and children(received) != children(expected):
            received = place.node.receive(case.topic(kind))
        got, wanted = without_stamps(received), without_stamps(expected)
        if case.type == "STATUS" and got != wanted:
            got["values"] = [{**each, "value": "-42"} if each["key"] == "subcode" else each for each in got["values"]]
            text = SUBCODE
        assert got == wanted, f"{kind} has {got}, expected {wanted}"
    return Row(case.type, TO_ROS, DIFFERS if text else EXACT, 1, text)


def without_stamps(value: Any) -> Any:
    """The message without times and metadata: it sends its own of them."""
    if isinstance(value, dict):
        return {key: without_stamps(one) for key, one in value.items() if key not in ("stamp", "metadata")}
    return [without_stamps(one) for one in value] if isinstance(value, list) else value


# ── what it receives ───────────────────────────────────────────────────────────────────────────────────────────────


def shown_image(event: Json) -> Json:
    raw = Path(event["raw"]).read_bytes()
    return {"dims": event["dims"], "comp": event["comp"], "data": list(raw), "matrix": event["ijk2ras"]}


def wanted_image(content: Json) -> Json:
    size = content["dimensions"]
    wire = content.get("wire_matrix", [1, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0])
    place = corner(wire, size)
    return {"dims": size, "comp": content.get("num_components", 1), "data": content["data"], "matrix": place}


def shown_polydata(event: Json) -> Json:
    points = Path(event["file"]).read_bytes().partition(b"POINTS ")[2].partition(b"\n")[2]
    count = event["points"]
    there = np.frombuffer(points, ">f4", 3 * count).reshape(count, 3).tolist()
    cells = [event[name] for name in ("verts", "lines", "polys", "strips")]
    return {"points": there, "cells": cells, "arrays": [each[1:4] for each in event["arrays"]]}


def wanted_polydata(content: Json) -> Json:
    cells = [len(content[name]) for name in ("vertices", "lines", "polygons", "triangle_strips")]
    arrays = [[each["name"], each["ncomponents"], each["n"]] for each in content["attributes"]]
    return {"points": content["points"], "cells": cells, "arrays": arrays}


def picked(key: str, **names: str) -> Callable[[Json], list[Json]]:
    """The elements of a list, with our names of fields."""
    return lambda event: [{ours: each[its] for ours, its in names.items()} for each in event[key]]


#: Type → what it shows of a message, and what our content has of that.
SHOWN: dict[str, tuple[Callable[[Json], Any], Callable[[Json], Any]]] = {
    "TRANSFORM": (lambda event: event["matrix"], lambda content: matrix(content["matrix"])),
    "STRING": (lambda event: event["string"], lambda content: content["string"]),
    "STATUS": (
        lambda event: [event[each] for each in ("code", "sub", "err", "msg")],
        lambda content: [content[each] for each in ("code", "subcode", "error_name", "status_string")],
    ),
    "IMAGE": (shown_image, wanted_image),
    "POLYDATA": (shown_polydata, wanted_polydata),
    "POINT": (
        picked("pts", position="pos", diameter="radius", name="name", rgba="rgba"),
        lambda content: content["elements"],
    ),
    "TDATA": (
        lambda event: [[each["tname"] or each["name"], each["matrix"]] for each in event["tools"]],
        lambda content: [[each["name"], matrix(each["matrix"])] for each in content["elements"]],
    ),
    "IMGMETA": (
        picked("list", name="name", device_name="dev", modality="modality", patient_name="pname", patient_id="pid"),
        lambda content: content["elements"],
    ),
    "LBMETA": (
        picked("list", name="name", device_name="dev", label="label", rgba="rgba", size="size", owner="owner"),
        lambda content: content["elements"],
    ),
}


def _out(place: Place, one: Sent) -> Row:
    place.node.publish(one.topic, one.fields)
    event = place.peer.event("recv", type=one.type, name=one.device)
    shows, wants = SHOWN[one.type]
    got, wanted = shows(event), wants(one.content)
    assert same(got, wanted), f"{got}, expected {wanted}"
    return Row(one.type, TO_IGTL, EXACT)


def same(got: Any, wanted: Any) -> bool:
    """Equal in what both have; floats to the last bits of a float32."""
    if isinstance(got, dict):
        return all(same(got[key], wanted[key]) for key in got.keys() & wanted.keys())
    if isinstance(got, list):
        return len(got) == len(wanted) and all(map(same, got, wanted))
    return bool(np.isclose(got, wanted, 1e-6, 1e-4)) if isinstance(got, float) else bool(got == wanted)


def _command(place: Place, _: None) -> Row:
    fields = {"device_name": "Console", "name": "Move", "content": "<To x='1'/>", "timeout": 15.0}
    place.node.call(SERVICE, "igtl_msgs/srv/SendCommand", fields)
    asked = place.peer.event("command")
    assert (asked["name"], asked["content"]) == ("Move", "<To x='1'/>"), asked
    reply = place.node.receive(SERVICE)
    assert reply["content"] == "reply to Move: <To x='1'/>", reply
    return Row("COMMAND and its reply", BOTH, EXACT)


# ── replays ────────────────────────────────────────────────────────────────────────────────────────────────────────


def replays(program: Path, recordings: Sequence[Path]) -> list[Row]:
    """Each recording as fast as possible to a client of its own."""
    return [_tried(f"replay of {path.name}", TO_IGTL, _replayed, program, path) for path in recordings]


def _replayed(program: Path, path: Path) -> Row:
    port = free_port()
    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        words = ("replay", str(path), "--to", "igtl", "--listen", f"127.0.0.1:{port}", "--as-fast-as-possible")
        sender = gateway(*words)
        stack.callback(sender.close)
        peer = Connector(program, Path(folder))
        stack.callback(peer.close)
        peer.do("set", raw=False)
        peer.do("client", port=port)
        peer.event("connected")
        sender.process.wait(120)
        peer.do("counts")
        counts = peer.event("counts")["counts"]
        peer.do("quit")
        code = peer.process.wait(30)
    assert code == 0, f"it ended with {code}"
    return Row(f"replay of {path.name}: received, and lives", TO_IGTL, EXACT, sum(counts.values()))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--program", type=Path, required=True, help="the program on OpenIGTLinkIO")
    parser.add_argument("--version", default="d7f6aef", help="of OpenIGTLinkIO (default: %(default)s)")
    parser.add_argument("--replay", type=Path, nargs="*", default=[], help="further recordings that are replayed to it")
    options = parser.parse_args()
    recordings = [*sorted(FIXTURES.glob("*.mcap")), *map(Path.resolve, options.replay)]
    rows = [*judge(options.program), *replays(options.program, recordings)]
    role = "client and server, as 3D Slicer's connector"
    return results.write("openigtlinkio", "OpenIGTLinkIO", options.version, role, rows)


if __name__ == "__main__":
    sys.exit(main())
