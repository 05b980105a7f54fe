"""The add-on upload: closed recordings to an object store."""

from __future__ import annotations

from igtl_gateway.addon.terminal import RARE, Verb

VERBS = {
    "upload": Verb(
        "copy the recordings of a directory to an object store",
        "igtl_gateway.cli.keep",
        group=RARE,
        place=6,
        now="keep",
        lasts=True,
    ),
}
