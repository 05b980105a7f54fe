"""Which inputs stand for all that came before."""

from __future__ import annotations

from dataclasses import replace

import pytest

from igtl_gateway.gateway.live_settings import LiveSettings
from igtl_gateway.gateway.log.clocksteps import ClockStep
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.record import prologue
from igtl_gateway.record.prologue import Prologue
from igtl_gateway.record.selection import StateInputRule
from tests.record import samples

RULE = StateInputRule(frozenset({"/igtl/links"}), frozenset({"COMMAND"}))


def kept(given: Prologue, entries: list[Entry]) -> list[int]:
    for entry in entries:
        given.observe(entry)
    return [entry.seq for entry in given.entries()]


def test_links_what_was_learned_and_the_last_of_each_stream() -> None:
    entries = [
        samples.note(1, Kind.LINK),
        samples.igtl(2),
        samples.note(3),  # the first of its stream
        samples.ros(4, Kind.ROS_OUT),
        samples.igtl(5),
        samples.igtl(6, message_type="COMMAND"),
        samples.igtl(7, message_type="COMMAND"),
        samples.note(8, Kind.EDGE_NOTE),
        samples.igtl(9),
        samples.igtl(10, links=(2,)),
        samples.ros(11),
        samples.ros(12),
    ]
    assert kept(Prologue(RULE), entries) == [1, 2, 6, 7, 9, 10, 12]


def test_a_step_of_the_hosts_clock_is_remembered() -> None:
    step = Entry(2, samples.START_NS, Kind.EDGE_NOTE, payload=(ClockStep.after(-(10**12), 0).note().pack(),))
    assert kept(Prologue(RULE), [samples.note(1, Kind.EDGE_NOTE), step, samples.note(3, Kind.EDGE_NOTE)]) == [2]


def test_changes_of_settings_are_remembered() -> None:
    changed = LiveSettings().changed({"deny_in": ["COMMAND"]}).note(LiveSettings())
    change = Entry(2, samples.START_NS, Kind.EDGE_NOTE, payload=(changed.pack(),))
    assert kept(Prologue(RULE), [samples.note(1, Kind.EDGE_NOTE), change, samples.note(3, Kind.EDGE_NOTE)]) == [2]


def test_an_output_says_of_its_own_cause_only() -> None:
    entries = [samples.ros(1), samples.note(2, Kind.LINK), samples.note(3), samples.ros(4)]
    assert kept(Prologue(RULE), entries) == [2, 4]


