"""The guard: withholds old poses and reports odd streams, once per episode; the fast path does the same."""

from __future__ import annotations

import random
from dataclasses import replace
from typing import Any

import pytest

from igtl_gateway.base.buffers import join
from igtl_gateway.base.qos import Qos
from igtl_gateway.base.stamp import NS_PER_MS, NS_PER_S, ns_to_ticks
from igtl_gateway.config.configuration import Config, TfOutRow, ToIgtlRow, ToRosRow
from igtl_gateway.convert import rosmsg
from igtl_gateway.convert.common_msgs import FrameTransform, TFMessage
from igtl_gateway.convert.raw import raw_message
from igtl_gateway.gateway import LINK_UP, Gateway, Session, guard
from igtl_gateway.gateway.guarded_stream import CODES, STILL_LOOKS, is_unit_jump
from igtl_gateway.gateway.log.clocksteps import ClockStep
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.note import Level, Note
from igtl_gateway.wire import Message, encode
from igtl_gateway.wire.query import EmptyQuery, StartTracking
from igtl_gateway.wire.transform import Transform
from tests.script import T0_NS, Script
from tests.tables import table

ROTATION = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
WATCHING = Config(watch=True)


def pose(stamp_ns: int, place: tuple[float, float, float] = (100.0, 200.0, 300.0), device: str = "Tool") -> Message:
    return Message("TRANSFORM", device, Transform((*ROTATION, *place)), ns_to_ticks(stamp_ns))


def tool(stamp_ns: int) -> rosmsg.TransformStamped:
    return rosmsg.TransformStamped(rosmsg.Header(stamp_ns, "base"), "tool", (0.1, 0.2, 0.3), (0.0, 0.0, 0.0, 1.0))


def tf_of(parent: str, child: str, stamp_ns: int, x: float = 0.1) -> TFMessage:
    return TFMessage((FrameTransform(rosmsg.Header(stamp_ns, parent), child, (x, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)),))


# -- maximum age --------------------------------------------------------------------------------------------------


def test_what_is_too_old_is_withheld_and_told_once_until_it_is_fresh_again() -> None:
    script = Script(Config(to_ros=(ToRosRow(max_age_s=0.5),)))
    assert script.igtl(pose(script.now_ns)) == ["ros /igtl/in/Tool/transform"]
    assert script.igtl(pose(script.now_ns - NS_PER_S)) == ["note stale"]
    assert script.notes[0].level is Level.ERROR and script.notes[0].stream == "TRANSFORM/Tool"
    assert [script.igtl(pose(script.now_ns - NS_PER_S)) for _ in range(3)] == [[], [], []]
    assert script.igtl(pose(script.now_ns)) == ["ros /igtl/in/Tool/transform", "note fresh"]
    assert "4 messages dropped as too old" in script.notes[0].text
    assert script.igtl(pose(script.now_ns)) == ["ros /igtl/in/Tool/transform"]
    counts = script.gateway.ledger.to_dict()["igtl_in"]["TRANSFORM/Tool"]
    assert counts == {"received": 7, "decoded": 7, "converted": 3, "dropped": {"stale": 4}}


def test_on_the_way_out_too_and_it_does_not_become_the_latest() -> None:
    script = Script(Config(to_igtl=(ToIgtlRow(max_age_s=0.5),)))
    script.up(1)
    assert script.ros("/igtl/out/Tool", tool(script.now_ns - NS_PER_S)) == ["note stale"]
    query = Message("GET_TRANS", "Tool", EmptyQuery())
    assert "note query_unanswered" in script.igtl(query)
    assert script.ros("/igtl/out/Tool", tool(script.now_ns)) == ["igtl TRANSFORM/Tool v1 to 1", "note fresh"]
    assert "igtl TRANSFORM/Tool v1 to 1" in script.igtl(query)
    script.now_ns += NS_PER_S  # the pose is too old now, and must not be the answer to a query
    assert "igtl TRANSFORM/Tool v1 to 1" not in script.igtl(query)
    assert script.gateway.ledger.to_dict()["ros_in"]["/igtl/out/Tool"]["dropped"] == {"stale": 1}


def test_the_stamp_of_the_middleware_counts_where_the_message_has_none() -> None:
    script = Script(Config(to_igtl=(ToIgtlRow(max_age_s=0.5, stamp="receive"),)))
    script.up(1)
    assert script.ros("/igtl/out/Tool", tool(0), source_ns=script.now_ns - NS_PER_S) == ["note stale"]


