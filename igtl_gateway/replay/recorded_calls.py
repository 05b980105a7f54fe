"""Services and actions of a recording: what was asked, and what came of it, from the events of service introspection.

A request is known by its values: the bytes between them are those of the memory of its sender.
"""

from __future__ import annotations

import struct
from collections import Counter, deque
from collections.abc import Hashable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property
from operator import itemgetter
from typing import TYPE_CHECKING

from igtl_gateway.base.errors import ConversionError, UnsupportedRecording
from igtl_gateway.base.untrusted.dialects import RULE
from igtl_gateway.convert.exchanges import (
    HEAD,
    ID,
    OUTCOMES,
    REQUEST_RECEIVED,
    REQUEST_SENT,
    RESPONSE_RECEIVED,
    RESPONSE_SENT,
    ServiceEvent,
    action_of,
    goal_states,
    service_of,
)
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.replay.compare import ElementArray, LeafDecoder, Undecodable

if TYPE_CHECKING:
    from igtl_gateway.base.untrusted.decoding import MessageDecoder

#: Of an event: where the content of its request begins, and the number of responses behind that.
_REQUEST, _COUNT = 48, 4
#: Kinds of events that belong together: as the client has them, which includes the way, or else as the server has them.
_SIDES = ((REQUEST_SENT, RESPONSE_RECEIVED), (REQUEST_RECEIVED, RESPONSE_SENT))
#: Bytes of all that is kept of services and actions.
_MOST_BYTES = 256 << 20
_CANCELING = 3
#: Why a service or an action is not known.
NO_CONTENTS = "its events have no contents (introspection of CONTENTS has them)"
NO_GOALS = "its goals were not recorded (introspection has them)"


@dataclass(frozen=True, slots=True)
class RecordedAnswer:
    """A response as CDR, and how long after its request it came."""

    data: bytes
    latency_ns: int


@dataclass(frozen=True, slots=True)
class Exchange:
    """A request and what came of it.

    Attributes:
        request: its event, CDR.
        asked_ns: when it was recorded, UTC ns.
        answer: None: there is none, or none with content.
    """

    request: bytes
    asked_ns: int
    answer: RecordedAnswer | None

    @property
    def goal(self) -> bytes:
        """Of an action: the id of the goal that it is about."""
        return self.request[_REQUEST : _REQUEST + ID]


class Contents:
    """The contents of the requests of one type, as values that can be compared.

    Args:
        event_type: type of their events: ``package/srv/Name_Event``.
        definition: of the event with all that it needs; ``""``: there is none, and bytes are compared.
        is_goal: whether they begin with the id of a goal, which does not count.
    """

    def __init__(self, event_type: str, definition: str, *, is_goal: bool = False) -> None:
        package, _, name = event_type.removesuffix("_Event").partition("/")
        request = f"{package}/{name.rpartition('/')[2]}_Request content"
        needed = "".join(definition.partition(RULE)[1:])
        texts = {
            "request/msg/Alone": f"{request}\n{needed}",
            "request/msg/InEvent": f"uint8[{_REQUEST - HEAD}] head_\n{request}\nuint32 tail_\n{needed}",
        }
        self._texts = texts if needed else {}
        self._decoder = LeafDecoder(self._texts)
        self._is_goal = is_goal

    def of_event(self, event: bytes) -> Hashable:
        """The values of the request of an event, CDR."""
        return self._values("request/msg/InEvent", event, event[_REQUEST:-_COUNT])

    def of_request(self, request: bytes) -> Hashable:
        """The values of a request, CDR."""
        return self._values("request/msg/Alone", request, request[HEAD:])

    def alone(self, event: bytes) -> bytes | None:
        """The request of an event as a message of its own, CDR; None where no definition states where values begin."""
        name = "request/msg/Alone"
        try:
            content = self._messages.decode("request/msg/InEvent", event).content
            store = self._messages.store(name)
            return bytes(store.serialize_cdr(store.types[name](content), name))
        except Exception:  # rosbags raises many types of errors for invalid bytes
            return None

    @cached_property
    def _messages(self) -> MessageDecoder:
        # imported only if requests are sent
        from igtl_gateway.base.untrusted.decoding import MessageDecoder

        return MessageDecoder(lambda name: self._texts.get(name, ""))

    def _values(self, type_: str, data: bytes, content: bytes) -> Hashable:
        try:
            return tuple(
                (path, value.values.tobytes() if isinstance(value, ElementArray) else repr(value))
                for path, value in self._decoder.leaves(Entry(1, 0, Kind.ROS_IN, "", type_, (data,)))
                if path.startswith("content.") and not (self._is_goal and path.startswith("content.goal_id"))
            )
        except Undecodable:  # values of up to 4 bytes have the same bytes at both places
            return content[ID if self._is_goal else 0 :].rstrip(b"\0")


