"""``igtl-gateway doctor``: what is wrong between us and a peer."""

from __future__ import annotations

import argparse
from pathlib import Path

from igtl_gateway.app.examine import ExamineOptions, examine
from igtl_gateway.cli import admission
from igtl_gateway.cli.common import DEFAULT_HOST, DEFAULT_PORT, load_config, stop_event
from igtl_gateway.cli.terminal import print_json, print_line
from igtl_gateway.clock import SystemClock
from igtl_gateway.doctor.report import DoctorReport
from igtl_gateway.errors import ConfigError

EXAMPLES = """\
  igtl-gateway doctor 192.168.1.20:18944          connect to a server, look for 5 seconds, say what is wrong
  igtl-gateway doctor --listen :18944             wait for a client
  igtl-gateway doctor --listen :18944 10.0.0.7    ... and, if none comes, see whether that one is a server itself
  igtl-gateway doctor tls://or1.clinic --tls-cert me.pem --tls-ca clinic.pem    a server with TLS
  igtl-gateway doctor :18944 --ros --json         compare with the ROS graph, too; for programs
exit code: 0 no error found, 1 an error, 2 usage"""

_SECONDS = 5.0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "peer", metavar="[tls://]HOST:PORT", type=admission.peer_address, nargs="?", help="the peer's address"
    )
    parser.add_argument(
        "--listen",
        type=admission.peer_address,
        nargs="?",
        const=(DEFAULT_HOST, DEFAULT_PORT),
        metavar="[tls://]HOST:PORT",
        help=f"wait for the peer to connect here ({DEFAULT_HOST}:{DEFAULT_PORT})",
    )
    parser.add_argument("--seconds", type=float, default=_SECONDS, metavar="S", help="how long to look (%(default)s)")
    parser.add_argument("--messages", type=int, default=0, metavar="N", help="look no longer once so many have come")
    parser.add_argument(
        "--speak",
        type=int,
        choices=(0, 1, 2),
        default=1,
        metavar="VERSION",
        help="header version of the STATUS that a silent peer is told once, 0 for none (%(default)s)",
    )
    parser.add_argument(
        "--allow",
        action="append",
        default=[],
        metavar="CIDR",
        help="networks whose peers may connect (needed for --listen on other than loopback); 'any' for all",
    )
    admission.add_tls(parser)
    parser.add_argument("--ros", action="store_true", help="compare with the topics, types and QoS of the ROS graph")
    parser.add_argument("--config", type=Path, metavar="FILE", help="the configuration of the bridge, where it has one")
    parser.add_argument("--json", action="store_true", help="print everything as one JSON object")


def run(options: argparse.Namespace) -> int:
    if not options.peer and not options.listen:
        raise ConfigError("nobody to look at: give the peer's HOST:PORT, or --listen")
    if not 0 < options.seconds < float("inf"):
        raise ConfigError(f"--seconds: found {options.seconds:g}, expected a number above 0")
    if options.messages < 0:
        raise ConfigError(f"--messages: found {options.messages}, expected 0 or more")
    ours, servers = ([place] if place else [] for place in (options.listen, options.peer))
    tls_listen, tls_connect = admission.secured(options, ours, servers)
    how = ExamineOptions(
        options.peer,
        options.listen,
        options.seconds,
        options.messages,
        options.speak,
        tuple(options.allow),
        options.ros,
        admission.tls(options),
        bool(tls_listen),
        bool(tls_connect),
    )
    with stop_event() as stop:
        report = DoctorReport.of(examine(load_config(options.config), how, SystemClock(), stop))
    if options.json:
        print_json(report.to_dict())
    else:
        for line in report.lines():
            print_line(line)
    return int(report.failed)
