"""What a replay sends to which side."""

from __future__ import annotations

import re
import threading
from pathlib import Path
from typing import Any

import pytest

from igtl_gateway.app.replay_listeners import Listeners
from igtl_gateway.app.replay_plan import (
    both_sender,
    check_sends,
    check_streams,
    igtl_sender,
    plan_replay,
    planned_entries,
    ros_sender,
)
from igtl_gateway.app.replay_settings import Side
from igtl_gateway.app.rows import with_sends
from igtl_gateway.base.clock import ManualClock
from igtl_gateway.base.errors import ConfigError
from igtl_gateway.base.qos import Qos
from igtl_gateway.config.configuration import Config
from igtl_gateway.gateway import LINK_UP, LINKS_TOPIC, Gateway, Session
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.note import Level, Note
from igtl_gateway.record.host import in_thread
from igtl_gateway.record.options import RecordOptions
from igtl_gateway.record.recorder import Recorder
from igtl_gateway.record.selection import StateInputRule
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.record.sessionfile.writer import SessionWriter
from igtl_gateway.replay.recorded_config import config_to_run
from igtl_gateway.testing.gateway import ManualGateway
from igtl_gateway.wire import Message
from igtl_gateway.wire.query import EmptyQuery
from igtl_gateway.wire.transform import Transform
from tests.files import BytesRead
from tests.places import ROOT
from tests.record import samples
from tests.record.sessionfile.test_lookup import long_session
from tests.tables import table

TYPES = ROOT / "fixtures" / "paper-types.mcap"
S = 1_000_000_000
PLAN = "/igtl/out/Plan"


def seqs(entries: Any) -> list[int]:
    return [entry.seq for entry in entries]


@pytest.mark.parametrize(
    ("side", "kinds"),
    [
        ("igtl", {Kind.IGTL_OUT}),
        ("ros", {Kind.ROS_OUT, Kind.ROS_IN}),
        ("both", {Kind.IGTL_OUT, Kind.ROS_OUT, Kind.ROS_IN}),
    ],
)
def test_each_side_gets_what_it_heard_that_day(side: str, kinds: set[Kind]) -> None:
    with SessionFile.open(TYPES) as file:
        how = plan_replay(file, side, recompute=False)
        assert set(how.kinds) == kinds and not how.recompute
        assert plan_replay(file, side, recompute=True).recompute
        found = seqs(planned_entries(file, Config(), how, []))
        assert found == sorted(found) and found


@table("glob", ["Foo", "TRANSFORM/Foo", "/nothing/**"])
@table("side", ["igtl", "ros", "both"])
def test_streams_that_are_not_there_are_refused_before_anybody_waits(side: str, glob: str) -> None:
    with SessionFile.open(TYPES) as file:
        how = plan_replay(file, side, recompute=False)
        with pytest.raises(ConfigError, match=re.escape(f"--streams: found '{glob}', expected one of these streams: ")):
            check_streams(file, Config(), how, [glob])
        assert check_streams(file, Config(), how, []) == []
        assert check_streams(file, Config(), how, ["**"]) == []
        assert [each.partition(": ")[0] for each in check_streams(file, Config(), how, ["**", glob])] == [glob]
        computed = plan_replay(file, side, recompute=True)
        with pytest.raises(ConfigError, match=re.escape(f"--streams: found '{glob}', expected one of these streams: ")):
            check_streams(file, config_to_run(file.session), computed, [glob])
        assert check_streams(file, config_to_run(file.session), computed, ["**", glob]) == []  # known too late


def plus_like(path: Path, received: str = "TRANSFORM") -> Path:
    """A session with PlusServer, which the gateway pings, and without a robot."""
    gateway = ManualGateway(profile="plus")
    content: Any = Transform((1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 5.0, 0.0, 0.0))
    for _ in range(5):
        gateway.from_peer(Message(received, "ProbeToTracker", content if received == "TRANSFORM" else EmptyQuery(), 1))
        gateway.advance(10)
    assert {sent.stream for sent in gateway.outputs.igtl()} >= {"GET_STATUS/"}
    gateway.save(path)
    return path


def test_queries_of_the_gateway_do_not_count_as_what_it_sent(tmp_path: Path) -> None:
    with SessionFile.open(plus_like(tmp_path / "plus.mcap")) as file:
        how = plan_replay(file, "igtl", recompute=False)
        assert how.kinds == {Kind.IGTL_IN} and "only GET_STATUS was sent to peers" in how.why
        assert {entry.type for entry in planned_entries(file, Config(), how, [])} == {"TRANSFORM"}


