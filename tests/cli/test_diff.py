"""``diff`` on the command line: exit codes, a table for people, JSON for programs, any MCAP file."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from mcap.writer import Writer

from igtl_gateway.cli import main
from igtl_gateway.convert.rosmsg import String
from igtl_gateway.gateway.log.entry import Entry
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.record.sessionfile.writer import SessionWriter
from tests.places import FIXTURES

TYPES = FIXTURES / "paper-types.mcap"


def copy(path: Path, change: Callable[[Entry], Entry | None]) -> Path:
    with SessionFile.open(TYPES) as file:
        writer = SessionWriter(path, file.session)
        for entry in map(change, file.entries()):
            if entry:
                writer.write(entry)
        writer.close({})
    return path


def test_equal_recordings_exit_0(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["diff", str(TYPES), str(TYPES)]) == 0
    told = capsys.readouterr().out
    assert "TRANSFORM/ToolToBase" in told and told.endswith("equal\n")


def test_differences_exit_1_and_are_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def change(entry: Entry) -> Entry | None:
        if entry.channel == "STRING/Greeting":
            return None
        if entry.channel == "/igtl/in/ProbeToTracker/transform":
            data = bytearray(entry.data())
            data[-50] ^= 0x10  # in the translation
            return replace(entry, payload=(bytes(data),))
        return entry

    other = copy(tmp_path / "other.mcap", change)
    assert main(["diff", str(TYPES), str(other)]) == 1
    told = capsys.readouterr().out
    assert "DIFFERENT: 3 streams" in told
    assert "transform is" in told and " mm" in told and "missing" in told
    assert main(["diff", str(TYPES), str(other), "--json"]) == 1
    facts = json.loads(capsys.readouterr().out)
    streams = {(one["kind"], one["stream"]): one for one in facts["streams"]}
    assert streams["igtl_out", "STRING/Greeting"]["missing"] == streams["igtl_out", "STRING/Greeting"]["messages"] > 0
    pose = streams["ros_out", "/igtl/in/ProbeToTracker/transform"]
    assert pose["different"] == 1 and pose["mm"] > 0 and pose["first"]["delta"]["field"] == "transform"
    assert main(["diff", str(TYPES), str(other), "--tolerance-mm", str(pose["mm"] * 2), "--streams", "/igtl/**"]) == 0


def test_a_rosbag2_file_is_compared_too(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The same ROS messages, recorded by another program."""
    bag = tmp_path / "bag.mcap"
    with SessionFile.open(TYPES) as file, bag.open("wb") as stream:
        writer = Writer(stream)
        writer.start("ros2", "another")
        channels: dict[str, int] = {}
        for entry in file.entries():
            if not entry.channel.startswith("/"):
                continue
            if entry.channel not in channels:
                text = file.definitions[entry.type].encode()
                schema = writer.register_schema(entry.type, "ros2msg", text)
                channels[entry.channel] = writer.register_channel(entry.channel, "cdr", schema)
            stamp_ns = entry.stamp_ns + 7_000_000_000
            writer.add_message(channels[entry.channel], stamp_ns, entry.data(), entry.source_ns or stamp_ns)
        writer.finish()  # type: ignore[no-untyped-call]
    assert main(["diff", str(TYPES), str(bag)]) == 0
    assert "7 s later" in capsys.readouterr().out
    assert main(["diff", str(bag), str(bag)]) == 0


@pytest.mark.parametrize("options", [["--tolerance-mm", "-1"], ["--tolerance-deg", "nan"]])
def test_a_tolerance_that_is_none_is_refused(options: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["diff", str(TYPES), str(TYPES), *options]) == 2
    assert options[0] in capsys.readouterr().err


def test_what_is_no_recording_is_usage(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["diff", str(TYPES), str(tmp_path / "nothing.mcap")]) == 2
    assert "nothing.mcap" in capsys.readouterr().err


def test_a_topic_that_cannot_be_read_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "mixed.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start(profile="ros2")
        text = writer.register_channel("/text", "cdr", writer.register_schema(String.TYPE, "ros2msg", b"string data"))
        data = writer.register_channel("/data", "json", writer.register_schema("x.Data", "jsonschema", b"{}"))
        writer.add_message(text, 10**18, String("a").pack(), 10**18)
        writer.add_message(data, 10**18 + 1, b"{}", 10**18 + 1)
        writer.finish()  # type: ignore[no-untyped-call]
    assert main(["diff", str(path), str(path)]) == 0
    said = capsys.readouterr().out
    assert said.count("mixed.mcap: /data: 1 message, found encoding 'json', expected 'cdr'") == 2
    assert said.endswith("what is compared is equal\n")
    assert main(["diff", str(path), str(path), "--streams", "/text"]) == 0
    assert capsys.readouterr().out.endswith("\nequal\n")
