"""Hostile recordings of ROS 1 and ROS 2: bags, SQLite, and their YAML files."""

from __future__ import annotations

import os
import sqlite3
import struct
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path

from tests.integration.hostile_files.case import (
    ESCAPE,
    FORGED,
    GIB,
    MIB,
    NAUGHTY,
    Danger,
    Hostile,
    bz2_zeros,
    file,
    lz4_zeros,
    zstd_zeros,
)
from tests.integration.hostile_files.foreign import bag as mcap_bag
from tests.integration.hostile_files.foreign import chained, doubling
from tests.record import samples

# --- ROS 1: http://wiki.ros.org/Bags/Format/2.0 ----------------------------------------------------------------------

_BAG, _CHUNK, _CONNECTION, _MESSAGE, _INDEX, _CHUNK_INFO = 3, 5, 7, 2, 4, 6
_MAGIC = b"#ROSBAG V2.0\n"
_STRING_MD5 = "992ce8a1687cec8c8bd883ec73ca41d1"


def fields(given: Mapping[str, bytes]) -> bytes:
    """A header of a record."""
    packed = b"".join(
        struct.pack("<I", len(key) + 1 + len(value)) + key.encode() + b"=" + value for key, value in given.items()
    )
    return struct.pack("<I", len(packed)) + packed


def record(opcode: int, given: Mapping[str, bytes], data: bytes, length: int | None = None) -> bytes:
    return fields({"op": bytes([opcode]), **given}) + struct.pack("<I", len(data) if length is None else length) + data


def _u32(value: int) -> bytes:
    return struct.pack("<I", value)


def _u64(value: int) -> bytes:
    return struct.pack("<Q", value)


def bag1(
    topic: str = "/chatter",
    kind: str = "std_msgs/String",
    definition: str | bytes = "string data\n",
    message: bytes = _u32(5) + b"hello",
    compression: str = "none",
    packed: bytes | None = None,
    size: int | None = None,
    connections: int = 1,
    caller: str = "/node",
    index_count: int = 1,
    chunk_count: int = 1,
    index_at: int | None = None,
    times: int = 0,
) -> bytes:
    """A bag with one chunk; what is given is wrong where the caller wants it to be."""
    text = definition.encode() if isinstance(definition, str) else definition

    def connection(number: int) -> bytes:
        told = fields(
            {
                "topic": topic.encode(),
                "type": kind.encode(),
                "md5sum": _STRING_MD5.encode(),
                "message_definition": text,
                "callerid": caller.encode(),
            }
        )[4:]
        return record(_CONNECTION, {"conn": _u32(number), "topic": topic.encode()}, told)

    inside = connection(0)
    at = len(inside)
    inside += record(_MESSAGE, {"conn": _u32(0), "time": _u64(times)}, message)
    body = inside if packed is None else packed
    head = {"compression": compression.encode(), "size": _u32(len(inside) if size is None else size)}
    chunk = record(_CHUNK, head, body)
    index = record(_INDEX, {"ver": _u32(1), "conn": _u32(0), "count": _u32(index_count)}, _u64(times) + _u32(at))
    chunk_at = len(_MAGIC) + 4096
    end = chunk_at + len(chunk) + len(index)
    info = {
        "ver": _u32(1),
        "chunk_pos": _u64(chunk_at),
        "start_time": _u64(times),
        "end_time": _u64(times),
        "count": _u32(1),
    }
    summary = b"".join(map(connection, range(connections))) + record(_CHUNK_INFO, info, _u32(0) + _u32(1)) * min(
        chunk_count, 50_000
    )
    told = {
        "index_pos": _u64(end if index_at is None else index_at),
        "conn_count": _u32(connections),
        "chunk_count": _u32(chunk_count),
    }
    begin = fields({"op": bytes([_BAG]), **told})
    begin += struct.pack("<I", 4096 - len(begin) - 4)
    return _MAGIC + begin.ljust(4096, b" ") + chunk + index + summary


