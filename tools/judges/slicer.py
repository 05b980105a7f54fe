"""3D Slicer's connector on 3D Slicer's scene, as client and as server of the gateway: nodes, log, load, memory.

``python tools/judges/slicer.py --program PATH``: the program ``programs/slicer_node.cpp``, compiled against slicer-core
and the MRML part of SlicerOpenIGTLink.  Writes docs/evidence/real-programs/slicer.jsonl; exit code 1 if anything fails.

Strategy: what ROS publishes is compared with the node that a person sees in Slicer, in millimetres and RAS, and what a
person sets in Slicer with what ROS receives, in metres.  After each scenario Slicer's log must not have a line.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

sys.path.insert(0, str(Path(__file__).parents[2]))

from igtl_gateway.convert.names import name_hash, short_device_name
from tests.integration.bridge import Bridge, Program, RosClient, free_port, gateway
from tests.integration.test_ros_types import MOVED, OUTGOING, SERVICE, Sent, hexed, rows_of_the_command_line, xyz
from tools.judges import results
from tools.judges.openigtlinkio import corner, same
from tools.judges.results import BOTH, CANNOT, DIFFERS, EXACT, FAILS, TO_IGTL, TO_ROS, Row

Json = dict[str, Any]
Floats = npt.NDArray[np.float64]
VERSIONS = "slicer-core 5.13.31053.0, SlicerOpenIGTLink d090ca4, OpenIGTLinkIO d7f6aef, OpenIGTLink 94244fe, VTK 9.6.2"
#: A warning that its connector gives at the first picture of each size, if a pixel is not 1 mm wide.
OWN_WARNING = "In vtkMRMLVolumeNode.cxx"
OWN_TEXT = "{}, one at the first picture of each size whose pixels are not of 1 mm, of any sender: its fault"
FIXTURES = results.ROOT / "fixtures"
RANDOM = 20  # messages of each kind with random values
#: Of what Slicer sends: topic → type.
HEARD = {
    "/igtl/in/SlicerPose/transform": "geometry_msgs/msg/TransformStamped",
    "/igtl/in/SlicerText/string": "std_msgs/msg/String",
    "/igtl/in/SlicerState/status": "diagnostic_msgs/msg/DiagnosticStatus",
    "/igtl/in/SlicerMarks/landmarks": "igtl_msgs/msg/PointList",
    "/igtl/in/SlicerModel/polydata": "igtl_msgs/msg/PolyData",
    "/igtl/in/SlicerModel/mesh": "shape_msgs/msg/Mesh",
    "/igtl/in/SlicerVolume/volume": "igtl_msgs/msg/Volume",
    "/igtl/in/SlicerColors/image": "sensor_msgs/msg/Image",
}
TALK = {
    "/igtl/out/RandomPose": "geometry_msgs/msg/PoseStamped",
    "/igtl/out/RandomVolume": "igtl_msgs/msg/Volume",
    "/igtl/out/RandomMarks": "igtl_msgs/msg/PointList",
    "/igtl/out/RandomMesh": "shape_msgs/msg/Mesh",
    "/igtl/out/RandomCloud": "sensor_msgs/msg/PointCloud2",
}
SPEAKS = {one.topic: one.ros_type for one in OUTGOING} | TALK


class Slicer(Program):
    """The program, by its lines."""

    def __init__(self, program: Path, folder: Path) -> None:
        self.events: list[Json] = []
        super().__init__([str(program), str(folder)], stdin=subprocess.PIPE)

    def take(self, line: str) -> None:
        self.events.append(json.loads(line))

    def do(self, *words: Any) -> None:
        assert self.process.stdin is not None
        self.process.stdin.write("\t".join(map(str, words)).encode() + b"\n")
        self.process.stdin.flush()

    def event(self, kind: str, wanted: Callable[[Json], bool] = lambda _: True, what: str = "") -> Json:
        """The first such event; what came before it is forgotten."""
        seen = 0

        def found() -> bool:
            nonlocal seen
            while seen < len(self.events):
                if self.events[seen]["ev"] == kind and wanted(self.events[seen]):
                    return True
                seen += 1
            return False

        self.wait_until(found, f"{kind} {what}")
        event = self.events[seen]
        del self.events[: seen + 1]
        return event

    def node(self, name: str, wanted: Callable[[Json], bool] = lambda _: True) -> Json:
        return self.event("node", lambda event: event["name"] == name and wanted(event), name)

    def counts(self) -> Json:
        self.do("counts")
        return self.event("counts")

    def log_lines(self) -> tuple[int, int]:
        """Errors and warnings in its log, and those of them which its connector makes itself."""
        counts = self.counts()
        own = self.stderr().count(f"\nWarning: {OWN_WARNING}")
        return int(counts["errors"] + counts["warnings"]) - own or len(self.stderr().splitlines()) * (not own), own

    def resident_bytes(self) -> int:
        status = Path(f"/proc/{self.process.pid}/status").read_text()
        return int(status.partition("RssAnon:")[2].split()[0]) << 10


@dataclass(frozen=True)
class Place:
    node: RosClient
    slicer: Slicer
    bridge: Bridge
    folder: Path
    random: np.random.Generator


@contextmanager
def world(program: Path, is_server: bool, *words: str) -> Iterator[Place]:
    """The bridge as users start it, between a rclpy node and Slicer."""
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        node = stack.enter_context(RosClient("judge", subscribe=HEARD, advertise=SPEAKS))
        slicer = Slicer(program, folder)
        stack.callback(slicer.close)
        port = free_port()
        if is_server:
            slicer.do("server", "C", port)
            words = (*words, "--connect", f"127.0.0.1:{port}")
        bridge = Bridge(*rows_of_the_command_line(), *words)
        stack.callback(bridge.close)
        stack.callback(bridge.end)
        if not is_server:
            slicer.do("client", "C", bridge.port)
        slicer.event("connected")
        bridge.wait_code("link_up")
        node.wait_readers(*SPEAKS)
        yield Place(node, slicer, bridge, folder, np.random.default_rng(2026))


def _tried(what: str, direction: str, run: Callable[..., Row], *words: Any) -> Row:
    try:
        return run(*words)
    except (AssertionError, TimeoutError, KeyError, BrokenPipeError, ConnectionError, OSError) as error:
        return Row(what, direction, FAILS, 1, " ".join(f"{type(error).__name__} {error}".split())[:300])


def quiet(slicer: Slicer, what: str, role: str) -> Row:
    """The row of Slicer's log."""
    lines, own = slicer.log_lines()
    result = FAILS if lines else DIFFERS if own else EXACT
    text = f"{lines}: {' '.join(slicer.stderr().split())[:200]}" if lines else OWN_TEXT.format(own) * bool(own)
    return Row(f"lines in its log: {what}, {role}", BOTH, result, 1, text)


