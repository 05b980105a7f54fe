"""Which entries fulfil a rule of the black box, once for each time its condition begins, and what has no value."""

from __future__ import annotations

import numpy as np

from igtl_gateway.base.buffers import join
from igtl_gateway.config.triggers import KINDS, trigger
from igtl_gateway.convert.common_msgs import DiagnosticArray, JointState, OperatingState, WrenchStamped
from igtl_gateway.convert.exchanges import REQUEST_RECEIVED, RESPONSE_SENT
from igtl_gateway.convert.rosmsg import DiagnosticStatus, Header
from igtl_gateway.gateway.expected import NO_SOURCE
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.marks import MarkNote
from igtl_gateway.gateway.log.note import Level, Note
from igtl_gateway.record.sessionfile.schemas import RosTypes
from igtl_gateway.record.triggers import _CONCERNS, _LOOKS, INCOMPLETE, LOSSES, SAVED, TRIGGERED, Triggers
from igtl_gateway.wire import Message, encode
from igtl_gateway.wire.text import Status
from tests.calls import fibonacci, status
from tests.exchanges import ACTION_TYPE, event
from tests.tables import table


def _note(code: str, kind: Kind = Kind.EDGE_NOTE, stream: str = "", **data: object) -> Entry:
    return Entry(1, 7, kind, payload=(Note(Level.WARN, code, f"text of {code}", stream, dict(data)).pack(),))


def _ros(topic: str, ros_type: str, cdr: bytes, kind: Kind = Kind.ROS_IN) -> Entry:
    return Entry(1, 7, kind, topic, ros_type, (cdr,))


def _diagnostics(level: int, name: str = "motor") -> Entry:
    array = DiagnosticArray(Header(), (DiagnosticStatus(level, name, "hot"),))
    return _ros("/diagnostics", DiagnosticArray.TYPE, array.pack())


def _status(code: int) -> Entry:
    return Entry(1, 7, Kind.IGTL_IN, "STATUS/Arm", "STATUS", (join(encode(Message("STATUS", "Arm", Status(code)))),))


def _state(state: str) -> Entry:
    return _ros("/PSM1/operating_state", OperatingState.TYPE, OperatingState(Header(), state).pack())


def _force(z: float) -> Entry:
    return _ros("/force", WrenchStamped.TYPE, WrenchStamped(Header(), (0.0, 0.0, z, 0.0, 0.0, 0.0)).pack())


_A, _B = bytes(range(16)), bytes(range(1, 17))


def _goals(*states: tuple[bytes, int]) -> Entry:
    return _ros("/arm/drive/_action/status", "action_msgs/msg/GoalStatusArray", status(*states))


def _result(kind: int, number: int, content: bytes, client: bytes = b"one") -> Entry:
    contents = {"request": content} if kind < RESPONSE_SENT else {"response": content}
    topic = "/arm/drive/_action/get_result/_service_event"
    return _ros(topic, f"{ACTION_TYPE}_GetResult_Event", event(kind, 7, number, client=client, **contents))


_ASKED, _GIVEN = _result(REQUEST_RECEIVED, 3, _A), _result(RESPONSE_SENT, 3, b"\6\0\0\0" + fibonacci(1))


def _cut(entry: Entry, size: int) -> Entry:
    return _ros(entry.channel, entry.type, entry.data()[:size])


VALUE = "value=/force,field=wrench.force.z,above=5"


