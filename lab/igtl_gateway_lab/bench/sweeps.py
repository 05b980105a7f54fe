"""Costs as a size grows: the same measurement at several sizes, and a straight line through the figures."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from igtl_gateway_lab.bench.cases import SIZES, USUAL_HZ, BenchStream, Case, Direction, payload
from igtl_gateway_lab.bench.figures import Row
from igtl_gateway_lab.bench.runner import BenchPlan, Extent

_CPU, _P50, _FLOOR = "gateway_cpu_percent", "p50_ms", "floor_p50_ms"
_BYTES_PER_S = 60e6  # of the largest pictures, which would not pass at 30 Hz
_LEAST = 10  # messages, however rare they are
_STREAM_HZ = 10.0
_CLIENTS_HZ = 100.0
_FLAT = 1e-12  # less is rounding


@dataclass(frozen=True, slots=True)
class SweepPoint:
    """One size.

    Attributes:
        x: how much of it.
        case: what is measured.
        clients: on the side of OpenIGTLink.
        count: messages of each stream; 0: by the time.
    """

    x: float
    case: Case
    clients: int = 1
    count: int = 0


@dataclass(frozen=True, slots=True)
class Sweep:
    """Something that grows.

    Attributes:
        text: one line for people.
        x: what grows, for the axis.
        charts: fields that are drawn, one picture for each group.
        points: returns the sizes to measure, given the duration of each in seconds.
        floor: measure the bare hops too.
        logarithmic: both axes.
    """

    text: str
    x: str
    charts: tuple[tuple[str, ...], ...]
    points: Callable[[float], list[SweepPoint]]
    floor: bool = False
    logarithmic: bool = False

    def plans(self, extent: Extent, directions: Sequence[Direction]) -> list[tuple[Row, BenchPlan]]:
        """What is to be measured, and what its rows are marked with."""
        return [
            (
                {"x": point.x},
                BenchPlan(
                    point.case,
                    ways,
                    Extent(extent.seconds, extent.count or point.count),
                    self.floor,
                    clients=point.clients,
                ),
            )
            for point in self.points(extent.seconds)
            if (ways := tuple(way for way in directions if way in point.case.ways))
        ]


def _payloads(seconds: float) -> list[SweepPoint]:
    points = []
    for kind in SIZES.values():
        size = payload(kind).size
        rate_hz = min(USUAL_HZ, round(_BYTES_PER_S / size, 1))
        case = Case(kind, (BenchStream(kind, rate_hz),), "")
        points.append(SweepPoint(size, case, count=max(_LEAST, round(rate_hz * seconds))))
    return points


def _rates(_seconds: float) -> list[SweepPoint]:
    return [
        SweepPoint(rate_hz, Case("transform", (BenchStream("transform", rate_hz),), ""))
        for rate_hz in (30.0, 100.0, 300.0, 1000.0, 2000.0, 3000.0, 4000.0, 5000.0)
    ]


def _streams(_seconds: float) -> list[SweepPoint]:
    return [
        SweepPoint(
            many, Case(f"transform-x{many}", tuple(BenchStream("transform", _STREAM_HZ, at) for at in range(many)), "")
        )
        for many in (1, 10, 25, 50, 100, 150, 200)
    ]


def _clients(_seconds: float) -> list[SweepPoint]:
    case = Case("transform", (BenchStream("transform", _CLIENTS_HZ),), "", ways=(Direction.ROS_TO_IGTL,))
    return [SweepPoint(many, case, many) for many in (1, 2, 5, 10, 15, 20)]


SWEEPS: dict[str, Sweep] = {
    "payload": Sweep(
        "images of 1 kB to 50 MB at 30 Hz, or at most 60 MB/s",
        "message size, bytes",
        ((_P50, _FLOOR),),
        _payloads,
        floor=True,
        logarithmic=True,
    ),
    "rate": Sweep("a transform at 30 to 5000 Hz", "messages per second", ((_CPU,), (_P50,)), _rates),
    "streams": Sweep("1 to 200 transforms at 10 Hz each", "streams of 10 Hz", ((_CPU,), (_P50,)), _streams),
    "clients": Sweep(
        "a transform at 100 Hz to 1 to 20 OpenIGTLink clients",
        "clients that receive 100 Hz",
        ((_CPU,), (_P50,)),
        _clients,
    ),
}


def fit_lines(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """For each sweep, direction and figure: the line ``a + b x`` with the least squares, and how much it explains.

    The floor contains both directions, and is returned once.
    """
    lines = []
    for name, sweep in SWEEPS.items():
        floors = 0
        for direction in Direction:
            swept = [row for row in rows if (row.get("sweep"), row.get("direction")) == (name, direction.value)]
            for figure in (figure for chart in sweep.charts for figure in chart):
                points = [(row["x"], row[figure]) for row in swept if row.get(figure) is not None]
                floors += figure == _FLOOR and bool(points)
                if len(points) > 1 and (figure != _FLOOR or floors == 1):
                    of = {"sweep": name, "direction": direction.value, "figure": figure}
                    lines.append(of | line(points, relative=sweep.logarithmic))
    return lines


def line(points: Sequence[tuple[float, float]], relative: bool = False) -> dict[str, float]:
    """``a``, ``b`` and ``r2`` of points; where all are at one height, ``r2`` is 1.

    Args:
        points: x and y.
        relative: minimise the squares of relative differences; otherwise the largest sizes alone would determine
            the line.
    """
    x, y = np.array(points, np.float64).T
    b, a = np.polyfit(x, y, 1, w=1 / y if relative else None)
    spread = float(((y - y.mean()) ** 2).sum())
    rest = float(((y - a - b * x) ** 2).sum())
    r2 = 1 - rest / spread if spread > _FLAT * float((y**2).sum()) else 1.0
    return {"a": float(f"{a:.5g}"), "b": float(f"{b:.5g}"), "r2": round(r2, 4)}
