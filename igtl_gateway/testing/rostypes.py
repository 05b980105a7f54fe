"""The classes of all ROS types that the gateway receives or publishes, by the name of the type."""

from __future__ import annotations

from igtl_gateway.base.buffers import Buffer
from igtl_gateway.base.errors import ConfigError
from igtl_gateway.convert.igtl_msgs import LinkStatusList, Metadata, RawMessage
from igtl_gateway.convert.rosmsg import RosMessage
from igtl_gateway.convert.table import TO_IGTL, TO_ROS

_ALL: list[type[RosMessage]] = [
    *(row.message for row in TO_ROS),
    *(row.message for row in TO_IGTL),
    LinkStatusList,
    Metadata,
    RawMessage,
]
CLASSES = {kind.TYPE: kind for kind in _ALL}


def unpack(ros_type: str, cdr: Buffer) -> RosMessage:
    """Decode ``cdr``.  Raises ConfigError for a type that the gateway does not know."""
    kind = CLASSES.get(ros_type)
    if kind is None:
        raise ConfigError(f"found a message of type {ros_type}, expected one of {', '.join(sorted(CLASSES))}")
    return kind.unpack(cdr)
