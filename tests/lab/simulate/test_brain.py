"""The brain goes there and back, through the real gateway."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
import pytest

from igtl_gateway.convert.rosmsg import Mesh
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.wire import decode
from igtl_gateway_lab.simulate import brain
from igtl_gateway_lab.simulate.actor import Actor, Received, RosReceived, Sent
from igtl_gateway_lab.simulate.brain_surface import TriangleMesh
from igtl_gateway_lab.simulate.stage import play_offline
from igtl_gateway_lab.simulate.volume import SYNTHETIC, VARIABLE


def tetrahedron() -> tuple[TriangleMesh, str]:
    points = np.array([[0.1, 0, 0], [1, 0.2, 0], [0, 1.3, 0], [0, 0, 100.7]])
    return TriangleMesh(points, np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])).unwelded(), "tetrahedron"


def played(actors: tuple[Actor, ...], limit_s: float = 5.0) -> list[Entry]:
    return list(play_offline(actors, brain.CONFIG, limit_s=limit_s))


def test_it_arrives_equal_and_comes_back_equal() -> None:
    planner, model = brain.BrainPlanner(tetrahedron, 2), brain.Model(2)
    log = played((planner, model))
    assert planner.done and model.done
    told, heard = planner.report(), model.report()
    assert told.good and heard.good, (told, heard)
    assert told.facts["points"] == 12 and told.facts["faces"] == 4
    assert told.facts["equal_at_ros"] == told.facts["equal_back"] == heard.facts["equal"] == 2
    sent = [decode(entry.data()).content for entry in log if entry.channel == "POLYDATA/BrainSurface"]
    back = [decode(entry.data()).content for entry in log if entry.channel == "POLYDATA/BrainModel"]
    assert len(sent) == 2 and sent == back


def test_ros_has_metres() -> None:
    log = played((brain.BrainPlanner(tetrahedron, 1), brain.Model(1)))
    (mesh,) = (Mesh.unpack(entry.data()) for entry in log if entry.kind is Kind.ROS_OUT and entry.type == Mesh.TYPE)
    assert mesh.vertices.max() == pytest.approx(0.1007)


class Bending(brain.Model):
    """A node whose mesh is not the one that was sent: by the last bit of one number."""

    def receive(self, now_ns: int, heard: Received) -> Iterable[Sent]:
        if isinstance(heard, RosReceived) and heard.type == Mesh.TYPE:
            mesh = Mesh.unpack(heard.cdr)
            vertices = mesh.vertices.copy()
            vertices[0, 0] = np.nextafter(np.float32(vertices[0, 0] * 1000), np.float32(1)) / 1000
            heard = replace(heard, cdr=Mesh(mesh.triangles, vertices).pack())
        return super().receive(now_ns, heard)


def test_one_bit_is_seen_on_both_sides() -> None:
    planner, model = brain.BrainPlanner(tetrahedron, 1), Bending(1)
    played((planner, model))
    assert planner.done and model.done
    assert not planner.report().good and not model.report().good
    assert planner.report().facts["equal_at_ros"] == planner.report().facts["equal_back"] == 0


def test_nobody_at_the_other_end_is_no_success() -> None:
    planner = brain.BrainPlanner(tetrahedron, 1)
    assert played((planner,)) and not planner.done and not planner.report().good
    model = brain.Model(1)
    log = played((model,))
    assert not model.done and not model.report().good
    assert sum(entry.channel == "/brain/ready" for entry in log) == 10, "it reports that twice a second"


def test_a_short_session_is_the_small_one_on_every_machine() -> None:
    actors = brain.actors(1.0)
    played(actors)
    small = actors[0].report()
    assert small.good and small.facts["points"] == 74_772 and small.facts["source"] == "synthetic brain, 3.5 mm"
    assert small.lines[0].split("CRC ")[1].startswith("5b94bfa1"), "the same bytes everywhere"


def test_the_large_one_exceeds_the_papers(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(VARIABLE, SYNTHETIC)
    surface, source = brain.large_brain()
    assert len(surface.points) > 600_000 and len(surface.faces) > 230_000
    assert source.startswith("synthetic")
