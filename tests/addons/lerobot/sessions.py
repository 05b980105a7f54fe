"""Small sessions whose content at any time is known without reading them: two arms, two cameras, a force, markers."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

import igtl_gateway
from igtl_gateway.base.buffers import join
from igtl_gateway.base.stamp import NS_PER_S, ns_to_ticks
from igtl_gateway.config.configuration import Config
from igtl_gateway.convert.common_msgs import JointState
from igtl_gateway.convert.rosmsg import Header
from igtl_gateway.convert.rosmsg import Image as RosImage
from igtl_gateway.gateway import Gateway, Session
from igtl_gateway.gateway.log.entry import Kind
from igtl_gateway.record.sessionfile.writer import SessionWriter
from igtl_gateway.wire import Message, encode
from igtl_gateway.wire.body import Body
from igtl_gateway.wire.image import Image
from igtl_gateway.wire.text import String
from igtl_gateway.wire.transform import Transform

BEGIN_NS = 1_700_000_000 * NS_PER_S
#: Time of the gateway minus stamp: transport.
TRANSPORT_NS = 3_000_000
Array = npt.NDArray[Any]

#: Time (s), stream, content: one message.
Sent = tuple[float, str, Any]


def write_session(
    path: Path, messages: Sequence[Sent], *, stamped: bool = True, ahead_s: Mapping[str, float] | None = None
) -> Path:
    """Write a session with these messages at their times after ``BEGIN_NS``; the gateway gets each 3 ms later.

    Args:
        path: new file.
        messages: in the order in which they arrive.
        stamped: whether messages have a stamp.
        ahead_s: stream → how far the clock of its stamps is ahead.
    """
    config = Config()
    session = Session(Gateway(config))
    facts = {"config": json.dumps(config.to_dict()), "igtl_gateway_version": igtl_gateway.__version__}
    writer = SessionWriter(path, facts)
    now_ns = 0
    for at, stream, content in messages:
        stamp_ns = BEGIN_NS + round(at * NS_PER_S)
        now_ns = max(stamp_ns + TRANSPORT_NS, now_ns + 1)
        stamp_ns += round((ahead_s or {}).get(stream, 0.0) * NS_PER_S)
        if stream.startswith("/"):
            message, source_ns = content(stamp_ns), stamp_ns if stamped else 0
            entries = session.input(
                now_ns, Kind.ROS_IN, (message.pack(),), channel=stream, type_name=message.TYPE, source_ns=source_ns
            )
        else:
            kind, _, device = stream.partition("/")
            ticks = ns_to_ticks(stamp_ns) if stamped else 0
            frame = join(encode(Message(kind, device, content, ticks=ticks)))
            entries = session.input(now_ns, Kind.IGTL_IN, (frame,), links=(1,))
        for entry in entries:
            writer.write(entry)
    writer.close({"streams": session.gateway.ledger.to_dict()})
    return path


def pose_m(at: float, arm: int) -> Array:
    """The pose of an arm at a time (s), m: straight and about one axis, so that interpolation is exact."""
    angle = 0.3 * at + 0.1 * arm
    matrix = np.eye(4)
    matrix[:2, :2] = [[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]]
    matrix[:3, 3] = 0.01 * at, 0.05 * arm, 0.02 - 0.004 * at
    return matrix


def quaternion(at: float, arm: int) -> list[float]:
    """The rotation of :func:`pose_m` as x, y, z, w."""
    half = (0.3 * at + 0.1 * arm) / 2
    return [0.0, 0.0, math.sin(half), math.cos(half)]


def arm(at: float, number: int) -> Body:
    """The pose as TRANSFORM."""
    matrix = pose_m(at, number)
    matrix[:3, 3] *= 1000
    return Transform.from_rows(matrix.tolist())


def bars(number: int, rows: int = 48, columns: int = 64) -> Array:
    """A picture (rows, columns) whose eight bars are the bits of its number."""
    bits = [(number >> bit) & 1 for bit in range(8)]
    return np.repeat(np.array(bits, np.uint8) * 200 + 20, columns // 8)[np.newaxis, :].repeat(rows, 0)


def number_of(picture: Array) -> int:
    """The number of a picture of :func:`bars`, decoded."""
    width = picture.shape[1] // 8
    return sum(int(picture[8:-8, bit * width + 2 : (bit + 1) * width - 2].mean() > 120) << bit for bit in range(8))


def blue_bars(number: int) -> Callable[[int], RosImage]:
    """A picture of 65 × 49 pixels, bgr8: the bars are in the blue channel only."""

    def message(stamp_ns: int) -> RosImage:
        pixels = np.zeros((49, 65, 3), np.uint8)
        pixels[:48, :64, 0] = bars(number)
        return RosImage(Header(stamp_ns, "camera"), 49, 65, "bgr8", 0, 195, pixels.tobytes())

    return message


def joints(at: float) -> Callable[[int], JointState]:
    """Two joints."""
    nothing = np.array([])
    return lambda stamp_ns: JointState(
        Header(stamp_ns, ""), ("yaw", "pitch"), np.array([0.5 * at, 1 - 0.25 * at]), nothing, nothing
    )


def trial_messages(seconds: float = 3.0) -> list[Sent]:
    """Two arms at 100 Hz with jitter, two cameras at 30 and 25 Hz, joints at 50 Hz, markers of two trials."""
    jitter = np.random.default_rng(1).uniform(-2e-3, 2e-3, 10_000)
    messages: list[Sent] = []
    for number in range(round(seconds * 100)):
        for each in (0, 1):
            at = number / 100 + 0.02 + float(jitter[2 * number + each])
            messages.append((at, f"TRANSFORM/Arm{each}ToBase", arm(at, each)))
    for number in range(round(seconds * 30)):
        at = number / 30 + 0.011
        messages.append((at, "IMAGE/Left", Image((64, 48, 1), 3, bars(number).tobytes())))
    messages += [(number / 25 + 0.007, "/right/image", blue_bars(number)) for number in range(round(seconds * 25))]
    messages += [
        (number / 50 + 0.003, "/joint_states", joints(number / 50 + 0.003)) for number in range(round(seconds * 50))
    ]
    marks = (
        (0.001, "ready"),
        (0.5, "start: left knot"),
        (1.5, "stop"),
        (1.8, "start right knot"),
        (seconds - 0.3, "stop"),
    )
    messages += [(at, "STRING/Trial", String(text.encode())) for at, text in marks]
    return sorted(messages, key=lambda each: each[0])


TRIAL_RECIPE = """\
[dataset]
fps = 20
task = "tie"
robot_type = "two arms"
format = "{format}"
measure_lags = {lags}
[episodes]
by = "markers"
stream = "STRING/Trial"
[[feature]]
name = "observation.state"
stream = "TRANSFORM/Arm0ToBase"
[[feature]]
name = "observation.state"
stream = "TRANSFORM/Arm1ToBase"
[[feature]]
name = "observation.state.joint_positions"
stream = "/joint_states"
fields = ["position"]
[[feature]]
name = "observation.images.left"
stream = "IMAGE/Left"
[[feature]]
name = "observation.images.right"
stream = "/right/image"
rule = "hold"
[[feature]]
name = "observation.meta.trial"
stream = "STRING/Trial"
tolerance_ms = "any"
[[feature]]
name = "action"
next_of = "observation.state"
[splits]
train = "0:1"
val = "1:2"
[card]
license = "CC BY 4.0"
"""
