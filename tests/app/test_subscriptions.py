"""Which topics are recorded: hidden ones, and those of ROS itself, if a glob names them."""

from __future__ import annotations

from igtl_gateway.app.subscriptions import EVERYTHING, names
from tests.tables import table

CASES = {
    "/tree/snapshots": ("/tree/snapshots", "/tree/*", "**", "/**"),
    "/tree/_snapshots_0": ("/tree/_snapshots_0", "/tree/_*", "**/_*"),
    "/switch/_service_event": ("/switch/_service_event", "**/_service_event"),
    "/fib/_action/status": ("/fib/_action/status", "/fib/_action/*", "**/_action/**"),
    "/fib/_action/send_goal/_service_event": ("/fib/_action/**", "**/_action/**", "**/_service_event"),
    "/_a/_b": ("/_a/_b", "/_a/_*", "/_a/*"),
    "/_a/b/c": ("/_a/b/c", "/_a/**"),
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


def test_everything_is_all_but_what_is_hidden_and_what_ros_has_itself() -> None:
    topics = ["/a", "/s/_service_event", "/f/_action/status", "/f/_action/get_result/_service_event"]
    others = ["/_a", "/a/_b/c", "/rosout"]
    assert [each for each in (*topics, *others) if any(names(glob, each) for glob in EVERYTHING)] == topics