def packed(compression: str, pack: Callable[[int], bytes], claimed: int) -> bytes:
    """A bag whose chunk unpacks to 2 GiB."""
    return bag1(compression=compression, packed=pack(2 * GIB), size=claimed)


def _bag1(name: str, danger: Danger, what: str, data: Callable[[], bytes]) -> Hostile:
    return Hostile(f"bag1-{name}", "ROS 1 bag", danger, what, file(f"bag1-{name}.bag", data))


_RING = f"lab/A a\n{'=' * 80}\nMSG: lab/A\nlab/B b\n{'=' * 80}\nMSG: lab/B\nlab/A a\n"

BAGS_1: tuple[Hostile, ...] = (
    *(
        _bag1(
            f"{name}-{claimed}",
            Danger.BOMB,
            f"a chunk of {name} with 2 GiB that claims {claimed:,} bytes",
            partial(packed, name, pack, claimed),
        )
        for name, pack in (("bz2", bz2_zeros), ("lz4", lz4_zeros))
        for claimed in (2 * GIB, 100, (1 << 32) - 1)
    ),
    _bag1(
        "lz4-declared",
        Danger.BOMB,
        "an lz4 frame that declares 2^62 bytes",
        lambda: bag1(compression="lz4", packed=lz4_zeros(64 * MIB, 1 << 62), size=100),
    ),
    _bag1(
        "bz2-garbage",
        Danger.LIE,
        "an invalid chunk of bz2",
        lambda: bag1(compression="bz2", packed=b"BZh9" + b"x" * 99),
    ),
    _bag1(
        "compression", Danger.TERMINAL, "a compression with escape sequences", lambda: bag1(compression=f"zip{ESCAPE}")
    ),
    _bag1("connections-50000", Danger.LIE, "50,000 connections", lambda: bag1(connections=50_000)),
    _bag1("chunks", Danger.LIE, "2^32 − 1 chunks", lambda: bag1(chunk_count=(1 << 32) - 1)),
    _bag1("index", Danger.LIE, "an index of 2^32 − 1 messages", lambda: bag1(index_count=(1 << 32) - 1)),
    *(
        _bag1(f"index-at-{at}", Danger.LIE, f"an index at {at:,}", partial(bag1, index_at=at))
        for at in (0, 13, 4109, 1 << 40, (1 << 64) - 1)
    ),
    _bag1("cut", Danger.LIE, "cut off in the middle", lambda: bag1()[:4300]),
    _bag1("header-length", Danger.LIE, "a record header of 4 GiB", lambda: bag1()[:13] + b"\xff" * 4 + bag1()[17:]),
    _bag1(
        "data-length",
        Danger.LIE,
        "a chunk of 4 GiB",
        lambda: bag1().replace(b"compression=none", b"compression=none", 1)[:4200] + b"\xff" * 500,
    ),
    _bag1(
        "ring", Danger.LIE, "a definition whose types name each other", lambda: bag1(kind="lab/Thing", definition=_RING)
    ),
    _bag1(
        "self", Danger.LIE, "a definition that names itself", lambda: bag1(kind="lab/Thing", definition="lab/Thing a\n")
    ),
    _bag1(
        "chain",
        Danger.LIE,
        "a definition with a chain of 2,000 types",
        lambda: bag1(kind="lab/Thing", definition=chained(2000)),
    ),
    _bag1(
        "doubling", Danger.LIE, "a definition with 2^40 fields", lambda: bag1(kind="lab/Thing", definition=doubling(40))
    ),
    _bag1(
        "giant",
        Danger.LIE,
        "a definition of 20 MB",
        lambda: bag1(kind="lab/Thing", definition="# " + "x" * 20_000_000 + "\nuint8 a\n"),
    ),
    _bag1(
        "giant-array",
        Danger.LIE,
        "a definition with an array of 2^40 numbers",
        lambda: bag1(kind="lab/Thing", definition="float64[1099511627776] a\n"),
    ),
    _bag1(
        "no-utf8",
        Danger.SHAPE,
        "a definition that is invalid UTF-8",
        lambda: bag1(kind="lab/Thing", definition=b"uint8 \xff\xfe\n"),
    ),
    _bag1("empty", Danger.SHAPE, "a definition that is empty", lambda: bag1(kind="lab/Thing", definition="")),
    _bag1(
        "string-length", Danger.LIE, "a string that claims 4 GiB", lambda: bag1(message=b"\xff\xff\xff\xff" + b"hello")
    ),
    _bag1("message-empty", Danger.SHAPE, "a message of no bytes", lambda: bag1(message=b"")),
    _bag1("times", Danger.SHAPE, "times of 2^64 − 1", lambda: bag1(times=(1 << 64) - 1)),
    _bag1("topic", Danger.TERMINAL, "escape sequences and a forged line in a topic", lambda: bag1(topic=f"/{NAUGHTY}")),
    _bag1("type", Danger.TERMINAL, "the same in a type", lambda: bag1(kind=f"lab/{NAUGHTY}")),
    _bag1(
        "definition",
        Danger.TERMINAL,
        "the same in a definition",
        lambda: bag1(kind="lab/Thing", definition=f"x{NAUGHTY}/A b\n"),
    ),
    _bag1("caller", Danger.TERMINAL, "the same in the name of a node", lambda: bag1(caller=NAUGHTY)),
    _bag1("version", Danger.LIE, "a version of 9 digits", lambda: b"#ROSBAG V999999999.9\n" + b"x" * 5000),
    _bag1("magic", Danger.LIE, "nothing behind its first line", lambda: _MAGIC),
)


