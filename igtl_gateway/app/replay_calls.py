"""Services and actions in a replay to ROS: answered as recorded, or called with the recorded requests.

Their topics are messages as others: by default they are published, too, as ``ros2 bag play`` does.
"""

from __future__ import annotations

import heapq
import threading
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

from igtl_gateway.app.replay_account import CALLED
from igtl_gateway.base.clock import SystemClock
from igtl_gateway.base.errors import ConversionError, RosError, first_line
from igtl_gateway.base.qos import Qos
from igtl_gateway.base.quantities import count_text
from igtl_gateway.base.stamp import NS_PER_S
from igtl_gateway.convert.exchanges import (
    ACTION_SERVICES,
    ACTION_TOPICS,
    IN_ACTION,
    ServiceEvent,
    action_of,
    service_of,
)
from igtl_gateway.edges.ros.calls import Answer, Caller
from igtl_gateway.edges.ros.edge import RosEdge
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.replay.played_action import PlayedAction, Sent
from igtl_gateway.replay.recorded_calls import (
    NO_CONTENTS,
    NO_GOALS,
    RecordedCalls,
    RecordedService,
    recorded_calls,
    requesting_kinds,
)

#: Longest wait for what is under way at the end of a replay.
_LINGER_S = 5.0
_LOOK_S = 0.01
#: Interval of the checks whether the replay was stopped meanwhile.
_STOP_S = 0.1
_QOS = {"feedback": Qos(10), "status": Qos(1, latched=True)}
_STATUS_TYPE, _CANCEL_TYPE = "action_msgs/msg/GoalStatusArray", "action_msgs/srv/CancelGoal"
_UNRECORDED = "requests that the recording has no answer to"
_OPEN = "goals that did not end before the replay"
_NO_RESPONSE = "requests without a response"
_NO_GOAL = "requests about goals that were not sent"
#: In the request of a cancellation: all goals.
_ALL_GOALS = bytes(16)

OnLine = Callable[[str], None]


@dataclass(slots=True)
class CallCounts:
    """Of a service or an action.

    Attributes:
        done: requests or goals that were answered as recorded, or requests that got a response.
        what: of one of them, in words: ``goal answered``.
        left: what was not, in words → how often.
    """

    done: int
    what: str
    left: dict[str, int]

    @property
    def text(self) -> str:
        noun, _, rest = self.what.partition(" ")
        return f"{count_text(self.done, noun)} {rest}".rstrip()


class Calls(Protocol):
    """What a replay does with services and actions.

    Attributes:
        instead: topics whose messages are not published.
    """

    instead: frozenset[str]

    def start(self, rate: float | None, on_line: OnLine) -> None:
        """Begin, once the graph is known.

        Args:
            rate: recorded seconds per second; None: what lasted some time in the recording lasts none.
            on_line: takes lines of text.
        """

    def wait_for_servers(self, timeout_s: float) -> bool:
        """Wait until there is a server of all that is called; False if that took too long."""

    def select(self, entries: Iterable[Entry], passed_over: Counter[str]) -> Iterable[Entry]:
        """Return the entries that are sent, and count the others."""

    def send(self, entry: Entry) -> bool:
        """Send an entry of a topic of ``instead``."""

    def finish(self, stop: threading.Event) -> None:
        """Wait for what is under way, for some seconds."""

    def counts(self) -> Mapping[str, CallCounts]:
        """Return what was done, by service or action."""


def open_calls(mode: str, file: SessionFile, topics: Sequence[str], edge: RosEdge) -> Calls | None:
    """Return what answers or calls the services and actions of a recording.

    Args:
        mode: ``"answer"``, ``"call"`` or ``"topics"``.
        file: the recording.
        topics: those of the recording that are played.
        edge: where.

    Returns:
        None if it has none, or only their topics are wanted.

    Raises what ``recorded_calls`` raises.
    """
    own = [topic for topic in topics if is_of_calls(topic)]
    if mode == "topics" or not own:
        return None
    return AnsweredCalls(recorded_calls(file, own), edge) if mode == "answer" else SentCalls(file, own, edge)


def is_of_calls(topic: str) -> bool:
    """Return whether a topic is one of a service or of an action."""
    return bool(service_of(topic) or action_of(topic))


