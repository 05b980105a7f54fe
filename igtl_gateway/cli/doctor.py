"""``igtl-gateway doctor``: diagnose the connection to a peer, a recording, or the machine."""

from __future__ import annotations

import argparse
from pathlib import Path

from igtl_gateway.app import bridge_options
from igtl_gateway.app.examine import ExamineOptions, examine
from igtl_gateway.base.clock import SystemClock
from igtl_gateway.base.errors import ConfigError
from igtl_gateway.cli import admission, lint
from igtl_gateway.cli.common import load_config, stop_event
from igtl_gateway.cli.options import DEFAULT_HOST, DEFAULT_PORT, add_config, add_json, default, peer_address
from igtl_gateway.cli.settings import add_settings
from igtl_gateway.cli.terminal import print_json, print_line
from igtl_gateway.doctor.host_report import HostReport, examine_host
from igtl_gateway.doctor.report import DoctorReport

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
  # check a recording: stamps, names, units, CRCs, header versions, losses
  igtl-gateway doctor out.mcap
  # check this machine: scheduling, timers, limits, memory
  igtl-gateway doctor --host

exit code 0: no error found; 1: an error; 2: wrong usage"""

_SECONDS = 5.0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "peer",
        metavar="[tls://]HOST:PORT|FILE",
        type=_peer_or_file,
        nargs="?",
        help="address of the peer; or a recording, which exists or ends in .mcap, or directory of a split recording",
    )
    parser.add_argument(
        "--listen",
        type=peer_address,
        nargs="?",
        const=(DEFAULT_HOST, DEFAULT_PORT),
        metavar="[tls://]HOST:PORT",
        help="wait for the peer to connect to this address " + default(f"{DEFAULT_HOST}:{DEFAULT_PORT}"),
    )
    parser.add_argument(
        "--seconds", type=float, default=_SECONDS, metavar="SECONDS", help="observe for this time " + default(_SECONDS)
    )
    parser.add_argument("--messages", type=int, default=0, metavar="N", help="stop after this number of messages")
    parser.add_argument(
        "--speak",
        type=int,
        choices=(0, 1, 2),
        default=1,
        metavar="VERSION",
        help="send one STATUS with this header version to a peer that sends nothing; 0: send none " + default(1),
    )
    parser.add_argument(
        "--ros", action="store_true", help="also compare with the topics, types and QoS of the ROS graph"
    )
    parser.add_argument(
        "--host",
        action="store_true",
        help="check this machine for causes of jitter instead of a peer: kernel, CPUs, timers, limits, memory, clock",
    )
    add_config(parser, "configuration of the bridge (TOML)")
    add_json(parser)
    group = parser.add_argument_group("security")
    add_settings(group, "allow")
    admission.add_tls(group)


def _peer_or_file(text: str) -> tuple[str, int] | Path:
    return Path(text) if text.endswith(".mcap") or Path(text).exists() else peer_address(text)


def run(options: argparse.Namespace) -> int:
    if isinstance(options.peer, Path):
        if options.listen or options.ros or options.host or options.messages or options.allow:
            raise ConfigError(
                f"found the recording {options.peer} with an option of a connection or --host, "
                "expected --config or --json"
            )
        return lint.run(argparse.Namespace(file=options.peer, config=options.config, json=options.json))
    if options.host:
        return _run_host(options)
    if not options.peer and not options.listen:
        raise ConfigError("found no peer, expected its HOST:PORT, a recording, --listen or --host")
    if not 0 < options.seconds < float("inf"):
        raise ConfigError(f"--seconds: found {options.seconds:g}, expected a number above 0")
    if options.messages < 0:
        raise ConfigError(f"--messages: found {options.messages}, expected 0 or more")
    ours, servers = ([place] if place else [] for place in (options.listen, options.peer))
    tls_listen, tls_connect = bridge_options.secured(vars(options), ours, servers)
    how = ExamineOptions(
        options.peer,
        options.listen,
        options.seconds,
        options.messages,
        options.speak,
        tuple(options.allow),
        options.ros,
        bridge_options.tls(vars(options)),
        bool(tls_listen),
        bool(tls_connect),
    )
    with stop_event() as stop:
        report = DoctorReport.of(examine(load_config(options.config), how, SystemClock(), stop))
    return _printed(report, options.json)


def _run_host(options: argparse.Namespace) -> int:
    if options.peer or options.listen or options.ros:
        raise ConfigError("--host: found a peer, --listen or --ros, expected --host alone: it checks this machine only")
    return _printed(examine_host(SystemClock()), options.json)


def _printed(report: DoctorReport | HostReport, as_json: bool) -> int:
    """Print a report, and return the exit code."""
    if as_json:
        print_json(report.to_dict())
    else:
        for line in report.lines():
            print_line(line)
    return int(report.failed)
