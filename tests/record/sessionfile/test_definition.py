"""Odd definitions of message types: the bytes of their files are recorded, and every reader that can reads them."""

from __future__ import annotations

import json
import struct
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest
from mcap.reader import make_reader
from mcap.writer import Writer
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader

from igtl_gateway.base.errors import DamagedRecording
from igtl_gateway.base.untrusted.decoding import MessageDecoder
from igtl_gateway.base.untrusted.dialects import RULE
from igtl_gateway.convert.rosmsg import String
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.record.sessionfile.definition import Definition, FileDefinitions
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.record.sessionfile.schemas import RosTypes
from igtl_gateway.record.sessionfile.writer import SessionWriter
from tests.record import samples
from tests.tables import table

TYPE, STRING = "p/msg/A", "std_msgs/msg/String"
MSG_MCAP, RERUN, ROSBAGS = "mcap-ros2-support", "rerun", "rosbags"
#: Files of other packages that the types below need.
FILES = {
    "q/msg/Pose": b"r/Point p\r\nr/Point[] ps\r\n",
    "r/msg/Point": b"float64 x 1.5\r\nfloat64 y",
    STRING: b"string data\n",
}


@dataclass(frozen=True)
class Odd:
    """A definition as a ``.msg`` file has it.

    Attributes:
        text: the file.
        rest: the bytes of a message behind the field ``a``, an int32.
        unread: readers that do not read the type; ``""``: this program.
        blinded: readers that for its sake do not read any other topic of the file.
    """

    text: bytes
    rest: bytes = b""
    unread: tuple[str, ...] = ()
    blinded: tuple[str, ...] = ()


def text(word: str) -> bytes:
    data = word.encode() + b"\0"
    return struct.pack("<I", len(data)) + data + bytes(-len(data) % 4)


ODD = {
    "plain": Odd(b"# words\nint32 a 5  # default\nint32 B=3\n"),
    "line ends of Windows": Odd(b"# words\r\nint32 a\r\nint32 B=3\r\n", blinded=(ROSBAGS,)),
    "line ends of a Mac": Odd(b"# words\rint32 a\rint32 B=3\r", unread=(ROSBAGS,)),
    "tabs": Odd(b"\tint32\t\ta\t# tab\nint32\tB\t=\t3\n"),
    "bool": Odd(b"bool SAFE=true\nbool OFF=false\nint32 a\n"),
    "numbers": Odd(b"uint8 A=0o17\nuint8 C=0x1F\nuint8 D=0b11\nint32 a\n", blinded=(ROSBAGS, RERUN)),
    "a hash in quotes": Odd(b'string S="a#b"\nint32 a\n'),
    "quotes in comments": Odd(b"int32 a  # don't \"quote\n# it's\n"),
    "a comment in Latin-1": Odd("int32 a  # Größe\n".encode("latin1"), unread=(MSG_MCAP,), blinded=(ROSBAGS,)),
    "a comment in UTF-8": Odd("int32 a  # Größe \u2028 x\n".encode(), unread=(MSG_MCAP,)),
    "a form feed": Odd(b"int32 a # \x0c words\n", unread=(MSG_MCAP,)),
    "default values": Odd(
        b'int32 a 5\nstring s "two words # here"\nfloat32[] x [1.0, 2.0]\nstring[2] t ["a", "b c"]\n',
        text("seven") + struct.pack("<Iff", 2, 1, 2) + text("one") + text("two"),
    ),
    "bounds": Odd(
        b"int32 a\nstring<=10[<=3] names\nstring<=5 s\nfloat32[<=4] w\n",
        struct.pack("<I", 1) + text("one") + text("two") + struct.pack("<If", 1, 5),
    ),
    "wstring": Odd(b"int32 a\nwstring w\n", struct.pack("<I", 0), unread=("", MSG_MCAP, ROSBAGS)),
    "bounded wstring": Odd(
        b"int32 a\nwstring<=5[<=3] w\n", struct.pack("<I", 0), unread=("", MSG_MCAP), blinded=(ROSBAGS,)
    ),
    "no line end": Odd(b"int32 a"),
    "indented": Odd(b"  int32 a\n   # c\n"),
    "types of others": Odd(
        b"int32 a\nq/Pose pose\nstd_msgs/String s\n",
        bytes(4) + struct.pack("<dd", 1, 2) + struct.pack("<I", 0) + text("seven"),
        blinded=(ROSBAGS,),
    ),
    "a Header of its own": Odd(b"int32 a\nHeader h\n", b"\x05", unread=(ROSBAGS,)),
    "rules in comments": Odd(b"int32 a\n# " + b"=" * 90 + b"\n#" + RULE.encode() + b"\n"),
}


