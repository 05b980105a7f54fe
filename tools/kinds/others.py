"""Files of other programs: bags of ROS 1 and ROS 2, captures, OpenIGTLink bytes, images and sequences."""

from __future__ import annotations

import gzip
import sqlite3
import struct
from collections.abc import Mapping
from typing import Any

from igtl_gateway.wire import Message, encode
from igtl_gateway.wire.text import String
from igtl_gateway.wire.transform import Transform
from tests.record import samples
from tools import mcap_build as build
from tools.kinds.recordings import igtl_message, recorded, strike
from tools.kinds.values import Maker
from tools.mcap_build import Chunk, Record

Files = Mapping[str, bytes]
_S = 1_000_000_000
_EPOCH_S = 1_700_000_000


# -- ROS 1: wiki.ros.org/Bags/Format/2.0 --------------------------------------------------------------------------


_RULE = "=" * 80 + "\n"
_HEADER = f"{_RULE}MSG: std_msgs/Header\nuint32 seq\ntime stamp\nstring frame_id\n"
_EMPTY = f"{_RULE}MSG: std_msgs/Empty\n"
#: Type, definition, and a message of it with the places of its counts and words.
_ROS1 = (
    ("std_msgs/String", "string data\n", b"\5\0\0\0hello"),
    ("lab/Empties", f"std_msgs/Empty[] e\n{_EMPTY}", b"\2\0\0\0"),
    ("lab/Stamped", f"Header h\ntime t\nduration[] d\nstd_msgs/Empty[] e\n{_HEADER}{_EMPTY}", bytes(32)),
    ("lab/Nested", f"lab/B[] b\nfloat64[] x\n{_RULE}MSG: lab/B\nstring s\nstd_msgs/Empty[] e\n{_EMPTY}",
     b"\1\0\0\0\1\0\0\0a\0\0\0\0\1\0\0\0" + bytes(8)),
    ("geometry_msgs/Point", "float64 x\nfloat64 y\nfloat64 z\n", bytes(24)),
)  # fmt: skip


def _field(name: str, value: bytes, make: Maker, place: str) -> bytes:
    body = f"{name}=".encode() + make.blob(f"{place}.({name})", value)
    return struct.pack("<I", make.length(f"{place}.({name}).length", len(body))) + body


def _bag_record(make: Maker, place: str, op: int, items: Mapping[str, bytes], data: bytes) -> bytes:
    head = _field("op", bytes([make.number(f"{place}.opcode", op, "u8")]), make, place)
    head += b"".join(_field(name, value, make, place) for name, value in items.items())
    return b"".join(
        (
            struct.pack("<I", make.length(f"{place}.header.length", len(head))),
            head,
            struct.pack("<I", make.length(f"{place}.data.length", len(data))),
            data,
        )
    )


