"""Import of rosbag2 recordings: directories and files, sqlite3 and MCAP storage, split or not, zstd by file or message.

The storage files are authoritative; the import is compared with the counts and serialization formats in
``metadata.yaml``.  Channels that are not topics, such as service events, are left out and listed.  Messages with a time
outside the range of a session are missing in the account, and so are other bytes than CDR and messages with another
definition of their type than the first.  Parts of a split recording are merged in the order of time.

A compressed message shows itself by its first bytes, so a lost ``metadata.yaml`` does no harm.  Attachments, metadata
records and ``custom_data`` come along.

Memory: one message of each part, and one chunk of MCAP files.
"""

from __future__ import annotations

import heapq
import json
import re
import shutil
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Protocol

from mcap.records import Attachment, Metadata

from igtl_gateway.addon import DamagedRecording, UnsupportedRecording
from igtl_gateway.addon.reading import Kind, Qos, layout, message_rows, read_index, read_record, records, recover_hint
from igtl_gateway.addon.terminal import by_count, counted
from igtl_gateway.addon.untrusted import DerivedType, files, limits, unpack
from igtl_gateway.addon.writing import Definition, FileDefinitions, another_definition, open_new
from igtl_gateway.addons.exchange.rosbag2_metadata import (
    METADATA,
    BagMetadata,
    Key,
    custom_data,
    read_metadata,
    storage_files,
)
from igtl_gateway.addons.exchange.rosbag2_sqlite import Message, SqliteStorage
from igtl_gateway.addons.exchange.rostypes import with_hash
from igtl_gateway.addons.exchange.source import ImportedItem, ImportedStream, NonRosSource, library_errors_as_damage

#: Upper bound of times in a session, in ns; a larger time is damage, or has another unit.
_MAX_NS = 1 << 62
_ROS_TYPE = re.compile(r"\w+/msg/\w+", re.ASCII)
#: First bytes of a zstd frame; bytes of a CDR message before its fields, of which the first is 0.
_ZSTD = b"\x28\xb5\x2f\xfd"
_ENCAPSULATION = 4
#: Units of rows.
ATTACHMENTS, METADATA_RECORDS = "attachments", "metadata records"


class _StorageFile(Protocol):
    """One storage file.

    Attributes:
        counts: number of messages by topic and type.
        skipped: topic and type that cannot be read → reason.
        qos: QoS profiles as in the file, by topic and type.
        formats: serialization format by topic and type.
        undecodable: number of messages, by topic and type, with another definition of their type.
        beside_counts: number of attachments, and of metadata records that are not rosbag2's own.
        serialized: ``metadata.yaml`` in the file.
    """

    counts: Counter[Key]
    skipped: dict[Key, str]
    qos: dict[Key, str]
    formats: dict[Key, str]
    undecodable: Counter[Key]
    beside_counts: Counter[str]
    serialized: str

    def beside(self) -> Iterator[Attachment | Metadata]: ...

    def messages(self) -> Iterator[Message]: ...

    def close(self) -> None: ...


class Rosbag2(NonRosSource):
    """An open rosbag2 recording.  Raises UnsupportedRecording or DamagedRecording."""

    def __init__(self, path: Path) -> None:
        super().__init__(f"rosbag2 recording {path.name}", {"imported_format": "rosbag2"})
        self._path = path
        self._parts: list[_StorageFile] = []
        self._unpacked: tempfile.TemporaryDirectory[str] | None = None
        self._definitions = FileDefinitions()
        self._kept: dict[str, Definition | None] = {}
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
        kind = SqliteStorage if is_sqlite else _Mcap
        return kind(plain, _unreadable, self._definitions)

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
                unpack.unpack_zstd_file(packed, out, size, allowed, str(path))
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
                self.notes.append(f"{METADATA} does not list {key[0]} ({counted(stored[key], 'message')} stored)")
            elif row.declared != stored[key]:
                self.notes.append(
                    f"{METADATA} declares {counted(row.declared, 'message')} of {key[0]}, {stored[key]} "
                    f"{by_count(stored[key], 'is', 'are')} stored"
                )
            declared, found = metadata.formats.get(key, ""), formats.get(key, "")
            if declared and found and declared != found:
                self.notes.append(
                    f"{METADATA} declares the serialization {declared!r} of {key[0]}, its storage {found!r}: "
                    + ("left out" if key in skipped else f"read as {found!r}")
                )
            undecodable = sum(part.undecodable[key] for part in self._parts)
            if undecodable:  # they are missing
                row.why = f"{undecodable} have {another_definition(key[1])}"
        self.rows = list(self._rows.values())
        for unit in (ATTACHMENTS, METADATA_RECORDS):
            if count := sum(part.beside_counts[unit] for part in self._parts):
                self.rows.append(ImportedStream(unit, count, unit=unit))
        texts = [part.serialized for part in self._parts if part.serialized]
        custom = metadata.custom if metadata.found else custom_data(texts[0], str(self._path)) if texts else {}
        if custom:
            self.facts[layout.CUSTOM_KEY] = json.dumps(custom, sort_keys=True)
            self.rows.append(ImportedStream("custom_data", len(custom), taken=len(custom), unit="keys"))

    def beside(self) -> Iterator[Attachment | Metadata]:
        rows = {row.unit: row for row in self.rows}
        for part in self._parts:
            for each in part.beside():
                rows[ATTACHMENTS if isinstance(each, Attachment) else METADATA_RECORDS].taken += 1
                yield each

    def items(self) -> Iterator[ImportedItem]:
        packed = unpacked = 0
        bounds = limits.current_limits()
        by_message = self._metadata.by_message
        for time_ns, key, data, source_ns in heapq.merge(*(part.messages() for part in self._parts), key=_time):
            row, payload = self._rows[key], data
            if not 0 <= time_ns < _MAX_NS:
                row.why = "some have no bytes, or a time outside 1970 to 2116"
                continue
            if data[: len(_ZSTD)] == _ZSTD and not by_message:  # no CDR begins so
                by_message = True
                source = METADATA if self._metadata.found else "the file"
                self.notes.append(f"each message is compressed with zstd, which {source} does not state")
            if by_message:
                place = f"{self._path}: {key[0]} at {time_ns} ns"
                payload = unpack.unpack_zstd_of_any_size(data, place)
                packed, unpacked = packed + len(data), unpacked + len(payload)
                limits.check_limit(
                    "ratio", unpacked, f"{place}: all messages so far", bounds.free + bounds.ratio * packed
                )
            if payload[:1] != b"\0" or len(payload) < _ENCAPSULATION:
                row.why = (
                    f"some are no CDR, the latest at {time_ns} ns begins with {bytes(payload[:4]).hex() or 'nothing'}"
                )
                continue
            row.taken += 1
            known_ns = source_ns if 0 <= source_ns < _MAX_NS else 0
            yield ImportedItem(time_ns, Kind.ROS_IN, payload, key[0], key[1], source_ns=known_ns)

    def qos_of(self, topic: str, ros_type: str) -> Qos | None:
        texts = (part.qos.get((topic, ros_type), "") for part in self._parts)
        return next((qos for text in texts if (qos := layout.parse_qos_yaml(text))), None)

    def definition_of(self, ros_type: str) -> Definition | None:
        if ros_type not in self._kept:
            found = self._definitions.known.get(ros_type)
            self._kept[ros_type] = with_hash(ros_type, found, self.notes.append) if found else None
        return self._kept[ros_type]

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
    is_topic = _ROS_TYPE.fullmatch(ros_type) or DerivedType.of(ros_type)
    return "" if is_topic else f"type {ros_type!r}, not package/msg/Name"