def record(folder: Path, odd: Odd) -> tuple[Definition, Path]:
    """Three messages of the type, and three strings, as a bridge records them where these files are installed."""
    for name, data in {**FILES, TYPE: odd.text, "p/msg/Header": b"int8 z\n"}.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / f"{name}.msg").write_bytes(data)
    types = RosTypes([folder])
    found = types.find(TYPE)
    assert found
    path = folder / "a.mcap"
    writer = SessionWriter(path, {"config": "{}"}, types=types)
    for number, entry in enumerate(("/a", "/s") * 3, 1):
        data = struct.pack("<Ii", 0x100, 7) + odd.rest if entry == "/a" else String("hello").pack()
        kind = TYPE if entry == "/a" else STRING
        writer.write(Entry(number, samples.START_NS + number, Kind.ROS_IN, entry, kind, (data,)))
    writer.close({})
    return found, path


def other_readers(path: Path) -> Iterator[tuple[str, str]]:
    """Each reader with each topic that it reads."""
    for topic in ("/a", "/s"):
        try:
            with path.open("rb") as stream:
                reader = make_reader(stream, decoder_factories=[DecoderFactory()])
                assert len(list(reader.iter_decoded_messages(topics=[topic]))) == 3
            yield MSG_MCAP, topic
        except (UnicodeDecodeError, IndexError, NotImplementedError):
            pass
    try:
        with AnyReader([path]) as bag:
            for topic in ("/a", "/s"):
                try:
                    wanted = [each for each in bag.connections if each.topic == topic]
                    assert len([bag.deserialize(data, each.msgtype) for each, _, data in bag.messages(wanted)]) == 3
                    yield ROSBAGS, topic
                except Exception:  # several kinds
                    pass
    except Exception:
        pass
    rerun = (Path(sys.prefix) / "bin" / "rerun", "mcap", "convert", path, "-o", path.with_suffix(".rrd"))
    said = subprocess.run(rerun, capture_output=True, text=True, check=True)
    for topic in ("/a", "/s"):
        if f"{topic}," in said.stderr + said.stdout:
            yield RERUN, topic


@table("name", ODD)
def test_the_files_own_bytes_are_recorded(name: str, tmp_path: Path) -> None:
    odd = ODD[name]
    found, path = record(tmp_path, odd)
    assert found.data.startswith(odd.text)
    with path.open("rb") as stream:
        schemas = {schema.name: schema for schema in make_reader(stream).get_summary().schemas.values()}  # type: ignore[union-attr]
    assert (schemas[TYPE].data, schemas[TYPE].encoding) == (found.data, "ros2msg")
    with SessionFile.open(path) as file:
        assert file.definition_of(TYPE) == found
        decoder = MessageDecoder(lambda ros_type: file.definitions.get(ros_type, ""))
        (entry, *_) = (entry for entry in file.entries() if entry.channel == "/a")
    if "" in odd.unread:
        with pytest.raises(DamagedRecording, match="messages with wstring are not decoded"):
            decoder.decode(TYPE, entry.data())
    else:
        assert decoder.decode(TYPE, entry.data()).a == 7
    read = set(other_readers(path))
    readers = {MSG_MCAP, ROSBAGS, RERUN} - {*odd.blinded}
    assert {reader for reader, topic in read if topic == "/s"} == readers
    assert {reader for reader, topic in read if topic == "/a"} >= readers - {RERUN, *odd.unread}


