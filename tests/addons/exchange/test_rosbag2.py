"""rosbag2 recordings of every storage: written by rosbags, read by us."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
from mcap.reader import make_reader
from mcap.writer import Writer as McapWriter
from rosbags.rosbag2 import CompressionFormat, CompressionMode, Reader, StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from igtl_gateway.addons.exchange.rosbag2 import Rosbag2
from igtl_gateway.addons.exchange.rosbag2_metadata import METADATA, read_metadata
from igtl_gateway.addons.exchange.source import ImportedItem, ImportedStream
from igtl_gateway.base.errors import DamagedRecording, UnsupportedRecording
from igtl_gateway.base.untrusted.dialects import RULE
from igtl_gateway.cli import main
from igtl_gateway.convert.exchanges import REQUEST_SENT
from igtl_gateway.record.sessionfile.reader import SessionFile
from tests import exchanges
from tests.foreign_bags import cdr_mcap, cdr_sqlite3, dashing, talker, topics_and_services
from tests.tables import table

ROS2 = get_typestore(Stores.ROS2_JAZZY)
STRING = "std_msgs/msg/String"


def text(value: str) -> bytes:
    return bytes(ROS2.serialize_cdr(ROS2.types[STRING](data=value), STRING))


def recording(
    path: Path, storage: StoragePlugin, mode: CompressionMode = CompressionMode.NONE, start: int = 1000
) -> Path:
    writer = Writer(path, version=9, storage_plugin=storage)
    if mode is not CompressionMode.NONE:
        writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        one = writer.add_connection("/one", STRING, typestore=ROS2)
        two = writer.add_connection("/two", STRING, typestore=ROS2)
        for index in range(5):
            writer.write(one if index % 2 else two, start + 10 * index, text(f"{start} {index}"))
    return path


def read(path: Path) -> tuple[list[ImportedItem], list[ImportedStream], list[str]]:
    with closing(Rosbag2(path)) as source:
        return list(source.items()), source.rows, source.notes


@pytest.mark.parametrize("storage", StoragePlugin)
@pytest.mark.parametrize("mode", [CompressionMode.NONE, CompressionMode.MESSAGE, CompressionMode.FILE])
def test_all_messages_of_a_directory(tmp_path: Path, storage: StoragePlugin, mode: CompressionMode) -> None:
    items, rows, notes = read(recording(tmp_path / "bag", storage, mode))
    assert [(item.time_ns, item.channel, bytes(item.payload)) for item in items] == [
        (1000 + 10 * index, "/one" if index % 2 else "/two", text(f"1000 {index}")) for index in range(5)
    ]
    assert {row.stream: (row.declared, row.taken) for row in rows} == {"/one": (2, 2), "/two": (3, 3)}
    assert notes == []


@pytest.mark.parametrize("storage", StoragePlugin)
def test_parts_are_merged_by_time_and_the_metadata_is_held_against_them(tmp_path: Path, storage: StoragePlugin) -> None:
    path = recording(tmp_path / "bag", storage)
    first = next(file for file in path.iterdir() if file.name != METADATA)
    other = recording(tmp_path / "other", storage, start=1005)
    (second,) = (file for file in other.iterdir() if file.name != METADATA)
    second.rename(path / f"bag_1{second.suffix}")
    told = (path / METADATA).read_text()
    (path / METADATA).write_text(told.replace(f"- {first.name}", f"- {first.name}\n  - bag_1{second.suffix}", 1))
    items, rows, notes = read(path)
    times = [item.time_ns for item in items]
    assert times == sorted(times)
    assert len(times) == 10
    assert not any(row.good for row in rows)  # the metadata still declares the first part's
    assert notes == [
        f"{METADATA} declares {n} messages of {t}, {2 * n} are stored" for t, n in (("/one", 2), ("/two", 3))
    ]
    (path / METADATA).unlink()
    items, rows, notes = read(path)
    assert (len(items), notes) == (10, [])
    assert all(row.good for row in rows)


@pytest.mark.parametrize("storage", StoragePlugin)
def test_a_file_alone(tmp_path: Path, storage: StoragePlugin) -> None:
    path = recording(tmp_path / "bag", storage)
    (file,) = (file for file in path.iterdir() if file.name != METADATA)
    before = file.read_bytes()
    items, rows, _ = read(file)
    assert len(items) == 5
    assert all(row.good for row in rows)
    assert file.read_bytes() == before
    assert len(list(path.iterdir())) == 2  # nothing beside it either


def test_the_files_own_definition_is_given(tmp_path: Path) -> None:
    with closing(Rosbag2(recording(tmp_path / "bag", StoragePlugin.MCAP))) as source:
        told = source.definition_of(STRING)
    assert told
    assert b"string data" in told.data
    assert told.type_hash == ROS2.hash_rihs01(STRING)


@pytest.mark.parametrize("storage", StoragePlugin)
def test_damaged_files_are_refused(tmp_path: Path, storage: StoragePlugin) -> None:
    path = recording(tmp_path / "bag", storage)
    (file,) = (file for file in path.iterdir() if file.name != METADATA)
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    with pytest.raises(DamagedRecording, match=file.name):
        read(path)
    file.unlink()
    with pytest.raises(DamagedRecording, match=file.name):
        read(path)
    (path / METADATA).write_text("nothing: [")
    with pytest.raises(DamagedRecording, match=METADATA):
        read(path)


def test_a_directory_without_a_recording(tmp_path: Path) -> None:
    with pytest.raises(UnsupportedRecording, match="expected a rosbag2 recording"):
        Rosbag2(tmp_path)


@pytest.mark.parametrize(
    ("write", "name", "counts"),
    [
        (dashing, "old", {"/imu": 156, "/pose": 156}),
        (cdr_mcap, "cdr", {"/array_topic": 4, "/test_topic": 3}),
        (cdr_sqlite3, "cdr", {"/array_topic": 4, "/test_topic": 3}),
        (talker, "talker", {"/topic": 10, "/rosout": 10}),
        (topics_and_services, "some.mcap", {"/parameter_events": 7, "/add_two_ints/_service_event": 6}),
    ],
)
def test_recordings_of_every_version_come_whole(
    tmp_path: Path, write: Callable[[Path], Path], name: str, counts: dict[str, int]
) -> None:
    items, rows, _ = read(write(tmp_path / name))
    assert {row.stream: row.taken for row in rows if row.taken} == counts
    assert len(items) == sum(counts.values())
    assert all(row.good for row in rows)


#: The text that rosbag2 writes for the events of a service, and its encoding: at first; then without other types, which
#: rosbags refuses with the whole file; with them.
TEXTS_OF_EVENTS = {
    "2023": ("ros2msg", "bool a\n---\nbool b\n"),
    "alone": ("unknown", f"{RULE}\nSRV: p/srv/S\nbool a\n---\nbool b\n"),
    "with types": ("ros2msg", f"{RULE}\nSRV: p/srv/S\np/T a\n---\np/T b\n\n{RULE}\nMSG: p/T\nbool t\n"),
}


ASKED = exchanges.event(REQUEST_SENT, 0, 1, request=b"\1")


def of_a_service_in_mcap(path: Path, encoding: str, text: str) -> None:
    with path.open("wb") as stream:
        writer = McapWriter(stream)
        writer.start("ros2", "test")
        schema = writer.register_schema("p/srv/S_Event", encoding, text.encode())
        channel = writer.register_channel("/s/_service_event", "cdr", schema)
        writer.add_message(channel, 5, ASKED, 5)
        writer.finish()  # type: ignore[no-untyped-call]


def of_a_service_in_sqlite(path: Path, encoding: str, text: str) -> None:
    """The definition stands under the type of the service."""
    with closing(sqlite3.connect(path)) as base:
        base.execute("CREATE TABLE topics(id, name, type, serialization_format)")
        base.execute("CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id, timestamp, data)")
        base.execute("CREATE TABLE message_definitions(topic_type, encoding, encoded_message_definition)")
        base.execute("INSERT INTO topics VALUES (1, '/s/_service_event', 'p/srv/S_Event', 'cdr')")
        base.execute("INSERT INTO messages VALUES (1, 1, 5, ?)", (ASKED,))
        base.execute("INSERT INTO message_definitions VALUES ('p/srv/S', ?, ?)", (encoding, text))
        base.commit()


@table(("encoding", "text"), TEXTS_OF_EVENTS.values(), ids=TEXTS_OF_EVENTS)
@pytest.mark.parametrize("write", [of_a_service_in_mcap, of_a_service_in_sqlite])
def test_the_events_of_services_come_with_a_definition_that_all_read(
    write: Callable[[Path, str, str], None], encoding: str, text: str
) -> None:
    with TemporaryDirectory() as name:
        path = Path(name, "bag")
        write(path, encoding, text)
        with closing(Rosbag2(path)) as source:
            assert [item.payload for item in source.items()] == [ASKED]
            found = source.definition_of("p/srv/S_Event")
    assert found and found.encoding == "ros2msg"
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(found.data.decode(), "p/srv/S_Event"))
    assert {"p/msg/S_Request", "p/msg/S_Response", "service_msgs/msg/ServiceEventInfo"} <= store.fielddefs.keys()


def test_compressed_messages_show_themselves(tmp_path: Path) -> None:
    """One file of a recording whose ``metadata.yaml`` is lost: rosbag2 writes the compression nowhere else."""
    for storage in StoragePlugin:
        folder = recording(tmp_path / storage.name, storage, CompressionMode.MESSAGE)
        (file,) = (each for each in folder.iterdir() if each.name != METADATA)
        items, rows, notes = read(file)
        assert {bytes(item.payload) for item in items} == {text(f"1000 {index}") for index in range(5)}
        assert all(row.good for row in rows)
        assert notes == ["each message is compressed with zstd, which the file does not state"]


def bag(path: Path, *messages: bytes, **metadata: dict[str, str]) -> Path:
    with path.open("wb") as stream:
        writer = McapWriter(stream)
        writer.start("ros2", "test")
        for name, items in metadata.items():
            writer.add_metadata(name.replace("__", "."), items)
        for name in ("calibration.yaml", "configuration.json"):
            writer.add_attachment(5, 6, name, "text/plain", name.encode())
        channel = writer.register_channel("/a", "cdr", writer.register_schema(STRING, "ros2msg", b"string data\r\n"))
        for number, data in enumerate(messages, 1):
            writer.add_message(channel, number, data, number)
        writer.finish()  # type: ignore[no-untyped-call]
    return path


def test_bytes_that_are_no_cdr_are_missing(tmp_path: Path) -> None:
    items, rows, _ = read(bag(tmp_path / "a.mcap", text("good"), b"LZ4\x01....", b"\0\1", text("good")))
    assert [item.time_ns for item in items] == [1, 4]
    assert (rows[0].good, rows[0].taken, rows[0].declared) == (False, 2, 4)
    assert rows[0].why == "some are no CDR, the latest at 3 ns begins with 0001"


def test_what_is_beside_the_messages_comes_along(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Attachments, metadata records and custom data: into the session, its slices, and back into a bag."""
    told = "version: 9\ncustom_data:\n  patient: phantom\n  run: '3'\n"
    place = bag(
        tmp_path / "a.mcap", text("one"), text("two"),
        robot={"arm": "left"}, rosbag2={"serialized_metadata": told}, igtl_gateway__ledger={"ledger": "{}"},
    )  # fmt: skip
    assert main(["import", str(place), "-o", str(tmp_path / "s.mcap"), "--json"]) == 0
    rows = {row["stream"]: (row["declared"], row["imported"]) for row in json.loads(capsys.readouterr().out)["rows"]}
    assert rows == {"/a": (2, 2), "attachments": (2, 2), "metadata records": (2, 2), "custom_data": (2, 2)}
    assert main(["slice", str(tmp_path / "s.mcap"), "-o", str(tmp_path / "t.mcap")]) == 0
    assert main(["export", str(tmp_path / "t.mcap"), "--to", "rosbag2", "-o", str(tmp_path / "bag")]) == 0
    for path in (tmp_path / "s.mcap", tmp_path / "t.mcap", tmp_path / "bag" / "bag_0.mcap"):
        with path.open("rb") as stream:
            reader = make_reader(stream)
            found = {each.name: (each.create_time, each.log_time, each.data) for each in reader.iter_attachments()}
            assert found["calibration.yaml"] == (5, 6, b"calibration.yaml"), path
            assert found["imported/configuration.json"] == (5, 6, b"configuration.json"), path
            metadata = {each.name: each.metadata for each in reader.iter_metadata()}
            assert metadata["robot"] == {"arm": "left"} and metadata["imported.igtl_gateway.ledger"] == {"ledger": "{}"}
            (schema,) = (each for each in reader.get_summary().schemas.values() if each.name == STRING)  # type: ignore[union-attr]
            assert schema.data == b"string data\r\n"
    with SessionFile.open(tmp_path / "t.mcap") as session:
        assert json.loads(session.session["custom_data"]) == {"patient": "phantom", "run": "3"}
    assert read_metadata(tmp_path / "bag").custom == {"patient": "phantom", "run": "3"}
    with Reader(tmp_path / "bag") as again:  # which refuses metadata that it cannot read
        assert again.message_count == 2


def test_messages_with_another_definition_of_their_type_are_missing(tmp_path: Path) -> None:
    with (tmp_path / "a.mcap").open("wb") as stream:
        writer = McapWriter(stream)
        writer.start("ros2", "test")
        for number, definition in enumerate((b"string data\n", b"string data # words\r\n", b"int32 data\n"), 1):
            schema = writer.register_schema(STRING, "ros2msg", definition)
            channel = writer.register_channel(f"/{number}", "cdr", schema)
            writer.add_message(channel, number, text("abc"), number)
        writer.finish()  # type: ignore[no-untyped-call]
    items, rows, _ = read(tmp_path / "a.mcap")
    assert [item.channel for item in items] == ["/1", "/2"]
    assert {row.stream: row.good for row in rows} == {"/1": True, "/2": True, "/3": False}
    assert rows[2].why == "1 have another definition of std_msgs/msg/String than the first one of the file"
