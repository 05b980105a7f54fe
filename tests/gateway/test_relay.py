"""The core of the relay: bytes to the partner, and nothing else."""

from __future__ import annotations

import pytest

from igtl_gateway.base.buffers import join
from igtl_gateway.base.errors import ConfigError
from igtl_gateway.config.configuration import Config
from igtl_gateway.gateway import (
    CUT,
    FAULT,
    LINK_DOWN,
    LINK_UP,
    PARTNER,
    TICK,
    Gateway,
    RelayGateway,
    Session,
    make_core,
)
from igtl_gateway.gateway.log.clocksteps import CLOCK_STEP, ClockStep
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.note import Level, Note
from igtl_gateway.replay.verify import verify
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
    assert isinstance(make_core(Config()), Gateway)
    assert isinstance(make_core(CONFIG), RelayGateway)
    assert Config.from_dict(CONFIG.to_dict()).relay


def test_a_message_goes_to_the_partner_and_to_nobody_else() -> None:
    relay = Relay()
    relay.pair(1, 2)
    relay.pair(3, 4)
    for link, partner in ((1, 2), (2, 1), (3, 4), (4, 3)):
        (sent,) = relay.igtl(HELLO, link)
        assert (sent.kind, sent.links, sent.data()) == (Kind.IGTL_OUT, (partner,), HELLO)
        assert (sent.channel, sent.type, sent.source_ns) == ("STRING/Greeting", "STRING", 7_000_000_000)
        assert relay.gateway.must_keep(sent)
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


# -- with faults ----------------------------------------------------------------------------------------------


class FaultyRelay(Relay):
    """Its time is the test's."""

    def __init__(self, faults: str, seed: int = 1) -> None:
        super().__init__(Config(relay=True, faults=faults, fault_seed=seed))
        self.now_ns = T0_NS
        self.pair(1, 2)

    def feed(self, kind: Kind, payload: bytes, link: int) -> list[Entry]:
        entries = self.session.input(self.now_ns, kind, (payload,), links=(link,) if link else ())
        self.log += entries
        return entries[1:]

    def tick(self) -> list[Entry]:
        """At the moment that it waits for."""
        assert self.gateway.due_ns
        self.now_ns = self.gateway.due_ns
        return self.feed(Kind.EDGE_NOTE, Note(Level.INFO, TICK, "a deadline has come").pack(), 0)

    def verified(self) -> bool:
        return verify(self.log, self.gateway.config).good

    def fates(self) -> object:
        return self.gateway.ledger.to_dict()["igtl_in"]["STRING/Greeting"]


def test_a_delayed_message_leaves_with_the_tick_that_it_is_due_at() -> None:
    relay = FaultyRelay("delay=50ms")
    assert relay.igtl(HELLO, 1) == []
    relay.now_ns += 10_000_000
    assert relay.igtl(HELLO, 2) == []
    (to_server,) = relay.tick()
    assert (to_server.kind, to_server.links, to_server.data()) == (Kind.IGTL_OUT, (2,), HELLO)
    assert to_server.stamp_ns == T0_NS + 50_000_000 + 1 + 2, (
        "the input, two links before it, and the step behind a tick"
    )
    (to_client,) = relay.tick()
    assert to_client.links == (1,)
    assert relay.gateway.due_ns is None
    assert relay.fates() == {"received": 2, "relayed": 2}
    assert relay.verified()


def test_what_is_done_to_a_message_is_told_and_what_is_recorded_is_what_was_sent() -> None:
    relay = FaultyRelay("corrupt=100%")
    told, sent = relay.igtl(HELLO, 1)
    assert Note.unpack(told.data()).code == FAULT
    assert "corrupt: STRING/Greeting" in Note.unpack(told.data()).text
    assert sent.data() != HELLO
    assert relay.verified()
    lossy = FaultyRelay("loss=100%")
    assert codes(lossy.igtl(HELLO, 1)) == [FAULT]
    assert lossy.fates() == {"received": 1, "dropped": {"fault_loss": 1}}
    assert lossy.verified()


