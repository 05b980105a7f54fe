"""Whole sessions: nothing that was planted is found again, the result verifies, geometry and intervals stay."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.writer import Writer

from igtl_gateway.addons.deidentify.profile import BASIC, Profile, TextRule
from igtl_gateway.addons.deidentify.pseudonyms import Pseudonyms
from igtl_gateway.addons.deidentify.session import DEIDENTIFIED, DERIVED_FROM, deidentify
from igtl_gateway.addons.merge.merging import Source, merge
from igtl_gateway.addons.merge.offsets import ClockOffset, Piece
from igtl_gateway.app.verification import verify_recording
from igtl_gateway.base.errors import UnsupportedRecording
from igtl_gateway.cli import main
from igtl_gateway.config.configuration import Config
from igtl_gateway.convert.names import short_device_name
from igtl_gateway.convert.rosmsg import String
from igtl_gateway.gateway.log.entry import Kind
from igtl_gateway.record.sessionfile.merged import Method
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.record.sessionfile.writer import SessionWriter
from igtl_gateway.replay.recorded_marks import marks_of
from igtl_gateway.testing.gateway import ManualGateway
from igtl_gateway.wire import Message, Raw, decode
from igtl_gateway.wire.header import READING
from igtl_gateway.wire.text import Status
from igtl_gateway.wire.transform import Transform
from tests import marked
from tests.addons.deidentify.planted import MARK, SOURCE, found, planted_session

KEY, OTHER = bytes(range(32)), bytes(32)


@pytest.fixture(scope="module")
def planted(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("planted") / "planted.mcap"
    planted_session(path)
    return path


def inputs(path: Path) -> list[Any]:
    with SessionFile.open(path) as file:
        return [entry for entry in file.entries() if entry.kind.is_input]


@pytest.mark.slow
def test_nothing_that_was_planted_is_found(planted: Path, tmp_path: Path) -> None:
    assert found(planted)
    out = tmp_path / "clean.mcap"
    report = deidentify(planted, out, BASIC, KEY)
    assert found(out) == []
    assert MARK not in json.dumps(report.to_dict())
    assert out.stat().st_mode & 0o777 == 0o600
    assert verify_recording(out).good
    with SessionFile.open(out) as file:
        assert "113100" in file.session[DEIDENTIFIED]
    assert not {"patient", "name", "text", "metadata", "type", "address", "note", "setting", "session", "time"} - set(
        report.rules
    )


def test_intervals_and_geometry_stay_to_the_bit(tmp_path: Path) -> None:
    out = tmp_path / "clean.mcap"
    deidentify(SOURCE, out, BASIC, KEY)
    poses, times = {}, {}
    for path in (SOURCE, out):
        entries = inputs(path)
        messages = [decode(entry.data(), reading=READING) for entry in entries if entry.type == "TRANSFORM"]
        contents = [message.content for message in messages]
        poses[path] = [content.pack() for content in contents if isinstance(content, Transform)]
        times[path] = np.array([message.ticks for message in messages], np.uint64)
    assert poses[SOURCE] == poses[out]
    assert (np.diff(times[SOURCE]) == np.diff(times[out])).all()
    assert (times[SOURCE] != times[out]).any()
    kinds = (Kind.LINK, Kind.EDGE_NOTE)
    stamps = [[entry.stamp_ns for entry in inputs(path) if entry.kind in kinds] for path in (SOURCE, out)]
    assert len(set(np.array(stamps[0]) - np.array(stamps[1][:-1]))) == 1


def test_the_key_decides_about_the_pseudonyms(tmp_path: Path) -> None:
    for name in ("acquisition", "paper-types"):
        source = SOURCE.with_name(f"{name}.mcap")
        for key in (KEY, OTHER):
            out = tmp_path / f"{name}-{key[1]}.mcap"
            deidentify(source, out, Profile(keep_types=("**",)), key)
            olds, news = (
                {entry.channel for entry in inputs(path) if entry.kind is Kind.IGTL_IN} for path in (source, out)
            )
            same, others = (Pseudonyms(each) for each in (key, bytes(31) + b"x"))
            expected = {f"{kind}/{same.name(device)}" for kind, _, device in (old.partition("/") for old in olds)}
            assert news == expected
            other = {f"{kind}/{others.name(device)}" for kind, _, device in (old.partition("/") for old in olds)}
            assert not news & other - olds
            assert len(news - olds) >= 3


@pytest.mark.parametrize("name", ["acquisition", "paper-types"])
def test_recordings_verify_and_keep_their_inputs(name: str, tmp_path: Path) -> None:
    source, out = SOURCE.with_name(f"{name}.mcap"), tmp_path / "clean.mcap"
    report = deidentify(source, out, Profile(keep_types=("**",)), KEY, shift_ns=0)
    assert len(inputs(out)) == len(inputs(source)) + 1 - sum(report.removed.values())


def test_the_command_refuses_what_it_cannot_do(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out, short = tmp_path / "out.mcap", tmp_path / "short.key"
    short.write_bytes(b"short")
    damaged = tmp_path / "damaged.mcap"
    damaged.write_bytes(SOURCE.read_bytes()[:100_000])
    for call, code, said in (
        ([str(SOURCE), "-o", str(out), "--secret", str(short)], 2, "found 5 bytes, expected at least 16"),
        ([str(SOURCE), "-o", str(out), "--shift", "0"], 2, "--shift: found 0"),
        ([str(SOURCE), "-o", str(out), "--shift", "-2000000000"], 1, "expected one from 1970 to 2106"),
        ([str(SOURCE), "-o", str(SOURCE), "--overwrite"], 2, "the recording itself"),
        ([str(SOURCE), "-o", str(damaged)], 2, "exists already"),
        ([str(damaged), "-o", str(out)], 1, "recover"),
        ([str(tmp_path / "absent.mcap"), "-o", str(out)], 2, "absent.mcap: No such file"),
    ):
        assert main(["deidentify", *call]) == code, call
        assert said in capsys.readouterr().err
    assert sorted(path.name for path in tmp_path.iterdir()) == ["damaged.mcap", "short.key"]


def test_only_a_session_is_deidentified(tmp_path: Path) -> None:
    """Not what another program wrote, and not several sessions at once."""
    foreign, merged, out = tmp_path / "bag.mcap", tmp_path / "merged.mcap", tmp_path / "out.mcap"
    with foreign.open("wb") as stream:
        writer = Writer(stream)
        writer.start("ros2", "another program")
        schema = writer.register_schema("std_msgs/msg/String", "ros2msg", b"string data")
        channel = writer.register_channel("/chatter", "cdr", schema)
        writer.add_message(channel, 1, b"\0\1\0\0\2\0\0\0a\0", 1)
        writer.finish()  # type: ignore[no-untyped-call]
    with pytest.raises(UnsupportedRecording, match=r"bag.mcap: found an MCAP file of another program, expected a ses"):
        deidentify(foreign, out, BASIC, KEY)
    sources = [Source("", SOURCE), Source("two", SOURCE.with_name("acquisition.mcap"))]
    merge(sources, merged, given={"two": ClockOffset(Method.GIVEN, (Piece(0, 0),))})
    with pytest.raises(UnsupportedRecording, match=r"found a merged session, expected one of its parts, such as .*mer"):
        deidentify(merged, out, BASIC, KEY)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["bag.mcap", "merged.mcap"]


def test_a_name_that_is_too_long_for_a_device_is_one_name_in_both_forms(tmp_path: Path) -> None:
    """A topic has all of it, a device its beginning and a hash: in the result both are of one name."""
    gateway, long = ManualGateway(), "OperatingMicroscopeOfTheatre"
    short = short_device_name(long)
    gateway.connect()
    gateway.from_ros(f"/igtl/out/{long}", String("text"))
    gateway.from_peer(Message("STATUS", short, Status(1)))
    writer = SessionWriter(tmp_path / "a.mcap", {"config": json.dumps(Config().to_dict())})
    for entry in gateway.log:
        writer.write(entry)
    writer.close({})
    deidentify(tmp_path / "a.mcap", tmp_path / "b.mcap", BASIC, KEY)
    with SessionFile.open(tmp_path / "b.mcap") as file:
        channels = {entry.channel for entry in file.entries() if entry.kind in (Kind.ROS_IN, Kind.IGTL_IN)}
    new = Pseudonyms(KEY).name(long)
    assert channels == {f"/igtl/out/{new}", f"STATUS/{new}"} and new != long


def test_removed_messages_are_counted_by_their_new_streams(tmp_path: Path) -> None:
    gateway = ManualGateway()
    gateway.connect()
    for number in range(3):
        gateway.from_peer(Message("SECRET", "Anna", Raw(b"text %d" % number)))
    gateway.from_peer(Message("STATUS", "Anna", Status(1)))
    writer = SessionWriter(tmp_path / "a.mcap", {"config": json.dumps(Config().to_dict())})
    for entry in gateway.log:
        writer.write(entry)
    writer.close({})
    report = deidentify(tmp_path / "a.mcap", tmp_path / "b.mcap", BASIC, KEY)
    new = Pseudonyms(KEY).name("Anna")
    assert report.removed == {f"(unknown type)/{new}": 3}, "the type may be any text"
    assert report.to_dict()["removed"] == {f"(unknown type)/{new}": 3} and report.rules["type"] == 3
    assert len(inputs(tmp_path / "b.mcap")) == len(inputs(tmp_path / "a.mcap")) - 3 + 1


@pytest.mark.parametrize("state", ["unsealed", "sealed", "changed"])
def test_what_is_made_of_a_sealed_recording_names_its_seal(state: str, tmp_path: Path) -> None:
    pytest.importorskip("cryptography")
    source, key = tmp_path / "a.mcap", tmp_path / "a.key"
    if state == "unsealed":
        source.write_bytes(SOURCE.read_bytes())
    else:
        assert main(["keys", "new", str(key)]) == 0
        assert main(["seal", str(SOURCE), "--key", str(key), "-o", str(source)]) == 0
    if state == "changed":
        data = bytearray(source.read_bytes())
        data[data.index(b"igtl-gateway ") + 13] ^= 1  # the version of the program, which no other checksum covers
        source.write_bytes(data)
    report = deidentify(source, tmp_path / "b.mcap", BASIC, KEY)
    with SessionFile.open(tmp_path / "b.mcap") as file:
        assert (DERIVED_FROM in file.session) is (state == "sealed")
    assert ("seal" in report.left) is (state == "changed")


def test_marks_have_pseudonyms_and_the_text_that_the_profile_leaves(tmp_path: Path) -> None:
    source = marked.write(tmp_path / "marked.mcap")
    rules = (TextRule("mark/slip", "keep"),)
    deidentify(source, tmp_path / "clean.mcap", Profile(names={"rest": "pause"}, text_rules=rules), KEY)
    assert verify_recording(tmp_path / "clean.mcap").good
    with SessionFile.open(tmp_path / "clean.mcap") as file:
        marks = marks_of(file)
    assert [(mark.text, bool(mark.end_ns)) for mark in marks] == [
        ("", True),
        ("the needle slipped", False),
        ("", True),
        ("", True),
    ]
    assert marks[3].label == "pause" and marks[3].is_open
    assert not {"suture-1", "slip", "suture-2", "nurse"} & {part for mark in marks for part in (mark.label, mark.who)}
    assert marks[0].who == marks[1].who != ""
    assert b"nurse" not in b"".join(entry.data() for entry in inputs(tmp_path / "clean.mcap"))