@table(
    ("rule", "entries", "fires"),
    [
        ("guard", [_note("stamp_backwards", Kind.NOTE, "TRANSFORM/a"), _note("calm"), _note("bad_crc")], [0]),
        ("guard=*/b", [_note("stale", Kind.NOTE, "TRANSFORM/a"), _note("stale", Kind.NOTE, "TRANSFORM/b")], [1]),
        ("link_down", [_note("link_up", Kind.LINK, peer="1.2.3.4:5"), _note("link_down", Kind.LINK, peer="a:5")], [1]),
        ("clock", [_note("peer_clock", peer="a:5"), _note("peer_clock_step", peer="a:5"), _note("clock_step")], [1, 2]),
        ("clock=10.0.*", [_note("peer_clock_step", peer=each) for each in ("10.0.0.7:5", "10.1.0.7:5")], [0]),
        ("link_down=1.2.*", [_note("link_down", Kind.LINK, peer="1.2.3.4:5"), _note("link_down", Kind.LINK)], [0]),
        ("link_down", [_note("link_down", Kind.LINK, reason=each) for each in ("stopped", "closed by the peer")], [1]),
        ("loss", [_note("queue_drop"), _note("tick"), _note("ros_lost")], [0, 2]),
        ("diagnostics", [_diagnostics(1), _diagnostics(2), _diagnostics(2), _diagnostics(0), _diagnostics(2)], [1, 4]),
        ("diagnostics=arm*", [_diagnostics(2), _diagnostics(2, "arm 1")], [1]),
        ("status", [_status(1), _status(13), _status(13), _status(1), _status(2)], [1, 4]),
        ("status=Other", [_status(13)], []),
        ("operating_state", [_state("ENABLED"), _state("FAULT"), _state("FAULT")], [1]),
        ("operating_state=/PSM2/*", [_state("FAULT")], []),
        ("action_aborted", [_goals((_A, 2)), _goals((_A, 6)), _goals((_A, 6), (_B, 2)), _goals((_A, 6), (_B, 4))], [1]),
        ("action_aborted", [_goals((_A, 6)), _goals((_A, 6), (_B, 6)), _goals(), _goals((_B, 6))], [0, 1]),
        ("action_aborted", [_goals((_A, 6), (_B, 6))], [0, 0]),
        ("action_aborted=/arm/drive", [_goals((_A, 5)), _goals((_A, 6))], [1]),
        ("action_aborted=/arm/*,after=1", [_goals((_A, 6))], [0]),
        ("action_aborted=/drive", [_goals((_A, 6)), _ASKED, _GIVEN], []),
        ("action_aborted", [_ASKED, _GIVEN], [1]),
        ("action_aborted", [_ASKED, _result(RESPONSE_SENT, 3, b"")], []),
        ("action_aborted", [_ASKED, _cut(_GIVEN, 52)], []),  # it has a response of no bytes
        ("action_aborted", [_ASKED, _goals((_A, 6)), _GIVEN, _GIVEN], [1]),
        ("action_aborted", [_GIVEN, _result(RESPONSE_SENT, 4, b"\6\0\0\0" + fibonacci()), _ASKED], []),
        ("action_aborted", [_ASKED, _result(RESPONSE_SENT, 3, b"\6", b"two"), _result(RESPONSE_SENT, 3, b"\4")], []),
        (VALUE, [_force(5), _force(5.5), _force(9), _force(1), _force(6)], [1, 4]),
        ("value=/force,field=wrench.force.z,below=-1,above=1", [_force(0), _force(-2)], [1]),
        ("value=/force,field=wrench.nothing,above=1", [_force(9)], []),
        ("value=/force,field=header.frame_id,above=1", [_force(9)], []),
        ("mark=slip*", [_note("mark", label="slip-2"), _note("mark", label="other")], [0]),
        ("note=bad_*", [_note("bad_crc", Kind.NOTE), _note("tick"), _note(TRIGGERED), _note(SAVED)], [0]),
        (
            "note=link_*",
            [_note("link_down", Kind.LINK, reason=each) for each in ("stopped", "closed by the peer")],
            [1],
        ),
        ("loss", [_note("truncated", reason=each) for each in ("stopped", "closed by the peer")], [1]),
        ("note=**", [_note(code) for code in (TRIGGERED, SAVED, INCOMPLETE)], []),
    ],
)
def test_what_triggers(rule: str, entries: list[Entry], fires: list[int]) -> None:
    triggers = Triggers((trigger(rule),), RosTypes())
    found = [number for number, entry in enumerate(entries) for _ in triggers.look(entry)]
    assert found == fires


@table(("rule", "why"), [("note=bad_crc", "text of bad_crc"), ("note=bad_*", "bad_crc: text of bad_crc")])
def test_a_code_stands_once(rule: str, why: str) -> None:
    (cause,) = Triggers((trigger(rule),), RosTypes()).look(_note("bad_crc"))
    assert cause.why == why


def test_bytes_that_are_not_of_the_type_trigger_nothing() -> None:
    rules = tuple(map(trigger, ("diagnostics", "status", "operating_state", "action_aborted", VALUE)))
    triggers = Triggers(rules, RosTypes())
    for entry in (_diagnostics(2), _status(2), _state("FAULT"), _goals((_A, 6)), _ASKED, _force(9)):
        short = Entry(1, 7, entry.kind, entry.channel, entry.type, (bytes(join(entry.payload))[:-9],))
        assert not triggers.look(short)


