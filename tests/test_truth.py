"""``tools/truth``: a world of each condition, a check of each route, and faults that the judge must find.

Nothing is silent: what a route gives is right, or refused, or its output shows what is wrong.
"""

from __future__ import annotations

import pytest

from tests.tables import table
from tools.truth.conditions import CONDITIONS, chosen, plan_of
from tools.truth.mutants import MUTANTS, is_found
from tools.truth.routes import ROUTES
from tools.truth.table import RIGHT, SILENT, routes_of, world

pytest.importorskip("SimpleITK")
pytest.importorskip("rerun")

#: Routes that take less than 0.2 s each: together they join streams, name tools, and have all kinds of messages.
CHEAP = ("igs.mha", "python", "align", "lookup")

#: Worlds and routes that were silent once: two peers and refused messages in a merged session, a clock that is apart by
#: what looks like a latency, frames without stamps.
SILENT_ONCE = (
    *((150, "lookup"), (158, "lookup"), (158, "to_igtl"), (318, "csv"), (318, "align"), (318, "lookup")),
    *((346, "arrow"), (380, "lookup"), (407, "ply"), (829, "align"), (980, "view")),
)


#: Routes that make a data set as another one does: the third tier has them.
LONG = ("lerobot_append", "lerobot_import")

#: A fault of each kind that the judge must find.
FEW_MUTANTS = ("pairing by order of receipt", "joints by position", "LPS for RAS", "a stream is missing")


@table("route", [name for name in ROUTES if name != "to_ros"], gate=lambda route: route not in LONG)
def test_an_ordinary_world_is_right_on_each_route(route: str) -> None:
    (verdict,) = world(0, [route], [])
    assert verdict.verdict == RIGHT and verdict.samples, verdict.lines


@pytest.mark.ros
def test_an_ordinary_world_is_right_on_the_graph() -> None:
    (verdict,) = world(0, ["to_ros"], [])
    assert verdict.verdict == RIGHT and verdict.samples, verdict.lines


@pytest.mark.slow
@table("name", CONDITIONS)
def test_nothing_is_silent_in_a_world_of_each_condition(name: str) -> None:
    seed = list(CONDITIONS).index(name) + 1
    routes = dict.fromkeys((*CHEAP, ("rosbag2", "view", "parquet", "lerobot")[seed % 4]))
    for verdict in world(seed, list(routes), [name]):
        assert verdict.verdict != SILENT, (verdict.command, verdict.lines)


@pytest.mark.slow
@table(("seed", "route"), SILENT_ONCE, gate=lambda seed, route: seed in (150, 318))
def test_what_was_silent_once_is_not(seed: int, route: str) -> None:
    (verdict,) = world(seed, [route])
    assert verdict.verdict != SILENT, (verdict.command, verdict.lines)


@table("name", MUTANTS, gate=lambda name: name in FEW_MUTANTS)
def test_a_mutant_is_found(name: str) -> None:
    assert is_found(name)


def test_a_seed_is_a_world() -> None:
    assert [one.data for one in plan_of(77).messages()] == [one.data for one in plan_of(77).messages()]
    assert {name for seed in range(1, len(CONDITIONS) + 1) for name in chosen(seed)} == set(CONDITIONS)
    assert {name for seed in range(60) for name in routes_of(seed, ())} == set(ROUTES)
