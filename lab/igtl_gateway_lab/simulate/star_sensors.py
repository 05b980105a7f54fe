"""The sensors of the STAR session as one ROS program: cloud, picture with its camera info, near-infrared markers.

Each stream has a rate and a delay: a message has the time of the measurement as its stamp, and is sent after a fixed
latency and a little jitter.  The tool's pose at that time has been received by then.  **Synthetic data.**
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

from igtl_gateway.base.stamp import NS_PER_MS, NS_PER_S
from igtl_gateway.convert.common_msgs import CameraInfo
from igtl_gateway.convert.rosmsg import Header, Image, TransformStamped
from igtl_gateway_lab.simulate import star_topics as topics
from igtl_gateway_lab.simulate.actor import ActorProtocol, ActorReport, Publishes, Received, RosReceived, RosSent, Sent
from igtl_gateway_lab.simulate.agenda import Agenda
from igtl_gateway_lab.simulate.star_arm import SHAFT, held
from igtl_gateway_lab.simulate.star_camera import IMAGE_CAMERA
from igtl_gateway_lab.simulate.star_numbers import SEED, Array, Noise
from igtl_gateway_lab.simulate.star_scene import StarScene

_KEPT_POSES = 100  # a second of them: far more than the slowest sensor takes
_SAID = (topics.CLOUD, topics.IMAGE, topics.CAMERA_INFO, topics.MARKERS)


@dataclass(frozen=True, slots=True)
class _Shot:
    """When a sensor looked, UTC ns, and how many times before."""

    number: int
    stamp_ns: int

    @property
    def header(self) -> Header:
        return Header(self.stamp_ns, topics.CAMERA_FRAME)


@dataclass(frozen=True, slots=True)
class _SensorStream:
    """Times in ns: first look since the beginning, from look to look, from look to message."""

    make: Callable[[_Shot], Iterable[Sent]]
    first_ns: int
    period_ns: int
    latency_ns: int
    jitter: Noise
    jitter_ns: int


class Sensors:
    """An actor of ROS; see the module."""

    name = "star_sensors"
    side = ActorProtocol.ROS

    def __init__(self, duration_ns: int, seed: int = SEED) -> None:
        self.subscribes = {topics.TOOL: topics.TYPES[topics.TOOL]}
        self.publishes = {
            topic: Publishes(topics.TYPES[topic], recorded=topic == topics.CAMERA_INFO) for topic in _SAID
        }
        self._duration_ns = duration_ns
        self._scene = StarScene(seed)
        self._agenda = Agenda()
        self._start_ns = 0
        self._poses: deque[TransformStamped] = deque(maxlen=_KEPT_POSES)
        self._counts = dict.fromkeys(_SAID, 0)
        self._over = False
        second = NS_PER_S
        self._streams = tuple(
            _SensorStream(make, first * NS_PER_MS, period, latency * NS_PER_MS, Noise(seed, 5, row), jitter * NS_PER_MS)
            for row, (make, first, period, latency, jitter) in enumerate(
                (
                    (self._markers, 50, second // 5, 30, 2),
                    (self._picture, 100, second, 25, 3),
                    (self._cloud, 100, second, 60, 5),
                )
            )
        )

    def prepare(self) -> None:
        """What the undisturbed scene looks like: seconds of work."""
        self._scene.look()

    def begin(self, now_ns: int) -> None:
        self._start_ns = now_ns
        for stream in self._streams:
            self._note(stream, 0, 0)
        self._agenda.add(now_ns + self._duration_ns, self._end)

    @property
    def due_ns(self) -> int | None:
        return self._agenda.due_ns

    def act(self, now_ns: int) -> Iterable[Sent]:
        return self._agenda.act(now_ns)

    def receive(self, now_ns: int, received: Received) -> Iterable[Sent]:
        if isinstance(received, RosReceived):
            self._poses.append(TransformStamped.unpack(received.cdr))
        return ()

    @property
    def done(self) -> bool:
        return self._over

    def report(self) -> ActorReport:
        clouds, pictures, _, markers = (self._counts[topic] for topic in _SAID)
        facts = {"clouds": clouds, "pictures": pictures, "markers": markers}
        line = f"clouds taken: {clouds}; pictures: {pictures}; looks at the markers: {markers}"
        return ActorReport(bool(clouds), (line,), facts)

    def _note(self, stream: _SensorStream, look: int, number: int) -> None:
        """Note the look after ``look - 1`` others that were possible and ``number`` that happened."""
        since_ns = stream.first_ns + look * stream.period_ns
        if since_ns >= self._duration_ns:
            return
        delay_ns = stream.latency_ns + int(stream.jitter.uniform(1)[0] * stream.jitter_ns)

        def say(now_ns: int) -> Iterable[Sent]:
            # what a slow machine could not look at in time is not looked at later
            missed = max(0, (now_ns - self._start_ns - since_ns - delay_ns) // stream.period_ns)
            self._note(stream, look + missed + 1, number + 1)
            return stream.make(_Shot(number, self._start_ns + since_ns + missed * stream.period_ns))

        self._agenda.add(self._start_ns + since_ns + delay_ns, say)

    def _end(self, _now_ns: int) -> Iterable[Sent]:
        self._agenda.clear()
        self._over = True
        return ()

    def _tool(self, stamp_ns: int) -> tuple[Array, Array]:
        """Tip and direction of the shaft at a time, from the poses received so far."""
        past = next((pose for pose in reversed(self._poses) if pose.header.stamp_ns <= stamp_ns), None)
        return held(past.translation, past.rotation) if past else (self._scene.rest, SHAFT)

    def _cloud(self, shot: _Shot) -> Iterable[Sent]:
        frame = self._scene.cloud(shot.number, *self._tool(shot.stamp_ns))
        self._counts[topics.CLOUD] += 1
        yield RosSent(topics.CLOUD, topics.coloured_cloud(shot.header, frame.points, frame.rgb))

    def _picture(self, shot: _Shot) -> Iterable[Sent]:
        rgb = self._scene.image(shot.number, *self._tool(shot.stamp_ns))
        height, width, _ = rgb.shape
        self._counts[topics.IMAGE] += 1
        self._counts[topics.CAMERA_INFO] += 1
        yield RosSent(topics.CAMERA_INFO, camera_info(shot.header))
        yield RosSent(topics.IMAGE, Image(shot.header, height, width, "rgb8", 0, 3 * width, rgb.tobytes()))

    def _markers(self, shot: _Shot) -> Iterable[Sent]:
        self._counts[topics.MARKERS] += 1
        yield RosSent(topics.MARKERS, topics.plain_cloud(shot.header, self._scene.detected_markers(shot.number)))


def camera_info(header: Header) -> CameraInfo:
    """The pinhole of the colour camera, without distortion."""
    focal, width, height = IMAGE_CAMERA.focal_px, IMAGE_CAMERA.width, IMAGE_CAMERA.height
    u, v = (width - 1) / 2, (height - 1) / 2
    k = (focal, 0.0, u, 0.0, focal, v, 0.0, 0.0, 1.0)
    p = (focal, 0.0, u, 0.0, 0.0, focal, v, 0.0, 0.0, 0.0, 1.0, 0.0)
    still = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
    return CameraInfo(header, height, width, "plumb_bob", np.zeros(5), k, still, p)
