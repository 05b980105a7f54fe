"""What ``info`` counts of services and actions: calls with their answers, goals with their ends.

Only the channels of services and actions are read.  A client and its server both publish the events of a call, each
with an identifier of its own for the client (rmw_fastrtps), so each side is counted by itself, and the one with more
calls stands for the service.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

from igtl_gateway.base.errors import ConversionError
from igtl_gateway.base.quantities import count_text
from igtl_gateway.base.untrusted.derived_types import DerivedType
from igtl_gateway.base.untrusted.numbers import whole_number
from igtl_gateway.convert.exchanges import (
    OUTCOMES,
    REQUEST_RECEIVED,
    REQUEST_SENT,
    RESPONSE_SENT,
    ServiceEvent,
    action_of,
    feedback_goal,
    goal_states,
    service_of,
)
from igtl_gateway.gateway.log.entry import Entry
from igtl_gateway.record.sessionfile import layout
from igtl_gateway.record.sessionfile.columns import Stream, Unfit
from igtl_gateway.record.sessionfile.reader import SessionFile

#: Calls without an answer and goals that are followed at once; of more, the oldest are counted as they are.
_MOST = 100_000
_REQUESTS, _OF_SERVER = (REQUEST_SENT, REQUEST_RECEIVED), (REQUEST_RECEIVED, RESPONSE_SENT)
#: Where the first byte of a response is, and bytes of the id of a goal.
_FIRST, _ID = 4, 16
#: How a goal ends that is not accepted.
_REJECTED = "rejected"
#: Key of a number → what it counts.
_ENDS = (
    ("answered", "answered"),
    ("unanswered", "without response"),
    ("unasked", "without request"),
    ("bare", "events without content"),
    *((each, each) for each in (*OUTCOMES.values(), _REJECTED)),
    ("open", "without result"),
)
#: Those of which the rest may be elsewhere: what there is, and what is missing.
_INCOMPLETE = {
    "unanswered": ("call", "without response"),
    "unasked": ("response", "without request"),
    "open": ("goal", "without result"),
}


@dataclass(slots=True)
class _Side:
    """The calls as a client or a server has them."""

    calls: int = 0
    answered: int = 0
    unasked: int = 0
    waiting: dict[tuple[bytes, int], bytes] = field(default_factory=dict)

    def add(self, event: ServiceEvent) -> bytes:
        """Return the goal of the request that is now answered; ``b""``: there is none."""
        key = event.client, event.number
        if event.kind in _REQUESTS:
            self.calls += 1
            self.waiting[key] = event.goal
            if len(self.waiting) > _MOST:
                self.waiting.pop(next(iter(self.waiting)))
            return b""
        if key not in self.waiting:
            self.unasked += 1
            return b""
        self.answered += 1
        return self.waiting.pop(key)


@dataclass(slots=True)
class ServiceSummary:
    """The calls of one service.

    Attributes:
        name, type: of the service.
        unreadable: messages that are not events.
        bare: events without the content of a request or response, as introspection of metadata has them.
    """

    name: str
    type: str
    unreadable: int = 0
    bare: int = 0
    _sides: tuple[_Side, _Side] = field(default_factory=lambda: (_Side(), _Side()))

    def add(self, event: ServiceEvent) -> bytes:
        """Count an event; see `_Side.add`."""
        self.bare += not event.has_request and event.response is None
        return self._sides[event.kind in _OF_SERVER].add(event)

    def to_dict(self) -> dict[str, Any]:
        """Return it as JSON values."""
        side = max(self._sides, key=lambda each: each.calls)
        return {
            "service": self.name,
            "type": self.type,
            "calls": side.calls,
            "answered": side.answered,
            "unanswered": side.calls - side.answered,
            "unasked": side.unasked,
            "bare": self.bare,
            "unreadable": self.unreadable,
        }


@dataclass(slots=True)
class ActionSummary:
    """The goals of one action.

    Attributes:
        name, type: of the action; the type is ``""`` if only its states are recorded.
        feedback: number of messages.
        unreadable: messages that are not of their type.
    """

    name: str
    type: str = ""
    feedback: int = 0
    unreadable: int = 0
    _goals: dict[bytes, str] = field(default_factory=dict)
    _ended: Counter[str] = field(default_factory=Counter)

    def add(self, goal: bytes, outcome: str = "") -> None:
        """Take what a message shows of a goal."""
        if len(goal) < _ID:
            return
        known = self._goals.get(goal, "")
        self._goals[goal] = known or outcome
        if len(self._goals) > _MOST:
            self._ended[self._goals.pop(next(iter(self._goals)))] += 1

    def to_dict(self) -> dict[str, Any]:
        """Return it as JSON values."""
        ends = self._ended + Counter(self._goals.values())
        return {
            "action": self.name,
            "type": self.type,
            "goals": ends.total(),
            **{outcome: ends[outcome] for outcome in (*OUTCOMES.values(), _REJECTED)},
            "open": ends[""],
            "feedback": self.feedback,
            "unreadable": self.unreadable,
        }


@dataclass(slots=True)
class _Place:
    """Where the messages of a channel are counted: a service, a part of an action, or both."""

    service: ServiceSummary | None = None
    action: ActionSummary | None = None
    part: str = ""


@dataclass(slots=True)
class ExchangeSummary:
    """The services and actions of a recording, by name; a service of an action is part of it.

    Attributes:
        begin_ns: messages before this time only restore the state of a slice, and do not count; UTC ns.
    """

    begin_ns: int = 0
    _places: dict[tuple[str, str], _Place | None] = field(default_factory=dict)
    _services: dict[str, ServiceSummary] = field(default_factory=dict)
    _actions: dict[str, ActionSummary] = field(default_factory=dict)

    @classmethod
    def of(cls, file: SessionFile) -> ExchangeSummary:
        """Of a file.  Raises as SessionFile.entries."""
        found = cls(whole_number(file.session.get("slice_start_ns")) or 0)
        for entry in exchange_entries(file):
            found.add(entry)
        return found

    def add(self, entry: Entry) -> None:
        """Take an entry; those of other channels do not count."""
        key = entry.channel, entry.type
        if key not in self._places:
            self._places[key] = self._place(entry)
        place = self._places[key]
        if place is None or entry.stamp_ns < self.begin_ns:
            return
        data = bytes(entry.data())
        try:
            if place.service:
                event = ServiceEvent.unpack(data)
                answered = place.service.add(event)
                if place.action:
                    _add_call(place.action, place.part, event, answered)
            elif place.action:
                _add_message(place.action, place.part, data)
        except ConversionError:
            if place.service:
                place.service.unreadable += 1
            if place.action:
                place.action.unreadable += 1

    def _place(self, entry: Entry) -> _Place | None:
        """Return where the messages of a channel are counted; None: nowhere."""
        if entry.kind not in layout.ROS_KINDS or not is_exchange(entry.channel):
            return None
        place = _Place()
        if name := service_of(entry.channel):
            place.service = ServiceSummary(name, entry.type.removesuffix("_Event"))
            place.service = self._services.setdefault(name, place.service)
        if found := action_of(entry.channel):
            action, place.part = found
            place.action = self._actions.setdefault(action, ActionSummary(action))
            if (derived := DerivedType.of(entry.type)) and derived.kind == "action":
                place.action.type = f"{derived.package}/action/{derived.name}"
        return place

    def passing(self, entries: Iterable[Entry]) -> Iterator[Entry]:
        """Yield the entries, and take them."""
        for entry in entries:
            self.add(entry)
            yield entry

    @property
    def services(self) -> list[dict[str, Any]]:
        """The services as JSON values, without those of actions."""
        return [each.to_dict() for name, each in sorted(self._services.items()) if not _of_action(name)]

    @property
    def actions(self) -> list[dict[str, Any]]:
        """The actions as JSON values."""
        return [each.to_dict() for _, each in sorted(self._actions.items())]


def ends_text(facts: Mapping[str, Any]) -> str:
    """Return in words how the calls of a service or the goals of an action ended, and its type."""
    ends = [f"{facts[key]:,} {text}" for key, text in _ENDS if facts.get(key)]
    ends += [f"{facts['feedback']:,} feedback"] if facts.get("feedback") else []
    ends += [f"{count_text(facts['unreadable'], 'message')} unreadable"] if facts["unreadable"] else []
    return "; ".join(filter(None, (", ".join(ends), facts["type"])))


def incomplete(found: ExchangeSummary) -> Iterator[str]:
    """Yield a line for each service and action of which a recording has only a part of some calls or goals."""
    for each in (*found.services, *found.actions):
        parts = [f"{count_text(each[key], what)} {rest}" for key, (what, rest) in _INCOMPLETE.items() if each.get(key)]
        if parts:
            yield f"{each.get('service') or each['action']}: {', '.join(parts)}"


def exchange_count(file: SessionFile) -> int:
    """Return the number of messages of services and actions."""
    return sum(channel.count for channel in file.channels if is_exchange(channel.topic))


def exchange_entries(file: SessionFile) -> Iterator[Entry]:
    """Yield the entries of services and actions, in their order; nothing else is read.

    Raises as SessionFile.entries.
    """
    if not exchange_count(file):
        return
    try:
        found = file.columns(wanted=_is_exchange)
    except Unfit:
        entries = file.entries_of_kinds(layout.ROS_KINDS)
        yield from (each for each in entries if each.kind in layout.ROS_KINDS and is_exchange(each.channel))
        return
    for columns in found:
        yield from columns.entries()


def is_exchange(topic: str) -> bool:
    """Return whether a topic is one of a service or an action."""
    return bool(service_of(topic)) or action_of(topic) is not None


def _is_exchange(stream: Stream) -> bool:
    return stream.kind in layout.ROS_KINDS and is_exchange(stream.channel)


def _of_action(service: str) -> bool:
    return action_of(f"{service}/_service_event") is not None


def _add_call(action: ActionSummary, part: str, event: ServiceEvent, answered: bytes) -> None:
    """Take an event of a service of an action; ``answered``: the goal of the request which it answers."""
    if part == "cancel_goal":
        return
    action.add(event.goal)
    if answered and event.response and len(event.response) > _FIRST:
        first = event.response[_FIRST]  # whether it is accepted, or its status
        rejected = _REJECTED if part == "send_goal" and not first else ""
        action.add(answered, OUTCOMES.get(first, "") if part == "get_result" else rejected)


def _add_message(action: ActionSummary, part: str, data: bytes) -> None:
    """Take a feedback, or the states of goals.  Raises ConversionError."""
    if part == "feedback":
        action.add(feedback_goal(data))
        action.feedback += 1
        return
    for goal, status in goal_states(data):
        action.add(goal, OUTCOMES.get(status, ""))
