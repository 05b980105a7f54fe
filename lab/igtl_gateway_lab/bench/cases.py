"""What can be measured: a table of cases, each a few streams at their rates."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import Enum
from functools import cache, partial

from igtl_gateway.base.quantities import count_text
from igtl_gateway_lab.bench import payloads
from igtl_gateway_lab.bench.payloads import Payload


class Direction(Enum):
    """Which way a message goes through the gateway."""

    ROS_TO_IGTL = "ros-to-igtl"
    IGTL_TO_ROS = "igtl-to-ros"


#: Stands for all of them, on the command line.
BOTH = "both"
#: Rate of a stream that sends as fast as it can.
FLOOD = 0.0


@dataclass(frozen=True, slots=True)
class BenchStream:
    """One device that sends one kind of message.

    Attributes:
        kind: what is sent, a key of ``PAYLOADS``.
        rate_hz: how often, ``FLOOD``: as often as possible.
        index: distinguishes several streams of the same kind.
    """

    kind: str
    rate_hz: float
    index: int = 0

    def device(self, direction: Direction) -> str:
        """Its device name, at most 20 bytes: one for each direction, so that both can run at once."""
        side = "R" if direction is Direction.ROS_TO_IGTL else "I"
        return f"{side}{self.index}_{self.kind}".replace("-", "_")

    def topic(self, direction: Direction) -> str:
        """Where it is in ROS: published by a node, or by the gateway."""
        device = self.device(direction)
        if direction is Direction.ROS_TO_IGTL:
            return f"/igtl/out/{device}"
        return f"/igtl/in/{device}/{payload(self.kind).kind}"


@dataclass(frozen=True, slots=True)
class Case:
    """A row of the table.

    Attributes:
        name: on the command line.
        streams: what is sent; where there are several they run at once.
        text: one line for people.
        ways: which ways it can be sent.
        at_once: both ways run at the same time.
        stalls: a second client of OpenIGTLink stops reading for a while.
    """

    name: str
    streams: tuple[BenchStream, ...]
    text: str
    ways: tuple[Direction, ...] = tuple(Direction)
    at_once: bool = False
    stalls: bool = False

    def at(self, rate_hz: float) -> Case:
        """The same at another rate."""
        return replace(self, streams=tuple(replace(stream, rate_hz=rate_hz) for stream in self.streams))

    @property
    def together(self) -> bool:
        """Whether it is several streams at once."""
        return len(self.streams) > 1


_POINTS = (1, 10, 100, 1000, 10_000)
_TOOLS = (1, 10)
_THOUSANDS = (10, 30, 100)  # of points of a cloud

#: Kind → what makes it.
PAYLOADS: dict[str, Callable[[], Payload]] = {
    "transform": payloads.transform,
    "string-100": partial(payloads.string, 100),
    **{f"points-{count}": partial(payloads.points, count) for count in _POINTS},
    **{f"tdata-{count}": partial(payloads.tracking, count) for count in _TOOLS},
    "image-vga": partial(payloads.image, 640, 480),
    "image-xga": partial(payloads.image, 1024, 768),
    "image-hd": partial(payloads.image, 1280, 720),
    "image-fullhd": partial(payloads.image, 1920, 1080),
    "image-4k": partial(payloads.image, 3840, 2160),
    **{f"cloud-{count}k": partial(payloads.cloud, 1000 * count) for count in _THOUSANDS},
    "polydata-600k": partial(payloads.surface, 600_000, 230_000),
    "transform-n": partial(payloads.transform, stamped=False),
    **{f"points-{count}-n": partial(payloads.points, count, stamped=False) for count in _POINTS},
    **{f"cloud-{count}k-n": partial(payloads.cloud, 1000 * count, stamped=False) for count in _THOUSANDS},
    "image-vga-n": partial(payloads.image, 640, 480, stamped=False),
    "image-fullhd-n": partial(payloads.image, 1920, 1080, stamped=False),
}

#: Kind → what it is if 3D Slicer sends it, to ROS only; beside what has a number in its content as well.
SLICER: dict[str, str] = {
    **{
        kind: f"{kind.removesuffix('-n')}-s"
        for kind in PAYLOADS
        if kind.endswith("-n") and not kind.startswith("cloud")
    },
    "string-100": "string-100-s",
}
_FROM_SLICER = {sent: kind for kind, sent in SLICER.items()}

#: The same for pictures of other sizes, by how many bytes they have, about.
SIZES: dict[int, str] = {
    size: f"image-{size // 1000}k"
    for size in (1_000, 10_000, 100_000, 1_000_000, 3_000_000, 10_000_000, 25_000_000, 50_000_000)
}


@cache
def payload(kind: str) -> Payload:
    """What a kind of message is; made when it is needed, for the largest has 50 MB."""
    if kind in PAYLOADS:
        return PAYLOADS[kind]()
    if kind in _FROM_SLICER:
        return payloads.from_slicer(PAYLOADS[_FROM_SLICER[kind]]())
    (size,) = (size for size, name in SIZES.items() if name == kind)
    height = math.isqrt(size // 4)  # of 4:3, three bytes a pixel
    return payloads.image(size // 3 // height, height)


_TEXTS = {
    "transform": "TRANSFORM, TransformStamped",
    "string-100": "STRING of 100 bytes",
    "image-vga": "RGB picture of 640 x 480, 0.9 MB",
    "image-xga": "RGB picture of 1024 x 768, 2.4 MB",
    "image-hd": "RGB picture of 1280 x 720, 2.8 MB",
    "image-fullhd": "RGB picture of 1920 x 1080, 6.2 MB",
    "image-4k": "RGB picture of 3840 x 2160, 25 MB",
    "polydata-600k": "surface of 600,000 points and 230,000 triangles",
    **{f"points-{count}": f"POINT with {count_text(count, 'point')}" for count in _POINTS},
    **{f"tdata-{count}": f"TDATA of a tracker with {count_text(count, 'tool')}" for count in _TOOLS},
    **{
        kind: f"{kind.removesuffix('-n')} without stamps, for bridges that keep none: the number is in the content"
        for kind in PAYLOADS
        if kind.endswith("-n")
    },
    **{f"cloud-{count}k": f"PointCloud2 and POLYDATA, {count},000 points" for count in _THOUSANDS},
}

#: What a stream of its own is sent at unless asked otherwise.
USUAL_HZ = 30.0
_RATES = {"image-4k": 5.0, "polydata-600k": 1.0}

CASES: dict[str, Case] = {
    **{kind: Case(kind, (BenchStream(kind, _RATES.get(kind, USUAL_HZ)),), _TEXTS[kind]) for kind in PAYLOADS},
    **{
        sent: Case(
            sent,
            (BenchStream(sent, USUAL_HZ),),
            f"{kind} as 3D Slicer sends it: header version 2, four metadata, an id",
            ways=(Direction.IGTL_TO_ROS,),
        )
        for kind, sent in SLICER.items()
    },
    "mixed": Case(
        "mixed",
        (
            *(BenchStream("transform", 100.0, index) for index in range(10)),
            BenchStream("image-vga", 30.0),
            BenchStream("cloud-30k", 10.0),
            BenchStream("string-100", 20.0),
        ),
        "surgical load: 10 transforms at 100 Hz, VGA at 30 Hz, 30,000 points at 10 Hz, 20 strings a second, both ways",
        at_once=True,
    ),
    "stalled-client": Case(
        "stalled-client",
        (BenchStream("image-fullhd", FLOOD), BenchStream("transform", 100.0)),
        "flood of Full HD and a transform at 100 Hz to two clients, one of which stops reading for a while",
        ways=(Direction.ROS_TO_IGTL,),
        stalls=True,
    ),
}

#: The paper's Table 1.
TABLE_1 = (
    "transform",
    "string-100",
    *(f"points-{count}" for count in _POINTS),
    *("image-vga", "image-xga", "image-hd", "image-fullhd"),
)
