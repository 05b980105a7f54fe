"""Reads a storage file of rosbag2 in SQLite without changing any file and without running code of the file.

``topics``, ``messages`` and ``message_definitions`` must be plain tables: a view instead is a program, which might not
end.  An authorizer refuses everything except reading columns of these tables.  The size of the file bounds the work of
each query, because pages that are used many times would produce endless rows.
"""

from __future__ import annotations

import sqlite3
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from igtl_gateway.addon import DamagedRecording, LimitExceeded, RecordingError, limit_values, read_blob
from igtl_gateway.addon.terminal import count_text, counted
from igtl_gateway.addon.untrusted import files, limits, messages_of
from igtl_gateway.addon.writing import Definition, FileDefinitions
from igtl_gateway.addons.exchange.rosbag2_metadata import Key

#: A message of a storage file: time in UTC ns, key, bytes, source stamp in UTC ns or 0.
Message = tuple[int, Key, bytes, int]

_TABLES = ("topics", "messages", "message_definitions")
_FUNCTIONS = frozenset({"length", "typeof"})
_PRAGMAS = frozenset({"table_xinfo"})
_READABLE = frozenset({*_TABLES, "sqlite_master", ""})
#: Steps of SQLite's virtual machine: between two checks, allowed for each file, and allowed in addition per byte.
_EVERY, _STEPS, _STEPS_PER_BYTE = 20_000, 2_000_000, 20
#: Bytes of a message that is read by itself.
_LARGE = 1 << 20
#: Time of a row without a valid time.
NO_TIME = -1