# --- ROS 2: SQLite, and a folder with metadata.yaml ------------------------------------------------------------------


def database(
    path: Path,
    script: str = "",
    topic: str = "/chatter",
    kind: str = "std_msgs/msg/String",
    encoding: str = "cdr",
    qos: str = "",
    stamp: object = 10**18,
    data: object = samples.string_cdr("hello"),
    rows: int = 3,
) -> Path:
    """A storage file of rosbag2, after which ``script`` is run."""
    with sqlite3.connect(path) as store:
        store.executescript(
            "CREATE TABLE schema(schema_version INTEGER PRIMARY KEY, ros_distro TEXT NOT NULL);"
            "INSERT INTO schema VALUES (4, 'jazzy');"
            "CREATE TABLE metadata(id INTEGER PRIMARY KEY, metadata_version INTEGER NOT NULL, metadata TEXT NOT NULL);"
            "CREATE TABLE topics(id INTEGER PRIMARY KEY, name, type, serialization_format, offered_qos_profiles,"
            " type_description_hash);"
            "CREATE TABLE message_definitions(id INTEGER PRIMARY KEY, topic_type, encoding, encoded_message_definition,"
            " type_description_hash);"
            "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id, timestamp, data);"
        )
        store.execute("INSERT INTO topics VALUES (1, ?, ?, ?, ?, '')", (topic, kind, encoding, qos))
        store.executemany(
            "INSERT INTO messages VALUES (?, 1, ?, ?)", [(number + 1, stamp, data) for number in range(rows)]
        )
        store.executescript(script)
    store.close()
    return path


def _db(name: str, danger: Danger, what: str, **given: object) -> Hostile:
    def build(folder: Path) -> Path:
        return database(folder / f"db-{name}.db3", **given)  # type: ignore[arg-type]

    return Hostile(f"db-{name}", "ROS 2 bag", danger, what, build)


def _endless(table: str, columns: str, row: str) -> str:
    return (
        f"DROP TABLE {table}; CREATE VIEW {table} AS WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n) "
        f"SELECT {row} FROM n;"
    ).replace("COLUMNS", columns)


_DEFINE = "INSERT INTO message_definitions VALUES (1, 'lab/msg/Thing', '{encoding}', {text}, '');"
_SPLIT = "rosbag2_bagfile_information:\n"


