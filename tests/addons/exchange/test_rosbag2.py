"""rosbag2 recordings of every storage: written by rosbags, read by us."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import pytest
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from igtl_gateway.addons.exchange.rosbag2 import Rosbag2
from igtl_gateway.addons.exchange.rosbag2_metadata import METADATA
from igtl_gateway.addons.exchange.source import ImportedItem, ImportedStream
from igtl_gateway.base.errors import DamagedRecording, UnsupportedRecording
from tests.foreign_bags import cdr_mcap, cdr_sqlite3, dashing, talker, topics_and_services

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
    assert "string data" in told[0]
    assert told[1] == ROS2.hash_rihs01(STRING)


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
        (topics_and_services, "some.mcap", {"/parameter_events": 7}),
    ],
)
def test_recordings_of_every_version_come_whole(
    tmp_path: Path, write: Callable[[Path], Path], name: str, counts: dict[str, int]
) -> None:
    items, rows, _ = read(write(tmp_path / name))
    assert {row.stream: row.taken for row in rows if row.taken} == counts
    assert len(items) == sum(counts.values())
    assert all(row.good for row in rows)


def test_service_events_are_left_out_by_name(tmp_path: Path) -> None:
    _, rows, _ = read(topics_and_services(tmp_path / "some.mcap"))
    assert {(row.stream, row.left_out, row.why) for row in rows if row.left_out} == {
        ("/add_two_ints/_service_event", 6, "service events, not a topic")
    }
