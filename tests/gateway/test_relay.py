"""The core of the relay: bytes to the partner, and nothing else."""

from __future__ import annotations

import pytest

from igtl_gateway.buffers import join
from igtl_gateway.config import Config
from igtl_gateway.gateway import LINK_DOWN, LINK_UP, PARTNER, Gateway, RelayGateway, Session, gateway_of
from igtl_gateway.replay.verify import verify
from igtl_gateway.session.entry import Entry, Kind
from igtl_gateway.session.note import Level, Note
from igtl_gateway.wire import Message, encode
from igtl_gateway.wire.text import String
from tests.script import T0_NS

CONFIG = Config(relay=True)
HELLO = join(encode(Message("STRING", "Greeting", String.of("hello"), 7 << 32)))


class Relay:
    """A session of the relay; ``log`` is its recording."""

    def __init__(self, config: Config = CONFIG) -> None:
        self.gateway = RelayGateway(config)
        self.session = Session(self.gateway)
        self.log: list[Entry] = []

    def feed(self, kind: Kind, payload: bytes, link: int) -> list[Entry]:
        entries = self.session.input(T0_NS, kind, (payload,), links=(link,))
        self.log += entries
        return entries[1:]

    def up(self, link: int, **facts: int) -> list[Entry]:
        return self.feed(Kind.LINK, Note(Level.INFO, LINK_UP, "up", data=facts).pack(), link)

    def down(self, link: int) -> list[Entry]:
        return self.feed(Kind.LINK, Note(Level.INFO, LINK_DOWN, "down").pack(), link)

    def pair(self, client: int, server: int) -> None:
        assert self.up(client) == []
        assert self.up(server, **{PARTNER: client}) == []

    def igtl(self, data: bytes, link: int) -> list[Entry]:
        return self.feed(Kind.IGTL_IN, data, link)


def codes(entries: list[Entry]) -> list[str]:
    return [Note.unpack(entry.data()).code for entry in entries if entry.kind is Kind.NOTE]


def test_the_configuration_chooses_the_core() -> None:
    assert isinstance(gateway_of(Config()), Gateway)
    assert isinstance(gateway_of(CONFIG), RelayGateway)
    assert Config.from_dict(CONFIG.to_dict()).relay


def test_a_message_goes_to_the_partner_and_to_nobody_else() -> None:
    relay = Relay()
    relay.pair(1, 2)
    relay.pair(3, 4)
    for link, partner in ((1, 2), (2, 1), (3, 4), (4, 3)):
        (sent,) = relay.igtl(HELLO, link)
        assert (sent.kind, sent.links, sent.data()) == (Kind.IGTL_OUT, (partner,), HELLO)
        assert (sent.channel, sent.type, sent.source_ns) == ("STRING/Greeting", "STRING", 7_000_000_000)
        assert relay.gateway.keep(sent)
    assert relay.gateway.ledger.to_dict() == {
        "igtl_in": {"STRING/Greeting": {"received": 4, "relayed": 4}},
        "igtl_out": {"STRING/Greeting": {"sent": 4}},
    }


@pytest.mark.parametrize(
    ("data", "told"),
    [
        (HELLO[:50] + bytes(8) + HELLO[58:], ["bad_crc"]),
        (b"\0\7" + HELLO[2:], ["malformed"]),
        (HELLO[:2] + b"MYSTERY\0" + HELLO[10:], []),
    ],
    ids=["corrupt CRC", "header version 7", "unknown type"],
)
def test_what_is_broken_or_unknown_passes_unchanged_and_is_told_once(data: bytes, told: list[str]) -> None:
    relay = Relay()
    relay.pair(1, 2)
    first, again = relay.igtl(data, 1), relay.igtl(data, 1)
    assert (first[0].data(), again[0].data()) == (data, data)
    assert codes(first) == told
    assert codes(again) == []


def test_crc_is_not_computed_where_it_is_not_wanted() -> None:
    relay = Relay(Config(relay=True, check_crc=False))
    relay.pair(1, 2)
    assert [entry.kind for entry in relay.igtl(HELLO[:50] + bytes(8) + HELLO[58:], 1)] == [Kind.IGTL_OUT]


def test_without_a_partner_a_message_is_a_loss_that_is_told() -> None:
    relay = Relay()
    relay.pair(1, 2)
    relay.down(1)
    assert codes(relay.igtl(HELLO, 2)) == ["no_partner"]
    assert relay.igtl(HELLO, 2) == []
    assert relay.gateway.ledger.to_dict()["igtl_in"]["STRING/Greeting"]["dropped"] == {"no_partner": 2}
    relay.down(2)
    relay.pair(3, 4)
    assert [entry.links for entry in relay.igtl(HELLO, 4)] == [(3,)]


def test_a_session_of_the_relay_verifies_and_a_changed_byte_is_found() -> None:
    relay = Relay()
    relay.pair(1, 2)
    relay.igtl(HELLO, 1)
    relay.igtl(HELLO[:50] + bytes(8) + HELLO[58:], 2)
    report = verify(relay.log, CONFIG)
    assert report.good
    assert report.outputs == report.equal == 3
    bad = [
        Entry(e.seq, e.stamp_ns, e.kind, e.channel, e.type, (b"\0\2" + e.data()[2:],), e.links, e.source_ns)
        if e.kind is Kind.IGTL_OUT
        else e
        for e in relay.log
    ]
    assert verify(bad, CONFIG).differing == 2


def test_the_relay_has_no_other_side() -> None:
    gateway = RelayGateway(CONFIG)
    assert gateway.subscription("/igtl/out/A", "std_msgs/msg/String") is None
    assert gateway.qos("/igtl/in/A/string") is None
    assert not gateway.lacks_conversion("/igtl/out/A", "std_msgs/msg/String")
    assert gateway.due_ns is None