def test_senders_are_judged_by_the_hosts_clock_also_where_gateway_time_is_ahead_of_it() -> None:
    rows = {"to_ros": (ToRosRow(max_age_s=0.5),), "to_igtl": (ToIgtlRow(max_age_s=0.5),)}
    script = Script(Config(**rows, watch=True))  # type: ignore[arg-type]
    script.up(1)
    for _ in range(5):  # the fast path has begun
        script.igtl(pose(script.now_ns))
    hour_ns = 3600 * NS_PER_S
    assert script.feed(Kind.EDGE_NOTE, (ClockStep.after(-hour_ns, 0).note().pack(),)) == []
    backwards = script.igtl(pose(script.now_ns - hour_ns))
    assert backwards == ["ros /igtl/in/Tool/transform", "note stamp_backwards"]
    for age_ns, said in ((0, []), (NS_PER_S, ["note stale"]), (0, ["note fresh"])):
        script.now_ns += NS_PER_S
        passed = ["ros /igtl/in/Tool/transform"] if age_ns == 0 else []
        assert script.igtl(pose(script.now_ns - hour_ns - age_ns)) == passed + said
    assert script.ros("/igtl/out/Tool", tool(script.now_ns - hour_ns)) == ["igtl TRANSFORM/Tool v1 to 1"]
    query = Message("GET_TRANS", "Tool", EmptyQuery())
    assert "igtl TRANSFORM/Tool v1 to 1" in script.igtl(query)
    script.now_ns += NS_PER_S
    assert script.igtl(pose(script.now_ns - hour_ns + 2 * NS_PER_S)) == [
        "ros /igtl/in/Tool/transform",
        "note stamp_future",
    ]
    watched = dict(script.gateway.guard.items())[1, "TRANSFORM/Tool"]
    assert abs(watched.timing.most_ns) < 10 * NS_PER_S, "what was known of its clock before the step is forgotten"


