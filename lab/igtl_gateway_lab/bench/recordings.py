"""The recordings that offline work is measured with: made by the gateway's own core on scripted time.

They are real recordings, the outputs included, and verify as such; equal lengths give equal entries.
"""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np

from igtl_gateway.base.stamp import NS_PER_MS, NS_PER_S, ns_to_ros, ns_to_ticks
from igtl_gateway.base.version import __version__
from igtl_gateway.config.configuration import Config, ToIgtlRow, ToRosRow
from igtl_gateway.convert.common_msgs import JointState
from igtl_gateway.convert.interfaces import SHARES
from igtl_gateway.convert.rosmsg import Header, Image, PointCloud2, PointField, RosMessage, String, TransformStamped
from igtl_gateway.gateway import TICK, Gateway, Session
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.note import Level, Note
from igtl_gateway.record.sessionfile.schemas import RosTypes
from igtl_gateway.record.sessionfile.writer import SessionWriter
from igtl_gateway.wire import Message
from igtl_gateway.wire.header import TICKS_AT
from igtl_gateway.wire.text import String as WireString
from igtl_gateway.wire.transform import Transform
from igtl_gateway_lab.bench.payloads import transform
from igtl_gateway_lab.simulate import ultrasound
from igtl_gateway_lab.simulate.scenario import (
    SYNTHETIC,
    ScenarioInput,
    link_down_input,
    link_up_input,
    merge_inputs,
    note_input,
    peer_input,
    ros_input,
)
from igtl_gateway_lab.simulate.stage import START_NS, play_offline

_TICKS, _TIME = struct.Struct(">Q"), struct.Struct("<iI")
_TIME_AT = 4  # of a stamped message in CDR
_TRAVEL_NS = 300_000  # from a node to the gateway
_PEER, _SECOND_PORT = "127.0.0.1:53001", 54001
_REST_S = 120.0  # a story that takes so much longer is stuck
#: Poses a second of `small`, in each direction.
SMALL_HZ = 1_000
_JOINTS = tuple(f"joint_{number}" for number in range(1, 8))
_PIXELS, _POINTS = 256, 500
_XYZ = tuple(PointField(name, 4 * axis, 7) for axis, name in enumerate("xyz"))


def small(path: Path, duration_s: float) -> int:
    """TRANSFORM at 1 kHz both ways: four small entries a millisecond.  Returns the number of entries."""
    config = Config(
        to_igtl=(ToIgtlRow(topic="/tool", device="ToolToBase", type="TRANSFORM"),),
        to_ros=(ToRosRow(device="Tracker", kinds=("transform",)),),
    )
    return _written(
        path, config, _played(config, merge_inputs(_begin(), _poses_in(duration_s), _poses_out(duration_s)))
    )


def pictures(path: Path, duration_s: float) -> int:
    """The session of the scenario ``ultrasound``: pictures, poses, clouds, status.  Returns the number of entries."""
    config = ultrasound.CONFIG
    return _written(path, config, play_offline(ultrasound.actors(duration_s), config, limit_s=duration_s + _REST_S))


def mixed(path: Path, duration_s: float) -> int:
    """What a room has: poses, joint states, pictures, clouds, strings, notes.  Returns the number of entries."""
    rows = (
        ("/tool", "ToolToBase", "TRANSFORM"),
        ("/joint_states", "Joints", "SENSOR"),
        ("/camera", "Camera", "IMAGE"),
        ("/surface", "Surface", "POINT"),
        ("/task", "Task", "STRING"),
    )
    config = Config(to_igtl=tuple(ToIgtlRow(topic=topic, device=device, type=name) for topic, device, name in rows))
    sources = (_poses, _joints, _camera, _clouds, _tasks, _plans, _calls)
    return _written(path, config, _played(config, merge_inputs(_begin(), *(source(duration_s) for source in sources))))


def _written(path: Path, config: Config, entries: Iterable[Entry]) -> int:
    facts = {
        "config": json.dumps(config.to_dict(), sort_keys=True),
        "igtl_gateway_version": __version__,
        "synthetic": SYNTHETIC,
    }
    writer = SessionWriter(path, facts, types=RosTypes(SHARES), counted=True)
    for entry in entries:
        writer.write(entry)
    writer.close({})
    return writer.entries


def _played(config: Config, inputs: Iterable[ScenarioInput]) -> Iterator[Entry]:
    """The session log: inputs and the gateway's deadlines, and what they cause."""
    gateway = Gateway(config)
    session = Session(gateway)
    tick = (Note(Level.INFO, TICK, "a deadline has come").pack(),)
    for given in inputs:
        while gateway.due_ns is not None and gateway.due_ns <= given.time_ns:
            yield from session.input(gateway.due_ns, Kind.EDGE_NOTE, tick)
        yield from given.entries(session)


def _begin() -> Iterator[ScenarioInput]:
    yield note_input(START_NS, "synthetic", "synthetic session: no robot, no patient, no camera")
    yield link_up_input(START_NS + NS_PER_MS, 1, _PEER)


