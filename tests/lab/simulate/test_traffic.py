"""The two test programs: everything arrives as it was sent, and what does not is counted."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import pytest

from igtl_gateway.convert.rosmsg import TransformStamped
from igtl_gateway.gateway.log.entry import Kind
from igtl_gateway_lab.simulate.actor import ActorProtocol, ActorReport, RosSent, Sent
from igtl_gateway_lab.simulate.load import SIZES, Load
from igtl_gateway_lab.simulate.stage import IGTL_NS, ROS_NS, play_offline
from igtl_gateway_lab.simulate.traffic import TestNode, TestServer, scenario


def reports(load: Load) -> dict[ActorProtocol, ActorReport]:
    made = scenario(load)
    cast = made.cast()
    log = list(made.entries(cast=cast))
    assert all(actor.done for actor in cast)
    types = {entry.type for entry in log if entry.kind in (Kind.IGTL_IN, Kind.IGTL_OUT)}
    assert types == {load.type}
    return {actor.side: actor.report() for actor in cast}


@pytest.mark.parametrize("name", SIZES)
def test_every_type_arrives_both_ways_at_its_least_and_its_usual_size(name: str) -> None:
    _, least, usual, _ = SIZES[name]
    for size in {least, usual}:
        for report in reports(Load(name, size, rate_hz=100.0, count=4)).values():
            assert report.good, report.lines
            assert report.facts["received"] == report.facts["sent"] == 4
            assert report.facts["latency_ms"]["max"] == pytest.approx((IGTL_NS + ROS_NS) / 1e6, abs=0.001)
            assert report.facts["received_hz"] == pytest.approx(100.0, rel=0.01)


@pytest.mark.parametrize(("sender", "silent"), [("igtl", ActorProtocol.ROS), ("ros", ActorProtocol.IGTL)])
def test_one_side_may_only_receive(sender: str, silent: ActorProtocol) -> None:
    found = reports(Load(count=3, sender=sender))
    assert all(report.good for report in found.values())
    assert "sent" not in found[silent].facts and found[silent].facts["received"] == 3
    (other,) = set(found) - {silent}
    assert "received" not in found[other].facts


def test_what_is_lost_swapped_or_changed_is_counted() -> None:
    class Bad(TestNode):
        """Loses number 3, sends number 6 before 5, and changes number 8."""

        def act(self, now_ns: int) -> Iterable[Sent]:
            said = [one for one in super().act(now_ns) if isinstance(one, RosSent)]
            if not said:
                return []
            number = self._sent - 1
            match number:
                case 3:
                    return []
                case 5:
                    return [self._message(6, now_ns)]
                case 6:
                    return [self._message(5, now_ns)]
                case 8:
                    pose = said[0].message
                    assert isinstance(pose, TransformStamped)
                    x, y, _ = pose.translation
                    return [replace(said[0], message=replace(pose, translation=(x, y, 0.0)))]
            return said

    load = Load(count=10)
    server, node = TestServer(load, 0, 10), Bad(load, 10, 0)
    list(play_offline((server, node), scenario(load).config))
    report = server.report()
    assert server.done and not report.good
    assert {name: report.facts[name] for name in ("received", "lost", "out_of_order", "changed")} == {
        "received": 9, "lost": 1, "out_of_order": 1, "changed": 1,
    }  # fmt: skip
    assert report.lines[0].endswith("1 lost, 1 out of order, 1 changed")


def test_a_receiver_that_hears_nothing_gives_up() -> None:
    server = TestServer(Load(), 0, 5)
    list(play_offline((server,), scenario(Load()).config))
    assert server.done and not server.report().good
    assert server.report().lines == ("received 0 of 5: 5 lost, 0 out of order, 0 changed",)


def test_a_load_has_its_own_scenario() -> None:
    image = scenario(Load()).loaded
    assert image and image(Load("IMAGE", 64, count=2)).config.to_igtl[0].type == "IMAGE"
