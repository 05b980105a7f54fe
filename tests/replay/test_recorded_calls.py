"""What a recording has of services and actions, by name and by what was asked."""

from __future__ import annotations

import struct
from pathlib import Path
from random import Random

import pytest

from igtl_gateway.base.errors import UnsupportedRecording
from igtl_gateway.convert.exchanges import REQUEST_RECEIVED, REQUEST_SENT, RESPONSE_RECEIVED, RESPONSE_SENT
from igtl_gateway.record.sessionfile.definition import Definition
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.replay import recorded_calls as module
from igtl_gateway.replay.played_action import PlayedAction
from igtl_gateway.replay.recorded_calls import (
    NO_CONTENTS,
    NO_GOALS,
    Contents,
    Exchange,
    RecordedAnswer,
    RecordedCalls,
    RecordedService,
    recorded_calls,
    requesting_kinds,
)
from tests import exchanges
from tests.calls import Goal, rows_of
from tests.exchanges import ABORTED, ACTION_TYPE, HEAD, MS, SERVICE, SERVICE_TYPE, Row, event
from tests.tables import table

EVENTS = f"{SERVICE}/_service_event"
ON, OFF = struct.pack("<?", True), struct.pack("<?", False)  # requests of SetBool
YES = struct.pack("<?3xI3s", True, 3, b"on\0")


def calls_of(path: Path, rows: list[Row] | None = None) -> RecordedCalls:
    with SessionFile.open(exchanges.write(path, rows)) as file:
        return recorded_calls(file)


def of_service(*events: bytes) -> list[Row]:
    return [(number * MS, EVENTS, f"{SERVICE_TYPE}_Event", each) for number, each in enumerate(events)]


def asked(order: int, goal: bytes = bytes(16)) -> bytes:
    """A request of Fibonacci, as a client sends it."""
    return HEAD + goal + struct.pack("<i", order)


def test_a_request_is_known_by_its_values_wherever_it_is() -> None:
    """In an event there are other bytes between the values, and after them."""
    definition = Definition(b"int32 a\nfloat64 b\nstring c\n---\nbool done\n").text("robot/srv/Plan_Event")
    service = RecordedService("/plan", "robot/srv/Plan", Contents("robot/srv/Plan_Event", definition))
    alone = HEAD + struct.pack("<i4sdI3s", 5, b"\7\1\2\3", 0.5, 3, b"ab\0")
    answers = [RecordedAnswer(b"one", 1), RecordedAnswer(b"two", 2)]
    for answer in answers:
        service.add(Exchange(event(0, 0, 1, request=struct.pack("<idI3sx", 5, 0.5, 3, b"ab\0")), 0, answer))
    assert service.count == 2
    assert service.take(HEAD + struct.pack("<i4xdI3s", 0, 0.5, 3, b"ab\0")) is None
    assert [service.take(alone), service.take(alone), service.take(alone)] == [*answers, None]
    assert service.count == 0


def test_a_request_alone_has_its_values_where_they_belong() -> None:
    definition = Definition(b"int32 a\nfloat64 b\nstring c\n---\nbool done\n").text("robot/srv/Plan_Event")
    asked_for = event(0, 0, 1, request=struct.pack("<idI3sx", 5, 0.5, 3, b"ab\0"))
    contents = Contents("robot/srv/Plan_Event", definition)
    assert contents.alone(asked_for) == HEAD + struct.pack("<i4xdI3s", 5, 0.5, 3, b"ab\0")
    assert contents.alone(asked_for[:60]) is None
    assert Contents("robot/srv/Plan_Event", "").alone(asked_for) is None


def test_the_last_answer_may_come_again() -> None:
    service = RecordedService("/a", SERVICE_TYPE, Contents(f"{SERVICE_TYPE}_Event", ""))
    for text in (b"one", b"two"):
        service.add(Exchange(event(0, 0, 1, request=ON), 0, RecordedAnswer(text, 1)))
    found = [service.take(HEAD + ON, again=True) for _ in range(4)]
    assert [each and each.data for each in found] == [b"one", b"two", b"two", b"two"]


