"""The folder of a split recording: names, and a side file that is whole at any moment."""

from __future__ import annotations

from pathlib import Path

import pytest
from ruamel.yaml import YAML

from igtl_gateway.record.sessionfile import side_file
from igtl_gateway.record.sessionfile.side_file import RecordingPart, TopicCount


def part(folder: Path, number: int, *counts: TopicCount) -> RecordingPart:
    entries = sum(topic.count for topic in counts)
    start_ns = 100 * number + 100 if entries else 0
    return RecordingPart(side_file.part_path(folder, number), start_ns, start_ns and start_ns + 9, entries, counts, 1)


def test_names(tmp_path: Path) -> None:
    assert side_file.parts_folder(Path("a/run.mcap")) == side_file.parts_folder(Path("a/run")) == Path("a/run")
    folder = tmp_path / "run"
    folder.mkdir()
    for name in ("run_0.mcap", "run_10.mcap", "other.mcap", "notes.txt"):
        (folder / name).touch()
    assert {path.name for path in side_file.files_of(folder)} == {"run_0.mcap", "run_10.mcap"}
    side_file.write_side_file(folder, [])
    assert side_file.files_of(folder)[0].name == side_file.SIDE_FILE


def test_topics_of_all_parts_are_counted_together(tmp_path: Path) -> None:
    one, two = TopicCount("/a", "A", "- depth: 1\n", "RIHS01_0", 3), TopicCount("/b", "B", "", "", 1)
    parts = [part(tmp_path, 0, one), part(tmp_path, 1, one, two), part(tmp_path, 2)]
    side_file.write_side_file(tmp_path, parts)
    found = YAML(typ="safe").load((tmp_path / side_file.SIDE_FILE).read_text("utf-8"))["rosbag2_bagfile_information"]
    assert (found["message_count"], found["starting_time"], found["duration"]) == (
        7, {"nanoseconds_since_epoch": 100}, {"nanoseconds": 109},
    )  # fmt: skip
    topics = found["topics_with_message_count"]
    assert [(each["topic_metadata"]["name"], each["message_count"]) for each in topics] == [("/a", 6), ("/b", 1)]
    assert [each["message_count"] for each in found["files"]] == [3, 4, 0]


def test_a_side_file_that_cannot_be_written_leaves_nothing(tmp_path: Path) -> None:
    (tmp_path / side_file.SIDE_FILE).mkdir()
    with pytest.raises(OSError):
        side_file.write_side_file(tmp_path, [])
    assert [path.name for path in tmp_path.iterdir()] == [side_file.SIDE_FILE]
