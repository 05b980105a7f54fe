"""SQLite files that are programs, that use their pages twice, or hold what no recording holds."""

from __future__ import annotations

import sqlite3
import sys
import tracemalloc
from collections import Counter
from contextlib import closing
from pathlib import Path

import pytest

from igtl_gateway.addons.exchange.rosbag2 import Rosbag2
from igtl_gateway.addons.exchange.rosbag2_sqlite import NO_TIME, Message, SqliteStorage
from igtl_gateway.base.errors import DamagedRecording, LimitExceeded, RecordingError
from igtl_gateway.record.sessionfile.definition import FileDefinitions
from tests.tables import table
from tests.timing import quick

STRING = "std_msgs/msg/String"
CDR = b"\0\1\0\0\4\0\0\0abc\0"
TOPICS = "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT)"
MESSAGES = "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB)"
GOOD = (TOPICS, f"INSERT INTO topics VALUES(1, '/t', '{STRING}', 'cdr')", MESSAGES)
ROWS = "WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n) SELECT i AS id, 1 AS topic_id, i AS timestamp, x'00010000' AS data FROM n"  # fmt: skip  # noqa: E501


def made(path: Path, *statements: str) -> Path:
    with closing(sqlite3.connect(path)) as base:
        for statement in statements:
            base.execute(statement)
        base.commit()
    return path


def read(path: Path) -> list[Message]:
    with closing(SqliteStorage(path, lambda _type, _format: "", FileDefinitions())) as storage:
        return list(storage.messages())


HOSTILE = {
    "a view of messages": ((*GOOD[:2], f"CREATE VIEW messages AS {ROWS}"), "found a view named messages, expected"),
    "a view of topics": ((f"CREATE VIEW topics AS {ROWS}", MESSAGES), "found a view named topics, expected a table"),
    "a view of definitions": ((*GOOD, f"CREATE VIEW message_definitions AS {ROWS}"), "found a view named message_def"),
    "a virtual table": (
        (*GOOD[:2], "CREATE VIRTUAL TABLE messages USING fts5(id, topic_id, timestamp, data)"),
        "found a virtual table named messages",
    ),
    "no messages": (GOOD[:2], "found nothing named messages"),
    "computed columns": (
        (*GOOD[:2], "CREATE TABLE messages(id INTEGER, topic_id INTEGER, timestamp INTEGER, "
                    "data BLOB AS (zeroblob(1000000000)))"),
        "found computed columns in messages",
    ),
    "computed names": (
        ("CREATE TABLE topics(id, type, serialization_format, name TEXT AS (printf('%*d', 900000000, 1)))", MESSAGES),
        "found computed columns in topics",
    ),
    "other columns": ((*GOOD[:2], "CREATE TABLE messages(id INTEGER)"), "found other columns, expected those"),
    "topics of other columns": (("CREATE TABLE topics(id INTEGER)", MESSAGES), "SQLite reports"),
}  # fmt: skip


@table(("statements", "reason"), HOSTILE.values(), ids=HOSTILE)
def test_hostile_files_are_refused_at_once(tmp_path: Path, statements: tuple[str, ...], reason: str) -> None:
    path = made(tmp_path / "x.db3", *statements)
    with quick(), pytest.raises(DamagedRecording, match=reason) as found:
        read(path)
    assert str(path) in str(found.value)


def test_triggers_and_other_views_are_never_run(tmp_path: Path) -> None:
    path = made(
        tmp_path / "x.db3",
        *GOOD,
        f"CREATE VIEW other AS {ROWS}",
        "CREATE TRIGGER boom AFTER INSERT ON messages BEGIN INSERT INTO messages SELECT NULL, 1, 1, x'00'; END",
        "CREATE INDEX time_of ON messages(timestamp)",
        "INSERT INTO messages VALUES(1, 1, 5, x'00010000')",
    )
    assert [message[0] for message in read(path)] == [1, 5]


