"""What a conversion is told besides the message, and what it gives back."""

from __future__ import annotations

from dataclasses import dataclass, field

from igtl_gateway.convert.units import Lengths
from igtl_gateway.wire.body import Body


@dataclass(frozen=True, slots=True)
class ToRos:
    """Circumstances of a message on its way to ROS.

    Attributes:
        device_name: the full name of the stream.
        stamp_ns: UTC ns for the ROS header.
        frame_id: frame of the content; for transforms the parent.
        child_frame_id: for transforms.
        lengths: units of the two sides.
        warnings: (code, sentence) pairs that the conversion adds to: converted, but something was bent.
    """

    device_name: str
    stamp_ns: int
    frame_id: str
    child_frame_id: str
    lengths: Lengths = Lengths()
    warnings: list[tuple[str, str]] = field(default_factory=list)


@dataclass(frozen=True, slots=True)
class ToIgtl:
    """Circumstances of a message on its way to OpenIGTLink; attributes as in ``ToRos``."""

    lengths: Lengths = Lengths()
    warnings: list[tuple[str, str]] = field(default_factory=list)


@dataclass(frozen=True, slots=True)
class Outgoing:
    """What a ROS message became.

    Attributes:
        content: the OpenIGTLink body.
        stamp_ns: stamp in the ROS message's own header (UTC ns), 0 where it has none.
    """

    content: Body
    stamp_ns: int = 0