def test_a_request_without_fields_and_one_without_a_definition() -> None:
    empty = Definition(b"---\nbool success\n").text("std_srvs/srv/Trigger_Event")
    for definition in (empty, ""):
        contents = Contents("std_srvs/srv/Trigger_Event", definition)
        assert contents.of_event(event(0, 0, 1, request=b"\0")) == contents.of_request(HEAD + b"\0")
    contents = Contents(f"{SERVICE_TYPE}_Event", "")
    assert contents.of_event(event(0, 0, 1, request=ON)) == contents.of_request(HEAD + ON + b"\0\0\0")
    assert contents.of_event(event(0, 0, 1, request=ON)) != contents.of_request(HEAD + OFF)


def test_all_that_a_recording_has(tmp_path: Path) -> None:
    found = calls_of(tmp_path / "a.mcap")
    assert (found.unknown, list(found.services), list(found.actions)) == ({}, [SERVICE], [exchanges.ACTION])
    service = found.services[SERVICE]
    assert (service.type, service.count) == (SERVICE_TYPE, 3)
    answer = service.take(HEAD + ON)
    assert answer == RecordedAnswer(HEAD + YES, 2 * MS + 1)  # the client's side, which includes the way
    action = found.actions[exchanges.ACTION]
    assert (action.type, action.count) == (ACTION_TYPE, 4)
    ends = {}
    for order in exchanges.GOALS:
        goal = action.take(asked(order))
        assert goal and goal.is_accepted and [step.after_ns for step in goal.steps[:3]] == [5 * MS, 13 * MS, 14 * MS]
        ends[order] = (
            [step.status for step in goal.steps if step.status][-1],
            goal.result is not None,
            bool(goal.cancel),
        )
    assert ends == {3: (4, True, False), 9: (ABORTED, True, False), 5: (5, True, True), 7: (2, False, False)}
    assert action.take(asked(3)) is None
    requests = {name: (each.type, len(each.exchanges)) for name, each in found.requests.items()}
    assert requests == {
        SERVICE: (SERVICE_TYPE, 4),
        "/fib/_action/send_goal": (f"{ACTION_TYPE}_SendGoal", 4),
        "/fib/_action/get_result": (f"{ACTION_TYPE}_GetResult", 4),
        "/fib/_action/cancel_goal": ("action_msgs/srv/CancelGoal", 1),
    }


@table(
    ("events", "count"),
    [
        ([event(REQUEST_RECEIVED, 0, 1, ON), event(RESPONSE_SENT, MS, 1, response=YES)], 1),
        ([event(REQUEST_SENT, 0, 1, ON), event(RESPONSE_SENT, MS, 1, response=YES)], 0),  # of two sides
        ([event(REQUEST_SENT, 0, 1, ON), event(RESPONSE_RECEIVED, MS, 2, response=YES)], 0),
        ([event(REQUEST_SENT, 0, 1, ON), event(RESPONSE_RECEIVED, MS, 1, response=YES, client=b"you")], 0),
        ([event(RESPONSE_RECEIVED, 0, 1, response=YES), event(REQUEST_SENT, MS, 1, ON)], 0),
        ([event(REQUEST_SENT, 0, 1, ON), b"\0\1\0\0", event(RESPONSE_RECEIVED, MS, 1, response=YES)], 1),
        # one client has introspection, the server of two as well
        (
            [
                event(REQUEST_SENT, 0, 1, ON), event(REQUEST_RECEIVED, 0, 1, ON),
                event(RESPONSE_SENT, MS, 1, response=YES), event(RESPONSE_RECEIVED, MS, 1, response=YES),
                event(REQUEST_RECEIVED, 0, 1, ON, client=b"you"), event(RESPONSE_SENT, MS, 1, b"", YES, b"you"),
            ],
            2,
        ),
    ],
)  # fmt: skip
def test_requests_and_responses_that_belong_together(events: list[bytes], count: int, tmp_path: Path) -> None:
    assert calls_of(tmp_path / "a.mcap", of_service(*events)).services[SERVICE].count == count


def test_events_without_contents_are_no_answers(tmp_path: Path) -> None:
    found = calls_of(tmp_path / "a.mcap", of_service(event(REQUEST_SENT, 0, 1), event(RESPONSE_RECEIVED, MS, 1)))
    assert (found.services, found.unknown) == ({}, {SERVICE: NO_CONTENTS})


def test_an_action_without_introspection_is_not_known(tmp_path: Path) -> None:
    rows = list(rows_of("/drive", [Goal(bytes(16), 3, MS, 9 * MS)], events=False))
    found = calls_of(tmp_path / "a.mcap", rows)
    assert (found.actions, found.unknown) == ({}, {"/drive": NO_GOALS})


