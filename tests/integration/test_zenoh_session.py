"""The session log over Zenoh is that over DDS: the same inputs, and what follows from them, byte for byte.

Two bridges of the same configuration get the messages of the golden recording ``every-type``, one over each middleware.
Stamps of the wall clock differ, so the log over DDS is computed again with the messages that came over Zenoh in the
places of its own.
"""

from __future__ import annotations

import socket
import threading
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import pytest

from igtl_gateway.addons.zenoh.edge import ZenohEdge
from igtl_gateway.app.bridge import Bridge
from igtl_gateway.app.bridge_options import BridgeOptions
from igtl_gateway.app.verification import verify_recording
from igtl_gateway.base.clock import SystemClock
from igtl_gateway.base.qos import Qos
from igtl_gateway.config.configuration import Config
from igtl_gateway.edges.ros.edge import RosEdge
from igtl_gateway.gateway import Session, make_core
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.replay.recorded_config import config_to_run
from tests.addons.zenoh.routers import free_port, router
from tests.places import ROOT
from tests.timing import WAIT_S

pytestmark = pytest.mark.ros

GOLDEN = ROOT / "fixtures" / "every-type.mcap"
QOS = Qos(1000)
OF_EACH = 5


@dataclass
class Traffic:
    """What a bridge recorded, and what the node at the other end received, by topic."""

    entries: list[Entry]
    received: dict[str, list[bytes]]


@dataclass
class Arrivals:
    """Counts what arrives; a thread waits for it."""

    counts: dict[Kind, int] = field(default_factory=dict)
    changed: threading.Condition = field(default_factory=threading.Condition)

    def add(self, entry: Entry) -> None:
        with self.changed:
            self.counts[entry.kind] = self.counts.get(entry.kind, 0) + 1
            self.changed.notify_all()

    def wait(self, kind: Kind, count: int) -> None:
        with self.changed:
            assert self.changed.wait_for(lambda: self.counts.get(kind, 0) >= count, WAIT_S), (kind, count)


def traffic(
    path: Path, inputs: Sequence[Entry], config: Config, zenoh: str | None, make: Callable[..., Any]
) -> Traffic:
    """Pass the inputs through a bridge, one after the other."""
    arrivals, received = Arrivals(), dict[str, list[bytes]]()
    options = BridgeOptions(listen=(("127.0.0.1", 0),), zenoh=zenoh, record=path)
    bridge = Bridge(config, options, SystemClock(), arrivals.add)
    node = make(
        node_name="other",
        on_message=lambda topic, _type, cdr, _ns: received.setdefault(topic, []).append(cdr),
        wants=lambda topic, _type: QOS if topic.startswith(("/igtl/in", "/tf")) else None,
        on_note=lambda _note: None,
    )
    bridge.start()
    try:
        node.start()
        with socket.create_connection(bridge.addresses[0]) as peer:
            arrivals.wait(Kind.LINK, 1)
            topics = {(entry.channel, entry.type) for entry in inputs if entry.kind is Kind.ROS_IN}
            for topic, ros_type in sorted(topics):
                node.advertise(topic, ros_type, QOS)
            for topic, _ in topics:
                assert node.wait_for_subscribers(topic, 1, WAIT_S), topic
            sent = dict.fromkeys((Kind.ROS_IN, Kind.IGTL_IN), 0)
            for entry in inputs:
                if entry.kind is Kind.ROS_IN:
                    assert node.publish(entry.channel, entry.type, entry.data(), QOS) == ""
                else:
                    peer.sendall(entry.data())
                sent[entry.kind] += 1
                arrivals.wait(entry.kind, sent[entry.kind])
    finally:
        bridge.stop()
        node.stop()
    assert verify_recording(path).good
    with SessionFile.open(path) as file:
        return Traffic(list(file.entries()), received)


def first_of_each(entries: Iterable[Entry]) -> Iterator[Entry]:
    """The first inputs of each stream: each one waits for the one before it."""
    counts = Counter[tuple[Kind, str, str]]()
    for entry in entries:
        stream = (entry.kind, entry.channel, entry.type)
        counts[stream] += 1
        if entry.kind in (Kind.ROS_IN, Kind.IGTL_IN) and counts[stream] <= OF_EACH:
            yield entry


def unpadded(cdr: bytes) -> bytes:
    """Without the zeros that DDS appends to a multiple of 4."""
    return cdr.rstrip(b"\0")


def computed(entries: Sequence[Entry], config: Config, instead: Sequence[Entry]) -> list[Entry]:
    """The log of these inputs, with other messages of ROS in the places of its own."""
    session, others, log = Session(make_core(config)), iter(instead), list[Entry]()
    for entry in entries:
        one = replace(entry, payload=next(others).payload) if entry.kind is Kind.ROS_IN else entry
        if entry.kind.is_input:
            log += [one, *session.recorded(one)]
    return log


@pytest.mark.slow
def test_the_log_over_zenoh_is_that_over_dds(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", "87")
    with SessionFile.open(GOLDEN) as file:
        config = config_to_run(file.session)
        inputs = list(first_of_each(file.entries()))
    port = free_port()
    endpoint = f"tcp/127.0.0.1:{port}"
    with router(port):
        zenoh = traffic(
            tmp_path / "zenoh.mcap", inputs, config, endpoint, lambda **more: ZenohEdge(endpoint=endpoint, **more)
        )
    dds = traffic(tmp_path / "dds.mcap", inputs, config, None, RosEdge)

    ours, theirs = ([entry for entry in of.entries if entry.kind is Kind.ROS_IN] for of in (zenoh, dds))
    assert [(one.channel, one.type, one.data()) for one in ours] == [
        (one.channel, one.type, one.data()) for one in inputs if one.kind is Kind.ROS_IN
    ]
    assert [(one.channel, one.type, unpadded(one.data())) for one in ours] == [
        (one.channel, one.type, unpadded(one.data())) for one in theirs
    ]
    expected = [entry for entry in dds.entries if entry.kind is not Kind.ROS_IN]
    found = [entry for entry in computed(dds.entries, config, ours) if entry.kind is not Kind.ROS_IN]
    assert len(found) == len(expected)
    for one, other in zip(found, expected, strict=True):
        assert (one.seq, one.stamp_ns, one.kind, one.channel, one.type, one.links, one.source_ns, one.data()) == (
            *(other.seq, other.stamp_ns, other.kind, other.channel, other.type, other.links, other.source_ns),
            other.data(),
        )
    outputs: dict[str, list[bytes]] = {}
    for entry in zenoh.entries:
        if entry.kind is Kind.ROS_OUT:
            outputs.setdefault(entry.channel, []).append(entry.data())
    assert len(zenoh.received) > 20
    for topic, messages in zenoh.received.items():
        assert messages == outputs[topic][-len(messages) :]
