"""What goes where, for people: the mapping of a configuration and the tables of ``bridge --types``."""

from __future__ import annotations

from igtl_gateway.cli.terminal import aligned
from igtl_gateway.config.configuration import Config
from igtl_gateway.convert.choices import AUTO
from igtl_gateway.convert.igtl_msgs import Query
from igtl_gateway.convert.table import TO_IGTL, TO_ROS, ConversionToRos, Role

#: A row with more types than this is the one of the queries.
_MANY = 8


def mapping(config: Config) -> list[str]:
    """Return the mapping in a few lines: the rules, and the rows of the configuration."""
    tf = ", poses also on /tf" if config.publish_tf else ""
    lines = [
        f"to ROS       published on /igtl/in/<device>/<kind>{tf} ({config.igtl_unit} -> {config.ros_unit})",
        f"to peers     subscribed to /igtl/out/<device> ({config.ros_unit} -> {config.igtl_unit})",
        "             igtl-gateway bridge --types lists all types",
    ]
    for rule in config.to_ros:
        kinds = f", {', '.join(rule.kinds)}" if rule.kinds else ""
        lines.append(f"  device {rule.device} -> {rule.topic}{kinds}")
    for sent in config.to_igtl:
        lines.append(
            f"  {sent.topic} -> {sent.type or 'its usual type'}, device {sent.device or 'named after the topic'}"
        )
    for request in (row.request() for row in config.tf_out):
        frames = ", ".join(request.frames)
        lines.append(f"  frame {frames} in {request.base} -> {request.type}, device {request.device}")
    return lines


def profiles(config: Config) -> list[str]:
    """Return the profiles of peers that the configuration sets, as lines."""
    rows = [(peer.at, peer.profile) for peer in config.peers]
    if config.profile != AUTO:
        rows.append(("all others" if rows else "all", config.profile))
    return [f"peers        {at}: {profile}" for at, profile in rows]


def types() -> list[str]:
    """Return all conversions as the lines of two tables, one for each direction."""
    lines = ["OpenIGTLink -> ROS: topic /igtl/in/<device>/<kind>", ""]
    rows = [(_names(row.igtl_types), row.topic or row.kind, row.message.TYPE, _role(row)) for row in TO_ROS]
    lines += aligned([("type", "kind", "ROS message", ""), *rows], left=4)
    lines += ["", "ROS -> OpenIGTLink: topic /igtl/out/<device>, or --send TOPIC=DEVICE[:TYPE]", ""]
    by_type: dict[str, list[str]] = {}
    for out in TO_IGTL:
        by_type.setdefault(out.message.TYPE, []).append(out.igtl_type)
    by_type[Query.TYPE] = ["GET_, STT_, STP_, RTS_"]
    return lines + aligned(
        [
            ("ROS message", "type", "on request"),
            *((ros_type, default, ", ".join(others)) for ros_type, (default, *others) in by_type.items()),
        ],
        left=3,
    )


def _names(igtl_types: tuple[str, ...]) -> str:
    return "/".join(igtl_types) if len(igtl_types) < _MANY else "GET_, STT_, STP_, RTS_"


def _role(row: ConversionToRos) -> str:
    return "on request (--kinds)" if row.role is Role.ON_REQUEST else ""