class SqliteStorage:
    """One storage file in SQLite; its attributes are those of ``_StorageFile`` in ``exchange/rosbag2``.

    Args:
        path: the file.
        unreadable: returns why messages of a type and serialization format cannot be read; ``""`` if they can.
        definitions: those of the recording, to which those of this file are added.
    """

    def __init__(self, path: Path, unreadable: Callable[[str, str], str], definitions: FileDefinitions) -> None:
        self._path = path
        self._unreadable = unreadable
        self._definitions = definitions
        self._size = files.size_of(path)
        self._steps = 0
        self.counts: Counter[Key] = Counter()
        self.skipped: dict[Key, str] = {}
        self.qos: dict[Key, str] = {}
        self.formats: dict[Key, str] = {}
        self.undecodable: Counter[Key] = Counter()
        self.beside_counts: Counter[str] = Counter()
        self.serialized = ""
        self._keys: dict[int, Key] = {}
        self._stored = 0
        self._base = sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro&immutable=1", uri=True)
        try:
            self._open()
        except RecordingError:
            self.close()
            raise
        except (sqlite3.Error, OverflowError, ValueError) as error:
            self.close()
            raise self._damaged(error) from None

    def messages(self) -> Iterator[Message]:
        """Yield all messages in the order of time.  Raises DamagedRecording.

        The time is ``NO_TIME`` if time or bytes are missing.
        """
        self._steps = 0
        taken = 0
        try:
            # a large message is read by itself: sorted with the others, SQLite would copy it twice
            found = self._base.execute(
                f"SELECT topic_id, timestamp, CASE WHEN length(data) > {_LARGE} THEN NULL ELSE data END, rowid,"
                f" typeof(data) = 'blob' AND length(data) > {_LARGE} FROM messages ORDER BY timestamp, id"
            )
            for number, time_ns, small, row, is_large in found:
                key = self._keys.get(number) if isinstance(number, int) else None
                if not key:
                    continue
                data = self._large(row) if is_large else small
                is_whole = isinstance(time_ns, int) and isinstance(data, bytes)
                taken += len(data) + 1 if is_whole else 1
                if taken > self._stored:
                    raise DamagedRecording(f"{self._path}: found messages twice, expected each message once")
                yield (time_ns, key, data, 0) if is_whole else (NO_TIME, key, b"", 0)
        except (sqlite3.Error, OverflowError) as error:
            raise self._damaged(error) from None

    def _large(self, row: int) -> bytes:
        return read_blob(self._base, "messages", "data", row)

    def beside(self) -> Iterator[Any]:
        """Yield nothing: only MCAP has attachments and metadata records."""
        return iter(())

    def close(self) -> None:
        """Close the file."""
        self._base.close()

    def _open(self) -> None:
        base = self._base
        base.text_factory = _text
        for setting in ("trusted_schema=OFF", "query_only=ON", "cell_size_check=ON", "mmap_size=0"):
            base.execute(f"PRAGMA {setting}")
        limit_values(base, self._longest)
        base.set_progress_handler(self._exceeds_work, _EVERY)
        base.set_authorizer(_authorized)
        self._check_tables()
        columns = self._columns("topics")
        qos = "offered_qos_profiles" if "offered_qos_profiles" in columns else "''"
        self._count()
        others = self._take_definitions()
        for number, topic, ros_type, encoding, profiles in self._rows(
            f"SELECT id, name, type, serialization_format, {qos} FROM topics", "topics"
        ):
            if ros_type in others:
                self.undecodable[str(topic), str(ros_type)] += self._counted[number]
                self.counts[str(topic), str(ros_type)] += self._counted[number]
                continue
            self._add_topic(number, str(topic), str(ros_type), str(encoding), str(profiles or ""))

    @property
    def _longest(self) -> int:
        """Bytes of the longest value."""
        return min(limits.current_limits().memory, max(self._size, 1 << 16))

    def _take_definitions(self) -> set[str]:
        """Add the definitions; return the types that have another one in the recording."""
        if not self._columns("message_definitions"):
            return set()
        # before a value is read into memory: SQLite refuses a longer one
        most = 4 * limits.current_limits().definition
        limit_values(self._base, most)
        self._base.text_factory = bytes  # as they are
        try:
            found = self._rows(
                "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions", "topics"
            )
        except sqlite3.DataError:
            found = [(b"", b"", bytes(most + 1))]
        if any(isinstance(data, bytes) and len(data) > most for _, _, data in found):  # by itself, on Python 3.10
            raise LimitExceeded(
                f"{self._path}: found a definition of more than {count_text(most, 'byte')}, expected fewer (--limit "
                "definition)"
            )
        self._base.text_factory = _text
        limit_values(self._base, self._longest)
        others = set()
        for name, encoding, data in found:
            definition = Definition(data if isinstance(data, bytes) else b"", _text(encoding or b""))
            # of the events of a service it states the type of the service
            others |= {each for each in messages_of(_text(name)) if not self._definitions.takes(each, definition)}
        return others

    def _check_tables(self) -> None:
        kinds = {
            str(name).lower(): (str(kind), str(sql or ""))
            for kind, name, sql in self._rows("SELECT type, name, sql FROM sqlite_master")
            if kind in ("table", "view")
        }
        for name in _TABLES:
            kind, sql = kinds.get(name, ("nothing", ""))
            if kind == "nothing" and name == "message_definitions":
                continue  # versions before Jazzy have no such table
            if kind != "table" or not sql.upper().startswith("CREATE TABLE"):
                found = {"table": "a virtual table", "view": "a view"}.get(kind, kind)
                raise DamagedRecording(f"{self._path}: found {found} named {name}, expected a table")

    def _columns(self, table: str) -> set[str]:
        """Return the names of the columns.  Raises DamagedRecording for computed ones."""
        found = self._rows(f"PRAGMA table_xinfo({table})")
        if any(row[6] for row in found):
            raise DamagedRecording(f"{self._path}: found computed columns in {table}, expected plain ones")
        return {str(row[1]) for row in found}

    def _count(self) -> None:
        """Count messages by topic; check that their bytes are not more than the file."""
        if not {"id", "topic_id", "timestamp", "data"} <= self._columns("messages"):
            raise DamagedRecording(f"{self._path}: messages: found other columns, expected those of rosbag2")
        self._counted: Counter[Any] = Counter()
        # not GROUP BY, for which SQLite would sort the bytes of all messages
        for number, size in self._base.execute("SELECT topic_id, length(data) FROM messages"):
            self._counted[number] += 1
            self._stored += (size or 0) + 1
            limits.check_limit("topics", len(self._counted), f"{self._path}: topics of messages")
        if self._stored > self._size:
            raise DamagedRecording(
                f"{self._path}: messages: found {counted(self._stored, 'byte')}, expected at most the file size "
                f"{self._size}"
            )

    def _add_topic(self, number: Any, topic: str, ros_type: str, encoding: str, profiles: str) -> None:
        key = (topic, ros_type)
        self.counts[key] += self._counted[number]
        self.formats.setdefault(key, encoding)
        if why := self._unreadable(ros_type, encoding):
            self.skipped[key] = why
            return
        self._keys[number] = key
        self.qos.setdefault(key, profiles)

    def _rows(self, query: str, limit: str = "count") -> list[Any]:
        rows: list[Any] = []
        for row in self._base.execute(query):
            limits.check_limit(limit, len(rows) + 1, f"{self._path}: rows of a table")
            rows.append(row)
        return rows

    def _exceeds_work(self) -> int:
        """Return whether the queries need more steps than allowed for a file of this size; SQLite then stops."""
        self._steps += _EVERY
        return int(self._steps > self._allowed)

    @property
    def _allowed(self) -> int:
        return _STEPS + _STEPS_PER_BYTE * self._size

    def _damaged(self, error: Exception) -> DamagedRecording:
        if self._steps > self._allowed:
            return LimitExceeded(
                f"{self._path}: found queries of more than {counted(self._allowed, 'step')}, expected fewer"
            )
        reason = str(error)
        if "malformed" in reason or "not a database" in reason:
            return DamagedRecording(f"{self._path}: cut off or damaged: SQLite reports: {reason}")
        return DamagedRecording(f"{self._path}: SQLite reports: {reason}")


def _authorized(action: int, first: str | None, second: str | None, _base: str | None, _inner: str | None) -> int:
    allowed = (
        action == sqlite3.SQLITE_SELECT
        or (action == sqlite3.SQLITE_READ and (first or "").lower() in _READABLE)
        or (action == sqlite3.SQLITE_FUNCTION and (second or "").lower() in _FUNCTIONS)
        or (action == sqlite3.SQLITE_PRAGMA and (first or "").lower() in _PRAGMAS)
    )
    return sqlite3.SQLITE_OK if allowed else sqlite3.SQLITE_DENY


def _text(data: bytes) -> str:
    return data.decode("utf-8", "backslashreplace")