# ── what Slicer shows ──────────────────────────────────────────────────────────────────────────────────────────────


def numbers(path: str, kind: str = "f8") -> npt.NDArray[Any]:
    data = np.fromfile(path, kind)
    Path(path).unlink()
    return data


def cells(path: str) -> list[list[int]]:
    ids, at, found = numbers(path, "i8").tolist(), 0, []
    while at < len(ids):
        found.append(ids[at + 1 : at + 1 + ids[at]])
        at += 1 + ids[at]
    return found


def matrix(rows: Any) -> list[float]:
    return [float(each) for row in rows for each in row]


def shown_volume(event: Json) -> Json:
    voxels = Path(event["voxels"]).read_bytes()
    return {"size": event["size"], "components": event["components"], "place": event["ijk_to_ras"], "voxels": voxels}


def wanted_volume(content: Json) -> Json:
    size = content["dimensions"]
    place = corner(content.get("wire_matrix", [1, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0]), size)
    count = content.get("num_components", 1)
    return {"size": size, "components": count, "place": place, "voxels": bytes(content["data"])}


def shown_model(event: Json) -> Json:
    kinds = ("vertices", "lines", "polygons", "strips")
    shown: Json = {"points": numbers(event["points"]).reshape(-1, 3).tolist()}
    return (
        shown
        | {kind: cells(event[kind]) for kind in kinds}
        | {"arrays": [each[:1] + each[2:3] for each in event["arrays"]]}
    )