def test_of_mixed_topics_many_messages(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(prologue, "MAX_MIXED", 3)
    rule = StateInputRule(mixed=frozenset({"/tf"}))
    entries = [samples.ros(seq, topic="/tf" if seq % 2 else "/chatter") for seq in range(1, 12)]
    assert kept(Prologue(rule), entries) == [7, 9, 10, 11]


def test_peers_that_have_gone_give_way_before_those_that_are_there() -> None:
    came = [samples.note(1, Kind.LINK, code="link_up", links=(1,)), samples.igtl(2), samples.note(3)]
    seq = 3
    for link in range(2, 12):
        for code in ("link_up", "link_down"):
            seq += 1
            came.append(samples.note(seq, Kind.LINK, code=code, links=(link,)))
    # a number that is used again: it came, went, and came
    came += [
        samples.note(seq + 1 + more, Kind.LINK, code=code, links=(11,)) for more, code in enumerate(("up", "down"))
    ]
    assert kept(Prologue(RULE), came) == [1, 2, *range(4, seq + 3)]
    # entry 2 is in two tables: of the remaining places, one is for disconnected peers
    assert kept(Prologue(RULE, max_entries=4), came) == [1, 2, seq + 1, seq + 2]
    came.append(samples.note(seq + 3, Kind.LINK, code="link_up", links=(11,)))
    assert kept(Prologue(RULE, max_entries=4), came) == [1, 2, seq + 2, seq + 3]


def test_the_last_messages_give_way_first() -> None:
    entries = [
        samples.note(1, Kind.LINK),
        samples.igtl(2, device="first"),
        samples.note(3),
        samples.igtl(4, device="a"),
        samples.igtl(5, device="b"),
        samples.igtl(6, device="c"),
    ]
    # the first of its stream stands in two tables: four places
    assert kept(Prologue(RULE, max_entries=4), entries) == [1, 2, 5, 6]


def test_the_bound_in_bytes() -> None:
    entries = [samples.igtl(seq, device=f"n{seq}", body=bytes(900)) for seq in range(1, 30)]
    assert kept(Prologue(RULE, max_bytes=10_000), entries) == list(range(20, 30))


def test_one_picture_does_not_push_out_the_rest(monkeypatch: pytest.MonkeyPatch) -> None:
    """The last input of each stream is kept beside it, within bounds of its own; one that is not kept is named."""
    monkeypatch.setattr(prologue, "LARGEST_BYTES", 20_000)
    monkeypatch.setattr(prologue, "MAX_LARGE_BYTES", 30_000)
    entries = [samples.note(1, Kind.LINK), samples.igtl(2, device="a")]
    entries += [samples.igtl(seq, device="CT", body=bytes(9_000)) for seq in (3, 4)]
    seen = Prologue(RULE, max_bytes=10_000)
    assert kept(seen, entries) == [1, 2, 4] and not seen.forgotten
    entries = [samples.igtl(seq, device=f"n{seq}", body=bytes(9_000)) for seq in (5, 6, 7)]
    assert kept(seen, entries) == [1, 2, 5, 6, 7] and list(seen.forgotten) == ["TRANSFORM/CT"]
    assert kept(seen, [samples.igtl(8, device="n7", body=bytes(20_000))]) == [1, 2, 5, 6]
    assert list(seen.forgotten) == ["TRANSFORM/CT", "TRANSFORM/n7"]
    assert kept(seen, [samples.igtl(9, device="n7", body=bytes(9_000))]) == [1, 2, 5, 6, 9]
    assert list(seen.forgotten) == ["TRANSFORM/CT"]


ROBOTS = StateInputRule(robots=("/PSM*/measured_cp", "/PSM*/servo_cp"), stamped=("/PSM*/measured_cp",))


def test_of_a_robot_the_last_accepted_command_and_the_result_of_the_last_one() -> None:
    entries = [
        samples.ros(1, topic="/PSM1/measured_cp"),
        samples.igtl(2, device="Probe"),
        samples.ros(3, Kind.ROS_OUT, topic="/PSM1/servo_cp"),
        samples.igtl(4, device="Probe"),
        samples.ros(5, Kind.ROS_OUT, topic="/PSM1/servo_cp"),
        samples.ros(6, topic="/PSM1/measured_cp"),
        samples.igtl(7, device="Probe"),
        samples.note(8, code="command_speed"),
        samples.igtl(9, device="Probe"),
        samples.note(10, code="command_old"),
    ]
    assert kept(Prologue(ROBOTS), entries) == [4, 5, 6, 9, 10]


def test_a_refused_command_that_was_the_first_message_of_its_peer_is_kept() -> None:
    rule = StateInputRule(frozenset({"/igtl/links"}), robots=ROBOTS.robots)
    entries = [
        samples.note(1, Kind.LINK),
        samples.igtl(2, device="Probe"),
        samples.ros(3, Kind.ROS_OUT, topic="/igtl/links"),
        samples.note(4, code="command_speed"),
        samples.igtl(5, device="Probe"),
        samples.note(6, code="command_frame"),
    ]
    assert kept(Prologue(rule), entries) == [1, 2, 4, 5, 6]


def test_of_a_bind_the_results_of_all_its_commands() -> None:
    entries = [
        samples.igtl(1, message_type="BIND", device="both"),
        samples.note(2, code="command_old"),
        samples.note(3, code="warning"),
        samples.ros(4, Kind.ROS_OUT, topic="/PSM1/servo_cp"),
        samples.igtl(5, message_type="BIND", device="both"),
        samples.note(6, code="command_frame"),
    ]
    assert kept(Prologue(ROBOTS), entries) == [1, 2, 4, 5, 6]


def test_a_file_may_begin_before_the_outputs_are_complete() -> None:
    seen = Prologue(ROBOTS)
    assert kept(seen, [samples.igtl(1, message_type="BIND", device="both"), samples.note(2, code="command_old")]) == [
        1,
        2,
    ]
    assert kept(seen, [samples.ros(3, Kind.ROS_OUT, topic="/PSM1/servo_cp")]) == [1, 2, 3]


def test_the_bound_counts_the_results_of_commands() -> None:
    seen = Prologue(ROBOTS, max_entries=80)
    entries = []
    for seq in range(1, 60, 2):
        entries += [samples.igtl(seq, device=f"n{seq}"), samples.note(seq + 1, code="command_old")]
    assert kept(seen, entries) == list(range(1, 61))
    # one message with so much in it counts as a large one: it must not push out everything else
    many = [samples.igtl(61, message_type="BIND", device="many")]
    many += [samples.note(seq, code="command_old") for seq in range(62, 80)]
    assert kept(seen, many) == list(range(1, 80))
    others = [samples.igtl(seq, device=f"m{seq}") for seq in range(81, 181)]
    assert kept(seen, others) == [*range(61, 80), *range(101, 181)]


def test_a_state_that_is_not_valid_is_not_the_last_one() -> None:
    """CRTK: a stamp of 0.  The gateway goes on with the one before."""
    head = b"\0\1\0\0"
    stamped = replace(samples.ros(1, topic="/PSM1/measured_cp"), payload=(head + b"\1" * 8,))
    unstamped = [
        replace(samples.ros(seq, topic=topic), payload=(head + bytes(8),))
        for seq, topic in ((2, "/PSM1/measured_cp"), (3, "/other"))
    ]
    assert kept(Prologue(ROBOTS), [stamped, *unstamped]) == [1, 3]


@pytest.mark.parametrize(("aged", "expected"), [(True, [1, 5]), (False, [5])])
def test_where_old_messages_are_withheld_the_last_that_was_sent_is_kept(aged: bool, expected: list[int]) -> None:
    entries = [
        samples.ros(1),
        samples.igtl(2, Kind.IGTL_OUT),
        samples.ros(3),
        samples.ros(5),
    ]
    assert kept(Prologue(replace(RULE, aged=aged)), entries) == expected
