"""BIND: the table of names in all its layouts, children that no codec can read, BIND in BIND."""

from __future__ import annotations

import struct
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given

from igtl_gateway.base.buffers import join
from igtl_gateway.base.errors import MalformedBody, TruncatedMessage, WireError
from igtl_gateway.wire.bind import MAX_CHILDREN, MAX_DEPTH, Bind, BindChild
from igtl_gateway.wire.body import Raw
from igtl_gateway.wire.point import Points
from igtl_gateway.wire.registry import describe_content, read_child
from igtl_gateway.wire.text import String
from tests import strategies


def name(text: str) -> bytes:
    return text.encode().ljust(12, b"\0")


def sized(*sizes: int) -> bytes:
    return b"".join(struct.pack(">Q", size) for size in sizes)


HEADS = b"\0\2" + name("STRING") + sized(5) + name("CUSTOM") + sized(2)
STRING = b"\0\3\0\1x"
GOLDEN = HEADS + b"\0\6" + b"ab\0c\0\0" + STRING + b"\0" + b"yz"
CHILDREN = (BindChild("STRING", "ab", STRING), BindChild("CUSTOM", "c", b"yz"))


def read(data: bytes) -> Bind:
    return Bind.unpack(memoryview(data))


def test_golden_bytes() -> None:
    bind = read(GOLDEN)
    assert bind == Bind(CHILDREN)
    assert join(Bind(CHILDREN).pack()) == GOLDEN
    assert [read_child(child) for child in bind.children] == [String(b"x"), Raw(b"yz")]
    assert describe_content(bind)["children"][0] == {
        "type": "STRING",
        "name": "ab",
        "size": 5,
        "content": {"encoding": 3, "string": "x", "string_hex": "78"},
    }


@pytest.mark.parametrize(
    "data",
    [
        HEADS + b"\0\5" + b"ab\0c\0" + STRING + b"\0" + b"yz",  # no padding, an odd size
        HEADS + b"\0\4" + b"ab\0c" + STRING + b"\0" + b"yz",  # no NUL at the end either
        HEADS + b"\0\6" + b"ab\0c\0?" + STRING + b"\0" + b"yz",  # padding of heap garbage
        HEADS + b"\0\x0a" + b"ab\0c\0more\0" + STRING + b"\0" + b"yz",
        GOLDEN[:-3] + b"\xee" + b"yz",  # garbage behind a content of odd size
    ],
)
def test_odd_tables_and_pads_are_read_and_written_back(data: bytes) -> None:
    bind = read(data)
    assert [(child.name, bytes(child.content)) for child in bind.children] == [("ab", STRING), ("c", b"yz")]
    assert join(bind.pack()) == data
    assert join(replace(bind, name_table=None, pads=None).pack()) == GOLDEN


@pytest.mark.parametrize("pads", [b"\0\0", b"\0", b"\0\7", b"\1"])
def test_the_last_pad_may_be_missing(pads: bytes) -> None:
    child = name("CUSTOM") + sized(1)
    data = b"\0\2" + child * 2 + b"\0\2\0\0" + b"x" + pads[:1] + b"y" + pads[1:]
    bind = read(data)
    assert [bytes(one.content) for one in bind.children] == [b"x", b"y"]
    assert join(bind.pack()) == data
    assert (bind.pads is None) is (pads == b"\0\0")


def test_no_children() -> None:
    assert join(Bind(()).pack()) == bytes(4)
    assert read(bytes(4)) == Bind(())


def test_every_truncation() -> None:
    for size in {*range(len(GOLDEN))} - {4}:  # any 4 bytes are what the C++ library sends without children
        with pytest.raises(TruncatedMessage):
            read(GOLDEN[:size])
    with pytest.raises(MalformedBody, match="by its own sizes"):
        read(GOLDEN + b"\0")


@pytest.mark.parametrize(
    "data",
    [
        b"\xff\xff" + GOLDEN[2:],  # 65,535 children
        b"\0\1" + name("CUSTOM") + sized(2**64 - 1) + b"\0\2a\0",
        HEADS + b"\xff\xff" + b"ab\0c\0",
        HEADS + b"\0\2" + b"a\0" + STRING + b"\0" + b"yz",  # one name for two
        HEADS + b"\0\0" + STRING + b"\0" + b"yz",
        HEADS[:-8] + sized(3) + GOLDEN[len(HEADS) :],
        HEADS[:-8] + sized(1) + GOLDEN[len(HEADS) :] + b"\0",
    ],
)
def test_lies(data: bytes) -> None:
    with pytest.raises(WireError):
        read(data)


