"""The add-on cohort: many sessions."""

from __future__ import annotations

from igtl_gateway.addon.terminal import MANY, Verb

VERBS = {
    "cohort": Verb(
        "info, lint, verify, review or sync over many sessions, as tables",
        f"{__package__}.verb",
        writes_files=True,
        group=MANY,
        place=1,
        lasts=True,  # each file has its bound
    ),
}
