"""rosbag2 recordings: directories and single files, sqlite3 and MCAP storage, split or not, zstd by file or message.

The storage files themselves are read, not what ``metadata.yaml`` says of them; its counts are what the import is
held against.  Channels that are no topics, such as service events, are left out by name.  Parts of a split recording
are merged in order of time.  Memory: one message of each part, and one chunk of MCAP files.
"""

from __future__ import annotations

import heapq
import re
import sqlite3
import tempfile
from collections import Counter
from collections.abc import Iterator
from pathlib import Path, PurePath
from typing import IO, Any, Protocol

import zstandard
from mcap.reader import SeekingReader
from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

from igtl_gateway.errors import DamagedRecording, UnsupportedRecording
from igtl_gateway.exchange.rostypes import definition
from igtl_gateway.exchange.source import Item, Row, Told, reading
from igtl_gateway.qos import Qos
from igtl_gateway.session import layout
from igtl_gateway.session.entry import Kind

METADATA = "metadata.yaml"
_ROS_TYPE = re.compile(r"\w+/msg/\w+", re.ASCII)

#: Topic and type.
Key = tuple[str, str]
#: A message of a part: time, key, bytes, the sender's stamp or 0.
_Message = tuple[int, Key, bytes, int]


class _Part(Protocol):
    """One storage file: what it declares by topic, and what of it cannot be read."""

    counts: Counter[Key]
    skipped: dict[Key, str]
    qos: dict[Key, str]
    definitions: dict[str, tuple[str, str]]  # type → text, encoding

    def messages(self) -> Iterator[_Message]: ...

    def close(self) -> None: ...


class Rosbag2(Told):
    """An open rosbag2 recording.  Raises UnsupportedRecording or DamagedRecording."""

    def __init__(self, path: Path) -> None:
        super().__init__(f"rosbag2 recording {path.name}", {"imported_format": "rosbag2"})
        self._path = path
        self._parts: list[_Part] = []
        self._unpacked: tempfile.TemporaryDirectory[str] | None = None
        self._by_message = False
        try:
            metadata = _metadata(path / METADATA) if path.is_dir() else {}
            self._by_message = str(metadata.get("compression_mode", "")).lower() == "message"
            for file in storage_files(path, metadata) if path.is_dir() else [path]:
                self._parts.append(self._open_part(file))
            self._account(metadata)
        except BaseException:
            self.close()
            raise

    def _open_part(self, path: Path) -> _Part:
        if path.suffix == ".zstd":
            if self._unpacked is None:
                self._unpacked = tempfile.TemporaryDirectory(prefix="igtl-gateway-import-")
            plain = Path(self._unpacked.name, path.stem)
            try:
                with path.open("rb") as packed, plain.open("wb") as out:
                    zstandard.ZstdDecompressor().copy_stream(packed, out)
            except (OSError, zstandard.ZstdError) as error:
                raise DamagedRecording(f"{path}: cannot be unpacked: {error}") from None
            path = plain
        with path.open("rb") as stream:
            start = stream.read(16)
        return _Sqlite(path) if start.startswith(b"SQLite format 3\0") else _Mcap(path)

    def _account(self, metadata: dict[str, Any]) -> None:
        stored: Counter[Key] = Counter()
        skipped: dict[Key, str] = {}
        for part in self._parts:
            stored.update(part.counts)
            skipped.update(part.skipped)
        declared = {
            (str(row["topic_metadata"]["name"]), str(row["topic_metadata"]["type"])): int(row["message_count"])
            for row in metadata.get("topics_with_message_count") or ()
        }
        self._rows = {}
        for key in sorted({*stored, *declared, *skipped}):
            row = Row(key[0], declared.get(key, stored[key]), key[1], why=skipped.get(key, ""))
            row.left_out = stored[key] if key in skipped else 0
            self._rows[key] = row
            if metadata and key not in declared:
                self.notes.append(f"{METADATA} does not name {key[0]} ({stored[key]} stored)")
            elif row.declared != stored[key]:
                self.notes.append(f"{METADATA} declares {row.declared} of {key[0]}, {stored[key]} are stored")
        self.rows = list(self._rows.values())

    def items(self) -> Iterator[Item]:
        unpack = zstandard.ZstdDecompressor().decompressobj
        for time_ns, key, data, source_ns in heapq.merge(*(part.messages() for part in self._parts), key=_time):
            try:
                payload = unpack().decompress(data) if self._by_message else data
            except zstandard.ZstdError as error:
                raise DamagedRecording(f"{self._path}: {key[0]} at {time_ns} ns: {error}") from None
            self._rows[key].taken += 1
            yield Item(time_ns, Kind.ROS_IN, payload, key[0], key[1], source_ns=source_ns)

    def qos_of(self, topic: str, ros_type: str) -> Qos | None:
        texts = (part.qos.get((topic, ros_type), "") for part in self._parts)
        return next((qos for text in texts if (qos := layout.parse_qos_yaml(text))), None)

    def definition_of(self, ros_type: str) -> tuple[str, str] | None:
        for part in self._parts:
            text, encoding = part.definitions.get(ros_type, ("", ""))
            if found := definition(ros_type, text, encoding):
                return found
        return None

    def close(self) -> None:
        for part in self._parts:
            part.close()
        if self._unpacked:
            self._unpacked.cleanup()


def _time(message: _Message) -> int:
    return message[0]


