"""The planner runs on test/session.mcap; test/good.mcap has the outputs of the last version that was looked at."""

import itertools
import math
import sys
from pathlib import Path

import igtl_gateway

PLANNER = [sys.executable, str(Path(__file__).parents[1] / "resim_example" / "planner.py")]


def test_the_plan_is_as_before(igtl_resim):
    igtl_resim("session.mcap", PLANNER, baseline="good.mcap", tolerance_mm=0.05, tolerance_deg=0.05)


def test_the_robot_is_never_faster_than_50_mm_per_second(igtl_resim):
    found = igtl_resim("session.mcap", PLANNER, runs=2)
    with igtl_gateway.open(found.outputs) as outputs:
        places = outputs["/servo_cp"].poses().positions
    assert len(places) > 150
    for one, other in itertools.pairwise(places):
        assert math.dist(one, other) <= 2.5 + 1e-6  # mm in 50 ms
