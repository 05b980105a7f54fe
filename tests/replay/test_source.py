"""What a replay sends."""

from __future__ import annotations

from dataclasses import replace

import pytest

from igtl_gateway.base.buffers import join
from igtl_gateway.config.configuration import Config
from igtl_gateway.gateway import LINK_UP, PARTNER, Session, make_core
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.note import Level, Note
from igtl_gateway.replay.source import first_form_only, one_side_of_relay, select_entries, through_gateway
from igtl_gateway.wire import Header, Message, encode
from igtl_gateway.wire.text import String
from igtl_gateway_lab.simulate.catalogue import SCENARIOS

SCENARIO = SCENARIOS["paper-types"]
OUT = frozenset({Kind.IGTL_OUT})


@pytest.fixture(scope="module")
def entries() -> list[Entry]:
    return list(SCENARIO.entries())


def told(entries: list[Entry]) -> list[tuple[str, bytes]]:
    return [(entry.channel, entry.data()) for entry in entries]


def test_through_the_same_gateway_comes_what_was_sent(entries: list[Entry]) -> None:
    again = through_gateway(entries, SCENARIO.config, has_links=True)
    assert told(list(select_entries(again, OUT))) == told(list(select_entries(entries, OUT)))


def test_without_recorded_links_a_version_1_reader_is_assumed(entries: list[Entry]) -> None:
    inputs = [entry for entry in entries if entry.kind is Kind.ROS_IN]
    sent = list(select_entries(through_gateway(inputs, SCENARIO.config, has_links=False), OUT))
    assert len(sent) == len(inputs)
    assert {Header.unpack(entry.data()).version for entry in sent} == {1}


def test_of_two_header_versions_the_first_is_sent_once(entries: list[Entry]) -> None:
    both = list(select_entries(entries, OUT))
    single = list(select_entries(first_form_only(entries), OUT))
    assert len(both) == 2 * len(single)
    assert {Header.unpack(entry.data()).version for entry in single} == {1}


@pytest.mark.parametrize(
    ("globs", "channels"),
    [
        (("TRANSFORM/*",), {"TRANSFORM/ToolToBase"}),
        (("Mono*",), {"IMAGE/Mono8", "IMAGE/Mono16"}),
        (("Mono8", "STRING/**"), {"IMAGE/Mono8", "STRING/Greeting"}),
        (("nothing",), set()),
    ],
)
def test_streams_are_chosen_by_globs(entries: list[Entry], globs: tuple[str, ...], channels: set[str]) -> None:
    assert {entry.channel for entry in select_entries(entries, OUT, globs)} == channels


def test_ros_topics_are_chosen_by_their_name_only(entries: list[Entry]) -> None:
    ros = frozenset({Kind.ROS_IN, Kind.ROS_OUT})
    chosen = {entry.channel for entry in select_entries(entries, ros, ("/igtl/in/**",))}
    assert chosen and all(channel.startswith("/igtl/in/") for channel in chosen)


def test_a_new_cause_sends_the_same_stream_again(entries: list[Entry]) -> None:
    pair = [entry for entry in entries if entry.channel in ("/igtl/out/Greeting", "STRING/Greeting")]
    ros_in = next(entry for entry in pair if entry.kind is Kind.ROS_IN)
    sent = next(entry for entry in pair if entry.kind is Kind.IGTL_OUT)
    log = [
        ros_in,
        sent,
        replace(sent, seq=sent.seq + 1),
        replace(ros_in, seq=sent.seq + 2),
        replace(sent, seq=sent.seq + 3),
    ]
    assert len(list(select_entries(first_form_only(log), OUT))) == 2


@pytest.mark.parametrize(("role", "device"), [("server", "FromServer"), ("client", "FromClient")])
def test_of_a_relay_the_words_of_one_side(role: str, device: str) -> None:
    session = Session(make_core(Config(relay=True)))
    log: list[Entry] = []
    for link, facts in ((1, {"role": "server"}), (2, {"role": "client", PARTNER: 1})):
        note = Note(Level.INFO, LINK_UP, "up", data=facts)
        log += session.input(1, Kind.LINK, (note.pack(),), links=(link,))
    for link, name in ((1, "FromClient"), (2, "FromServer")):
        data = join(encode(Message("STRING", name, String.of("hello"))))
        log += session.input(1, Kind.IGTL_IN, (data,), links=(link,))
    assert [entry.channel for entry in select_entries(one_side_of_relay(role, log), OUT)] == [f"STRING/{device}"]
