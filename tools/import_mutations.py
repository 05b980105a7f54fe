"""Files for the importers, damaged where it hurts: ``cases(seed)`` gives them without end.

Strategy: each builder writes one format field by field (ROS 1 bag, rosbag2 in SQLite and in MCAP with its
``metadata.yaml``, pcap, pcapng, OpenIGTLink bytes) and passes every number, text and piece of bytes through a
:class:`Bend`,
which replaces a few of them by values at the edges of what fields can hold.  So lengths, counts, offsets and types
lie while the rest of the file stays valid.  Some files are then cut, or have bits flipped.  Definitions of messages
and YAML have grammars of their own (:func:`definition`, :func:`metadata`).

The sequence of cases depends on the seed only.  ``python tools/import_mutations.py FOLDER --count 100`` writes some.
"""

from __future__ import annotations

import argparse
import bz2
import io
import json
import sqlite3
import struct
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from random import Random

import lz4.frame  # type: ignore[import-untyped]
import zstandard
from mcap.writer import CompressionType, Writer

from igtl_gateway.wire import Message, encode
from igtl_gateway.wire.header import BODY_SIZE, HEADER_SIZE, U64
from igtl_gateway.wire.text import String
from igtl_gateway.wire.transform import Transform

#: Numbers at the edges of what fields and programs can hold.
EDGES = (0, 1, 2, 12, 0x7F, 0x80, 0xFF, 0x7FFF, 0xFFFF, 0x10000, 2**31 - 1, 2**31, 2**32 - 1, 2**32, 2**62,
         2**63 - 1, 2**64 - 1)  # fmt: skip
#: Strings that break parsers, paths and terminals.
TEXTS = (
    "", " ", "\0", "\n", "\x1b[2J", "\x1b]0;x\x07", "\u202e", "../../etc/passwd", "/", ".", "None", "class", "a" * 300,
    "std_msgs/msg/String", "a/b/c/d", "a/msg/A", "'", '"""', "{}", "%s", "-1", "1e999", "nan", "\ud800", "é", "cdr",
    "[[[[", "&a *a", "!!python/object:os.system", "json", "0x10", "true", "~",
)  # fmt: skip
_EPOCH_S = 1_700_000_000


@dataclass(frozen=True, slots=True)
class Case:
    """One import: what it was made of, and its files.

    Attributes:
        name: format and damage, for reports.
        files: name → bytes; more than one, or one named ``…/x``, are those of a folder.
    """

    name: str
    files: Mapping[str, bytes]

    def write(self, folder: Path) -> Path:
        """Write it into an empty folder; returns what an importer opens."""
        for name, data in self.files.items():
            path = folder / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(data)
        first = next(iter(self.files))
        return folder / first.partition("/")[0]


class Bend:
    """Changes a few of the values that pass through it.

    Args:
        rng: what decides.
        rate: the part of the values that are changed.
    """

    def __init__(self, rng: Random, rate: float) -> None:
        self.rng = rng
        self._rate = rate

    def hit(self, factor: float = 1.0) -> bool:
        return self.rng.random() < self._rate * factor

    def number(self, value: int, bits: int = 32) -> int:
        """An unsigned number of ``bits`` bits."""
        if self.hit():
            value = self.rng.choice((*EDGES, value + 1, value - 1, value * 2, value ^ (1 << self.rng.randrange(bits))))
        return value % (1 << bits)

    def text(self, value: str) -> str:
        if self.hit():
            at = self.rng.randrange(len(value) + 1)
            return self.rng.choice((*TEXTS, value[:at] + self.rng.choice(TEXTS) + value[at:]))
        return value

    def coded(self, value: str) -> bytes:
        """A string as bytes, possibly invalid UTF-8."""
        data = self.text(value).encode("utf-8", "surrogatepass")
        return data + b"\xff\xfe" if self.hit(0.3) else data

    def utf8(self, value: str) -> str:
        """A string that can be stored as UTF-8."""
        return self.text(value).encode("utf-8", "replace").decode()

    def odd(self, value: object, others: Sequence[object]) -> object:
        """The value, or one of another type."""
        return self.rng.choice(others) if self.hit() else value

    def u32(self, value: int) -> bytes:
        return struct.pack("<I", self.number(value))

    def byte(self, value: int) -> bytes:
        return bytes([self.number(value, 8)])

    def data(self, value: bytes) -> bytes:
        if value and self.hit():
            at = self.rng.randrange(len(value))
            return self.rng.choice((value[:at], value + value[:at], _flipped(self.rng, value), b""))
        return value


