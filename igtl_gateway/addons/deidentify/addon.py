"""The add-on deidentify: sessions without identity."""

from __future__ import annotations

from igtl_gateway.addon.terminal import CONVERT, Verb

VERBS = {
    "deidentify": Verb(
        "write a session without names, text and dates of persons",
        f"{__package__}.verb",
        writes_files=True,
        group=CONVERT,
        place=6,
    ),
}
