"""The folder of a split recording: names of its parts, and ``metadata.yaml``, the side file that ``ros2 bag`` needs.

``name.mcap`` becomes ``name/name_0.mcap``, ``name/name_1.mcap`` …  The side file names the complete parts.
"""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from igtl_gateway.record.sessionfile import layout
from igtl_gateway.record.sessionfile.new_file import write_text

if TYPE_CHECKING:
    from igtl_gateway.record.sessionfile.stream import McapStream

SIDE_FILE = "metadata.yaml"


@dataclass(frozen=True, slots=True)
class TopicCount:
    """Messages of a topic in a file."""

    topic: str
    type: str
    qos: str
    type_hash: str
    count: int


@dataclass(frozen=True, slots=True)
class RecordingPart:
    """A complete part: first and last stamp in UTC ns (0: no entries), entries, and bytes of the file."""

    path: Path
    start_ns: int
    end_ns: int
    entries: int
    topics: tuple[TopicCount, ...]
    size: int


def topic_counts(mcap: McapStream) -> list[TopicCount]:
    """Messages of a finished file by topic and type; channels of one topic together."""
    found: dict[tuple[str, str], TopicCount] = {}
    counts = mcap.statistics().channel_message_counts
    names = {schema.id: schema.name for schema in mcap.schemas}
    for channel in mcap.channels:
        key = (channel.topic, names.get(channel.schema_id, ""))
        if key not in found:
            qos = layout.parse_qos_yaml(channel.metadata.get(layout.QOS_KEY, ""))
            type_hash = channel.metadata.get(layout.TYPE_HASH_KEY, "")
            found[key] = TopicCount(*key, layout.qos_yaml(qos) if qos else "", type_hash, 0)
        found[key] = replace(found[key], count=found[key].count + counts.get(channel.id, 0))
    return list(found.values())


def parts_folder(path: Path) -> Path:
    """The folder of the parts of ``name.mcap``."""
    return path.with_suffix("") if path.suffix == ".mcap" else path


def part_path(folder: Path, number: int) -> Path:
    """The file of a part; ``number`` counts from 0."""
    return folder / f"{folder.name}_{number}.mcap"


def part_files(folder: Path) -> list[Path]:
    """The files that may be parts of a split recording, by name; other things with such names are not."""
    return sorted(path for path in folder.glob("*.mcap") if path.is_file())


def files_of(folder: Path) -> list[Path]:
    """The files of a split recording that are in its folder, complete or not."""
    found = [folder / SIDE_FILE, *folder.glob(f"{folder.name}_*.mcap")]
    return [path for path in found if path.exists()]


def write_side_file(folder: Path, parts: Sequence[RecordingPart]) -> None:
    """Write ``metadata.yaml``; at any moment there is either the old one or the new one.  Raises OSError."""
    path, new = folder / SIDE_FILE, folder / f".{SIDE_FILE}"
    try:
        write_text(new, side_file_text(parts))
        os.replace(new, path)
    except OSError:
        with contextlib.suppress(OSError):
            new.unlink()
        raise


def side_file_text(parts: Sequence[RecordingPart]) -> str:
    """``metadata.yaml`` as rosbag2 (Jazzy, version 9) writes it."""
    full = [part for part in parts if part.entries]
    start_ns = min((part.start_ns for part in full), default=0)
    end_ns = max((part.end_ns for part in full), default=0)
    lines = [
        "rosbag2_bagfile_information:",
        "  version: 9",
        "  storage_identifier: mcap",
        *_span("  ", start_ns, end_ns - start_ns, sum(part.entries for part in parts)),
        "  topics_with_message_count:" + ("" if full else " []"),
    ]
    for topic in _merged(parts):
        profiles = [f"          {line}" for line in topic.qos.splitlines()]
        lines += [
            "    - topic_metadata:",
            f"        name: {json.dumps(topic.topic)}",
            f"        type: {json.dumps(topic.type)}",
            f"        serialization_format: {layout.MESSAGE_ENCODING}",
            "        offered_qos_profiles:" + ("" if profiles else " []"),
            *profiles,
            f"        type_description_hash: {json.dumps(topic.type_hash)}",
            f"      message_count: {topic.count}",
        ]
    none = "" if parts else " []"
    lines += ['  compression_format: ""', '  compression_mode: ""', f"  relative_file_paths:{none}"]
    lines += [f"    - {json.dumps(part.path.name)}" for part in parts]
    lines.append(f"  files:{none}")
    for part in parts:
        lines.append(f"    - path: {json.dumps(part.path.name)}")
        lines += _span("      ", part.start_ns, part.end_ns - part.start_ns, part.entries)
    return "\n".join([*lines, "  custom_data: ~", "  ros_distro: jazzy", ""])


def _span(indent: str, start_ns: int, duration_ns: int, messages: int) -> list[str]:
    return [
        f"{indent}starting_time:",
        f"{indent}  nanoseconds_since_epoch: {start_ns}",
        f"{indent}duration:",
        f"{indent}  nanoseconds: {duration_ns}",
        f"{indent}message_count: {messages}",
    ]


def _merged(parts: Sequence[RecordingPart]) -> list[TopicCount]:
    topics: dict[tuple[str, str], TopicCount] = {}
    for topic in (topic for part in parts for topic in part.topics):
        before = topics.get((topic.topic, topic.type))
        topics[topic.topic, topic.type] = replace(topic, count=topic.count + (before.count if before else 0))
    return list(topics.values())