def wanted_model(content: Json) -> Json:
    """Vertices are lines from a point to itself: it reads one point of the first vertex cell only."""
    lines = [[point, point] for cell in content["vertices"] for point in cell] + content["lines"]
    arrays = [[each["name"], each["ncomponents"]] for each in content["attributes"]]
    wanted = {"points": content["points"], "vertices": [], "lines": lines, "polygons": content["polygons"]}
    return wanted | {"strips": content["triangle_strips"], "arrays": arrays}


#: Type → what Slicer shows of a message, and what our content has of that.
SHOWN: dict[str, tuple[Callable[[Json], Any], Callable[[Json], Any]]] = {
    "TRANSFORM": (lambda event: event["matrix"], lambda content: matrix(content["matrix"])),
    "STRING": (lambda event: event["text"], lambda content: content["string"]),
    "STATUS": (
        lambda event: [event[each] for each in ("code", "error", "text")],
        lambda content: [content[each] for each in ("code", "error_name", "status_string")],
    ),
    "IMAGE": (shown_volume, wanted_volume),
    "POLYDATA": (shown_model, wanted_model),
    "POINT": (
        lambda event: [each[1:] for each in event["points"]],
        lambda content: [list(map(float, each["position"])) for each in content["elements"]],
    ),
    "IMGMETA": (
        lambda event: [each[0] for each in event["elements"]],
        lambda content: [
            [each[key] for key in ("name", "device_name", "modality", "patient_name", "patient_id")]
            for each in content["elements"]
        ],
    ),
    "LBMETA": (
        lambda event: [[*each[0], each[1]] for each in event["elements"]],
        lambda content: [
            [each[key] for key in ("name", "device_name", "owner", "label")] for each in content["elements"]
        ],
    ),
}


def _second_name(one: Sent) -> str:
    """The device of the first tool, whose name a stream of TDATA has already."""
    name = one.content["elements"][0]["name"]
    return short_device_name(f"{name}_{name_hash(f'{one.type}/{one.device}{name}')}")


#: Type that it does not read → the node that is shown in its place, how that is read, and what it must be.
INSTEAD: dict[str, Callable[[Sent], tuple[str, Callable[[Json], Any], Any]]] = {
    "POSITION": lambda one: (one.device, SHOWN["TRANSFORM"][0], matrix(MOVED)),
    "TDATA": lambda one: (
        one.content["elements"][0]["name"],
        SHOWN["TRANSFORM"][0],
        matrix(one.content["elements"][0]["matrix"]),
    ),
    "QTDATA": lambda one: (_second_name(one), SHOWN["TRANSFORM"][0], matrix(MOVED)),
    "TRAJ": lambda one: (
        one.device,
        lambda event: list(map(shown_model(event).get, ("points", "lines"))),
        [[one.content["elements"][0][end] for end in ("entry", "target")], [[0, 1]]],
    ),
    "BIND": lambda one: (
        one.content["children"][1]["name"],
        SHOWN["TRANSFORM"][0],
        matrix(one.content["children"][1]["content"]["matrix"]),
    ),
}
NO_NODE = "it has no node for this type; nothing is sent, and its log stays empty"


def _shown(place: Place, one: Sent) -> Row:
    place.node.publish(one.topic, one.fields)
    if one.type in INSTEAD:
        name, read, wish = INSTEAD[one.type](one)
        got = read(place.slicer.node(name))
        assert same(got, wish), f"{one}: {got}, expected {wish}"
        return Row(f"{one.type}, as what it can show", TO_IGTL, EXACT)
    if one.type not in SHOWN:
        return Row(one.type, TO_IGTL, CANNOT, 1, NO_NODE)
    shows, wants = SHOWN[one.type]
    event, wanted = place.slicer.node(one.device), wants(one.content)
    assert same(got := shows(event), wanted), f"{one}: {got}, expected {wanted}"
    return Row(one.type, TO_IGTL, EXACT)


# ── random values, in physical units ───────────────────────────────────────────────────────────────────────────────


def turned(random: np.random.Generator) -> tuple[Json, Floats]:
    """A random rotation as a quaternion of ROS and as a matrix."""
    values = random.normal(size=4)
    x, y, z, w = quaternion = values / np.linalg.norm(values)
    axes = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return dict(zip("xyzw", map(float, quaternion), strict=True)), np.array(axes)