@pytest.mark.parametrize(
    "child",
    [
        BindChild("T" * 13, "", b""),
        BindChild("CUSTOM", "a\0b", b""),
        BindChild("CUSTOM", "n" * 65_535, b""),
        BindChild("BIND", "", b"\xff\xff"),
    ],
)
def test_what_does_not_fit(child: BindChild) -> None:
    with pytest.raises(WireError):
        Bind((child,)).pack()


def empty(count: int) -> bytes:
    """A BIND of nameless empty children, as no real program writes it."""
    return struct.pack(">H", count) + (name("CUSTOM") + sized(0)) * count + struct.pack(">H", count) + bytes(count)


def test_too_many_children() -> None:
    assert len(read(empty(MAX_CHILDREN)).children) == MAX_CHILDREN
    with pytest.raises(MalformedBody, match="children"):
        read(empty(MAX_CHILDREN + 1))
    with pytest.raises(MalformedBody, match="children"):
        Bind((BindChild("CUSTOM", "", b""),) * (MAX_CHILDREN + 1)).pack()


def test_children_are_counted_on_all_levels() -> None:
    """Else 16 MB of small ones inside others would be half a minute of work."""
    half = BindChild("BIND", "", empty(MAX_CHILDREN // 2 - 1))
    whole = Bind((half, half))
    assert read(join(whole.pack())) == whole
    more = replace(half, content=empty(MAX_CHILDREN // 2))
    with pytest.raises(MalformedBody, match="on all levels"):
        Bind((half, more)).pack()
    data = struct.pack(">H", 2) + b"".join(name("BIND") + sized(len(child.content)) for child in (half, more))
    with pytest.raises(MalformedBody, match="on all levels"):
        read(data + b"\0\2\0\0" + bytes(half.content) + b"\0" * (len(half.content) % 2) + bytes(more.content))


def nested(depth: int) -> Bind:
    bind = Bind((BindChild("CUSTOM", "", b"x"),))
    for _ in range(depth - 1):
        bind = Bind((BindChild("BIND", "", join(bind.pack())),))
    return bind


def test_nesting_ends() -> None:
    data = join(nested(MAX_DEPTH).pack())
    assert join(read(data).pack()) == data
    deeper = b"\0\1" + name("BIND") + sized(len(data)) + b"\0\2\0\0" + data
    with pytest.raises(MalformedBody, match="levels"):
        read(deeper)
    with pytest.raises(MalformedBody, match="levels"):
        Bind((BindChild("BIND", "", data),)).pack()
    shown = describe_content(read(data))
    for _ in range(MAX_DEPTH - 1):
        shown = shown["children"][0]["content"]
    assert shown["children"][0]["content"]["raw_hex"] == "78"


def test_a_child_that_nobody_can_read() -> None:
    """It costs its siblings nothing."""
    bind = read(join(Bind((BindChild("IMAGE", "broken", b"??"), *CHILDREN)).pack()))
    with pytest.raises(TruncatedMessage):
        read_child(bind.children[0])
    broken, whole, _ = describe_content(bind)["children"]
    assert broken["error"]["code"] == "truncated"
    assert "content" not in broken
    assert whole["content"]["string"] == "x"


def test_empty_children_are_as_empty_messages() -> None:
    bind = read(join(Bind((BindChild("IMAGE", "none", b""), BindChild("POINT", "", b""))).pack()))
    image, points = (read_child(child) for child in bind.children)
    assert image == Raw(b"")
    assert isinstance(points, Points)


def test_children_are_views() -> None:
    received = np.frombuffer(GOLDEN, np.uint8)
    bind = read(GOLDEN)
    for child in bind.children:
        assert np.shares_memory(np.frombuffer(child.content, np.uint8), received)
    assert sum(np.shares_memory(np.frombuffer(part, np.uint8), received) for part in bind.pack()) == len(CHILDREN)


#: Garbage under the name BIND is refused with the whole; under every other name it has no effect on the other children.
CONTENTS = {kind: contents for kind, contents in strategies.bodies().items() if kind != "BIND"}


@given(strategies.binds(CONTENTS))
def test_decoded_children_are_encoded_to_the_same_bytes(bind: Bind) -> None:
    for child in read(join(bind.pack())).children:
        try:
            body = read_child(child)
        except WireError:
            continue
        assert join(body.pack()) == child.content


def test_a_bind_without_children_of_the_cpp_library_has_none() -> None:
    """It reserves 4 bytes, and writes nothing into them."""
    for data in (bytes(4), b"\xa5" * 4):
        bind = Bind.unpack(memoryview(data))
        assert bind.children == () and join(bind.pack()) == data
