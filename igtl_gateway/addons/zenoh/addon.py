"""The add-on zenoh: the ROS graph over Zenoh, without ROS."""

from __future__ import annotations

from igtl_gateway.addon.terminal import RARE, Verb

VERBS = {
    "zenoh-router": Verb(
        "run a router of Zenoh, which ROS nodes with rmw_zenoh need",
        f"{__package__}.verb",
        reads_files=False,
        group=RARE,
        place=2,
    ),
}
