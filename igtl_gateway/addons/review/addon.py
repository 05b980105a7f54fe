"""The add-on review: a suture plan against the measured tissue."""

from __future__ import annotations

from igtl_gateway.addon import Verb
from igtl_gateway.cli.verbs import INSPECT

VERBS = {
    "review": Verb(
        "check each stitch of a suture plan against the measured tissue", f"{__package__}.verb", group=INSPECT, place=5
    ),
}