@dataclass(slots=True)
class RecordedService:
    """The answers of one service.

    Attributes:
        name: of the service.
        type: ``package/srv/Name``.
        contents: of its requests.
        count: requests with answers that were not taken.
    """

    name: str
    type: str
    contents: Contents
    count: int = 0
    _answers: dict[Hashable, deque[RecordedAnswer | None]] = field(default_factory=dict)

    def add(self, exchange: Exchange) -> None:
        """Add a request, and its answer if it has one."""
        self._answers.setdefault(self.contents.of_event(exchange.request), deque()).append(exchange.answer)
        self.count += exchange.answer is not None

    def take(self, request: bytes, *, again: bool = False) -> RecordedAnswer | None:
        """The next answer to a request with this content; None if the recording has no more, or had none.

        ``again``: the last answer is not used up.
        """
        answers = self._answers.get(self.contents.of_request(request))
        if not answers:
            return None
        if again and len(answers) == 1:
            return answers[0]
        self.count -= answers[0] is not None
        return answers.popleft()


@dataclass(frozen=True, slots=True)
class RecordedRequests:
    """The requests of one service, also of one of an action, in their order.

    Attributes:
        name: of the service.
        type: ``package/srv/Name``, ``package/action/Name_SendGoal``.
        contents: of its requests.
        exchanges: the requests.
    """

    name: str
    type: str
    contents: Contents
    exchanges: Sequence[Exchange]


@dataclass(frozen=True, slots=True)
class GoalStep:
    """What a server published about a goal.

    Attributes:
        after_ns: time since the request of the goal.
        status: of action_msgs/GoalStatus; 0: it is feedback.
        feedback: the message behind the id of the goal.
    """

    after_ns: int
    status: int
    feedback: bytes = b""


@dataclass(frozen=True, slots=True)
class RecordedGoal:
    """A goal, from its request on.

    Attributes:
        answer: whether it was accepted; its first byte is 1 then.
        steps: states and feedback, in their order.
        result: the response with the result; None: it was not asked for, or did not come.
        cancel: the response to the request that canceled it, and how long after the request of the goal that was asked
            for; None: it was not canceled.
    """

    answer: RecordedAnswer | None
    steps: tuple[GoalStep, ...] = ()
    result: bytes | None = None
    cancel: tuple[int, RecordedAnswer] | None = None

    @property
    def is_accepted(self) -> bool:
        return self.answer is not None and self.answer.data[HEAD : HEAD + 1] == b"\1"


@dataclass(slots=True)
class RecordedAction:
    """The goals of an action.

    Attributes:
        name: of the action.
        type: ``package/action/Name``.
        contents: of the requests of its goals.
        count: goals that were not taken.
    """

    name: str
    type: str
    contents: Contents
    count: int = 0
    _goals: dict[Hashable, deque[RecordedGoal]] = field(default_factory=dict)

    def add(self, exchange: Exchange, goal: RecordedGoal) -> None:
        self._goals.setdefault(self.contents.of_event(exchange.request), deque()).append(goal)
        self.count += 1

    def take(self, request: bytes, *, again: bool = False) -> RecordedGoal | None:
        """The next goal with this content; None if the recording has no more.  ``again``: the last one is kept."""
        goals = self._goals.get(self.contents.of_request(request))
        if not goals:
            return None
        if again and len(goals) == 1:
            return goals[0]
        self.count -= 1
        return goals.popleft()


