"""Other stamps in the bytes of a message: the tick word, and the ROS stamp in the metadata with the CRC."""

from __future__ import annotations

from igtl_gateway.base.buffers import join
from igtl_gateway.base.stamp import NS_PER_S, ns_to_ticks
from igtl_gateway.gateway.metadata import STAMP
from igtl_gateway.gateway.stamps import moved, restamped
from igtl_gateway.wire import Item, Message, decode, encode
from igtl_gateway.wire.text import String
from tests.script import T0_NS

HOUR_NS = 3_600 * NS_PER_S
WORDS = String.of("hello")


def bytes_of(stamp_ns: int, *items: Item) -> bytes:
    ticks = ns_to_ticks(stamp_ns) if stamp_ns else 0
    return join(encode(Message("STRING", "A", WORDS, ticks, 2 if items else 1, 0, items)))


def test_the_header_moves_and_nothing_else() -> None:
    assert moved(bytes_of(T0_NS), HOUR_NS) == bytes_of(T0_NS + HOUR_NS)


def test_an_unset_stamp_stays_unset_and_none_becomes_unset() -> None:
    assert moved(bytes_of(0), HOUR_NS) == bytes_of(0)
    assert decode(moved(bytes_of(NS_PER_S), -HOUR_NS)).ticks == ns_to_ticks(1)
    assert moved(bytes_of(T0_NS, Item.of(STAMP, "5")), -HOUR_NS) == bytes_of(T0_NS - HOUR_NS, Item.of(STAMP, "1"))


def test_the_stamp_in_the_metadata_moves_along_with_a_right_crc() -> None:
    users = Item.of("key", "value")
    data = moved(bytes_of(T0_NS, users, Item.of(STAMP, str(T0_NS + 7))), HOUR_NS)
    assert decode(data) == decode(bytes_of(T0_NS + HOUR_NS, users, Item.of(STAMP, str(T0_NS + 7 + HOUR_NS))))


def test_an_item_that_is_no_stamp_of_ours_stays() -> None:
    for text in ("yesterday", "१२३", "-5"):
        item = Item.of(STAMP, text)
        assert moved(bytes_of(T0_NS, item), HOUR_NS) == bytes_of(T0_NS + HOUR_NS, item)


def test_the_key_as_content_is_content() -> None:
    data = join(encode(Message("STRING", "A", String.of(STAMP), ns_to_ticks(T0_NS))))
    assert decode(moved(data, HOUR_NS)).content == String.of(STAMP)


def test_of_a_damaged_message_only_the_header_moves() -> None:
    whole = bytes_of(T0_NS, Item.of(STAMP, str(T0_NS)))
    damaged = whole[:-1] + bytes([whole[-1] ^ 1])
    data = moved(damaged, HOUR_NS)
    assert data[34:42] == bytes_of(T0_NS + HOUR_NS)[34:42]
    assert (data[:34], data[42:]) == (damaged[:34], damaged[42:])


def test_what_is_shorter_than_a_header_stays_as_it_is() -> None:
    assert restamped(b"short", lambda _: T0_NS) == b"short"
