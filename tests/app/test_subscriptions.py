"""Which topics are recorded: hidden ones, and those of ROS itself, if a glob names them."""

from __future__ import annotations

from igtl_gateway.app.subscriptions import names
from tests.tables import table

CASES = {
    "/tree/snapshots": ("/tree/snapshots", "/tree/*", "**", "/**"),
    "/tree/_snapshots_0": ("/tree/_snapshots_0", "/tree/_*", "**/_*"),
    "/switch/_service_event": ("/switch/_service_event", "**/_service_event"),
    "/fib/_action/status": ("/fib/_action/status", "/fib/_action/*", "**/_action/**"),
    "/_a/_b": ("/_a/_b", "/_a/_*"),
    "/rosout": ("/rosout",),
    "/parameter_events": ("/parameter_events",),
}
#: What names none of those above but the first.
WIDE = ("**", "/**", "/*", "/tree/*", "/fib/**", "/fib/*/*", "/_a/*", "/ros*", "/parameter_event?", "**/rosout")


@table(("topic", "globs"), CASES.items(), ids=CASES)
def test_hidden_topics_are_recorded_if_they_are_named(topic: str, globs: tuple[str, ...]) -> None:
    assert all(names(glob, topic) for glob in globs)
    others = {glob for glob in WIDE if names(glob, topic)} - {*globs}
    assert others == set()
    assert not names("/other", topic)
