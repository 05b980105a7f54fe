"""Hostile MCAP files of other programs: names, and definitions of message types."""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from functools import partial

from tests.integration.hostile_files.case import ESCAPE, GIB, NAUGHTY, Danger, Hostile, file, lz4_zeros, zstd_zeros
from tests.record import samples
from tools import mcap_build as build
from tools.mcap_build import Chunk, Record

_HELLO = samples.string_cdr("hello")


def bag(
    definition: str | bytes = "string data\n",
    name: str = "std_msgs/msg/String",
    topic: str | bytes = "/chatter",
    data: Sequence[bytes] = (_HELLO,) * 5,
    encoding: str = "cdr",
    schema_encoding: str = "ros2msg",
    more: Sequence[Record | Chunk] = (),
    qos: str = "",
) -> bytes:
    """A rosbag2 recording with one topic."""
    text = definition.encode() if isinstance(definition, str) else definition
    channel = build.channel(1, 1, topic, encoding, {"offered_qos_profiles": qos})
    messages = [
        (build.MESSAGE, build.message(1, number, 10**18 + number, 10**18, each)) for number, each in enumerate(data)
    ]
    records: list[Record | Chunk] = [
        (build.HEADER, build.header("ros2", "somebody")),
        Chunk(
            ((build.SCHEMA, build.schema(1, name, schema_encoding, text)), (build.CHANNEL, channel), *messages), "lz4"
        ),
        *more,
    ]
    return build.assemble(records).finish()


def chained(length: int) -> str:
    """A definition whose types name each other in a chain."""
    parts = ["lab/T0 first\n"]
    for number in range(length):
        following = f"lab/T{number + 1} next\n" if number + 1 < length else "uint8 end\n"
        parts.append(f"{'=' * 80}\nMSG: lab/T{number}\n{following}")
    return "".join(parts)


def doubling(depth: int) -> str:
    """A definition whose types hold two of the next one each: 2^depth fields."""
    parts = ["lab/T0 a\nlab/T0 b\n"]
    for number in range(depth):
        following = f"lab/T{number + 1} a\nlab/T{number + 1} b\n" if number + 1 < depth else "uint8 end\n"
        parts.append(f"{'=' * 80}\nMSG: lab/T{number}\n{following}")
    return "".join(parts)


_RECURSIVE = f"lab/A a\n{'=' * 80}\nMSG: lab/A\nlab/B b\n{'=' * 80}\nMSG: lab/B\nlab/A a\n"
_LAB = "lab/msg/Thing"


def _case(name: str, danger: Danger, what: str, data: Callable[[], bytes]) -> Hostile:
    slug = f"foreign-{name}".replace("/", "-")
    return Hostile(slug, "foreign MCAP", danger, what, file(f"{slug}.mcap", data))


def _definition(name: str, what: str, text: Callable[[], str | bytes], kind: str = _LAB) -> Hostile:
    return _case(name, Danger.LIE, f"a definition {what}", lambda: bag(text(), kind, "/thing", (bytes(64),) * 5))


def _bomb(compression: str, pack: Callable[[int], bytes], size: int) -> Callable[[], bytes]:
    return lambda: bag(more=(Chunk((), compression, packed=pack(2 * GIB), size=size, crc=0, start=1, end=2),))


def _array(count: int) -> bytes:
    """A CDR message whose first field is an array of ``count`` elements."""
    return b"\0\1\0\0" + struct.pack("<I", count) + b"abcd" * 8


