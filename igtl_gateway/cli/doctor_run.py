"""``igtl-gateway doctor``: diagnose the connection to a peer, a recording, or the machine."""

from __future__ import annotations

import argparse
from pathlib import Path

from igtl_gateway.app import bridge_options, setting_values
from igtl_gateway.app.examine import ExamineOptions, examine
from igtl_gateway.base.clock import SystemClock
from igtl_gateway.base.errors import ConfigError
from igtl_gateway.base.untrusted import cpu_time
from igtl_gateway.cli import lint_run
from igtl_gateway.cli.common import load_config, stop_event
from igtl_gateway.cli.doctor_options import OPTIONS, PEER
from igtl_gateway.cli.doctor_output import print_doctor
from igtl_gateway.cli.settings import values_with_effect
from igtl_gateway.cli.terminal import print_json, print_line
from igtl_gateway.config import notations
from igtl_gateway.config.triggers import trigger
from igtl_gateway.doctor.host_report import HostReport, examine_host
from igtl_gateway.doctor.report import DoctorReport
from igtl_gateway.edges.tcp.sockets import address_text
from igtl_gateway.gateway.expected import expected_sources

_ABSENT = {PEER: "found a recording or --host, expected a peer"}


def run(options: argparse.Namespace) -> int:
    is_file = isinstance(options.peer, Path)
    if options.host and options.peer:
        raise ConfigError("--host: found a peer or a recording, expected --host alone: it checks this machine only")
    peer = not (is_file or options.host)
    values = values_with_effect(options, OPTIONS, {PEER: peer}, _ABSENT)
    config = Path(values["config"]) if values["config"] else None
    if is_file:
        return lint_run.run(argparse.Namespace(file=options.peer, config=config, json=values["json"]))
    if options.host:
        return _printed(examine_host(SystemClock()), values["json"])
    if values["allow"] and not values["listen"]:
        raise ConfigError("--allow: found no --listen, expected it: the option has no effect here")
    if not options.peer and not values["listen"] and not values["ros"]:
        raise ConfigError("found no peer, expected its HOST:PORT, a recording, --listen, --ros or --host")
    listen = notations.peer_address(values["listen"]) if values["listen"] else None
    ours, servers = ([place] if place else [] for place in (listen, options.peer))
    known = setting_values.of_file(config) if config else {}
    named = [notations.peer_address(text) for text in known.get("connect", ())]
    if not options.peer:
        servers = named
    tls_listen, tls_connect = bridge_options.secured(values, ours, servers)
    chosen = load_config(config)
    how = ExamineOptions(
        servers=() if options.peer else tuple(named),
        tls_servers=frozenset() if options.peer else tls_connect,
        expected=expected_sources(
            chosen,
            known.get("record_topics", ()),
            triggers=map(trigger, known.get("trigger", ())),
            connect=map(address_text, named),
        ),
        connect=options.peer,
        listen=listen,
        tls=bridge_options.tls(values),
        tls_listen=bool(tls_listen),
        tls_connect=bool(options.peer and tls_connect),
        **{name: values[name] for name in ("seconds", "messages", "speak", "allow", "ros")},
    )
    with stop_event() as stop, cpu_time.not_counted():
        report = DoctorReport.of(examine(chosen, how, SystemClock(), stop))
    return _printed(report, values["json"])


def _printed(report: DoctorReport | HostReport, as_json: bool) -> int:
    """Print a report, and return the exit code."""
    if as_json:
        print_json(report.to_dict())
    elif isinstance(report, HostReport):
        for line in report.lines():
            print_line(line)
    else:
        print_doctor(report)
    return int(report.failed)
