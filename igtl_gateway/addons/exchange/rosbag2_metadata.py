"""Reads ``metadata.yaml`` of rosbag2: the files of a recording, and the declared counts and formats of its topics.

The importer compares these with the storage files.  Errors name the place in ``metadata.yaml``.
"""

from __future__ import annotations

import json
import re
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any

from igtl_gateway.addon import DamagedRecording, UnsupportedRecording
from igtl_gateway.addon.terminal import natural
from igtl_gateway.addon.untrusted import files, limits, parse_yaml

METADATA = "metadata.yaml"
_NEWEST = 9
_SUFFIXES = (".mcap", ".db3", ".mcap.zstd", ".db3.zstd")
_ROOT = "rosbag2_bagfile_information"

#: Topic and type.
Key = tuple[str, str]


@dataclass(frozen=True, slots=True)
class BagMetadata:
    """The content of ``metadata.yaml``.

    Attributes:
        found: whether the file exists.
        names: names of the storage files.
        storage: ``sqlite3`` or ``mcap``; ``""`` if unset.
        by_message: whether each message is compressed by itself.
        counts: number of messages by topic and type.
        formats: serialization format by topic and type.
        custom: ``custom_data``: keys and values of the user.
    """

    found: bool = False
    names: tuple[str, ...] = ()
    storage: str = ""
    by_message: bool = False
    counts: dict[Key, int] = field(default_factory=dict)
    formats: dict[Key, str] = field(default_factory=dict)
    custom: dict[str, str] = field(default_factory=dict)


def read_metadata(folder: Path) -> BagMetadata:
    """Read the metadata of a recording's directory.  Raises UnsupportedRecording, DamagedRecording."""
    path = folder / METADATA
    if not path.exists() and not path.is_symlink():
        return BagMetadata()
    try:
        text = files.read_bytes(path).decode("utf-8")
    except UnicodeDecodeError as error:
        raise DamagedRecording(f"{path}: found invalid UTF-8 at byte {error.start}, expected UTF-8") from None
    reader = _ShapeReader(path)
    content = reader.mapping(reader.mapping(parse_yaml(text, str(path)), "document").get(_ROOT), _ROOT)
    version = reader.number(content.get("version"), "version")
    if version > _NEWEST:
        raise UnsupportedRecording(f"{path}: found version {version}, expected at most {_NEWEST}")
    counts: dict[Key, int] = {}
    formats: dict[Key, str] = {}
    for index, row in enumerate(reader.rows(content, "topics_with_message_count")):
        at = f"topics_with_message_count[{index}]"
        topic = reader.mapping(reader.mapping(row, at).get("topic_metadata"), f"{at}.topic_metadata")
        key = reader.text(topic.get("name"), f"{at}.name"), reader.text(topic.get("type"), f"{at}.type")
        counts[key] = counts.get(key, 0) + reader.number(row.get("message_count"), f"{at}.message_count")
        formats[key] = reader.text(topic.get("serialization_format", ""), f"{at}.serialization_format")
    names = [reader.text(name, "relative_file_paths") for name in reader.rows(content, "relative_file_paths")]
    return BagMetadata(
        True,
        tuple(names),
        reader.text(content.get("storage_identifier", ""), "storage_identifier"),
        reader.text(content.get("compression_mode", ""), "compression_mode").lower() == "message",
        counts,
        formats,
        _custom(content, reader),
    )


def custom_data(text: str, place: str) -> dict[str, str]:
    """Return ``custom_data`` of the metadata that an MCAP file of rosbag2 has in it.  Raises DamagedRecording."""
    content = parse_yaml(text, f"{place}: metadata record rosbag2")
    return _custom(content, _ShapeReader(Path(place))) if isinstance(content, dict) else {}


def _custom(content: dict[str, Any], reader: _ShapeReader) -> dict[str, str]:
    found = content.get("custom_data")
    if found in (None, "", "~", "null", []):
        return {}
    rows = reader.mapping(found, "custom_data")
    return {str(key): value if isinstance(value, str) else json.dumps(value) for key, value in rows.items()}


def storage_files(folder: Path, metadata: BagMetadata) -> list[Path]:
    """Return the storage files of a recording: those in its metadata, or without names all in the directory.

    Old metadata contains the name of the directory before that of the file.  Only files in the directory are opened.
    Raises DamagedRecording, UnsupportedRecording.
    """
    limits.check_limit("count", len(metadata.names), f"{folder / METADATA}: files")
    names = [PurePosixPath(name).name for name in metadata.names]
    if len(set(names)) < len(names):
        raise DamagedRecording(f"{folder / METADATA}: found a file twice, expected each file once")
    if missing := [name for name in names if not name or not _exists(folder / name)]:
        more = f" and {len(missing) - 5} more" if len(missing) > 5 else ""
        raise DamagedRecording(f"{folder}: found no {', '.join(missing[:5])}{more}, which {METADATA} names")
    if names:
        return [files.sibling_file(folder / METADATA, name) for name in names]
    found = sorted(
        (file for file in folder.iterdir() if file.name.endswith(_SUFFIXES)), key=lambda file: natural(file.name)
    )
    if not found:
        raise UnsupportedRecording(f"{folder}: found no .mcap or .db3 file, expected a rosbag2 recording")
    return found


def _exists(path: Path) -> bool:
    try:
        return path.exists() or path.is_symlink()
    except (OSError, ValueError):  # the name is invalid for files
        return False


class _ShapeReader:
    """Checks the types of values; raises DamagedRecording with the place in the file."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def mapping(self, value: Any, at: str) -> dict[str, Any]:
        if not isinstance(value, dict):
            raise self._wrong(value, at, "a mapping")
        return value

    def rows(self, content: dict[str, Any], at: str) -> list[Any]:
        value = content.get(at)
        if value in (None, "", "~", "null"):
            return []
        if not isinstance(value, list):
            raise self._wrong(value, at, "a list")
        return value

    def text(self, value: Any, at: str) -> str:
        if not isinstance(value, str):
            raise self._wrong(value, at, "a string")
        return value

    def number(self, value: Any, at: str) -> int:
        if not isinstance(value, str) or not re.fullmatch(r"[0-9]{1,19}", value):
            raise self._wrong(value, at, "a number")
        return int(value)

    def _wrong(self, value: Any, at: str, expected: str) -> DamagedRecording:
        kind = {dict: "a mapping", list: "a list", type(None): "nothing"}.get(type(value)) or repr(value)[:40]
        return DamagedRecording(f"{self._path}: {at}: found {kind}, expected {expected}")
