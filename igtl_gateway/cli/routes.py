"""Options for what a configuration file also sets: topics, frames, messages and peers."""

from __future__ import annotations

import argparse
from typing import Any

from igtl_gateway.cli.options import Options, default
from igtl_gateway.config import PROFILE_NAMES, Config
from igtl_gateway.convert.frames import TfRequest
from igtl_gateway.convert.profiles import AUTO
from igtl_gateway.convert.table import TO_ROS
from igtl_gateway.errors import ConfigError


def add_send(parser: Options) -> None:
    """``--send``, any number of times."""
    parser.add_argument(
        "--send",
        action="append",
        default=[],
        metavar="TOPIC[=DEVICE[:TYPE]]",
        help="send this ROS topic to OpenIGTLink as this device and message type (repeatable)",
    )


def add_peers(group: Options) -> None:
    """Options for the profiles of peers."""
    group.add_argument(
        "--profile",
        choices=PROFILE_NAMES,
        help="profile of all peers " + default(f"{AUTO}, detected from their messages"),
    )
    group.add_argument(
        "--peer",
        action="append",
        default=[],
        metavar="HOST:PORT=PROFILE",
        help="profile of the server at this address, or of clients that connect to this address (repeatable)",
    )


def add_messages(group: Options) -> None:
    """Options for the messages that are sent and published."""
    add_send(group)
    group.add_argument(
        "--tf-out",
        action="append",
        default=[],
        metavar="FRAME[,FRAME…]:BASE[=DEVICE[:TYPE]]",
        help="send the poses of frames in BASE, from /tf and /tf_static: one frame as TRANSFORM, several as TDATA "
        "(repeatable)",
    )
    group.add_argument(
        "--kinds",
        action="append",
        default=[],
        metavar="DEVICE=KIND[,KIND…]",
        help="publish these messages of a device instead of the default ones, or with +KIND in addition to them; "
        "DEVICE: * matches one level, ** any number (repeatable)",
    )


def add_topics(group: Options) -> None:
    """Options for the ROS graph."""
    group.add_argument("--no-tf", action="store_true", help="do not publish poses on /tf")


def add_denials(group: Options) -> None:
    """``--deny-in`` and ``--deny-out``, any number of each."""
    for way, text in (("in", "reject messages of this type from peers"), ("out", "send no messages of this type")):
        group.add_argument(
            f"--deny-{way}",
            action="append",
            default=[],
            metavar="TYPE",
            help=f"{text}: COMMAND, 'GET_*', '*' for all (repeatable)",
        )


def with_routes(config: Config, options: argparse.Namespace) -> Config:
    """Return ``config`` with the options of the command line; their rows precede those of the file."""
    values = config.to_dict()
    values["to_igtl"] = [*map(_send_row, options.send), *values["to_igtl"]]
    values["tf_out"] = [*map(_tf_row, options.tf_out), *values["tf_out"]]
    kinds: dict[str, list[str]] = {}
    for device, named in map(_kinds_row, options.kinds):
        kinds.setdefault(device, []).extend(named)
    rows = [{"device": device, "kinds": named} for device, named in kinds.items()]
    values["to_ros"] = [*rows, *values["to_ros"]]
    values["peers"] = [*map(_peer_row, options.peer), *values["peers"]]
    values["deny_in"] = [*options.deny_in, *values["deny_in"]]
    values["deny_out"] = [*options.deny_out, *values["deny_out"]]
    if options.profile:
        values["profile"] = options.profile
    if options.no_tf:
        values["publish_tf"] = False
    return Config.from_dict(values)


def with_sends(config: Config, sends: list[str]) -> Config:
    """Return ``config`` with a first row for each ``TOPIC[=DEVICE[:TYPE]]``."""
    values = config.to_dict()
    return Config.from_dict(values | {"to_igtl": [*map(_send_row, sends), *values["to_igtl"]]})


def _send_row(text: str) -> dict[str, str]:
    topic, _, rest = text.partition("=")
    device, _, igtl_type = rest.partition(":")
    if not topic.startswith("/"):
        raise ConfigError(f"--send: found {text!r}, expected /topic, /topic=Device or /topic=Device:TYPE")
    return {"topic": topic, "device": device, "type": igtl_type}


def _tf_row(text: str) -> dict[str, Any]:
    request = TfRequest.parse(text)
    return {"frames": request.frames, "base": request.base, "device": request.device, "type": request.type}


def _kinds_row(text: str) -> tuple[str, list[str]]:
    device, equals, kinds = text.partition("=")
    known = {row.kind for row in TO_ROS}
    named = [kind.strip() for kind in kinds.split(",")]
    wrong = [kind for kind in named if kind.removeprefix("+") not in known]
    if not device or not equals or wrong:
        raise ConfigError(f"--kinds: found {text!r}, expected DEVICE=KIND[,KIND…] of {', '.join(sorted(known))}")
    return device, named


def _peer_row(text: str) -> dict[str, str]:
    place, _, profile = text.rpartition("=")
    if not place or profile not in PROFILE_NAMES:
        raise ConfigError(f"--peer: found {text!r}, expected HOST:PORT=PROFILE, one of {', '.join(PROFILE_NAMES)}")
    return {"at": place, "profile": profile}