@dataclass(slots=True)
class RecordedCalls:
    """What a recording has of services and actions, by name.

    Attributes:
        services: with the requests that have contents.
        actions: with the goals that have contents.
        requests: those of both, by service.
        unknown: services and actions without any → why.
    """

    services: dict[str, RecordedService] = field(default_factory=dict)
    actions: dict[str, RecordedAction] = field(default_factory=dict)
    requests: dict[str, RecordedRequests] = field(default_factory=dict)
    unknown: dict[str, str] = field(default_factory=dict)


@dataclass(slots=True)
class _Parts:
    """Of an action: its goals, cancellations and results; feedback and states with their times, by goal."""

    exchanges: dict[str, list[Exchange]] = field(default_factory=dict)
    event_type: str = ""
    steps: dict[bytes, list[tuple[int, tuple[int, bytes]]]] = field(default_factory=dict)


def recorded_calls(file: SessionFile, wanted: Sequence[str] = ()) -> RecordedCalls:
    """Return the services and actions of a recording.

    Args:
        file: the recording.
        wanted: topics that are read; (): all.

    Raises:
        UnsupportedRecording: they have more than 256 MiB.
        DamagedRecording: as of ``SessionFile.entries``.
    """
    events: dict[tuple[str, str], list[tuple[int, bytes]]] = {}
    actions: dict[str, _Parts] = {}
    for topic, type_, at_ns, data in _messages(file, wanted):
        if service_of(topic):
            events.setdefault((topic, type_), []).append((at_ns, data))
        elif named := action_of(topic):
            _add_steps(actions.setdefault(named[0], _Parts()), named[1], at_ns, data)
    found = RecordedCalls()
    for (topic, type_), rows in events.items():
        exchanges = list(_exchanges(rows))
        name, service_type = service_of(topic), type_.removesuffix("_Event")
        contents = Contents(type_, file.definitions.get(type_, ""))
        if exchanges:
            found.requests[name] = RecordedRequests(name, service_type, contents, exchanges)
        if named := action_of(topic):
            parts = actions.setdefault(named[0], _Parts())
            parts.exchanges[named[1]] = exchanges
            if named[1] == "send_goal":
                parts.event_type = type_
        elif exchanges:
            service = RecordedService(name, service_type, contents)
            for each in exchanges:
                service.add(each)
            found.services[name] = service
        else:
            found.unknown[name] = NO_CONTENTS
    for name, parts in actions.items():
        if parts.exchanges.get("send_goal"):
            found.actions[name] = _action_of(name, parts, file.definitions.get(parts.event_type, ""))
        else:
            found.unknown[name] = NO_GOALS
    return found


def requesting_kinds(file: SessionFile, wanted: Sequence[str] = ()) -> dict[str, tuple[int, int]]:
    """Return the kind of events that has most requests with contents, and how many, by topic.

    Raises as `recorded_calls`.
    """
    found: dict[str, Counter[int]] = {}
    for topic, _, _, data in _messages(file, wanted):
        if service_of(topic):
            with suppress(ConversionError):
                event = ServiceEvent.unpack(data)
                if event.has_request and event.kind in (REQUEST_SENT, REQUEST_RECEIVED):
                    found.setdefault(topic, Counter())[event.kind] += 1
    return {topic: max(kinds.items(), key=lambda row: (row[1], -row[0])) for topic, kinds in found.items()}


def _messages(file: SessionFile, wanted: Sequence[str]) -> Iterator[tuple[str, str, int, bytes]]:
    """Topic, type, gateway time and CDR, one topic after the other; of the rest of the file, little is read."""
    left = _MOST_BYTES
    for channel in file.channels:
        topic = channel.topic
        is_of_calls = channel.kind is Kind.ROS_IN and (service_of(topic) or action_of(topic))
        for block in file.blocks(channel) if is_of_calls and (not wanted or topic in wanted) else ():
            left -= int((block.ends - block.begins).sum())
            if left < 0:
                raise UnsupportedRecording(
                    f"{file.path}: found more than {_MOST_BYTES >> 20} MiB of services and actions, expected less"
                )
            for index in range(len(block)):
                yield topic, channel.type, int(block.times[index]), bytes(block.payload(index))