def posed(axes: Floats, place_mm: Floats) -> list[float]:
    whole = np.eye(4)
    whole[:3, :3], whole[:3, 3] = axes, place_mm
    return [float(each) for each in whole.ravel()]


def random_pose(random: np.random.Generator) -> tuple[Json, Any]:
    rotation, axes = turned(random)
    place = random.uniform(-1, 1, 3)
    pose = {"position": xyz(*place.tolist()), "orientation": rotation}
    return {"header": {"frame_id": "Base"}, "pose": pose}, posed(axes, place * 1000)


def random_volume(random: np.random.Generator) -> tuple[Json, Any]:
    _, axes = turned(random)
    size, spacing = random.integers(1, 9, 3), random.uniform(1e-4, 5e-3, 3)
    voxels = random.integers(0, 1 << 16, int(size.prod()), "<u2").tobytes()
    place = random.uniform(-0.5, 0.5, 3)
    fields = {
        "header": {"frame_id": "Base"},
        "size": size.tolist(),
        "scalar_type": 5,
        "components": 1,
        "coordinate_system": 1,
        "direction": axes.T.ravel().tolist(),
        "spacing": spacing.tolist(),
        "origin": xyz(*place.tolist()),
        "data": hexed(voxels),
    }
    wanted = {"size": size.tolist(), "components": 1, "place": posed(axes * spacing * 1000, place * 1000)}
    return fields, wanted | {"voxels": voxels}


def random_marks(random: np.random.Generator) -> tuple[Json, Any]:
    places = random.uniform(-1, 1, (int(random.integers(1, 30)), 3))
    points = [{"name": f"m{n}", "position": xyz(*each)} for n, each in enumerate(places.tolist())]
    wanted = [[f"m{n}", *each] for n, each in enumerate((places * 1000).tolist())]
    return {"header": {"frame_id": "Base"}, "points": points}, wanted


def random_mesh(random: np.random.Generator) -> tuple[Json, Any]:
    places = random.uniform(-1, 1, (int(random.integers(3, 60)), 3))
    triangles = random.integers(0, len(places), (40, 3)).tolist()
    fields = {
        "vertices": [xyz(*each) for each in places.tolist()],
        "triangles": [{"vertex_indices": each} for each in triangles],
    }
    return fields, {"points": (places * 1000).tolist(), "polygons": triangles}


#: Topic → a random message and what Slicer must show, how that is read, and the type on the wire.
RANDOMS: dict[str, tuple[Callable[[np.random.Generator], tuple[Json, Any]], Callable[[Json], Any], str]] = {
    "RandomPose": (random_pose, lambda event: event["matrix"], "TRANSFORM"),
    "RandomVolume": (random_volume, shown_volume, "IMAGE"),
    "RandomMarks": (random_marks, lambda event: event["points"], "POINT"),
    "RandomMesh": (random_mesh, shown_model, "POLYDATA"),
}


def _random(place: Place, device: str, role: str) -> Row:
    make, read, type_name = RANDOMS[device]
    what = f"{type_name}, random values in mm, {role}"
    for _ in range(RANDOM):
        fields, wanted = make(place.random)
        place.node.publish(f"/igtl/out/{device}", fields)
        got = read(place.slicer.node(device))
        assert same(got, wanted), f"{got}, expected {wanted}"
    return Row(what, TO_IGTL, EXACT, RANDOM)


# ── what Slicer sends ──────────────────────────────────────────────────────────────────────────────────────────────


def near(got: Any, wanted: Any) -> bool:
    return bool(np.allclose(np.array(got, float), np.array(wanted, float), rtol=2e-6, atol=5e-7))


def by_axes(fields: Json, axes: str = "xyz") -> list[float]:
    return [fields[each] for each in axes]


