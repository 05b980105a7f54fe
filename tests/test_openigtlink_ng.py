"""The judge of openigtlink-ng: the words that it compares, what explains a difference, and what it reads of C++."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from random import Random
from typing import Any

import pytest

from igtl_gateway.base.buffers import join
from igtl_gateway.wire import Item, Message, decode, encode
from igtl_gateway.wire.body import Body, Raw
from igtl_gateway.wire.capability import Capability
from igtl_gateway.wire.image import Image
from igtl_gateway.wire.query import EmptyQuery, GetBind, QueryReply, StartBind, StartPolyData, StartVideo
from igtl_gateway.wire.registry import BODIES
from igtl_gateway.wire.text import Status, String
from igtl_gateway.wire.transform import Transform
from igtl_gateway.wire.video import Video
from tests.places import ROOT
from tests.tables import all_hold, table
from tools.judges.ng_deviations import DEVIATIONS, LACKED, Case, content_of, explained
from tools.judges.ng_values import OURS, random_words, words_of
from tools.judges.openigtlink_ng import cpp_headers, seven_bits, with_signals
from tools.judges.programs.ng_words import read, written

FIELDS: list[dict[str, Any]] = [
    {"name": "count", "type": "uint8"},
    {"name": "offset", "type": "int64"},
    {"name": "name", "type": "fixed_string", "size_bytes": 20},
    {"name": "data", "type": "length_prefixed_string", "encoding": "binary"},
    {"name": "size", "type": "array", "element_type": "uint16", "count": 3},
    {"name": "ratio", "type": "float32"},
    {"name": "matrix", "type": "array", "element_type": "float32", "count": 12},
    {"name": "colour", "type": "array", "element_type": "uint8", "count": 4},
    {"name": "types", "type": "array", "element_type": {"type": "fixed_string", "size_bytes": 12}, "count": "count"},
    {
        "name": "tools",
        "type": "array",
        "element_type": {"type": "struct", "fields": [{"name": "x", "type": "float64"}]},
        "count_from": "remaining",
    },
]


def test_values_become_words_and_values_again() -> None:
    for number in range(50):
        _, _, _, _, _, _, *words = random_words(Random(number), "ANY", FIELDS, is_new=False).split(" ")
        assert list(written(FIELDS, read(FIELDS, iter(words)))) == words
    with pytest.raises(StopIteration):
        read(FIELDS, iter(words[:-1]))


def test_every_content_has_words() -> None:
    assert OURS.keys() == {*BODIES.values(), Raw}
    message = Message("TRANSFORM", "Tool", Transform((math.nan, *[0.5] * 11)), 7, 2, 9, (Item("k", b"v", 3),))
    there = "i2 x5452414e53464f524d x546f6f6c i7 i9 n1 x6b i3 x76 F7ff8000000000000" + "3fe0000000000000" * 11
    assert words_of(message) == there
    assert decode(join(encode(with_signals(message)))).content.pack()[0][:4] == b"\x7f\x80\0\1"
    assert seven_bits(Message("STRING", "Dé", String(b"\xff"))) == Message("STRING", "DCi", String(b"\xff"))


def case(content: Body, kind: str = "STATUS", codec: str = "Python", *, is_ours: bool = True, ticks: int = 5) -> Case:
    data = join(encode(Message(kind, "Tool", content, ticks)))
    words = words_of(decode(data))
    return Case(codec, is_ours, kind, data, words, words, data)


TRANSFORM = Transform((2.0,) * 12)
REFUSED = "body must be 1 bytes"
IMAGE = join(encode(Message("IMAGE", "", Image((1, 1, 1), 3, b"x"))))
HOST = IMAGE[:62] + b"\3" + IMAGE[63:]
CODEC = case(Video("H26", (1, 1, 1), b"x"), "VIDEO")
OPEN = case(Status(1, 2, "n", "text", nul_terminated=False))
ENDED = join(encode(Message("STATUS", "Tool", Status(1, 2, "n", "text"), 5)))
CUT = join(encode(Message("STATUS", "Tool", Status(1, 2, "n", "tex"), 5)))
REPLY = case(Raw(b"\1"), "RTS_STRING", is_ours=False)
LONG = case(Status(1, 2, "n\0m", "text"))
KEYS = Message("STATUS", "Tool", Status(1), 5, 2, 1, (Item("\udcff", b"", 3),))
QUIET = case(Transform((math.nan, *[0.0] * 11)), "TRANSFORM")
SIGNALS = QUIET.data[:58] + b"\x7f\xa0\0\0" + QUIET.data[62:]

#: A case of each deviation, by a word of its text.
CASES = {
    "without a schema": replace(case(Capability(("IMAGE",)), "CAPABIL"), error="no class for CAPABIL"),
    "not ASCII: refused": replace(case(Status(1, 0, "é")), error="non-ASCII byte"),
    "without content": replace(case(QueryReply(has_body=False), "RTS_IMAGE"), error=REFUSED),
    "interval only": replace(case(StartBind(7), "STT_BIND"), error="ncmessages: short buffer"),
    "STT_VIDEO: refused": replace(case(StartPolyData(7), "STT_POLYDATA"), error=REFUSED),
    "STT_VIDEO: dropped": replace(
        case(EmptyQuery(b"x"), "GET_IMAGE"),
        read=case(EmptyQuery(), "GET_IMAGE").words,
        again=case(EmptyQuery(), "GET_IMAGE").data,
    ),
    "byte order 3": Case(
        "C++", False, "IMAGE", HOST, words_of(decode(IMAGE)), error="here: IMAGE content, offset 4, endian: found 3"
    ),
    "key of metadata": Case(
        "Python",
        True,
        "STATUS",
        join(encode(KEYS)),
        words_of(KEYS),
        words_of(KEYS).replace("xff", "xefbfbd"),
        join(encode(KEYS)),
    ),
    "fewer than four": replace(CODEC, read=CODEC.words.replace("x483236", "x48323600")),
    "RTS_STRING": replace(REPLY, words=REPLY.words[:-3] + "i1"),
    "unsigned": replace(case(QueryReply(200), "RTS_IMAGE"), read=case(QueryReply(0), "RTS_IMAGE").words[:-2] + "i-56"),
    "final NUL": replace(OPEN, codec="TypeScript", read=OPEN.words[:-2], again=CUT),
    "stamp 0": replace(case(TRANSFORM, "TRANSFORM", "C++", ticks=0), again=case(TRANSFORM, "TRANSFORM").data),
    "behind the NUL": replace(LONG, again=case(Status(1, 2, "n", "text")).data),
    "signalling": replace(QUIET, data=SIGNALS, again=SIGNALS[:59] + b"\xe0" + SIGNALS[60:]),
}


def test_each_deviation_explains_its_case() -> None:
    assert len(CASES) == len(DEVIATIONS)
    for word, one in CASES.items():
        what = explained(one)
        assert what is not None and word in what, (word, what)


def test_nothing_else_is_explained() -> None:
    for word, one in CASES.items():
        if one.error:
            assert explained(replace(one, error="another error")) is None, word
            assert explained(replace(one, type="TRANSFORM", data=case(TRANSFORM, "TRANSFORM").data)) is None, word
        else:
            assert explained(replace(one, read=one.read + " i1")) is None, word
            assert explained(replace(one, again=one.again + b"?")) is None, word
    assert explained(replace(OPEN, again=ENDED)) is not None
    assert explained(replace(OPEN, again=CUT)) is None  # one letter less is for TypeScript only
    assert explained(replace(OPEN, codec="TypeScript", read=OPEN.words[:-2], again=OPEN.data)) is None


@table("kind", [GetBind((("IMAGE", "CT"),)), StartVideo("H264", 4, b"\0")])
def test_the_content_of_either_version(kind: Body) -> None:
    name = "GET_BIND" if isinstance(kind, GetBind) else "STT_VIDEO"
    for version in (1, 2):
        data = join(encode(Message(name, "", kind, 0, version, 0, (Item("k", b"v", 3),) * (version - 1))))
        assert content_of(data) == join(kind.pack())


HEADER = """
struct Tdata {
    static constexpr const char* kTypeId = "TDATA";

