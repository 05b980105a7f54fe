"""Rounds become one row, and what must not happen is not averaged away."""

from __future__ import annotations

from igtl_gateway_lab.bench.figures import Row
from igtl_gateway_lab.bench.rounds import against_version_1, merge_rounds, with_costs


def row(p50: float, delivered: int = 10, recording: bool = False, **more: float) -> Row:
    return {
        "case": "transform",
        "direction": "ros-to-igtl",
        "rate_hz": 30.0,
        "recording": recording,
        "sent": 10,
        "delivered": delivered,
        "p50_ms": p50,
        "p99_ms": 2 * p50,
        "max_ms": 9 * p50,
        **more,
    }


def test_one_round_stays_as_it_is() -> None:
    rows = [row(1.0), row(2.0, recording=True)]
    assert merge_rounds([rows]) == rows


def test_medians_and_the_worst() -> None:
    figures = ((3.0, 10, 0), (1.0, 8, 2), (2.0, 10, 0))
    rounds = [[row(p50, delivered, ros_lost=lost), row(10.0, recording=True)] for p50, delivered, lost in figures]
    first, second = merge_rounds(rounds)
    assert first["ros_lost"] == 2
    assert (first["p50_ms"], first["max_ms"]) == (2.0, 27.0)
    assert (first["sent"], first["delivered"]) == (10, 8)
    assert [one["p50_ms"] for one in first["rounds"]] == [3.0, 1.0, 2.0]
    assert (first["case"], first["rate_hz"], second["recording"]) == ("transform", 30.0, True)


def test_what_slicer_sends_is_compared_with_header_version_1() -> None:
    first = row(1.0, gateway_cpu_us_per_message=100.0) | {"case": "transform-n"}
    other = row(1.0)
    second = row(1.05, gateway_cpu_us_per_message=110.0) | {"case": "transform-s"}
    found = against_version_1([first, second, other])
    assert found[1]["version_1_p50_ratio"] == 1.05 and found[1]["version_1_cpu_ratio"] == 1.1
    assert [found[0], found[2]] == [first, other]


def test_what_was_not_measured_in_one_round() -> None:
    rounds = [[row(1.0) | {"ratio": value}] for value in (None, 1.5, 1.25)]
    assert merge_rounds(rounds)[0]["ratio"] == 1.25
    assert merge_rounds([[row(1.0) | {"ratio": None}]] * 2)[0]["ratio"] is None


def test_groups_of_figures_are_merged_figure_by_figure() -> None:
    figures: list[Row] = [{"a": {"p50_us": 3}}, {"a": {"p50_us": 5}}, {"b": {}}]
    (merged,) = merge_rounds([[row(1.0) | {"native_times": times}] for times in figures])
    assert merged["native_times"] == {"a": {"p50_us": 3}, "b": {}}


def test_what_a_recording_costs() -> None:
    other: Row = row(1.0) | {"bridge": "hop"}
    plain, recorded, _ = with_costs([row(2.0), row(3.0, recording=True), other])
    assert "recording_p50_ratio" not in plain
    assert (recorded["recording_p50_ratio"], recorded["recording_p99_ratio"]) == (1.5, 1.5)


def test_what_seals_cost() -> None:
    recorded = row(4.0, recording=True) | {"recorder_cpu_percent": 20.0}
    sealed = row(3.0, recording=True) | {"recorder_cpu_percent": 22.5, "sealed": True}
    _, _, told = with_costs([row(2.0), recorded, sealed])
    assert (told["sealing_p50_ratio"], told["sealing_cpu_percent"]) == (0.75, 2.5)
    assert "recording_p50_ratio" not in told
    assert "sealing_p50_ratio" not in with_costs([row(2.0), sealed])[1]
