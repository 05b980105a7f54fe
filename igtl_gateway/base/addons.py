"""The add-ons: folders below ``igtl_gateway/addons`` that stand on the core, each of which may be deleted.

The core imports none of them.  It asks this table for a verb, and for the few parts that it can do without: a live
window, a graph over Zenoh, an upload beside the bridge, files of other programs.  Each is loaded when it is needed.
"""

from __future__ import annotations

from importlib import import_module
from importlib.util import find_spec
from typing import Any

from igtl_gateway.base.errors import MissingAddon

#: Where they are.
FOLDER = "igtl_gateway.addons"
#: Add-on → its verbs, so that a verb of an absent one is known.  ``addon.py`` of its folder has ``VERBS``.
ADDONS: dict[str, tuple[str, ...]] = {
    "sync": ("sync",),
    "merge": ("merge",),
    "deidentify": ("deidentify",),
    "exchange": ("import", "export"),
    "upload": ("upload",),
    "view": ("view",),
    "page": ("page",),
    "review": ("review",),
    "resim": ("resim",),
    "cohort": ("cohort",),
    "lerobot": (),
    "zenoh": ("zenoh-router",),
}

#: Add-on → its settings of `bridge`, so that one of an absent add-on is known: name → option.  ``settings.py`` of its
#: folder has the rows.
ADDON_SETTINGS: dict[str, dict[str, str]] = {
    "zenoh": {"ros": "--ros", "site": "--site", "site_budget": "--site-budget", "site_classes": "--site-class"},
    "upload": {"upload": "--upload", "upload_rate": "--upload-rate"},
    "view": {"view": "--view"},
    "page": {"page": "--page", "page_address": "--page-address"},
}


def is_present(addon: str) -> bool:
    """Return whether this installation has an add-on."""
    return find_spec(FOLDER) is not None and find_spec(f"{FOLDER}.{addon}") is not None


def check_present(addon: str) -> None:
    """Raise MissingAddon if this installation lacks an add-on."""
    if not addon or not is_present(addon):
        raise MissingAddon(f"found no add-on {addon!r}, which this needs: the folder {FOLDER}.{addon} is not installed")


def check_setting(name: str) -> None:
    """Raise MissingAddon if a setting is one of an add-on that this installation lacks."""
    for addon, settings in ADDON_SETTINGS.items():
        if name in settings:
            check_present(addon)


def part_of(addon: str, place: str) -> Any:
    """Return a name of a module of an add-on: ``part_of("view", "live:LiveWindow")``.

    Raises:
        MissingAddon: this installation lacks the add-on.
        Unavailable: a library that the module needs is not installed.
    """
    check_present(addon)
    module, _, name = place.partition(":")
    return getattr(import_module(f"{FOLDER}.{addon}.{module}"), name)
