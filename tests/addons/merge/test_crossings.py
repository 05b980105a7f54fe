"""Messages that two recordings hold, by tables: which of equal messages count, and which streams are left out."""

from __future__ import annotations

from typing import Any

import numpy as np

from igtl_gateway.addons.merge.crossings import Crossing, Passed, find_crossings, pooled, without_coincidences
from tests.tables import table

START_NS, MS = 1_700_000_000_000_000_000, 1_000_000

#: A message: key, time in ms, stream.
Messages = list[tuple[int, int, str]]


def passed(messages: Messages) -> Passed:
    names = list(dict.fromkeys(stream for *_, stream in messages))
    keys, times = [key for key, _, _ in messages], [START_NS + at * MS for _, at, _ in messages]
    return Passed.of(keys, times, [names.index(stream) for *_, stream in messages], names)


def rows(found: list[Crossing]) -> list[tuple[str, str, list[tuple[int, int, bool]]]]:
    return [
        (
            each.sent_as,
            each.received_as,
            [
                (int(one - START_NS) // MS, int(two - START_NS) // MS, bool(once))
                for one, two, once in zip(each.sent, each.received, each.once, strict=True)
            ],
        )
        for each in found
    ]


THREE: Messages = [(1, 10, "a"), (2, 20, "a"), (3, 30, "a")]
LATER: Messages = [(1, 11, "a"), (2, 22, "a"), (3, 33, "a")]
ALL = [(10, 11, True), (20, 22, True), (30, 33, True)]

#: Sent, received by the other, received by the sender itself; the streams that cross.
CASES: dict[str, tuple[Messages, Messages, Messages, Any]] = {
    "each once": (THREE, LATER, [], [("a", "a", ALL)]),
    "another order": (THREE[::-1], LATER, [], [("a", "a", ALL)]),
    "nothing equal": (THREE, [(7, 11, "a")], [], []),
    "nothing at all": ([], [], [], []),
    "another stream": (THREE, [(key, at, "b") for key, at, _ in LATER], [], []),
    "sent twice: a bound and no latency": (
        [*THREE, (1, 40, "a")], LATER, [], [("a", "a", [(10, 11, False), *ALL[1:]])]
    ),
    "received twice: the first": ([*THREE], [*LATER, (1, 44, "a")], [], [("a", "a", ALL)]),
    "received twice, and by the sender": ([*THREE], [*LATER, (1, 44, "a")], [(1, 5, "a")], [("a", "a", ALL[1:])]),
    "received once, and by the sender": ([*THREE], LATER, [(1, 5, "a")], [("a", "a", ALL)]),
    "two streams, the larger first": (
        [(9, 1, "b"), (8, 2, "b"), (7, 3, "b"), *THREE, (4, 40, "a")],
        [*LATER, (4, 44, "a"), (9, 5, "b"), (8, 6, "b"), (7, 7, "b")], [],
        [("a", "a", [*ALL, (40, 44, True)]), ("b", "b", [(1, 5, True), (2, 6, True), (3, 7, True)])],
    ),
    "two of a stream are a coincidence beside three": (
        [(9, 1, "b"), (8, 2, "b"), *THREE], [*LATER, (9, 5, "b"), (8, 6, "b")], [], [("a", "a", ALL)]
    ),
    "two alone are not": (THREE[:2], LATER[:2], [], [("a", "a", ALL[:2])]),
}  # fmt: skip


@table("name", CASES)
def test_what_crosses(name: str) -> None:
    sent, received, own, expected = CASES[name]
    found = find_crossings(passed(sent), passed(received), passed(own), lambda one, two: one == two)
    assert rows(found) == expected


def test_times_of_several_streams_are_pooled() -> None:
    found = find_crossings(passed(THREE), passed(LATER), passed([]), str.__eq__)
    sent, received = pooled([*found, *found])
    assert (len(sent), int(received[0] - sent[0])) == (6, MS) and sent.dtype == np.int64
    assert [len(each) for each in pooled([])] == [0, 0]


def stream(name: str, count: int, delay_ms: float, *, since: int = 0) -> Crossing:
    sent = START_NS + since * MS + np.arange(count, dtype=np.int64) * 10 * MS
    return Crossing(name, name, sent, sent + round(delay_ms * MS), np.ones(count, np.bool_))


#: There, back, and what is left out.  The clocks are equal, so a message that arrives before it was sent contradicts.
COINCIDENCES: dict[str, tuple[list[Crossing], list[Crossing], list[str]]] = {
    "nothing": ([], [], []),
    "one line": ([stream("a", 100, 1)], [stream("b", 100, 1)], []),
    "a few that contradict": ([stream("a", 100, 1), stream("x", 4, -50)], [stream("b", 100, 1)], ["x"]),
    "a few that contradict, back": ([stream("a", 100, 1)], [stream("b", 100, 1), stream("x", 4, -50)], ["x"]),
    "a few that fit": ([stream("a", 100, 1), stream("x", 4, 2)], [stream("b", 100, 1)], []),
    "many that contradict": ([stream("a", 100, 1), stream("x", 20, -50)], [stream("b", 100, 1)], []),
}


@table("name", COINCIDENCES)
def test_streams_that_contradict_the_others_are_left_out_if_they_are_few(name: str) -> None:
    there, back, expected = COINCIDENCES[name]
    kept_there, kept_back, left_out = without_coincidences(there, back)
    assert [each.sent_as for each in left_out] == expected
    assert [each.sent_as for each in kept_there] == [each.sent_as for each in there if each.sent_as not in expected]
    assert [each.sent_as for each in kept_back] == [each.sent_as for each in back if each.sent_as not in expected]