def rosbag1(make: Maker) -> Files:
    """A bag with one chunk."""

    def u32(place: str, value: int) -> bytes:
        return struct.pack("<I", make.number(place, value, "u32"))

    def u64(place: str, value: int) -> bytes:
        return struct.pack("<Q", make.number(place, value, "u64"))

    kind, definition, message = make.one_of("type", _ROS1, lambda row: row[0])
    topic = make.coded("topic", "/made")

    def connection() -> bytes:
        items = {"topic": topic, "type": make.coded("connection.type", kind), "md5sum": b"0" * 32,
                 "message_definition": make.coded(f"type.{kind}.definition", definition)}  # fmt: skip
        told = b"".join(_field(name, value, make, "connection.told") for name, value in items.items())
        return _bag_record(make, "connection", 7, {"conn": u32("connection.number", 0), "topic": topic}, told)

    def stamp(place: str, at: int) -> bytes:
        return u32(f"{place}.sec", _EPOCH_S + at) + u32(f"{place}.nsec", 5)

    inside = connection()
    count = make.rng.choice((1, 1, 3, 30))
    for at in range(count):
        items = {"conn": u32("message.connection", 0), "time": stamp("message.time", at)}
        inside += _bag_record(make, "message", 2, items, make.words(f"type.{kind}.data", message, 64, 1))
    packing = make.rng.choice(("none", "bz2", "lz4"))
    chunk = _bag_record(
        make,
        "chunk",
        5,
        {
            "compression": make.coded("chunk.packing", packing if packing == "none" else "none"),
            "size": struct.pack("<I", make.length("chunk.size", len(inside))),
        },
        make.blob("chunk.data", inside),
    )
    begin = 13 + 4096
    info = {"ver": u32("info.version", 1), "chunk_pos": u64("info.position", begin),
            "start_time": stamp("info.start", 0), "end_time": stamp("info.end", count),
            "count": u32("info.connections", 1)}  # fmt: skip
    counts = u32("info.connection", 0) + u32("info.messages", count)
    index = connection() + _bag_record(make, "info", 6, info, counts)
    told = {"index_pos": u64("bag.index", begin + len(chunk)), "conn_count": u32("bag.connections", 1),
            "chunk_count": u32("bag.chunks", 1)}  # fmt: skip
    head = _bag_record(make, "bag", 3, told, b"")[:-4]
    head += struct.pack("<I", make.length("bag.padding", 4096 - len(head) - 4))
    return {"a.bag": b"#ROSBAG V2.0\n" + head.ljust(4096, b" ") + chunk + index}


# -- ROS 2: SQLite with metadata.yaml ------------------------------------------------------------------------------


def rosbag2(make: Maker) -> Files:
    """A folder with a storage file in SQLite and its metadata."""
    base = sqlite3.connect(":memory:")
    base.execute(
        "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT,"
        " offered_qos_profiles TEXT)"
    )
    base.execute("CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB)")
    depth = make.written("qos.depth", "10")
    qos = make.text("topic.qos", f"- history: 1\n  depth: {depth}\n  reliability: 1\n  durability: 2\n")

    def stored(text: str) -> str | bytes:
        try:
            text.encode()
        except UnicodeEncodeError:
            return text.encode("utf-8", "surrogatepass")
        return text

    row = (1, stored(make.text("topic.name", "/chatter")), stored(make.text("topic.type", "std_msgs/msg/String")),
           stored(make.text("topic.format", "cdr")), stored(qos))  # fmt: skip
    base.execute("INSERT INTO topics VALUES (?, ?, ?, ?, ?)", row)
    count = make.rng.choice((1, 3, 20))
    for at in range(count):
        data = make.blob("message.data", make.words("message", samples.string_cdr("hello"), 20, 1))
        time_ns: Any = make.number("message.time", (_EPOCH_S + at) * _S, "i64")
        base.execute("INSERT INTO messages VALUES (?, ?, ?, ?)",
                     (at + 1, make.number("message.topic", 1, "i32"), time_ns, data))  # fmt: skip
    base.commit()
    image = base.serialize()  # type: ignore[attr-defined]  # from Python 3.11 on
    base.close()
    return {
        "a/a_0.db3": make.words("sqlite", image, 100),
        "a/metadata.yaml": _metadata(make, "sqlite3", "a_0.db3", count),
    }


def _metadata(make: Maker, storage: str, file: str, count: int) -> bytes:
    """metadata.yaml of a bag with one topic."""
    written = make.written
    yaml = f"""rosbag2_bagfile_information:
  version: {written("yaml.version", "8")}
  storage_identifier: {written("yaml.storage", storage)}
  duration:
    nanoseconds: {written("yaml.duration", "5")}
  starting_time:
    nanoseconds_since_epoch: {written("yaml.start", "1700000000000000000")}
  message_count: {written("yaml.count", str(count))}
  topics_with_message_count: {written("yaml.topics", "")}
    - topic_metadata:
        name: {written("yaml.name", "/chatter")}
        type: {written("yaml.type", "std_msgs/msg/String")}
        serialization_format: {written("yaml.format", "cdr")}
        offered_qos_profiles: {written("yaml.qos", '""')}
      message_count: {written("yaml.messages", str(count))}
  compression_format: {written("yaml.packing", '""')}
  compression_mode: {written("yaml.mode", '""')}
  relative_file_paths: {written("yaml.files", "")}
    - {written("yaml.file", file)}
"""
    return yaml.encode("utf-8", "surrogatepass")


