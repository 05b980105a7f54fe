"""A part and a snapshot for readers: static frames, the robot and plans from before it are in it."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from rosbags.rosbag2 import Reader

import igtl_gateway
from igtl_gateway.base.clock import ManualClock
from igtl_gateway.base.errors import ConfigError
from igtl_gateway.base.qos import Qos
from igtl_gateway.cli import main
from igtl_gateway.config.configuration import Config
from igtl_gateway.convert import rosmsg
from igtl_gateway.convert.common_msgs import FrameTransform, TFMessage
from igtl_gateway.gateway import LINKS_TOPIC
from igtl_gateway.gateway.log.entry import Kind
from igtl_gateway.gateway.log.note import Note
from igtl_gateway.record.host import in_thread
from igtl_gateway.record.options import RecordOptions
from igtl_gateway.record.recorder import Recorder
from igtl_gateway.record.selection import StateInputRule
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.record.sessionfile.with_state import SessionWithState
from igtl_gateway.record.sessionfile.writer import SessionWriter
from igtl_gateway.replay.shared_names import shared_names
from igtl_gateway.replay.source import _ANY_LINK
from igtl_gateway.replay.state_before import LASTING, _before, latched_before, notes_before, with_state, without_state
from igtl_gateway.testing.gateway import ManualGateway
from igtl_gateway.wire import Message
from igtl_gateway.wire.text import Status
from igtl_gateway.wire.transform import Transform
from tests.record import samples
from tools.note_codes import NOTES

ROBOT = "/robot_description"
URDF = "<robot name='arm'/>"


def tf_of(parent: str, child: str, x_m: float, stamp_ns: int) -> TFMessage:
    pose = (x_m, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
    return TFMessage((FrameTransform(rosmsg.Header(stamp_ns, parent), child, pose),))


def parts(folder: Path) -> list[Path]:
    """Parts of two seconds: state in the first second, then ten seconds of motion below the static frame."""
    gateway = ManualGateway(start_ns=samples.START_NS)
    gateway.from_ros("/tf_static", tf_of("world", "base", 1.0, gateway.now_ns))
    gateway.from_ros(ROBOT, rosmsg.String(URDF))
    gateway.from_peer(Message("STATUS", "Navigation", Status(1, message="ready"), 0))
    for number in range(10):
        gateway.advance(1)
        gateway.from_ros("/tf", tf_of("base", "tip", 0.1 * number, gateway.now_ns))
        matrix = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, float(number), 0.0, 0.0)
        gateway.from_peer(Message("TRANSFORM", "PenToTable", Transform(matrix), 0))
    recorder = Recorder(
        folder / "long.mcap",
        samples.SESSION,
        qos_of=lambda topic, _: Qos(latched=topic in ("/tf_static", ROBOT)),
        on_note=lambda note: pytest.fail(note.text),
        clock=ManualClock(),
        host=in_thread,
        options=RecordOptions(split_s=2.0),
        rule=StateInputRule(frozenset({LINKS_TOPIC})),
    )
    for entry in gateway.log:
        recorder(entry)
    return [file for file in recorder.close({"streams": {}}).files if file.suffix == ".mcap"]


@pytest.fixture
def part(tmp_path: Path) -> Path:
    return parts(tmp_path)[-1]


def test_the_frames_of_a_part_have_the_static_ones(part: Path) -> None:
    with igtl_gateway.open(part) as recording:
        assert {"/tf_static", ROBOT, "STATUS/Navigation"} <= set(recording)
        assert any("were latched before" in warning for warning in recording.warnings)
        at_ns = int(recording["in:/tf"].times[-1])
        found = recording.tf.lookup("world", "tip", at_ns, unit="m")
        assert np.allclose(found[:3, 3], (1.9, 0, 0))
        assert next(iter(recording[ROBOT])).content.data == URDF
        assert recording.start_time >= int(recording["in:/tf"].times[0]) - 1_000_000_000, "it begins as the part does"


def test_a_part_of_a_recording_has_the_static_frames_before_it(tmp_path: Path) -> None:
    with igtl_gateway.open(parts(tmp_path)[0].parent) as recording:
        some = recording.between(5.0, 8.0)
        at_ns = int(some["in:/tf"].times[0])
        assert np.allclose(some.tf.lookup("world", "base", at_ns, unit="m")[:3, 3], (1, 0, 0))
        assert "/tf_static" in some and len(some["/tf_static"]) == 0


def test_what_judges_a_part_reads_the_part_alone(part: Path) -> None:
    with SessionFile.open(part) as file:
        whole = with_state(file)
        assert whole.entry_count > file.entry_count and without_state(whole) is file
        assert [entry.seq for entry in whole.entries()][-file.entry_count :] == [entry.seq for entry in file.entries()]
        assert len(list(whole.entries())) == whole.entry_count
        for channel in whole.channels:
            blocks = sum(len(block) for block in whole.blocks(channel))
            assert blocks == channel.count, channel
    assert main(["verify", str(part)]) == 0


def test_a_whole_recording_is_the_file_itself(tmp_path: Path) -> None:
    first, *_ = parts(tmp_path)
    with SessionFile.open(first) as file:
        assert with_state(file) is file
    with SessionFile.open(first.parent) as folder:
        assert with_state(folder) is folder


def test_a_bag_of_a_part_has_its_static_frames(part: Path, tmp_path: Path) -> None:
    assert main(["export", str(part), "--to", "rosbag2", "-o", str(tmp_path / "bag")]) == 0
    with Reader(tmp_path / "bag") as bag:
        topics = [connection.topic for connection, _, _ in bag.messages()]
    assert topics.count("/tf_static") == 1 and topics.count(ROBOT) == 1
    assert topics.count("/igtl/in/Navigation/status") == 1, "what the gateway made of it"


def test_what_the_gateway_made_of_latched_messages_is_there_for_the_viewer(part: Path) -> None:
    with SessionFile.open(part) as file:
        found = {(entry.kind, entry.channel) for entry in latched_before(file, Config())}
    assert (Kind.ROS_IN, "/tf_static") in found
    assert {(Kind.IGTL_IN, "STATUS/Navigation"), (Kind.ROS_OUT, "/igtl/in/Navigation/status")} <= found
    assert (Kind.ROS_IN, "/tf") not in found


def test_each_method_of_a_file_has_its_state() -> None:
    """A method that the class does not have would read attributes that only a file of its own has."""
    public = {name for name, each in vars(SessionFile).items() if callable(each) and not name.startswith("_")}
    assert public - vars(SessionWithState).keys() == set()


def part_of_two_peers(folder: Path) -> Path:
    """The last part of a session whose peers share a device from its start; one sends what is no rotation."""
    gateway = ManualGateway(start_ns=samples.START_NS)
    links = [gateway.connect(), gateway.connect()]
    for number in range(60):
        gateway.advance(0.1)
        for link in links:
            matrix = (1.0 + 0.01 * (link == links[0]), 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 100.0 * number, 0.0, 0.0)
            gateway.from_peer(Message("TRANSFORM", "Pen", Transform(matrix), 0), link)
    recorder = Recorder(
        folder / "peers.mcap",
        {"config": json.dumps(Config().to_dict())},
        qos_of=lambda *_: None,
        on_note=lambda note: pytest.fail(note.text),
        clock=ManualClock(),
        host=in_thread,
        options=RecordOptions(split_s=2.0),
        rule=StateInputRule(frozenset({LINKS_TOPIC})),
    )
    for entry in gateway.log:
        recorder(entry)
    return [file for file in recorder.close({"streams": {}}).files if file.suffix == ".mcap"][-1]


def test_notes_that_hold_until_the_end_are_there_in_a_part(tmp_path: Path) -> None:
    part = part_of_two_peers(tmp_path)
    with SessionFile.open(part) as file:
        assert not [each for each in file.entries() if each.kind is Kind.NOTE]
        assert {Note.of(entry.data()).code for entry in notes_before(file)} == {"name_shared", "not_a_rotation"}
        assert [note.code for note in shared_names(file)] == ["name_shared"]
        whole = with_state(file)
        assert [each.kind for each in whole.entries_of_kinds({Kind.NOTE})].count(Kind.NOTE) == 2
        assert len(list(whole.entries())) == whole.entry_count
        seen = [each for each in latched_before(file, Config()) if each.kind is Kind.NOTE]
        assert len(seen) == 2, "for the viewer"
    with igtl_gateway.open(part) as recording:
        assert recording.warnings == (), "no message was latched"
        assert {note.code for note in recording.notes} >= {"name_shared", "not_a_rotation"}
        with pytest.raises(ConfigError, match="found messages of several peers"):
            recording["/igtl/in/Pen/transform"].poses()
    assert main(["verify", str(part)]) == 0


def test_each_note_of_names_and_changes_is_lasting() -> None:
    """A new one is, unless it is about one message."""
    about = {**NOTES["Names"], **NOTES["Messages that are changed or not converted"]}
    assert about.keys() - LASTING == {"stream", "listened"} and about.keys() >= LASTING


@pytest.mark.parametrize("links", [(), (1,), (1, 2)])
def test_what_a_prologue_sends_goes_to_the_peers_that_it_has(links: tuple[int, ...], tmp_path: Path) -> None:
    """Without any, to one that reads header version 1: a viewer shows what would be sent."""
    gateway = ManualGateway()
    for _ in links:
        gateway.connect()
    gateway.from_ros("/igtl/out/Plan", rosmsg.String("text"))
    writer = SessionWriter(tmp_path / "a.mcap", {})
    for entry in gateway.log:
        if entry.kind.is_input:
            writer.write(entry)
    writer.close({})
    with SessionFile.open(tmp_path / "a.mcap") as before:
        sent = [entry.links for entry in _before(before, Config()) if entry.kind is Kind.IGTL_OUT]
    assert sent == [links or (_ANY_LINK,)]