def test_each_kind_is_looked_for() -> None:
    assert KINDS.keys() == _CONCERNS.keys() == _LOOKS.keys()


@table(
    ("kind", "channel", "ros_type", "rule", "fires"),
    [
        (Kind.ROS_OUT, "/diagnostics", DiagnosticArray.TYPE, "diagnostics", False),  # our own diagnostics
        (Kind.ROS_IN, "/other", DiagnosticArray.TYPE, "diagnostics", True),
        (Kind.ROS_IN, "/diagnostics", "std_msgs/msg/String", "diagnostics", False),
    ],
)
def test_diagnostics_of_other_nodes_count(kind: Kind, channel: str, ros_type: str, rule: str, fires: bool) -> None:
    entry = Entry(1, 7, kind, channel, ros_type, _diagnostics(2).payload)
    assert bool(Triggers((trigger(rule),), RosTypes()).look(entry)) == fires


def test_a_state_and_a_number_count_on_their_way_to_ros_and_from_it() -> None:
    for kind in (Kind.ROS_IN, Kind.ROS_OUT):
        triggers = Triggers((trigger("operating_state"), trigger(VALUE)), RosTypes())
        for entry in (_state("FAULT"), _force(9)):
            assert triggers.look(Entry(1, 7, kind, entry.channel, entry.type, entry.payload))


def test_patterns_are_globs_of_topics_and_devices() -> None:
    for text, entry in (
        ("value=/fo*,field=wrench.force.z,above=5", _force(9)),
        ("operating_state=/PSM?/operating_state", _state("FAULT")),
        ("status=A*", _status(13)),
    ):
        assert Triggers((trigger(text),), RosTypes()).look(entry), text


def test_a_status_that_the_gateway_sends_triggers_nothing() -> None:
    sent = Entry(1, 7, Kind.IGTL_OUT, "STATUS/Arm", "STATUS", _status(13).payload)
    assert not Triggers((trigger("status"),), RosTypes()).look(sent)


def test_each_stream_and_each_status_has_a_condition_of_its_own() -> None:
    triggers = Triggers((trigger("status"), trigger("diagnostics")), RosTypes())
    other = Entry(2, 8, Kind.IGTL_IN, "STATUS/Other", "STATUS", _status(13).payload)
    entries = [_status(13), other, _status(13), _diagnostics(2, "a"), _diagnostics(2, "b"), _diagnostics(2, "a")]
    assert [len(triggers.look(each)) for each in entries] == [1, 1, 0, 1, 1, 0]


def test_several_rules_look_at_one_entry() -> None:
    triggers = Triggers(tuple(map(trigger, ("guard", "note=stale", "loss", "note=bad_crc"))), RosTypes())
    assert [each.rule.kind for each in triggers.look(_note("stale", Kind.NOTE))] == ["guard", "note"]


@table(
    ("entry", "rule", "why"),
    [
        (_note("stale", Kind.NOTE), "guard", "stale: text of stale"),
        (_note("queue_drop"), "loss", "queue_drop: text of queue_drop"),
        (_diagnostics(2), "diagnostics", "motor: hot"),
        (_status(13), "status", "STATUS/Arm: code 13, "),
        (_state("FAULT"), "operating_state", "/PSM1/operating_state: FAULT"),
        (_goals((_B, 4), (_A, 6)), "action_aborted", "/arm/drive: goal 00010203 was aborted"),
        (_force(5.5), VALUE, "/force wrench.force.z: 5.5"),
    ],
)
def test_why_is_one_sentence_with_what_was_found(entry: Entry, rule: str, why: str) -> None:
    (cause,) = Triggers((trigger(rule),), RosTypes()).look(entry)
    assert cause.why == why
    assert (cause.at_ns, cause.noted_ns, cause.rule) == (7, 7, trigger(rule))


def test_a_mark_is_at_the_moment_that_is_marked() -> None:
    note = MarkNote("slip", ago_ns=3).note()
    (cause,) = Triggers((trigger("mark"),), RosTypes()).look(Entry(1, 7, Kind.EDGE_NOTE, payload=(note.pack(),)))
    assert (cause.at_ns, cause.noted_ns) == (4, 7)


def _joints(*positions: float) -> Entry:
    return _ros("/joints", JointState.TYPE, JointState(Header(), ("a",), np.array(positions)).pack())


