"""``igtl-gateway doctor``: diagnose the connection to a peer, a recording, or the machine."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

from igtl_gateway.cli.doctor_options import OPTIONS
from igtl_gateway.cli.options import peer_address
from igtl_gateway.cli.settings import add_settings

EXAMPLES = """\
  # connect to a server, observe it for 5 seconds, report problems
  igtl-gateway doctor 192.168.1.20:18944
  # wait for a client
  igtl-gateway doctor --listen :18944
  # wait for a client; without one, check whether 10.0.0.7 is a server
  igtl-gateway doctor --listen :18944 10.0.0.7
  # a server with TLS
  igtl-gateway doctor tls://or1.clinic --tls-cert me.pem --tls-ca clinic.pem
  # also compare with the ROS graph; for programs
  igtl-gateway doctor :18944 --ros --json
  # which topics, frames and servers of a configuration are not there
  igtl-gateway doctor --ros --config bridge.toml
  # check a recording: stamps, names, units, CRCs, header versions, losses
  igtl-gateway doctor out.mcap
  # check this machine: scheduling, timers, limits, memory
  igtl-gateway doctor --host

exit code 0: no error found; 1: an error; 2: wrong usage"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "peer",
        metavar="[tls://]HOST:PORT|FILE",
        type=_peer_or_file,
        nargs="?",
        help="address of the peer; or a recording, which exists or ends in .mcap, or directory of a split recording",
    )
    add_settings(parser, OPTIONS)


def _peer_or_file(text: str) -> tuple[str, int] | Path:
    return Path(text) if text.endswith(".mcap") or Path(text).exists() else peer_address(text)


def runner() -> Callable[[argparse.Namespace], int]:
    from igtl_gateway.cli.doctor_run import run  # here: the help does not wait for it

    return run