class Sender:
    """Nodes that a person sets in Slicer; they are sent when they change."""

    def __init__(self, place: Place) -> None:
        self._place = place
        self._out: set[str] = set()

    def set(self, kind: str, name: str, *words: Any) -> None:
        self._place.slicer.do(kind, name, *words)
        if name not in self._out:
            self._out.add(name)
            self._place.slicer.do("out", "C", name)

    def stored(self, data: bytes, name: str) -> Path:
        path = self._place.folder / name
        path.write_bytes(data)
        return path

    def pose(self) -> None:
        fields, wanted = random_pose(self._place.random)
        self.set("transform", "SlicerPose", *wanted)
        got = self._place.node.receive("/igtl/in/SlicerPose/transform")["transform"]
        assert near(by_axes(got["translation"]), by_axes(fields["pose"]["position"])), got
        turns = by_axes(got["rotation"], "xyzw"), by_axes(fields["pose"]["orientation"], "xyzw")
        assert abs(abs(float(np.dot(*turns))) - 1) < 1e-6, turns

    def text(self) -> None:
        text = f"Größe {self._place.random.integers(1 << 30)} µm, 手術"
        self.set("text", "SlicerText", text)
        assert (got := self._place.node.receive("/igtl/in/SlicerText/string")["data"]) == text, got

    def status(self) -> None:
        code = int(self._place.random.integers(1, 20))
        self.set("status", "SlicerState", code, "Warming", "not ready yet")
        got = self._place.node.receive("/igtl/in/SlicerState/status")
        values = {each["key"]: each["value"] for each in got["values"]}
        assert (values["code"], got["message"]) == (str(code), "not ready yet"), got

    def marks(self) -> None:
        _, wanted = random_marks(self._place.random)
        self.set("points", "SlicerMarks", *(word for each in wanted for word in each))
        got = self._place.node.receive("/igtl/in/SlicerMarks/landmarks")["points"]
        assert [each["name"] for each in got] == [each[0] for each in wanted], got
        assert near([by_axes(each["position"]) for each in got], np.array([each[1:] for each in wanted]) / 1000), got

    def model(self) -> None:
        _, wanted = random_mesh(self._place.random)
        points, faces = wanted["points"], wanted["polygons"]
        lines = ["# vtk DataFile Version 3.0", "SPACE=RAS", "ASCII", "DATASET POLYDATA", f"POINTS {len(points)} double"]
        lines += [" ".join(map(repr, each)) for each in points]
        lines += [f"POLYGONS {len(faces)} {4 * len(faces)}", *(" ".join(map(str, [3, *each])) for each in faces)]
        path = self.stored(("\n".join(lines) + "\n").encode(), "model.vtk")
        self.set("model", "SlicerModel", path)
        got = self._place.node.receive("/igtl/in/SlicerModel/mesh")
        assert [each["vertex_indices"] for each in got["triangles"]] == faces, got
        assert near([by_axes(each) for each in got["vertices"]], np.array(points) / 1000), got

    def volume(self) -> None:
        fields, wanted = random_volume(self._place.random)
        path = self.stored(wanted["voxels"], "volume")
        self.set("volume", "SlicerVolume", *wanted["size"], 1, 5, path, *wanted["place"])
        got = self._place.node.receive("/igtl/in/SlicerVolume/volume")
        assert (got["size"], got["scalar_type"], got["data"]["hex"]) == (wanted["size"], 5, wanted["voxels"].hex()), got
        assert near(got["direction"], fields["direction"]) and near(got["spacing"], fields["spacing"]), got
        assert near(by_axes(got["origin"]), by_axes(fields["origin"])), got

    def colors(self) -> None:
        pixels = self._place.random.bytes(5 * 4 * 3)
        path = self.stored(pixels, "colors")
        self.set("volume", "SlicerColors", 5, 4, 1, 3, 3, path, *np.eye(4).ravel().tolist())
        got = self._place.node.receive("/igtl/in/SlicerColors/image")
        assert (got["width"], got["height"], got["encoding"], got["data"]["hex"]) == (5, 4, "rgb8", pixels.hex()), got


def _sent(what: str, send: Callable[[], None], role: str) -> Row:
    for _ in range(RANDOM):
        send()
    return Row(f"{what}, random values in mm, {role}", TO_ROS, EXACT, RANDOM)


# ── conversations ──────────────────────────────────────────────────────────────────────────────────────────────────


