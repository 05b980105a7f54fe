"""``igtl-gateway page``: the recordings of a folder on a page for browsers, without a bridge."""

from __future__ import annotations

import argparse
from pathlib import Path

from igtl_gateway.addon import ConfigError
from igtl_gateway.addon.settings import address, values_with_effect
from igtl_gateway.addon.terminal import print_line, stop_event
from igtl_gateway.addon.untrusted import near_file
from igtl_gateway.addons.page.process import Page, serve
from igtl_gateway.addons.page.starting import Starters
from igtl_gateway.addons.page.verb_options import OPTIONS


def run(options: argparse.Namespace) -> int:
    values = values_with_effect(options, OPTIONS)
    folder: Path = options.folder
    if not folder.is_dir():
        raise ConfigError(f"{folder}: found no directory, expected one with recordings{near_file(folder)}")
    host, port = address(values["address"]) if values["address"] else ("127.0.0.1", 0)
    tls = (values["tls_cert"], values["tls_key"]) if values["tls_cert"] else None
    page = Page(folder.absolute(), None, Starters())
    with stop_event() as stop:
        server = serve(page, {"host": host, "port": port, "allow": list(values["allow"]), "tls": tls})
        print_line(
            f"page         {server.link}", f"  read-only  {server.spectators}", "Press Ctrl-C to stop.", flush=True
        )
        stop.wait()
    server.close()
    page.close()
    return 0