def _times(hz: float, duration_s: float, late_ns: int = 0) -> Iterator[tuple[int, int]]:
    """Number and time (UTC ns) of what comes at a rate; ``late_ns``: after the start of each period."""
    begin_ns = START_NS + 10 * NS_PER_MS + late_ns
    return ((number, begin_ns + round(number * NS_PER_S / hz)) for number in range(round(hz * duration_s)))


def _poses_in(duration_s: float) -> Iterator[ScenarioInput]:
    frame = bytearray(transform().igtl_maker("Tracker")(0))
    for _, time_ns in _times(SMALL_HZ, duration_s):
        _TICKS.pack_into(frame, TICKS_AT, ns_to_ticks(time_ns - _TRAVEL_NS))
        yield ScenarioInput(time_ns, Kind.IGTL_IN, bytes(frame), link=1)


def _poses_out(duration_s: float) -> Iterator[ScenarioInput]:
    cdr = bytearray(transform().ros_maker()(0))
    for _, time_ns in _times(SMALL_HZ, duration_s, NS_PER_MS // 2):
        sent_ns = time_ns - _TRAVEL_NS
        _TIME.pack_into(cdr, _TIME_AT, *ns_to_ros(sent_ns))
        yield ScenarioInput(time_ns, Kind.ROS_IN, bytes(cdr), "/tool", TransformStamped.TYPE, source_ns=sent_ns)


def _sent(time_ns: int, topic: str, message: RosMessage) -> ScenarioInput:
    return ros_input(time_ns, topic, message, time_ns - _TRAVEL_NS)


def _poses(duration_s: float) -> Iterator[ScenarioInput]:
    for number, time_ns in _times(40, duration_s):
        angle = number / 400
        cos, sin = math.cos(angle), math.sin(angle)
        rows = [[cos, -sin, 0.0, 80 * cos], [sin, cos, 0.0, 80 * sin], [0.0, 0.0, 1.0, 30.5]]
        ticks = ns_to_ticks(time_ns - _TRAVEL_NS)
        yield peer_input(time_ns, 1, Message("TRANSFORM", "Tracker", Transform.from_rows(rows), ticks))
        header = Header(time_ns - _TRAVEL_NS, "Base")
        half = (0.0, 0.0, math.sin(angle / 2), math.cos(angle / 2))
        yield _sent(time_ns + NS_PER_MS, "/tool", TransformStamped(header, "Tool", (cos / 8, sin / 8, 0.03), half))


def _joints(duration_s: float) -> Iterator[ScenarioInput]:
    for number, time_ns in _times(50, duration_s, 2 * NS_PER_MS):
        position = np.sin(number / 200 + np.arange(len(_JOINTS)))
        header = Header(time_ns - _TRAVEL_NS, "Base")
        yield _sent(time_ns, "/joint_states", JointState(header, _JOINTS, position, position / 4))


def _camera(duration_s: float) -> Iterator[ScenarioInput]:
    """Grey pictures: a gradient that moves, and the noise of a camera in the last two bits."""
    columns, rows = np.meshgrid(np.arange(_PIXELS), np.arange(_PIXELS))
    noise = np.random.Generator(np.random.PCG64(7))
    for number, time_ns in _times(4, duration_s, 5 * NS_PER_MS):
        seen = (columns + rows + 2 * number & 0xFC).astype(np.uint8)
        seen |= np.frombuffer(noise.bytes(seen.size), np.uint8).reshape(seen.shape) & 3
        header = Header(time_ns - _TRAVEL_NS, "Camera")
        yield _sent(time_ns, "/camera", Image(header, _PIXELS, _PIXELS, "mono8", 0, _PIXELS, seen.tobytes()))


def _clouds(duration_s: float) -> Iterator[ScenarioInput]:
    at = np.arange(_POINTS)
    for number, time_ns in _times(2, duration_s, 7 * NS_PER_MS):
        places = np.stack([np.cos(at / 16), np.sin(at / 16 + number / 40), at / _POINTS], axis=1) / 30
        data = places.astype("<f4").tobytes()
        header = Header(time_ns - _TRAVEL_NS, "Camera")
        yield _sent(time_ns, "/surface", PointCloud2(header, 1, _POINTS, _XYZ, False, 12, len(data), data, True))


def _tasks(duration_s: float) -> Iterator[ScenarioInput]:
    for number, time_ns in _times(1, duration_s, 9 * NS_PER_MS):
        yield _sent(time_ns, "/task", String(f"step {number + 1}: move to the next target"))


def _plans(duration_s: float) -> Iterator[ScenarioInput]:
    for number, time_ns in _times(0.2, duration_s, 11 * NS_PER_MS):
        text = WireString.of(f"target {number + 1} is planned")
        yield peer_input(time_ns, 1, Message("STRING", "Plan", text, ns_to_ticks(time_ns - _TRAVEL_NS)))


def _calls(duration_s: float) -> Iterator[ScenarioInput]:
    """A second peer connects for the second half of each minute."""
    for number, time_ns in _times(1 / 30, duration_s, 13 * NS_PER_MS):
        link, peer = 2 + number // 2, f"127.0.0.1:{_SECOND_PORT + number // 2}"
        yield (link_down_input if number % 2 else link_up_input)(time_ns, link, peer)
