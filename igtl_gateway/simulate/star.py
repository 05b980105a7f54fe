"""The synthetic suturing session of ``star_scene`` as timed ROS messages, as the robot's own nodes would send them.

Each row of the table below is a stream with its rate and its delay: a message is stamped when the sensor
looked, and arrives (``SceneMessage.time_ns``) some fixed latency and a little jitter later.  Time comes from
the schedule and never from a clock, so the same arguments give the same bytes.  **Synthetic data**: the first
status message says so too.
"""

from __future__ import annotations

import colorsys
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from igtl_gateway.convert.rosmsg import (
    Header,
    Image,
    Marker,
    PointCloud2,
    PointField,
    RosMessage,
    String,
    TransformStamped,
)
from igtl_gateway.errors import ConfigError
from igtl_gateway.simulate.star_arm import APPROACH_S, BASE_FROM_CAMERA, CYCLE_S, DRIVE_S, IDLE_S, quaternion
from igtl_gateway.simulate.star_numbers import SEED, Array, Noise
from igtl_gateway.simulate.star_scene import Scene
from igtl_gateway.simulate.star_tissue import STITCHES, WET_STITCH, Plan
from igtl_gateway.stamp import NS_PER_S

START_NS = 1_767_225_600 * NS_PER_S  #: 2026-01-01T00:00:00Z, unless the caller has another start
DURATION_S = 12.0
CAMERA_FRAME = "star_camera_optical"
BASE_FRAME = "lwr_base"
TOOL_FRAME = "suture_tool"

_MS = 1_000_000
_PLANNED_NS = 400 * _MS  # the plan is drawn on the first cloud
_LAST_CORRECTION_NS = 20 * NS_PER_S  # the stray stitch must be mended before the arm comes to it
_FLOAT32 = 7  # sensor_msgs/PointField
_XYZ = tuple(PointField(name, 4 * i, _FLOAT32) for i, name in enumerate("xyz"))
_XYZRGB = (*_XYZ, PointField("rgb", 12, _FLOAT32))


@dataclass(frozen=True, slots=True)
class SceneMessage:
    """One message as it arrives from the ROS graph.

    Attributes:
        time_ns: arrival, UTC nanoseconds; the stamp inside the message is a little earlier.
        topic: ROS topic.
        type: ROS type, as ``"sensor_msgs/msg/Image"``.
        cdr: the serialised message.
        latched: whether the topic is transient local (its last message holds for late subscribers).
        sent_ns: the sender's own stamp, UTC ns: when the sensor looked.
    """

    time_ns: int
    topic: str
    type: str
    cdr: bytes
    latched: bool
    sent_ns: int


class _Session:
    """The scene on its time line."""

    def __init__(self, seed: int, start_ns: int, duration_ns: int) -> None:
        self.scene = Scene(seed)
        self.start_ns = start_ns
        self.status = _status_lines(duration_ns)
        self.path = self.scene.tool(np.array(_TOOL_TIMES(duration_ns)) / NS_PER_S)


@dataclass(frozen=True, slots=True)
class _Shot:
    """What a message is made from: the session, how many of its stream came before, and when."""

    session: _Session
    number: int
    since_ns: int

    @property
    def scene(self) -> Scene:
        return self.session.scene

    @property
    def time_s(self) -> float:
        return self.since_ns / NS_PER_S

    def header(self, frame_id: str) -> Header:
        return Header(self.session.start_ns + self.since_ns, frame_id)


@dataclass(frozen=True, slots=True)
class _Stream:
    topic: str
    times: Callable[[int], range | list[int]]  #: duration → when the sensor looks; all in ns
    latency_ns: int
    jitter_ns: int
    make: Callable[[_Shot], RosMessage]
    latched: bool = False


def messages(duration_s: float = DURATION_S, start_ns: int = START_NS, seed: int = SEED) -> Iterator[SceneMessage]:
    """The session in order of arrival.

    Raises ConfigError if the duration is not a positive number of seconds.
    """
    if not 0 < duration_s < math.inf:
        raise ConfigError(f"duration of the STAR session: found {duration_s} s, expected more than 0")
    return _play(seed, start_ns, round(duration_s * NS_PER_S))


def _play(seed: int, start_ns: int, duration_ns: int) -> Iterator[SceneMessage]:
    session = _Session(seed, start_ns, duration_ns)
    arrivals = []
    for row, stream in enumerate(_STREAMS):
        times = stream.times(duration_ns)
        jitter = Noise(seed, 5, row).uniform(len(times)) * stream.jitter_ns
        arrival_ns = 0
        for number, since_ns in enumerate(times):
            # a transport keeps the order of a topic, however close two messages are
            arrival_ns = max(since_ns + stream.latency_ns + int(jitter[number]), arrival_ns + 1)
            arrivals.append((arrival_ns, row, number, since_ns))
    for arrival_ns, row, number, since_ns in sorted(arrivals):
        stream = _STREAMS[row]
        message = stream.make(_Shot(session, number, since_ns))
        yield SceneMessage(
            start_ns + arrival_ns,
            stream.topic,
            message.TYPE,
            message.pack(),
            stream.latched,
            start_ns + since_ns,
        )


def _cloud(shot: _Shot) -> PointCloud2:
    frame = shot.scene.cloud(shot.number, shot.time_s)
    height, width, _ = frame.points.shape
    rgb = frame.rgb.astype(np.uint32)
    # as the Point Cloud Library packs colour: 0x00RRGGBB in the four bytes of a float
    data = np.empty((height, width, 4), "<u4")
    data[..., :3] = frame.points.astype("<f4").view("<u4")
    data[..., 3] = rgb[..., 0] << 16 | rgb[..., 1] << 8 | rgb[..., 2]
    header = shot.header(CAMERA_FRAME)
    return PointCloud2(header, height, width, _XYZRGB, False, 16, 16 * width, data.tobytes(), False)


