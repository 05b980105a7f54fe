"""The pictures are SVG with the values of the rows."""

from __future__ import annotations

from typing import Any
from xml.etree import ElementTree

from igtl_gateway_lab.bench.plot import latency_plots

SVG = "{http://www.w3.org/2000/svg}"


def row(case: str, direction: str, p50: float | None, floor: float | None = None) -> dict[str, Any]:
    return {"case": case, "direction": direction, "rate_hz": 30.0, "p50_ms": p50, "p99_ms": p50, "floor_p50_ms": floor}


def test_one_picture_a_direction_with_a_bar_for_each_number() -> None:
    rows = [
        row("transform", "ros-to-igtl", 0.5, 0.25),
        row("image<vga>", "ros-to-igtl", 5.0),
        row("transform", "ros-to-igtl", 0.375) | {"bridge": "hop"},
        row("transform", "igtl-to-ros", 1.0),
        row("lost", "igtl-to-ros", None),
        {"case": "start-up", "port_p50_s": 1.0},
    ]
    plots = latency_plots(rows)
    assert list(plots) == ["latency-ros-to-igtl.svg", "latency-igtl-to-ros.svg"]
    drawn = ElementTree.fromstring(plots["latency-ros-to-igtl.svg"])
    texts = [text.text for text in drawn.iter(f"{SVG}text")]
    assert "image<vga>, 30 Hz" in texts and "transform, 30 Hz, hop" in texts and "0.25" in texts
    assert {"floor, p50", "p50", "p99", "ms, logarithmic", "One-way latency, ros-to-igtl"} <= set(texts)
    assert all(text in texts for text in ("0.5", "5")), "bars have their values"
    assert latency_plots(rows) == plots, "equal rows give equal files"


def test_nothing_measured_is_no_picture() -> None:
    assert latency_plots([row("transform", "igtl-to-ros", None), {"case": "verify"}]) == {}