@table(
    ("field", "entries", "fires", "text"),
    [
        ("position[1]", [_joints(0, 9), _joints(9, 0), _joints(0, 9)], [0, 2], ""),
        ("position[1]", [_joints(), _joints(0, 9)], [1], ""),  # without values, which may come later
        ("position[1]", [_joints(9)], [], "'position' has 1 value"),
        ("position", [_joints(9, 9)], [], "it is not a number"),
        ("posiiton[0]", [_joints(9)], [], "found no 'posiiton[0]'; did you mean 'position'"),
        ("header[0]", [_joints(9)], [], "'header' is not an array"),
        ("position[0].x", [_joints(9)], [], "found no 'x'"),
        ("__msgtype__", [_joints(9)], [], "found no '__msgtype__'"),
        ("name[0]", [_joints(9)], [], "it is not a number"),
        ("header.stamp.sec", [_joints(9)], [], ""),
    ],
)
def test_paths_to_numbers(field: str, entries: list[Entry], fires: list[int], text: str) -> None:
    """Why a message has no number is reported once, and not for each message."""
    notes: list[Note] = []
    triggers = Triggers((trigger(f"value=/joints,field={field},above=5"),), RosTypes(), on_note=notes.append)
    assert [number for number, entry in enumerate(entries) for _ in triggers.look(entry)] == fires
    for entry in entries:
        triggers.look(entry)
    assert len(notes) == bool(text)
    for note in notes:
        assert (note.level, note.code, note.stream) == (Level.WARN, NO_SOURCE, "/joints")
        assert note.text.startswith(f"{field} is configured (--trigger), but a message of /joints does not have it: ")
        assert text in note.text
        assert note.data == {"kind": "field", "setting": "--trigger"}


def test_bounds_belong_to_the_range() -> None:
    rule = trigger("value=/force,field=wrench.force.z,below=-1,above=1")
    for value, fires in ((1, 0), (-1, 0), (1.5, 1), (-1.5, 1), (float("nan"), 0), (float("inf"), 1)):
        assert len(Triggers((rule,), RosTypes()).look(_force(value))) == fires, value


def test_losses_are_codes_of_notes() -> None:
    assert len(LOSSES) == 10
    for code in LOSSES:
        assert Triggers((trigger("loss"),), RosTypes()).look(_note(code)), code


@table(
    ("rule", "entry"),
    [
        ("note=bad_crc", _note("bad_crc")),
        ("guard", _note("stale", Kind.NOTE)),
        ("loss", _note("queue_drop")),
        ("diagnostics", _diagnostics(2)),
        ("status", _status(13)),
        ("operating_state", _state("FAULT")),
        ("action_aborted", _goals((_A, 6))),
        (VALUE, _force(6)),
        ("mark=slip", _note("mark", label="slip")),
    ],
)
def test_a_trigger_is_of_the_moment_of_its_entry(rule: str, entry: Entry) -> None:
    (cause,) = Triggers((trigger(rule),), RosTypes()).look(entry)
    assert (cause.at_ns, cause.noted_ns) == (entry.stamp_ns, entry.stamp_ns)


def test_a_mark_of_the_past_is_of_its_own_moment() -> None:
    (cause,) = Triggers((trigger("mark=slip"),), RosTypes()).look(_note("mark", label="slip", ago_ns=5))
    assert (cause.at_ns, cause.noted_ns) == (2, 7)


def test_requests_for_results_are_forgotten_at_a_bound() -> None:
    triggers = Triggers((trigger("action_aborted"),), RosTypes())
    for number in range(10_001):
        triggers.look(_result(REQUEST_RECEIVED, number, _A))
    assert not triggers.look(_result(RESPONSE_SENT, 0, b"\6"))
    assert triggers.look(_result(RESPONSE_SENT, 1, b"\6"))


def test_of_ten_thousand_conditions_each_is_followed_and_no_further_one() -> None:
    """A condition that is followed triggers once while it holds; one beyond the bound with each message."""
    triggers = Triggers((trigger("diagnostics"),), RosTypes())

    def causes(first: int, count: int) -> int:
        statuses = tuple(DiagnosticStatus(2, f"motor {number}", "hot") for number in range(first, first + count))
        cdr = DiagnosticArray(Header(), statuses).pack()
        return len(triggers.look(_ros("/diagnostics", DiagnosticArray.TYPE, cdr)))

    assert [causes(0, 10_000), causes(9_999, 1), causes(10_000, 1), causes(10_000, 1)] == [10_000, 0, 1, 1]
