"""The settings that a bridge has with this add-on.  Loaded at each start of a bridge: nothing here imports rerun."""

from __future__ import annotations

from igtl_gateway.addon.settings import Setting, grouped

SETTINGS = grouped(
    "diagnostics",
    Setting(
        "view",
        False,
        "show all messages live in the window of rerun",
        parameter=False,
        keyword=False,
        common=True,
    ),
)
