"""The reader: what was written comes back, and whatever else it is given ends in one clear line."""

from __future__ import annotations

import gc
import random
import tracemalloc
from collections.abc import Callable, Sequence
from io import BytesIO
from itertools import islice
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.writer import CompressionType, IndexType, Writer

from igtl_gateway.base.errors import DamagedRecording, RecordingError, UnsupportedRecording
from igtl_gateway.base.qos import Qos
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.record.sessionfile import layout
from igtl_gateway.record.sessionfile.bulk import ChunkReader
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.record.sessionfile.writer import SessionWriter
from tests.files import RefusingStream, write_anew
from tests.foreign_bags import cdr_mcap, talker, topics_and_services
from tests.record import samples
from tests.record.sessionfile.test_index import DEFINITIONS, bag, messages
from tools import mcap_build as build
from tools.mcap_build import Chunk

STRING = "std_msgs/msg/String"


def read(path: Path) -> list[Entry]:
    with SessionFile.open(path) as file:
        return list(file.entries())


# --- round trip ------------------------------------------------------------------------------------------------


@given(samples.sessions(), st.sampled_from([200, 1 << 20]))
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow])
def test_any_session_comes_back(tmp_path: Path, entries: list[Entry], chunk_bytes: int) -> None:
    path = tmp_path / "session.mcap"
    path.unlink(missing_ok=True)
    writer = SessionWriter(path, samples.SESSION, chunk_bytes=chunk_bytes)
    for entry in entries:
        writer.write(entry)
    writer.close({"n": len(entries)})
    with SessionFile.open(path) as file:
        assert list(file.entries()) == [samples.flat(entry) for entry in entries]
        assert list(file.entries()) == list(file.entries())  # from the start again
        assert (file.entry_count, file.skipped, file.foreign) == (len(entries), (), False)
        assert file.ledger == {"n": len(entries)}
        if entries:
            assert (file.start_ns, file.end_ns) == (entries[0].stamp_ns, entries[-1].stamp_ns)


def test_what_a_file_says_without_reading_its_entries(tmp_path: Path) -> None:
    latched = Qos(depth=1, reliable=True, latched=True)
    writer = SessionWriter(
        tmp_path / "a", samples.SESSION, qos_of=lambda topic, _: latched if topic == "/map" else None
    )
    entries = [*samples.every_kind(3), samples.ros(30, topic="/map"), samples.ros(31, Kind.ROS_OUT, topic="/map")]
    for entry in entries:
        writer.write(entry)
    writer.close({})
    with SessionFile.open(tmp_path / "a") as file:
        told = {(each.topic, each.kind): (each.type, each.stream, each.count, each.qos) for each in file.channels}
    wire, note = layout.RAW_MESSAGE_TYPE, layout.NOTE_TYPE
    assert told == {
        ("/igtl_gateway/wire/in/transform/ProbeToTracker", Kind.IGTL_IN): (wire, "TRANSFORM/ProbeToTracker", 3, Qos()),
        ("/igtl_gateway/wire/out/string/chatter", Kind.IGTL_OUT): (wire, "STRING/chatter", 3, Qos()),
        ("/igtl_gateway/notes", Kind.LINK): (note, "", 3, Qos()),
        ("/igtl_gateway/notes", Kind.EDGE_NOTE): (note, "", 3, Qos()),
        ("/igtl_gateway/notes", Kind.NOTE): (note, "", 3, Qos()),
        ("/chatter", Kind.ROS_IN): (STRING, "/chatter", 3, Qos()),
        ("/igtl/probe", Kind.ROS_OUT): (STRING, "/igtl/probe", 3, Qos()),
        ("/map", Kind.ROS_IN): (STRING, "/map", 1, latched),
        ("/map", Kind.ROS_OUT): (STRING, "/map", 1, latched),
    }