def test_a_frame_that_is_too_old_is_left_out_and_the_others_go_on() -> None:
    script = Script(Config(tf_out=(TfOutRow(frames=("a", "b"), base="base", device="Tools", max_age_s=0.5),)))
    script.up(1)

    def names() -> list[str]:
        return [element["name"] for message in script.sent() for element in message.content.describe()["elements"]]

    script.ros("/tf_static", tf_of("base", "mount", 0))
    assert script.ros("/tf", tf_of("mount", "a", script.now_ns)) == ["igtl TDATA/Tools v1 to 1"]
    script.ros("/tf", tf_of("mount", "b", script.now_ns))
    assert names() == ["a", "b"]
    script.now_ns += NS_PER_S
    said = script.ros("/tf", tf_of("mount", "a", script.now_ns, x=0.2))
    assert said == ["note stale", "igtl TDATA/Tools v1 to 1"] and names() == ["a"]
    assert "frame b in base is stale: messages are 1 s" in script.notes[0].text
    script.now_ns += NS_PER_S
    late = script.ros("/tf", tf_of("mount", "a", script.now_ns - NS_PER_S // 2 - 10**8, x=0.3))
    assert late == ["note stale"], "nothing is left to be sent"
    assert "note query_unanswered" in script.igtl(Message("GET_TDATA", "Tools", EmptyQuery())), "it is old by now"
    said = script.ros("/tf", tf_of("mount", "b", script.now_ns, x=0.4))
    assert said == ["note fresh", "igtl TDATA/Tools v1 to 1"] and names() == ["b"]
    assert "note query_unanswered" not in script.igtl(Message("GET_TDATA", "Tools", EmptyQuery()))
    assert names() == ["b"]


def test_frames_that_do_not_move_have_no_age() -> None:
    script = Script(Config(tf_out=(TfOutRow(frames=("a",), base="base", max_age_s=0.5),)))
    script.up(1)
    assert script.ros("/tf_static", tf_of("base", "a", 0)) == ["igtl TRANSFORM/aTobase v1 to 1"]
    script.now_ns += NS_PER_S
    assert "igtl TRANSFORM/aTobase v1 to 1" in script.igtl(Message("GET_TRANS", "aTobase", EmptyQuery()))


def test_a_raw_message_has_the_age_of_its_own_stamp() -> None:
    script = Script(Config(to_igtl=(ToIgtlRow(max_age_s=0.5),)))
    script.up(1)

    def raw(stamp_ns: int) -> list[str]:
        data = join(encode(pose(stamp_ns)))
        return script.ros("/igtl/out/Any/raw", raw_message(data, script.now_ns, 1))

    assert raw(script.now_ns) == ["igtl TRANSFORM/Tool v1 to 1"]
    assert raw(script.now_ns - NS_PER_S) == ["note stale"]
    assert raw(script.now_ns) == ["igtl TRANSFORM/Tool v1 to 1", "note fresh"]
    assert raw(0) == ["igtl TRANSFORM/Tool v1 to 1", "note age_unknown"]
    assert script.gateway.ledger.to_dict()["ros_in"]["/igtl/out/Any/raw"]["dropped"] == {"stale": 1}


def test_tracking_data_is_put_together_of_fresh_poses_only() -> None:
    script = Script(Config(to_igtl=(ToIgtlRow(max_age_s=0.5),)))
    script.up(1)
    script.igtl(Message("STT_TDATA", "", StartTracking(0)))
    script.ros("/igtl/out/Probe", tool(script.now_ns))

    def needle(age_ns: int = 0) -> list[str]:
        script.ros("/igtl/out/Needle", tool(script.now_ns - age_ns))
        told = [message for message in script.sent() if message.type == "TDATA"]
        return [element["name"] for message in told for element in message.content.describe()["elements"]]

    assert needle() == ["Probe", "Needle"]
    script.now_ns += NS_PER_S
    assert needle() == ["Needle"], "of the probe there is nothing new"
    script.ros("/igtl/out/Probe", tool(script.now_ns))
    assert needle() == ["Probe", "Needle"]
    assert needle(NS_PER_S) == [], "a withheld pose causes no output"


def test_without_stamps_there_is_no_age_which_is_said_once() -> None:
    script = Script(Config(to_ros=(ToRosRow(max_age_s=0.5),)))
    assert script.igtl(pose(0)) == ["ros /igtl/in/Tool/transform", "note age_unknown"]
    assert script.igtl(pose(0)) == ["ros /igtl/in/Tool/transform"]


def test_a_latched_message_is_sent_again_to_a_late_link_whatever_its_age() -> None:
    row = ToIgtlRow(max_age_s=0.5, qos=Qos(latched=True))
    script = Script(Config(to_igtl=(row,)))
    assert script.ros("/igtl/out/Tool", tool(script.now_ns)) == []  # no peer is connected
    script.now_ns += 60 * NS_PER_S
    assert script.up(1) == ["igtl TRANSFORM/Tool v1 to 1"]
    assert script.gateway.ledger.to_dict()["ros_in"]["/igtl/out/Tool"] == {"received": 1, "dropped": {"no_peer": 1}}


def test_an_episode_belongs_to_a_link_and_a_row_to_its_devices() -> None:
    script = Script(Config(to_ros=(ToRosRow(device="Probe*", max_age_s=0.5), ToRosRow())))
    old_ns = script.now_ns - NS_PER_S
    assert script.igtl(pose(old_ns, device="Other")) == ["ros /igtl/in/Other/transform"]
    assert script.igtl(pose(old_ns, device="Probe1"), 1) == ["note stale"]
    assert script.igtl(pose(old_ns, device="Probe1"), 2) == ["note stale"]
    script.up(1)
    script.down(1)
    assert script.igtl(pose(old_ns, device="Probe1"), 1) == ["note stale"]


def test_streams_beyond_the_limit_share_a_memory_and_are_withheld_all_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(guard, "MAX_WATCHED", 1)
    script = Script(Config(watch=True, to_ros=(ToRosRow(max_age_s=0.5),)))
    assert script.igtl(pose(script.now_ns)) == ["ros /igtl/in/Tool/transform"]
    assert script.igtl(pose(script.now_ns - NS_PER_S, device="One")) == ["note stale"]
    assert script.igtl(pose(script.now_ns - NS_PER_S, device="Two")) == []
    assert script.igtl(pose(script.now_ns, device="Two")) == ["ros /igtl/in/Two/transform", "note fresh"]


# -- watchers -----------------------------------------------------------------------------------------------------


TEXTS: list[str] = []


def watched(script: Script, messages: list[Message], every_ns: int = 200 * NS_PER_MS) -> list[str]:
    """Codes of the guard's notes on messages in a row; their sentences are in ``TEXTS``."""
    told = []
    for message in messages:
        script.now_ns += every_ns - NS_PER_MS
        script.igtl(message)
        told += [note for note in script.notes if note.code in CODES]
    TEXTS[:] = [note.text for note in told]
    return [note.code for note in told]


def coming(script: Script, number: int, every_ns: int = 200 * NS_PER_MS, **facts: Any) -> list[Message]:
    """Messages stamped at the time of their arrival."""
    return [pose(script.now_ns + index * every_ns, **facts) for index in range(1, number + 1)]


def test_nothing_is_said_without_watch_nor_of_good_streams() -> None:
    assert Config().watch is None
    odd = [pose(T0_NS + 5 * NS_PER_S), pose(T0_NS, (0.1, 0.2, 0.3)), pose(T0_NS - NS_PER_S)]
    assert watched(Script(), odd) == []
    script = Script(WATCHING)
    assert watched(script, coming(script, 60)) == []
    assert watched(script, [pose(0)] * 60) == []  # an unset stamp is not a finding


def test_metres_for_millimetres_are_seen_and_the_episode_ends() -> None:
    script = Script(WATCHING)
    assert watched(script, coming(script, 3)) == []
    assert watched(script, coming(script, 1, place=(0.101, 0.2, 0.299))) == ["unit_jump"]
    assert "a factor of 1001" in TEXTS[0] and "metres" in TEXTS[0]
    assert watched(script, coming(script, 1)) == []  # and back: of the same episode
    assert watched(script, coming(script, 60)) == ["calm"]
    assert "2 times" in TEXTS[0]


@table(
    ("before", "after", "jumps"),
    [
        ((0.3, 0.1, 0.0), (300.0, 100.0, 0.0), True),
        ((300.0, 100.0, 0.0), (0.3, 0.1, 0.0), True),
        ((300.0, 100.0, 0.0), (310.0, 100.0, 0.0), False),
        ((0.0, 0.0, 0.0), (300.0, 100.0, 0.0), False),  # from nowhere: a pose that begins
        ((0.3, 0.1, 0.0), (0.0, 0.0, 300.0), False),  # elsewhere: it moved
        ((0.3, 0.1, 0.0), (-300.0, -100.0, 0.0), False),
        ((0.3, 0.1, 0.0), (3e5, 1e5, 0.0), False),
        ((0.3, 0.1, 0.0), (float("nan"), 0.0, 0.0), False),
        ((float("inf"), 0.0, 0.0), (float("inf"), 0.0, 0.0), False),
    ],
)
def test_what_a_jump_of_the_unit_is(before: Any, after: Any, jumps: bool) -> None:
    assert is_unit_jump(before, after) is jumps


def test_stamps_that_run_backwards() -> None:
    script = Script(WATCHING)
    assert watched(script, coming(script, 2)) == []
    back = pose(script.now_ns - 50 * NS_PER_MS)
    assert watched(script, [back], NS_PER_MS) == ["stamp_backwards"]
    assert watched(script, coming(script, 1)) == []
    assert watched(script, [pose(script.now_ns - NS_PER_MS)], NS_PER_MS) == []
    assert watched(script, coming(script, 60)) == ["calm"]


def test_stamps_that_stand_still_but_not_those_of_whole_seconds() -> None:
    script = Script(WATCHING)
    frozen = pose(script.now_ns)
    assert watched(script, [frozen] * STILL_LOOKS) == []
    assert watched(script, [frozen] * 30) == ["stamp_still"]
    assert watched(script, coming(script, 60)) == ["calm"]
    script = Script(WATCHING)
    every_ns = 10 * NS_PER_MS
    whole = [pose((T0_NS + index * every_ns) // NS_PER_S * NS_PER_S) for index in range(1, 500)]
    assert watched(script, whole, every_ns) == []


def test_stamps_in_the_future() -> None:
    script = Script(WATCHING)
    ahead = [pose(script.now_ns + (index + 10) * 200 * NS_PER_MS) for index in range(5)]
    assert watched(script, ahead) == ["stamp_future"]
    assert "synchronise the clocks" in TEXTS[0]


def test_numbers_that_are_none_have_a_reason_of_their_own() -> None:
    script = Script(WATCHING)
    assert script.igtl(pose(script.now_ns, (float("nan"), 0.0, 0.0))) == ["note conversion"]
    script.up(1)
    nowhere = replace(tool(script.now_ns), translation=(float("inf"), 0.0, 0.0))
    assert script.ros("/igtl/out/Tool", nowhere) == ["note conversion"]
    ledger = script.gateway.ledger.to_dict()
    assert ledger["igtl_in"]["TRANSFORM/Tool"]["dropped"] == {"not_finite": 1}
    assert ledger["ros_in"]["/igtl/out/Tool"]["dropped"] == {"not_finite": 1}


# -- the fast path ---------------------------------------------------------------------------------------------

ROWS = Config(watch=True, to_ros=(ToRosRow(device="Old*", max_age_s=0.3),), to_igtl=(ToIgtlRow(max_age_s=0.3),))


def inputs(seed: int) -> list[tuple[int, Kind, bytes, str]]:
    """A thousand poses at 50 Hz in both directions, of a source with moods that last for a while."""
    chance = random.Random(seed)
    now_ns, made, place, lag_ns, frozen_ns = T0_NS, [], (100.0, 200.0, 300.0), 0, 0
    for _ in range(1_000):
        now_ns += 20 * NS_PER_MS if chance.random() > 0.005 else 11 * NS_PER_S
        mood = chance.random()
        if mood < 0.01:
            place = (0.1, 0.2, 0.3) if place[0] > 1 else (100.0, 200.0, 300.0)
        elif mood < 0.02:
            lag_ns = chance.choice([0, NS_PER_S, -NS_PER_S, 290 * NS_PER_MS])
        elif mood < 0.03:
            frozen_ns = 0 if frozen_ns else now_ns + 60 * NS_PER_MS
        stamp_ns = 0 if 0.03 < mood < 0.032 else frozen_ns or now_ns - lag_ns
        device = chance.choice(["Tool", "OldTool"])
        made.append((now_ns, Kind.IGTL_IN, join(encode(pose(stamp_ns, place, device))), ""))
        made.append((now_ns + 1, Kind.ROS_IN, replace(tool(stamp_ns), translation=place).pack(), "/igtl/out/Tool"))
    return made


def test_a_verification_which_knows_no_plans_finds_the_same_notes() -> None:
    assert set().union(*map(verified, range(3))) >= CODES


def verified(seed: int) -> set[str]:
    """The codes of the notes of a session, which a verification has to find too."""
    gateway = Gateway(ROWS)
    session = Session(gateway)
    general: list[Entry] = []
    handle = gateway.handle
    gateway.handle = lambda entry: general.append(entry) or handle(entry)  # type: ignore[method-assign, func-returns-value]
    up = Note(Level.INFO, LINK_UP, "", data={"peer": "127.0.0.1:1", "role": "server"}).pack()
    log = session.input(T0_NS, Kind.LINK, (up,), links=(1,))
    for now_ns, kind, data, topic in inputs(seed):
        links, ros_type = ((1,), "") if kind is Kind.IGTL_IN else ((), rosmsg.TransformStamped.TYPE)
        log += session.input(now_ns, kind, (data,), channel=topic, type_name=ros_type, links=links)
    assert len(general) < 1_400  # of 2,000: the others, though watched, took the fast path
    again = Gateway(ROWS)
    told = [output for entry in log if entry.kind.is_input for output in (entry, *again.handle(entry))]
    assert [(e.seq, e.kind, e.channel, e.data()) for e in told] == [(e.seq, e.kind, e.channel, e.data()) for e in log]
    assert again.ledger.to_dict() == gateway.ledger.to_dict()
    return {Note.unpack(entry.data()).code for entry in log if entry.kind is Kind.NOTE}


def test_an_output_has_the_time_until_which_it_may_be_sent() -> None:
    """The edge may hold it for its subscribers; /tf has frames of many devices."""
    rows = (ToRosRow(device="Aged", max_age_s=0.5), ToRosRow(device="Tool", max_age_s=0.0))
    script = Script(Config(to_ros=rows, max_age_s=3.0), news=True)
    script.up(1)
    until: dict[str, float] = {}
    for device in ("Aged", "Tool", "Other"):
        script.igtl(
            Message(
                "TRANSFORM",
                device,
                Transform((1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)),
                ns_to_ticks(script.now_ns),
            )
        )
        outputs = (entry for entry in script.last if entry.kind is Kind.ROS_OUT)
        until |= {entry.channel: (script.gateway.until_ns(entry) - entry.source_ns) / NS_PER_S for entry in outputs}
    assert until.pop("/igtl/links", 0) <= 0
    assert until["/igtl/in/Aged/transform"] == 0.5
    assert until["/igtl/in/Other/transform"] == 3.0
    assert until["/igtl/in/Tool/transform"] < 0, "no limit"
    assert until["/tf"] < 0