def storage_files(path: Path, metadata: dict[str, Any]) -> list[Path]:
    """The storage files of a recording's directory: those that its metadata names, else all that are there."""
    names = [PurePath(str(name)).name for name in metadata.get("relative_file_paths") or ()]
    files = [path / name for name in names]
    if missing := [file.name for file in files if not file.is_file()]:
        raise DamagedRecording(f"{path}: found no {', '.join(missing)}, which {METADATA} names")
    if not files:
        suffixes = (".mcap", ".db3", ".mcap.zstd", ".db3.zstd")
        files = sorted((file for file in path.iterdir() if file.name.endswith(suffixes)), key=_natural)
    if not files:
        raise UnsupportedRecording(f"{path}: found no .mcap or .db3 file in it, expected a rosbag2 recording")
    return files


def _natural(path: Path) -> list[tuple[int, str]]:
    """``bag_10`` after ``bag_9``."""
    return [(int(word), "") if word.isdigit() else (0, word) for word in re.split(r"(\d+)", path.name)]


def _metadata(path: Path) -> dict[str, Any]:
    if not path.is_file():
        return {}
    try:
        told = YAML(typ="safe").load(path.read_text("utf-8"))["rosbag2_bagfile_information"]
        version = int(told["version"])
    except (OSError, UnicodeDecodeError, YAMLError, KeyError, TypeError, ValueError) as error:
        raise DamagedRecording(f"{path}: {type(error).__name__}: {str(error).splitlines()[0]}") from None
    if version > 9:
        raise UnsupportedRecording(f"{path}: found version {version}, expected at most 9")
    return dict(told)


def _unreadable(ros_type: str, encoding: str) -> str:
    """Why a channel is no topic that can be read; ``""`` if it is one."""
    if encoding != layout.MESSAGE_ENCODING:
        return f"encoding {encoding!r}, not cdr"
    if ros_type.endswith("_Event") and "/srv/" in ros_type:
        return "service events, not a topic"
    return "" if _ROS_TYPE.fullmatch(ros_type) else f"type {ros_type!r}, not package/msg/Name"


class _Mcap:
    """An MCAP file."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._stream: IO[bytes] = path.open("rb")
        self.counts: Counter[Key] = Counter()
        self.skipped: dict[Key, str] = {}
        self.qos: dict[Key, str] = {}
        self.definitions: dict[str, tuple[str, str]] = {}
        self._keys: dict[int, Key] = {}
        try:
            with reading(path):
                self._open()
        except BaseException:
            self.close()
            raise

    def _open(self) -> None:
        self._reader = SeekingReader(self._stream, validate_crcs=True, record_size_limit=self._path.stat().st_size)
        summary = self._reader.get_summary()
        if summary is None or summary.statistics is None:
            raise DamagedRecording(f"{self._path}: has no index; `igtl-gateway recover` makes one")
        if any(index.name == layout.SESSION_METADATA for index in summary.metadata_indexes):
            raise UnsupportedRecording(f"{self._path}: is a session of igtl-gateway already")
        for channel in summary.channels.values():
            schema = summary.schemas.get(channel.schema_id)
            ros_type = schema.name if schema else ""
            key = (channel.topic, ros_type)
            self.counts[key] += summary.statistics.channel_message_counts.get(channel.id, 0)
            why = _unreadable(ros_type, channel.message_encoding)
            if why:
                self.skipped[key] = why
                continue
            self._keys[channel.id] = key
            self.qos.setdefault(key, channel.metadata.get(layout.QOS_KEY, ""))
            if schema:
                self.definitions.setdefault(ros_type, (schema.data.decode("utf-8", "replace"), schema.encoding))

    def messages(self) -> Iterator[_Message]:
        found = self._reader.iter_messages()
        while True:
            try:
                _, channel, message = next(found)
            except StopIteration:
                return
            except Exception as error:  # of the library: whatever it makes of damaged bytes
                raise DamagedRecording(f"{self._path}: {type(error).__name__}: {error}") from error
            key = self._keys.get(channel.id)
            if key:
                # MCAP says publish_time = log_time for "not set"
                source_ns = message.publish_time if message.publish_time != message.log_time else 0
                yield message.log_time, key, message.data, source_ns

    def close(self) -> None:
        self._stream.close()


class _Sqlite:
    """An sqlite3 file, opened so that nothing of it or beside it changes."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self.counts: Counter[Key] = Counter()
        self.skipped: dict[Key, str] = {}
        self.qos: dict[Key, str] = {}
        self.definitions: dict[str, tuple[str, str]] = {}
        self._keys: dict[int, Key] = {}
        self._base = sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro&immutable=1", uri=True)
        try:
            with reading(path):
                self._open()
        except BaseException:
            self.close()
            raise

    def _open(self) -> None:
        columns = {row[1] for row in self._base.execute("PRAGMA table_info(topics)")}
        qos = "offered_qos_profiles" if "offered_qos_profiles" in columns else "''"
        counts = dict(self._base.execute("SELECT topic_id, count(*) FROM messages GROUP BY topic_id"))
        topics = self._base.execute(f"SELECT id, name, type, serialization_format, {qos} FROM topics").fetchall()
        for number, topic, ros_type, encoding, profiles in topics:
            key = (topic, ros_type)
            self.counts[key] += counts.get(number, 0)
            if why := _unreadable(ros_type, encoding):
                self.skipped[key] = why
                continue
            self._keys[number] = key
            self.qos.setdefault(key, profiles or "")
        if list(self._base.execute("PRAGMA table_info(message_definitions)")):
            found = self._base.execute(
                "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions"
            )
            self.definitions = {name: (text, encoding) for name, encoding, text in found}

    def messages(self) -> Iterator[_Message]:
        try:
            found = self._base.execute("SELECT topic_id, timestamp, data FROM messages ORDER BY timestamp, id")
            for number, time_ns, data in found:
                if key := self._keys.get(number):
                    yield time_ns, key, data, 0
        except sqlite3.Error as error:
            raise DamagedRecording(f"{self._path}: {error}") from None

    def close(self) -> None:
        self._base.close()
