"""What is done before a ROS message has its number: the same outputs, and the lock does not wait for it."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from igtl_gateway.base.buffers import join
from igtl_gateway.config.configuration import Config, ToIgtlRow
from igtl_gateway.config.settings import RECEIVE, SOURCE
from igtl_gateway.gateway import Session
from igtl_gateway.gateway.fastpath import cache
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.note import Level, Note
from igtl_gateway.gateway.session import make_core
from igtl_gateway.gateway.to_igtl import beforehand
from igtl_gateway.gateway.to_igtl.beforehand import RosResults
from igtl_gateway.wire import Message, encode
from igtl_gateway.wire.text import String
from igtl_gateway_lab.simulate.every_ros import messages as published

T0_NS = 1_800_000_000_000_000_000


def rows() -> tuple[ToIgtlRow, ...]:
    return tuple(
        ToIgtlRow(topic=f"/t{number}", type=igtl_type, device=f"D{number}")
        for number, (_, igtl_type, _) in enumerate(published())
    )


@pytest.mark.parametrize("peers", [0, 1])
def test_outputs_are_those_of_the_full_path(peers: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(beforehand, "_LEAST_BYTES", 0)
    used, logs = 0, list[list[Entry]]()
    for early in (False, True):
        session, log = Session(make_core(Config(to_igtl=rows()), fast_path=False)), list[Entry]()
        for link in range(1, peers + 1):
            session.input(T0_NS, Kind.LINK, (Note(Level.INFO, "link_up", "up").pack(),), links=(link,))
        for turn in range(2):
            for number, (_, _, message) in enumerate(published()):
                cdr, topic = message.pack(), f"/t{number}"
                cdr = cdr[:-1] if turn and number % 3 == 0 else cdr  # some cannot be decoded
                prepared = session.prepare(Kind.ROS_IN, cdr, topic, message.TYPE, (), 0) if early else None
                used += isinstance(prepared, RosResults)
                now_ns = T0_NS + (turn * 1_000 + number) * 1_000_000
                log += session.input(
                    now_ns, Kind.ROS_IN, (cdr,), channel=topic, type_name=message.TYPE, prepared=prepared
                )
        logs.append(log)
    assert logs[0] == logs[1]
    assert bool(used) is bool(peers)  # without a peer nothing is converted


def test_results_with_another_unit_are_not_used(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(beforehand, "_LEAST_BYTES", 0)
    logs = []
    for early in (False, True):
        session = Session(make_core(Config(to_igtl=rows()), fast_path=False))
        session.input(T0_NS, Kind.LINK, (Note(Level.INFO, "link_up", "up").pack(),), links=(1,))
        _, _, message = next(published())
        prepared = session.prepare(Kind.ROS_IN, message.pack(), "/t0", message.TYPE, (), 0) if early else None
        if isinstance(prepared, RosResults):
            prepared = replace(prepared, lengths=replace(prepared.lengths, ros="mm"))
        cdr = message.pack()
        logs.append(session.input(T0_NS, Kind.ROS_IN, (cdr,), channel="/t0", type_name=message.TYPE, prepared=prepared))
    assert logs[0] == logs[1]


@pytest.mark.parametrize("stamp", [RECEIVE, SOURCE])
@pytest.mark.parametrize("versions", [(1,), (2,), (1, 2)])
def test_a_compiled_message_with_gateway_time_is_converted_before_it_has_that(
    versions: tuple[int, ...], stamp: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its stamp is put in later, unless a peer gets it among the metadata: these have a checksum."""
    monkeypatch.setattr(cache, "LARGE_BYTES", 0)
    hello = {version: join(encode(Message("STRING", "hello", String(b"hi"), 0, version))) for version in versions}
    logs, ready = list[list[Entry]](), 0
    for early in (False, True):
        session, log = Session(make_core(Config(to_igtl=rows(), stamp=stamp))), list[Entry]()
        for link, version in enumerate(versions, 1):
            session.input(T0_NS, Kind.LINK, (Note(Level.INFO, "link_up", "up").pack(),), links=(link,))
            session.input(T0_NS, Kind.IGTL_IN, (hello[version],), links=(link,))
        for turn in range(4):
            for number, (_, _, plain) in enumerate(published()):
                topic, now_ns = f"/t{number}", T0_NS + (turn * 1_000 + number) * 1_000_000
                header: Any = getattr(plain, "header", None)
                message: Any = plain
                if header and turn % 2:  # without a stamp
                    message = replace(message, header=replace(header, stamp_ns=0))
                cdr = message.pack()
                prepared = session.prepare(Kind.ROS_IN, cdr, topic, message.TYPE, (), 0) if early else None
                ready += isinstance(prepared, tuple) and prepared[1][0] == 0
                log += session.input(
                    now_ns, Kind.ROS_IN, (cdr,), channel=topic, type_name=message.TYPE, prepared=prepared
                )
        logs.append([replace(entry, payload=(join(entry.payload),)) for entry in log])
    assert logs[0] == logs[1]
    assert ready > 5 or stamp == SOURCE
