"""The add-on review: a suture plan against the measured tissue."""

from __future__ import annotations

from igtl_gateway.addon.terminal import INSPECT, Verb

#: Begins of the errors of a recording that has nothing to review, for programs that run the verb.
NOTHING = NO_CLOUD, NO_PLAN = "found no point cloud", "found no suture plan"

VERBS = {
    "review": Verb(
        "check each stitch of a suture plan against the measured tissue", f"{__package__}.verb", group=INSPECT, place=5
    ),
}
