"""ROS-IGTL-Test and its mirror image: five kinds of content in each round, each where it was sent to."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from igtl_gateway.convert.rosmsg import PointStamped, TransformStamped
from igtl_gateway.gateway.log.entry import Kind
from igtl_gateway_lab.simulate.actor import Actor, RosSent, Sent
from igtl_gateway_lab.simulate.dummies import CONFIG, KINDS, TRIANGLES, Dummies, DummyNode, DummyServer, actors
from igtl_gateway_lab.simulate.stage import play_offline


def played(*cast: Actor) -> list[str]:
    """The OpenIGTLink streams of the session."""
    log = list(play_offline(cast, CONFIG))
    return [entry.channel for entry in log if entry.kind in (Kind.IGTL_IN, Kind.IGTL_OUT)]


def test_all_five_kinds_arrive_both_ways_where_they_were_sent() -> None:
    cast = actors(1.0)
    streams = played(*cast)
    types = {"Transform": "TRANSFORM", "Point": "POINT", "Cloud": "POINT", "String": "STRING", "Model": "POLYDATA"}
    assert set(streams) == {f"{types[kind]}/{who}{kind}" for who in ("Node", "Server") for kind in KINDS}
    for actor in cast:
        report = actor.report()
        assert report.good, report.lines
        assert set(report.facts["received"].values()) == {2}
        assert 0 < report.facts["worst_mm"] < 0.0001


def test_the_numbers_are_random_but_the_same_for_the_same_round() -> None:
    first, again, next_one, other = (Dummies.of(*key) for key in (("Node", 0), ("Node", 0), ("Node", 1), ("Server", 0)))
    assert np.array_equal(first.cloud, again.cloud) and first.cloud.shape == (20, 3)
    assert not np.array_equal(first.cloud, next_one.cloud) and not np.array_equal(first.cloud, other.cloud)
    assert first.off_mm("String", again.text) == 0.0
    assert first.off_mm("String", next_one.text) == np.inf
    assert first.off_mm("Cloud", first.cloud[:-1]) == np.inf


def test_the_model_is_a_closed_surface() -> None:
    edges = [tuple(sorted((int(a), int(b)))) for t in TRIANGLES for a, b in zip(t, np.roll(t, 1), strict=True)]
    assert len(edges) == 2 * len(set(edges)), "each edge has two triangles"
    corners = len(Dummies.of("Node", 0).model)
    assert corners - len(set(edges)) + len(TRIANGLES) == 2, "as of a sphere"


class Off(DummyNode):
    """Moves its point by a hundredth of a millimetre, and turns its transform by a thousandth of a degree."""

    def act(self, now_ns: int) -> Iterable[Sent]:
        for said in super().act(now_ns):
            assert isinstance(said, RosSent)
            match said.message:
                case PointStamped(_, (x, y, z)):
                    yield replace(said, message=replace(said.message, point=(x + 0.00001, y, z)))
                case TransformStamped(_, _, _, (x, y, z, w)):
                    yield replace(said, message=replace(said.message, rotation=(x + 0.0001, y, z, w)))
                case _:
                    yield said


def test_what_arrives_elsewhere_is_measured() -> None:
    server, node = DummyServer(1), Off(1)
    played(server, node)
    report = server.report()
    assert not report.good
    told = {line.split()[1]: line for line in report.lines[1:]}
    assert told["NodePoint"].endswith("0.01000 mm off")
    assert float(told["NodeTransform"].split()[-3]) > 0.005
    assert told["NodeCloud"].endswith("0.00000 mm off")


def test_a_server_alone_ends_and_says_what_did_not_come() -> None:
    server = DummyServer(1)
    played(server)
    assert server.done and not server.report().good
    assert all(line.endswith("nothing came") for line in server.report().lines[1:])
