"""``recover``, and ``info`` on damaged files."""

from __future__ import annotations

import json
import os
import random
import shutil
import subprocess
import sys
from collections import Counter
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader
from mcap.writer import Writer
from rosbags.rosbag2 import Reader
from ruamel.yaml import YAML

import igtl_gateway
from igtl_gateway.base.buffers import join
from igtl_gateway.base.errors import DamagedRecording
from igtl_gateway.cli import main
from igtl_gateway.config.configuration import Config
from igtl_gateway.gateway import LINK_UP, Gateway, Session
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.note import Level, Note
from igtl_gateway.record.sessionfile import layout, records
from igtl_gateway.record.sessionfile.damaged import DamagedFile
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.record.sessionfile.writer import SessionWriter
from igtl_gateway.wire import Message, encode
from igtl_gateway.wire.image import Image
from igtl_gateway.wire.transform import Transform
from tests.places import ROOT
from tests.record import samples
from tests.record.test_parts import record, session

FIXTURE = ROOT / "fixtures" / "paper-types.mcap"
ENTRIES = samples.every_kind(20)
SESSION = {**samples.SESSION, "config": json.dumps(Config().to_dict())}


@pytest.fixture
def cut(tmp_path: Path) -> Path:
    """A recording that ended in the middle."""
    path = tmp_path / "out.mcap"
    writer = SessionWriter(path, SESSION, chunk_bytes=1000)
    for entry in ENTRIES:
        writer.write(entry)
    writer.flush()
    data = path.read_bytes()
    writer.close({})
    path.write_bytes(data[:-300])
    return path


def entries(path: Path) -> list[Entry]:
    with SessionFile.open(path) as file:
        return list(file.entries())


def told(capsys: pytest.CaptureFixture[str], *arguments: str | Path, code: int) -> dict[str, Any]:
    assert main([*map(str, arguments), "--json"]) == code
    result: dict[str, Any] = json.loads(capsys.readouterr().out)
    return result


def test_a_cut_recording_becomes_a_whole_file(cut: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["recover", str(cut)]) == 1
    out = cut.with_name("out.recovered.mcap")
    said = capsys.readouterr()
    assert f"{out}: written, closed, with an index" in said.out
    assert "LOST the end after" in said.out and "whole" not in said.out
    assert said.err == ""
    found = entries(out)
    assert 0 < len(found) < len(ENTRIES)
    assert found == [samples.flat(entry) for entry in ENTRIES[: len(found)]]
    with SessionFile.open(out) as file:
        assert file.session == {**SESSION, "format_version": "1"}
        assert file.ledger is not None
        facts = file.ledger["recovered"]
    assert (facts["from"], facts["messages"], facts["closed"], facts["whole"]) == (
        "out.mcap", len(found), False, False,
    )  # fmt: skip
    (loss,) = facts["lost"]
    assert (loss["what"], loss["start_ns"], loss["end_ns"]) == ("cut_off", found[-1].stamp_ns, 0)


