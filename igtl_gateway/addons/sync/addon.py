"""The add-on sync: lags between streams."""

from __future__ import annotations

from igtl_gateway.addon.terminal import INSPECT, Verb

VERBS = {
    "sync": Verb(
        "measure the lags between streams from what moves in them",
        f"{__package__}.verb",
        writes_files=True,
        group=INSPECT,
        place=6,
    ),
}