def cases(seed: int) -> Iterator[Case]:
    """Damaged files without end."""
    rng = Random(seed)
    names = sorted(BUILDERS)
    while True:
        name = rng.choice(names)
        bend = Bend(rng, rng.choice((0.0, 0.005, 0.02, 0.1)))
        files = BUILDERS[name](bend)
        damage = rng.choice(("", "", "", "cut", "flip"))
        if damage or bend.hit(5):
            victim = rng.choice(sorted(files))
            data = files[victim]
            files[victim] = data[: rng.randrange(len(data) + 1)] if damage == "cut" else _flipped(rng, data)
        yield Case(f"{name} {damage}".strip(), files)


def _flipped(rng: Random, data: bytes) -> bytes:
    found = bytearray(data)
    for _ in range(rng.randint(1, 6) if found else 0):
        found[rng.randrange(len(found))] ^= 1 << rng.randrange(8)
    return bytes(found)


# -- definitions -------------------------------------------------------------------------------------------------

_BASES = ("bool", "byte", "char", "int8", "uint16", "int32", "uint64", "float32", "float64", "string", "string<=7",
          "time", "duration", "Header", "wstring", "float128")  # fmt: skip
_SIZES = ("", "", "", "[]", "[3]", "[<=4]", "[0]", "[-1]", "[4294967296]", "[99999999999999999999]", "[<=0]", "[[2]]")
_NAMES = ("data", "x", "Y", "class", "None", "__init__", "a-b", "1x", "x__y", "self", "sec", "x\x1b[2J", "é", "print")
_VALUES = ("=1", "=-1", "=1e999", "='a\\'", '="""', "=0x" + "f" * 400, "=" + "9" * 400, "= #", " 5", " [1, 2]", " 'x'")


def definition(bend: Bend, ros_type: str = "std_msgs/msg/String") -> str:
    """A definition in ``ros2msg`` with all that it needs; bent ones are recursive, chained, giant or nonsense."""
    rng = bend.rng
    if not bend.hit(8):
        return "string data\n" if ros_type.endswith("/String") else "float64 x\nfloat64 y\nfloat64 z\n"
    names = [f"pkg/T{index}" for index in range(rng.choice((1, 2, 5, 70, 200)))]
    parts = ["".join(_line(rng, names) for _ in range(rng.randint(0, 6)))]
    for index, name in enumerate(names):
        chain = "".join(
            f"{names[(index + 1) % len(names)]}{rng.choice(('', '[2]', '[10]', '[]'))} f{k}\n"
            for k in range(rng.randint(0, 3))
        )
        body = chain + "".join(_line(rng, names) for _ in range(rng.randint(0, 3)))
        parts.append(f"{'=' * rng.choice((80, 80, 80, 79))}\nMSG: {name}\n{body}")
    return "".join(parts)


def _line(rng: Random, names: list[str]) -> str:
    kind = rng.choice((*_BASES, *names, ros_name(rng)))
    name = rng.choice(_NAMES) + rng.choice(("", "", str(rng.randrange(9))))
    value = rng.choice(_VALUES) if rng.random() < 0.2 else ""
    comment = rng.choice(("", "", " # \x1b[2J", "  ", "\t# ' \" ="))
    return f"{kind}{rng.choice(_SIZES)} {name}{value}{comment}\n"


def ros_name(rng: Random) -> str:
    return rng.choice(("geometry_msgs/Point", "std_msgs/msg/Header", "a/b/c", "Nothing", "../x", "pkg/T0", "A"))


# -- ROS 1 -------------------------------------------------------------------------------------------------------