class AnsweredCalls:
    """Servers, whose answers and goals come again: the last one of a content for all that follow."""

    instead: frozenset[str] = frozenset()

    def __init__(self, calls: RecordedCalls, edge: RosEdge) -> None:
        self._calls, self._edge = calls, edge
        self._rate: float | None = None
        clock = SystemClock()
        offset_ns = clock.utc_ns() - clock.monotonic_ns()
        self._now_ns: Callable[[], int] = lambda: offset_ns + clock.monotonic_ns()
        self._changed = threading.Condition()  # guards the attributes below
        self._answered: Counter[str] = Counter()
        self._left: dict[str, Counter[str]] = {}
        self._actions: dict[str, PlayedAction] = {}
        self._responses: list[tuple[int, int, str, Answer, bytes]] = []  # heap of time, order, service, …
        self._order = 0
        self._is_closed = False
        for action in calls.actions.values():  # with the QoS that clients need, whatever the recorder asked for
            for part, of in zip(ACTION_TOPICS, (f"{action.type}_FeedbackMessage", _STATUS_TYPE), strict=True):
                edge.advertise(f"{action.name}{IN_ACTION}{part}", of, _QOS[part])

    def start(self, rate: float | None, on_line: OnLine) -> None:
        self._rate = rate
        refused = dict(self._calls.unknown)
        offered = []
        for service in self._calls.services.values():
            text = f"{service.name} ({count_text(service.count, 'answer')})"
            if why := self._edge.serve_later(service.name, service.type, self._answering(service)):
                refused[service.name] = why
            else:
                offered.append(text)
        for action in self._calls.actions.values():
            text = f"{action.name} ({count_text(action.count, 'goal')})"
            with self._changed:
                self._actions[action.name] = PlayedAction(action, again=True, lasts=self._lasts)
            if why := self._serve(action.name, action.type):
                with self._changed:
                    del self._actions[action.name]
                refused[action.name] = why
            else:
                offered.append(text)
        if offered:
            on_line(f"answers as recorded: {', '.join(offered)} (--services call sends them instead)")
        for name, why in sorted(refused.items()):
            on_line(f"! {name} is not answered: {why}")
        threading.Thread(target=self._run, name="igtl-replay-calls", daemon=True).start()

    def wait_for_servers(self, timeout_s: float) -> bool:
        return True

    def select(self, entries: Iterable[Entry], passed_over: Counter[str]) -> Iterable[Entry]:
        return entries

    def send(self, entry: Entry) -> bool:
        return False

    def finish(self, stop: threading.Event) -> None:
        """Send what is due within some seconds; then no more."""
        until_ns = self._now_ns() + round(_LINGER_S * NS_PER_S)
        with self._changed:
            while not stop.is_set() and (due_ns := self._due_ns()) is not None and due_ns <= until_ns:
                self._changed.wait(min(max(0, due_ns - self._now_ns()) / NS_PER_S + _LOOK_S, _STOP_S))
            self._is_closed = True
            self._changed.notify_all()

    def counts(self) -> Mapping[str, CallCounts]:
        found: dict[str, CallCounts] = {}
        with self._changed:
            for name in {*self._answered, *self._left}:
                found[name] = CallCounts(self._answered[name], "request answered", dict(self._left.get(name, {})))
            for name, action in self._actions.items():
                left = dict(action.refused) | ({_OPEN: action.open} if action.open else {}) | self._left.get(name, {})
                if action.ended or left:
                    found[name] = CallCounts(action.ended, "goal answered", left)
        return found

    def _leave(self, name: str, why: str) -> None:
        """Count what was not done; the caller has the lock."""
        self._left.setdefault(name, Counter())[why] += 1

    def _lasts(self, recorded_ns: int) -> int:
        return round(recorded_ns / self._rate) if self._rate else 0

    def _answering(self, service: RecordedService) -> Callable[[bytes, Answer], None]:
        def on_request(request: bytes, answer: Answer) -> None:
            with self._changed:
                recorded = service.take(request, again=True)
                if recorded is None:
                    self._leave(service.name, _UNRECORDED)
                    return
                self._answered[service.name] += 1
                self._order += 1
                due_ns = self._now_ns() + self._lasts(recorded.latency_ns)
                heapq.heappush(self._responses, (due_ns, self._order, service.name, answer, recorded.data))
                self._changed.notify_all()

        return on_request

    def _serve(self, action: str, type_: str) -> str:
        """Offer an action; return why it is not possible, or ``""``."""
        types = (f"{type_}_SendGoal", _CANCEL_TYPE, f"{type_}_GetResult")
        for part, of in zip(ACTION_SERVICES, types, strict=True):
            if why := self._edge.serve_later(f"{action}{IN_ACTION}{part}", of, self._asking(action, part)):
                return why
        return ""

    def _asking(self, action: str, part: str) -> Callable[[bytes, Answer], None]:
        def on_request(request: bytes, answer: Answer) -> None:
            with self._changed:
                if action in self._actions:
                    self._actions[action].ask(part, request, self._now_ns(), answer)
                    self._changed.notify_all()

        return on_request

    def _due_ns(self) -> int | None:
        """When the next message is due; the caller has the lock."""
        due = [each.next_ns for each in self._actions.values()] + [row[0] for row in self._responses[:1]]
        return min((each for each in due if each is not None), default=None)

    def _run(self) -> None:
        with self._changed:
            while not self._is_closed:
                now_ns, due_ns = self._now_ns(), self._due_ns()
                if due_ns is None or due_ns > now_ns:
                    self._changed.wait(None if due_ns is None else (due_ns - now_ns) / NS_PER_S)
                    continue
                for name, action in self._actions.items():
                    for each in action.take(now_ns):
                        self._send(name, each)
                while self._responses and self._responses[0][0] <= now_ns:
                    at_ns, _, name, answer, data = heapq.heappop(self._responses)
                    self._send(name, Sent(at_ns, "", data, answer))
                self._changed.notify_all()

    def _send(self, name: str, sent: Sent) -> None:
        try:
            if callable(sent.to):
                sent.to(sent.data)
            else:
                of = f"{self._actions[name].action.type}_FeedbackMessage" if sent.part == "feedback" else _STATUS_TYPE
                if why := self._edge.publish(f"{name}{IN_ACTION}{sent.part}", of, sent.data, _QOS[sent.part]):
                    raise RosError(why)
        except Exception as error:  # rclpy raises a dozen unrelated classes here
            self._answered[name] -= not sent.part
            self._leave(name, f"not sent: {first_line(error)}")