def test_rows_that_are_no_messages_have_no_time(tmp_path: Path) -> None:
    values = ("NULL", "'x'", "1.5", "-5", "9223372036854775807")
    rows = [f"INSERT INTO messages(topic_id, timestamp, data) VALUES(1, {value}, x'{CDR.hex()}')" for value in values]
    rows += [f"INSERT INTO messages(topic_id, timestamp, data) VALUES(1, 7, {value})" for value in ("NULL", "'x'", "3")]
    rows += ["INSERT INTO messages(topic_id, timestamp, data) VALUES('?', 7, x'00')"]
    path = made(tmp_path / "x.db3", *GOOD, *rows, f"INSERT INTO messages(topic_id, timestamp, data) VALUES(1, 8, x'{CDR.hex()}')")  # fmt: skip  # noqa: E501
    assert Counter(message[0] for message in read(path)) == {NO_TIME: 6, -5: 1, 2**63 - 1: 1, 8: 1}
    with closing(Rosbag2(path)) as source:
        assert [item.time_ns for item in source.items()] == [8]
        (row,) = source.rows
    assert (row.declared, row.taken, row.left_out, row.good) == (9, 1, 0, False)
    assert row.why == "some have no bytes, or a time outside 1970 to 2116"


def test_pages_that_are_used_many_times_make_no_work(tmp_path: Path) -> None:
    """Every inner page of the tree refers to the same leaf: a few pages that make messages without end."""
    path = tmp_path / "x.db3"
    with closing(sqlite3.connect(path)) as base:
        base.execute("PRAGMA page_size=4096")
        for statement in GOOD:
            base.execute(statement)
        base.executemany("INSERT INTO messages VALUES(?, 1, ?, ?)", ((i, i, bytes(200)) for i in range(1, 20_000)))
        base.commit()
        (root,) = base.execute("SELECT rootpage FROM sqlite_master WHERE name='messages'").fetchone()
    data = bytearray(path.read_bytes())
    pages = [data[at : at + 4096] for at in range(0, len(data), 4096)]

    def shared(number: int) -> None:
        page = pages[number - 1]
        if page[0] != 5:  # no inner page of a table
            return
        cells = int.from_bytes(page[3:5], "big")
        places = [int.from_bytes(page[12 + 2 * i : 14 + 2 * i], "big") for i in range(cells)]
        child = page[places[0] : places[0] + 4]
        for place in places:
            page[place : place + 4] = child
        page[8:12] = child
        shared(int.from_bytes(child, "big"))

    shared(root)
    path.write_bytes(b"".join(pages))
    with quick(), pytest.raises(RecordingError) as found:
        read(path)
    assert isinstance(found.value, DamagedRecording | LimitExceeded)


def test_a_file_that_is_cut_off_says_so(tmp_path: Path) -> None:
    rows = [f"INSERT INTO messages VALUES({i}, 1, {i}, x'{'00' * 500}')" for i in range(1, 100)]
    whole = made(tmp_path / "x.db3", *GOOD, *rows).read_bytes()
    for part in (0.9, 0.5, 0.2, 0.05):
        (tmp_path / "y.db3").write_bytes(whole[: int(len(whole) * part)])
        with pytest.raises(DamagedRecording, match=r"y\.db3: (cut off or damaged|SQLite reports|messages)"):
            read(tmp_path / "y.db3")


@pytest.mark.parametrize("kind", ["TEXT", "BLOB"])
def test_a_long_definition_is_refused_before_it_is_in_memory(tmp_path: Path, kind: str) -> None:
    table = (
        "CREATE TABLE message_definitions (id, topic_type TEXT, encoding TEXT, encoded_message_definition, hash TEXT)"
    )
    text = "float64 a # " + "x" * (64 << 20)
    path = made(tmp_path / "long.db3", *GOOD, table)
    with closing(sqlite3.connect(path)) as base:
        value = text if kind == "TEXT" else text.encode()
        base.execute("INSERT INTO message_definitions VALUES (1, 'a_msgs/msg/A', 'ros2msg', ?, '')", (value,))
        base.commit()
    tracemalloc.start()
    try:
        with pytest.raises(LimitExceeded, match=r"found a definition of more than 1,048,576 bytes.*--limit definition"):
            read(path)
        assert tracemalloc.get_traced_memory()[1] < 16 << 20 or sys.version_info < (3, 11)
    finally:
        tracemalloc.stop()
