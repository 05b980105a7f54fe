"""The add-on resim: run ROS 2 programs on a recording again, deterministically."""

from __future__ import annotations

from igtl_gateway.addon.terminal import INSPECT, Verb

VERBS = {
    "resim": Verb(
        "run ROS 2 programs on a recording again, and compare outputs",
        f"{__package__}.verb",
        writes_files=True,
        group=INSPECT,
        place=8,
        failure=2,
        lasts=True,
    ),
}