def _commands(place: Place, role: str) -> Row:
    for number in range(5):
        fields = {"device_name": "C", "name": f"Move{number}", "content": "<To x='1'/>", "timeout": 15.0}
        place.node.call(SERVICE, "igtl_msgs/srv/SendCommand", fields)
        asked = place.slicer.event("command")
        assert (asked["name"], asked["content"]) == (f"Move{number}", "<To x='1'/>"), asked
        assert (reply := place.node.receive(SERVICE))["content"] == f"reply to Move{number}: <To x='1'/>", reply
    return Row(f"COMMAND and its reply, {role}", BOTH, EXACT, 5)


def _asked(place: Place, role: str) -> Row:
    """A query for what ROS has published is answered into the node."""
    sent = next(one for one in OUTGOING if one.device == "Scanner")
    place.node.publish(sent.topic, sent.fields)
    place.slicer.node("Scanner")
    place.slicer.do("query", "C", "IMAGE", "get", "Scanner", 20)
    answer = place.slicer.event("answer")
    assert (answer["status"], answer["node"]) == (3, "Scanner"), answer
    return Row(f"GET_IMAGE that it asks, {role}", BOTH, EXACT)


def _two_connectors(program: Path) -> Iterator[Row]:
    """A second connector of the same scene to another port: each stream arrives once, and none goes back."""
    port = free_port()
    with world(program, False, "--listen", f"127.0.0.1:{port}") as place:
        place.slicer.do("client", "D", port)
        place.slicer.event("connected", lambda event: event["connector"] == "D")
        place.bridge.wait_code("link_up", 2)
        for _ in range(RANDOM):
            fields, wanted = random_pose(place.random)
            place.node.publish("/igtl/out/RandomPose", fields)
            for _connector in "CD":
                assert same(place.slicer.node("RandomPose")["matrix"], wanted)
        Sender(place).pose()
        yield Row("two connectors in one scene", BOTH, EXACT, RANDOM + 1)
        yield quiet(place.slicer, "two connectors", "client")


