"""Things that grow: what is measured at each size, and the line through the figures."""

from __future__ import annotations

from xml.etree import ElementTree

import pytest

from igtl_gateway_lab.bench.cases import SIZES, Direction, payload
from igtl_gateway_lab.bench.figures import Row
from igtl_gateway_lab.bench.plot import sweep_plots
from igtl_gateway_lab.bench.runner import Extent
from igtl_gateway_lab.bench.sweeps import SWEEPS, fit_lines, line

SVG = "{http://www.w3.org/2000/svg}"


def test_a_line_through_points() -> None:
    assert line([(0, 1), (10, 3), (20, 5)]) == {"a": 1.0, "b": 0.2, "r2": 1.0}
    bent = line([(0, 0), (1, 1), (2, 4), (3, 9)])
    assert 0.8 < bent["r2"] < 1 and bent["b"] == pytest.approx(3)
    assert line([(1, 1), (2, 1), (100, 200), (200, 100)], relative=True)["a"] < 2  # where it is small it must fit
    assert line([(1, 2), (5, 2)])["r2"] == 1  # flat, and no more than that


@pytest.mark.parametrize("name", SWEEPS)
def test_every_size_is_measured_once_and_can_be_told_apart(name: str) -> None:
    marked = SWEEPS[name].plans(Extent(2.0), tuple(Direction))
    sizes = [marks["x"] for marks, _ in marked]
    assert sizes == sorted(set(sizes)) and len(sizes) > 5
    assert all(plan.directions for _, plan in marked)
    if name == "payload":
        assert all(plan.extent.messages(plan.case.streams[0]) >= 10 for _, plan in marked)


def test_sizes_of_pictures_are_what_they_are_called() -> None:
    for size in [size for size in SIZES if size < 2_000_000]:
        assert payload(SIZES[size]).size == pytest.approx(size, rel=0.12)


def test_what_was_swept_is_drawn_with_its_lines() -> None:
    rows: list[Row] = [
        {"sweep": name, "x": x, "direction": way.value, "p50_ms": 1 + x / 1e6, "floor_p50_ms": 0.5 + x / 2e6}
        | {"gateway_cpu_percent": 2 + x / 100}
        for name, sizes in (("payload", (1e3, 1e6, 5e7)), ("streams", (1, 100, 200)))
        for x in sizes
        for way in Direction
    ]
    found = fit_lines(rows)
    assert len(found) == 2 + 1 + 4
    assert {(fit["sweep"], fit["figure"]): fit["b"] for fit in found} == {
        ("payload", "p50_ms"): 1e-6,
        ("payload", "floor_p50_ms"): 5e-7,
        ("streams", "gateway_cpu_percent"): 0.01,
        ("streams", "p50_ms"): 1e-6,
    }
    plots = sweep_plots(rows, found)
    assert list(plots) == [
        "sweep-payload-p50_ms.svg",
        "sweep-streams-gateway_cpu_percent.svg",
        "sweep-streams-p50_ms.svg",
    ]
    payloads = ElementTree.fromstring(plots["sweep-payload-p50_ms.svg"])
    assert len(list(payloads.iter(f"{SVG}use"))) >= 3 * 3  # two directions, one floor
    assert any("r² = 1.000" in str(text.text) for text in payloads.iter(f"{SVG}text"))
