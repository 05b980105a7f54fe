"""The service for marks, as ROS and as Zenoh call it."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from igtl_gateway.app.mark_service import MarkService
from igtl_gateway.base.clock import ManualClock
from igtl_gateway.convert.igtl_msgs import MarkRequest
from igtl_gateway.gateway.log.marks import MarkNote

NOW_NS = 1_700_000_000 * 10**9
_OLD = {"label": "slip", "text": "", "who": "", "phase": ""}


@pytest.mark.parametrize(
    ("request_", "ago_ns"),
    [
        (MarkRequest("slip"), 0),
        (MarkRequest("slip", stamp_ns=NOW_NS - 8), 8),
        (SimpleNamespace(**_OLD, stamp=SimpleNamespace(sec=0, nanosec=0)), 0),
        (SimpleNamespace(**_OLD, stamp=SimpleNamespace(sec=1_699_999_992, nanosec=0)), 8 * 10**9),
        (SimpleNamespace(**_OLD), 0),  # of a package that is older than the stamp
    ],
)
def test_a_stamp_is_the_moment_of_the_mark(request_: Any, ago_ns: int) -> None:
    made: list[MarkNote] = []
    side: Any = None
    answer = MarkService(side, made.append, ManualClock(NOW_NS)).call(request_, SimpleNamespace())
    assert (answer.success, made) == (True, [MarkNote("slip", "", "ros", "", ago_ns)])


def test_a_stamp_of_another_clock_is_refused() -> None:
    made: list[MarkNote] = []
    side: Any = None
    answer = MarkService(side, made.append, ManualClock(NOW_NS)).call(
        MarkRequest("slip", stamp_ns=7), SimpleNamespace()
    )
    assert not answer.success and not made and "behind the bridge's clock" in answer.message
