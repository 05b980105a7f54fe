"""``igtl-gateway zenoh-router``: a router of Zenoh, until Ctrl-C."""

from __future__ import annotations

import argparse
import threading

from igtl_gateway.addon.terminal import default, parser_of, print_line, stop_event
from igtl_gateway.addons.zenoh.notation import ZENOH_LISTEN, zenoh_endpoint
from igtl_gateway.addons.zenoh.router import Router

EXAMPLES = """\
  # for ROS nodes with rmw_zenoh and bridges on this machine
  igtl-gateway zenoh-router
  # for other machines, too: without TLS, everything passes in the clear
  igtl-gateway zenoh-router --listen tcp/0.0.0.0:7447
  # join the graph of another site
  igtl-gateway zenoh-router --connect tls/planning.example:7447
  # certificates and access control by a file of Zenoh (docs/how-to/zenoh.md)
  ZENOH_ROUTER_CONFIG_URI=router.json5 igtl-gateway zenoh-router

ROS nodes with rmw_zenoh find each other through a router on their machine.
Where ROS is installed, rmw_zenohd is one."""

_EVERY_S = 0.2


def add_arguments(parser: argparse.ArgumentParser) -> None:
    for flag, text, more in (
        ("--listen", "listen on this endpoint (repeatable)", f" {default(ZENOH_LISTEN)}"),
        ("--connect", "connect to the router at this endpoint, and again until stopped (repeatable)", ""),
    ):
        parser.add_argument(
            flag,
            action="append",
            default=[],
            type=parser_of(zenoh_endpoint),
            metavar="ENDPOINT",
            help=text + more,
        )


def run(options: argparse.Namespace) -> int:
    changed = threading.Event()
    with stop_event() as stop:
        router = Router(options.listen, options.connect, changed.set)
        try:
            print_line(f"Zenoh router {router.zid} on {', '.join(router.endpoints)}")
            print_line("Press Ctrl-C to stop.", flush=True)
            while not stop.wait(_EVERY_S):
                for line in router.changes():
                    print_line(line, flush=True)
        finally:
            router.close()
    return 0
