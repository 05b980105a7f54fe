"""A recorded action as a server: what clients get, and when."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path

import pytest

from igtl_gateway.convert.exchanges import goal_states
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.replay.played_action import PlayedAction, Sent
from igtl_gateway.replay.recorded_calls import RecordedAction, recorded_calls
from tests import exchanges
from tests.calls import Goal, fibonacci, rows_of
from tests.exchanges import ABORTED, CANCELED, HEAD, MS, START_NS, SUCCEEDED

ID, OTHER = b"a" * 16, b"b" * 16
#: By order: succeeds, aborts, rejected, never ends, canceled, its result was not asked for.
GOALS = [
    Goal(bytes([1] * 16), 1, 10 * MS, 40 * MS, SUCCEEDED, feedback_ns=(20 * MS, 30 * MS)),
    Goal(bytes([2] * 16), 2, 10 * MS, 40 * MS, ABORTED),
    Goal(bytes([3] * 16), 3, 10 * MS, accepted=False),
    Goal(bytes([4] * 16), 4, 10 * MS),
    Goal(bytes([5] * 16), 5, 10 * MS, 60 * MS, CANCELED, cancel_ns=40 * MS, feedback_ns=(20 * MS, 50 * MS)),
    Goal(bytes([6] * 16), 6, 10 * MS, 40 * MS, SUCCEEDED, asked=False),
]


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return exchanges.write(tmp_path_factory.mktemp("action") / "a.mcap", list(rows_of("/drive", GOALS)))


@pytest.fixture
def action(recording: Path) -> Iterator[RecordedAction]:
    with SessionFile.open(recording) as file:
        yield recorded_calls(file).actions["/drive"]


def asked(order: int, id_: bytes = ID) -> bytes:
    return HEAD + id_ + struct.pack("<i", order)


def about(id_: bytes) -> bytes:
    return HEAD + id_ + bytes(8)


def told(sent: list[Sent]) -> list[tuple[int, str, object]]:
    """Milliseconds, part, and what it states: states, length of feedback, acceptance, return code, or status."""
    found: list[tuple[int, str, object]] = []
    for each in sent:
        first = each.data[4]
        what: object = first
        if each.part == "status":
            what = [state for _, state in goal_states(each.data)]
        elif each.part == "feedback":
            what = each.data[4:20][:1], struct.unpack_from("<I", each.data, 20)[0]
        found.append(((each.at_ns - START_NS) // MS, each.part, what))
    return found


def play(
    action: RecordedAction, *requests: tuple[int, str, bytes], again: bool = False
) -> tuple[PlayedAction, list[Sent]]:
    """What a server sends for requests at some milliseconds, each with its number."""
    server = PlayedAction(action, again=again)
    found: list[Sent] = []
    for number, (at_ms, part, request) in enumerate(requests):
        now_ns = START_NS + at_ms * MS
        while server.next_ns is not None and server.next_ns < now_ns:
            found += server.take(server.next_ns)
        server.ask(part, request, now_ns, number)
    while server.next_ns is not None:
        found += server.take(server.next_ns)
    return server, found


def test_a_goal_goes_as_the_recorded_one(action: RecordedAction) -> None:
    server, sent = play(action, (100, "send_goal", asked(1)), (105, "get_result", about(ID)))
    assert told(sent) == [
        (101, "send_goal", 1),
        (101, "status", [1]),
        (102, "status", [2]),
        (110, "feedback", (b"a", 1)),
        (120, "feedback", (b"a", 2)),
        (130, "status", [SUCCEEDED]),
        (130, "get_result", SUCCEEDED),
    ]
    assert [each.to for each in sent if each.to is not None] == [0, 1]
    assert sent[-1].data == HEAD + struct.pack("<b3s", SUCCEEDED, b"\x55\1\2") + fibonacci(1, 8)
    assert struct.unpack_from("<iI", sent[0].data, 8) == (START_NS // 10**9, 101 * MS)  # accepted now
    assert goal_states(sent[1].data)[0][0] == ID
    assert (server.ended, server.open, server.refused) == (1, 0, {})


def test_a_result_that_is_asked_for_later_comes_at_once(action: RecordedAction) -> None:
    _, sent = play(action, (0, "send_goal", asked(2)), (500, "get_result", about(ID)))
    assert told(sent)[-2:] == [(30, "status", [ABORTED]), (500, "get_result", ABORTED)]


def test_a_goal_is_rejected_as_recorded(action: RecordedAction) -> None:
    server, sent = play(action, (0, "send_goal", asked(3)))
    assert told(sent) == [(1, "send_goal", 0)]
    assert (server.ended, server.refused) == (1, {})


def test_what_is_not_recorded_is_refused_and_counted(action: RecordedAction) -> None:
    server, sent = play(
        action, (0, "send_goal", asked(99)), (1, "get_result", about(ID)), (2, "cancel_goal", about(OTHER)),
        (3, "send_goal", asked(4)), (8, "cancel_goal", about(ID)), (9, "send_goal", asked(6, OTHER)),
        (80, "get_result", about(OTHER)), (81, "cancel_goal", about(OTHER)), (82, "send_goal", asked(1, OTHER)),
        (83, "get_result", HEAD),
    )  # fmt: skip
    answers = [each for each in told(sent) if each[1] not in ("status", "feedback")]
    assert answers == [
        (0, "send_goal", 0),
        (2, "cancel_goal", 2),  # an unknown goal
        (4, "send_goal", 1),
        (8, "cancel_goal", 1),  # rejected
        (10, "send_goal", 1),
        (81, "cancel_goal", 3),  # it has ended
        (82, "send_goal", 0),
    ]
    assert server.refused == {
        "goals that are not in the recording": 1,
        "results of goals that it does not have": 1,
        "cancellations that are not in the recording": 1,
        "results that are not in the recording": 1,
        "goals whose ids are taken": 1,
    }
    assert server.open == 1  # the fourth, which has no end


def test_a_canceled_goal_waits_for_its_client(action: RecordedAction) -> None:
    server, sent = play(action, (0, "send_goal", asked(5)), again=True)
    assert [each for each in told(sent) if each[1] != "status"] == [(1, "send_goal", 1), (10, "feedback", (b"a", 1))]
    assert server.open == 1
    # what the recording has behind the cancellation follows behind that of the client
    for number, again_ms in enumerate((3, 200)):
        id_ = bytes([65 + number] * 16)
        requests = (0, "send_goal", asked(5, id_)), (2, "get_result", about(id_)), (again_ms, "cancel_goal", about(id_))
        _, sent = play(action, *requests, again=True)
        assert told(sent)[-5:] == [
            (again_ms, "status", [3]),
            (again_ms + 1, "cancel_goal", 0),
            (again_ms + 10, "feedback", (id_[:1], 2)),
            (again_ms + 20, "status", [CANCELED]),
            (again_ms + 20, "get_result", CANCELED),
        ]
        assert sum(part == "feedback" for _, part, _ in told(sent)) == 1 + number


def test_all_goals_are_canceled_by_one_request(action: RecordedAction) -> None:
    server, sent = play(
        action, (0, "send_goal", asked(5)), (0, "send_goal", asked(5, OTHER)), (0, "send_goal", asked(4, b"c" * 16)),
        (50, "cancel_goal", about(bytes(16))), again=True,
    )  # fmt: skip
    (answer,) = (each.data for each in sent if each.part == "cancel_goal")
    assert struct.unpack_from("<b3xI", answer, 4) == (0, 2)
    assert (answer[12:28], answer[36:52], len(answer)) == (ID, OTHER, 60)
    assert (server.ended, server.open) == (2, 1)


def test_several_goals_share_the_states(action: RecordedAction) -> None:
    _, sent = play(action, (0, "send_goal", asked(1)), (10, "send_goal", asked(2, OTHER)))
    assert [what for _, part, what in told(sent) if part == "status"] == [[1], [2], [2, 1], [2, 2], [4, 2], [4, 6]]


def test_a_goal_comes_again_only_if_it_may(recording: Path) -> None:
    for again, accepted in ((False, [1, 0]), (True, [1, 1])):
        with SessionFile.open(recording) as file:
            action = recorded_calls(file).actions["/drive"]
        _, sent = play(action, (0, "send_goal", asked(1)), (100, "send_goal", asked(1, OTHER)), again=again)
        assert [each.data[4] for each in sent if each.part == "send_goal"] == accepted


def test_goals_that_have_ended_are_forgotten_at_a_bound(action: RecordedAction) -> None:
    requests = [(number * 100, "send_goal", asked(1, bytes([number] * 16))) for number in range(103)]
    first, last = (number for number in (1, 102))
    server, sent = play(
        action, *requests, (20_000, "get_result", about(bytes([first] * 16))),
        (20_000, "get_result", about(bytes([last] * 16))), again=True,
    )  # fmt: skip
    assert server.refused == {"results of goals that it does not have": 1}
    assert [each.to for each in sent if each.part == "get_result"] == [104]
    assert max(len(what) for _, part, what in told(sent) if isinstance(what, list)) <= 101


def test_delays_are_as_long_as_they_last_now(action: RecordedAction) -> None:
    server = PlayedAction(action, lasts=lambda ns: ns // 10)
    server.ask("send_goal", asked(1), START_NS, "me")
    assert [each.at_ns - START_NS for each in server.take(START_NS + 3 * MS)] == [
        MS // 10, MS // 10, 2 * MS // 10, MS, 2 * MS, 3 * MS,
    ]  # fmt: skip