def test_who_only_asks_gets_what_was_sent_to_it(tmp_path: Path) -> None:
    """A recording in which no program sends data has no better side."""
    with SessionFile.open(plus_like(tmp_path / "asked.mcap", received="GET_TRANS")) as file:
        assert plan_replay(file, "igtl", recompute=False).kinds == {Kind.IGTL_OUT}


@table(
    "to, side, kinds",
    [
        ("igtl", "peers", {Kind.IGTL_IN}),
        ("igtl", "gateway", {Kind.IGTL_OUT}),
        ("igtl", "both", {Kind.IGTL_IN, Kind.IGTL_OUT}),
        ("ros", "peers", {Kind.ROS_IN}),
        ("ros", "gateway", {Kind.ROS_OUT}),
        ("ros", "both", {Kind.ROS_IN, Kind.ROS_OUT}),
        ("both", "peers", {Kind.IGTL_IN, Kind.ROS_IN}),
        ("both", "gateway", {Kind.IGTL_OUT, Kind.ROS_OUT}),
        ("both", "both", {Kind.IGTL_IN, Kind.IGTL_OUT, Kind.ROS_IN, Kind.ROS_OUT}),
    ],
)
def test_whose_messages_are_sent_can_be_chosen(to: str, side: Side, kinds: set[Kind]) -> None:
    with SessionFile.open(TYPES) as file:
        how = plan_replay(file, to, recompute=False, side=side)
        assert how.kinds == kinds and not how.recompute
        assert {entry.kind for entry in planned_entries(file, Config(), how, [])} <= kinds


def test_a_name_with_a_mistake_has_a_near_one() -> None:
    with SessionFile.open(TYPES) as file:
        for to, glob, near in (("igtl", "Greetin", "STRING/Greeting"), ("ros", "/igtl/out/Clou", "/igtl/out/Cloud")):
            how = plan_replay(file, to, recompute=False)
            with pytest.raises(ConfigError, match=f"did you mean '{near}'"):
                check_streams(file, Config(), how, [glob])
            assert near in check_streams(file, Config(), how, ["**", glob])[0]


def test_a_stream_that_only_this_version_computes_is_there() -> None:
    with SessionFile.open(TYPES) as file:
        config = with_sends(config_to_run(file.session), ["/igtl/out/Greeting=New"])
        assert check_streams(file, config, plan_replay(file, "igtl", recompute=True), ["*/New"]) == []


@table(
    "sends, recompute, error",
    [
        (["/igtl/out/Plan"], False, "--send: found recorded outputs, expected --through-gateway"),
        (["/nothing=A"], True, "--send: found '/nothing=A', expected a topic that ROS nodes sent: /igtl/out/"),
    ],
)
def test_a_row_to_send_without_effect_is_refused(sends: list[str], recompute: bool, error: str) -> None:
    with SessionFile.open(TYPES) as file, pytest.raises(ConfigError, match=re.escape(error)):
        check_sends(file, plan_replay(file, "igtl", recompute), sends)


def test_both_sides_are_the_two_sides() -> None:
    with SessionFile.open(TYPES) as file:
        igtl, ros, both = (
            seqs(planned_entries(file, Config(), plan_replay(file, side, False), []))
            for side in ("igtl", "ros", "both")
        )
    assert both == sorted(igtl + ros)


