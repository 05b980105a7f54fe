"""The triggers of the black box: which entries of a session fulfil a rule.

They are looked at in the recorder's process, so no message waits for them.  A condition that lasts, such as a value out
of its range, triggers when it begins, and again after it has ended.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

from igtl_gateway.base.errors import ConversionError, DamagedRecording, WireError
from igtl_gateway.base.globs import matches
from igtl_gateway.base.near import did_you_mean, near_names
from igtl_gateway.base.quantities import counted
from igtl_gateway.base.untrusted.decoding import BadBytes, MessageDecoder
from igtl_gateway.config.triggers import Trigger
from igtl_gateway.convert.common_msgs import DiagnosticArray, OperatingState
from igtl_gateway.convert.exchanges import ServiceEvent, action_of, goal_states
from igtl_gateway.gateway import LINK_DOWN
from igtl_gateway.gateway.acceptance import DEFAULT_ACCEPTANCE, Acceptance
from igtl_gateway.gateway.expected import NO_SOURCE
from igtl_gateway.gateway.guarded_stream import CALM, CODES, FRESH
from igtl_gateway.gateway.log.clock_offset import PEER_CLOCK_STEP
from igtl_gateway.gateway.log.clocksteps import CLOCK_STEP
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.marks import MarkNote
from igtl_gateway.gateway.log.note import STOPPED, Level, Note
from igtl_gateway.record.sessionfile.schemas import RosTypes
from igtl_gateway.wire.fields import visible
from igtl_gateway.wire.text import Status

#: Codes of the black box's own notes, which trigger nothing.
TRIGGERED, SAVED, INCOMPLETE = "trigger", "trigger_saved", "trigger_incomplete"
_OWN = frozenset({TRIGGERED, SAVED, INCOMPLETE})
#: Codes of notes about clocks that were set.
_SET = frozenset({CLOCK_STEP, PEER_CLOCK_STEP})
_GUARD = CODES - {CALM, FRESH}
#: Codes of notes about messages that were dropped.
LOSSES = frozenset(
    "queue_drop queue_full ros_lost ros_hold_overflow video_drop record_drop record_refused site_over_budget "
    "site_command_late truncated".split()
)
_OK = 1  # of a STATUS
_ERROR = 2  # of a DiagnosticStatus
_FAULT = "FAULT"
_ABORTED = 6  # of a GoalStatus, with which the response of get_result begins
#: Of an event of get_result, behind its encapsulation: the id of the goal in the request.
_GOAL = slice(48, 64)
#: Conditions that are followed, and streams whose rules are known.
_MOST = 10_000
_STEP = re.compile(r"(\w+)((?:\[[0-9]{1,9}\])*)")
_INDEX = re.compile(r"[0-9]{1,9}")


@dataclass(frozen=True, slots=True)
class Cause:
    """Why a rule was triggered by an entry.

    Attributes:
        rule: the rule.
        why: one sentence.
        at_ns: when it was, UTC ns: of a mark the moment that is marked.
        noted_ns: stamp of the entry.
    """

    rule: Trigger
    why: str
    at_ns: int
    noted_ns: int


@dataclass(frozen=True, slots=True)
class _Readers:
    """What decodes messages, of ROS and of OpenIGTLink, and takes a topic and why it has no value for a rule.

    ``asked``: of requests for results, topic, client and number → id of the goal; the last ones.
    """

    ros: MessageDecoder
    igtl: Acceptance
    on_no_value: Callable[[Trigger, str, str], None]
    asked: dict[tuple[str, bytes, int], bytes] = field(default_factory=dict)


class Triggers:
    """Looks at entries in their order.

    Args:
        rules: the rules.
        types: definitions of ROS types, for values.
        acceptance: which bytes are messages of OpenIGTLink.
        on_note: takes a note about each rule and topic whose messages do not have the field of the rule.
    """

    def __init__(
        self,
        rules: Sequence[Trigger],
        types: RosTypes,
        acceptance: Acceptance = DEFAULT_ACCEPTANCE,
        on_note: Callable[[Note], object] = lambda _note: None,
    ) -> None:
        self._rules = rules
        self._holds: dict[tuple[int, str], bool] = {}  # number of the rule, and of what → whether its condition holds
        self._of_stream: dict[tuple[Kind, str, str], tuple[int, ...]] = {}

        def definition_of(ros_type: str) -> str:
            found = types.find(ros_type)
            return found.text(ros_type) if found else ""

        self._on_note = on_note
        self._without: set[tuple[Trigger, str]] = set()  # rules and topics with a note
        self._read = _Readers(MessageDecoder(definition_of), acceptance, self._report)

    def _report(self, rule: Trigger, topic: str, why: str) -> None:
        """Report once that the messages of a topic do not have the field of a rule."""
        if (rule, topic) not in self._without and len(self._without) < _MOST:
            self._without.add((rule, topic))
            text = f"{rule.field} is configured (--trigger), but a message of {topic} does not have it: {why}"
            self._on_note(Note(Level.WARN, NO_SOURCE, text, topic, {"kind": "field", "setting": "--trigger"}))

    def look(self, entry: Entry) -> list[Cause]:
        """Return what an entry triggers."""
        key = (entry.kind, entry.channel, entry.type)
        numbers = self._of_stream.get(key)
        if numbers is None:
            numbers = tuple(number for number, rule in enumerate(self._rules) if _CONCERNS[rule.kind](rule, entry))
            if len(self._of_stream) < _MOST:
                self._of_stream[key] = numbers
        return [cause for number in numbers for cause in self._causes(number, entry)] if numbers else []

    def _causes(self, number: int, entry: Entry) -> Iterator[Cause]:
        rule = self._rules[number]
        try:
            found = _LOOKS[rule.kind](rule, entry, self._read)
            for name, holds, why in found:
                if not name:
                    yield Cause(rule, why, _moment_ns(rule, entry), entry.stamp_ns)
                elif holds is not self._holds.get((number, name), False):
                    if len(self._holds) < _MOST:
                        self._holds[number, name] = holds
                    if holds:
                        yield Cause(rule, why, entry.stamp_ns, entry.stamp_ns)
        except (WireError, ConversionError, DamagedRecording, BadBytes, ValueError):
            return  # what cannot be decoded has no value; the gateway's own notes report it


#: Name of what has a condition ("": an event), whether it holds, and one sentence.
_Found = Iterator[tuple[str, bool, str]]


def _note(entry: Entry) -> Note | None:
    """Return what may trigger: no note of the black box itself, and none of the end of a link with the bridge."""
    note = Note.of(entry.data())
    return None if note.code in _OWN or note.data.get("reason") == STOPPED else note


def _of_codes(codes: frozenset[str]) -> Callable[[Trigger, Entry, _Readers], _Found]:
    def look(rule: Trigger, entry: Entry, _read: _Readers) -> _Found:
        note = _note(entry)
        if note and note.code in codes and matches(rule.pattern, note.stream):
            yield "", True, f"{note.code}: {note.text}"

    return look


def _any_note(rule: Trigger, entry: Entry, _read: _Readers) -> _Found:
    note = _note(entry)
    if note and matches(rule.pattern, note.code):
        yield "", True, note.text if rule.pattern == note.code else f"{note.code}: {note.text}"


def _mark(rule: Trigger, entry: Entry, _read: _Readers) -> _Found:
    note = Note.of(entry.data())
    mark = MarkNote.of(note)
    if mark and matches(rule.pattern, mark.label):
        yield "", True, note.text


def _moment_ns(rule: Trigger, entry: Entry) -> int:
    mark = MarkNote.of(Note.of(entry.data())) if rule.kind == "mark" else None
    return entry.stamp_ns - (mark.ago_ns if mark else 0)


def _link_down(rule: Trigger, entry: Entry, _read: _Readers) -> _Found:
    note = _note(entry)
    if note and note.code == LINK_DOWN and matches(rule.pattern, str(note.data.get("peer", ""))):
        yield "", True, note.text


def _clock(rule: Trigger, entry: Entry, _read: _Readers) -> _Found:
    note = _note(entry)
    if note and note.code in _SET and matches(rule.pattern, str(note.data.get("peer", ""))):
        yield "", True, note.text


def _status(rule: Trigger, entry: Entry, read: _Readers) -> _Found:
    content = read.igtl.message(entry.data()).content
    if isinstance(content, Status):
        why = f"{visible(entry.channel)}: code {content.code}, {visible(content.message)}"
        yield entry.channel, content.code != _OK, why


def _diagnostics(rule: Trigger, entry: Entry, _read: _Readers) -> _Found:
    for status in DiagnosticArray.unpack(entry.data()).status:
        if matches(rule.pattern, status.name):
            yield f"{entry.channel} {status.name}", status.level == _ERROR, f"{status.name}: {status.message}"


def _operating_state(rule: Trigger, entry: Entry, _read: _Readers) -> _Found:
    state = OperatingState.unpack(entry.data()).state
    yield entry.channel, state == _FAULT, f"{entry.channel}: {state}"


def _action_aborted(_rule: Trigger, entry: Entry, read: _Readers) -> _Found:
    action, part = action_of(entry.channel) or ("", "")
    states = goal_states(entry.data()) if part == "status" else _result_state(entry, read)
    for goal, status in states:
        name = goal.hex()
        yield f"{action} {name}", status == _ABORTED, f"{action}: goal {name[:8]} was aborted"


def _result_state(entry: Entry, read: _Readers) -> list[tuple[bytes, int]]:
    """Return the goal of a response of get_result, and its status; nothing if the goal is not known."""
    event = ServiceEvent.unpack(entry.data())
    key = (entry.channel, event.client, event.number)
    if event.has_request:
        if len(read.asked) >= _MOST:
            del read.asked[next(iter(read.asked))]
        read.asked[key] = bytes(entry.data()[_GOAL])
    elif event.response and (goal := read.asked.get(key)):
        return [(goal, status) for status in event.response[4:5]]
    return []


def _value(rule: Trigger, entry: Entry, read: _Readers) -> _Found:
    value = _number_at(read.ros.decode(entry.type, entry.data()), rule.field)
    if value is None or isinstance(value, str):
        if value:
            read.on_no_value(rule, entry.channel, value)
        return
    outside = (rule.below is not None and value < rule.below) or (rule.above is not None and value > rule.above)
    yield entry.channel, outside, f"{entry.channel} {rule.field}: {value:g}"


def _number_at(message: Any, path: str) -> float | str | None:
    """Return the number at a path of a message; if there is none, the reason; None for an array without values."""
    for step in path.split("."):
        found = _STEP.fullmatch(step)
        fields = [name for name in getattr(message, "__dataclass_fields__", ()) if name != "__msgtype__"]
        if not found or found[1] not in fields:
            near = did_you_mean(near_names(found[1] if found else step, fields))
            return f"found no {step!r}" + (f"; {near}" if near else "")
        message = getattr(message, found[1])
        for index in _INDEX.findall(found[2]):
            try:
                message = message[int(index)]
            except TypeError:
                return f"{found[1]!r} is not an array"
            except IndexError:
                # it may get values later
                return f"{found[1]!r} has {counted(len(message), 'value')}" if len(message) else None
    try:
        return float(message)
    except (TypeError, ValueError):
        return "it is not a number"


_NOTES = frozenset({Kind.NOTE, Kind.EDGE_NOTE})
_ROS = frozenset({Kind.ROS_IN, Kind.ROS_OUT})

#: Kind of a rule → whether it concerns the stream of an entry.
_CONCERNS: dict[str, Callable[[Trigger, Entry], bool]] = {
    "guard": lambda _, entry: entry.kind in _NOTES,
    "clock": lambda _, entry: entry.kind in _NOTES,
    "link_down": lambda _, entry: entry.kind is Kind.LINK,
    "loss": lambda _, entry: entry.kind in _NOTES,
    "diagnostics": lambda _, entry: entry.kind is Kind.ROS_IN and entry.type == DiagnosticArray.TYPE,
    "status": lambda rule, entry: (
        entry.kind is Kind.IGTL_IN and entry.type == "STATUS" and matches(rule.pattern, entry.channel.partition("/")[2])
    ),
    "operating_state": lambda rule, entry: (
        entry.kind in _ROS and entry.type == OperatingState.TYPE and matches(rule.pattern, entry.channel)
    ),
    "action_aborted": lambda rule, entry: (
        entry.kind is Kind.ROS_IN
        and (named := action_of(entry.channel)) is not None
        and named[1] in ("status", "get_result")
        and matches(rule.pattern, named[0])
    ),
    "value": lambda rule, entry: entry.kind in _ROS and matches(rule.pattern, entry.channel),
    "mark": lambda _, entry: entry.kind is Kind.EDGE_NOTE,
    "note": lambda _, entry: entry.kind in _NOTES or entry.kind is Kind.LINK,
}

#: Kind of a rule → what it finds in an entry of such a stream.
_LOOKS: dict[str, Callable[[Trigger, Entry, _Readers], _Found]] = {
    "guard": _of_codes(_GUARD),
    "clock": _clock,
    "link_down": _link_down,
    "loss": _of_codes(LOSSES),
    "diagnostics": _diagnostics,
    "status": _status,
    "operating_state": _operating_state,
    "action_aborted": _action_aborted,
    "value": _value,
    "mark": _mark,
    "note": _any_note,
}