def _points(shot: _Shot, points: Array) -> PointCloud2:
    header, count = shot.header(CAMERA_FRAME), len(points)
    return PointCloud2(header, 1, count, _XYZ, False, 12, 12 * count, points.astype("<f4").tobytes(), True)


def _markers(shot: _Shot) -> PointCloud2:
    return _points(shot, shot.scene.detected_markers(shot.number))


def _image(shot: _Shot) -> Image:
    rgb = shot.scene.image(shot.number, shot.time_s)
    height, width, _ = rgb.shape
    return Image(shot.header(CAMERA_FRAME), height, width, "rgb8", 0, 3 * width, rgb.tobytes())


def _tool(shot: _Shot) -> TransformStamped:
    path = shot.session.path
    return _transform(shot, TOOL_FRAME, path.position[shot.number], path.rotation[shot.number])


def _camera_pose(shot: _Shot) -> TransformStamped:
    return _transform(shot, CAMERA_FRAME, BASE_FROM_CAMERA[:3, 3], quaternion(BASE_FROM_CAMERA[:3, :3]))


def _transform(shot: _Shot, child: str, position: Array, rotation: Array) -> TransformStamped:
    x, y, z = (float(value) for value in position)
    qx, qy, qz, qw = (float(value) for value in rotation)
    return TransformStamped(shot.header(BASE_FRAME), child, (x, y, z), (qx, qy, qz, qw))


def _current_plan(shot: _Shot) -> Plan:
    return shot.scene.corrected_plan if shot.number else shot.scene.measured_plan


def _plan(shot: _Shot) -> Marker:
    plan = _current_plan(shot)
    points = np.stack([plan.entry, plan.exit], 1).reshape(-1, 3)
    colours = [(*colorsys.hsv_to_rgb(i / STITCHES, 0.8, 1.0), 1.0) for i in range(STITCHES)]
    return Marker(
        shot.header(CAMERA_FRAME),
        ns="suture_plan",
        id=0,
        type=Marker.LINE_LIST,
        scale=(0.0005, 0.0, 0.0),  # width of the lines, metres
        points=points,
        colors=np.repeat(np.array(colours, np.float32), 2, axis=0),
    )


def _plan_points(shot: _Shot) -> PointCloud2:
    plan = _current_plan(shot)
    return _points(shot, np.concatenate([plan.entry, plan.exit]))


def _status(shot: _Shot) -> String:
    return String(shot.session.status[shot.number][1])


def _plan_times(duration_ns: int) -> list[int]:
    """When the plan is drawn and when it is mended; a session too short for either goes without."""
    mended_ns = min(duration_ns // 2, _LAST_CORRECTION_NS)
    times = [_PLANNED_NS, mended_ns] if mended_ns > _PLANNED_NS else [_PLANNED_NS]
    return [since_ns for since_ns in times if since_ns < duration_ns]


def _status_lines(duration_ns: int) -> list[tuple[int, str]]:
    """What the session says, and when: (ns since the start, text), in order."""
    lines = [(20 * _MS, "session: SYNTHETIC suturing scene, no patient data")]
    plans = (
        f"plan: {STITCHES} stitches from the first cloud",
        f"plan: exit point of stitch {WET_STITCH + 1} put back on the tissue by the operator",
    )
    lines += zip((t + 10 * _MS for t in _plan_times(duration_ns)), plans, strict=False)
    for number in range(STITCHES):
        begin, name = IDLE_S + number * CYCLE_S, f"stitch {number + 1}/{STITCHES}"
        for offset, phase in ((0.0, "approach"), (APPROACH_S, "drive"), (APPROACH_S + DRIVE_S, "pull")):
            lines.append((round((begin + offset) * NS_PER_S), f"{name}: {phase}"))
    lines.append((round((IDLE_S + STITCHES * CYCLE_S) * NS_PER_S), "session: all stitches placed"))
    return sorted(line for line in lines if line[0] < duration_ns)


def _every(period_ns: int, first_ns: int = 0) -> Callable[[int], range]:
    return lambda duration_ns: range(first_ns, duration_ns, period_ns)


_TOOL_TIMES = _every(10 * _MS)

_STREAMS = (
    _Stream("/star/camera_pose", _every(NS_PER_S, 5 * _MS), _MS, _MS // 5, _camera_pose, latched=True),
    _Stream(
        "/star/status",
        lambda duration_ns: [since_ns for since_ns, _ in _status_lines(duration_ns)],
        _MS // 2,
        _MS // 5,
        _status,
        latched=True,
    ),
    _Stream("/star/tool", _TOOL_TIMES, _MS, _MS // 2, _tool),
    _Stream("/star/nir_markers", _every(200 * _MS, 50 * _MS), 30 * _MS, 2 * _MS, _markers),
    _Stream("/star/camera/image", _every(NS_PER_S, 100 * _MS), 25 * _MS, 3 * _MS, _image),
    _Stream("/star/cloud", _every(NS_PER_S, 100 * _MS), 60 * _MS, 5 * _MS, _cloud),
    _Stream("/star/plan", _plan_times, 2 * _MS, _MS // 5, _plan, latched=True),
    _Stream("/star/plan_points", _plan_times, 3 * _MS, _MS // 5, _plan_points, latched=True),
)
