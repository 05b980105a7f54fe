"""The file as others see it: rosbags, mcap-ros2-support, pymcap-cli and rerun open our recordings."""

from __future__ import annotations

import errno
import os
import re
import subprocess
import sys
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from unittest.mock import Mock

import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader

from igtl_gateway.base.errors import DiskRefused, RecordingError
from igtl_gateway.base.qos import Qos
from igtl_gateway.convert import rosmsg
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.record.sessionfile import layout, writer
from igtl_gateway.record.sessionfile.compression import COMPRESSIONS
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.record.sessionfile.salvage import Salvage
from igtl_gateway.record.sessionfile.stream import McapStream
from igtl_gateway.record.sessionfile.writer import SessionWriter
from tests.record import samples

BIN = Path(sys.executable).parent
DEADLINE_S = 120


@pytest.fixture(scope="module", params=sorted(COMPRESSIONS))
def recording(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A session with every kind of entry, in each compression."""
    path = tmp_path_factory.mktemp("conformance") / "session.mcap"
    writer = SessionWriter(
        path,
        samples.SESSION,
        qos_of=lambda topic, _type: Qos(1, latched=True) if topic == "/chatter" else None,
        compression=request.param,
        chunk_bytes=3000,
    )
    for entry in entries():
        writer.write(entry)
    writer.close({"streams": {}})
    return path


def entries() -> list[Entry]:
    """With names that need escaping, too."""
    given = samples.every_kind(20)
    at = len(given)
    odd = samples.START_NS + at
    return [
        *given,
        Entry(at + 1, odd + 1, Kind.IGTL_IN, "ODD \udcff/Größe\0\\", "ODD \udcff", (b"bytes",)),
        Entry(at + 2, odd + 2, Kind.NOTE, payload=(b"\xff no note",)),
    ]


def test_rosbags_reads_every_message(recording: Path) -> None:
    with AnyReader([recording]) as reader:
        assert reader.message_count == len(entries())
        read = [(connection, reader.deserialize(data, connection.msgtype)) for connection, _, data in reader.messages()]
        (chatter,) = [connection for connection in reader.connections if connection.topic == "/chatter"]
    for entry, (connection, message) in zip(entries(), read, strict=True):
        if entry.kind in layout.ROS_KINDS:
            assert connection.topic == entry.channel
            assert bytes(samples.string_cdr(message.data)) == entry.data()  # type: ignore[attr-defined]
        elif entry.kind in layout.WIRE_TOPICS:
            assert message.data.tobytes() == entry.data()  # type: ignore[attr-defined]
            assert layout.unescape(message.type) == entry.type  # type: ignore[attr-defined]
        else:
            assert message.kind == entry.kind.value  # type: ignore[attr-defined]
    (qos,) = chatter.ext.offered_qos_profiles  # type: ignore[union-attr]
    assert (qos.depth, qos.durability.name) == (1, "TRANSIENT_LOCAL")


def test_mcap_ros2_support_decodes_every_message(recording: Path) -> None:
    with recording.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
        decoded = list(reader.iter_decoded_messages())
        assert [attachment.name for attachment in reader.iter_attachments()] == [layout.CONFIGURATION_ATTACHMENT]
        assert reader.get_header().profile == "ros2"
    assert len(decoded) == len(entries())
    for entry, (_, channel, message, fields) in zip(entries(), decoded, strict=True):
        assert (message.sequence, message.log_time) == (entry.seq, entry.stamp_ns)
        assert message.publish_time == (entry.source_ns or entry.stamp_ns)
        assert channel.metadata[layout.KIND_KEY] == entry.kind.value
        if entry.kind in layout.WIRE_TOPICS:
            assert bytes(fields.data) == entry.data()
        elif entry.kind in layout.NOTE_KINDS:
            assert fields.kind == entry.kind.value


@pytest.mark.slow
def test_pymcap_doctor_finds_no_errors(recording: Path) -> None:
    done = subprocess.run(
        [BIN / "pymcap-cli", "doctor", recording],
        capture_output=True, text=True, check=False, timeout=DEADLINE_S, env={**os.environ, "COLUMNS": "500"},
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    assert re.search(r"\b0 errors\b", done.stdout + done.stderr)


@pytest.mark.skipif(find_spec("rerun") is None, reason="no rerun here: install the extra 'view'")
def test_rerun_opens_it(recording: Path, tmp_path: Path) -> None:
    out = tmp_path / "session.rrd"
    done = subprocess.run(
        [BIN / "rerun", "mcap", "convert", recording, "-o", out],
        capture_output=True, text=True, check=False, timeout=DEADLINE_S, env={**os.environ, "RERUN_ANALYTICS": "0"},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "ERROR" not in done.stderr
    told = subprocess.run(
        [BIN / "rerun", "rrd", "print", out],
        capture_output=True, text=True, check=True, timeout=DEADLINE_S, env={**os.environ, "RERUN_ANALYTICS": "0"},
    ).stdout  # fmt: skip
    # rows per topic: the importer has decoded every message, our own and those of ROS
    rows: dict[str, int] = {}
    for number, topic in re.findall(r"with (\d+) rows.*? - (/\S+) - data columns: \[(?:igtl_msgs|TextDocument)", told):
        rows[topic] = rows.get(topic, 0) + int(number)
    assert rows["/chatter"] == 20
    assert rows["/igtl_gateway/wire/in/transform/ProbeToTracker"] == 20
    assert rows["/igtl_gateway/notes"] == 61


# -- limits and errors ----------------------------------------------------------------------------------------------


def text(number: int, topic: str = "/chatter") -> Entry:
    """A ROS message of std_msgs/msg/String."""
    cdr = rosmsg.String(f"message {number}").pack()
    return Entry(number, samples.START_NS + number, Kind.ROS_IN, topic, rosmsg.String.TYPE, (cdr,))


def read(path: Path) -> list[Entry]:
    with SessionFile.open(path) as file:
        return list(file.entries())


@pytest.mark.parametrize(
    "wrong",
    [
        replace(text(2), stamp_ns=1 << 64),
        replace(text(2), stamp_ns=-1),
        replace(text(2), source_ns=1 << 64),
        replace(text(2), source_ns=-1),
        replace(text(2), seq=-1),
    ],
)
def test_an_entry_that_the_format_cannot_hold_leaves_the_file_untouched(tmp_path: Path, wrong: Entry) -> None:
    path = tmp_path / "session.mcap"
    out = SessionWriter(path, samples.SESSION)
    out.write(text(1))
    with pytest.raises(layout.LayoutError, match="expected unsigned 64 bits"):
        out.write(wrong)
    out.write(text(3))
    out.close({})
    assert (out.entries, out.end_ns) == (2, samples.START_NS + 3)
    assert read(path) == [text(1), text(3)]


def test_a_topic_beyond_the_channels_of_mcap_costs_the_others_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(writer, "_MAX_ROS_CHANNELS", 2)
    path = tmp_path / "session.mcap"
    out = SessionWriter(path, samples.SESSION)
    for number, topic in enumerate(["/a", "/b"], start=1):
        out.write(text(number, topic))
    with pytest.raises(layout.LayoutError, match="topic /c: found 2 channels"):
        out.write(text(3, "/c"))
    out.write(text(4, "/a"))
    out.close({})
    assert read(path) == [text(1, "/a"), text(2, "/b"), text(4, "/a")]


def test_streams_that_a_peer_invents_fill_no_memory_and_change_no_byte(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    files = []
    for bound in (10_000, 1):
        monkeypatch.setattr(writer, "_MAX_KNOWN", bound)
        path = tmp_path / f"{bound}.mcap"
        out = SessionWriter(path, samples.SESSION)
        for entry in entries():
            out.write(entry)
            assert len(out._known) <= bound
        out.close({})
        files.append(path.read_bytes())
    assert files[0] == files[1]


def test_a_payload_in_pieces_or_of_an_array_is_one_message(tmp_path: Path) -> None:
    path = tmp_path / "session.mcap"
    whole = text(1)
    data = whole.data()
    array = memoryview(data).cast("B", (1, len(data)))
    out = SessionWriter(path, samples.SESSION)
    out.write(replace(whole, payload=(data[:5], memoryview(data)[5:])))
    out.write(replace(whole, seq=2, payload=(array,)))
    out.close({})
    assert [entry.data() for entry in read(path)] == [data, data]


def test_an_existing_file_is_replaced_only_where_that_is_asked_for(tmp_path: Path) -> None:
    path = tmp_path / "session.mcap"
    path.write_bytes(b"mine")
    with pytest.raises(RecordingError, match="not replaced without --overwrite"):
        SessionWriter(path, samples.SESSION)
    assert path.read_bytes() == b"mine"
    out = SessionWriter(path, samples.SESSION, overwrite=True)
    with pytest.raises(RecordingError, match="another process is recording to it"):
        SessionWriter(path, samples.SESSION, overwrite=True)
    out.write(text(1))
    out.close({})
    assert read(path) == [text(1)]


def test_a_link_is_replaced_itself(tmp_path: Path) -> None:
    (tmp_path / "other").write_bytes(b"of somebody else")
    path = tmp_path / "session.mcap"
    path.symlink_to("other")
    with pytest.raises(RecordingError):
        SessionWriter(path, samples.SESSION)
    out = SessionWriter(path, samples.SESSION, overwrite=True)
    out.write(text(1))
    out.close({})
    assert not path.is_symlink() and read(path) == [text(1)]
    assert (tmp_path / "other").read_bytes() == b"of somebody else"


def test_a_recording_that_does_not_begin_keeps_the_old_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "session.mcap"
    path.write_bytes(b"mine")
    monkeypatch.setattr(SessionWriter, "_start", Mock(side_effect=OSError(28, "No space left on device")))
    with pytest.raises(DiskRefused, match="No space left"):
        SessionWriter(path, samples.SESSION, overwrite=True)
    assert [each.name for each in tmp_path.iterdir()] == ["session.mcap"] and path.read_bytes() == b"mine"


@pytest.mark.parametrize(("taken", "found"), [(False, "the file was removed"), (True, "another file took its place")])
def test_a_file_that_is_taken_away_ends_the_recording(tmp_path: Path, taken: bool, found: str) -> None:
    path = tmp_path / "session.mcap"
    out = SessionWriter(path, samples.SESSION)
    out.write(text(1))
    path.unlink()
    if taken:
        path.write_bytes(b"mine")
    with pytest.raises(RecordingError, match=found):
        out.flush()
    with pytest.raises(RecordingError, match=found):
        out.write(text(2))
    out.close({})  # adds nothing
    assert out.size == 0
    assert not taken or path.read_bytes() == b"mine"


def test_a_disk_that_refuses_ends_the_recording_and_what_was_flushed_stays(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "session.mcap"
    out = SessionWriter(path, samples.SESSION)
    out.write(text(1))
    out.flush()

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(McapStream, "add_message", full)
    for _ in range(2):
        with pytest.raises(RecordingError, match=f"recording to {path} failed: No space left"):
            out.write(text(2))
    with Salvage.open(path) as file:
        assert [found.entry for found in file.read()] == [text(1)]


def test_where_the_file_cannot_even_begin_none_is_left(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(McapStream, "start", full)
    with pytest.raises(DiskRefused, match="No space left"):
        SessionWriter(tmp_path / "session.mcap", samples.SESSION)
    assert list(tmp_path.iterdir()) == []


def test_a_closed_file_takes_no_more(tmp_path: Path) -> None:
    out = SessionWriter(tmp_path / "session.mcap", samples.SESSION)
    out.close({})
    out.close({})
    for act in (out.flush, lambda: out.write(text(1))):
        with pytest.raises(RecordingError, match="already closed"):
            act()


@pytest.mark.parametrize(("fsync", "syncs"), [("never", 0), ("close", 1), ("flush", 3)])
def test_when_data_are_forced_to_the_disk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fsync: writer.Fsync, syncs: int
) -> None:
    forced: list[int] = []
    monkeypatch.setattr(writer, "_DATASYNC", forced.append)
    out = SessionWriter(tmp_path / "session.mcap", samples.SESSION, fsync=fsync)
    for number in (1, 2):
        out.write(text(number))
        out.flush()
    out.close({})
    assert len(forced) == syncs


def test_topics_are_counted_over_the_kinds_of_their_entries(tmp_path: Path) -> None:
    out = SessionWriter(tmp_path / "session.mcap", samples.SESSION)
    for number, kind in enumerate([Kind.ROS_IN, Kind.ROS_OUT, Kind.ROS_IN], start=1):
        out.write(replace(text(number), kind=kind))
    out.close({})
    (topic,) = out.topics()
    assert (topic.topic, topic.type, topic.count) == ("/chatter", rosmsg.String.TYPE, 3)
    assert out.files == [out.path]


def test_a_type_without_a_definition_is_recorded_and_named(tmp_path: Path) -> None:
    path = tmp_path / "session.mcap"
    out = SessionWriter(path, samples.SESSION)
    unknown = replace(text(1), type="lab_msgs/msg/Unknown")
    for number in (1, 2):
        out.write(replace(unknown, seq=number))
    out.close({})
    assert out.undefined == ["lab_msgs/msg/Unknown"]
    assert [entry.type for entry in read(path)] == ["lab_msgs/msg/Unknown"] * 2
