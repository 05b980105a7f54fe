"""Streams that several peers send in turn: named with their links, their topics, and the way to select one of them."""

from __future__ import annotations

from igtl_gateway.addon.reading import Entry, Kind
from igtl_gateway.addons.exchange.senders import Senders

TOOL = "TRANSFORM/Tool"


def received(*links: int, channel: str = TOOL) -> Entry:
    return Entry(1, 5, Kind.IGTL_IN, channel, channel.partition("/")[0], (b"",), links)


def published(topic: str, kind: Kind = Kind.ROS_OUT) -> Entry:
    return Entry(2, 6, kind, topic, "t", (b"",))


def notes(*steps: tuple[Entry, bool]) -> list[str]:
    senders = Senders()
    for entry, selected in steps:
        senders.see(entry, selected=selected)
    return list(senders.notes())


def in_turn(selected: bool = True, channel: str = TOOL) -> list[tuple[Entry, bool]]:
    return [(received(link, channel=channel), selected) for link in (3, 2, 3)]


def test_a_stream_of_one_peer_or_of_one_after_the_other_is_one_movement() -> None:
    assert notes(*((received(1), True) for _ in range(5))) == []
    assert notes(*((received(link), True) for link in (1, 1, 2, 2, 3))) == [], "it connected again"
    assert notes() == []


def test_a_stream_of_several_in_turn_is_not() -> None:
    assert notes(*in_turn()) == [
        "TRANSFORM/Tool has the messages of links 2 and 3 in turn, which are not one movement; "
        "--streams 'in:TRANSFORM/Tool@2' selects one of them"
    ]


def test_what_is_not_exported_is_not_named() -> None:
    assert notes(*in_turn(selected=False)) == []
    assert notes(*in_turn(channel="STT_TDATA/Tool")) == [], "queries are no movement"


def test_topics_that_are_made_of_it_are_mixed_too() -> None:
    steps = [each for step in in_turn(selected=False) for each in (step, (published("/tool"), True))]
    (note,) = notes(*steps, (published("/igtl/in"), False))
    assert "which are not one movement; so do /tool; --streams" in note


def test_topics_of_another_cause_are_not() -> None:
    between = [(published("/input", Kind.ROS_IN), False), (published("/other"), True)]
    steps = [each for step in in_turn() for each in (step, *between)]
    (note,) = notes(*steps)
    assert "so do" not in note


def test_a_few_topics_are_named_and_the_others_counted() -> None:
    made = [(published(f"/t{number}"), True) for number in range(7)]
    (note,) = notes(*[each for step in in_turn() for each in (step, *made)])
    assert "so do /t0, /t1, /t2, /t3, /t4, and 2 more;" in note
    (note,) = notes(*[each for step in in_turn() for each in (step, *made[:5])])
    assert "so do /t0, /t1, /t2, /t3, /t4;" in note
