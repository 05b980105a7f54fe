"""The add-on view: a session in rerun."""

from __future__ import annotations

from igtl_gateway.addon.terminal import INSPECT, Verb

VERBS = {
    "view": Verb(
        "show a session in rerun: in a window, as a file, page or image",
        f"{__package__}.verb",
        writes_files=True,
        group=INSPECT,
        place=2,
    ),
}