CASES: tuple[Hostile, ...] = (
    *(
        _case(
            f"{name}-{size}",
            Danger.BOMB,
            f"a chunk of {name} with 2 GiB that claims {size:,} bytes",
            _bomb(name, pack, size),
        )
        for name, pack in (("zstd", zstd_zeros), ("lz4", lz4_zeros))
        for size in (2 * GIB, 1000)
    ),
    _definition("recursive", "whose types name each other in a ring", lambda: _RECURSIVE),
    _definition("self", "that names itself", lambda: "lab/Thing thing\n"),
    _definition("self-array", "that holds an array of itself", lambda: "lab/Thing[] things\nuint8 end\n"),
    _definition("chain-2000", "with a chain of 2,000 types", lambda: chained(2000)),
    _definition("chain-50", "with a chain of 50 types", lambda: chained(50)),
    _definition("doubling-24", "with 2^24 fields, two types in each", lambda: doubling(24)),
    _definition("doubling-60", "with 2^60 fields", lambda: doubling(60)),
    _definition(
        "fields-100000", "with 100,000 fields", lambda: "".join(f"uint8 f{number}\n" for number in range(100_000))
    ),
    _definition("giant-array", "with a fixed array of 2^40 numbers", lambda: "float64[1099511627776] values\n"),
    _definition(
        "nested-arrays",
        "with arrays of arrays of 65,535 structures",
        lambda: "lab/A[65535] a\n" + f"{'=' * 80}\nMSG: lab/A\nlab/B[65535] b\n{'=' * 80}\nMSG: lab/B\nuint8 c\n",
    ),
    _definition("giant-text", "of 40 MB", lambda: "# " + "x" * 40_000_000 + "\nuint8 a\n"),
    _definition("one-line", "with one name of 1 MB", lambda: "uint8 " + "x" * 1_000_000 + "\n"),
    _definition(
        "constants", "with 20,000 constants", lambda: "".join(f"uint8 C{n}={n % 256}\n" for n in range(20_000))
    ),
    _definition(
        "defaults",
        "with endless default values",
        lambda: "string a '" + "\\'" * 100_000 + "\nuint8[] b [" + "[" * 5000 + "\n",
    ),
    _definition("no-utf8", "that is invalid UTF-8", lambda: b"uint8 \xff\xfe\n"),
    _definition("same-name-twice", "with one name twice", lambda: "uint8 a\nuint8 a\nfloat64 a\n"),
    _definition("keywords", "with fields that are words of Python", lambda: "uint8 def\nuint8 __class__\nuint8 self\n"),
    _definition("service", "of a service", lambda: "uint8 a\n---\nuint8 b\n"),
    _definition("idl", "in IDL under the name of ros2msg", lambda: "module lab { struct Thing { long a; }; };"),
    _case(
        "encoding-idl",
        Danger.SHAPE,
        "IDL that nests 3,000 deep",
        lambda: bag("module a { " * 3000 + "}; " * 3000, _LAB, schema_encoding="ros2idl"),
    ),
    _case(
        "encoding-unknown",
        Danger.SHAPE,
        "unknown encodings, with escape sequences",
        lambda: bag(encoding=f"x{ESCAPE}", schema_encoding=f"y{ESCAPE}"),
    ),
    *(
        _case(
            f"array-{count}",
            Danger.LIE,
            f"an array of a message that claims {count:,} elements",
            partial(bag, "uint8[] a\nstring b\n", _LAB, "/thing", (_array(count),) * 5),
        )
        for count in (1 << 31, (1 << 32) - 1, 33)
    ),
    *(
        _case(
            f"{name}-lies",
            Danger.LIE,
            f"a {name.partition('/')[2]} whose counts claim 2^32 − 1",
            partial(bag, text, name.replace("/", "/msg/"), "/lie", (b"\0\1\0\0" + b"\xff" * 300,) * 5),
        )
        for name, text in (
            ("std_msgs/String", "string data\n"),
            ("sensor_msgs/Image", "uint8[] data\n"),
            ("sensor_msgs/PointCloud2", "uint8[] data\n"),
            ("tf2_msgs/TFMessage", "uint8[] transforms\n"),
            ("geometry_msgs/PoseArray", "uint8[] poses\n"),
            ("visualization_msgs/MarkerArray", "uint8[] markers\n"),
        )
    ),
    _case("empty-messages", Danger.SHAPE, "messages of no bytes", lambda: bag(data=(b"",) * 5)),
    _case(
        "short-messages", Danger.SHAPE, "messages that end inside the header", lambda: bag(data=(b"\0\1", b"\0\1\0\0"))
    ),
    _case(
        "big-endian",
        Danger.SHAPE,
        "messages of the other byte order",
        lambda: bag(data=(b"\0\0\0\0\0\0\0\6hello\0",) * 5),
    ),
    _case("topic-empty", Danger.SHAPE, "a topic without a name", lambda: bag(topic="")),
    _case("topic-no-utf8", Danger.SHAPE, "a topic that is invalid UTF-8", lambda: bag(topic=b"/\xff\xfe")),
    _case(
        "topic-path",
        Danger.LIE,
        "a topic that is a path out of the folder",
        lambda: bag(topic="/../../../../tmp/owned"),
    ),
    _case("topic-nul", Danger.SHAPE, "a topic with NUL", lambda: bag(topic="/a\0b")),
    _case("topic-long", Danger.TERMINAL, "a topic of 5 MB", lambda: bag(topic="/" + "x" * 5_000_000)),
    _case("type-odd", Danger.SHAPE, "an invalid type name", lambda: bag(name="String")),
    _case("type-path", Danger.LIE, "a type that is a path", lambda: bag(name="../../etc/msg/passwd")),
    _case("topic", Danger.TERMINAL, "escape sequences and a forged line in a topic", lambda: bag(topic=f"/{NAUGHTY}")),
    _case("type", Danger.TERMINAL, "the same in a type", lambda: bag(name=f"lab/msg/{NAUGHTY}")),
    _case(
        "definition",
        Danger.TERMINAL,
        "the same in a definition",
        lambda: bag(f"lab/{NAUGHTY} a\nuint{ESCAPE} b\n", _LAB),
    ),
    _case("content", Danger.TERMINAL, "the same in a message", lambda: bag(data=(samples.string_cdr(NAUGHTY),) * 3)),
    _case(
        "library",
        Danger.TERMINAL,
        "the same in the header",
        lambda: build.assemble([(build.HEADER, build.header(NAUGHTY, NAUGHTY)), *build.parse(bag())[1:]]).finish(),
    ),
    _case(
        "metadata",
        Danger.TERMINAL,
        "the same in metadata and attachments",
        lambda: bag(
            more=(
                (build.METADATA, build.metadata(NAUGHTY, {NAUGHTY: NAUGHTY})),
                (build.ATTACHMENT, build.attachment(NAUGHTY, NAUGHTY, NAUGHTY.encode())),
            )
        ),
    ),
    *(
        _case(f"qos-{number}", Danger.SHAPE, f"quality of service that is {what}", partial(bag, qos=text))
        for number, (what, text) in enumerate(
            (
                (
                    "YAML with a billion aliases",
                    "a: &a [x,x,x,x,x,x,x,x,x]\n"
                    + "".join(
                        f"{chr(98 + n)}: &{chr(98 + n)} [{','.join(['*' + chr(97 + n)] * 9)}]\n" for n in range(12)
                    ),
                ),
                ("nested 50,000 deep", "[" * 50_000),
                ("a depth of 400 digits", f"- history: 1\n  depth: {'9' * 400}\n  reliability: 1\n  durability: 1\n"),
                ("full of escape sequences", f"- {NAUGHTY}"),
            )
        )
    ),
)