def yaml(
    extra: str = "",
    name: str = "bag.mcap",
    version: str = "9",
    topic: str = "/chatter",
    kind: str = "std_msgs/msg/String",
    compression: str = "",
    mode: str = "",
    count: str = "5",
) -> str:
    return f"""\
rosbag2_bagfile_information:
  version: {version}
  storage_identifier: mcap
  duration: {{nanoseconds: 10}}
  starting_time: {{nanoseconds_since_epoch: 1000}}
  message_count: {count}
  topics_with_message_count:
    - topic_metadata:
        {{name: {topic}, type: {kind}, serialization_format: cdr, offered_qos_profiles: "", type_description_hash: ""}}
      message_count: {count}
  compression_format: "{compression}"
  compression_mode: "{mode}"
  relative_file_paths:
    - {name}
  files: []
  custom_data: {{}}
  ros_distro: jazzy
{extra}"""


def folder(
    text: Callable[[], str | bytes], data: Callable[[], bytes] = mcap_bag, name: str = "bag.mcap"
) -> Callable[[Path], Path]:
    """A recording of rosbag2 as a folder."""

    def build(place: Path) -> Path:
        made = place / "bag"
        made.mkdir()
        told = text()
        (made / "metadata.yaml").write_bytes(told if isinstance(told, bytes) else told.encode())
        if name:
            (made / name).write_bytes(data())
        return made

    return build


def _yaml(name: str, danger: Danger, what: str, text: Callable[[], str | bytes]) -> Hostile:
    return Hostile(f"yaml-{name}", "ROS 2 bag", danger, what, folder(text))


def _fifo_folder(place: Path) -> Path:
    made = folder(yaml, name="")(place)
    os.mkfifo(made / "bag.mcap")
    return made


def _linked_folder(place: Path) -> Path:
    made = folder(yaml, name="")(place)
    (place / "elsewhere.mcap").write_bytes(mcap_bag())
    (made / "bag.mcap").symlink_to(place / "elsewhere.mcap")
    return made


def _laughs(levels: int, width: int) -> str:
    lines = [f"a0: &a0 [{','.join(['x'] * width)}]"]
    lines += [f"a{n}: &a{n} [{','.join([f'*a{n - 1}'] * width)}]" for n in range(1, levels)]
    return "\n".join(lines) + "\n"


