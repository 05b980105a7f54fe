"""Raw OpenIGTLink bytes of one direction."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path

import pytest

from igtl_gateway.addons.exchange.capture import Capture
from igtl_gateway.addons.exchange.sequence import DEFAULT_EPOCH_NS
from igtl_gateway.addons.exchange.source import ImportedItem
from igtl_gateway.base.buffers import join
from igtl_gateway.base.errors import DamagedRecording, UnsupportedRecording
from igtl_gateway.base.stamp import NS_PER_S, ns_to_ticks
from igtl_gateway.gateway.log.entry import Kind
from igtl_gateway.gateway.log.note import Note
from igtl_gateway.wire import Message, encode
from igtl_gateway.wire.text import String
from tests.files import CAPTURES


def message(text: str, stamp_ns: int = 0) -> bytes:
    return join(encode(Message("STRING", "Said", String.of(text), ns_to_ticks(stamp_ns))))


def read(path: Path) -> tuple[list[ImportedItem], Capture]:
    with closing(Capture(path)) as source:
        return list(source.items()), source


def test_messages_are_where_their_stamps_say_else_a_millisecond_apart(tmp_path: Path) -> None:
    path = tmp_path / "some.s2c.igtl"
    sent = [message("a"), message("b"), message("c", 10**18 + 5), message("d", 10**18 + 3), message("e")]
    path.write_bytes(b"".join(sent))
    items, source = read(path)
    said = [item for item in items if item.kind is Kind.IGTL_IN]
    assert [bytes(item.payload) for item in said] == sent
    assert [item.time_ns for item in said] == [
        DEFAULT_EPOCH_NS,
        DEFAULT_EPOCH_NS + 1_000_000,
        10**18 + 5,
        10**18 + 1_000_005,
        10**18 + 2_000_005,
    ]
    assert [item.source_ns % NS_PER_S for item in said] == [0, 0, 5, 3, 0]
    assert {(item.channel, item.links) for item in said} == {("STRING/Said", (1,))}
    assert [(row.unit, row.declared, row.taken) for row in source.rows] == [
        ("bytes", path.stat().st_size, path.stat().st_size),
        ("messages", 5, 5),
    ]


@pytest.mark.parametrize(("name", "role"), [("some.s2c.igtl", "client"), ("some.c2s.igtl", "server")])
def test_the_name_tells_who_sent_it(tmp_path: Path, name: str, role: str) -> None:
    (tmp_path / name).write_bytes(message("a"))
    items, _ = read(tmp_path / name)
    assert [item.kind for item in items] == [Kind.LINK, Kind.IGTL_IN, Kind.LINK]
    assert Note.unpack(bytes(items[0].payload)).data["role"] == role


def test_damaged_messages_are_taken_as_they_are(tmp_path: Path) -> None:
    bad = bytearray(message("a"))
    bad[-1] ^= 1
    (tmp_path / "some.igtl").write_bytes(bytes(bad) + message("b"))
    items, _ = read(tmp_path / "some.igtl")
    assert bytes(items[1].payload) == bad


def test_an_end_inside_a_message_is_missing_in_the_account(tmp_path: Path) -> None:
    (tmp_path / "some.igtl").write_bytes(message("a") + message("b")[:-3])
    items, source = read(tmp_path / "some.igtl")
    assert len(items) == 3
    assert not source.rows[0].good
    assert source.rows[0].why == f"ends inside a message, after {len(message('b')) - 3} bytes of it"


def test_a_size_that_cannot_be_ends_it(tmp_path: Path) -> None:
    bad = bytearray(message("b"))
    bad[42] = 0xFF
    (tmp_path / "some.igtl").write_bytes(message("a") + bytes(bad) + message("c"))
    with closing(Capture(tmp_path / "some.igtl")) as source:
        with pytest.raises(DamagedRecording, match="body size"):
            list(source.items())
        assert source.rows[0].taken == len(message("a"))


def test_other_bytes_are_refused(tmp_path: Path) -> None:
    (tmp_path / "some.igtl").write_bytes(b"GET / HTTP/1.1\r\n" * 10)
    with pytest.raises(UnsupportedRecording, match="expected the header"):
        Capture(tmp_path / "some.igtl")


def test_real_captures_come_whole() -> None:
    files = sorted(CAPTURES.glob("*.igtl"))
    assert files
    for path in files:
        items, source = read(path)
        assert b"".join(bytes(item.payload) for item in items if item.kind is Kind.IGTL_IN) == path.read_bytes()
        assert all(row.good for row in source.rows)
