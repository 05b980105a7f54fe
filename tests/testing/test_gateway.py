"""The gateway on manual time, as in a test of a user."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from igtl_gateway.base.errors import ConfigError
from igtl_gateway.base.stamp import NS_PER_S
from igtl_gateway.config.configuration import Config
from igtl_gateway.convert.rosmsg import Header, String, TransformStamped
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.replay.verify import verify
from igtl_gateway.testing.gateway import START_NS, ManualGateway, unpack
from igtl_gateway.wire import Message, encode
from igtl_gateway.wire.command import Command
from igtl_gateway.wire.text import String as IgtlString
from igtl_gateway.wire.transform import Transform
from tests.places import FIXTURES

POSE = TransformStamped(Header(START_NS, "base"), "tool", (0.1, 0.2, 0.3), (0.0, 0.0, 0.0, 1.0))
HELLO = Message("STRING", "Greeting", IgtlString.of("hello"))


def test_a_ros_message_is_sent_to_all_peers_in_millimetres() -> None:
    gateway = ManualGateway()
    links = (gateway.connect(), gateway.connect())
    (sent,) = gateway.from_ros("/igtl/out/ToolToBase", POSE).igtl()
    assert (sent.stream, sent.links) == ("TRANSFORM/ToolToBase", links)
    assert isinstance(sent.message.content, Transform)
    assert sent.message.content.wire_matrix[9:] == pytest.approx((100.0, 200.0, 300.0))


def test_a_peer_sends_a_message_or_its_bytes() -> None:
    gateway = ManualGateway()
    for message in (HELLO, b"".join(encode(HELLO))):
        (published,) = gateway.from_peer(message).ros("/igtl/in/**")
        assert (published.topic, published.message) == ("/igtl/in/Greeting/string", String("hello"))
    assert len(gateway.outputs.ros("/igtl/in/*/string")) == 2
    (again,) = gateway.from_ros("/igtl/out/Echo", published.cdr, published.type).igtl("STRING/*")
    assert again.message.content == HELLO.content


def test_an_invalid_message_is_noted() -> None:
    data = b"".join(encode(HELLO))
    outputs = ManualGateway().from_peer(data[:50] + bytes(8) + data[58:])
    assert not outputs.ros("/igtl/in/**")
    assert [note.stream for note in outputs.notes("bad_crc")] == ["STRING/Greeting"]


def test_advance_runs_timeouts_when_they_are_due() -> None:
    gateway = ManualGateway(command_timeout_s=2.0)
    gateway.from_peer(Message("COMMAND", "Robot", Command.of(7, "Start", "<Command/>")))
    assert gateway.advance(1.9).entries == []
    (reply,) = gateway.advance(10.0).igtl("RTS_COMMAND/*")
    assert isinstance(reply.message.content, Command)
    assert reply.message.content.command_id == 7
    assert gateway.now_ns == START_NS + round(11.9 * NS_PER_S)
    (sent,) = [entry for entry in gateway.log if entry.type == "RTS_COMMAND"]
    assert sent.stamp_ns - START_NS == pytest.approx(2.0 * NS_PER_S, abs=1000)


def test_settings_by_name_by_file_and_by_value(tmp_path: Path) -> None:
    path = tmp_path / "lab.toml"
    path.write_text('[gateway]\nros_unit = "mm"\n')
    for gateway in (ManualGateway(ros_unit="mm"), ManualGateway(path), ManualGateway(Config(ros_unit="mm"))):
        assert gateway.config == Config(ros_unit="mm")
    assert ManualGateway(path, base_frame="map").config == Config(ros_unit="mm", base_frame="map")
    with pytest.raises(ConfigError, match=r"gateway\.ros_unit"):
        ManualGateway(ros_unit="inch")


def test_a_disconnected_peer_receives_nothing() -> None:
    gateway = ManualGateway()
    gateway.disconnect(gateway.connect())
    assert gateway.from_ros("/igtl/out/Tool", POSE).igtl() == []


def test_the_inputs_of_a_recording_cause_the_recorded_outputs() -> None:
    path = FIXTURES / "paper-types.mcap"
    with SessionFile.open(path) as file:
        recorded = list(file.entries())
    gateway = ManualGateway(path)
    gateway.play(path)
    assert [(entry.stamp_ns, entry.data()) for entry in gateway.log] == [(e.stamp_ns, e.data()) for e in recorded]
    star = FIXTURES / "star.mcap"
    chosen = ManualGateway(star).play(star, streams=("/star/status",))
    assert {sent.stream for sent in chosen.igtl()} == {"STRING/StarStatus"}


def test_a_saved_session_is_a_recording_that_verifies(tmp_path: Path) -> None:
    gateway = ManualGateway(publish_tf=False)
    gateway.connect()
    gateway.from_peer(HELLO)
    gateway.from_ros("/igtl/out/ToolToBase", POSE)
    path = tmp_path / "golden.mcap"
    gateway.save(path)
    with SessionFile.open(path) as file:
        report = verify(file.entries(), gateway.config)
        assert file.session["config"]
    assert report.good
    assert report.equal == len(gateway.outputs.entries) > 0


def test_a_recording_with_a_prologue_starts_with_its_state(tmp_path: Path) -> None:
    class Midway(SessionFile):
        """The second half of a recording, after the begin of the link."""

        def prologue(self) -> list[Entry]:
            return [entry for entry in super().entries() if entry.kind is Kind.LINK]

        def entries(self, *, computed: bool = True) -> Iterator[Entry]:
            return (entry for entry in super().entries() if entry.kind is Kind.ROS_IN)

    gateway = ManualGateway()
    gateway.connect()
    gateway.from_ros("/igtl/out/ToolToBase", POSE)
    gateway.save(tmp_path / "whole.mcap")
    again = ManualGateway()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("igtl_gateway.testing.gateway.SessionFile", Midway)
        outputs = again.play(tmp_path / "whole.mcap")
    assert [sent.stream for sent in outputs.igtl()] == ["TRANSFORM/ToolToBase"]
    assert not [entry for entry in again.log if entry.kind is Kind.LINK]


def test_a_type_is_decoded_and_an_unknown_one_is_an_error() -> None:
    assert unpack("std_msgs/msg/String", String("hello").pack()) == String("hello")
    with pytest.raises(ConfigError, match="found a message of type my_msgs/msg/Own"):
        unpack("my_msgs/msg/Own", b"")