class SentCalls:
    """Clients, which send the recorded requests; those of one side, that of the client or of the server."""

    def __init__(self, file: SessionFile, topics: Sequence[str], edge: RosEdge) -> None:
        self._edge = edge
        types = {channel.topic: channel.type for channel in file.channels if channel.kind is Kind.ROS_IN}
        self._kinds = requesting_kinds(file, topics)
        self._callers: dict[str, Caller] = {}
        self._called: list[str] = []
        self._refused: dict[str, str] = {}
        self._begun = {_ALL_GOALS}
        self._without_goal: Counter[str] = Counter()
        goals: dict[str, dict[bytes, bytes]] = {}
        for topic in topics:
            action, part = action_of(topic) or ("", "")
            name = action or service_of(topic)
            caller: Caller | str = NO_CONTENTS
            if topic in self._kinds:
                caller = edge.caller(service_of(topic), types[topic], goals.setdefault(action, {}))
            if isinstance(caller, Caller):
                self._callers[topic] = caller
                what = {"": "request", "send_goal": "goal"}.get(part)
                self._called += [f"{name} ({count_text(self._kinds[topic][1], what)})"] if what else []
            elif part in ("", "send_goal"):
                self._refused[name] = caller
        missing = {action for topic in topics if (action := (action_of(topic) or ("",))[0])} - goals.keys()
        self._refused |= dict.fromkeys(missing, NO_GOALS)
        self.instead = frozenset(
            topic for topic in topics if (action_of(topic) or (service_of(topic),))[0] not in self._refused
        )

    def start(self, rate: float | None, on_line: OnLine) -> None:
        if self._called:
            on_line(f"calls as recorded: {', '.join(self._called)}")
        for name, why in sorted(self._refused.items()):
            on_line(f"! {name} is not called: {why}")

    def wait_for_servers(self, timeout_s: float) -> bool:
        return self._wait(lambda: all(each.is_ready for each in self._callers.values()), timeout_s)

    def _wait(self, condition: Callable[[], bool], timeout_s: float) -> bool:
        """Look at a condition again and again; False if it did not hold in time."""
        clock = SystemClock()
        until_ns = clock.monotonic_ns() + round(timeout_s * NS_PER_S)
        while not condition():
            if clock.monotonic_ns() >= until_ns:
                return False
            self._edge.wait(lambda: False, _LOOK_S)
        return True

    def select(self, entries: Iterable[Entry], passed_over: Counter[str]) -> Iterator[Entry]:
        for entry in entries:
            if entry.channel not in self.instead or self._asks(entry):
                yield entry
            else:
                passed_over[CALLED] += 1

    def _asks(self, entry: Entry) -> bool:
        if entry.channel not in self._callers:
            return False
        try:
            event = ServiceEvent.unpack(entry.data())
        except ConversionError:
            return False
        return event.kind == self._kinds[entry.channel][0] and event.has_request and self._has_goal(entry, event)

    def _has_goal(self, entry: Entry, event: ServiceEvent) -> bool:
        """Whether a request is about no goal, or about one of this replay: no server knows a recorded id."""
        part = (action_of(entry.channel) or ("", ""))[1]
        if part == "send_goal":
            self._begun.add(event.goal)
        if not part or event.goal in self._begun:
            return True
        self._without_goal[entry.channel] += 1
        return False

    def send(self, entry: Entry) -> bool:
        self._callers[entry.channel].call(entry.data())
        return True

    def finish(self, stop: threading.Event) -> None:
        """Wait some seconds for responses."""
        self._wait(
            lambda: stop.is_set() or all(each.sent == each.answered for each in self._callers.values()), _LINGER_S
        )

    def counts(self) -> Mapping[str, CallCounts]:
        found = {}
        for topic, each in self._callers.items():
            left = {_NO_RESPONSE: each.sent - each.answered, _NO_GOAL: self._without_goal[topic]}
            if each.sent or left[_NO_GOAL]:
                found[each.name] = CallCounts(each.answered, "response", {why: n for why, n in left.items() if n})
        return found
