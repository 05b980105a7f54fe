"""The server of a recorded action, without sockets and clocks: it answers as the recorded one did.

A goal with a recorded content is accepted or rejected as that was; its states and feedback follow with their recorded
times, counted from its request, those behind a cancellation from that.  A goal that was recorded as canceled waits for
its client to cancel it.  What is not recorded is refused: a goal is rejected, a goal is not canceled; and a result that
the recorded client did not ask for is not known.
"""

from __future__ import annotations

import heapq
import struct
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field

from igtl_gateway.base.stamp import ns_to_ros
from igtl_gateway.convert.exchanges import HEAD, ID, OUTCOMES
from igtl_gateway.replay.recorded_calls import GoalStep, RecordedAction, RecordedGoal

#: Goals that have ended whose results are kept; goals at a time.
_KEPT, _MOST_GOALS = 100, 10_000
_CDR = b"\0\1\0\0"
_UNKNOWN, _REJECTED, _TERMINATED = 2, 1, 3  # return codes of action_msgs/srv/CancelGoal
_COUNT, _TIME, _GOALS = struct.Struct("<I"), struct.Struct("<iI"), struct.Struct("<bxxxI")
_ANY = bytes(ID)


@dataclass(frozen=True, slots=True)
class Sent:
    """What the server sends.

    Attributes:
        at_ns: when.
        part: ``"feedback"`` or ``"status"``; of a response its service: ``"send_goal"``, ``"cancel_goal"`` or
            ``"get_result"``.
        data: the message, CDR.
        to: of a response: what its request came with.
    """

    at_ns: int
    part: str
    data: bytes
    to: object = None


@dataclass(slots=True)
class _Goal:
    """A goal of a client: what of the recording it is, and where it stands."""

    id: bytes
    recorded: RecordedGoal
    accepted_ns: int
    status: int = 0
    is_canceled: bool = False
    waiting: list[object] = field(default_factory=list)

    @property
    def has_ended(self) -> bool:
        return self.status in OUTCOMES