def test_a_part_begins_with_the_latched_topics_of_the_file() -> None:
    with SessionFile.open(TYPES) as file:
        how, start_ns = plan_replay(file, "ros", False), file.start_ns + 2 * S
        latched = {channel.topic for channel in file.channels if channel.qos and channel.qos.latched}
        found = list(planned_entries(file, Config(), how, [], start_ns, start_ns + S // 2))
        before = [entry for entry in planned_entries(file, Config(), how, []) if entry.stamp_ns < start_ns]
    state = [entry for entry in found if entry.stamp_ns < start_ns]
    assert {entry.channel for entry in before} & latched <= {entry.channel for entry in state}
    assert "/igtl/in/Device/status" in {entry.channel for entry in state}, "not latched in ROS, but a STATUS caused it"
    assert not {"/tf", "/igtl/in/Grey/image"} & {entry.channel for entry in state}
    assert len({entry.channel for entry in state}) == len(state)
    assert all(start_ns <= entry.stamp_ns <= start_ns + S // 2 for entry in found[len(state) :])


@pytest.mark.parametrize("name", ["paper-types", "star", "every-type"])
def test_entries_of_some_kinds_tell_of_the_inputs_between_them(name: str) -> None:
    with SessionFile.open(TYPES.with_stem(name)) as file:
        wanted = frozenset({Kind.IGTL_OUT, Kind.IGTL_IN})
        few, every = list(file.entries_of_kinds(wanted)), list(file.entries())
    assert [entry for entry in few if entry.kind in wanted] == [entry for entry in every if entry.kind in wanted]

    def caused(entries: list[Entry]) -> list[bool]:
        """Of each of those entries, whether an input came since the one before."""
        came, told = False, []
        for entry in entries:
            came |= entry.kind.is_input
            if entry.kind in wanted:
                told.append(came)
                came = False
        return told

    assert caused(few) == caused(every)


def split(folder: Path) -> list[Path]:
    """A plan once, latched, and ten seconds of talk, in parts of two seconds."""
    gateway = Session(Gateway(Config()))
    up = Note(Level.INFO, LINK_UP, "a peer", data={"address": "127.0.0.1:1"}).pack()
    entries = gateway.input(samples.START_NS, Kind.LINK, (up,), links=(1,))
    for number in range(10):
        entries += gateway.input(
            samples.START_NS + number * S + 1000,
            Kind.ROS_IN,
            (samples.string_cdr(f"message {number}"),),
            channel=PLAN if number == 0 else "/igtl/out/Chat",
            type_name="std_msgs/msg/String",
        )
    recorder = Recorder(
        folder / "long.mcap",
        samples.SESSION,
        qos_of=lambda topic, _: Qos(latched=topic == PLAN),
        on_note=lambda note: pytest.fail(note.text),
        clock=ManualClock(),
        host=in_thread,
        options=RecordOptions(split_s=2.0),
        rule=StateInputRule(frozenset({LINKS_TOPIC, PLAN})),
    )
    for entry in entries:
        recorder(entry)
    return [file for file in recorder.close({"streams": {}}).files if file.suffix == ".mcap"]


def test_a_file_that_begins_midway_goes_through_the_gateway_behind_its_prologue(tmp_path: Path) -> None:
    *_, last = split(tmp_path)
    with SessionFile.open(last) as file:
        assert file.prologue()
        said = list(planned_entries(file, Config(), plan_replay(file, "igtl", False), []))
        again = list(planned_entries(file, Config(), plan_replay(file, "igtl", True), [], file.start_ns))
    assert said and [entry.data() for entry in again[-len(said) :]] == [entry.data() for entry in said]


class Edge:
    """Both edges: what they were asked for, and acknowledgements that come at the third look."""

    def __init__(self) -> None:
        self.asked: list[str] = []

    def links(self) -> list[Any]:
        return []

    def send(self, links: list[int], _payload: Any, stream: str, keep: bool) -> None:
        assert (links, keep) == ([], True)
        self.asked.append(f"send {stream}")

    def publish(self, topic: str, _type: str, _data: bytes, qos: Qos) -> None:
        self.asked.append(f"publish {topic} {qos.depth}")

    def flush(self, _timeout_s: float) -> bool:
        return self._look("flush")

    def wait_acked(self, topic: str, _timeout_s: float) -> bool:
        return self._look(f"acked {topic}")

    def _look(self, what: str) -> bool:
        self.asked.append(what)
        return self.asked.count(what) == 3


def test_in_lock_step_each_message_is_waited_for() -> None:
    igtl, ros = Entry(1, 1, Kind.IGTL_OUT, "STRING/A"), Entry(2, 2, Kind.ROS_IN, "/tf")
    for stop, waits in ((None, 0), (threading.Event(), 3)):
        edge: Any = Edge()
        with SessionFile.open(TYPES) as file:
            send = both_sender(igtl_sender(edge, Listeners(exact=True), stop), ros_sender(edge, file, stop))
        assert [send(igtl), send(ros)] == [False, True]
        assert edge.asked == ["send STRING/A", *["flush"] * waits, "publish /tf 100", *["acked /tf"] * waits]


def test_a_stop_ends_the_wait_for_acknowledgements() -> None:
    stop, edge = threading.Event(), Edge()
    stop.set()
    igtl_sender(edge, Listeners(exact=True), stop)(Entry(1, 1, Kind.IGTL_OUT, "STRING/A"))  # type: ignore[arg-type]
    assert edge.asked == ["send STRING/A"]


def test_a_start_near_the_end_does_not_read_the_file_from_its_beginning(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    entries = long_session(20_000)
    path = tmp_path / "long.mcap"
    latched = Qos(latched=True)
    writer = SessionWriter(
        path, {}, qos_of=lambda topic, _type: latched if topic == "/plan" else None, chunk_bytes=20_000
    )
    for entry in entries:
        writer.write(entry)
    writer.close({})
    size = path.stat().st_size
    read = BytesRead(monkeypatch)
    with SessionFile.open(path) as file:
        how = plan_replay(file, "igtl", recompute=False)
        found = list(planned_entries(file, Config(), how, [], file.end_ns - 1_000))
    assert found[0].type == "STRING" and found[1].seq > entries[-200].seq
    # the summary with its index, one chunk with the latched message, and the last two chunks
    assert read.count < size / 5
