"""The folder of a split recording as ``ros2 bag`` takes it, field by field.

There is no ``ros2 bag`` to be installed as wheels.  So its reader of ``metadata.yaml`` is written down here (rosbag2's
``rosbag2_storage/yaml.hpp`` and ``qos.cpp``, version 9: the fields that it reads, and their types), and each value is
compared with the files by two other readers.
"""

from __future__ import annotations

import shutil
from collections import Counter
from functools import cache
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import Reader
from rosbags.typesys import get_types_from_msg
from ruamel.yaml import YAML

from igtl_gateway.cli import main
from igtl_gateway.record.parts import PartsWriter
from igtl_gateway.record.prologue import Prologue
from igtl_gateway.record.selection import StateInputRule
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.record.sessionfile.writer import SessionWriter
from tests.places import FIXTURES

_U64 = range((1 << 63) - 1)
_TIME = {"sec": _U64, "nsec": _U64}
_QOS = {
    "history": {"keep_last", "keep_all"},
    "depth": range(1 << 31),
    "reliability": {"reliable", "best_effort"},
    "durability": {"volatile", "transient_local"},
    "deadline": _TIME,
    "lifespan": _TIME,
    "liveliness": {"automatic"},
    "liveliness_lease_duration": _TIME,
    "avoid_ros_namespace_conventions": bool,
}
_SPAN = {
    "starting_time": {"nanoseconds_since_epoch": _U64},
    "duration": {"nanoseconds": _U64},
    "message_count": _U64,
}
_TOPIC = {
    "name": str,
    "type": str,
    "serialization_format": {"cdr"},
    "offered_qos_profiles": [_QOS],
    "type_description_hash": str,
}
#: What rosbag2 asks of the side file; a list of one: a sequence of such.
_METADATA = {
    "version": {9},
    "storage_identifier": {"mcap"},
    **_SPAN,
    "topics_with_message_count": [{"topic_metadata": _TOPIC, "message_count": _U64}],
    "relative_file_paths": [str],
    "compression_format": {""},
    "compression_mode": {""},
    "files": [{"path": str, **_SPAN}],
    "custom_data": type(None),
    "ros_distro": {"jazzy"},
}


