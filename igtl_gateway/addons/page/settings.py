"""The settings that a bridge has with this add-on.  Loaded at each start of a bridge: nothing here serves a page."""

from __future__ import annotations

from igtl_gateway.addon.settings import HOST, Setting, address, grouped

SETTINGS = grouped(
    "diagnostics",
    Setting(
        "page",
        False,
        "serve a page for browsers: what arrives, the recording, closed recordings, replays; prints its link",
        HOST,
        common=True,
        keyword=False,
    ),
    Setting(
        "page_address",
        "",
        "address of the page",
        HOST,
        metavar="[HOST:]PORT",
        reads=address,
        shown="127.0.0.1, a free port",
        needs=("page",),
        keyword=False,
    ),
)