def _exchanges(rows: Sequence[tuple[int, bytes]]) -> Iterable[Exchange]:
    """Requests that have contents, of the side that has most of them, in their order."""
    sides = [_of_side(rows, *kinds) for kinds in _SIDES]
    return max(sides, key=lambda side: (len(side), sum(each.answer is not None for each in side)))


def _of_side(rows: Sequence[tuple[int, bytes]], asks: int, answers: int) -> list[Exchange]:
    found: dict[tuple[bytes, int], Exchange] = {}
    sent_ns: dict[tuple[bytes, int], int] = {}
    for at_ns, data in rows:
        try:
            event = ServiceEvent.unpack(data)
        except ConversionError:
            continue  # other messages of the topic have contents
        key = event.client, event.number
        if event.kind == asks and event.has_request and key not in found:
            found[key], sent_ns[key] = Exchange(data, at_ns, None), event.stamp_ns
        elif event.kind == answers and event.response and key in found and not found[key].answer:
            answer = RecordedAnswer(event.response, max(0, event.stamp_ns - sent_ns[key]))
            found[key] = Exchange(found[key].request, found[key].asked_ns, answer)
    return list(found.values())


def _add_steps(parts: _Parts, part: str, at_ns: int, data: bytes) -> None:
    if part == "feedback" and len(data) >= HEAD + ID:
        parts.steps.setdefault(data[HEAD : HEAD + ID], []).append((at_ns, (0, data[HEAD + ID :])))
    elif part == "status":
        try:
            states = goal_states(data)
        except ConversionError:
            return
        for goal, status in states:
            steps = parts.steps.setdefault(goal, [])
            if status != next((said[0] for _, said in reversed(steps) if said[0]), 0):
                steps.append((at_ns, (status, b"")))


def _action_of(name: str, parts: _Parts, definition: str) -> RecordedAction:
    type_ = parts.event_type.removesuffix("_SendGoal_Event")
    action = RecordedAction(name, type_, Contents(parts.event_type, definition, is_goal=True))
    results = {each.goal: each for each in parts.exchanges.get("get_result", ()) if each.answer}
    cancels = _canceled(parts.exchanges.get("cancel_goal", ()))
    for each in parts.exchanges["send_goal"]:
        asked_ns, goal = each.asked_ns, each.goal
        steps = [
            GoalStep(max(0, at_ns - asked_ns), *said)
            for at_ns, said in sorted(parts.steps.get(goal, ()), key=itemgetter(0))
        ]
        result = results.get(goal)
        ended = next(iter(result.answer.data[HEAD:]), 0) if result and result.answer else 0
        if result and result.answer and ended in OUTCOMES and not any(step.status in OUTCOMES for step in steps):
            # its states were not recorded
            after_ns = max(result.asked_ns - asked_ns + result.answer.latency_ns, steps[-1].after_ns if steps else 0)
            steps.append(GoalStep(after_ns, ended))
        cancel = cancels.get(goal)
        canceling = next((step.after_ns for step in steps if step.status == _CANCELING), None)
        action.add(
            each,
            RecordedGoal(
                each.answer,
                tuple(steps),
                result.answer.data if result and result.answer else None,
                (cancel.asked_ns - asked_ns, cancel.answer) if cancel and cancel.answer
                else None if canceling is None else (canceling, RecordedAnswer(b"", 0)),
            ),
        )  # fmt: skip
    return action


def _canceled(exchanges: Iterable[Exchange]) -> dict[bytes, Exchange]:
    """The requests that canceled goals, by goal: the response has their ids, as one request may cancel several."""
    found: dict[bytes, Exchange] = {}
    for each in exchanges:
        if each.answer and each.answer.data[HEAD : HEAD + 1] == b"\0" and len(each.answer.data) >= HEAD + 8:
            (count,) = struct.unpack_from("<I", each.answer.data, HEAD + 4)
            places = range(HEAD + 8, min(HEAD + 8 + 24 * count, len(each.answer.data) - ID + 1), 24)
            for at in places:
                found.setdefault(each.answer.data[at : at + ID], each)
    return found
