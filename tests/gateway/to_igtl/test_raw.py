"""Whole messages from ROS: to the peers that they name, by type, version and age."""

from __future__ import annotations

import struct
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from igtl_gateway.base.buffers import join
from igtl_gateway.base.stamp import NS_PER_S, ns_to_ticks
from igtl_gateway.config.configuration import Config, ToIgtlRow
from igtl_gateway.convert.raw import raw_message
from igtl_gateway.wire import Item, Message, Raw, encode
from igtl_gateway.wire.bind import Bind, BindChild
from igtl_gateway.wire.body import Body
from igtl_gateway.wire.text import Status, String
from tests.script import T0_NS, Script

TOPIC = "/igtl/out/raw"
HELLO = join(encode(Message("STRING", "Greeting", String.of("hello"), ns_to_ticks(T0_NS))))
NEWER = Message("STATUS", "", Status(1), 0, 2, 0, (Item("a", b"b"),))


def sent(script: Script, data: bytes, *links: int) -> list[str]:
    raw = raw_message(HELLO, T0_NS, 0)
    return script.ros(TOPIC, replace(raw, data=data, links=np.array(links, np.uint32)))


def dropped(script: Script) -> dict[str, Any]:
    row: dict[str, Any] = script.gateway.ledger.to_dict()["ros_in"][TOPIC]
    return dict(row.get("dropped", {}))


def test_it_goes_to_all_peers_or_to_those_that_it_names() -> None:
    script = Script()
    for link in (1, 2, 3):
        script.up(link)
    assert sent(script, HELLO) == ["igtl STRING/Greeting v1 to 1,2,3"]
    assert script.last[0].data() == HELLO
    assert sent(script, HELLO, 3, 1) == ["igtl STRING/Greeting v1 to 1,3"]


def test_without_a_peer_that_can_read_it_it_is_dropped() -> None:
    script = Script()
    assert sent(script, HELLO) == []
    script.up(1)
    newer = join(encode(Message("STRING", "Greeting", String.of("hello"), 0, 2)))
    assert sent(script, newer) == [], "the peer has not shown version 2"
    assert dropped(script) == {"no_peer": 1, "not_for_peer": 1}
    script.igtl(NEWER)
    assert sent(script, newer) == ["igtl STRING/Greeting v2 to 1"]


def test_bytes_that_are_not_a_message_are_refused() -> None:
    script = Script()
    script.up(1)
    assert sent(script, b"short") == ["note conversion"]
    assert dropped(script) == {"conversion": 1}


@pytest.mark.parametrize(("age_s", "lines"), [(1.0, ["igtl STRING/Greeting v1 to 1"]), (5.0, ["note stale"])])
def test_a_message_that_is_too_old_is_not_sent(age_s: float, lines: list[str]) -> None:
    script = Script(Config(to_igtl=(ToIgtlRow(topic=TOPIC, max_age_s=2.0),)))
    script.up(1)
    stamp = ns_to_ticks(script.now_ns - round(age_s * NS_PER_S))
    old = HELLO[:34] + struct.pack(">Q", stamp) + HELLO[42:]
    assert sent(script, old) == lines


def bind(name: str, body: Body) -> bytes:
    return join(encode(Message("BIND", "Both", Bind((BindChild(name, "child", join(body.pack())),)))))


def test_a_bind_is_denied_for_its_child_and_refused_if_it_cannot_be_decoded() -> None:
    script = Script(Config(deny_out=("STATUS",)))
    script.up(1)
    assert sent(script, bind("STRING", String.of("hello"))) == ["igtl BIND/Both v1 to 1"]
    assert sent(script, bind("STATUS", Status(1))) == ["note denied"]
    assert sent(script, join(encode(Message("BIND", "Both", Raw(b"\xff\xff"))))) == ["note conversion"]
    assert dropped(script) == {"denied": 1, "conversion": 1}
