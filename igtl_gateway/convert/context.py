"""Inputs of a conversion besides the message, and its result."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import field
from typing import Any

from igtl_gateway.base.values import value
from igtl_gateway.convert.igtl_msgs import MetadataItem
from igtl_gateway.convert.names import frames_of_name
from igtl_gateway.convert.units import LengthUnits
from igtl_gateway.wire.body import Body


@value(frozen=True, slots=True)
class ToRosContext:
    """Inputs of a conversion from OpenIGTLink to ROS, besides the content.

    Attributes:
        device_name: full device name of the stream.
        stamp_ns: stamp for the ROS header, UTC ns.
        frame_id: frame of the content; for transforms the parent frame.
        child_frame_id: child frame, for transforms.
        lengths: length units of the two sides.
        igtl_type: type name on the wire.
        metadata: the sender's metadata (header version 2), without the items that the gateway itself uses.
        message_id: the sender's id of the message (header version 2).
        link: number of the link from which the message came.
        warnings: (code, sentence) pairs; the conversion appends one for each change of the data.
        reads_status: whether a pose that its sender marks as not valid is left out of /tf.
        whole_names: whether names of tools are whole where PLUS has cut them.
        frames: name of a tool and frame of the stream → (parent, child) frame of the tool.
        made: ROS messages that earlier rows of the table built from the same message, by ROS type.
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
    reads_status: bool = False
    whole_names: bool = False
    frames: Callable[[str, str], tuple[str, str]] = frames_of_name


@value(frozen=True, slots=True)
class ToIgtlContext:
    """Inputs of a conversion from ROS to OpenIGTLink; attributes as in ``ToRosContext``."""

    lengths: LengthUnits = LengthUnits()
    warnings: list[tuple[str, str]] = field(default_factory=list)


@value(frozen=True, slots=True)
class ConvertedMessage:
    """The OpenIGTLink content that a ROS message was converted to.

    Attributes:
        content: the OpenIGTLink body.
        stamp_ns: stamp in the header of the ROS message (UTC ns); 0 if unset.
        frame_id: frame in the header of the ROS message; "" without a header.
        child_frame_id: child frame of a transform.
        metadata: metadata of the ROS message; sent with header version 2.
        igtl_type: type name on the wire if the content determines it; "" for the type of the row.
        device_name: device name if the message has one; "" for that of the topic.
        link: number of the only link that receives the message; 0 for all links.
    """

    content: Body
    stamp_ns: int = 0
    frame_id: str = ""
    child_frame_id: str = ""
    metadata: tuple[MetadataItem, ...] = ()
    igtl_type: str = ""
    device_name: str = ""
    link: int = 0
