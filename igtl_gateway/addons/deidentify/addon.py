"""The add-on deidentify: sessions without identity."""

from __future__ import annotations

from igtl_gateway.addon import Verb
from igtl_gateway.cli.verbs import CONVERT

VERBS = {
    "deidentify": Verb(
        "write a session without names, text and dates of persons",
        f"{__package__}.verb",
        writes_files=True,
        group=CONVERT,
        place=6,
    ),
}
