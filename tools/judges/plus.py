"""PlusServer, of PLUS: a server of pictures and poses that the gateway reads, and a tracker that reads the gateway.

``python tools/judges/plus.py --program PATH``: the program PlusServer, in the folder of its build.  Writes
docs/evidence/real-programs/plus.jsonl; exit code 1 if anything differs.

Strategy: PLUS plays a sequence whose pixels, poses, statuses and strings are written here.  A message is joined to its
frame by the stamp that PLUS gives all messages of a frame, and compared with what the sequence has.  Poses of ROS come
back: one PlusServer reads them as a tracker and serves them to the same bridge.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[2]))

from tests.integration.bridge import TIMEOUT_S, Bridge, Program, RosClient, free_port, gateway
from tests.integration.test_ros_types import IN, OUT, QUERY, SERVICE
from tools.judges import results
from tools.judges.results import BOTH, DIFFERS, EXACT, FAILS, TO_IGTL, TO_ROS, Row

Json = dict[str, Any]
FRAMES, WIDTH, HEIGHT, PERIOD_S = 40, 64, 48, 0.1
COMPARED = FRAMES + 8  # the sequence begins again
SENT = 20  # poses of ROS
CLOSE = 1e-6  # of float32
OK = "OK"
POSES = ("ProbeToTracker", "ReferenceToTracker", "ProbeToReference")
IMAGE, VOLUME, TEXT = f"{IN}Image_Reference/image", f"{IN}Image_Reference/volume", f"{IN}Annotation/string"
TRACKING, QUESTION = f"{IN}TDATA_3Elem/tracking", f"{OUT}Question"
STATUSES = f"{IN}ToolToRobot/metadata"
TRANSFORM, METADATA = "geometry_msgs/msg/TransformStamped", "igtl_msgs/msg/Metadata"
SUBSCRIBED = {
    IMAGE: "sensor_msgs/msg/Image",
    VOLUME: "igtl_msgs/msg/Volume",
    TEXT: "std_msgs/msg/String",
    TRACKING: "igtl_msgs/msg/TrackingData",
    "/tf": "tf2_msgs/msg/TFMessage",
    **{f"{IN}{name}/transform": TRANSFORM for name in (*POSES, "ToolToRobot")},
    **{f"{IN}{name}/metadata": METADATA for name in (*POSES, "ToolToRobot")},
}
JOINTS, TOOL, LOST = f"{OUT}joints", f"{OUT}ToolToRobot", "/judge/lost"
ADVERTISED = {JOINTS: "sensor_msgs/msg/JointState", QUESTION: QUERY, TOOL: TRANSFORM, LOST: TRANSFORM}


# ── what PLUS plays ────────────────────────────────────────────────────────────────────────────────────────────────


def pixels(number: int) -> bytes:
    rows = np.arange(WIDTH * HEIGHT) * (number + 3) + number
    return (rows % 251).astype(np.uint8).tobytes()


def turned(angle: float, place: Sequence[float]) -> Any:
    """A pose: turned about the axis (1, 2, 2) / 3, at a place in millimetres."""
    axis = np.array([1.0, 2.0, 2.0]) / 3
    cross = np.cross(np.eye(3), axis)
    full = np.eye(4)
    full[:3, :3] = np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
    full[:3, 3] = place
    return full


def probe(number: int) -> Any:
    return turned(0.05 * number, (number + 1, 2 * number, 3.5 * number))


def reference(number: int) -> Any:
    return turned(-0.03 * number, (-2 * (number + 1), 7.25, number))


CALIBRATION = np.array([[0.5, 0, 0, 11], [0, 0.25, 0, 50], [0, 0, 1, 0], [0, 0, 0, 1.0]])
#: Device → its pose in a frame of the sequence.
WANTED: dict[str, Callable[[int], Any]] = {
    "ProbeToTracker": probe,
    "ReferenceToTracker": reference,
    "ProbeToReference": lambda number: np.linalg.inv(reference(number)) @ probe(number),
}


def status(device: str, number: int) -> str:
    """Never are both tools invalid: which of the two PLUS names is not written anywhere."""
    lost = {"Probe": "OUT_OF_VIEW" if number % 5 == 2 else OK, "Reference": "INVALID" if number % 10 == 4 else OK}
    return next((text for tool, text in lost.items() if tool in device and text != OK), OK)


def sequence() -> bytes:
    """The sequence file."""
    lines = ["ObjectType = Image", "NDims = 3", "BinaryData = True", "BinaryDataByteOrderMSB = False"]
    lines += ["CompressedData = False", "TransformMatrix = 1 0 0 0 1 0 0 0 1", "Offset = 0 0 0"]
    lines += ["ElementSpacing = 1 1 1", f"DimSize = {WIDTH} {HEIGHT} {FRAMES}", "Kinds = domain domain list"]
    lines += ["AnatomicalOrientation = RAI", "ElementType = MET_UCHAR", "UltrasoundImageOrientation = MF"]
    lines += ["UltrasoundImageType = BRIGHTNESS"]
    for number in range(FRAMES):
        fields = {"Timestamp": f"{1 + PERIOD_S * number:.3f}", "FrameNumber": number, "ImageStatus": OK}
        fields |= {"Annotation": f"frame {number}"}
        for device in POSES[:2]:
            fields[f"{device}Transform"] = " ".join(f"{each:.12f}" for each in WANTED[device](number).ravel())
            fields[f"{device}TransformStatus"] = status(device, number)
        lines += [f"Seq_Frame{number:04d}_{name} = {value}" for name, value in fields.items()]
    lines += ["ElementDataFile = LOCAL"]
    return ("\n".join(lines) + "\n").encode() + b"".join(map(pixels, range(FRAMES)))


DEVICES = """<PlusConfiguration version="2.1">
  <DataCollection StartupDelaySec="1.0">
    <DeviceSet Name="judge" Description="judge" />
    {device}
  </DataCollection>
  <PlusOpenIGTLinkServer ListeningPort="{port}" OutputChannelId="Stream" SendValidTransformsOnly="false">
    <DefaultClientInfo {version}>
      <MessageTypes>{types}</MessageTypes>
      <TransformNames>{names}</TransformNames>
      <StringNames><String Name="Annotation" /></StringNames>
      <ImageNames><Image Name="Image" EmbeddedTransformToFrame="Reference" /></ImageNames>
    </DefaultClientInfo>
  </PlusOpenIGTLinkServer>
  <CoordinateDefinitions>
    <Transform From="Image" To="Probe" Matrix="{matrix}" />
  </CoordinateDefinitions>
