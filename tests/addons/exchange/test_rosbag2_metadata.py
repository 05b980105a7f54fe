"""``metadata.yaml`` of other shapes, names that leave the folder, and formats that differ from the storage's."""

from __future__ import annotations

import json
import os
import sqlite3
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
import zstandard

from igtl_gateway.addons.exchange.rosbag2 import Rosbag2
from igtl_gateway.addons.exchange.rosbag2_metadata import METADATA, read_metadata
from igtl_gateway.base.errors import DamagedRecording, RecordingError
from tests.tables import table

STRING = "std_msgs/msg/String"
CDR = b"\0\1\0\0\4\0\0\0abc\0"
MIB = 1 << 20


def storage(path: Path, data: bytes = CDR, encoding: str = "cdr") -> Path:
    with closing(sqlite3.connect(path)) as base:
        base.execute("CREATE TABLE topics(id INTEGER PRIMARY KEY, name, type, serialization_format)")
        base.execute("CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id, timestamp, data)")
        base.execute("INSERT INTO topics VALUES(1, '/t', ?, ?)", (STRING, encoding))
        base.executemany("INSERT INTO messages VALUES(?, 1, ?, ?)", [(i, i, data) for i in range(1, 4)])
        base.commit()
    return path


def bag(folder: Path, **changes: Any) -> Path:
    folder.mkdir(exist_ok=True)
    topic = {"name": "/t", "type": STRING, "serialization_format": changes.pop("format", "cdr")}
    content = {
        "version": 5,
        "storage_identifier": "sqlite3",
        "relative_file_paths": ["x.db3"],
        "topics_with_message_count": [{"topic_metadata": topic, "message_count": 3}],
        "compression_mode": "",
        **changes,
    }
    (folder / METADATA).write_text(json.dumps({"rosbag2_bagfile_information": content}))
    return folder


WRONG: dict[str, tuple[Any, ...]] = {
    "version": ("x", [], {}, None, -1, 2**70),
    "relative_file_paths": ("x", {"a": 1}, 5, [[]], [None, []]),
    "topics_with_message_count": ("x", 5, ["x"], [{}], [{"topic_metadata": []}], [{"topic_metadata": {"name": []}}]),
    "storage_identifier": ([], {}),
    "compression_mode": ([], {}),
}


@table(("field", "value"), [(name, value) for name, values in WRONG.items() for value in values])
def test_other_shapes_are_named_with_their_place(tmp_path: Path, field: str, value: Any) -> None:
    folder = bag(tmp_path / "bag", **{field: value})
    storage(folder / "x.db3")
    with pytest.raises(DamagedRecording, match=rf"metadata\.yaml: .*{field}|found no ") as found:
        Rosbag2(folder)
    assert "expected" in str(found.value) or "which metadata.yaml names" in str(found.value)


@pytest.mark.parametrize("text", ["", "[]", "x", "rosbag2_bagfile_information: []", "a: 1", "\xff"])
def test_other_documents_are_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / METADATA).write_bytes(text.encode("latin-1"))
    with pytest.raises(DamagedRecording, match=METADATA):
        read_metadata(tmp_path)


@table("name", ["../../etc/passwd", "/etc/passwd", "..", "", ".", "pipe", "link", "x\0y", "a" * 300, "sub"])
def test_files_lie_in_the_folder(tmp_path: Path, name: str) -> None:
    folder = bag(tmp_path / "bag", relative_file_paths=[name])
    storage(tmp_path / "outside.db3")
    os.mkfifo(folder / "pipe")
    (folder / "link").symlink_to(tmp_path / "outside.db3")
    (folder / "sub").mkdir()
    with pytest.raises(RecordingError, match="bag"):
        Rosbag2(folder)


def test_a_fifo_in_place_of_the_metadata(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / METADATA)
    with pytest.raises(RecordingError, match="found a FIFO, expected a file"):
        Rosbag2(tmp_path)


def test_a_file_is_read_once(tmp_path: Path) -> None:
    folder = bag(tmp_path / "bag", relative_file_paths=["x.db3", "bag/x.db3"])
    storage(folder / "x.db3")
    with pytest.raises(DamagedRecording, match="found a file twice"):
        Rosbag2(folder)


def test_a_serialization_format_other_than_that_of_the_storage_is_told(tmp_path: Path) -> None:
    folder = bag(tmp_path / "bag", format="json")
    storage(folder / "x.db3")
    with closing(Rosbag2(folder)) as source:
        assert len(list(source.items())) == 3
        assert source.notes == [
            "metadata.yaml declares the serialization 'json' of /t, its storage 'cdr': read as 'cdr'"
        ]
    (folder / "x.db3").unlink()
    bag(folder)
    storage(folder / "x.db3", encoding="json")
    with closing(Rosbag2(folder)) as source:
        assert list(source.items()) == []
        assert source.notes == ["metadata.yaml declares the serialization 'cdr' of /t, its storage 'json': left out"]
        assert [(row.left_out, row.why) for row in source.rows] == [(3, "encoding 'json', not cdr")]


def test_a_storage_other_than_that_of_the_metadata_is_told(tmp_path: Path) -> None:
    folder = bag(tmp_path / "bag", storage_identifier="mcap")
    storage(folder / "x.db3")
    with closing(Rosbag2(folder)) as source:
        assert source.notes == ["metadata.yaml declares the storage mcap, but x.db3 is sqlite3"]


@pytest.mark.parametrize("told", [True, False])
def test_packed_files_and_messages_that_are_bombs(tmp_path: Path, told: bool) -> None:
    bomb = zstandard.ZstdCompressor(write_content_size=told).compress(bytes(80 * MIB))
    by_message = bag(tmp_path / "bag", compression_mode="MESSAGE")
    storage(by_message / "x.db3", data=bomb)
    with closing(Rosbag2(by_message)) as source, pytest.raises(DamagedRecording, match=r"/t at 1 ns: .*--limit ratio"):
        list(source.items())
    (tmp_path / "y.db3.zstd").write_bytes(bomb)
    with pytest.raises(DamagedRecording, match=r"y\.db3\.zstd: .* packed bytes: found \d+, expected at most"):
        Rosbag2(tmp_path / "y.db3.zstd")


def test_messages_that_are_a_bomb_together(tmp_path: Path) -> None:
    folder = bag(tmp_path / "bag", compression_mode="MESSAGE")
    storage(folder / "x.db3", data=zstandard.ZstdCompressor().compress(bytes(30 * MIB)))
    with closing(Rosbag2(folder)) as source, pytest.raises(DamagedRecording, match="all messages so far: found"):
        list(source.items())