class PlayedAction:
    """A server.  Times are UTC ns, and do not go back.

    Args:
        action: what it has; used up, except the last goal of a content if that may come ``again``.
        again: whether it may.
        lasts: returns how long something lasts that lasted some ns in the recording.

    Attributes:
        refused: what was not answered as recorded, in words → how often.
        ended: goals that were rejected as recorded, or have ended.
    """

    def __init__(
        self, action: RecordedAction, *, again: bool = False, lasts: Callable[[int], int] = lambda ns: ns
    ) -> None:
        self.action = action
        self.refused: Counter[str] = Counter()
        self.ended = 0
        self._again, self._lasts = again, lasts
        self._goals: dict[bytes, _Goal] = {}
        self._due: list[tuple[int, int, Callable[[int], Iterable[Sent]]]] = []
        self._order = 0

    @property
    def next_ns(self) -> int | None:
        """When it sends the next message; None: not before it is asked again."""
        return self._due[0][0] if self._due else None

    @property
    def open(self) -> int:
        """Goals that were accepted and have not ended: some wait for their client to cancel them."""
        return sum(not goal.has_ended for goal in self._goals.values())

    def ask(self, part: str, request: bytes, now_ns: int, to: object) -> None:
        """Take a request (CDR) of one of its services; its response comes from :meth:`take`, if there is one."""
        if len(request) >= HEAD + ID:
            _ASKED[part](self, request, now_ns, to)

    def take(self, now_ns: int) -> list[Sent]:
        """Return what it sends up to this time, in order."""
        found: list[Sent] = []
        while self._due and self._due[0][0] <= now_ns:
            at_ns, _, send = heapq.heappop(self._due)
            found += send(at_ns)
        return found

    # -- requests ---------------------------------------------------------------------------------------------------

    def _send_goal(self, request: bytes, now_ns: int, to: object) -> None:
        id_ = request[HEAD : HEAD + ID]
        recorded = None
        if id_ in self._goals or len(self._goals) >= _MOST_GOALS:
            self.refused["goals whose ids are taken"] += 1
        elif not (recorded := self.action.take(request, again=self._again)):
            self.refused["goals that are not in the recording"] += 1
        elif not recorded.answer:
            self.refused["goals that the recorded server did not answer"] += 1
            return
        at_ns = now_ns + (self._lasts(recorded.answer.latency_ns) if recorded and recorded.answer else 0)
        is_accepted = recorded is not None and recorded.is_accepted
        data = _CDR + struct.pack("<?3x", is_accepted) + _TIME.pack(*ns_to_ros(at_ns))
        self._plan(at_ns, lambda sent_ns: [Sent(sent_ns, "send_goal", data, to)])
        self.ended += recorded is not None and not is_accepted
        if recorded and is_accepted:
            goal = self._goals[id_] = _Goal(id_, recorded, at_ns)
            until_ns = recorded.cancel[0] if recorded.cancel else None
            self._follow(goal, now_ns, 0, (step for step in recorded.steps if _is_before(step, until_ns)))

    def _cancel_goal(self, request: bytes, now_ns: int, to: object) -> None:
        id_ = request[HEAD : HEAD + ID]
        goals = [self._goals[id_]] if id_ in self._goals else list(self._goals.values()) if id_ == _ANY else []
        found = [goal for goal in goals if not goal.has_ended and not goal.is_canceled and goal.recorded.cancel]
        latency_ns, code = 0, 0
        for goal in found:
            assert goal.recorded.cancel
            goal.is_canceled = True
            asked_ns, answer = goal.recorded.cancel
            latency_ns = max(latency_ns, answer.latency_ns)
            behind = (step for step in goal.recorded.steps if not _is_before(step, asked_ns))
            self._follow(goal, now_ns, asked_ns, behind)
        if not found:
            code = _UNKNOWN if not goals and id_ != _ANY else _TERMINATED if goals and goals[0].has_ended else _REJECTED
            if code == _REJECTED:
                self.refused["cancellations that are not in the recording"] += 1
        infos = b"".join(goal.id + _TIME.pack(*ns_to_ros(goal.accepted_ns)) for goal in found)
        data = _CDR + _GOALS.pack(code, len(found)) + infos
        self._plan(now_ns + self._lasts(latency_ns), lambda sent_ns: [Sent(sent_ns, "cancel_goal", data, to)])

    def _get_result(self, request: bytes, now_ns: int, to: object) -> None:
        goal = self._goals.get(request[HEAD : HEAD + ID])
        if goal is None:
            self.refused["results of goals that it does not have"] += 1
        elif goal.has_ended:
            self._plan(now_ns, lambda sent_ns: self._result(goal, [to], sent_ns))
        else:
            goal.waiting.append(to)

    # -- what follows -----------------------------------------------------------------------------------------------

    def _plan(self, at_ns: int, send: Callable[[int], Iterable[Sent]]) -> None:
        self._order += 1
        heapq.heappush(self._due, (at_ns, self._order, send))

    def _follow(self, goal: _Goal, now_ns: int, from_ns: int, steps: Iterable[GoalStep]) -> None:
        """Plan steps: those of a goal that is canceled meanwhile are withdrawn."""
        is_canceled = goal.is_canceled

        def sender(step: GoalStep) -> Callable[[int], Iterable[Sent]]:
            return lambda at_ns: self._step(goal, step, at_ns) if goal.is_canceled == is_canceled else ()

        for step in steps:
            self._plan(now_ns + self._lasts(step.after_ns - from_ns), sender(step))

    def _step(self, goal: _Goal, step: GoalStep, at_ns: int) -> Iterable[Sent]:
        if not step.status:
            return [Sent(at_ns, "feedback", _CDR + goal.id + step.feedback)]
        goal.status = step.status
        found = [Sent(at_ns, "status", self._states())]
        if goal.has_ended:
            self.ended += 1
            found += self._result(goal, goal.waiting, at_ns)
            goal.waiting = []
            ended = [each for each in self._goals.values() if each.has_ended]
            for each in ended[:-_KEPT]:
                del self._goals[each.id]
        return found

    def _result(self, goal: _Goal, to: Iterable[object], at_ns: int) -> list[Sent]:
        if goal.recorded.result is None:
            self.refused["results that are not in the recording"] += sum(1 for _ in to)
            return []
        return [Sent(at_ns, "get_result", goal.recorded.result, each) for each in to]

    def _states(self) -> bytes:
        """A GoalStatusArray of the goals whose state is known."""
        known = [goal for goal in self._goals.values() if goal.status]
        data = _COUNT.pack(len(known))
        for goal in known:
            data += goal.id
            data += bytes(-len(data) % 4) + _TIME.pack(*ns_to_ros(goal.accepted_ns)) + bytes((goal.status,))
        return _CDR + data


def _is_before(step: GoalStep, until_ns: int | None) -> bool:
    return until_ns is None or step.after_ns < until_ns


_ASKED: dict[str, Callable[[PlayedAction, bytes, int, object], None]] = {
    "send_goal": PlayedAction._send_goal,
    "cancel_goal": PlayedAction._cancel_goal,
    "get_result": PlayedAction._get_result,
}
