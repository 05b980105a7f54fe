"""The add-on deidentify: sessions without identity."""

from __future__ import annotations

from igtl_gateway.cli.verbs import Verb

VERBS = {
    "deidentify": Verb(
        "write a session without names, text and dates of persons; it verifies",
        f"{__package__}.verb",
        writes_files=True,
    ),
}