def test_for_programs(cut: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    facts = told(capsys, "recover", cut, "-o", tmp_path / "b", code=1)
    assert facts["file"] == str(cut)
    assert facts["output"] == str(tmp_path / "b")
    assert facts["output_bytes"] == (tmp_path / "b").stat().st_size
    assert facts["messages"] == len(entries(tmp_path / "b"))
    assert [loss["what"] for loss in facts["lost"]] == ["cut_off"]


def test_what_is_lost_stays_told_when_it_is_recovered_again(
    cut: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    first = told(capsys, "recover", cut, "-o", tmp_path / "b", code=1)
    second = told(capsys, "recover", tmp_path / "b", "-o", tmp_path / "c", code=0)
    assert second["whole"]
    assert second["earlier"]["lost"] == first["lost"]
    assert entries(tmp_path / "c") == entries(tmp_path / "b")


def test_a_recording_whose_index_alone_is_damaged_is_whole_again_and_verifies(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data = bytearray(FIXTURE.read_bytes())
    data[-100] ^= 1
    (tmp_path / "a.mcap").write_bytes(data)
    assert main(["recover", str(tmp_path / "a.mcap")]) == 0
    assert "complete: nothing is lost" in capsys.readouterr().out
    out = tmp_path / "a.recovered.mcap"
    assert entries(out) == entries(FIXTURE)
    with SessionFile.open(out) as file, SessionFile.open(FIXTURE) as before:
        assert file.session == before.session
        assert file.ledger is not None and before.ledger is not None
        assert {**file.ledger, "recovered": None} == {**before.ledger, "recovered": None}
        assert file.channels == before.channels
    assert main(["verify", str(out)]) == 0


def test_nothing_is_overwritten_unasked(cut: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = cut.read_bytes()
    out = tmp_path / "b"
    out.write_bytes(b"precious")
    assert main(["recover", str(cut), "-o", str(out)]) == 2
    assert "--overwrite" in capsys.readouterr().err
    assert out.read_bytes() == b"precious"
    assert main(["recover", str(cut), "-o", str(cut), "--overwrite"]) == 2
    assert "found the damaged file" in capsys.readouterr().err
    assert cut.read_bytes() == before
    assert main(["recover", str(cut), "-o", str(out), "--overwrite"]) == 1
    assert entries(out)


@pytest.mark.parametrize("content", [None, b"", b"no recording at all"])
def test_what_is_no_recording_is_refused_and_nothing_written(
    tmp_path: Path, content: bytes | None, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "a.mcap"
    if content is not None:
        path.write_bytes(content)
    assert main(["recover", str(path)]) == 2
    assert capsys.readouterr().err.startswith(f"igtl-gateway recover: {path}: ")
    assert list(tmp_path.iterdir()) == ([path] if content is not None else [])


def test_a_disk_that_refuses_leaves_no_half_copy(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "b"
    assert main(["recover", str(FIXTURE), "-o", str(out / "c")]) == 1
    assert "there is no folder" in capsys.readouterr().err
    command = 'ulimit -f 40; exec "$0" -m igtl_gateway recover "$1" -o "$2"'
    ended = subprocess.run(
        ["sh", "-c", command, sys.executable, str(FIXTURE), str(out)],
        env=os.environ | {"PYTHONDONTWRITEBYTECODE": "1"},  # Python would leave compiled modules that are cut off
        capture_output=True,
        text=True,
        check=False,
    )
    assert (ended.returncode, ended.stdout) == (1, "")
    assert ended.stderr == f"igtl-gateway recover: cannot write {out}: File too large\n"
    assert not out.exists()


def test_of_other_programs_everything_is_kept(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "bag.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start("ros2", "another program")
        writer.add_metadata("theirs", {"a": "b"})
        writer.add_attachment(1, 2, "notes.txt", "text/plain", b"hello")
        string = writer.register_schema("std_msgs/msg/String", "ros2msg", b"string data")
        other = writer.register_schema("foxglove.Log", "protobuf", b"\1\2")
        for number in range(10):
            for topic, encoding, schema in (
                ("/chatter", "cdr", string),
                ("/log", "protobuf", other),
                ("/x", "json", 0),
            ):
                if number == 0:
                    writer.register_channel(topic, encoding, schema, {"theirs": topic})
            for channel in (1, 2, 3):
                writer.add_message(channel, number + 1, samples.string_cdr(f"{number}"), number, number * 2)
            writer.flush()  # type: ignore[no-untyped-call]
    assert told(capsys, "recover", path, code=1)["messages"] == 30
    out = tmp_path / "bag.recovered.mcap"
    with out.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        assert reader.get_header().profile == "ros2"
        found = list(reader.iter_messages())
        assert [attachment.data for attachment in reader.iter_attachments()] == [b"hello"]
        assert {"theirs": {"a": "b"}}.items() <= {each.name: each.metadata for each in reader.iter_metadata()}.items()
    assert [(channel.topic, message.sequence, message.publish_time) for _, channel, message in found] == [
        (topic, 2 * number, number) for number in range(10) for topic in ("/chatter", "/log", "/x")
    ]
    assert {channel.topic: (channel.message_encoding, schema and schema.data) for schema, channel, _ in found} == {
        "/chatter": ("cdr", b"string data"), "/log": ("protobuf", b"\1\2"), "/x": ("json", None),
    }  # fmt: skip
    with SessionFile.open(out) as file:
        assert file.foreign
        assert len(list(file.entries())) == 10


def test_info_tells_what_can_be_read_of_a_damaged_file(cut: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["info", str(cut)]) == 1
    said = capsys.readouterr()
    assert "session log version 1" in said.out
    assert "TRANSFORM/ProbeToTracker" in said.out
    assert "LOST the end" in said.out
    assert said.err.startswith(f"igtl-gateway info: {cut}: was cut off after ")
    assert said.err.endswith(f"; run: igtl-gateway recover {cut}\n")
    facts = told(capsys, "info", cut, code=1)
    assert facts["entries"] == facts["damaged"]["messages"] > 0
    assert [loss["what"] for loss in facts["damaged"]["lost"]] == ["cut_off"]


def test_info_reads_a_file_that_turns_out_to_be_damaged_in_the_middle(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "a.mcap"
    writer = SessionWriter(path, SESSION, chunk_bytes=1000, compression="none")
    for entry in ENTRIES:
        writer.write(entry)
    writer.close({"streams": {}})
    data = path.read_bytes()
    path.write_bytes(data.replace(b"message 70", b"message 71"))
    facts = told(capsys, "info", path, code=1)
    assert 0 < facts["entries"] < len(ENTRIES)
    assert facts["damaged"]["missing"] == len(ENTRIES) - facts["entries"]
    assert "checksum" in facts["damaged"]["why"]


def test_info_tells_of_a_recovered_file(cut: Path, capsys: pytest.CaptureFixture[str]) -> None:
    main(["recover", str(cut)])
    capsys.readouterr()
    assert main(["info", str(cut.with_name("out.recovered.mcap"))]) == 0
    said = capsys.readouterr().out
    assert "recovered from out.mcap by igtl-gateway" in said
    assert "1 loss, see --json" in said


def side_file(folder: Path) -> Counter[str]:
    """Messages by type as rosbags finds them by ``metadata.yaml``; each of its fields is compared with the files."""
    told = YAML(typ="safe").load((folder / "metadata.yaml").read_text("utf-8"))["rosbag2_bagfile_information"]
    parts = []
    topics: Counter[tuple[str, str, str]] = Counter()
    for path in sorted(folder.glob("*.mcap")):
        with path.open("rb") as stream:
            summary = make_reader(stream).get_summary()
        assert summary and summary.statistics
        facts = summary.statistics
        span = facts.message_end_time - facts.message_start_time
        parts.append((path.name, facts.message_start_time, span, facts.message_count))
        for number, count in facts.channel_message_counts.items():
            channel = summary.channels[number]
            kind = summary.schemas[channel.schema_id].name
            topics[channel.topic, kind, channel.metadata["offered_qos_profiles"]] += count
    assert told["relative_file_paths"] == [part[0] for part in parts]
    assert parts == [
        (
            one["path"],
            one["starting_time"]["nanoseconds_since_epoch"],
            one["duration"]["nanoseconds"],
            one["message_count"],
        )
        for one in told["files"]
    ]
    end_ns = max(start_ns + span for _, start_ns, span, _ in parts)
    assert told["starting_time"]["nanoseconds_since_epoch"] == min(start_ns for _, start_ns, _, _ in parts)
    assert told["duration"]["nanoseconds"] == end_ns - told["starting_time"]["nanoseconds_since_epoch"]
    assert {
        (one["topic_metadata"]["name"], one["topic_metadata"]["type"]): (
            one["topic_metadata"]["offered_qos_profiles"],
            one["message_count"],
        )
        for one in told["topics_with_message_count"]
    } == {(topic, kind): (YAML(typ="safe").load(qos), count) for (topic, kind, qos), count in topics.items()}
    with Reader(folder) as reader:
        found = Counter(connection.msgtype for connection, _, _ in reader.messages())
        assert found.total() == reader.message_count == told["message_count"]
    return found


def counts(given: list[Entry]) -> Counter[str]:
    return Counter(layout.type_of(entry.kind) or entry.type for entry in given)


def test_the_parts_of_a_split_recording_are_recovered_together(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "split"
    folder.mkdir()
    for number, given in enumerate((ENTRIES[:70], ENTRIES[70:])):
        writer = SessionWriter(folder / f"split_{number}.mcap", {**SESSION, layout.PART_KEY: str(number)})
        for entry in given:
            writer.write(entry)
        writer.close({"streams": {}})
    last = folder / "split_1.mcap"
    last.write_bytes(last.read_bytes()[:-300])
    assert main(["info", str(folder)]) == 1
    assert capsys.readouterr().err.endswith(f"; run: igtl-gateway recover {folder}\n")
    facts = told(capsys, "recover", folder, code=0)
    assert [Path(part["file"]).name for part in facts["parts"]] == ["split_0.mcap", "split_1.mcap"]
    assert entries(tmp_path / "split.recovered") == [samples.flat(entry) for entry in ENTRIES]
    assert main(["recover", str(folder)]) == 2
    assert "found a directory with files in it" in capsys.readouterr().err
    assert side_file(tmp_path / "split.recovered") == counts(ENTRIES)
    (folder / "split_2.mcap").touch()  # killed before its first byte
    assert main(["recover", str(folder), "-o", str(tmp_path / "more")]) == 1
    assert "LOST" in capsys.readouterr().out
    assert entries(tmp_path / "more") == [samples.flat(entry) for entry in ENTRIES]
    assert side_file(tmp_path / "more") == counts(ENTRIES)
    (tmp_path / "none").mkdir()
    assert main(["recover", str(tmp_path / "none")]) == 2
    capsys.readouterr()
    assert main(["recover", str(folder), "-o", str(tmp_path / "one.mcap")]) == 2
    words = f"one.mcap: found the name of a file, expected a directory for the parts of {folder}"
    assert words in capsys.readouterr().err and not (tmp_path / "one.mcap").exists()


def test_session_metadata_that_are_lost_are_named_once(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path, first, second = (tmp_path / name for name in ("out.mcap", "first.mcap", "second.mcap"))
    writer = SessionWriter(path, SESSION)
    for entry in ENTRIES:
        writer.write(entry)
    writer.close({})
    path.write_bytes(path.read_bytes().replace(b"igtl_gateway.session", b"igtl_gateway.nothing"))
    (loss,) = told(capsys, "recover", path, "-o", first, code=1)["lost"]
    assert loss["text"] == "the session metadata, such as the configuration"
    assert told(capsys, "recover", first, "-o", second, code=0)["lost"] == []
    again = told(capsys, "recover", second, code=0)
    assert again["lost"] == [] and entries(second) == entries(first)


def test_a_split_recording_whose_last_part_is_not_there_has_no_end(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    record(tmp_path / "out", session(), split_s=2)
    max((tmp_path / "out").glob("*.mcap")).unlink()
    assert main(["info", str(tmp_path / "out")]) == 0
    assert "losses\n       unknown: the last part was closed for a next one" in capsys.readouterr().out
    assert main(["info", str(tmp_path / "out" / "out_0.mcap")]) == 0
    assert "losses\n       none" in capsys.readouterr().out, "a part alone is whole"
    facts = told(capsys, "recover", tmp_path / "out", code=1)
    assert all(part["whole"] for part in facts["parts"])
    assert facts["notes"] == [
        "the end of the recording is unknown: the last part was closed for a next one, which is not there"
    ]


def test_marks_behind_the_end_that_is_left_are_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "out.mcap"
    record(path, session(), chunk_bytes=2000)
    for at, label in (("1", "early"), ("4.9", "late")):
        assert main(["mark", str(path), "--at", at, "--label", label]) == 0
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    capsys.readouterr()
    facts = told(capsys, "recover", path, code=1)
    assert facts["notes"] == ["marks that were added behind the end are left out: late"]


def test_the_folder_of_another_program_gets_the_side_file_too(tmp_path: Path) -> None:
    folder = tmp_path / "bag"
    folder.mkdir()
    for name, at in (("bag_10", 2_000), ("bag_9", 1_000)):
        with (folder / f"{name}.mcap").open("wb") as stream:
            writer = Writer(stream)
            writer.start("ros2", "rosbag2")
            schema = writer.register_schema("std_msgs/msg/String", "ros2msg", b"string data")
            channel = writer.register_channel("/chatter", "cdr", schema, {})
            for number in range(3):
                writer.add_message(channel, at + number, samples.string_cdr("x"), at + number, number)
            writer.finish()  # type: ignore[no-untyped-call]
    assert main(["recover", str(folder)]) == 0
    with Reader(tmp_path / "bag.recovered") as reader:
        assert [stamp for _, stamp, _ in reader.messages()] == [1000, 1001, 1002, 2000, 2001, 2002]
        (connection,) = reader.connections
        assert (connection.topic, connection.msgcount) == ("/chatter", 6)
    told = YAML(typ="safe").load((tmp_path / "bag.recovered" / "metadata.yaml").read_text("utf-8"))
    told = told["rosbag2_bagfile_information"]
    assert told["relative_file_paths"] == ["bag_9.mcap", "bag_10.mcap"], "in the order of time"
    assert told["topics_with_message_count"][0]["topic_metadata"]["offered_qos_profiles"] == []


def test_where_nothing_can_be_read_the_side_file_names_nothing(tmp_path: Path) -> None:
    folder = tmp_path / "bag"
    folder.mkdir()
    (folder / "bag_0.mcap").touch()
    assert main(["recover", str(folder)]) == 1
    told = YAML(typ="safe").load((tmp_path / "bag.recovered" / "metadata.yaml").read_text("utf-8"))
    told = told["rosbag2_bagfile_information"]
    lists = ("relative_file_paths", "files", "topics_with_message_count")
    assert [told[key] for key in (*lists, "message_count")] == [[], [], [], 0]


def with_pictures(path: Path) -> tuple[Path, list[Entry]]:
    """The folder of a split recording whose parts have a picture in their prologue, and its entries."""
    live = Session(Gateway(Config(base_frame="world")))
    up = Note(Level.INFO, LINK_UP, "a peer", data={"address": "127.0.0.1:1"}).pack()
    found = live.input(samples.START_NS, Kind.LINK, (up,), links=(1,))
    picture = bytes(join(encode(Message("IMAGE", "CT", Image((30, 20, 1), 3, random.Random(1).randbytes(600))))))
    for number in range(40):
        now_ns = samples.START_NS + (number + 1) * 50_000_000
        pose = Message("TRANSFORM", "AToB", Transform((1.0, 0, 0, 0, 1, 0, 0, 0, 1, number, 2, 3)))
        found += live.input(now_ns, Kind.IGTL_IN, (bytes(join(encode(pose))),), links=(1,))
        if number in (1, 15):
            found += live.input(now_ns + 5, Kind.IGTL_IN, (picture,), links=(1,))
    return record(path, found, split_s=1.0).path, found


def test_a_folder_whose_last_part_was_cut_off_anywhere_is_recovered_to_one_that_opens(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, all_entries = with_pictures(tmp_path / "long.mcap")
    last = max(folder.glob("*.mcap"))
    data = last.read_bytes()
    with SessionFile.open(last) as part:
        first = next(part.entries()).seq
        assert any(entry.type == "IMAGE" for entry in part.prologue())
    with last.open("rb") as stream:
        spans = list(DamagedFile(last, stream).walk())
    prologue = [span for span in spans if span.opcode == records.ATTACHMENT][-1]
    begins = [span.at for span in spans if span.opcode in (records.METADATA, records.ATTACHMENT, records.CHUNK)]
    places = [0, 7, 20, *begins, *range(prologue.at, prologue.end, 211), prologue.end - 1, len(data) - 1]
    for cut in sorted(set(places)):
        last.write_bytes(data[:cut])
        out = tmp_path / f"recovered-{cut}"
        assert main(["recover", str(folder), "-o", str(out)]) in (0, 1)
        assert main(["verify", str(out)]) == 0, (cut, capsys.readouterr().out)
        assert main(["info", str(out)]) == 0, cut
        with SessionFile.open(out) as file:
            left = [entry.seq for entry in file.entries()]
        assert left == [entry.seq for entry in all_entries][: len(left)] and len(left) >= first - 1, cut
        if (out / last.name).exists():
            assert all(entry.seq >= first for entry in entries(out / last.name)), cut
        with igtl_gateway.open(folder) as recording:  # directly
            assert sum(map(len, recording.values())) <= len(all_entries), cut
        with pytest.raises(DamagedRecording, match=f"recover {folder}"):
            SessionFile.open(folder)
        shutil.rmtree(out)


def test_a_part_that_lost_its_session_metadata_gets_those_of_the_others(tmp_path: Path) -> None:
    folder, all_entries = with_pictures(tmp_path / "long.mcap")
    part = folder / "long_1.mcap"
    data = bytearray(part.read_bytes())
    for name in layout.SESSION_RECORDS:
        place = data.find(name.encode())
        data[place - 20 : place + 40] = bytes(60)
    part.write_bytes(data)
    assert main(["recover", str(folder)]) == 1
    with SessionFile.open(tmp_path / "long.recovered") as file:
        assert [entry.seq for entry in file.entries()] == [entry.seq for entry in all_entries]


def test_what_is_no_part_has_no_place_in_a_folder(tmp_path: Path) -> None:
    folder, all_entries = with_pictures(tmp_path / "long.mcap")
    os.mkfifo(folder / "long_5.mcap")
    (folder / "long_6.mcap").mkdir()
    (folder / "long_7.mcap").symlink_to(tmp_path / "nothing")
    (folder / "long_00.mcap").symlink_to(ROOT / "fixtures" / "star.mcap")
    (folder / "long_8.mcap").symlink_to(folder / "long_1.mcap")
    assert main(["recover", str(folder)]) == 0
    for place in (folder, tmp_path / "long.recovered"):
        with SessionFile.open(place) as file:
            assert [entry.seq for entry in file.entries()] == [entry.seq for entry in all_entries]
    assert not any(path.is_symlink() for path in (tmp_path / "long.recovered").iterdir())
    shutil.copy(folder / "long_1.mcap", folder / "copy.mcap")
    with pytest.raises(DamagedRecording, match="part 1 twice"):
        SessionFile.open(folder)