</PlusConfiguration>
"""
PLAYER = """<Device Id="Player" Type="SavedDataSource" SequenceFile="{file}" UseData="IMAGE_AND_TRANSFORM"
            UseOriginalTimestamps="TRUE" RepeatEnabled="TRUE">
      <DataSources><DataSource Type="Video" Id="Video" PortUsImageOrientation="MF" /></DataSources>
      <OutputChannels><OutputChannel Id="Stream" VideoDataSourceId="Video" /></OutputChannels>
    </Device>"""
TRACKER = """<Device Id="Robot" Type="OpenIGTLinkTracker" MessageType="{type}" ServerAddress="127.0.0.1"
            ServerPort="{port}" ToolReferenceFrame="{frame}" AcquisitionRate="50" UseReceivedTimestamps="FALSE"
            UseLastTransformsOnReceiveTimeout="{last}">
      <DataSources><DataSource Type="Tool" Id="{tool}" /></DataSources>
      <OutputChannels><OutputChannel Id="Stream"><DataSource Id="{tool}" /></OutputChannel></OutputChannels>
    </Device>"""


def configuration(device: str, port: int, types: Sequence[str], names: Sequence[str], version: int) -> str:
    return DEVICES.format(
        device=device,
        port=port,
        version=f'ClientHeaderVersion="{version}"',
        types="".join(f'<Message Type="{each}" />' for each in types),
        names="".join(f'<Transform Name="{each}" />' for each in names),
        matrix=" ".join(map(str, CALIBRATION.ravel())),
    )


def player(folder: Path, port: int, version: int = 1) -> str:
    """The configuration of a PLUS that plays the sequence."""
    file = folder / "sequence.igs.mha"
    file.write_bytes(sequence())
    types = ("IMAGE", "TRANSFORM", "STRING", "TDATA")
    return configuration(PLAYER.format(file=file), port, types, POSES, version)


def tracker(device: str, port: int, at: int, kind: str = "TRANSFORM", last: str = "TRUE") -> str:
    """The configuration of a PLUS that reads one tool from a server, and serves it."""
    tool, _, frame = device.rpartition("To")
    words = TRACKER.format(type=kind, port=at, tool=tool, frame=frame, last=last)
    return configuration(words, port, ("TRANSFORM",), (device,), 2)


# ── the bridge between ROS and PLUS ────────────────────────────────────────────────────────────────────────────────


class Plus(Program):
    """PlusServer, in the folder of its build, where its own settings are."""

    def __init__(self, program: Path, folder: Path, text: str) -> None:
        path = folder / f"{len(list(folder.iterdir()))}.xml"
        path.write_text(text)
        super().__init__(["env", "-C", str(program.parent), str(program), f"--config-file={path}"])


@dataclass(frozen=True)
class Place:
    node: RosClient
    bridge: Bridge
    plus: Plus
    port: int

    def stamped(self, topic: str) -> dict[tuple[int, int], Json]:
        """The messages of a topic by their stamps."""
        return {stamp(each): each for each in self.node.received(topic)}


def dict_of(items: list[Json]) -> dict[str, str]:
    return {each["key"]: each["value"] for each in items}


def is_heard(node: RosClient, topic: str) -> bool:
    return node.waiting(topic) > 0


def stamp(message: Json) -> tuple[int, int]:
    at = message["header"]["stamp"]
    return at["sec"], at["nanosec"]


@contextmanager
def world(program: Path, folder: Path, text: Callable[[int, int], str], *words: str) -> Iterator[Place]:
    """The bridge between a rclpy node and PLUS; ``text`` is given both ports; ``{port}`` in words is that of PLUS."""
    with ExitStack() as stack:
        node = stack.enter_context(RosClient("judge", subscribe=SUBSCRIBED, advertise=ADVERTISED))
        port = free_port()
        filled = [word.format(port=port) for word in words]
        bridge = Bridge("--no-cautious", "--connect", f"127.0.0.1:{port}", *filled)
        stack.callback(bridge.close)
        stack.callback(bridge.end)
        plus = Plus(program, folder, text(port, bridge.port))
        stack.callback(plus.close)
        bridge.wait_code("link_up")
        node.wait_readers(JOINTS)
        yield Place(node, bridge, plus, port)


def _tried(what: str, direction: str, run: Callable[..., Iterator[Row]], *given: Any) -> list[Row]:
    rows: list[Row] = []
    try:
        rows.extend(run(*given))
    except (AssertionError, TimeoutError, KeyError, BrokenPipeError) as error:
        rows.append(Row(what, direction, FAILS, 1, " ".join(f"{type(error).__name__} {error}".split())[:300]))
    return rows


# ── frames of PLUS ─────────────────────────────────────────────────────────────────────────────────────────────────


NUMBERS = {pixels(number).hex(): number for number in range(FRAMES)}


def frames(place: Place, version: int) -> dict[tuple[int, int], int]:
    """Stamp → number of the frame, of as many frames as are compared; of version 2 as soon as PLUS sends that."""
    node = place.node
    begin = (0, 0)
    if version > 1:
        for name in POSES:
            topic = f"{IN}{name}/metadata"
            node.wait_until(partial(is_heard, node, topic), f"metadata of {name}")
            begin = max(begin, stamp(node.received(topic)[0]))

    def are_there() -> bool:
        topics = (IMAGE, VOLUME, *(f"{IN}{name}/transform" for name in POSES))
        return all(sum(at >= begin for at in place.stamped(topic)) > COMPARED for topic in topics)

    node.wait_until(are_there, f"{COMPARED} frames")
    images = [(at, image) for at, image in place.stamped(IMAGE).items() if at >= begin][:COMPARED]
    return {at: NUMBERS.get(image["data"]["hex"], -1) for at, image in images}


def of_pixels(found: dict[tuple[int, int], int], version: int) -> Row:
    """Equal pixels, each frame after the one before it."""
    numbers = list(found.values())
    wrong = numbers.count(-1)
    left_out = sum((after - before) % FRAMES != 1 for before, after in pairwise(numbers))
    row = Row(f"IMAGE, version {version}: pixels, in order", TO_ROS, EXACT, len(numbers))
    if wrong or left_out:
        return Row(row.what, TO_ROS, FAILS, len(numbers), f"{wrong} have other pixels, {left_out} gaps")
    return row


def placed(place: Place, found: dict[tuple[int, int], int], version: int) -> Iterator[Row]:
    volumes = place.stamped(VOLUME)
    for at, number in found.items():
        shown, wanted = volumes[at], WANTED["ProbeToReference"](number) @ CALIBRATION
        sizes = np.linalg.norm(wanted[:3, :3], axis=0)
        assert close(shown["spacing"], sizes / 1000), f"frame {number}: {shown['spacing']}, expected {sizes / 1000}"
        assert close(shown["direction"], (wanted[:3, :3] / sizes).T.ravel()), f"frame {number}: {shown['direction']}"
        origin = [shown["origin"][axis] for axis in "xyz"]
        assert close(origin, wanted[:3, 3] / 1000), f"frame {number}: {origin}, expected {wanted[:3, 3] / 1000}"
    yield Row(f"IMAGE, version {version}: position, orientation, spacing", TO_ROS, EXACT, len(found))


def close(found: Any, wanted: Any) -> bool:
    return bool(np.allclose(found, wanted, rtol=CLOSE, atol=CLOSE))


def is_pose(transform: Json, wanted: Any) -> bool:
    """Equal place in metres, and the same rotation."""
    x, y, z, w = (transform["rotation"][axis] for axis in "xyzw")
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    rotation = np.eye(3) + 2 * w * cross + 2 * cross @ cross
    place = [transform["translation"][axis] for axis in "xyz"]
    return close(place, wanted[:3, 3] / 1000) and close(rotation, wanted[:3, :3])


def on_tf(place: Place) -> set[tuple[tuple[int, int], str]]:
    """(stamp, device) of all that is on /tf."""
    sent = [each for message in place.node.received("/tf") for each in message["transforms"]]
    return {(stamp(each), f"{each['child_frame_id']}To{each['header']['frame_id']}") for each in sent}


def of_poses(place: Place, found: dict[tuple[int, int], int], version: int) -> Iterator[Row]:
    cases = [(at, name, number) for at, number in found.items() for name in POSES]
    for name in POSES:
        shown = place.stamped(f"{IN}{name}/transform")
        for at, number in found.items():
            wanted = WANTED[name](number) if status(name, number) == OK else np.eye(4)
            text = f"frame {number}: {name} is {shown[at]['transform']}, expected {wanted.tolist()}"
            assert is_pose(shown[at]["transform"], wanted), text
    valid = {(at, name) for at, name, number in cases if status(name, number) == OK}
    place.node.wait_until(lambda: valid <= on_tf(place), "each valid pose on /tf")
    yield Row(f"TRANSFORM, version {version}", TO_ROS, EXACT, len(valid))
    invalid = {(at, name) for at, name, _ in cases} - valid
    what = f"TRANSFORM that is not valid, version {version}"
    if version == 1:
        text = "on /tf as a valid one: version 1 has no status; its choice of version, and a note states so"
        assert invalid <= on_tf(place), "not all are on /tf"
        yield Row(what, TO_ROS, DIFFERS, len(invalid), text)
        return
    assert not invalid & on_tf(place), "on /tf"
    for name in POSES:
        items = place.stamped(f"{IN}{name}/metadata")
        for at, number in found.items():
            told = dict_of(items[at]["items"])
            assert told["TransformStatus"] == status(name, number), f"frame {number}: {name} has {told}"
    yield Row(what, TO_ROS, EXACT, len(invalid))


def of_text(place: Place, found: dict[tuple[int, int], int], version: int) -> Iterator[Row]:
    """Strings have no stamp in ROS: one after the other."""
    texts = [each["data"] for each in place.node.received(TEXT)]
    first = f"frame {next(iter(found.values()))}"
    assert first in texts, f"no {first!r} in {texts[:5]}"
    begin = texts.index(first)
    wanted = [f"frame {number}" for number in found.values()]
    shown = texts[begin : begin + len(wanted)]
    assert shown == wanted[: len(shown)], f"{shown[:5]}, expected {wanted[:5]}"
    yield Row(f"STRING of a field, version {version}", TO_ROS, EXACT, len(shown))


def of_tracking(place: Place, version: int) -> Iterator[Row]:
    """PLUS reads the interval as seconds, so that only 0 brings each frame."""
    node = place.node
    node.publish(QUESTION, {"kind": 2, "type": "TDATA", "device_name": "", "resolution": 0})
    node.wait_until(lambda: node.waiting(TRACKING) > FRAMES // 2, "TDATA")
    tracked = place.stamped(TRACKING)
    node.wait_until(lambda: max(place.stamped(IMAGE)) >= max(tracked), "the images of the same frames")
    images, count = place.stamped(IMAGE), 0
    for at, message in tracked.items():
        number = NUMBERS[images[at]["data"]["hex"]]
        told = dict_of(message["metadata"])
        assert [tool["name"] for tool in message["tools"]] == list(POSES), message["tools"]
        for name, tool in zip(POSES, message["tools"], strict=True):
            pose = {"translation": tool["pose"]["position"], "rotation": tool["pose"]["orientation"]}
            assert is_pose(pose, WANTED[name](number)), f"frame {number}: {name} is {pose}"
            if version > 1:
                assert told[f"{name}Status"] == status(name, number), f"frame {number}: {told}"
            count += 1
    yield Row(f"TDATA that the gateway asks for, version {version}: tools", TO_ROS, EXACT, count)


# ── commands ───────────────────────────────────────────────────────────────────────────────────────────────────────


STYLUS = "1 0 0 5.5 0 1 0 6 0 0 1 7 0 0 0 1"
#: Name, attributes, and whether a reply is right.
COMMANDS: tuple[tuple[str, str, Callable[[Json], bool]], ...] = (
    ("RequestChannelIds", "", lambda reply: reply["status"] == 1 and 'Message="Stream"' in reply["content"]),
    (
        "UpdateTransform",
        f'TransformName="StylusToProbe" TransformValue="{STYLUS}" TransformPersistent="FALSE"',
        lambda reply: reply["status"] == 1 and "completed successfully" in reply["content"],
    ),
    ("GetTransform", 'TransformName="StylusToProbe"', lambda reply: reply["status"] == 1 and has_stylus(reply)),
    (
        "GetTransform",
        'TransformName="NothingToProbe"',
        lambda reply: reply["status"] != 1 and "Transform not found" in reply["error_message"],
    ),
    ("Unheard", "", lambda reply: reply["status"] != 1 and "Unknown command type" in reply["error_message"]),
)


def has_stylus(reply: Json) -> bool:
    told = dict_of(reply["metadata"])
    return told.get("StylusToProbe", "").split() == STYLUS.split() if told else "successful" in reply["content"]


def commands(place: Place, version: int) -> Iterator[Row]:
    """After JointStates, which PLUS has no type for."""
    for number in range(5):
        place.node.publish(JOINTS, {"name": ["a"], "position": [0.1 * number]})
    for name, words, is_right in COMMANDS:
        reply = asked(place, name, words)
        assert is_right(reply), f"{name} {words}: {reply}"
        yield Row(f"COMMAND and its reply, after JointStates, version {version}", BOTH, EXACT)


def asked(place: Place, name: str, words: str = "") -> Json:
    content = f'<Command Name="{name}" {words}/>'
    fields = {"device_name": "Judge", "name": name, "content": content, "timeout": 20.0}
    place.node.call(SERVICE, "igtl_msgs/srv/SendCommand", fields)
    reply: Json = place.node.receive(SERVICE)
    return reply


# ── what is compared ───────────────────────────────────────────────────────────────────────────────────────────────


def served(place: Place, version: int) -> list[Row]:
    """All that PLUS serves."""
    try:
        found = frames(place, version)
    except AssertionError as error:
        return [Row(f"frames of version {version}", TO_ROS, FAILS, 1, " ".join(str(error).split())[:300])]
    rows = [of_pixels(found, version)]
    for run in (placed, of_poses, of_text):
        rows += _tried(f"{run.__name__}, version {version}", TO_ROS, run, place, found, version)
    rows += _tried(f"TDATA, version {version}", TO_ROS, of_tracking, place, version)
    return [*rows, *_tried(f"COMMAND, version {version}", BOTH, commands, place, version)]


def detected(place: Place) -> Iterator[Row]:
    """Without --peer: by its frames of version 1, then by its reply to a command."""
    found = frames(place, 1)
    assert "profile plus-v1" in place.bridge.wait_code("peer_profile", level="WARN")["text"]
    yield of_pixels(found, 1)
    yield from commands(place, 1)
    place.bridge.wait_events(lambda event: "profile plus," in event.get("text", ""), "note of plus")
    yield Row("detected without --peer: plus-v1 by its frames, plus by its reply", TO_ROS, EXACT, 2)
    found = frames(place, 2)
    yield of_pixels(found, 2)
    yield from of_poses(place, found, 2)


def configured(place: Place) -> Iterator[Row]:
    """ClientHeaderVersion="2": from the first message on."""
    found = frames(place, 2)
    assert next(iter(found)) == min(place.stamped(IMAGE)), "the first image is not of version 2"
    yield of_pixels(found, 2)
    yield from of_poses(place, found, 2)
    note = place.bridge.wait_code("peer_profile")
    assert "profile plus," in note["text"], note["text"]
    yield Row("detected without --peer: plus by its metadata", TO_ROS, EXACT)


def judge(program: Path, folder: Path) -> list[Row]:
    def plays(version: int) -> Callable[[int, int], str]:
        return lambda port, at: player(folder, port, version)

    def tracks(kind: str, last: str = "TRUE") -> Callable[[int, int], str]:
        return lambda port, at: tracker("ToolToRobot", port, at, kind, last)

    peer, recording, rules, port = "127.0.0.1:{port}=plus", folder / "session.mcap", folder / "lost.toml", free_port()
    rules.write_text(
        f'[[to_igtl]]\ntopic = "{LOST}"\ndevice = "ToolToRobot"\nmetadata = {{ TransformStatus = "OUT_OF_VIEW" }}\n'
    )
    rows = []
    with world(program, folder, plays(1), "--peer", f"{peer}-v1") as place:
        rows += served(place, 1)
    with world(program, folder, plays(1), "--peer", peer) as place:
        rows += served(place, 2)
    with world(program, folder, plays(1)) as place:
        rows += _tried("detected without --peer", TO_ROS, detected, place)
    with world(program, folder, plays(2)) as place:
        rows += _tried("detected, of version 2", TO_ROS, configured, place)
    for kind in ("TRANSFORM", "POSITION", "TDATA"):
        words = ("--send", f"{TOOL}=ToolToRobot:{kind}") if kind == "POSITION" else ()
        words = ("--record", str(recording)) if kind == "TRANSFORM" else words
        with world(program, folder, tracks(kind), *words) as place:
            rows += _tried(f"{kind} to its tracker", TO_IGTL, followed, place, kind)
    with world(program, folder, tracks("TRANSFORM", "FALSE"), "--config", str(rules)) as place:
        rows += _tried("TRANSFORM with a status", TO_IGTL, lost, place)
    with closing(replay(recording, "--listen", f"127.0.0.1:{port}")) as sender:
        with world(program, folder, lambda own, _: tracker("ToolToRobot", own, port)) as place:
            rows += _tried("replay of its session to its tracker", TO_IGTL, to_tracker, place, sender)
    with world(program, folder, plays(2)) as place:
        rows += _tried("replay of its session to its server", TO_IGTL, to_server, place, recording)
    return results.summed(rows)


# ── what PLUS reads ────────────────────────────────────────────────────────────────────────────────────────────────


def followed(place: Place, kind: str) -> Iterator[Row]:
    """Poses of ROS, as PLUS serves them after it has read them as a tracker."""
    place.node.wait_readers(TOOL)
    what, count = f"{kind} to its OpenIGTLinkTracker, and back", SENT
    for number in range(count):
        came_back(place, TOOL, number, np.eye(4) if kind == "POSITION" else reference(number))
    told = [dict_of(each["items"])["TransformStatus"] for each in place.node.received(STATUSES)]
    assert set(told[-count:]) == {OK}, told
    if kind == "POSITION":
        yield Row(what, TO_IGTL, DIFFERS, count, "always the identity: it leaves out what it has read; its fault")
    else:
        yield Row(what, TO_IGTL, EXACT, count)


def came_back(place: Place, topic: str, number: int, wanted: Any) -> None:
    """Publish the pose of a frame until it is the last one that PLUS serves."""
    pose, half = reference(number), -0.03 * number / 2
    turn = {axis: float(np.sin(half)) * part / 3 for axis, part in zip("xyz", (1, 2, 2), strict=True)}
    at = {axis: float(part) / 1000 for axis, part in zip("xyz", pose[:3, 3], strict=True)}
    transform = {"translation": at, "rotation": {**turn, "w": float(np.cos(half))}}
    fields = {"header": {"frame_id": "Robot"}, "child_frame_id": "Tool", "transform": transform}
    deadline, shown = time.monotonic() + TIMEOUT_S, []
    while time.monotonic() < deadline:
        place.node.publish(topic, fields)
        time.sleep(0.05)
        shown = place.node.received(f"{IN}ToolToRobot/transform")[-1:]
        if shown and is_pose(shown[0]["transform"], wanted):
            return
    raise AssertionError(
        f"pose {number}: came back {[each['transform'] for each in shown]}, expected {wanted.tolist()}"
    )


def lost(place: Place) -> Iterator[Row]:
    """The same pose without a status, then with one of the configuration; PLUS may name it otherwise, but not OK."""
    place.node.wait_readers(TOOL, LOST)
    came_back(place, TOOL, 3, reference(3))
    came_back(place, LOST, 3, np.eye(4))
    before = len(place.stamped(STATUSES))
    for _ in range(SENT):
        came_back(place, LOST, 3, np.eye(4))
    told = {at: dict_of(each["items"])["TransformStatus"] for at, each in place.stamped(STATUSES).items()}
    assert OK in told.values() and OK not in list(told.values())[before:], told
    assert {at for at, _ in on_tf(place)} == {at for at, text in told.items() if text == OK}, "others are on /tf"
    yield Row("TRANSFORM with the status OUT_OF_VIEW: no valid pose", TO_IGTL, EXACT, SENT)


def to_tracker(place: Place, sender: Program) -> Iterator[Row]:
    """Each pose that came back is one of the recording, or of none."""
    assert sender.process.wait(120) == 0, sender.said()
    shown = [each["transform"] for each in place.node.received(f"{IN}ToolToRobot/transform")]
    known = [np.eye(4), *map(reference, range(SENT))]
    found = {next(n for n, pose in enumerate(known) if is_pose(each, pose)) for each in shown} - {0}
    assert asked(place, "RequestChannelIds")["status"] == 1, "no answer afterwards"
    assert place.plus.process.poll() is None and len(found) > SENT // 2, f"{len(found)} poses"
    yield Row("replay of its session to its tracker: poses come back, and it lives", TO_IGTL, EXACT, len(found))


def to_server(place: Place, recording: Path) -> Iterator[Row]:
    with closing(replay(recording, "--connect", f"127.0.0.1:{place.port}", "--as-fast-as-possible")) as sender:
        assert sender.process.wait(120) == 0, sender.said()
    assert asked(place, "RequestChannelIds")["status"] == 1, "no answer afterwards"
    assert place.plus.process.poll() is None, "it ended"
    yield Row("replay of its session to its server: it lives, and answers", TO_IGTL, EXACT)


def replay(recording: Path, *words: str) -> Program:
    return gateway("replay", str(recording), "--to", "igtl", *words)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--program", type=Path, required=True, help="PlusServer, in the folder of its build")
    parser.add_argument("--version", default="2.9.0 (112a7f3)", help="of PLUS (default: %(default)s)")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        rows = judge(options.program.resolve(), Path(name))
    return results.write("plus", "PLUS: PlusServer", options.version, "server, and client as a tracker", rows)


if __name__ == "__main__":
    sys.exit(main())
