"""The add-on exchange: files of other programs."""

from __future__ import annotations

from igtl_gateway.addon.terminal import CONVERT, Verb

VERBS = {
    "import": Verb(
        "convert a recording of another program to a session",
        f"{__package__}.import_verb",
        writes_files=True,
        group=CONVERT,
        place=1,
    ),
    "export": Verb(
        "convert a session to formats of other programs",
        f"{__package__}.export_verb",
        writes_files=True,
        group=CONVERT,
        place=2,
    ),
}