def _restarts(program: Path, count: int) -> Iterator[Row]:
    """Slicer's connector goes and comes, as its user clicks; then the bridge does, on the same port."""
    with world(program, False) as place:
        memory = []
        for number in range(count):
            place.slicer.do("stop", "C")
            place.bridge.wait_code("link_down", number + 1)
            place.slicer.do("start", "C")
            place.slicer.event("connected")
            place.bridge.wait_code("link_up", number + 2)
            if number % 10 == 0:
                _random(place, "RandomPose", "client")
            memory.append((place.slicer.resident_bytes(), place.bridge.resident_bytes()))
        half = memory[count // 2]
        grown = [(last - middle) / 1e3 / (count / 2) for last, middle in zip(memory[-1], half, strict=True)]
        text = f"a reconnection adds {grown[1]:.1f} kB to the bridge, {grown[0]:.1f} kB to it"
        yield Row("reconnections", BOTH, EXACT if grown[1] < 20 else FAILS, count, text)
        yield quiet(place.slicer, "reconnections", "client")


def _restarted_bridge(program: Path, count: int) -> Iterator[Row]:
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        node = stack.enter_context(RosClient("judge", subscribe=HEARD, advertise=TALK))
        latched = {"/igtl/out/Late": "shape_msgs/msg/Mesh"}
        node.advertise(*next(iter(latched.items())), latched=True)
        fields, wanted = random_mesh(random := np.random.default_rng(1))
        node.publish("/igtl/out/Late", fields)
        slicer = Slicer(program, folder)
        stack.callback(slicer.close)
        port = free_port()
        slicer.do("client", "C", port)
        for _ in range(count):
            bridge = Bridge("--listen", f"127.0.0.1:{port}", listen=False)
            try:
                slicer.event("connected")
                place = Place(node, slicer, bridge, folder, random)
                assert same(shown_model(slicer.node("Late")), wanted)
                node.wait_readers(*TALK)
                _random(place, "RandomPose", "client")
            finally:
                bridge.end()
                bridge.close()
            slicer.event("disconnected")
        yield Row("restarts of the bridge; a latched mesh for who comes late", TO_IGTL, EXACT, count)
        yield quiet(slicer, "restarts of the bridge", "client")


# ── load ───────────────────────────────────────────────────────────────────────────────────────────────────────────


LOAD = """
import sys, time, array, json
import rclpy
from geometry_msgs.msg import PoseStamped
from sensor_msgs.msg import Image, PointCloud2, PointField
kind, rate, count = sys.argv[1], float(sys.argv[2]), int(sys.argv[3])
rclpy.init()
node = rclpy.create_node("load")
types = {"LoadPose": PoseStamped, "LoadImage": Image, "LoadCloud": PointCloud2}
publisher = node.create_publisher(types[kind], "/igtl/out/" + kind, 10)
message = types[kind]()
message.header.frame_id = "Base"
if kind == "LoadImage":
    message.width, message.height, message.encoding, message.step = 1920, 1080, "rgb8", 5760
    message.data = array.array("B", bytes(5760 * 1080))
if kind == "LoadCloud":
    points = 600_000
    message.width, message.height, message.point_step, message.row_step = points, 1, 12, 12 * points
    message.fields = [PointField(name=name, offset=4 * n, datatype=7, count=1) for n, name in enumerate("xyz")]
    message.data = array.array("B", array.array("f", [n / 1e6 for n in range(3 * points)]).tobytes())
while publisher.get_subscription_count() < 1:
    time.sleep(0.01)
input()
start = time.perf_counter()
for number in range(1, count + 1):
    if kind == "LoadPose":
        message.pose.position.x = number / 1000
    if kind == "LoadImage":
        message.data[0] = number % 256
    publisher.publish(message)
    time.sleep(max(0.0, start + number / rate - time.perf_counter()))
print(json.dumps({"rate": count / (time.perf_counter() - start)}), flush=True)
input()
"""


def _load(place: Place, kind: str, rate: float, count: int, what: str, last: Callable[[Json], bool]) -> Row:
    """The last one of a stream arrives whole; how many Slicer has shown, and how much memory each side has grown."""
    load = Program([sys.executable, "-c", LOAD, kind, str(rate), str(count)], stdin=subprocess.PIPE)
    try:
        place.bridge.wait_events(lambda event: kind in json.dumps(event), f"stream {kind}")
        assert load.process.stdin is not None
        place.slicer.do("watch", 0)
        load.process.stdin.write(b"\n")
        load.process.stdin.flush()
        load.wait_until(lambda: bool(load.lines), "load", count / rate * 10 + 60)
        reached = json.loads(load.lines[0])["rate"]
        deadline = time.monotonic() + 60
        while True:
            place.slicer.do("show", kind)
            if last(place.slicer.node(kind)):
                break
            assert time.monotonic() < deadline, f"the last {kind} is not there"
            time.sleep(0.1)
        shown = dict(place.slicer.counts()["messages"])
        (seen,) = (number for name, number in shown.items() if name.endswith(kind))
        place.slicer.do("watch", 1)
        text = f"{reached:.0f} a second sent; it has shown {seen} of {count}, the last one too"
        return Row(what, TO_IGTL, EXACT, count, text)
    finally:
        load.close()


def _loads(program: Path, seconds: float) -> Iterator[Row]:
    with world(program, False) as place:
        before = place.slicer.resident_bytes(), place.bridge.resident_bytes()
        poses, images = int(1000 * seconds), int(30 * seconds)
        yield _tried(
            *("TRANSFORM at 1 kHz", TO_IGTL, _load, place, "LoadPose", 1000, poses, "TRANSFORM at 1 kHz"),
            lambda event: abs(event["matrix"][3] - poses) < 1e-3 * poses,
        )
        yield _tried(
            *("IMAGE, Full HD at 30 Hz", TO_IGTL, _load, place, "LoadImage", 30, images, "IMAGE, Full HD at 30 Hz"),
            lambda event: shown_volume(event)["voxels"][0] == images % 256,
        )
        yield _tried(
            *("POLYDATA, 600,000 points at 1 Hz", TO_IGTL, _load, place, "LoadCloud", 1, 5),
            "POLYDATA, 600,000 points at 1 Hz",
            lambda event: (
                len(points := shown_model(event)["points"]) == 600_000
                and same(points[-1], [1799.997, 1799.998, 1799.999])
            ),
        )
        after = place.slicer.resident_bytes(), place.bridge.resident_bytes()
        grown = [(new - old) / 1e6 for new, old in zip(after, before, strict=True)]
        yield Row(
            "memory under load", BOTH, EXACT, 1, f"the bridge has grown by {grown[1]:.0f} MB, it by {grown[0]:.0f} MB"
        )
        yield quiet(place.slicer, "load", "client")


# ── replays ────────────────────────────────────────────────────────────────────────────────────────────────────────


def _replayed(program: Path, path: Path) -> Iterator[Row]:
    port = free_port()
    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        words = ("replay", str(path), "--to", "igtl", "--listen", f"127.0.0.1:{port}", "--as-fast-as-possible")
        sender = gateway(*words)
        stack.callback(sender.close)
        slicer = Slicer(program, Path(folder))
        stack.callback(slicer.close)
        slicer.do("watch", 0)
        slicer.do("client", "C", port)
        slicer.event("connected")
        sender.process.wait(120)
        messages = sum(number for _, number in slicer.counts()["messages"])
        yield Row(f"replay of {path.name}: received, and lives", TO_IGTL, EXACT, messages)
        yield quiet(slicer, f"replay of {path.name}", "client")


def once(rows: Iterable[Row]) -> list[Row]:
    """Equal rows are one row with the sum of their cases."""
    found: dict[Row, int] = {}
    for row in rows:
        key = replace(row, cases=0)
        found[key] = found.get(key, 0) + row.cases
    return [replace(row, cases=cases) for row, cases in found.items()]


def every(what: str, run: Callable[..., Iterator[Row]], *words: Any) -> list[Row]:
    """The rows of a scenario; one that fails keeps those before it."""
    rows: list[Row] = []
    try:
        for row in run(*words):
            print(*(row.what, row.direction, row.result, row.cases, row.text), sep=" | ", flush=True)
            rows.append(row)
    except (AssertionError, TimeoutError, KeyError, ConnectionError, OSError) as error:
        rows.append(Row(what, BOTH, FAILS, 1, " ".join(f"{type(error).__name__} {error}".split())[:300]))
        print(rows[-1], flush=True)
    return rows


def _types(program: Path, is_server: bool) -> Iterator[Row]:
    role = "server" if is_server else "client"
    with world(program, is_server) as place:
        for one in OUTGOING:
            yield _tried(one.type, TO_IGTL, _shown, place, one)
        for device, (_, _, type_name) in RANDOMS.items():
            yield _tried(type_name, TO_IGTL, _random, place, device, role)
        yield quiet(place.slicer, "every type", role)
        sender = Sender(place)
        sends = {
            "TRANSFORM": sender.pose, "STRING": sender.text, "STATUS": sender.status, "POINT": sender.marks,
            "POLYDATA": sender.model, "IMAGE, 16 bits": sender.volume, "IMAGE, colours": sender.colors,
        }  # fmt: skip
        for what, send in sends.items():
            yield _tried(what, TO_ROS, _sent, what, send, role)
        yield _tried("COMMAND and its reply", BOTH, _commands, place, role)
        yield _tried("GET_IMAGE that it asks", BOTH, _asked, place, role)
        yield quiet(place.slicer, "sending, commands, queries", role)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--program", type=Path, required=True, help="slicer_node.cpp, compiled")
    parser.add_argument("--version", default=VERSIONS, help="of all that it is compiled against (default: %(default)s)")
    parser.add_argument("--seconds", type=float, default=10.0, help="of each load (default: %(default)s)")
    parser.add_argument("--reconnections", type=int, default=300, help="(default: %(default)s)")
    options = parser.parse_args()
    rows = []
    for is_server in (False, True):
        rows += every("every type", _types, options.program, is_server)
    rows += every("two connectors", _two_connectors, options.program)
    rows += every("restarts of the bridge", _restarted_bridge, options.program, 5)
    rows += every("reconnections", _restarts, options.program, options.reconnections)
    rows += every("load", _loads, options.program, options.seconds)
    for path in sorted(FIXTURES.glob("*.mcap")):
        rows += every(f"replay of {path.name}", _replayed, options.program, path)
    return results.write("slicer", "3D Slicer's connector", options.version, "client and server", once(rows))


if __name__ == "__main__":
    sys.exit(main())