@pytest.mark.parametrize(("way", "hit", "spared"), [("in", 1, 2), ("out", 2, 1)])
def test_faults_of_one_way_leave_the_other_as_it_is(way: str, hit: int, spared: int) -> None:
    relay = FaultyRelay(f"{way}:loss=100%")
    (sent,) = relay.igtl(HELLO, spared)
    assert (sent.kind, sent.links, sent.data()) == (Kind.IGTL_OUT, (hit,), HELLO)
    assert codes(relay.igtl(HELLO, hit)) == [FAULT]
    assert relay.fates() == {"received": 2, "relayed": 1, "dropped": {"fault_loss": 1}}
    assert relay.verified()


def test_a_connection_that_is_cut_by_a_fault_of_one_way() -> None:
    relay = FaultyRelay("in:disconnect=100%")
    assert [entry.links for entry in relay.igtl(HELLO, 1)][-1] == (2,)
    assert relay.igtl(HELLO, 1) == []
    assert [entry.kind for entry in relay.igtl(HELLO, 2)] == [Kind.IGTL_OUT]  # to the client, which is still there
    relay.down(2)
    assert relay.fates() == {"received": 3, "relayed": 2, "dropped": {CUT: 1}}
    assert relay.verified()


def test_a_connection_is_closed_on_purpose_and_what_comes_behind_is_lost() -> None:
    relay = FaultyRelay("delay=50ms,disconnect=50%", seed=4)
    outs: list[Entry] = []
    for _ in range(8):
        outs += relay.igtl(HELLO, 1)
    outs += relay.tick()
    outs += relay.igtl(HELLO, 1)
    sent = [entry for entry in outs if entry.kind is Kind.IGTL_OUT]
    assert 0 < len(sent) < 8
    assert codes(outs) == [FAULT, CUT]
    assert outs[-1].links == (2,)
    relay.down(2)
    assert codes(relay.igtl(HELLO, 1)) == ["no_partner"]
    dropped = {CUT: 9 - len(sent), "no_partner": 1}
    assert relay.fates() == {"received": 10, "relayed": len(sent), "dropped": dropped}
    assert relay.verified()


def test_the_last_words_of_a_peer_that_leaves_still_arrive() -> None:
    relay = FaultyRelay("delay=50ms")
    relay.igtl(HELLO, 1)
    relay.igtl(HELLO, 2)
    assert [(entry.kind, entry.links) for entry in relay.down(1)] == [(Kind.IGTL_OUT, (2,))]
    assert relay.fates() == {"received": 2, "relayed": 1, "dropped": {LINK_DOWN: 1}}
    assert relay.gateway.due_ns is None
    assert relay.verified()


def test_a_step_of_the_hosts_clock_is_counted() -> None:
    relay = Relay()
    assert relay.feed(Kind.EDGE_NOTE, ClockStep.after(-(10**12), 0).note().pack(), 0) == []
    assert relay.gateway.ledger.to_dict()["edges"] == {"": {CLOCK_STEP: 1}}


def test_faults_are_for_relays() -> None:
    with pytest.raises(ConfigError, match=r"gateway\.faults: found 'loss=1%', expected relay = true with it"):
        Config(faults="loss=1%")
    with pytest.raises(ConfigError, match=r"gateway\.faults: loss: found '1'"):
        Config(relay=True, faults="loss=1")


def test_of_the_rest_of_a_link_what_follows_a_disconnect_is_dropped() -> None:
    relay = FaultyRelay("delay=50ms,disconnect=50%", seed=4)
    for _ in range(8):
        relay.igtl(HELLO, 1)
    outs = relay.down(1)
    sent = sum(entry.kind is Kind.IGTL_OUT for entry in outs)
    assert 0 < sent < 8 and codes(outs) == [FAULT, CUT]
    assert relay.fates() == {"received": 8, "relayed": sent, "dropped": {CUT: 8 - sent}}
    assert relay.verified()


def test_no_stream_of_a_relay_is_guarded() -> None:
    """It forwards old data and odd stamps; a bridge looks for silences of guarded streams only."""
    relay = Relay()
    relay.pair(1, 2)
    relay.igtl(HELLO, 1)
    assert relay.gateway.guard.of(1, "STRING/Greeting", 0.0) is None
    assert list(relay.gateway.guard.items()) == []
