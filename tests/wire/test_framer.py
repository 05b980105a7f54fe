from __future__ import annotations

import struct

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from igtl_gateway.base.errors import MessageTooLarge
from igtl_gateway.base.quantities import counted
from igtl_gateway.wire.framer import Framer
from igtl_gateway.wire.header import DEFAULT_MAX_BODY, HEADER_SIZE
from tests.tables import table

CHUNK = 64 * 2**10
EAGER = 16 * 2**20


def header(body_size: int, name: bytes = b"STRING") -> bytes:
    return struct.pack(">H12s20sQQQ", 1, name, b"device", 0, body_size, 0)


def message(body_size: int, fill: int = 7) -> bytes:
    return header(body_size) + bytes([fill % 256]) * body_size


def in_pieces(framer: Framer, data: bytes, sizes: list[int]) -> list[bytes]:
    """Feed ``data`` as a socket would: pieces of the given sizes, repeated, straight into the buffer."""
    messages, at, turn = [], 0, 0
    while at < len(data):
        room = framer.buffer()
        assert len(room) > 0
        count = min(sizes[turn % len(sizes)], len(room), len(data) - at)
        room[:count] = data[at : at + count]
        messages += framer.received(count)
        at, turn = at + count, turn + 1
    return [bytes(one) for one in messages]


# Around every place where the framer changes its ways: empty, one byte, a full chunk, own storage, growing storage.
SIZES = [0, 1, 48, CHUNK - HEADER_SIZE - 1, CHUNK - HEADER_SIZE, CHUNK - HEADER_SIZE + 1, CHUNK, 3 * CHUNK]
LARGE = [EAGER - HEADER_SIZE - 1, EAGER - HEADER_SIZE, EAGER - HEADER_SIZE + 1, 2 * EAGER + 5, 4 * EAGER]


@table("size", SIZES + LARGE)
def test_whole(size: int) -> None:
    framer = Framer()
    (only,) = framer.feed(message(size))
    assert bytes(only) == message(size)
    assert framer.pending == 0


@table("size", SIZES)
def test_byte_by_byte(size: int) -> None:
    sent = [message(size, 1), message(0), message(48, 2)]
    framer = Framer()
    assert in_pieces(framer, b"".join(sent), [1]) == sent
    assert framer.pending == 0


@table("size", SIZES)
@table("piece", [57, 58, 59, CHUNK - 1, CHUNK + 1])
def test_pieces_around_the_boundaries_and_trailing_data(size: int, piece: int) -> None:
    trailing = HEADER_SIZE + 19
    sent = [message(48, 1), message(size, 2), message(size, 3), message(48, 4)]
    framer = Framer()
    assert in_pieces(framer, b"".join(sent) + message(100)[:trailing], [piece]) == sent
    assert framer.pending == trailing
    assert framer.pending_head() == header(100)


@pytest.mark.parametrize("size", LARGE)
def test_storage_that_grows(size: int) -> None:
    sent = [message(48, 1), message(size, 2), message(48, 3)]
    assert in_pieces(Framer(), b"".join(sent), [HEADER_SIZE + 49, CHUNK, 2**20]) == sent


@settings(deadline=None, max_examples=60)
@given(
    st.lists(st.one_of(st.integers(0, 300), st.sampled_from(SIZES)), max_size=12),
    st.lists(st.integers(1, 2 * CHUNK), min_size=1, max_size=8),
    st.integers(0, 157),
)
def test_random_pieces(sizes: list[int], pieces: list[int], trailing: int) -> None:
    sent = [message(size, number) for number, size in enumerate(sizes)]
    framer = Framer()
    assert in_pieces(framer, b"".join(sent) + message(100)[:trailing], pieces) == sent
    assert framer.pending == trailing
    assert framer.pending_head() == header(100)[:trailing]


def test_many_small_messages_at_one_reception() -> None:
    sent = [message(48, number) for number in range(600)]
    framer = Framer()
    data = b"".join(sent)
    framer.buffer()[: len(data)] = data
    assert framer.received(len(data)) == sent


@pytest.mark.parametrize("size", [48, CHUNK, EAGER + 1])
def test_a_message_is_never_written_to_again(size: int) -> None:
    framer = Framer()
    first = [memoryview(one) for one in framer.feed(message(size, 1))]
    framer.feed(message(size, 2) * 3)
    assert bytes(first[0]) == message(size, 1)
    assert first[0].readonly


def test_the_body_of_a_large_message_is_received_in_place() -> None:
    framer = Framer()
    framer.feed(header(10 * CHUNK))
    room = framer.buffer()
    assert len(room) == 10 * CHUNK
    room[5] = 99
    (only,) = framer.received(len(room))
    room[6] = 98
    assert (only[HEADER_SIZE + 5], only[HEADER_SIZE + 6]) == (99, 98)


def test_nothing_much_is_reserved_for_what_is_only_announced() -> None:
    framer = Framer()
    framer.feed(header(DEFAULT_MAX_BODY))
    assert len(framer.buffer()) < EAGER
    assert framer.pending == HEADER_SIZE


@table("size", [1001, 2**62, 2**63, 2**64 - 1])
@table("piece", [1, 58, 1000])
def test_too_large(size: int, piece: int) -> None:
    framer = Framer(max_body=1000)
    assert in_pieces(framer, message(1000), [piece]) == [message(1000)]
    with pytest.raises(MessageTooLarge) as caught:
        in_pieces(framer, header(size) + b"more", [piece])
    assert caught.value.found == counted(size, "byte")
    assert framer.pending_head() == header(size)
    for call in (framer.buffer, lambda: framer.received(0), lambda: framer.feed(message(0))):
        with pytest.raises(MessageTooLarge):
            call()


def test_what_came_whole_before_a_too_large_header_is_returned_first() -> None:
    data = message(3) + message(4) + header(2**62)
    framer = Framer()
    framer.buffer()[: len(data)] = data
    assert framer.received(len(data)) == [message(3), message(4)]
    with pytest.raises(MessageTooLarge):
        framer.buffer()

    by_feed = Framer()
    assert by_feed.feed(data + bytes(2 * CHUNK)) == [message(3), message(4)]
    with pytest.raises(MessageTooLarge):
        by_feed.feed(b"x")


@pytest.mark.parametrize("count", [-1, CHUNK + 1])
def test_impossible_count(count: int) -> None:
    with pytest.raises(ValueError, match="bytes received"):
        Framer().received(count)


def test_version_and_type_are_not_judged() -> None:
    odd = b"\xff" * 42 + struct.pack(">QQ", 2, 0) + b"ab"
    assert Framer().feed(odd) == [odd]


def test_the_longest_body_may_depend_on_the_type() -> None:
    rows = (("STRING", 100), ("GET_*", 10), ("IMAGE", 10_000))
    for name, limit in ((b"STRING", 100), (b"GET_TRANS", 10), (b"IMAGE", 10_000), (b"OTHER", 1_000), (b"", 1_000)):
        framer = Framer(1_000, rows)
        assert framer.feed(header(limit, name) + bytes(limit)) == [header(limit, name) + bytes(limit)]
        for _ in range(2):
            with pytest.raises(
                MessageTooLarge, match=f"found {counted(limit + 1, 'byte')}, expected at most {counted(limit, 'byte')}"
            ):
                framer.feed(header(limit + 1, name))