BAGS_2: tuple[Hostile, ...] = (
    _db(
        "view-messages",
        Danger.BOMB,
        "an endless SQLite view instead of the messages",
        script=_endless("messages", "", "i AS id, 1 AS topic_id, i AS timestamp, zeroblob(1000000) AS data"),
    ),
    _db(
        "view-topics",
        Danger.BOMB,
        "an endless SQLite view instead of the topics",
        script=_endless(
            "topics",
            "",
            "i AS id, '/t' || i AS name, 'std_msgs/msg/String' AS type, 'cdr' AS "
            "serialization_format, '' AS offered_qos_profiles, '' AS type_description_hash",
        ),
    ),
    _db(
        "view-big",
        Danger.BOMB,
        "a SQLite view whose messages have 900 MB",
        script="DROP TABLE messages; CREATE VIEW messages AS SELECT 1 AS id, 1 AS topic_id, 1 AS timestamp,"
        " zeroblob(900000000) AS data;",
    ),
    _db("blob", Danger.LIE, "strings instead of numbers and bytes", stamp="soon", data="text"),
    _db("nulls", Danger.SHAPE, "NULL instead of a message", data=None),
    _db("number", Danger.SHAPE, "a number instead of a message", data=7),
    _db("stamp-float", Danger.SHAPE, "a time with a fraction", stamp=1.5),
    _db("stamp-negative", Danger.SHAPE, "a time before 1970", stamp=-(1 << 62)),
    _db("no-tables", Danger.SHAPE, "no tables", script="DROP TABLE messages; DROP TABLE topics;"),
    _db(
        "no-columns", Danger.SHAPE, "tables with other columns", script="DROP TABLE messages; CREATE TABLE messages(a);"
    ),
    _db(
        "schema-text",
        Danger.SHAPE,
        "an unknown version of the schema",
        script="UPDATE schema SET schema_version = 99;",
    ),
    _db(
        "many-topics",
        Danger.LIE,
        "100,000 topics",
        script="WITH RECURSIVE n(i) AS (SELECT 2 UNION ALL SELECT i + 1 FROM n WHERE i < 100000) "
        "INSERT INTO topics SELECT i, '/t' || i, 'std_msgs/msg/String', 'cdr', '', '' FROM n;",
    ),
    _db(
        "topic-type",
        Danger.SHAPE,
        "a topic whose name is a number",
        script="UPDATE topics SET name = 7, type = x'ff00';",
    ),
    _db("encoding", Danger.SHAPE, "an unknown serialisation", encoding="protobuf"),
    *(
        _db(
            f"definition-{name}",
            Danger.LIE,
            f"a definition {what}",
            kind="lab/msg/Thing",
            data=bytes(64),
            script=_DEFINE.format(encoding=encoding, text="'" + text.replace("'", "''") + "'"),
        )
        for name, what, encoding, text in (
            ("ring", "whose types name each other", "ros2msg", _RING),
            ("chain", "with a chain of 2,000 types", "ros2msg", chained(2000)),
            ("doubling", "with 2^40 fields", "ros2msg", doubling(40)),
            ("idl", "in IDL that nests 3,000 deep", "ros2idl", "module a { " * 3000 + "}; " * 3000),
            ("garbage", "that is invalid", "ros2msg", "= = [[[["),
        )
    ),
    _db(
        "definition-blob",
        Danger.SHAPE,
        "a definition that is invalid UTF-8",
        kind="lab/msg/Thing",
        script=_DEFINE.format(encoding="ros2msg", text="x'75696e7438ff'"),
    ),
    _db("topic", Danger.TERMINAL, "escape sequences and a forged line in a topic", topic=f"/{NAUGHTY}"),
    _db("type", Danger.TERMINAL, "the same in a type", kind=f"lab/msg/{NAUGHTY}"),
    _db("format", Danger.TERMINAL, "the same in a serialisation", encoding=NAUGHTY),
    _db("qos", Danger.BOMB, "quality of service as YAML with a billion aliases", qos=_laughs(12, 9)),
    Hostile(
        "db-garbage",
        "ROS 2 bag",
        Danger.LIE,
        "a SQLite header followed by other data",
        file("db-garbage.db3", lambda: b"SQLite format 3\0" + bytes(range(256)) * 40),
    ),
    Hostile(
        "db-page-size",
        "ROS 2 bag",
        Danger.LIE,
        "a SQLite file cut off in the middle",
        lambda place: _cut(database(place / "db-cut.db3", rows=500)),
    ),
    # compressed storage
    *(
        Hostile(
            f"zstd-file-{claimed}",
            "ROS 2 bag",
            Danger.BOMB,
            f"a compressed storage of 2 GiB that declares {claimed or 'nothing'}",
            file("bag.mcap.zstd", partial(zstd_zeros, 2 * GIB, claimed)),
        )
        for claimed in (2 * GIB, 0, 1 << 60)
    ),
    Hostile(
        "zstd-db",
        "ROS 2 bag",
        Danger.BOMB,
        "a compressed database of 2 GiB",
        file("bag.db3.zstd", lambda: zstd_zeros(2 * GIB)),
    ),
    Hostile(
        "zstd-folder",
        "ROS 2 bag",
        Danger.BOMB,
        "a folder whose compressed file has 2 GiB",
        folder(
            lambda: yaml(name="bag.mcap.zstd", compression="zstd", mode="FILE"),
            lambda: zstd_zeros(2 * GIB),
            "bag.mcap.zstd",
        ),
    ),
    Hostile(
        "zstd-messages",
        "ROS 2 bag",
        Danger.BOMB,
        "messages that are compressed one by one, 2 GiB each",
        folder(lambda: yaml(compression="zstd", mode="MESSAGE"), lambda: mcap_bag(data=(zstd_zeros(2 * GIB),) * 3)),
    ),
    Hostile(
        "zstd-messages-undeclared",
        "ROS 2 bag",
        Danger.BOMB,
        "the same without a declared size",
        folder(lambda: yaml(compression="zstd", mode="MESSAGE"), lambda: mcap_bag(data=(zstd_zeros(2 * GIB, 0),) * 3)),
    ),
    # metadata.yaml
    _yaml("aliases", Danger.BOMB, "YAML with a billion aliases", lambda: yaml(_laughs(12, 9))),
    _yaml("aliases-deep", Danger.BOMB, "YAML with 5,000 aliases in a chain", lambda: yaml(_laughs(5000, 1))),
    _yaml("deep", Danger.LIE, "YAML that nests 20,000 deep", lambda: yaml("x: " + "[" * 20_000 + "]" * 20_000)),
    _yaml("ring", Danger.LIE, "YAML that holds itself", lambda: yaml("x: &x [*x]\n")),
    _yaml("giant", Danger.BOMB, "YAML of 70 MB", lambda: yaml("x: " + "y" * 70_000_000)),
    _yaml(
        "many",
        Danger.LIE,
        "YAML with 100,000 topics",
        lambda: yaml().replace(
            "  compression_format",
            "".join(
                f"    - topic_metadata: {{name: /t{n}, type: a/msg/B}}\n      message_count: 1\n"
                for n in range(100_000)
            )
            + "  compression_format",
        ),
    ),
    _yaml("no-utf8", Danger.SHAPE, "YAML that is invalid UTF-8", lambda: b"rosbag2_bagfile_information: \xff\xfe"),
    _yaml(
        "python",
        Danger.LIE,
        "YAML that asks for an object of Python",
        lambda: yaml("x: !!python/object/apply:os.system ['true']\n"),
    ),
    *(
        _yaml(f"shape-{number}", Danger.SHAPE, f"YAML that is {text[:30]!r}", partial(str, text))
        for number, text in enumerate(
            (
                "",
                "[1, 2]",
                "7",
                "rosbag2_bagfile_information: 7",
                "rosbag2_bagfile_information: [1]",
                "rosbag2_bagfile_information: {version: [1], relative_file_paths: {a: 1}}",
                "rosbag2_bagfile_information: {topics_with_message_count: 5, relative_file_paths: [7, {a: b}]}",
            )
        )
    ),
    *(
        _yaml(f"count-{number}", Danger.SHAPE, f"counts that are {count}", partial(yaml, count=count))
        for number, count in enumerate(("9" * 400, "-1", "many", "[1]", "1.5", ".inf"))
    ),
    *(
        _yaml(f"path-{number}", Danger.LIE, f"a file that is `{name}`", partial(yaml, name=name))
        for number, name in enumerate(
            ("/etc/passwd", "../../../../etc/passwd", "/dev/zero", ".", '""', '"a\\0b"', '"' + "x" * 5000 + '"')
        )
    ),
    Hostile("yaml-fifo", "ROS 2 bag", Danger.LIE, "a file that is a FIFO", _fifo_folder),
    Hostile("yaml-link", "ROS 2 bag", Danger.LIE, "a file that is a link out of the folder", _linked_folder),
    _yaml(
        "topic",
        Danger.TERMINAL,
        "escape sequences and a forged line in a topic",
        lambda: yaml(topic=f'"/a\\e[2J\\n{FORGED}"'),
    ),
    _yaml("name", Danger.TERMINAL, "the same in the name of a file", lambda: yaml(name=f'"a\\e[2J\\n{FORGED}.mcap"')),
    _yaml(
        "format",
        Danger.TERMINAL,
        "the same in the name of a compression",
        lambda: yaml(compression="x\\e[2J\\nFORGED", mode="FILE"),
    ),
    _yaml("version", Danger.TERMINAL, "the same in the version", lambda: yaml(version=f'"9\\e[2J\\n{FORGED}"')),
)


def _cut(path: Path) -> Path:
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])
    return path


CASES = BAGS_1 + BAGS_2
