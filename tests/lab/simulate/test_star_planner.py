"""The planner alone: its input is made here, so that each of its judgements can be compared with the truth."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from igtl_gateway.base.stamp import NS_PER_S, ns_to_ticks
from igtl_gateway.wire import Message
from igtl_gateway.wire.body import Body
from igtl_gateway.wire.point import Points
from igtl_gateway.wire.polydata import PolyData
from igtl_gateway.wire.text import String
from igtl_gateway_lab.simulate.actor import Sent
from igtl_gateway_lab.simulate.star_numbers import Array
from igtl_gateway_lab.simulate.star_planner import LIMIT_MM, SuturePlanner, offsets

START_NS = 10**18


def plane(tilt: float = 0.0) -> Array:
    """A cloud of the plane z = 250 mm + tilt · x, a point each 0.35 mm."""
    x, y = np.meshgrid(np.arange(-20, 20, 0.35), np.arange(-20, 20, 0.35))
    return np.stack([x, y, 250 + tilt * x], -1).reshape(-1, 3)


def drawn(*depths: float) -> Array:
    """Points of a plan 3 mm apart: entries, then exits, at these depths."""
    half = len(depths) // 2
    return np.array([[3.0 * (i % half), -3.0 if i < half else 3.0, z] for i, z in enumerate(depths)])


class Played:
    """A planner that receives messages, and everything it sends."""

    def __init__(self) -> None:
        self.planner = SuturePlanner(100 * NS_PER_S)
        self.planner.begin(START_NS)
        self.said: list[Message] = []
        self.pass_time(START_NS)

    def receive(self, since_s: float, device: str, content: Body) -> None:
        at_ns = START_NS + round(since_s * NS_PER_S)
        kind = "POINT" if isinstance(content, Points) else "POLYDATA"
        self._take(self.planner.receive(at_ns, Message(kind, device, content, ns_to_ticks(at_ns))))
        self.pass_time(at_ns + NS_PER_S // 2)

    def plan(self, since_s: float, points: Array) -> None:
        self.receive(since_s, "PlanPoints", Points.of(points))

    def cloud(self, since_s: float, points: Array) -> None:
        self.receive(since_s, "TissueCloud", PolyData(points.astype(">f4")))

    def pass_time(self, until_ns: int) -> None:
        while self.planner.due_ns is not None and self.planner.due_ns <= until_ns:
            self._take(self.planner.act(self.planner.due_ns))

    def _take(self, words: Iterable[Sent]) -> None:
        self.said += [word for word in words if isinstance(word, Message)]

    @property
    def texts(self) -> list[str]:
        return [m.content.text for m in self.said if isinstance(m.content, String)]

    @property
    def corrections(self) -> list[Any]:
        return [m.content.elements for m in self.said if isinstance(m.content, Points)]


def test_offsets_are_along_the_ray_and_to_the_surface_whatever_its_tilt() -> None:
    for tilt in (0.0, 0.3):
        cloud = plane(tilt)
        plan = np.array([[5.0, 2.0, 250 + tilt * 5.0], [-4.0, 1.0, 250 - tilt * 4.0]])
        for off_mm in (-2.0, 0.0, 1.5):
            moved = plan * (1 + off_mm / plan[:, 2])[:, None]
            np.testing.assert_allclose(offsets(moved, cloud), off_mm, atol=0.12)


def test_where_there_is_no_cloud_nothing_is_said_of_the_depth() -> None:
    assert offsets(np.array([[100.0, 0.0, 200.0]]), plane()).tolist() == [0]


def test_what_is_off_is_put_onto_the_cloud_and_approved_when_it_is_repeated() -> None:
    play = Played()
    play.plan(1, drawn(250, 248, 250.2, 249.9))
    assert play.corrections == [], "it waits for a newer cloud"
    play.cloud(2, plane())
    (elements,) = play.corrections
    assert elements["position"][:, 2].round(3).tolist() == [250, 250, np.float32(250.2), np.float32(249.9)]
    before = drawn(250, 248, 250.2, 249.9)[1]
    np.testing.assert_allclose(elements["position"][1], before * 250 / 248, rtol=1e-6)
    assert [bytes(name) for name in elements["name"]] == [b"entry 1", b"entry 2", b"exit 1", b"exit 2"]
    assert [tuple(colour) for colour in elements["rgba"]].count((255, 160, 0, 255)) == 1
    assert play.texts == ["moved: entry 2, 2.0 mm off the cloud"]
    play.plan(3, drawn(250, 248, 250.2, 249.9))  # not what it asked for
    assert play.texts[1:] == []
    play.plan(4, elements["position"].astype(np.float64))
    assert play.texts[1:] == ["plan approved"]
    report = play.planner.report()
    assert report.good and report.facts["moved_mm"] == {"entry 2": 2.0}


def test_a_plan_on_the_cloud_is_approved_as_it_is() -> None:
    play = Played()
    play.plan(1, drawn(250, 250 + 0.9 * LIMIT_MM))
    play.cloud(2, plane())
    assert (play.texts, play.corrections) == (["plan approved"], [])


def test_a_cloud_that_is_no_newer_than_the_plan_tells_nothing_of_it() -> None:
    play = Played()
    play.cloud(1, plane())
    play.plan(2, drawn(248, 250))
    play.cloud(2, plane())
    assert (play.texts, play.corrections) == ([], [])


def test_a_planner_waits_for_the_session_and_ends_with_it() -> None:
    planner = SuturePlanner(NS_PER_S)
    planner.begin(START_NS)
    list(planner.act(START_NS))
    states = [(planner.done, planner.due_ns)]
    later_ns = START_NS + 500 * NS_PER_S
    planner.receive(later_ns, Message("STRING", "StarStatus", String.of("session: SYNTHETIC"), 1))
    states.append((planner.done, planner.due_ns))
    assert list(planner.act(later_ns + NS_PER_S)) == []
    states.append((planner.done, planner.due_ns))
    assert states == [(False, None), (False, later_ns + NS_PER_S), (True, None)]
    assert not planner.report().good and "not approved" in planner.report().lines[1]
