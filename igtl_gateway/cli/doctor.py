"""``igtl-gateway doctor``: diagnose the connection to a peer, a recording, or the machine."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

from igtl_gateway.app import bridge_options
from igtl_gateway.app.examine import ExamineOptions, examine
from igtl_gateway.base.clock import SystemClock
from igtl_gateway.base.errors import ConfigError
from igtl_gateway.base.untrusted import cpu_time
from igtl_gateway.cli import lint
from igtl_gateway.cli.common import load_config, stop_event
from igtl_gateway.cli.options import DEFAULT_HOST, DEFAULT_PORT, peer_address
from igtl_gateway.cli.settings import add_settings, values_with_effect
from igtl_gateway.cli.terminal import print_json, print_line
from igtl_gateway.config import notations
from igtl_gateway.config.setting import Setting, grouped
from igtl_gateway.config.settings import BY_SETTING, TLS
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

_YEAR_S = 365 * 86_400.0

#: What an option needs: a peer, or an address for it; a recording and this machine have neither.
_PEER = "a peer"
_ABSENT = {_PEER: "found a recording or --host, expected a peer"}

OPTIONS = (
    Setting(
        "listen",
        None,
        "wait for the peer to connect to this address",
        kind=str,
        metavar="[tls://]HOST:PORT",
        reads=notations.peer_address,
        bare=f"{DEFAULT_HOST}:{DEFAULT_PORT}",
        shown=f"{DEFAULT_HOST}:{DEFAULT_PORT}",
        needs=(_PEER,),
    ),
    Setting(
        "seconds",
        5.0,
        "observe for this time",
        metavar="SECONDS",
        unit="s",
        least=0,
        most=_YEAR_S,
        open_ends=True,
        needs=(_PEER,),
    ),
    Setting("messages", 0, "stop after this number of messages", metavar="N", least=0, needs=(_PEER,)),
    Setting(
        "speak",
        1,
        "send one STATUS with this header version to a peer that sends nothing; 0: send none",
        metavar="VERSION",
        choices=(0, 1, 2),
        needs=(_PEER,),
    ),
    Setting("ros", False, "also compare with the topics, types and QoS of the ROS graph", needs=(_PEER,)),
    Setting(
        "host",
        False,
        "check this machine for causes of jitter instead of a peer: kernel, CPUs, timers, limits, memory, clock",
    ),
    Setting("config", "", "configuration of the bridge (TOML)", metavar="FILE"),
    Setting("json", False, "print the result as one JSON object"),
    *grouped("security", *(replace(BY_SETTING[name], needs=(_PEER,)) for name in ("allow", *TLS))),
)


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


def run(options: argparse.Namespace) -> int:
    is_file = isinstance(options.peer, Path)
    if options.host and options.peer:
        raise ConfigError("--host: found a peer or a recording, expected --host alone: it checks this machine only")
    peer = not (is_file or options.host)
    values = values_with_effect(options, OPTIONS, {_PEER: peer}, _ABSENT)
    config = Path(values["config"]) if values["config"] else None
    if is_file:
        return lint.run(argparse.Namespace(file=options.peer, config=config, json=values["json"]))
    if options.host:
        return _printed(examine_host(SystemClock()), values["json"])
    if values["allow"] and not values["listen"]:
        raise ConfigError("--allow: found no --listen, expected it: the option has no effect here")
    if not options.peer and not values["listen"]:
        raise ConfigError("found no peer, expected its HOST:PORT, a recording, --listen or --host")
    listen = notations.peer_address(values["listen"]) if values["listen"] else None
    ours, servers = ([place] if place else [] for place in (listen, options.peer))
    tls_listen, tls_connect = bridge_options.secured(values, ours, servers)
    how = ExamineOptions(
        connect=options.peer,
        listen=listen,
        tls=bridge_options.tls(values),
        tls_listen=bool(tls_listen),
        tls_connect=bool(tls_connect),
        **{name: values[name] for name in ("seconds", "messages", "speak", "allow", "ros")},
    )
    with stop_event() as stop, cpu_time.not_counted():
        report = DoctorReport.of(examine(load_config(config), how, SystemClock(), stop))
    return _printed(report, values["json"])


def _printed(report: DoctorReport | HostReport, as_json: bool) -> int:
    """Print a report, and return the exit code."""
    if as_json:
        print_json(report.to_dict())
    else:
        for line in report.lines():
            print_line(line)
    return int(report.failed)