def rosbag2_mcap(make: Maker) -> Files:
    """A folder with a storage file in MCAP, record by record, and its metadata."""
    schema = build.schema(1, "std_msgs/msg/String", "ros2msg", make.coded("definition", "string data\n"))
    items = {"offered_qos_profiles": "- history: 1\n  depth: 10\n  reliability: 1\n  durability: 2\n"}
    records: list[Record] = [
        (build.SCHEMA, schema),
        (build.CHANNEL, build.channel(1, 1, "/chatter", "cdr", items)),
    ]
    count = make.rng.choice((1, 3, 20))
    for at in range(count):
        data = make.blob("data", make.words("cdr", samples.string_cdr("hello"), 20, 1))
        time_ns = (_EPOCH_S + at) * _S
        records.append((build.MESSAGE, build.message(1, at, time_ns, time_ns, data)))
    chunk = Chunk(tuple(records), compression=make.rng.choice(("", "zstd", "lz4")))
    header = build.HEADER, build.header(make.text("profile", "ros2"), "libmcap 1.0")
    parts = [strike(make, part) for part in (header, chunk)]
    made = build.assemble(parts)
    made.summary = [(code, make.words(f"summary.{code}", data, 80)) for code, data in made.summary]
    storage = made.finish(start=make.length("footer.summary", len(made.data), 64))
    return {"a/a_0.mcap": storage, "a/metadata.yaml": _metadata(make, "mcap", "a_0.mcap", count)}


# -- captures ------------------------------------------------------------------------------------------------------


def _talk(make: Maker) -> list[bytes]:
    """Ethernet frames of one connection on which messages are sent."""
    messages = b"".join(
        b"".join(encode(Message(kind, "Probe", content, (_EPOCH_S + at) << 32)))
        for at, (kind, content) in enumerate(
            (("TRANSFORM", _POSE), ("STRING", String(b"hello"))) * make.rng.choice((1, 4))
        )
    )
    data = make.words("stream", messages, 120)
    sequence, frames = make.number("tcp.sequence", 1000, "u32"), []
    pieces = [data[at : at + 90] for at in range(0, len(data), 90)]
    for number, piece in enumerate(pieces):
        tcp = struct.pack(">HHIIBBHHH", 40000, 18944, (sequence + 90 * number) % (1 << 32), 1,
                          make.number("tcp.offset", 5, "u8") % 16 << 4, 0x18, 100, 0, 0)  # fmt: skip
        total = make.length("ip.length", 20 + len(tcp) + len(piece), 16)
        ip = struct.pack(">BBHHHBBHII", make.number("ip.version", 0x45, "u8"), 0, total, number,
                         make.number("ip.fragment", 0, "u16"), 64, 6, 0, 0x7F000001, 0x7F000002)  # fmt: skip
        frames.append(bytes(12) + b"\x08\x00" + ip + tcp + piece)
    return frames


_POSE = Transform((1, 0, 0, 0, 1, 0, 0, 0, 1, 10, 20, 30))