    struct Tool {
        std::string name;
        std::array<float, 12> transform{};
    };

    std::uint8_t count{};
    std::vector<Tool> tools;

    std::vector<std::uint8_t> pack() const;
    static Tdata unpack(const std::uint8_t* data, std::size_t length);
};
"""


def test_the_fields_of_a_structure_in_cpp(tmp_path: Path) -> None:
    folder = tmp_path / "include/oigtl/messages"
    folder.mkdir(parents=True)
    (folder / "tdata.hpp").write_text(HEADER, "utf-8")
    (folder / "register_all.hpp").write_text("void register_all();\n", "utf-8")
    text = cpp_headers(tmp_path)
    assert "(V& visit, oigtl::messages::Tdata& m) { (void)visit; (void)m; visit(m.count); visit(m.tools); }" in text
    assert "oigtl::messages::Tdata::Tool& m) { (void)visit; (void)m; visit(m.name); visit(m.transform); }" in text
    assert "#define MESSAGES(each) each(Tdata)\n" in text and "register_all" not in text


def test_what_all_of_its_codecs_write_alike_is_read_here() -> None:
    lines = [json.loads(line) for line in (ROOT / "tests/data/openigtlink-ng.jsonl").read_text("utf-8").splitlines()]
    assert {decode(bytes.fromhex(line["message"])).type for line in lines} == BODIES.keys() - LACKED

    def check(line: dict[str, str]) -> None:
        data = bytes.fromhex(line["message"])
        message = decode(data)
        assert words_of(message) == line["words"]
        assert join(encode(message)) == data

    all_hold({line["message"][4:28]: line for line in lines}, check)
