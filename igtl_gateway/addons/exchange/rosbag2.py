"""Import of rosbag2 recordings: directories and files, sqlite3 and MCAP storage, split or not, zstd by file or message.

The storage files are authoritative; the import is compared with the counts and serialization formats in
``metadata.yaml``.  Channels that are not topics, such as service events, are left out and listed.  Messages with a time
outside the range of a session are missing in the account.  Parts of a split recording are merged in the order of time.

Memory: one message of each part, and one chunk of MCAP files.
"""

from __future__ import annotations

import heapq
import re
import shutil
import tempfile
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Protocol

from igtl_gateway.addon import DamagedRecording, Kind, Qos, UnsupportedRecording, files, layout, limits, open_new
from igtl_gateway.addons.exchange.rosbag2_metadata import METADATA, BagMetadata, Key, read_metadata, storage_files
from igtl_gateway.addons.exchange.rosbag2_sqlite import Message, SqliteStorage
from igtl_gateway.addons.exchange.rostypes import definition
from igtl_gateway.addons.exchange.source import ImportedItem, ImportedStream, NonRosSource, library_errors_as_damage
from igtl_gateway.base.untrusted.unpack import unpack_zstd_file, unpack_zstd_of_any_size
from igtl_gateway.record.sessionfile.index import read_index, recover_hint
from igtl_gateway.record.sessionfile.order import message_rows
from igtl_gateway.record.sessionfile.records import Malformed

#: Upper bound of times in a session, in ns; a larger time is damage, or has another unit.
_MAX_NS = 1 << 62
_ROS_TYPE = re.compile(r"\w+/msg/\w+", re.ASCII)


class _StorageFile(Protocol):
    """One storage file.

    Attributes:
        counts: number of messages by topic and type.
        skipped: topic and type that cannot be read → reason.
        qos: QoS profiles as in the file, by topic and type.
        formats: serialization format by topic and type.
        definitions: type → text and encoding of its definition.
    """

    counts: Counter[Key]
    skipped: dict[Key, str]
    qos: dict[Key, str]
    formats: dict[Key, str]
    definitions: dict[str, tuple[str, str]]

    def messages(self) -> Iterator[Message]: ...

    def close(self) -> None: ...