def test_the_hash_is_that_of_the_installation(tmp_path: Path) -> None:
    told = f"RIHS01_{'5e' * 32}"
    (tmp_path / "p" / "msg").mkdir(parents=True)
    (tmp_path / "p/msg/A.msg").write_bytes(b"wstring w\n")
    rows = [{"type_name": "p/msg/B", "hash_string": "RIHS01_"}, {"type_name": TYPE, "hash_string": told}]
    (tmp_path / "p/msg/A.json").write_text(json.dumps({"type_hashes": rows}))
    assert RosTypes([tmp_path]).find(TYPE) == Definition(b"wstring w\n", "ros2msg", told)
    (tmp_path / "p/msg/A.json").write_text("{")
    assert RosTypes([tmp_path]).find(TYPE) == Definition(b"wstring w\n", "ros2msg", "")


def test_idl_files_are_recorded_where_there_are_no_others(tmp_path: Path) -> None:
    """As rosbag2: those of all types, as soon as one has no ``.msg`` file."""
    files = {
        "p/msg/A.idl": '#include "q/msg/B.idl"\nmodule p { module msg { struct A { q::msg::B b; long a; }; }; };\n',
        "p/msg/A.msg": "q/B b\nint32 a\n",
        "q/msg/B.idl": "module q { module msg { struct B { double x; }; }; };\n",
    }
    for name, content in files.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(content)
    found = RosTypes([tmp_path]).find(TYPE)
    assert found and found.encoding == "ros2idl" and found.type_hash.startswith("RIHS01_")
    head = f"{RULE}\nIDL: "
    assert found.data.decode() == f"{head}p/msg/A\n{files['p/msg/A.idl']}{head}q/msg/B\n{files['q/msg/B.idl']}"
    data = struct.pack("<Idi", 0x100, 2.5, 7)
    assert MessageDecoder(lambda _: found.text(TYPE)).decode(TYPE, data).b.x == 2.5


def foreign(path: Path, *schemas: tuple[str, bytes, bytes]) -> Path:
    """A channel for each schema, of encoding and definition, with one message."""
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start("ros2", "test")
        for number, (encoding, data, message) in enumerate(schemas, 1):
            schema = writer.register_schema(TYPE, encoding, data)
            channel = writer.register_channel(f"/{number}", "cdr", schema)
            writer.add_message(channel, samples.START_NS + number, message, samples.START_NS + number)
        writer.finish()  # type: ignore[no-untyped-call]
    return path


def test_a_second_definition_of_a_type_is_not_read_with_the_first(tmp_path: Path) -> None:
    """The same fields in other words, or in IDL, are the same definition."""
    seven = struct.pack("<Ii", 0x100, 7)
    path = foreign(
        tmp_path / "a.mcap",
        ("ros2msg", b"int32 a\n", seven),
        ("ros2msg", b"float32 a\n", seven),
        ("ros2msg", b"int32 a # in other words\r\nint32 X=3\r\n", seven),
        ("ros2idl", b"module p { module msg { struct A { long a; }; }; };", seven),
        ("ros2msg", b"int32 a\nint32 b\n", seven + seven[4:]),
    )
    with SessionFile.open(path) as file:
        assert [entry.channel for entry in file.entries()] == ["/1", "/3", "/4"]
        assert [(each.topic, each.count) for each in file.skipped] == [("/2", 1), ("/5", 1)]
        assert all("another definition of p/msg/A" in each.why for each in file.skipped)


def test_definitions_that_cannot_be_compared_are_two() -> None:
    kept = FileDefinitions()
    assert kept.takes(TYPE, Definition(b"")) and kept.takes(TYPE, Definition(b"wstring a\n"))
    assert kept.takes(TYPE, Definition(b"wstring a\n")) and kept.takes(TYPE, Definition(b""))
    assert not kept.takes(TYPE, Definition(b"wstring b\n"))
    assert kept.takes(TYPE, Definition(b"message A {}", "protobuf"))