def pcap(make: Maker) -> Files:
    data = make.words("file", struct.pack("<IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, 65535, 1), 24, 1)
    for number, frame in enumerate(_talk(make)):
        size = make.length("packet.captured", len(frame))
        data += struct.pack("<IIII", make.number("packet.seconds", _EPOCH_S, "u32"),
                            make.number("packet.rest", number, "u32"), size,
                            make.length("packet.sent", len(frame)))  # fmt: skip
        data += make.blob("packet.data", frame)
    return {"a.pcap": data}


def pcapng(make: Maker) -> Files:
    def block(name: str, code: int, body: bytes) -> bytes:
        body += bytes(-len(body) % 4)
        size = make.length(f"{name}.length", len(body) + 12)
        last = make.length(f"{name}.length again", len(body) + 12)
        return struct.pack("<II", make.number(f"{name}.kind", code, "u32"), size) + body + struct.pack("<I", last)

    def option(name: str, code: int, value: bytes) -> bytes:
        value = make.blob(name, value)
        head = struct.pack("<HH", code, make.length(f"{name}.length", len(value), 16))
        return head + value + bytes(-len(value) % 4)

    order = make.number("section.order", 0x1A2B3C4D, "u32")
    data = block(
        "section", 0x0A0D0D0A, struct.pack("<IHHQ", order, 1, 0, make.length("section.size", (1 << 64) - 1, 64))
    )
    resolution = bytes([make.number("interface.resolution", 9, "u8")])
    offset = struct.pack("<q", make.number("interface.offset", 0, "i64"))
    options = option("interface.if_name", 2, b"lo") + option("interface.if_tsresol", 9, resolution)
    options += option("interface.if_tsoffset", 14, offset) + option("interface.if_filter", 11, b"\0tcp")
    options += struct.pack("<HH", 0, make.length("interface.end", 0, 16))
    link = make.number("interface.link", 1, "u16")
    data += block("interface", 1, struct.pack("<HHI", link, 0, make.number("interface.snap", 0, "u32")) + options)
    kind = make.one_of("packet", ("enhanced", "simple", "obsolete"))
    for at, frame in enumerate(_talk(make)):
        ticks = make.number("packet.ticks", (_EPOCH_S + at) * _S, "u64")
        captured, sent = make.length("packet.captured", len(frame)), make.length("packet.sent", len(frame))
        number = make.number("packet.interface", 0, "u16")
        high, low = ticks >> 32, ticks & 0xFFFF_FFFF
        match kind:
            case "enhanced":
                body = struct.pack("<IIIII", number, high, low, captured, sent) + frame + bytes(-len(frame) % 4)
                body += option(f"packet.{kind}.epb_flags", 2, bytes(4)) + bytes(4)
                data += block(f"packet.{kind}", 6, body)
            case "simple":
                data += block(f"packet.{kind}", 3, struct.pack("<I", sent) + frame)
            case _:
                body = struct.pack("<HHIIII", number, 0, high, low, captured, sent) + frame
                data += block(f"packet.{kind}", 2, body)
    return {"a.pcapng": data}


def stream(make: Maker) -> Files:
    """OpenIGTLink bytes of one type as they are on a link, any word of them."""
    entries = {each.type: each.data() for each in recorded()[0] if each.type and each.channel.startswith(each.type)}
    kind = make.one_of("igtl", sorted(entries))
    one = igtl_message(make, f"igtl.{kind}", entries[kind])
    return {"a.igtl": one * make.rng.choice((1, 2, 5))}


# -- images --------------------------------------------------------------------------------------------------------


def _number_text(make: Maker, name: str, true: str) -> str:
    return " ".join(make.text(f"{name}.number", word) for word in true.split())


def metaimage(make: Maker) -> Files:
    """A volume or a tracked sequence."""
    is_sequence = make.one_of("kind", ("sequence", "volume")) == "sequence"
    frames = make.rng.choice((1, 2, 6)) if is_sequence else 1
    fields = {
        "ObjectType": "Image", "NDims": "3", "BinaryData": "True", "BinaryDataByteOrderMSB": "False",
        "CompressedData": "False", "CompressedDataSize": "0", "TransformMatrix": "1 0 0 0 1 0 0 0 1", "Offset": "0 0 0",
        "CenterOfRotation": "0 0 0", "AnatomicalOrientation": "RAI", "ElementSpacing": "1 1 1",
        "ElementNumberOfChannels": "1", "DimSize": f"4 3 {frames}", "Kinds": "domain domain list",
        "ElementType": "MET_UCHAR", "UltrasoundImageOrientation": "MFA", "UltrasoundImageType": "BRIGHTNESS",
    }  # fmt: skip
    if not is_sequence:
        fields.pop("Kinds")
    for at in range(frames if is_sequence else 0):
        fields |= {
            f"Seq_Frame{at:04}_ProbeToTrackerTransform": "1 0 0 5 0 1 0 6 0 0 1 7 0 0 0 1",
            f"Seq_Frame{at:04}_ProbeToTrackerTransformStatus": "OK",
            f"Seq_Frame{at:04}_Timestamp": f"{at / 10}",
            f"Seq_Frame{at:04}_ImageStatus": "OK",
        }
    lines = []
    for key, value in fields.items():
        bare = f"frame.{key.partition('_')[2].partition('_')[2]}" if key.startswith("Seq") else key
        lines.append(f"{make.text(f'{bare}.(key)', key)} = {make.text(bare, _number_text(make, bare, value))}")
    text = "\n".join([*lines, f"ElementDataFile = {make.text('ElementDataFile', 'LOCAL')}", ""])
    pixels = make.blob("pixels", bytes(range(12)) * frames)
    return {"a.igs.mha" if is_sequence else "a.mha": text.encode("utf-8", "surrogatepass") + pixels}


def nrrd(make: Maker) -> Files:
    kind = make.one_of("scalar", ("uint8", "float", "double", "int64", "short"))
    code = {"uint8": "B", "float": "f", "double": "d", "int64": "q", "short": "h"}[kind]
    packing = make.one_of("packing", ("raw", "gzip"))
    fields = {
        "type": kind, "dimension": "3", "space": "left-posterior-superior", "sizes": "4 3 2", "endian": "little",
        "space directions": "(1,0,0) (0,1,0) (0,0,1)", "kinds": "domain domain domain", "encoding": packing,
        "space origin": "(0,0,0)", "line skip": "0", "byte skip": "0",
    }  # fmt: skip
    lines = [f"{make.text(f'{key}.(key)', key)}: {make.text(key, _number_text(make, key, value))}"
             for key, value in fields.items()]  # fmt: skip
    text = "\n".join([make.text("magic", "NRRD0005"), *lines, make.text("pair", "a:=b"), "", ""])
    if code in "fd":
        values: list[Any] = [make.float(f"scalar.{kind}.pixel", 0.5) for _ in range(24)]
        values = [each if code == "d" or abs(each) < 3.4e38 else float("inf") for each in values]
    else:
        values = [make.number(f"scalar.{kind}.pixel", 1, {"B": "u8", "q": "i64", "h": "i16"}[code]) for _ in range(24)]
    pixels = make.blob("pixels", struct.pack(f"<24{code}", *values))
    if packing == "gzip":
        pixels = make.words("packing.gzip.bytes", gzip.compress(pixels, mtime=0), 40, 1)
    return {"a.nrrd": text.encode("utf-8", "surrogatepass") + pixels}


def nifti(make: Maker) -> Files:
    """Every word of a header, and a few pixels."""
    head = bytearray(352)
    struct.pack_into("<i", head, 0, 348)
    struct.pack_into("<8h", head, 40, 3, 4, 3, 2, 1, 1, 1, 1)
    struct.pack_into("<hh", head, 70, 16, 32)
    struct.pack_into("<8f", head, 76, 1, 1, 1, 1, 1, 1, 1, 1)
    struct.pack_into("<f", head, 108, 352.0)
    struct.pack_into("<hh", head, 252, 1, 1)
    struct.pack_into("<12f", head, 280, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0)
    head[344:348] = b"n+1\0"
    data = make.words("header", bytes(head), 352)
    data += make.blob(
        "pixels", struct.pack("<24f", *(max(-3e38, min(make.float("pixel", 0.5), 3e38)) for _ in range(24)))
    )
    if make.one_of("packing", ("none", "gzip")) == "gzip":
        return {"a.nii.gz": make.words("packing.gzip.bytes", gzip.compress(data, mtime=0), 30, 1)}
    return {"a.nii": data}