def _record(bend: Bend, fields: dict[str, bytes], data: bytes) -> bytes:
    head = b""
    for name, value in fields.items():
        if not bend.hit(0.3):
            field = bend.coded(name) + b"=" + bend.data(value)
            head += struct.pack("<I", bend.number(len(field))) + field
    return struct.pack("<I", bend.number(len(head))) + head + struct.pack("<I", bend.number(len(data))) + data


def rosbag1(bend: Bend) -> dict[str, bytes]:
    """A bag of two topics in a few chunks."""
    rng = bend.rng
    u32, byte = bend.u32, bend.byte
    kinds = (
        ("/text", "std_msgs/String", "string data\n"),
        ("points", "lab/Place", "float64 x\nfloat64 y\nfloat64 z\n"),
    )
    connections = []
    for number, (topic, kind, text) in enumerate(kinds):
        made = definition(bend, kind.replace("/", "/msg/")) if bend.hit(3) else text
        facts = {
            "topic": topic.encode(),
            "type": bend.coded(kind),
            "md5sum": b"*",
            "message_definition": bend.coded(made),
            "latching": b"1" if rng.random() < 0.3 else b"0",
        }
        body = b"".join(struct.pack("<I", len(n) + 1 + len(v)) + n.encode() + b"=" + v for n, v in facts.items())
        connections.append(_record(bend, {"op": byte(7), "conn": u32(number), "topic": bend.coded(topic)}, body))
    out = bytearray(b"#ROSBAG V2.0\n" + b"\0" * 4117)
    infos = []
    for chunk in range(rng.randint(1, 3)):
        inner, index = bytearray(b"".join(connections)), {0: b"", 1: b""}
        for message in range(rng.randint(0, 5)):
            number = rng.randrange(2)
            stamp = struct.pack("<II", bend.number(_EPOCH_S + chunk), bend.number(message))
            payload = struct.pack("<I", bend.number(3)) + b"abc" if number == 0 else struct.pack("<3d", 1, 2, 3)
            index[number] += stamp + u32(len(inner))
            inner += _record(bend, {"op": byte(2), "conn": u32(number), "time": stamp}, bend.data(payload))
        how = rng.choice(("none", "bz2", "lz4"))
        packed = {"none": bytes, "bz2": bz2.compress, "lz4": lz4.frame.compress}[how](bytes(inner))
        at, counts = len(out), {number: len(rows) // 12 for number, rows in index.items() if rows}
        chunk_head = {"op": byte(5), "compression": bend.coded(how), "size": u32(len(inner))}
        out += _record(bend, chunk_head, bend.data(packed))
        for number, rows in index.items():
            if rows:
                head = {"op": byte(4), "ver": u32(1), "conn": u32(number), "count": u32(counts[number])}
                out += _record(bend, head, bend.data(rows))
        info = {
            "op": byte(6),
            "ver": u32(1),
            "chunk_pos": struct.pack("<Q", bend.number(at, 64)),
            "start_time": struct.pack("<II", _EPOCH_S, 0),
            "end_time": struct.pack("<II", _EPOCH_S + 3, 0),
            "count": u32(len(counts)),
        }
        infos.append(_record(bend, info, b"".join(u32(number) + u32(count) for number, count in counts.items())))
    start = len(out)
    out += b"".join((*connections, *infos))
    place = struct.pack("<Q", bend.number(start, 64))
    bag_head = {"op": byte(3), "index_pos": place, "conn_count": u32(len(connections)), "chunk_count": u32(len(infos))}
    first = _record(Bend(rng, 0.0), bag_head, b"")[:-4]
    out[13 : 17 + len(first)] = first + struct.pack("<I", 4117 - len(first) - 4)
    return {"some.bag": bytes(out)}


# -- rosbag2 -----------------------------------------------------------------------------------------------------

_CDR = b"\0\1\0\0\4\0\0\0abc\0"
_QOS = "- history: 1\n  depth: 10\n  reliability: 1\n  durability: {}\n"


def sqlite(bend: Bend, cdr: bytes = _CDR) -> bytes:
    """A storage file of SQLite, all of its messages ``cdr``."""
    rng = bend.rng
    base = sqlite3.connect(":memory:")
    kind = rng.choice(("BLOB", "BLOB", "TEXT", "INTEGER")) if bend.hit(2) else "BLOB"
    base.execute("CREATE TABLE schema(schema_version INTEGER PRIMARY KEY, ros_distro TEXT NOT NULL)")
    base.execute("CREATE TABLE metadata(id INTEGER PRIMARY KEY, metadata_version INTEGER, metadata TEXT)")
    base.execute(
        "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT, "
        "offered_qos_profiles TEXT, type_description_hash TEXT)"
    )
    base.execute(
        "CREATE TABLE message_definitions(id INTEGER PRIMARY KEY, topic_type TEXT, encoding TEXT, "
        "encoded_message_definition TEXT, type_description_hash TEXT)"
    )
    base.execute(f"CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data {kind})")
    values: tuple[object, ...] = (None, -1, 1.5, "x", b"\xff", 2**63 - 1, -(2**63))

    def odd(value: object) -> object:
        return bend.odd(value, values)

    def clean(text: str) -> object:
        return odd(bend.utf8(text))

    for number in range(2):
        qos = clean(_QOS.format(number + 1))
        topic = (number + 1, clean(f"/t{number}"), clean("std_msgs/msg/String"), clean("cdr"), qos, clean(""))
        base.execute("INSERT INTO topics VALUES(?,?,?,?,?,?)", topic)
    text = definition(bend).encode("utf-8", "replace").decode()
    told = (clean("std_msgs/msg/String"), clean(rng.choice(("ros2msg", "ros2idl"))), clean(text))
    base.execute("INSERT INTO message_definitions VALUES(1,?,?,?,'')", told)
    for message in range(rng.randint(0, 6)):
        row = (odd(1 + message % 2), odd(_EPOCH_S * 10**9 + message), odd(bend.data(cdr)))
        base.execute("INSERT INTO messages(topic_id, timestamp, data) VALUES(?,?,?)", row)
    if bend.hit(2):
        victim = rng.choice(("messages", "topics", "message_definitions"))
        base.execute(f"ALTER TABLE {victim} RENAME TO old")
        base.execute(rng.choice((
            f"CREATE VIEW {victim} AS SELECT * FROM old, old AS b, old AS c",
            f"CREATE VIEW {victim} AS WITH RECURSIVE n(id) AS (SELECT 1 UNION ALL SELECT id+1 FROM n) SELECT * FROM n",
            f"CREATE TABLE {victim}(id INTEGER)",
            "SELECT 1",
        )))  # fmt: skip
    base.commit()
    data = base.serialize()  # type: ignore[attr-defined]  # from Python 3.11 on
    base.close()
    return data


def mcap(bend: Bend, cdr: bytes = _CDR) -> bytes:
    """A storage file of MCAP, all of its messages ``cdr``."""
    rng = bend.rng
    stream = io.BytesIO()
    how = rng.choice((CompressionType.ZSTD, CompressionType.LZ4, CompressionType.NONE))
    writer = Writer(stream, chunk_size=rng.choice((60, 1 << 20)), compression=how)
    writer.start("ros2", "fuzz")
    clean = bend.utf8
    channels = []
    for number in range(2):
        text = definition(bend).encode("utf-8", "replace")
        schema = writer.register_schema(
            clean("std_msgs/msg/String"), clean(rng.choice(("ros2msg", "ros2msg", "ros2idl"))), bend.data(text)
        )
        facts = {"offered_qos_profiles": clean(_QOS.format(number + 1))}
        channels.append(writer.register_channel(clean(f"/t{number}"), clean("cdr"), schema, facts))
    for message in range(rng.randint(0, 6)):
        time_ns = bend.number(_EPOCH_S * 10**9 + message, 64)
        writer.add_message(rng.choice(channels), time_ns, bend.data(cdr), bend.number(time_ns, 64))
    writer.finish()  # type: ignore[no-untyped-call]
    return stream.getvalue()


def metadata(bend: Bend, storage: str, file: str, mode: str = "") -> str:
    """``metadata.yaml``: shapes, anchors, tags and numbers that it should not have."""
    rng = bend.rng
    if bend.hit(1):
        return rng.choice((
            "a0: &a0 [x]\n" + "".join(f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]\n" for i in range(1, 9)),
            "a0: &a0 [x]\n" + "".join(f"a{i}: &a{i} [*a{i - 1}, *a{i - 1}]\n" for i in range(1, 40)),
            "[" * rng.choice((10, 1000, 5000)),
            "rosbag2_bagfile_information: &a {version: 5, topics_with_message_count: *a}\n",
            "rosbag2_bagfile_information: !!python/object/apply:os.system ['true']\n",
            "rosbag2_bagfile_information: []\n",
            "- " * 3000,
            "? " * 3000,
            "\x00\x01",
        ))  # fmt: skip
    others: tuple[object, ...] = (None, [], {}, "x", -1, 2**70, [[1]], {"a": 1}, True)

    def odd(value: object) -> object:
        return bend.odd(value, others)

    def topic(number: int) -> dict[str, object]:
        return {
            "topic_metadata": odd(
                {
                    "name": odd(f"/t{number}"),
                    "type": odd("std_msgs/msg/String"),
                    "serialization_format": odd(bend.text("cdr")),
                    "offered_qos_profiles": odd(_QOS.format(1)),
                }
            ),
            "message_count": odd(3),
        }

    content = {
        "version": odd(5),
        "storage_identifier": odd(storage),
        "relative_file_paths": odd([odd(bend.text(file))]),
        "duration": odd({"nanoseconds": odd(10)}),
        "starting_time": odd({"nanoseconds_since_epoch": odd(_EPOCH_S * 10**9)}),
        "message_count": odd(6),
        "topics_with_message_count": odd([odd(topic(0)), odd(topic(1))]),
        "compression_format": odd("zstd" if mode else ""),
        "compression_mode": odd(mode),
    }
    return json.dumps({"rosbag2_bagfile_information": odd(content)})  # JSON is YAML


def rosbag2(bend: Bend) -> dict[str, bytes]:
    """A folder of rosbag2, or a storage file alone."""
    rng = bend.rng
    storage, suffix, build = rng.choice((("sqlite3", "db3", sqlite), ("mcap", "mcap", mcap)))
    mode, pack = rng.choice(("", "", "FILE", "MESSAGE")), zstandard.ZstdCompressor().compress
    data = build(bend, bend.data(pack(_CDR)) if mode == "MESSAGE" else _CDR)
    name = f"bag_0.{suffix}"
    if mode == "FILE":
        data = bend.data(pack(data))
        name += ".zstd"
    if mode != "MESSAGE" and rng.random() < 0.5:
        return {name: data}
    side = metadata(bend, storage, name, mode).encode("utf-8", "surrogatepass")
    return {"bag/metadata.yaml": side, f"bag/{name}": data}


# -- network -----------------------------------------------------------------------------------------------------


def igtl_bytes(bend: Bend) -> bytes:
    """OpenIGTLink messages, one after the other."""
    out = b""
    for index in range(bend.rng.randint(1, 5)):
        message = (
            Message("STRING", "Note", String(b"hello"), index << 32)
            if index % 2
            else Message("TRANSFORM", "Probe", Transform((1, 0, 0, 0, 1, 0, 0, 0, 1, 10, 20, 30)), index << 32)
        )
        data = bytearray(b"".join(encode(message)))
        if bend.hit(2):
            data[BODY_SIZE] = U64.pack(bend.number(len(data) - HEADER_SIZE, 64))
        out += bend.data(bytes(data))
    return out


def capture(bend: Bend) -> dict[str, bytes]:
    """OpenIGTLink bytes of one direction."""
    return {"probe.s2c.igtl": igtl_bytes(bend)}


def frames(bend: Bend) -> Iterator[bytes]:
    """Ethernet frames of several TCP connections, with repeated, late and missing segments."""
    rng = bend.rng
    packets = []
    for port in range(rng.randint(1, 4)):
        data, seq = igtl_bytes(bend), rng.choice((0, 2**32 - 40, 7))
        packets.append((port, seq - 1, 2, b""))
        at = 0
        while at < len(data):
            size = rng.randint(1, 120)
            packets.append((port, seq + at, 0x10, data[at : at + size]))
            at += size
            if bend.hit(3):
                packets.insert(rng.randrange(len(packets)), packets.pop())
        packets.append((port, seq + len(data), rng.choice((1, 4)), b""))
    for port, seq, flags, data in packets:
        words = bend.number(5, 4)
        tcp = struct.pack(">HHIIBBHHH", 4000 + port, 18944, bend.number(seq), 0, words << 4, flags, 0, 0, 0) + data
        if rng.random() < 0.2:
            ip = struct.pack(">IHBB", 6 << 28, bend.number(len(tcp), 16), bend.number(6, 8), 64) + bytes(32)
            frame = bytes(12) + b"\x86\xdd" + ip + tcp
        else:
            fragment = bend.number(0, 16)
            ip = struct.pack(
                ">BBHHHBBH", bend.number(0x45, 8), 0, bend.number(len(tcp) + 20, 16), 0, fragment, 64, 6, 0
            )
            frame = bytes(12) + b"\x08\x00" + ip + bytes(8) + tcp
        if bend.hit(0.5):
            frame = frame[:12] + b"\x81\x00" * rng.randint(1, 9) + frame[12:]
        yield bend.data(frame)


def pcap(bend: Bend) -> dict[str, bytes]:
    """Captured TCP as tcpdump writes it."""
    order = bend.rng.choice("<>")
    out = struct.pack(f"{order}IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, bend.number(65535), bend.number(1))
    for index, frame in enumerate(frames(bend)):
        head = struct.pack(f"{order}4I", bend.number(_EPOCH_S), bend.number(index), bend.number(len(frame)), len(frame))
        out += head + frame
    return {"some.pcap": out}


def pcapng(bend: Bend) -> dict[str, bytes]:
    """Captured TCP as Wireshark writes it: one or two interfaces, all three kinds of packets."""
    rng = bend.rng
    order = rng.choice("<>")

    def block(kind: int, body: bytes) -> bytes:
        body = bend.data(body + bytes(-len(body) % 4))
        size = bend.number(12 + len(body), 32)
        return struct.pack(f"{order}II", bend.number(kind, 32), size) + body + struct.pack(f"{order}I", size)

    head = struct.pack(f"{order}IHHq", 0x1A2B3C4D, 1, 0, -1)
    out = struct.pack(f"{order}II", 0x0A0D0D0A, 28) + head + struct.pack(f"{order}I", 28)
    interfaces = rng.randint(1, 2)
    for _ in range(interfaces):
        units = struct.pack(f"{order}HHB3x", 9, 1, bend.number(rng.choice((6, 9, 0x94)), 8))
        out += block(1, struct.pack(f"{order}HHI", 1, 0, bend.number(65535, 32)) + units)
    for index, frame in enumerate(frames(bend)):
        size = bend.number(len(frame), 32)
        place = (bend.number(rng.randrange(interfaces), 16), 0, index, bend.number(index, 32), size, len(frame))
        kind = rng.choice((2, 3, 6, 6))
        form = {2: "2H4I", 3: "I", 6: "5I"}[kind]
        fields = {2: place, 3: place[-1:], 6: (place[0], *place[2:])}[kind]
        out += block(kind, struct.pack(order + form, *fields) + frame)
    return {"some.pcapng": out}


#: Format → what builds its files.
BUILDERS: dict[str, Callable[[Bend], dict[str, bytes]]] = {
    "rosbag1": rosbag1,
    "rosbag2": rosbag2,
    "igtl": capture,
    "pcap": pcap,
    "pcapng": pcapng,
}


def main() -> None:
    """Write some cases into folders."""
    parser = argparse.ArgumentParser(description="write damaged files for the importers")
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--count", type=int, default=100)
    options = parser.parse_args()
    for index, case in zip(range(options.count), cases(options.seed), strict=False):
        folder = options.folder / f"{index:06}"
        folder.mkdir(parents=True)
        case.write(folder)


if __name__ == "__main__":
    main()