class Rosbag2(NonRosSource):
    """An open rosbag2 recording.  Raises UnsupportedRecording or DamagedRecording."""

    def __init__(self, path: Path) -> None:
        super().__init__(f"rosbag2 recording {path.name}", {"imported_format": "rosbag2"})
        self._path = path
        self._parts: list[_StorageFile] = []
        self._unpacked: tempfile.TemporaryDirectory[str] | None = None
        self._bad_types: set[str] = set()
        try:
            self._metadata = read_metadata(path) if path.is_dir() else BagMetadata()
            for file in storage_files(path, self._metadata) if path.is_dir() else [path]:
                self._parts.append(self._open_part(file))
            self._account()
        except BaseException:
            self.close()
            raise

    def _open_part(self, path: Path) -> _StorageFile:
        plain = self._unpack(path) if path.suffix == ".zstd" else path
        with files.open_file(plain) as stream:
            start = stream.read(16)
        is_sqlite = start.startswith(b"SQLite format 3\0")
        storage, declared = "sqlite3" if is_sqlite else "mcap", self._metadata.storage
        if declared not in ("", storage):
            self.notes.append(f"{METADATA} declares the storage {declared}, but {path.name} is {storage}")
        return SqliteStorage(plain, _unreadable) if is_sqlite else _Mcap(plain)

    def _unpack(self, path: Path) -> Path:
        """Decompress a storage file to a temporary file, which exists until ``close``."""
        if self._unpacked is None:
            self._unpacked = tempfile.TemporaryDirectory(prefix="igtl-gateway-import-")
        plain, size = Path(self._unpacked.name, f"{len(self._parts)}-{path.stem[-100:]}"), files.size_of(path)
        bounds = limits.current_limits()
        # the file is on disk, so the limit of memory does not apply
        allowed = min(max(bounds.free, bounds.ratio * size), shutil.disk_usage(self._unpacked.name).free // 2)
        try:
            with files.open_file(path) as packed, open_new(plain) as out:
                unpack_zstd_file(packed, out, size, allowed, str(path))
        except OSError as error:
            raise DamagedRecording(f"{path}: cannot be decompressed: {error.strerror or error}") from None
        return plain

    def _account(self) -> None:
        metadata = self._metadata
        stored: Counter[Key] = Counter()
        skipped: dict[Key, str] = {}
        formats: dict[Key, str] = {}
        for part in self._parts:
            stored.update(part.counts)
            skipped.update(part.skipped)
            formats.update(part.formats)
        self._rows = {}
        for key in sorted({*stored, *metadata.counts, *skipped}):
            row = ImportedStream(key[0], metadata.counts.get(key, stored[key]), key[1], why=skipped.get(key, ""))
            row.left_out = stored[key] if key in skipped else 0
            self._rows[key] = row
            if metadata.found and key not in metadata.counts:
                self.notes.append(f"{METADATA} does not list {key[0]} ({stored[key]} messages stored)")
            elif row.declared != stored[key]:
                self.notes.append(f"{METADATA} declares {row.declared} messages of {key[0]}, {stored[key]} are stored")
            declared, found = metadata.formats.get(key, ""), formats.get(key, "")
            if declared and found and declared != found:
                self.notes.append(
                    f"{METADATA} declares the serialization {declared!r} of {key[0]}, its storage {found!r}: "
                    + ("left out" if key in skipped else f"read as {found!r}")
                )
        self.rows = list(self._rows.values())

    def items(self) -> Iterator[ImportedItem]:
        packed = unpacked = 0
        bounds = limits.current_limits()
        for time_ns, key, data, source_ns in heapq.merge(*(part.messages() for part in self._parts), key=_time):
            row, payload = self._rows[key], data
            if not 0 <= time_ns < _MAX_NS:
                row.why = "some have no bytes, or a time outside 1970 to 2116"
                continue
            if self._metadata.by_message:
                place = f"{self._path}: {key[0]} at {time_ns} ns"
                payload = unpack_zstd_of_any_size(data, place)
                packed, unpacked = packed + len(data), unpacked + len(payload)
                limits.check_limit(
                    "ratio", unpacked, f"{place}: all messages so far", bounds.free + bounds.ratio * packed
                )
            row.taken += 1
            known_ns = source_ns if 0 <= source_ns < _MAX_NS else 0
            yield ImportedItem(time_ns, Kind.ROS_IN, payload, key[0], key[1], source_ns=known_ns)

    def qos_of(self, topic: str, ros_type: str) -> Qos | None:
        texts = (part.qos.get((topic, ros_type), "") for part in self._parts)
        return next((qos for text in texts if (qos := layout.parse_qos_yaml(text))), None)

    def definition_of(self, ros_type: str) -> tuple[str, str] | None:
        for part in self._parts:
            text, encoding = part.definitions.get(ros_type, ("", ""))
            try:
                if found := definition(ros_type, text, encoding):
                    return found
            except DamagedRecording as error:
                if ros_type not in self._bad_types:
                    self._bad_types.add(ros_type)
                    self.notes.append(f"{error}: left out")
        return None

    def close(self) -> None:
        for part in self._parts:
            part.close()
        if self._unpacked:
            self._unpacked.cleanup()


def _time(message: Message) -> int:
    return message[0]


def _unreadable(ros_type: str, encoding: str) -> str:
    """Return why a channel cannot be read as a topic; ``""`` if it can."""
    if encoding != layout.MESSAGE_ENCODING:
        return f"encoding {encoding!r}, not cdr"
    if ros_type.endswith("_Event") and "/srv/" in ros_type:
        return "service events, not a topic"
    return "" if _ROS_TYPE.fullmatch(ros_type) else f"type {ros_type!r}, not package/msg/Name"


class _Mcap:
    """An MCAP file."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._stream = files.open_file(path)
        self.counts: Counter[Key] = Counter()
        self.skipped: dict[Key, str] = {}
        self.qos: dict[Key, str] = {}
        self.formats: dict[Key, str] = {}
        self.definitions: dict[str, tuple[str, str]] = {}
        self._keys: dict[int, Key] = {}
        try:
            with library_errors_as_damage(path):
                self._open()
        except BaseException:
            self.close()
            raise

    def _open(self) -> None:
        self._index = index = read_index(self._path, self._stream)
        if any(place.name == layout.SESSION_METADATA for place in index.metadata):
            raise UnsupportedRecording(f"{self._path}: found a session of igtl-gateway, which needs no import")
        for channel in index.channels.values():
            schema = index.schemas.get(channel.schema_id)
            ros_type = schema.name if schema else ""
            key = (channel.topic, ros_type)
            self.counts[key] += index.counts.get(channel.id, 0)
            self.formats.setdefault(key, channel.message_encoding)
            why = _unreadable(ros_type, channel.message_encoding)
            if why:
                self.skipped[key] = why
                continue
            self._keys[channel.id] = key
            self.qos.setdefault(key, channel.metadata.get(layout.QOS_KEY, ""))
            if schema:
                self.definitions.setdefault(ros_type, (schema.data.decode("utf-8", "replace"), schema.encoding))

    def messages(self) -> Iterator[Message]:
        try:
            for _, rows in message_rows(self._stream, self._index, str(self._path)):
                for channel, _, log_ns, publish_ns, start, end, data in rows or ():
                    if key := self._keys.get(channel):
                        # publish_time = log_time means "unset" in MCAP
                        yield log_ns, key, data[start:end], publish_ns if publish_ns != log_ns else 0
        except Malformed as error:
            raise DamagedRecording(f"{self._path}: {error}{recover_hint(self._path)}") from None

    def close(self) -> None:
        self._stream.close()