def fits(found: Any, expected: Any, where: str = "") -> list[str]:
    """Where a value is not what is asked for."""
    match expected:
        case dict():
            if not isinstance(found, dict) or found.keys() != expected.keys():
                return [f"{where}: {found}"]
            return [fault for key in expected for fault in fits(found[key], expected[key], f"{where}.{key}")]
        case [each]:
            if not isinstance(found, list):
                return [f"{where}: {found}"]
            return [fault for at, one in enumerate(found) for fault in fits(one, each, f"{where}[{at}]")]
        case type():
            return [] if isinstance(found, expected) else [f"{where}: {found!r}"]
        case _:
            return [] if not isinstance(found, bool | float) and found in expected else [f"{where}: {found!r}"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A split recording with all types, as the recorder writes it; no test changes it."""
    place = tmp_path_factory.mktemp("rosbag2")
    with SessionFile.open(FIXTURES / "every-type.mcap") as file:
        qos = {(one.topic, one.type): one.qos for one in file.channels}
        parts = PartsWriter(
            place / "long.mcap",
            lambda path, facts, prologue: SessionWriter(
                path,
                {**file.session, **facts},
                qos_of=lambda topic, ros_type: qos.get((topic, ros_type)),
                prologue=prologue,
            ),
            Prologue(StateInputRule(frozenset())),
            max_bytes=0,
            max_s=(file.end_ns - file.start_ns) / 4e9,
            overwrite=False,
            counters=dict,
        )
        for entry in file.entries():
            parts.write(entry)
        parts.close({})
    return place / "long"


@cache
def parsed(text: str) -> Any:
    """A YAML string; hundreds of channels have the same few, and the reader is slow."""
    return YAML(typ="safe").load(text)


def told(folder: Path) -> dict[str, Any]:
    found = parsed((folder / "metadata.yaml").read_text("utf-8"))
    assert list(found) == ["rosbag2_bagfile_information"]
    return dict(found["rosbag2_bagfile_information"])


def check(folder: Path) -> None:
    metadata = told(folder)
    assert fits(metadata, _METADATA) == []
    counts: Counter[tuple[str, str]] = Counter()
    hashes: dict[tuple[str, str], str] = {}
    texts: dict[tuple[str, str], str] = {}
    spans = []
    for name in metadata["relative_file_paths"]:
        with (folder / name).open("rb") as stream:
            reader = make_reader(stream, validate_crcs=True)
            assert reader.get_header().profile == "ros2"
            times = []
            for schema, channel, message in reader.iter_messages():
                assert schema and channel.message_encoding == "cdr"
                key = (channel.topic, schema.name)
                counts[key] += 1
                hashes[key] = channel.metadata.get("topic_type_hash", "")
                texts[key] = channel.metadata["offered_qos_profiles"]
                times.append(message.log_time)
        spans.append((name, times[0], times[-1] - times[0], len(times)))
    assert sorted(path.name for path in folder.glob("*.mcap")) == sorted(metadata["relative_file_paths"])
    assert [span(one) for one in metadata["files"]] == [each[1:] for each in spans]
    assert [one["path"] for one in metadata["files"]] == [each[0] for each in spans]
    profiles = {key: parsed(text) for key, text in texts.items()}
    start_ns, end_ns = spans[0][1], spans[-1][1] + spans[-1][2]
    assert span(metadata) == (start_ns, end_ns - start_ns, counts.total())
    rows = {(row["topic_metadata"]["name"], row["topic_metadata"]["type"]): row for row in metadata[_ROWS]}
    assert len(rows) == len(metadata[_ROWS])
    assert {key: row["message_count"] for key, row in rows.items()} == counts
    assert {key: row["topic_metadata"]["type_description_hash"] for key, row in rows.items()} == hashes
    assert {key: row["topic_metadata"]["offered_qos_profiles"] for key, row in rows.items()} == profiles


_ROWS = "topics_with_message_count"


def span(row: dict[str, Any]) -> tuple[int, int, int]:
    start_ns = row["starting_time"]["nanoseconds_since_epoch"]
    return start_ns, row["duration"]["nanoseconds"], row["message_count"]


def test_the_side_file_is_what_rosbag2_asks_for(folder: Path) -> None:
    assert len(told(folder)["files"]) > 3
    check(folder)


def test_so_is_that_of_a_recovered_folder(folder: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(folder, tmp_path / "long")
    last = folder / told(folder)["relative_file_paths"][-1]
    last.write_bytes(last.read_bytes()[:-400])
    (folder / "metadata.yaml").unlink()
    assert main(["recover", str(folder), "-o", str(folder.with_name("whole"))]) in (0, 1)
    check(folder.with_name("whole"))


def test_rosbags_plays_the_folder_in_order(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # each of the files has all definitions: rosbags is slow to read them, and need not read the same text again
    monkeypatch.setattr("rosbags.highlevel.anyreader.get_types_from_msg", cache(get_types_from_msg))
    with SessionFile.open(folder) as file:
        expected = [entry.stamp_ns for entry in file.entries()]
    with Reader(folder) as reader:
        assert [stamp for _, stamp, _ in reader.messages()] == expected
    with AnyReader([folder]) as reader:
        for connection, _, data in reader.messages():
            reader.deserialize(data, connection.msgtype)


def test_the_list_of_fields_is_strict(folder: Path) -> None:
    metadata = told(folder)
    changes: list[dict[str, Any]] = [{"custom_data": {}}, {"version": 8}, {"more": 1}, {"files": None}]
    for change in (*changes, {"message_count": -1}):
        assert fits({**metadata, **change}, _METADATA) != []
