"""What peers get in place of a message: each with its readers, until nothing is left that a peer does not read."""

from __future__ import annotations

import numpy as np

from igtl_gateway.app.replay_listeners import Listeners
from igtl_gateway.base.buffers import join
from igtl_gateway.config.configuration import Config
from igtl_gateway.convert.substitutes import Shown
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.note import Level, Note
from igtl_gateway.gateway.naming import ShownNames
from igtl_gateway.gateway.peers import Peers
from igtl_gateway.gateway.substitution import in_place_of
from igtl_gateway.gateway.to_igtl.sender import OutboundMessage, send
from igtl_gateway.wire import Message, decode, encode
from igtl_gateway.wire.bind import Bind, BindChild
from igtl_gateway.wire.body import Body
from igtl_gateway.wire.sensor import Sensor
from igtl_gateway.wire.tracking import TrackingData
from igtl_gateway.wire.trajectory import ENTRY_AND_TARGET, Trajectories
from igtl_gateway.wire.transform import Transform

T0_NS = 1_700_000_000_000_000_000


def child(igtl_type: str, name: str, content: Body) -> BindChild:
    return BindChild(igtl_type, name, join(content.pack()))


def nested() -> Bind:
    """A BIND with a pose, numbers, tools and a plan, of which the last two are in a BIND of their own."""
    tools = np.zeros(1, TrackingData.DTYPE)
    tools[0]["name"], tools[0]["matrix"][[0, 4, 8]] = b"Tip", 1
    plan = np.zeros(1, Trajectories.DTYPE)
    plan["type"], plan["target"] = ENTRY_AND_TARGET, (1, 2, 3)
    inner = Bind((child("TDATA", "Tools", TrackingData(tools)), child("TRAJ", "Plan", Trajectories(plan))))
    children = (
        child("TRANSFORM", "Pose", Transform((1.0, 0, 0, 0, 1, 0, 0, 0, 1, 5, 6, 7))),
        child("SENSOR", "Force", Sensor(np.array([1.0]))),
        child("BIND", "Inner", inner),
    )
    return Bind(children)


def peers(count: int) -> Peers:
    made = Peers(Config(profile="slicer"))
    for link in range(1, count + 1):
        made.up(link, {"peer": f"127.0.0.1:{link}", "role": "server"}, T0_NS)
    return made


def test_each_step_has_its_readers_and_those_that_get_nothing() -> None:
    both = peers(2)
    both[2].asked.add("TDATA")
    steps = list(in_place_of(Shown("BIND", "All", nested()), "BIND/All", [*both.all()], ShownNames(lambda _: False)))
    assert [
        (
            step.source,
            step.shown and step.shown.igtl_type,
            step.device,
            [peer.link for peer in step.readers],
            [peer.link for peer in step.left],
        )
        for step in steps
    ] == [
        ("BIND/All", "TRANSFORM", "Pose", [1, 2], []),
        ("BIND/All", "SENSOR", "Force", [], [1, 2]),
        ("BIND/All", "BIND", "Inner", [], []),
        ("BIND/Inner", "TDATA", "Tools", [2], []),
        ("TDATA/Tools", "TRANSFORM", "Tip", [1], []),
        ("BIND/Inner", "TRAJ", "Plan", [], []),
        ("TRAJ/Plan", "POLYDATA", "Plan", [1, 2], []),
    ]


def test_live_and_in_a_replay_a_peer_gets_the_same() -> None:
    message = Message("BIND", "All", nested(), header_version=1)
    entry = Entry(1, T0_NS, Kind.IGTL_OUT, "BIND/All", "BIND", tuple(encode(message)), (1,), T0_NS)
    out = OutboundMessage("BIND", "All", nested(), T0_NS)
    live = send(entry, out, peers(1).all(), names=ShownNames(lambda _: False))
    listeners = Listeners(profile="slicer")
    listeners.on_link(1, True, Note(Level.INFO, "link_up", "", data={"peer": "127.0.0.1:1", "role": "server"}))
    again = listeners.fit(entry, [1])
    found = [
        [(one.type, one.device_name, join(one.content.pack())) for one in (decode(join(data)) for data in bytes_of)]
        for bytes_of in ([each.payload for each in live.outputs], [payload for payload, _ in again])
    ]
    assert found[0] == found[1]
    assert [each[:2] for each in found[0]] == [("TRANSFORM", "Pose"), ("TRANSFORM", "Tip"), ("POLYDATA", "Plan")]
