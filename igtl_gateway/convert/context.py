"""What a conversion is told besides the message, and what it gives back."""

from __future__ import annotations

from dataclasses import field
from typing import Any

from igtl_gateway.convert.igtl_msgs import MetadataItem
from igtl_gateway.convert.units import LengthUnits
from igtl_gateway.values import value
from igtl_gateway.wire.body import Body


@value(frozen=True, slots=True)
class ToRosContext:
    """Circumstances of a message on its way to ROS.

    Attributes:
        device_name: the full name of the stream.
        stamp_ns: UTC ns for the ROS header.
        frame_id: frame of the content; for transforms the parent.
        child_frame_id: for transforms.
        lengths: units of the two sides.
        igtl_type: type name on the wire.
        metadata: what the sender said besides (header version 2), without what the gateway itself understands.
        message_id: sender's id of the message (header version 2).
        link: number of the peer that it came from.
        warnings: (code, sentence) pairs that the conversion adds to: converted, but something was bent.
        made: what other rows have made of the message already, by type; for those that say the same once more.
    """

    device_name: str
    stamp_ns: int
    frame_id: str
    child_frame_id: str
    lengths: LengthUnits = LengthUnits()
    igtl_type: str = ""
    metadata: tuple[MetadataItem, ...] = ()
    message_id: int = 0
    link: int = 0
    warnings: list[tuple[str, str]] = field(default_factory=list)
    made: dict[str, Any] = field(default_factory=dict)


@value(frozen=True, slots=True)
class ToIgtlContext:
    """Circumstances of a message on its way to OpenIGTLink; attributes as in ``ToRosContext``."""

    lengths: LengthUnits = LengthUnits()
    warnings: list[tuple[str, str]] = field(default_factory=list)


@value(frozen=True, slots=True)
class ConvertedMessage:
    """What a ROS message became.

    Attributes:
        content: the OpenIGTLink body.
        stamp_ns: stamp in the ROS message's own header (UTC ns), 0 where it has none.
        frame_id: frame in the ROS message's own header, "" where it has none.
        child_frame_id: of a transform.
        metadata: what the ROS message says besides; travels with header version 2.
        igtl_type: type name on the wire where the content decides it, "" for that of the row.
        device_name: device where the message names one, "" for that of the topic.
        link: number of the only peer that it is for, 0 for all.
    """

    content: Body
    stamp_ns: int = 0
    frame_id: str = ""
    child_frame_id: str = ""
    metadata: tuple[MetadataItem, ...] = ()
    igtl_type: str = ""
    device_name: str = ""
    link: int = 0
