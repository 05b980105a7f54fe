"""A gateway that is not active: what it refuses is counted, and reported once for each stream and each time."""

from __future__ import annotations

from igtl_gateway.gateway.activity import INACTIVE, Activity
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.note import Level


def entry(channel: str = "TRANSFORM/Tool", *links: int) -> Entry:
    return Entry(1, 5, Kind.IGTL_IN, channel, "TRANSFORM", (), links)


def test_it_begins_active_and_a_change_to_the_same_is_none() -> None:
    activity = Activity()
    states = [(activity.change(wanted), activity.active) for wanted in (True, True, False)]
    assert states == [([], True), ([], True), ([], False)]
    activity.refuse(entry())
    assert activity.change(False) == [], "what was refused stays counted"
    (found,) = activity.change(True)
    assert "1 message was refused" in found.text


def test_what_was_refused_is_reported_when_it_is_active_again() -> None:
    activity = Activity()
    activity.change(False)
    for _ in range(1234):
        activity.refuse(entry())
    (found,) = activity.change(True)
    assert (found.level, found.code) == (Level.INFO, "active")
    assert found.text == "1,234 messages were refused while the gateway was not active"
    assert activity.change(False) == [] == activity.change(True), "nothing was refused since"


def test_a_refusal_is_about_the_stream_of_its_link() -> None:
    activity = Activity()
    activity.change(False)
    found = activity.refuse(entry("TRANSFORM/Tool", 3, 4))
    assert (found.level, found.code, found.stream, found.links) == (Level.WARN, INACTIVE, "TRANSFORM/Tool", (3, 4))
    assert found.text == "TRANSFORM/Tool is refused: the gateway is not active"
    assert found.by == 3 and activity.refuse(entry("/topic")).by == 0


def test_each_time_the_first_refusal_of_a_stream_is_another_subject() -> None:
    activity = Activity()
    subjects = []
    for _ in range(2):
        activity.change(False)
        subjects += [activity.refuse(entry()).subject, activity.refuse(entry()).subject]
        subjects.append(activity.refuse(entry("STRING/A")).subject)
        activity.change(True)
    first, again, other, second, *_ = subjects
    assert first == again and len({first, other, second}) == 3 and None not in subjects
