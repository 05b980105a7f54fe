"""The add-on merge: one session of several recorders."""

from __future__ import annotations

from igtl_gateway.addon.terminal import CONVERT, Verb

VERBS = {
    "merge": Verb(
        "make one session of several recorders; each part verifies",
        f"{__package__}.verb",
        writes_files=True,
        group=CONVERT,
        place=4,
    ),
}