def test_an_end_that_only_the_result_shows(tmp_path: Path) -> None:
    rows = rows_of("/drive", [Goal(bytes(16), 3, MS, 9 * MS, ABORTED)])
    found = calls_of(tmp_path / "a.mcap", [row for row in rows if not row[1].endswith("/status")])
    goal = found.actions["/drive"].take(asked(3))
    assert goal and [(step.after_ns, step.status) for step in goal.steps] == [(9 * MS, ABORTED)]


def test_a_cancellation_that_only_the_states_show(tmp_path: Path) -> None:
    rows = rows_of("/drive", [Goal(bytes(16), 3, MS, 9 * MS, 5, cancel_ns=6 * MS)])
    found = calls_of(tmp_path / "a.mcap", [row for row in rows if "cancel_goal" not in row[1]])
    goal = found.actions["/drive"].take(asked(3))
    assert goal and goal.cancel == (5 * MS + 0, RecordedAnswer(b"", 0))


def test_which_side_has_more_requests(tmp_path: Path) -> None:
    events = [event(REQUEST_SENT, 0, 1, ON), event(REQUEST_RECEIVED, 0, 1, ON)]
    for more, expected in (
        ([], (REQUEST_SENT, 1)),
        ([event(REQUEST_RECEIVED, 0, 2, ON)], (REQUEST_RECEIVED, 2)),
        ([event(REQUEST_RECEIVED, 0, 2), event(RESPONSE_SENT, 0, 2, response=YES)], (REQUEST_SENT, 1)),
    ):
        with SessionFile.open(exchanges.write(tmp_path / "a.mcap", of_service(*events, *more))) as file:
            assert requesting_kinds(file) == {EVENTS: expected}


def test_only_topics_that_are_wanted(tmp_path: Path) -> None:
    with SessionFile.open(exchanges.write(tmp_path / "a.mcap")) as file:
        assert list(recorded_calls(file, [EVENTS]).services) == [SERVICE]
        assert recorded_calls(file, [EVENTS]).actions == {}
        assert recorded_calls(file, ["/other"]) == RecordedCalls()


def test_more_bytes_than_the_bound_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "_MOST_BYTES", 1 << 10)
    with pytest.raises(UnsupportedRecording, match="found more than 0 MiB of services and actions"):
        calls_of(tmp_path / "a.mcap")


def test_bytes_of_any_kind_are_no_calls_or_are_played(tmp_path: Path) -> None:
    """Messages that are cut off and overwritten anywhere: what is left is a server that answers without an error."""
    chosen = Random(7)
    rows = sorted([*exchanges.calls(), *exchanges.goals()], key=lambda row: row[0])
    for _ in range(20):
        changed = []
        for at_ns, topic, type_, data in rows:
            new = bytearray(data)
            for _ in range(chosen.choice((0, 0, 1, 3))):
                new[chosen.randrange(4, len(new))] = chosen.choice((0, 1, 2, 255, chosen.randrange(256)))
            size = chosen.randrange(len(new)) if chosen.random() < 0.1 else len(new)
            changed.append((at_ns, topic, type_, bytes(new[:size])))
        found = calls_of(tmp_path / "a.mcap", changed)
        for service in found.services.values():
            service.take(HEAD + ON, again=True)
        for action in found.actions.values():
            server = PlayedAction(action, again=True)
            for order in exchanges.GOALS:
                goal = bytes([order] * 16)
                server.ask("send_goal", asked(order, goal), 0, 1)
                server.ask("cancel_goal", HEAD + goal + bytes(8), 0, 2)
                server.ask("get_result", HEAD + goal, 0, 3)
            server.take(1 << 62)


def test_types_of_any_name(tmp_path: Path) -> None:
    events = [event(REQUEST_SENT, 0, 1, ON), event(RESPONSE_RECEIVED, MS, 1, response=YES)]
    for type_ in ("std_msgs/msg/String", "std_msgs/String", "a/b/c/D_Event", "Event", "_Event"):
        contents = Contents(type_, "")
        assert contents.of_event(events[0]) == contents.of_request(HEAD + ON)
    rows = [(0, EVENTS, "std_msgs/msg/String", each) for each in events]
    assert calls_of(tmp_path / "a.mcap", rows).services[SERVICE].count == 1