def test_streams_that_share_a_channel_come_back(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(layout, "MAX_WIRE_STREAMS", 2)
    entries = [samples.igtl(seq, device=f"n{seq}") for seq in range(1, 10)]
    path = samples.write(tmp_path / "a", entries)
    assert read(path) == [samples.flat(entry) for entry in entries]
    with SessionFile.open(path) as file:
        assert [(each.stream, each.count) for each in file.channels] == [
            ("TRANSFORM/n1", 1), ("TRANSFORM/n2", 1), ("", 7),
        ]  # fmt: skip


def test_entry_numbers_beyond_32_bits(tmp_path: Path) -> None:
    entries = [samples.ros(seq) for seq in (1, 2**31 - 1, 2**32 - 2, 2**32 - 1, 2**32, 2**32 + 5)]
    assert [entry.seq for entry in read(samples.write(tmp_path / "a", entries))] == [entry.seq for entry in entries]


def test_payloads_are_views_that_outlive_the_file(tmp_path: Path) -> None:
    path = samples.write(tmp_path / "a", [samples.igtl(1, body=b"x" * 1000)])
    (entry,) = read(path)
    (payload,) = entry.payload
    assert isinstance(payload, memoryview)
    assert bytes(payload[58:]) == b"x" * 1000


def test_memory_is_bounded_by_the_chunk_not_by_the_file(tmp_path: Path) -> None:
    writer = SessionWriter(tmp_path / "a", {})
    for seq in range(1, 201):
        writer.write(samples.igtl(seq, body=bytes(200_000)))
    writer.close({})
    with SessionFile.open(tmp_path / "a") as file:
        gc.collect()
        tracemalloc.start()
        assert sum(entry.size for entry in file.entries()) == 200 * 200_058
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
    assert peak < 8_000_000  # of 40 MB; chunks are of one


# --- not a recording -------------------------------------------------------------------------------------------


def _missing(path: Path) -> None:
    del path


def _directory(path: Path) -> None:
    path.mkdir()


def _empty(path: Path) -> None:
    path.touch()


def _text(path: Path) -> None:
    path.write_text("This is no recording.\n" * 100)


def _sqlite_bag(path: Path) -> None:
    path.write_bytes(b"SQLite format 3\0" + bytes(4096))


def _newer(path: Path) -> None:
    _bag(path, {layout.SESSION_METADATA: layout.seal({"format_version": str(max(layout.PRESENT_VERSIONS) + 1)})})


@pytest.mark.parametrize(
    ("make", "error", "words"),
    [
        (_missing, UnsupportedRecording, "No such file"),
        (_directory, UnsupportedRecording, "found a directory"),
        (_empty, UnsupportedRecording, "the file is empty"),
        (_text, UnsupportedRecording, "not an MCAP file"),
        (_sqlite_bag, UnsupportedRecording, "not an MCAP file"),
        (_newer, UnsupportedRecording, "found format version 3, expected at most 2"),
    ],
)
def test_what_is_no_recording_is_refused(
    tmp_path: Path, make: Callable[[Path], None], error: type[RecordingError], words: str
) -> None:
    path = tmp_path / "session.mcap"
    make(path)
    with pytest.raises(error, match=words) as caught:
        SessionFile.open(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)


def _unindexed(path: Path) -> None:
    _bag(path, {}, index_types=IndexType.NONE)


def _unchunked(path: Path) -> None:
    _bag(path, {}, use_chunking=False)


def _without_summary(path: Path) -> None:
    _bag(
        path, {}, index_types=IndexType.NONE, repeat_channels=False, repeat_schemas=False, use_statistics=False,
        use_summary_offsets=False,
    )  # fmt: skip


@pytest.mark.parametrize("make", [_unindexed, _unchunked, _without_summary])
def test_a_file_without_an_index_is_read(tmp_path: Path, make: Callable[[Path], None]) -> None:
    indexed, path = tmp_path / "indexed.mcap", tmp_path / "session.mcap"
    _bag(indexed, {})
    make(path)
    assert read(path) == read(indexed) != []


# --- damaged ---------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> tuple[bytes, list[Entry]]:
    """A sound file of several chunks, and its entries."""
    path = tmp_path_factory.mktemp("sound") / "session.mcap"
    entries = samples.every_kind(8)
    writer = SessionWriter(path, samples.SESSION, chunk_bytes=2000)
    for entry in entries:
        writer.write(entry)
    writer.close({"a": {"b": 1}})
    return path.read_bytes(), [samples.flat(entry) for entry in entries]


def outcome(path: Path, data: bytes) -> list[Entry] | RecordingError:
    """Entries of a file with that content, or how it was refused; any other error is a failure of the test."""
    write_anew(path, data)
    try:
        with SessionFile.open(path) as file:
            assert file.session == {**samples.SESSION, "format_version": "1"}
            assert file.ledger == {"a": {"b": 1}}
            assert not file.foreign
            return list(file.entries())
    except RecordingError as error:
        assert "\n" not in str(error)
        return error


def test_a_file_cut_anywhere_is_refused_with_the_way_to_mend_it(
    tmp_path: Path, sound: tuple[bytes, list[Entry]]
) -> None:
    data, _ = sound
    for length in [*range(1, 200, 7), *range(200, len(data), 311), *range(len(data) - 50, len(data))]:
        refused = outcome(tmp_path / "cut", data[:length])
        assert isinstance(refused, DamagedRecording)
        assert "was cut off" in str(refused)
        assert "run: igtl-gateway recover" in str(refused)


@pytest.mark.slow
def test_a_damaged_byte_is_refused_or_does_not_matter(tmp_path: Path, sound: tuple[bytes, list[Entry]]) -> None:
    data, entries = sound
    chance = random.Random(4)
    refused = 0
    offsets = [*range(0, len(data), 37), *range(len(data) - 50, len(data))]
    for at in offsets:
        broken = bytearray(data)
        broken[at] ^= 1 << chance.randrange(8)
        result = outcome(tmp_path / "flipped", bytes(broken))
        if isinstance(result, RecordingError):
            refused += 1
        else:
            assert result == entries
    assert refused > len(offsets) // 2


def test_a_damaged_run_of_bytes_is_refused_or_does_not_matter(tmp_path: Path, sound: tuple[bytes, list[Entry]]) -> None:
    data, entries = sound
    chance = random.Random(5)
    for _ in range(500):
        broken = bytearray(data)
        at, length = chance.randrange(len(data)), chance.randrange(1, 200)
        broken[at : at + length] = chance.choice([bytes(length), b"\xff" * length, chance.randbytes(length), b""])
        result = outcome(tmp_path / "overwritten", bytes(broken))
        if not isinstance(result, RecordingError):
            assert result == entries


def test_what_comes_before_the_damage_is_given(tmp_path: Path) -> None:
    writer = SessionWriter(tmp_path / "a", {}, compression="none", chunk_bytes=1000)
    for seq in range(1, 51):
        writer.write(samples.igtl(seq, body=f"body {seq}.".encode()))
    writer.close({})
    data = (tmp_path / "a").read_bytes()
    assert data.count(b"body 40.") == 1
    (tmp_path / "a").write_bytes(data.replace(b"body 40.", b"body 41."))
    given: list[Entry] = []
    with SessionFile.open(tmp_path / "a") as file, pytest.raises(DamagedRecording, match="checksum"):
        given.extend(file.entries())
    assert 0 < len(given) < 40
    assert given == [samples.flat(samples.igtl(n, body=f"body {n}.".encode())) for n in range(1, len(given) + 1)]


@pytest.mark.parametrize(
    ("sequences", "words"),
    [
        ([1, 3, 2], "number 2, expected one above 3"),
        ([1, 1], "number 1"),
        ([0], "number 0"),
        ([1, 2**31 + 1], "number"),
    ],
)
def test_entry_numbers_that_do_not_increase_are_refused(tmp_path: Path, sequences: list[int], words: str) -> None:
    _bag(tmp_path / "a", {layout.SESSION_METADATA: layout.seal({"format_version": "1"})}, sequences=sequences)
    with SessionFile.open(tmp_path / "a") as file, pytest.raises(DamagedRecording, match=words):
        list(file.entries())


def test_a_foreign_message_on_our_channel_is_refused(tmp_path: Path) -> None:
    _bag(
        tmp_path / "a",
        {layout.SESSION_METADATA: layout.seal({"format_version": "1"})},
        ros_type=layout.RAW_MESSAGE_TYPE,
        kind="igtl_in",
        sequences=[1],
    )
    with SessionFile.open(tmp_path / "a") as file, pytest.raises(DamagedRecording, match="RawMessage"):
        list(file.entries())


@pytest.mark.parametrize("version", ["", "one", "-1", "²"])
def test_a_version_that_is_no_number_is_refused(tmp_path: Path, version: str) -> None:
    _bag(tmp_path / "a", {layout.SESSION_METADATA: layout.seal({"format_version": version})})
    with pytest.raises(DamagedRecording, match="format version"):
        SessionFile.open(tmp_path / "a")


# --- foreign ---------------------------------------------------------------------------------------------------


def _bag(
    path: Path,
    metadata: dict[str, dict[str, str]],
    *,
    sequences: list[int] | None = None,
    ros_type: str = STRING,
    kind: str = "ros_in",
    **options: object,
) -> None:
    """An MCAP file of another program."""
    with path.open("wb") as stream:
        writer = Writer(stream, compression=CompressionType.NONE, **options)  # type: ignore[arg-type]
        writer.start("ros2", "another program")
        for name, items in metadata.items():
            writer.add_metadata(name, items)
        schema = writer.register_schema(ros_type, "ros2msg", b"string data")
        marks = {layout.KIND_KEY: kind} if metadata else {}
        channel = writer.register_channel("/chatter", "cdr", schema, marks)
        for log_time, sequence in enumerate([0, 0, 0] if sequences is None else sequences):
            writer.add_message(channel, log_time, samples.string_cdr("hello"), log_time, sequence)
        writer.finish()  # type: ignore[no-untyped-call]


def test_a_plain_bag_is_what_ros_nodes_said(tmp_path: Path) -> None:
    _bag(tmp_path / "a", {})
    with SessionFile.open(tmp_path / "a") as file:
        assert (file.foreign, file.session, file.ledger) == (True, {}, None)
        assert list(file.entries()) == [
            Entry(seq, seq - 1, Kind.ROS_IN, "/chatter", STRING, (samples.string_cdr("hello"),)) for seq in (1, 2, 3)
        ]


def test_channels_in_other_encodings_are_skipped_and_named(tmp_path: Path) -> None:
    with (tmp_path / "a").open("wb") as stream:
        writer = Writer(stream)
        writer.start("", "another program")
        string = writer.register_schema(STRING, "ros2msg", b"string data")
        request = writer.register_schema("a/srv/B_Request", "ros2msg", b"int8 a")
        service = writer.register_schema("a/msg/B", "ros2msg", b"int8 a\n---\nint8 b")
        proto = writer.register_schema("foxglove.Log", "protobuf", b"")
        for topic, encoding, schema in (
            ("/json", "json", 0),
            ("/bare", "cdr", 0),
            ("/good", "cdr", string),
            ("/request", "cdr", request),
            ("/service", "cdr", service),
            ("/proto", "protobuf", proto),
        ):
            channel = writer.register_channel(topic, encoding, schema)
            writer.add_message(channel, 5, samples.string_cdr(topic), 4)
        writer.finish()  # type: ignore[no-untyped-call]
    with SessionFile.open(tmp_path / "a") as file:
        assert [entry.channel for entry in file.entries()] == ["/good"]
        assert file.entry_count == 1
        assert [each.topic for each in file.skipped] == ["/json", "/bare", "/request", "/service", "/proto"]
        assert all(each.why and each.count == 1 for each in file.skipped)


def test_a_session_that_lost_its_metadata_is_still_ours(tmp_path: Path) -> None:
    with (tmp_path / "a").open("wb") as stream:
        writer = Writer(stream)
        writer.start("ros2", "a filter")
        schema = writer.register_schema(STRING, "ros2msg", b"string data")
        ours = writer.register_channel("/a", "cdr", schema, {layout.KIND_KEY: "ros_out"})
        other = writer.register_channel("/b", "cdr", schema)
        writer.add_message(ours, 1, samples.string_cdr("a"), 1, 17)
        writer.add_message(other, 2, samples.string_cdr("b"), 2, 0)
        writer.finish()  # type: ignore[no-untyped-call]
    with SessionFile.open(tmp_path / "a") as file:
        assert not file.foreign
        assert [(entry.seq, entry.kind, entry.channel) for entry in file.entries()] == [(17, Kind.ROS_OUT, "/a")]
        assert [each.topic for each in file.skipped] == ["/b"]


def recorded_bags(folder: Path) -> list[Path]:
    """Recordings as versions of rosbag2 write them."""
    topics_and_services(folder / "services.mcap")
    cdr_mcap(folder / "cdr")
    talker(folder / "talker")
    return sorted(folder.rglob("*.mcap"))


def test_recordings_of_rosbag2_are_read_or_refused(tmp_path: Path) -> None:
    read_files = 0
    for path in recorded_bags(tmp_path):
        try:
            with SessionFile.open(path) as file:
                entries = list(islice(file.entries(), 10_000))
        except UnsupportedRecording:
            continue
        assert file.foreign
        assert entries
        assert all(entry.kind is Kind.ROS_IN for entry in entries)
        assert [entry.seq for entry in entries] == list(range(1, len(entries) + 1))
        assert [entry.stamp_ns for entry in entries] == sorted(entry.stamp_ns for entry in entries)
        read_files += 1
    assert read_files


def test_the_ledger_must_be_json(tmp_path: Path) -> None:
    metadata = {
        layout.SESSION_METADATA: layout.seal({"format_version": "1"}),
        layout.LEDGER_METADATA: layout.seal({layout.LEDGER_KEY: "{"}),
    }
    _bag(tmp_path / "a", metadata)
    with pytest.raises(DamagedRecording, match="ledger"):
        SessionFile.open(tmp_path / "a")


def test_a_disk_that_refuses_to_read(sound: tuple[bytes, list[Entry]]) -> None:
    data, entries = sound
    stream = RefusingStream(data, len(data) + 1)
    with SessionFile(Path("session.mcap"), stream) as file:
        assert file.entry_count == len(entries)
        stream.refuses_from = 100
        with pytest.raises(DamagedRecording, match=r"session\.mcap: cannot be read: Input/output error"):
            list(file.entries())


OTHER = (build.MESSAGE, build.message(2, 0, 6, 6, b""))


def test_a_message_of_a_channel_that_is_not_there_is_refused() -> None:
    """Whether the index counts it, or it is found when the entries are read."""
    made = bag(Chunk((*DEFINITIONS, *messages(5), OTHER)))
    with pytest.raises(DamagedRecording, match="found messages of channel 2, of which there is no record"):
        SessionFile(Path("bag.mcap"), BytesIO(made.finish()))
    hidden = build.statistics(2, 1, 1, 0, 0, 1, 5, 6, {1: 2})
    summary = [(opcode, hidden if opcode == build.STATISTICS else content) for opcode, content in made.summary]
    data = build.finish(made.data, summary)
    with SessionFile(Path("bag.mcap"), BytesIO(data)) as file:
        with pytest.raises(DamagedRecording, match="found a message of channel 2, of which there is no record"):
            list(file.entries())


def test_a_channel_of_a_schema_that_is_not_there_is_refused() -> None:
    lost = (build.CHANNEL, build.channel(2, 7, "/lost", "cdr"))
    with pytest.raises(DamagedRecording, match="channel /lost: found schema 7, which is not there"):
        SessionFile(Path("bag.mcap"), BytesIO(bag(Chunk((*DEFINITIONS, lost, *messages(5)))).finish()))


@pytest.mark.parametrize("messages_first", [True, False])
def test_of_two_definitions_of_a_type_that_of_the_channel_with_messages_counts(
    messages_first: bool, tmp_path: Path
) -> None:
    """Whichever comes first in the file."""
    with (tmp_path / "a").open("wb") as stream:
        writer = Writer(stream)
        writer.start("ros2", "another program")
        texts = {"/used": b"int8 a", "/unused": b"int8 a\nint8 b"}
        names = ["/used", "/unused"] if messages_first else ["/unused", "/used"]
        channels = {}
        for name in names:
            schema = writer.register_schema("a/msg/B", "ros2msg", texts[name])
            channels[name] = writer.register_channel(name, "cdr", schema)
        writer.add_message(channels["/used"], 5, b"\0\1\0\0\7", 4)
        writer.finish()  # type: ignore[no-untyped-call]
    with SessionFile.open(tmp_path / "a") as file:
        assert [entry.channel for entry in file.entries()] == ["/used"]
        assert file.definitions["a/msg/B"].strip() == "int8 a"
        assert [each.topic for each in file.skipped] == ["/unused"]


def test_messages_are_read_in_arrays_and_notes_one_by_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A note has its fields in JSON, so there is no array of them; messages must not be read as notes are."""
    writer = SessionWriter(tmp_path / "a.mcap", samples.SESSION)
    for entry in samples.every_kind(3):
        writer.write(entry)
    writer.close({})
    used: list[Sequence[int]] = []
    blocks = ChunkReader.blocks

    def counted(self: ChunkReader, channels: Sequence[int], *words: int, **more: bool) -> object:
        used.append(channels)
        return blocks(self, channels, *words, **more)

    monkeypatch.setattr(ChunkReader, "blocks", counted)
    with SessionFile.open(tmp_path / "a.mcap") as file:
        for channel in file.channels:
            used.clear()
            is_note = channel.kind in layout.NOTE_KINDS
            assert sum(map(len, file.blocks(channel))) == (0 if is_note else channel.count)
            assert bool(used) is not is_note, channel
