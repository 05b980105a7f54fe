"""``igtl-gateway simulate``: a scenario, live over real connections or as a recording."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

from igtl_gateway.cli.options import (
    DEFAULT_HOST,
    DEFAULT_PORT,
    add_json,
    add_output,
    add_overwrite,
    address,
    default,
    definitions,
)
from igtl_gateway_lab.simulate.catalogue import SCENARIOS
from igtl_gateway_lab.simulate.load import SENDERS, SIZES, Load

_SCENARIOS = "\n".join(definitions([(name, scenario.title) for name, scenario in SCENARIOS.items()]))
EXAMPLES = f"""\
  # live: a bridge, a ROS 2 node and an OpenIGTLink client
  igtl-gateway simulate acquisition
  # the same, with the recording of the bridge
  igtl-gateway simulate acquisition --record a.mcap
  # the same, shown live in rerun
  igtl-gateway simulate star --view
  # offline: no ROS, no network, always the same content
  igtl-gateway simulate acquisition -o a.mcap
  # a load for the bridge
  igtl-gateway simulate test-server --type IMAGE --size 640 --rate 30 \\
      --count 300
  # only the ROS node, for a bridge that you run
  igtl-gateway simulate test-node --side ros
  # only the OpenIGTLink client, for a bridge that you run
  igtl-gateway simulate test-server --side igtl --connect 127.0.0.1:18944
  # robot and bridge; 3D Slicer replaces the planner
  igtl-gateway simulate acquisition --side ros --listen :18944

scenarios:
{_SCENARIOS}"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("name", choices=tuple(SCENARIOS), metavar="SCENARIO", help="scenario to play, see below")
    parser.add_argument("--duration", type=float, metavar="SECONDS", help="duration of the session")
    add_overwrite(parser)
    add_json(parser)
    add_output(parser, "play offline and write this recording", metavar="FILE")
    live = parser.add_argument_group("live")
    live.add_argument("--record", type=Path, metavar="FILE", help="record to this MCAP file")
    live.add_argument("--view", action="store_true", help="show the session in rerun, like `bridge --view`")
    live.add_argument(
        "--timeout", type=float, metavar="SECONDS", help="longest time for the start, and for the scenario"
    )
    alone = parser.add_argument_group("live, one side only")
    alone.add_argument(
        "--side",
        choices=("ros", "igtl"),
        help="play only the actors of ROS 2 or of OpenIGTLink; you run the bridge and the other side",
    )
    where = alone.add_mutually_exclusive_group()
    where.add_argument(
        "--connect",
        type=address,
        metavar="HOST:PORT",
        help="connect the OpenIGTLink actors to a bridge at this address " + default(f"{DEFAULT_HOST}:{DEFAULT_PORT}"),
    )
    where.add_argument(
        "--listen",
        type=address,
        metavar="HOST:PORT",
        help="--side igtl: listen for the bridge on this address; --side ros: run a bridge that listens on this "
        "address for the program that replaces the OpenIGTLink actors",
    )
    alone.add_argument(
        "--print-config", action="store_true", help="print the configuration of the bridge (TOML), then exit"
    )
    load = parser.add_argument_group("load, for test-server")
    load.add_argument("--type", choices=tuple(SIZES), help="type of the messages " + default(Load().type))
    load.add_argument("--size", type=int, metavar="N", help=f"size of a message; {'; '.join(_size_help())}")
    load.add_argument("--rate", type=float, metavar="HZ", help="rate of the messages " + default(f"{Load().rate_hz:g}"))
    load.add_argument("--count", type=int, metavar="N", help="number of messages " + default(Load().count))
    load.add_argument("--sender", choices=SENDERS, help="side that sends " + default(Load().sender))
    # of the programs that a live scenario starts
    parser.add_argument("--actor", help=argparse.SUPPRESS)
    parser.add_argument("--peers", type=int, default=1, help=argparse.SUPPRESS)


def _size_help() -> list[str]:
    return [f"{name}: {unit} " + default(f"{usual:,}") for name, (unit, _, usual, _) in SIZES.items() if unit]


def runner() -> Callable[[argparse.Namespace], int]:
    from igtl_gateway_lab.cli.simulate_run import run  # here: the help does not wait for it

    return run
