"""Settings that change while a session runs: inputs of the log, from whose entry on they apply."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import pytest

from igtl_gateway.base.buffers import join
from igtl_gateway.base.errors import ConfigError
from igtl_gateway.base.qos import Qos
from igtl_gateway.base.stamp import NS_PER_S, ns_to_ticks
from igtl_gateway.config.configuration import Config, ToIgtlRow, ToRosRow
from igtl_gateway.convert.igtl_msgs import Command as RosCommand
from igtl_gateway.convert.igtl_msgs import CommandReply
from igtl_gateway.convert.raw import raw_message
from igtl_gateway.convert.rosmsg import Header, String, TransformStamped
from igtl_gateway.gateway.live_settings import LiveSettings
from igtl_gateway.gateway.log.changes import SETTING, SETTINGS, is_change
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.note import Level, Note
from igtl_gateway.replay.slice import Slice
from igtl_gateway.replay.slice_state import SliceWindow
from igtl_gateway.replay.verify import verify
from igtl_gateway.wire import Message, encode
from igtl_gateway.wire.command import Command
from igtl_gateway.wire.query import EmptyQuery
from igtl_gateway.wire.text import Status
from igtl_gateway.wire.text import String as StringBody
from igtl_gateway.wire.transform import Transform
from tests.gateway.test_relay import Relay
from tests.script import Script

POSE = Message("TRANSFORM", "Probe", Transform((1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 1.0, 2.0, 3.0)))
TEXT = Message("STRING", "Words", StringBody.of("text"))
TOOL = TransformStamped(Header(0, "base"), "tool", (0.1, 0.2, 0.3), (0.0, 0.0, 0.0, 1.0))
TOPIC = "/igtl/out/Tool"
TO_ROS = ["ros /igtl/in/Probe/transform"]
TO_IGTL = ["igtl TRANSFORM/Tool v1 to 1"]


class Changing(Script):
    """A script whose settings change."""

    def __init__(self, config: Config | None = None) -> None:
        super().__init__(config)
        self.config = self.gateway.config
        self.settings = LiveSettings.of(self.config)

    def change(self, **changes: Any) -> list[str]:
        before, self.settings = self.settings, self.settings.changed(changes)
        return self.feed(Kind.EDGE_NOTE, (self.settings.note(before).pack(),))

    def check(self) -> None:
        """Check that the log verifies, as a whole and from each of its seconds on."""
        assert verify(self.log, self.config).good
        for start in range(0, len(self.log), 3):
            part = Slice(lambda: self.log, self.config, SliceWindow(self.log[start].stamp_ns, self.now_ns + NS_PER_S))
            assert part.report.differing == 0
            assert verify(part.entries(), self.config).good


def test_types_are_denied_from_the_change_on() -> None:
    script = Changing()
    script.up(1)
    for _ in range(3):  # by the fast path, too
        assert script.igtl(POSE) == TO_ROS
        assert script.ros(TOPIC, TOOL) == TO_IGTL
    assert script.change(deny_in=["TRANSFORM"]) == []
    assert script.igtl(POSE) == ["note denied"]
    assert script.ros(TOPIC, TOOL) == TO_IGTL
    script.change(deny_in=[], deny_out=["TRANSFORM"])
    assert script.igtl(POSE) == TO_ROS
    assert script.ros(TOPIC, TOOL) == ["note denied"]
    script.change(deny_out=[])
    assert script.ros(TOPIC, TOOL) == TO_IGTL
    script.check()


def test_the_maximum_age_of_rows_without_their_own_changes() -> None:
    rows = (ToRosRow(device="Own", max_age_s=5.0), ToRosRow(device="Any", max_age_s=0.0), ToRosRow())
    script = Changing(Config(to_ros=rows, watch=True))
    script.up(1)

    def aged(device: str, age_s: float) -> list[str]:
        ticks = ns_to_ticks(script.now_ns - round(age_s * NS_PER_S))
        return script.igtl(replace(POSE, device_name=device, ticks=ticks))

    def all_pass(age_s: float) -> list[bool]:
        return [f"ros /igtl/in/{device}/transform" in aged(device, age_s) for device in ("Own", "Any", "Probe")]

    assert all_pass(1.0) == [True, True, True]
    assert all_pass(1.0) == [True, True, True]
    script.change(max_age_s=0.5)
    assert all_pass(1.0) == [True, True, False]
    assert aged("Probe", 1.0) == []
    script.change(max_age_s=0)
    assert aged("Probe", 1.0) == [*TO_ROS, "note fresh"]
    script.change(max_age_s=0.5)
    assert aged("Probe", 0.1) == TO_ROS
    assert all_pass(9.0) == [False, True, False]
    script.check()


def test_kinds_of_rows_without_their_own_change() -> None:
    script = Changing(Config(to_ros=(ToRosRow(device="Own", kinds=("transform",)),)))
    script.up(1)
    assert script.igtl(TEXT) == ["ros /igtl/in/Words/string"]
    assert script.change(kinds=["transform"]) == []
    assert script.igtl(POSE) == TO_ROS
    assert [entry.channel for entry in script.last if entry.kind is Kind.ROS_OUT] == ["/igtl/in/Probe/transform"]
    assert script.igtl(TEXT) == []
    script.change(kinds=[])
    assert script.igtl(TEXT) == ["ros /igtl/in/Words/string"]
    script.check()


def test_a_gateway_that_is_not_active_refuses_all_messages() -> None:
    script = Changing()
    script.up(1)
    script.igtl(POSE)
    script.ros(TOPIC, TOOL)
    assert script.change(active=False) == []
    for number in range(3):
        for message in (POSE, TEXT):
            assert script.igtl(message) == ([] if number else ["note inactive"])
        assert script.ros(TOPIC, TOOL) == ([] if number else ["note inactive"])
    assert script.change(active=True) == ["note active"]
    assert script.notes[-1].text == "9 messages were refused while the gateway was not active"
    assert script.igtl(POSE) == TO_ROS
    assert script.ros(TOPIC, TOOL) == TO_IGTL
    script.change(active=False)
    assert script.igtl(POSE) == ["note inactive"], "once each time"
    ledger = script.gateway.ledger.to_dict()
    assert ledger["igtl_in"]["TRANSFORM/Probe"]["dropped"] == {"inactive": 4}
    assert ledger["ros_in"][TOPIC]["dropped"] == {"inactive": 3}
    script.check()


def test_who_waits_for_a_reply_gets_one_from_a_gateway_that_is_not_active() -> None:
    script = Changing()
    script.up(1)
    script.change(active=False)
    assert script.igtl(Message("COMMAND", "Robot", Command(7, "Move", b"<x/>"), 0, 2)) == [
        "note inactive",
        "igtl RTS_COMMAND/Robot v2 to 1",
    ]
    assert isinstance(script.sent()[0].content, Command)
    assert script.igtl(Message("GET_TRANS", "Tool", EmptyQuery(), 0, 2)) == [
        "note inactive",
        "igtl STATUS/Tool v2 to 1",
    ]
    (answer,) = script.sent()
    assert isinstance(answer.content, Status) and "not active" in str(answer.content)
    command = RosCommand(Header(0), "Robot", 3, "Move", 3, "<x/>")
    script.ros("/igtl/out/Robot", command)
    reply = CommandReply.unpack(script.published("/igtl/in/Robot/command_reply"))
    assert reply.status == CommandReply.FAIL and "not active" in reply.error_message
    raw = raw_message(join(encode(POSE)), 0, 1)
    assert script.ros("/igtl/out/raw", raw) == ["note inactive"]
    script.check()


def test_a_gateway_that_becomes_active_sends_what_is_latched() -> None:
    script = Changing(Config(to_igtl=(ToIgtlRow(topic="/plan", qos=Qos(latched=True)), ToIgtlRow())))
    script.up(1)
    assert script.ros("/plan", String("first")) == ["igtl STRING/plan v1 to 1"]
    script.change(active=False)
    assert script.up(2) == []
    assert script.ros("/plan", String("second")) == ["note inactive"]
    assert script.change(active=True) == ["note active", "igtl STRING/plan v1 to 1", "igtl STRING/plan v1 to 2"]
    assert [message.content for message in script.sent()] == [StringBody.of("second")] * 2
    script.check()


def test_a_relay_changes_its_deny_lists_and_refuses_messages() -> None:
    relay = Relay(Config(relay=True))
    relay.pair(1, 2)
    settings = LiveSettings()

    def change(**changes: Any) -> list[str]:
        nonlocal settings
        before, settings = settings, settings.changed(changes)
        return codes(relay.feed(Kind.EDGE_NOTE, settings.note(before).pack(), 0))

    def codes(outputs: list[Entry]) -> list[str]:
        return [Note.unpack(one.data()).code if one.kind is Kind.NOTE else one.channel for one in outputs]

    def status() -> list[str]:
        return codes(relay.igtl(join(encode(Message("STATUS", "Robot", Status(1)))), 1))

    assert status() == ["STATUS/Robot"]
    assert change(deny_in=["STATUS"]) == []
    assert status() == ["denied"]
    assert change(deny_in=[], active=False) == []
    assert status() == ["inactive"]
    assert status() == []
    assert change(active=True) == ["active"]
    assert status() == ["STATUS/Robot"]


@pytest.mark.parametrize(
    "change, text",
    [
        ({"port": 1}, "gateway.port: unknown setting, expected one of deny_in, deny_out, kinds, max_age_s, active"),
        ({"active": 1}, "gateway.active: found 1, expected true or false"),
        ({"max_age_s": "x"}, "gateway.max_age_s: found 'x', expected a number"),
        ({"max_age_s": -1}, "gateway.max_age_s: found -1, expected 0 to 31536000"),
        ({"deny_in": ["a b"]}, "gateway.deny_in: found 'a b', expected a type or a glob such as COMMAND, GET_*"),
        ({"kinds": ["+slice"]}, "gateway.kinds: found '+slice', expected one of array, bind"),
    ],
)
def test_what_cannot_be_set_is_named_in_one_line(change: dict[str, Any], text: str) -> None:
    with pytest.raises(ConfigError) as caught:
        LiveSettings().changed(change)
    assert str(caught.value).startswith(text) and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "data",
    [{}, {SETTINGS: []}, {SETTINGS: {"active": "no"}}, {SETTINGS: {"x": 1}}, {SETTINGS: {"max_age_s": float("inf")}}],
)
def test_a_note_of_a_damaged_file_changes_nothing(data: dict[str, Any]) -> None:
    note = Note(Level.INFO, SETTING, "changed", data=data)
    assert LiveSettings.from_note(note) is None
    script = Changing()
    script.up(1)
    assert script.feed(Kind.EDGE_NOTE, (note.pack(),)) == []
    assert script.igtl(POSE) == TO_ROS


def test_a_note_has_all_settings_that_can_change() -> None:
    settings = LiveSettings().changed({"deny_in": ["COMMAND"], "max_age_s": 1})
    note = settings.note(LiveSettings())
    assert note.text == 'changed: deny_in from [] to ["COMMAND"], max_age_s from 0.0 to 1.0'
    assert json.loads(note.pack())["data"] == {
        "settings": {"active": True, "deny_in": ["COMMAND"], "deny_out": [], "kinds": [], "max_age_s": 1.0}
    }
    entry = Entry(1, 1, Kind.EDGE_NOTE, payload=(note.pack(),))
    assert is_change(entry) and LiveSettings.from_note(Note.unpack(entry.data())) == settings
    other = Note(Level.INFO, "other", "setting")
    assert not is_change(Entry(1, 1, Kind.EDGE_NOTE, payload=(other.pack(),)))