class _Mcap:
    """An MCAP file."""

    def __init__(self, path: Path, unreadable: Callable[[str, str], str], definitions: FileDefinitions) -> None:
        self._path = path
        self._unreadable = unreadable
        self._definitions = definitions
        self._stream = files.open_file(path)
        self.counts: Counter[Key] = Counter()
        self.skipped: dict[Key, str] = {}
        self.qos: dict[Key, str] = {}
        self.formats: dict[Key, str] = {}
        self.undecodable: Counter[Key] = Counter()
        self.beside_counts: Counter[str] = Counter()
        self.serialized = ""
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
            why = self._unreadable(ros_type, channel.message_encoding)
            if why:
                self.skipped[key] = why
                continue
            type_hash = channel.metadata.get(layout.TYPE_HASH_KEY, "")
            if schema and not self._definitions.takes(
                ros_type, Definition(bytes(schema.data), schema.encoding, type_hash)
            ):
                self.undecodable[key] += index.counts.get(channel.id, 0)
                continue
            self._keys[channel.id] = key
            self.qos.setdefault(key, channel.metadata.get(layout.QOS_KEY, ""))
        found = [place.name for place in index.metadata]
        self.beside_counts = Counter(
            {ATTACHMENTS: len(index.attachments), METADATA_RECORDS: len(found) - found.count(layout.ROSBAG2_METADATA)}
        )
        for number, place in enumerate(index.metadata):  # the last one has all messages
            if place.name == layout.ROSBAG2_METADATA:
                self.serialized = self._metadata(number).metadata.get("serialized_metadata", "")

    def beside(self) -> Iterator[Attachment | Metadata]:
        """Yield the attachments and the metadata records; those with the name of one of a session get another one."""
        with library_errors_as_damage(self._path):
            for place in self._index.attachments:
                content = read_record(
                    self._stream, self._index, records.ATTACHMENT, place, f"{self._path}: attachment {place.name}"
                )
                found = records.parse_attachment(content)
                is_ours = found.name in layout.ATTACHMENTS
                yield replace(found, name=f"imported/{found.name}") if is_ours else found
            for number, place in enumerate(self._index.metadata):
                if place.name != layout.ROSBAG2_METADATA:
                    record = self._metadata(number)
                    is_ours = record.name.startswith(layout.OWN_METADATA)
                    yield replace(record, name=f"imported.{record.name}") if is_ours else record

    def _metadata(self, number: int) -> Metadata:
        place = self._index.metadata[number]
        what = f"{self._path}: metadata {place.name}"
        limits.check_limit("free", place.length, what)
        return records.parse_metadata(read_record(self._stream, self._index, records.METADATA, place, what))

    def messages(self) -> Iterator[Message]:
        try:
            for _, rows in message_rows(self._stream, self._index, str(self._path)):
                for channel, _, log_ns, publish_ns, start, end, data in rows or ():
                    if key := self._keys.get(channel):
                        # publish_time = log_time means "unset" in MCAP
                        yield log_ns, key, data[start:end], publish_ns if publish_ns != log_ns else 0
        except records.Malformed as error:
            raise DamagedRecording(f"{self._path}: {error}{recover_hint(self._path)}") from None

    def close(self) -> None:
        self._stream.close()
