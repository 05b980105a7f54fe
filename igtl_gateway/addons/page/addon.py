"""The add-on page: a running bridge and its recordings in a browser."""

from __future__ import annotations

from igtl_gateway.addon.terminal import INSPECT, Verb

VERBS = {
    "page": Verb(
        "show the recordings of a directory on a page for browsers",
        f"{__package__}.verb",
        writes_files=True,
        group=INSPECT,
        place=3,
        lasts=True,
    ),
}
